"""The simulated devices, asked by pymodbus's own clients and by mbpoll; none of our protocol code takes part."""

from __future__ import annotations

import contextlib
import os
import random
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pymodbus.exceptions import ModbusIOException

from gateway.errors import LinkUnavailable, PointsOutOfRange, RequestInvalid
from gateway.modbus.pdu import Table
from gateway.simulator import WRITES_KEPT, Device, Simulator, demo_devices
from tests.peers import client_rtu_over_tcp, client_serial, client_tcp, free_port, has_mbpoll, mbpoll, unit_kwargs

COILS, INPUTS, HOLDING, INPUT_REGISTERS = Table
SOON_S = 5.0  # a limit for waits that end at once when all is well
CUT_S = 0.15  # how long a client waits for a device that will not answer


@pytest.fixture
def simulator() -> Iterator[Simulator]:
    with Simulator() as running:
        yield running


def a_device(unit: int = 17, first: int = 107, name: str = "device") -> Device:
    device = Device(name, unit)
    device.set(COILS, first, [1, 0, 1, 1, 0, 0, 1, 0, 1])
    device.set(INPUTS, first, [0, 1, 1])
    device.set(HOLDING, first, [555, 0, 100])
    device.set(INPUT_REGISTERS, first, [65535, 1])
    return device


def registers(client: Any, address: int, count: int, unit: int) -> list[int]:
    reply = client.read_holding_registers(address, count=count, **unit_kwargs(unit))
    assert not reply.isError(), reply
    return list(reply.registers)


def what_is_open() -> set[tuple[str, str]]:
    found = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        if descriptor.is_symlink():  # the one that lists the folder is gone by now
            found.add((descriptor.name, str(descriptor.readlink())))
    return found


Line = Callable[[Simulator, Device], Any]  # puts the device on a line of its own, gives a client there


def over_pty(framing: str) -> Line:
    return lambda simulator, device: client_serial(simulator.add_serial([device], framing), framing)


LINES: dict[str, Line] = {
    "rtu on a pty": over_pty("rtu"),
    "ascii on a pty": over_pty("ascii"),
    "tcp": lambda simulator, device: client_tcp(simulator.add_tcp([device])),
    "rtu over tcp": lambda simulator, device: client_rtu_over_tcp(simulator.add_tcp([device], framing="rtu")),
}
every_line = pytest.mark.parametrize("line", LINES.values(), ids=LINES.keys())


@every_line
def test_all_four_tables_are_read_and_two_written_over_every_line(simulator: Simulator, line: Line) -> None:
    device = a_device()
    here = unit_kwargs(17)
    with line(simulator, device) as client:
        assert registers(client, 107, 3, 17) == [555, 0, 100]
        assert list(client.read_input_registers(107, count=2, **here).registers) == [65535, 1]
        assert list(client.read_coils(107, count=9, **here).bits[:9]) == [1, 0, 1, 1, 0, 0, 1, 0, 1]
        assert list(client.read_discrete_inputs(107, count=3, **here).bits[:3]) == [0, 1, 1]
        for reply in (
            client.write_register(109, 40000, **here),
            client.write_registers(107, [1, 2], **here),
            client.write_coil(107, False, **here),
            client.write_coils(108, [True, True, False], **here),
        ):
            assert not reply.isError()
        assert registers(client, 107, 3, 17) == [1, 2, 40000]
    assert list(device.writes) == [
        (HOLDING, 109, [40000]),
        (HOLDING, 107, [1, 2]),
        (COILS, 107, [0]),
        (COILS, 108, [1, 1, 0]),
    ]
    assert device.get(COILS, 107, 4) == [0, 1, 1, 0]
    assert device.served == 9


@every_line
def test_points_that_do_not_exist_are_refused_with_exception_2(simulator: Simulator, line: Line) -> None:
    device = a_device()
    here = unit_kwargs(17)
    with line(simulator, device) as client:
        for reply in (
            client.read_coils(108, count=9, **here),
            client.read_discrete_inputs(0, count=1, **here),
            client.read_holding_registers(106, count=2, **here),
            client.read_input_registers(109, count=1, **here),
            client.write_register(110, 1, **here),
            client.write_registers(109, [1, 2], **here),
            client.write_coil(0, True, **here),
            client.write_coils(115, [True, True], **here),
        ):
            assert reply.isError()
            assert reply.exception_code == 2
        assert registers(client, 109, 1, 17) == [100]  # a refused block is refused whole
    assert not device.writes


@every_line
def test_a_silent_device_times_out_takes_no_write_and_comes_back(simulator: Simulator, line: Line) -> None:
    device = a_device()
    with line(simulator, device) as client:
        client.comm_params.timeout_connect = CUT_S
        if hasattr(client.socket, "settimeout"):
            client.socket.settimeout(CUT_S)
        device.silent = True
        with pytest.raises(ModbusIOException):
            client.write_register(107, 1, **unit_kwargs(17))
        device.silent = False
        assert registers(client, 107, 1, 17) == [555]
    assert not device.writes


