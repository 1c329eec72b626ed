"""The main road: devices (pymodbus) - master - register - slave - SCADA (pymodbus, libmodbus), with real lines."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.modbus.pdu import Span, Table
from gateway.register import Quality
from gateway.simulator import Device, Simulator
from tests.peers import client_tcp, free_port, has_mbpoll, mbpoll, unit_kwargs
from tests.stations import running_station

HOLDING = Table.HOLDING_REGISTERS


@pytest.fixture
def simulator() -> Iterator[Simulator]:
    with Simulator() as simulator:
        yield simulator


def a_device(unit: int = 17) -> Device:
    """A device with points in all four tables."""
    device = Device(f"device {unit}", unit)
    device.set(Table.COILS, 0, [1, 0, 1, 1, 0, 0, 0, 1, 1])
    device.set(Table.DISCRETE_INPUTS, 100, [0, 1] * 10)
    device.set(HOLDING, 107, [555, 0, 65535, 7])
    device.set(Table.INPUT_REGISTERS, 8, [10, 20])
    return device


def line_of(simulator: Simulator, device: Device, framing: str, is_tcp: bool) -> str:
    if is_tcp:
        return f'line = "tcp://127.0.0.1:{simulator.add_tcp([device], framing=framing)}"\nframing = "{framing}"'
    path = simulator.add_serial([device], framing)
    return f'line = "{path}"\nframing = "{framing}"\nparity = "none"\ndata_bits = 8'


REQUESTS = """
[[master.request]]
unit = 17
function = "read-coils"
address = 0
count = 9
every = 0.05
point = 1

[[master.request]]
unit = 17
function = "read-discrete-inputs"
address = 100
count = 20
every = 0.05
point = 0

[[master.request]]
unit = 17
function = "read-holding-registers"
address = 107
count = 4
every = 0.05
point = 0

[[master.request]]
unit = 17
function = "read-input-registers"
address = 8
count = 2
every = 0.05
point = 8
"""


def config(line: str, port: int, requests: str = REQUESTS) -> str:
    slave = f'[[slave]]\nname = "scada"\nline = "tcp://127.0.0.1:{port}"\nunit = 1\n'
    return f'[[master]]\nname = "field"\nresponse_timeout = 0.15\n{line}\n{requests}\n{slave}'


@pytest.mark.parametrize(
    ("framing", "is_tcp"), [("rtu", False), ("ascii", False), ("tcp", True), ("rtu", True), ("ascii", True)]
)
def test_values_go_from_device_to_scada_in_every_framing(simulator: Simulator, framing: str, is_tcp: bool) -> None:
    device, port = a_device(), free_port()
    with running_station(config(line_of(simulator, device, framing, is_tcp), port)) as station:
        register = station.register
        station.wait_until(lambda: register.samples(Span(Table.INPUT_REGISTERS, 9, 1))[0].quality is Quality.GOOD)
        with client_tcp(port) as scada:
            assert scada.read_coils(1, count=9, **unit_kwargs(1)).bits[:9] == [1, 0, 1, 1, 0, 0, 0, 1, 1]
            assert scada.read_discrete_inputs(0, count=20, **unit_kwargs(1)).bits[:20] == [0, 1] * 10
            assert scada.read_holding_registers(0, count=4, **unit_kwargs(1)).registers == [555, 0, 65535, 7]
            assert scada.read_input_registers(8, count=2, **unit_kwargs(1)).registers == [10, 20]


@pytest.mark.skipif(not has_mbpoll(), reason="mbpoll is not installed")
def test_libmodbus_sees_the_same_as_pymodbus(simulator: Simulator) -> None:
    device, port = a_device(), free_port()
    with running_station(config(line_of(simulator, device, "rtu", False), port)) as station:
        station.wait_until(lambda: station.register.read(Span(HOLDING, 0, 1)) == b"\x02\x2b")
        said = mbpoll("-m", "tcp", "-p", str(port), "-0", "-1", "-t", "4", "-r", "0", "-c", "4", "127.0.0.1")
    assert "[0]: \t555" in said
    assert "65535" in said


SETPOINT = """
[[master.request]]
name = "read-back"
unit = 17
function = "read-holding-registers"
address = 107
count = 4
every = 0.01
point = 0

