"""Values that survive a restart, through whole stations: devices and SCADA by pymodbus, real lines, a real file."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.modbus.pdu import Span, Table
from gateway.register import RESTORED, Quality, Sample
from gateway.retained import FILE_NAME, RetainedFile, decode
from gateway.simulator import Device, Simulator
from gateway.store import load_text
from gateway.supervisor import Supervisor
from gateway.wiring import build
from tests.fakes import SCADA
from tests.peers import client_tcp, free_port, unit_kwargs
from tests.points import coils, holding, scada
from tests.stations import RunningStation, running_station
from tests.tasks import running

HOLDING, INPUTS = Table.HOLDING_REGISTERS, Table.INPUT_REGISTERS
READ_BACK = """
[[master.request]]
name = "read-back"
unit = 17
function = "read-holding-registers"
address = 107
count = 2
every = 0.01
point = 10
status_point = 500
"""
WRITES = """
[[master.request]]
name = "setpoints"
unit = 17
function = "write-multiple-registers"
address = 107
count = 2
every = 0.01
point = 10
trigger = "{trigger}"
"""
RETAIN = '[register]\nretain = ["holding_registers", "input_registers"]\n'


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "state" / FILE_NAME


@pytest.fixture
def simulator() -> Iterator[Simulator]:
    with Simulator() as simulator:
        yield simulator


@pytest.fixture
def device() -> Device:
    device = Device("boiler", 17)
    device.set(HOLDING, 107, [50, 51])
    return device


class Town:
    """One configuration, whose station is started again and again."""

    def __init__(self, file: Path, line: str, requests: str, register: str = RETAIN, slave: str = "") -> None:
        self.file = file
        self.port = free_port()
        self.text = (
            f'{register}[[master]]\nname = "field"\nresponse_timeout = 0.15\n{line}\n{requests}\n'
            f'[[slave]]\nname = "scada"\nline = "tcp://127.0.0.1:{self.port}"\nunit = 1\n{slave}'
        )

    def write(self, point: int, *written: int) -> None:
        with client_tcp(self.port) as client:
            assert not client.write_registers(point, list(written), **unit_kwargs(1)).isError()

    def read(self, point: int, count: int) -> list[int] | int:
        """Return what SCADA is answered: registers, or an exception code."""
        with client_tcp(self.port) as client:
            reply = client.read_holding_registers(point, count=count, **unit_kwargs(1))
            return int(reply.exception_code) if reply.isError() else list(reply.registers)

    @contextmanager
    def run(self) -> Iterator[RunningStation]:
        with running_station(self.text, self.file) as station:
            yield station


def line_of(simulator: Simulator, device: Device) -> str:
    return f'line = "tcp://127.0.0.1:{simulator.add_tcp([device])}"'


def sample(station: RunningStation, point: int, table: Table = HOLDING) -> Sample:
    return station.register.samples(Span(table, point, 1))[0]


def test_what_scada_wrote_is_there_after_a_restart_with_its_age(file: Path) -> None:
    town = Town(file, 'line = "/dev/ttyNONE"', "")
    with town.run():
        town.write(100, 7, 8, 9)
    with town.run() as station:
        assert town.read(99, 5) == [0, 7, 8, 9, 0]
        found = sample(station, 101)
        assert (found.value, found.quality, found.source) == (8, Quality.STALE, RESTORED)
        assert found.age_s is not None
        assert 0.0 <= found.age_s < 10.0
        town.write(101, 88)
        assert sample(station, 101).quality is Quality.GOOD
    with town.run():
        assert town.read(99, 5) == [0, 7, 88, 9, 0]


def test_a_new_table_size_keeps_the_points_that_remain(file: Path) -> None:
    town = Town(file, 'line = "/dev/ttyNONE"', "")
    with town.run():
        town.write(98, 1, 2, 3, 4)
    town.text = town.text.replace("retain = [", "holding_registers = 100\nretain = [")
    with town.run():
        assert town.read(98, 2) == [1, 2]
        assert town.read(98, 3) == 2
        town.write(97, 9)
    town.text = town.text.replace("holding_registers = 100", "holding_registers = 5000")
    with town.run():
        assert town.read(97, 5) == [9, 1, 2, 0, 0]


def test_a_damaged_file_gives_nothing_and_the_station_runs(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    town = Town(file, 'line = "/dev/ttyNONE"', "")
    with town.run():
        town.write(100, 7)
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    with town.run() as station:
        assert town.read(100, 1) == [0]
        assert sample(station, 100).quality is Quality.NEVER
    assert "retained.bin is not used: its checksum does not fit" in caplog.text


def test_a_cyclic_request_sends_what_scada_wrote_before_the_restart(
    simulator: Simulator, device: Device, file: Path
) -> None:
    """The device was off as well and has its own defaults again; the read-back, which comes first, hides nothing."""
    town = Town(file, line_of(simulator, device), READ_BACK + WRITES.format(trigger="cycle"))
    with town.run() as station:
        town.write(10, 66, 67)
        station.wait_until(lambda: bool(device.writes))
    device.set(HOLDING, 107, [50, 51])
    device.writes.clear()
    with town.run() as station:
        station.wait_until(lambda: sample(station, 10).quality is Quality.GOOD)
        assert town.read(10, 2) == [66, 67]
    assert device.writes
    assert all(write == (HOLDING, 107, [66, 67]) for write in device.writes)


def test_a_restart_alone_sends_nothing_that_is_sent_on_change(simulator: Simulator, device: Device, file: Path) -> None:
    town = Town(file, line_of(simulator, device), READ_BACK + WRITES.format(trigger="change"))
    with town.run() as station:
        town.write(10, 66, 67)
        station.wait_until(lambda: bool(device.writes))
    device.set(HOLDING, 107, [50, 51])
    device.writes.clear()
    with town.run() as station:
        served = device.served
        station.wait_until(lambda: device.served > served + 20)
        assert town.read(10, 2) == [50, 51]
    assert list(device.writes) == []


def test_what_was_only_read_from_a_device_is_not_sent_to_it_after_a_restart(
    simulator: Simulator, device: Device, file: Path
) -> None:
    town = Town(file, line_of(simulator, device), READ_BACK + WRITES.format(trigger="cycle"))
    with town.run() as station:
        station.wait_until(lambda: sample(station, 10).quality is Quality.GOOD)
    device.set(HOLDING, 107, [52, 53])  # somebody at the device
    with town.run() as station:
        station.wait_until(lambda: sample(station, 10).value == 52)
        served = device.served
        station.wait_until(lambda: device.served > served + 20)
    assert list(device.writes) == []


@pytest.mark.parametrize(("stale", "answer"), [("exception", 11), ("serve", [50, 51])])
def test_a_value_read_before_the_restart_is_not_passed_off_as_fresh(
    simulator: Simulator, device: Device, file: Path, stale: str, answer: object
) -> None:
    town = Town(file, line_of(simulator, device), READ_BACK, slave=f'stale = "{stale}"\n')
    with town.run() as station:
        station.wait_until(lambda: sample(station, 10).quality is Quality.GOOD)
        town.write(12, 7)
    device.silent = True
    with town.run() as station:
        assert town.read(10, 2) == answer
        assert town.read(12, 1) == [7]  # no request fills it: always served
        station.wait_until(lambda: sample(station, 10).quality is Quality.BAD)
        assert town.read(10, 2) == answer
        device.silent = False
        station.wait_until(lambda: sample(station, 10).quality is Quality.GOOD)
        assert town.read(10, 2) == [50, 51]


def test_what_the_gateway_writes_for_scada_is_not_retained(simulator: Simulator, device: Device, file: Path) -> None:
    events = "[events]\nblock_point = 300\n"
    town = Town(file, line_of(simulator, device), READ_BACK + "events = true\n", register=RETAIN + events)
    with town.run() as station:
        station.wait_until(lambda: sample(station, 500, INPUTS).value == 1)
        device.set(HOLDING, 107, [52, 51])
        station.wait_until(lambda: sample(station, 301).value == 1)  # one change waits
        town.write(299, 7)
    assert sorted(block.span.start for block in decode(file.read_bytes()).blocks) == [10, 299]
    device.set(HOLDING, 107, [54, 51])
    with town.run() as station:
        station.wait_until(lambda: sample(station, 10).value == 54)
        assert town.read(299, 7) == [7, 0, 1, 0, 1, 3, 10]  # what changed while the gateway was off is one change


# ------------------------------------------------------------------------------------------------ the program


@contextmanager
def program(config: Path, state: Path, port: int = 0) -> Iterator[None]:
    """`rtugate run` until the block ends; by its start the slave answers at *port*, if there is one."""
    known = {name: value for name, value in os.environ.items() if name not in ("STATE_DIRECTORY", "RUNTIME_DIRECTORY")}
    command = [sys.executable, "-m", "gateway", "run", "-c", str(config), "--state", str(state)]
    process = subprocess.Popen(command, env=known, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        for line in process.stderr:
            if " runs: " in line:
                break
        while port and not answers(port):
            assert process.poll() is None
        yield
        process.send_signal(signal.SIGTERM)
        assert process.wait(10.0) == 0
    finally:
        process.kill()
        process.communicate()


def answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_the_program_keeps_values_until_it_is_told_not_to(tmp_path: Path) -> None:
    state, config = tmp_path / "state", tmp_path / "rtugate.toml"
    town = Town(state / FILE_NAME, 'line = "/dev/ttyNONE"', "")
    config.write_text(town.text)
    with program(config, state, town.port):
        town.write(100, 7)
    config.write_text("a slip of the pen")
    with program(config, state):  # something else runs, which is no reason to forget
        assert town.file.exists()
    config.write_text(town.text)
    with program(config, state, town.port):
        assert town.read(100, 1) == [7]
    config.write_text(town.text.replace(RETAIN, ""))
    with program(config, state, town.port):
        assert town.read(100, 1) == [0]
        assert not town.file.exists()
    config.write_text(town.text)
    with program(config, state, town.port):
        assert town.read(100, 1) == [0]  # nothing from long ago


def test_a_change_of_what_is_retained_acts_at_once(file: Path) -> None:
    """A task that ends saves what it was to keep; where nothing is retained any more, the file goes."""
    texts = [f"[register]\nretain = [{names}]\n" for names in ('"holding_registers"', '"coils"', "")]
    configs = [load_text(text, "test.toml").config for text in texts]
    retained = RetainedFile(file)
    station = build(configs[0], SystemClock(), retained)
    scada(station.register, 5, 7)
    station.register.write(coils(3), b"\x01", SCADA)
    with running(Supervisor(station.plans_for(configs[0]), station.clock)) as run:
        found = []
        for config in [*configs[1:], configs[0]]:
            run.change(station.plans_for(config), partial(station.adopt, config))
            found.append([b.span for b in decode(file.read_bytes()).blocks] if file.exists() else None)
    assert found == [[holding(5)], None, None]
    assert [b.span for b in decode(file.read_bytes()).blocks] == [holding(5)]


def test_what_is_not_to_be_retained_any_more_is_not_saved_at_the_end(file: Path) -> None:
    configs = [load_text(text, "test.toml").config for text in (RETAIN, "")]
    station = build(configs[0], SystemClock(), RetainedFile(file))
    scada(station.register, 5, 7)
    with running(Supervisor(station.plans, station.clock)) as run:
        run.change(station.plans_for(configs[1]), partial(station.adopt, configs[1]))
    station.save_last()
    assert not file.exists()


def test_what_a_slave_still_stores_while_the_others_have_stopped_is_saved(file: Path) -> None:
    config = load_text(RETAIN, "test.toml").config
    station = build(config, SystemClock(), RetainedFile(file))
    with running(Supervisor(station.plans, station.clock)):
        pass
    scada(station.register, 5, 7)
    station.save_last()
    assert [b.span for b in decode(file.read_bytes()).blocks] == [holding(5)]
    build(config, SystemClock()).save_last()  # where nothing is retained there is nothing to save