@every_line
def test_a_unit_that_is_not_there_is_silent(simulator: Simulator, line: Line) -> None:
    with line(simulator, a_device()) as client:
        client.comm_params.timeout_connect = CUT_S
        with pytest.raises(ModbusIOException):
            client.read_holding_registers(107, count=1, **unit_kwargs(18))


def test_two_units_share_a_line_and_one_silent_unit_leaves_the_other_alone(simulator: Simulator) -> None:
    one, two = a_device(1), a_device(2)
    two.set(HOLDING, 107, [7])
    path = simulator.add_serial([one, two])
    with client_serial(path, timeout_s=CUT_S) as client:
        assert registers(client, 107, 1, 1) == [555]
        assert registers(client, 107, 1, 2) == [7]
        one.silent = True
        with pytest.raises(ModbusIOException):
            client.read_holding_registers(107, count=1, **unit_kwargs(1))
        assert registers(client, 107, 1, 2) == [7]


def test_a_broadcast_reaches_every_unit_but_the_silent_one(simulator: Simulator) -> None:
    arrived = threading.Event()

    def watch(device: Device, _seconds: float) -> None:
        if device.writes:
            arrived.set()

    silent, one, two = a_device(1), a_device(2), a_device(3)
    silent.silent = True
    two.moves = watch
    with client_serial(simulator.add_serial([silent, one, two])) as client:
        client.write_register(107, 9, no_response_expected=True, **unit_kwargs(0))
        assert arrived.wait(SOON_S)
    assert [device.get(HOLDING, 107) for device in (silent, one, two)] == [[555], [9], [9]]


def test_values_move_while_nobody_asks_and_are_there_at_the_first_read(simulator: Simulator) -> None:
    third_tick = threading.Event()
    seconds_seen: list[float] = []

    def move(device: Device, seconds: float) -> None:
        seconds_seen.append(seconds)
        device.set(HOLDING, 0, [len(seconds_seen)])
        if len(seconds_seen) == 3:
            third_tick.set()

    with client_tcp(simulator.add_tcp([Device("moving", 1, moves=move)])) as client:
        assert registers(client, 0, 1, 1)[0] >= 1
        assert third_tick.wait(SOON_S)
        assert registers(client, 0, 1, 1)[0] >= 3
    assert seconds_seen == sorted(seconds_seen)


def test_the_master_may_close_its_end_and_open_it_again(simulator: Simulator) -> None:
    path = simulator.add_serial([a_device()])
    for _ in range(5):
        with client_serial(path) as client:
            assert registers(client, 107, 3, 17) == [555, 0, 100]