[[master.request]]
name = "setpoints"
unit = 17
function = "write-multiple-registers"
address = 107
count = 4
point = 0
trigger = "change"
"""


def test_a_setpoint_arrives_exactly_once_in_1000_of_1000_tries(simulator: Simulator) -> None:
    """SCADA writes while the same points are polled all the time; the device's own record is the judge."""
    device, port = a_device(), free_port()
    rng = random.Random(1)
    wanted: list[tuple[Table, int, list[int]]] = []
    with (
        running_station(config(line_of(simulator, device, "tcp", True), port, SETPOINT)) as station,
        client_tcp(port) as scada,
    ):
        station.wait_until(lambda: station.register.read(Span(HOLDING, 0, 1)) == b"\x02\x2b")
        for number in range(1000):
            point, value = rng.randrange(4), number + 1
            assert not scada.write_register(point, value, **unit_kwargs(1)).isError()
            wanted.append((HOLDING, 107 + point, [value]))
            station.wait_until(lambda: len(device.writes) >= len(wanted))
        final = [value for [value] in (device.get(HOLDING, 107 + i) for i in range(4))]
        station.wait_until(lambda: station.register.read(Span(HOLDING, 0, 4)) == b"".join(v.to_bytes(2) for v in final))
    assert list(device.writes) == wanted


CYCLIC = """
[[master.request]]
name = "cyclic"
unit = 17
function = "write-multiple-registers"
address = 107
count = 4
every = 0.01
point = 0
"""


def test_nothing_is_written_after_a_start_that_nobody_wrote(simulator: Simulator) -> None:
    device, port = a_device(), free_port()
    line = line_of(simulator, device, "rtu", False)
    with running_station(config(line, port, SETPOINT + CYCLIC)) as station, client_tcp(port) as scada:
        polled = device.served
        station.wait_until(lambda: device.served > polled + 50)
        assert list(device.writes) == []
        assert not scada.write_registers(0, [1, 2, 3, 4], **unit_kwargs(1)).isError()
        station.wait_until(lambda: len(device.writes) > 3)  # now both write what somebody wrote
    assert all(write == (HOLDING, 107, [1, 2, 3, 4]) for write in device.writes)


def test_a_device_that_falls_silent_turns_bad_and_comes_back(simulator: Simulator) -> None:
    silent, well, port = a_device(17), a_device(18), free_port()
    line = f'line = "{simulator.add_serial([silent, well])}"\nparity = "none"'
    requests = REQUESTS + REQUESTS.replace("unit = 17", "unit = 18").replace("point = ", "point = 5")
    with running_station(config(line, port, requests)) as station:
        one, other = Span(HOLDING, 0, 1), Span(HOLDING, 50, 1)

        def quality(span: Span) -> Quality:
            return station.register.samples(span)[0].quality

        station.wait_until(lambda: quality(one) is quality(other) is Quality.GOOD)
        silent.silent = True
        station.wait_until(lambda: quality(one) is Quality.BAD)
        assert station.register.read(one) == b"\x02\x2b"  # held
        well.set(HOLDING, 107, [777])
        station.wait_until(lambda: station.register.read(other) == b"\x03\x09")  # polled on
        silent.silent = False
        silent.set(HOLDING, 107, [556])
        station.wait_until(lambda: station.register.read(one) == b"\x02\x2c", limit_s=15.0)
        assert quality(one) is Quality.GOOD


def test_a_port_that_is_not_there_yet_is_opened_when_it_comes(simulator: Simulator, tmp_path: Path) -> None:
    device, port, path = a_device(), free_port(), tmp_path / "tty-by-id"
    with running_station(config(f'line = "{path}"\nparity = "none"', port)) as station:
        station.wait_until(lambda: station.register.samples(Span(HOLDING, 0, 1))[0].quality is Quality.BAD)
        path.symlink_to(simulator.add_serial([device]))
        station.wait_until(lambda: station.register.read(Span(HOLDING, 0, 1)) == b"\x02\x2b")


def test_a_scada_write_to_a_read_only_table_or_beyond_it_is_refused(simulator: Simulator) -> None:
    port = free_port()
    with running_station(config(line_of(simulator, a_device(), "tcp", True), port)), client_tcp(port) as scada:
        assert scada.write_register(2000, 1, **unit_kwargs(1)).exception_code == 2
        assert scada.read_input_registers(1999, count=2, **unit_kwargs(1)).exception_code == 2
        assert scada.read_holding_registers(0, count=1, **unit_kwargs(9)).exception_code == 0x0B