def test_a_master_that_never_reads_disturbs_nobody(simulator: Simulator) -> None:
    deaf = simulator.add_serial([a_device()])
    port = simulator.add_tcp([a_device()])
    # unit 17, function 3, address 107, 3 registers, CRC
    request = bytes.fromhex("11 03 006B 0003 7687")
    descriptor = os.open(deaf, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        with client_tcp(port) as client:
            for _ in range(50):
                os.set_blocking(descriptor, True)
                os.write(descriptor, request * 100)
                assert registers(client, 107, 3, 17) == [555, 0, 100]
    finally:
        os.close(descriptor)


@pytest.mark.parametrize(
    ("framing", "noise"),
    [
        ("rtu", random.Random(4).randbytes(3000)),
        ("rtu", bytes.fromhex("11 03 006B")),  # a request cut short
        ("ascii", b":\x03w0000000000\r\n"),  # no hexadecimal digits
        ("ascii", b":1103006B\r\n"),  # cut short, the LRC is wrong
    ],
)
def test_noise_costs_a_line_no_more_than_two_requests(simulator: Simulator, framing: str, noise: bytes) -> None:
    path = simulator.add_serial([a_device()], framing)
    with client_serial(path, framing, timeout_s=CUT_S) as client:
        assert client.socket is not None
        client.socket.write(noise)
        for _ in range(2):
            with contextlib.suppress(ModbusIOException):
                client.read_holding_registers(107, count=3, **unit_kwargs(17))
        assert registers(client, 107, 3, 17) == [555, 0, 100]


def test_a_bug_in_moves_ends_the_simulator_in_the_open(monkeypatch: pytest.MonkeyPatch) -> None:
    raised: list[type[BaseException]] = []
    ended = threading.Event()

    def seen(args: threading.ExceptHookArgs) -> None:
        raised.append(args.exc_type)
        ended.set()

    def move(device: Device, _seconds: float) -> None:
        device.set(HOLDING, 0, [-1 if device.served else 0])

    monkeypatch.setattr(threading, "excepthook", seen)
    device = Device("faulty", 1, moves=move)
    with Simulator() as simulator:
        with client_tcp(simulator.add_tcp([device])) as client:
            registers(client, 0, 1, 1)
            assert ended.wait(SOON_S)
        assert raised == [RequestInvalid]


def test_a_value_never_tears_between_threads(simulator: Simulator) -> None:
    device = Device("pair", 1)
    device.set(HOLDING, 0, [0] * 100)
    stop = threading.Event()

    def write() -> None:
        value = 0
        while not stop.is_set():
            value = (value + 1) % 65536
            device.set(HOLDING, 0, [value] * 100)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        with client_tcp(simulator.add_tcp([device])) as client:
            for _ in range(50):
                assert len(set(registers(client, 0, 100, 1))) == 1
    finally:
        stop.set()
        writer.join()


def test_stop_leaves_no_thread_no_descriptor_and_takes_less_than_a_second() -> None:
    Simulator().stop()  # never started: nothing to do
    with Simulator() as first:  # what Python opens once and keeps
        first.add_tcp([a_device()])
    threads, descriptors = set(threading.enumerate()), what_is_open()
    simulator = Simulator()
    for _ in range(5):
        simulator.start()
        path = simulator.add_serial([a_device()])
        port = simulator.add_tcp([a_device()])
        with client_serial(path) as one, client_tcp(port) as two, client_tcp(port) as three:
            for client in (one, two, three):
                assert registers(client, 107, 1, 17) == [555]
            before_s = time.monotonic()
            simulator.stop()
            assert time.monotonic() - before_s < 1.0
        simulator.stop()
        assert set(threading.enumerate()) == threads
        assert what_is_open() == descriptors


def test_what_cannot_be_set_up_is_an_error_of_ours_and_leaves_nothing_open() -> None:
    with pytest.raises(LinkUnavailable, match="not running"):
        Simulator().add_tcp([a_device()])
    with Simulator() as simulator:
        port = simulator.add_tcp([a_device()], free_port())
        before = what_is_open()
        with pytest.raises(LinkUnavailable, match=f"127.0.0.1:{port}"):
            simulator.add_tcp([a_device()], port)
        for add in (simulator.add_tcp, simulator.add_serial):
            with pytest.raises(RequestInvalid, match="one unit"):
                add([a_device(1), a_device(1)])
            with pytest.raises(RequestInvalid, match="framing"):
                add([a_device()], framing="morse")
        assert what_is_open() == before


def test_a_device_refuses_values_and_addresses_that_modbus_does_not_have() -> None:
    device = a_device()
    with pytest.raises(PointsOutOfRange):
        device.get(HOLDING, 109, 2)
    with pytest.raises(PointsOutOfRange):
        device.set(HOLDING, 65535, [1, 2])
    for table, value in ((HOLDING, 65536), (HOLDING, -1), (COILS, 2)):
        with pytest.raises(RequestInvalid):
            device.set(table, 0, [value])


def test_the_record_of_writes_is_bounded() -> None:
    device = a_device()
    for value in range(WRITES_KEPT + 5):
        device.receive(HOLDING, 107, [value])
    assert len(device.writes) == WRITES_KEPT
    assert device.writes[-1] == (HOLDING, 107, [WRITES_KEPT + 4])


def test_the_demo_boiler_heats_to_its_setpoint_and_cools_without_its_burner() -> None:
    _, boiler, _ = demo_devices()
    assert boiler.moves is not None

    def at(seconds: float) -> int:
        assert boiler.moves is not None
        boiler.moves(boiler, seconds)
        return boiler.get(HOLDING, 107)[0]

    cold = at(0.0)
    assert 590 <= [at(tenths / 10) for tenths in range(1, 300)][-1] <= 620
    boiler.receive(HOLDING, 110, [750])
    assert 740 <= [at(tenths / 10) for tenths in range(300, 600)][-1] <= 770
    boiler.receive(COILS, 0, [0])
    assert [at(tenths / 10) for tenths in range(600, 2000)][-1] < cold


def test_the_demo_devices_answer_on_their_lines_and_move(simulator: Simulator) -> None:
    meter, boiler, block = demo_devices()
    path = simulator.add_serial([meter, boiler])
    port = simulator.add_tcp([block])
    with client_serial(path) as serial, client_tcp(port) as tcp:
        volts, _, _, *energy = serial.read_input_registers(0, count=5, **unit_kwargs(2)).registers
        assert 2250 <= volts <= 2350
        assert energy[0] << 16 | energy[1] >= 1_234_500
        assert registers(serial, 107, 4, 17)[3] == 600
        tcp.write_coil(3, True, **unit_kwargs(1))
        assert list(tcp.read_coils(0, count=8, **unit_kwargs(1)).bits) == [0, 0, 0, 1, 0, 0, 0, 0]
    assert block.moves is not None
    block.moves(block, 2.0)
    assert block.get(INPUTS, 0, 16) == [*(0, 0, 0, 0, 1, 0, 0, 0), *(0, 0, 0, 1, 0, 0, 0, 0)]


@pytest.mark.skipif(not has_mbpoll(), reason="mbpoll is not installed")
def test_libmodbus_reads_a_simulated_device_on_a_pty_and_on_tcp(simulator: Simulator) -> None:
    path = simulator.add_serial([a_device()])
    port = simulator.add_tcp([a_device()])
    asked = ["-0", "-1", "-q", "-a", "17", "-t", "4", "-r", "107", "-c", "3"]
    for line in (["-m", "rtu", "-b", "19200", "-P", "none", path], ["-m", "tcp", "-p", str(port), "127.0.0.1"]):
        said = mbpoll(*asked, *line).split()
        assert said[said.index("[107]:") :] == ["[107]:", "555", "[108]:", "0", "[109]:", "100"]
