"""Slaves and other people's masters: pymodbus and mbpoll (libmodbus), over TCP, RTU, ASCII and RTU over TCP.

What a peer wrote is compared with the register, what it read with what the register held. Serial peers and slaves have
two ptys with a cable between them.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from gateway.config import SlaveConfig
from gateway.link import Link, SerialSettings, Waker, open_serial
from gateway.link_tcp import listen_tcp
from gateway.modbus.pdu import Span, Table, pack_bits, pack_words
from gateway.register import DataRegister
from gateway.slave import SerialSlave
from gateway.slave_tcp import TcpSlave
from tests import peers
from tests.lines import CLOCK, MENU, PATIENCE_S, UNIT, cable, holding, running, values

BITS = [number % 3 == 0 or number % 7 == 0 for number in range(2000)]
WORDS = [number * 40503 & 0xFFFF for number in range(2000)]  # all different
LAST = 1999
BAUD = 115200

needs_mbpoll = pytest.mark.skipif(not peers.has_mbpoll(), reason="mbpoll is not installed")
to_unit = peers.unit_kwargs(UNIT)


@pytest.fixture
def register() -> DataRegister:
    """A register in which no two points are mistaken for each other: the tables differ, and so do neighbours."""
    made = DataRegister(CLOCK)
    made.write(Span(Table.COILS, 0, 2000), pack_bits(BITS), MENU)
    made.write(Span(Table.DISCRETE_INPUTS, 0, 2000), pack_bits(BITS[::-1]), MENU)
    made.write(Span(Table.HOLDING_REGISTERS, 0, 2000), pack_words(WORDS), MENU)
    made.write(Span(Table.INPUT_REGISTERS, 0, 2000), pack_words(WORDS[::-1]), MENU)
    return made


@contextmanager
def tcp_slave(register: DataRegister, framing: str = "tcp") -> Iterator[int]:
    """Give the port of a running slave."""
    keys = {"name": "scada", "line": "tcp://127.0.0.1:502", "framing": framing, "unit": UNIT}
    config = SlaveConfig.model_validate(keys)
    listener = listen_tcp("127.0.0.1", 0)
    with contextlib.closing(Waker()) as waker, running(TcpSlave(config, register, CLOCK, waker, lambda: listener)):
        yield listener.getsockname()[1]


@contextmanager
def serial_slave(register: DataRegister, framing: str = "rtu") -> Iterator[str]:
    """Give the path that a master opens to reach a running slave."""
    keys = {"name": "scada", "line": "/dev/ttyS2", "framing": framing, "unit": UNIT}
    config = SlaveConfig.model_validate(keys | {"baudrate": BAUD, "parity": "none", "data_bits": 8})
    opened = threading.Event()
    with cable() as (path, peers_path), contextlib.closing(Waker()) as waker:

        def opening() -> Link:
            link = open_serial(SerialSettings(path, BAUD, "none"), waker, CLOCK)
            opened.set()
            return link

        with running(SerialSlave(config, register, CLOCK, waker, opening)):
            assert opened.wait(PATIENCE_S)
            yield peers_path


@contextmanager
def tcp_peer(register: DataRegister) -> Iterator[Any]:
    with tcp_slave(register) as port, peers.client_tcp(port) as client:
        yield client


@contextmanager
def rtu_over_tcp_peer(register: DataRegister) -> Iterator[Any]:
    with tcp_slave(register, "rtu") as port, peers.client_rtu_over_tcp(port) as client:
        yield client


@contextmanager
def rtu_peer(register: DataRegister) -> Iterator[Any]:
    with serial_slave(register) as path, peers.client_serial(path, "rtu", baudrate=BAUD) as client:
        yield client


@contextmanager
def ascii_peer(register: DataRegister) -> Iterator[Any]:
    with serial_slave(register, "ascii") as path, peers.client_serial(path, "ascii", baudrate=BAUD) as client:
        yield client


@pytest.fixture(params=[tcp_peer, rtu_over_tcp_peer, rtu_peer, ascii_peer], ids=lambda made: made.__name__[:-5])
def client(request: pytest.FixtureRequest, register: DataRegister) -> Iterator[Any]:
    """A pymodbus client, over each transport in turn."""
    with request.param(register) as made:
        yield made


# ------------------------------------------------------------------------------------------------ pymodbus


BIT_BLOCKS = [(0, 1), (0, 7), (3, 8), (5, 9), (LAST, 1), (0, 2000)]
WORD_BLOCKS = [(0, 1), (107, 3), (LAST, 1), (2000 - 125, 125)]


def test_pymodbus_reads_bits_of_every_quantity(client: Any) -> None:
    for start, count in BIT_BLOCKS:
        found = client.read_coils(start, count=count, **to_unit)
        assert found.bits[:count] == BITS[start : start + count]
        found = client.read_discrete_inputs(start, count=count, **to_unit)
        assert found.bits[:count] == BITS[::-1][start : start + count]


def test_pymodbus_reads_registers_of_every_quantity(client: Any) -> None:
    for start, count in WORD_BLOCKS:
        found = client.read_holding_registers(start, count=count, **to_unit)
        assert found.registers == WORDS[start : start + count]
        found = client.read_input_registers(start, count=count, **to_unit)
        assert found.registers == WORDS[::-1][start : start + count]


@pytest.mark.parametrize("start", [0, LAST])
def test_pymodbus_writes_single_points(client: Any, register: DataRegister, start: int) -> None:
    for on in (not BITS[start], BITS[start]):
        assert not client.write_coil(start, on, **to_unit).isError()
        assert values(register, Table.COILS, start) == [on]
    for value in (0, 0xFFFF, 0x1234):
        assert not client.write_register(start, value, **to_unit).isError()
        assert holding(register, start) == [value]


@pytest.mark.parametrize(("start", "count"), [(0, 1), (3, 9), (2000 - 1968, 1968)])
def test_pymodbus_writes_coils_and_no_neighbour(client: Any, register: DataRegister, start: int, count: int) -> None:
    changed = [not bit for bit in BITS[start : start + count]]
    assert not client.write_coils(start, changed, **to_unit).isError()
    assert values(register, Table.COILS, 0, 2000) == BITS[:start] + changed + BITS[start + count :]


@pytest.mark.parametrize(("start", "count"), [(0, 1), (107, 2), (2000 - 123, 123)])
def test_pymodbus_writes_registers_and_no_neighbour(
    client: Any, register: DataRegister, start: int, count: int
) -> None:
    changed = [word ^ 0xFFFF for word in WORDS[start : start + count]]
    assert not client.write_registers(start, changed, **to_unit).isError()
    assert holding(register, 0, 2000) == WORDS[:start] + changed + WORDS[start + count :]


def test_pymodbus_masks_a_register(client: Any, register: DataRegister) -> None:
    client.write_register(4, 0x0012, **to_unit)
    assert not client.mask_write_register(address=4, and_mask=0x00F2, or_mask=0x0025, **to_unit).isError()
    assert holding(register, 4) == [0x0017]  # the example of the application protocol, section 6.16


@pytest.mark.parametrize(("read_count", "write_count"), [(1, 1), (125, 121)])
def test_pymodbus_reads_what_the_same_request_has_written(
    client: Any, register: DataRegister, read_count: int, write_count: int
) -> None:
    written = [number ^ 0xA5A5 for number in range(write_count)]
    found = client.readwrite_registers(
        read_address=100, read_count=read_count, write_address=100, values=written, **to_unit
    )
    assert found.registers == (written + WORDS[100 + write_count :])[:read_count]
    assert holding(register, 100, write_count) == written


def test_pymodbus_is_told_the_exception(client: Any, register: DataRegister) -> None:
    requests: list[Callable[[], Any]] = [
        lambda: client.read_coils(LAST, count=2, **to_unit),
        lambda: client.read_input_registers(2000, count=1, **to_unit),
        lambda: client.write_coil(2000, True, **to_unit),
        lambda: client.write_registers(LAST, [1, 2], **to_unit),
        lambda: client.mask_write_register(address=2000, and_mask=0, or_mask=0, **to_unit),
        lambda: client.readwrite_registers(read_address=0, read_count=2, write_address=LAST, values=[1, 2], **to_unit),
    ]
    assert [ask().exception_code for ask in requests] == [2] * len(requests)
    assert values(register, Table.COILS, 0, 2000) == BITS
    assert holding(register, 0, 2000) == WORDS


# ------------------------------------------------------------------------------------------------ mbpoll


Ask = Callable[..., str]


@contextmanager
def mbpoll_tcp(register: DataRegister) -> Iterator[Ask]:
    with tcp_slave(register) as port:
        yield asking("127.0.0.1", "-m", "tcp", "-p", str(port))


@contextmanager
def mbpoll_rtu(register: DataRegister) -> Iterator[Ask]:
    with serial_slave(register) as path:
        yield asking(path, "-m", "rtu", "-b", str(BAUD), "-P", "none")


def asking(place: str, *mode: str) -> Ask:
    """Return what runs mbpoll once on *place*: options first, then the values to write, if any."""

    def ask(options: str, *written: object) -> str:
        return peers.mbpoll(*mode, "-a", str(UNIT), "-0", "-1", *options.split(), place, "--", *map(str, written))

    return ask


@pytest.fixture(params=[mbpoll_tcp, mbpoll_rtu], ids=["tcp", "rtu"])
def ask(request: pytest.FixtureRequest, register: DataRegister) -> Iterator[Ask]:
    """Mbpoll, over each transport in turn."""
    with request.param(register) as made:
        yield made


def printed(output: str) -> dict[int, float]:
    """Return what mbpoll printed, by address."""
    return {int(at): float(value) for at, value in re.findall(r"^\[(\d+)\]:\s+(-?[\d.e+-]+)", output, re.M)}


def points(start: int, found: list[int] | list[bool]) -> dict[int, float]:
    return dict(zip(itertools.count(start), found, strict=False))


@needs_mbpoll
def test_mbpoll_reads_all_four_tables(ask: Ask) -> None:
    assert printed(ask("-t 0 -r 3 -c 125")) == points(3, BITS[3:128])
    assert printed(ask("-t 1 -r 3 -c 125")) == points(3, BITS[::-1][3:128])
    assert printed(ask("-t 4 -r 1875 -c 125")) == points(1875, WORDS[1875:])
    assert printed(ask("-t 3 -r 1875 -c 125")) == points(1875, WORDS[::-1][1875:])


@needs_mbpoll
def test_mbpoll_writes_coils_and_holding_registers(ask: Ask, register: DataRegister) -> None:
    changed = [int(not bit) for bit in BITS[5:14]]
    ask("-t 0 -r 5", *changed)
    assert values(register, Table.COILS, 4, 11) == [BITS[4], *changed, BITS[14]]
    ask("-t 0 -r 1999", int(not BITS[LAST]))
    assert values(register, Table.COILS, LAST) == [not BITS[LAST]]
    ask("-t 4 -r 107", 555, 0, 65535)
    assert holding(register, 106, 5) == [WORDS[106], 555, 0, 65535, WORDS[110]]
    ask("-t 4 -r 1999", 4711)
    assert holding(register, LAST) == [4711]


@needs_mbpoll
def test_mbpoll_writes_and_reads_32_bit_integers(ask: Ask, register: DataRegister) -> None:
    ask("-t 4:int -B -r 100", 305419896, -2)
    assert holding(register, 100, 4) == [0x1234, 0x5678, 0xFFFF, 0xFFFE]
    assert printed(ask("-t 4:int -B -r 100 -c 2")) == {100: 305419896, 102: -2}
    assert printed(ask("-t 4:int -r 100 -c 1")) == {100: 0x56781234}  # words the other way round
    register.write(Span(Table.INPUT_REGISTERS, 100, 2), bytes.fromhex("12345678"), MENU)
    assert printed(ask("-t 3:int -B -r 100 -c 1")) == {100: 305419896}


@needs_mbpoll
def test_mbpoll_writes_and_reads_32_bit_floats(ask: Ask, register: DataRegister) -> None:
    ask("-t 4:float -B -r 100", 3.5, -0.25)
    assert holding(register, 100, 4) == list(struct.unpack(">4H", struct.pack(">ff", 3.5, -0.25)))
    assert printed(ask("-t 4:float -B -r 100 -c 2")) == {100: 3.5, 102: -0.25}
    register.write(Span(Table.INPUT_REGISTERS, 100, 2), struct.pack(">f", 230.5), MENU)
    assert printed(ask("-t 3:float -B -r 100 -c 1")) == {100: 230.5}


@needs_mbpoll
def test_mbpoll_shows_the_exception(ask: Ask, register: DataRegister) -> None:
    for options in ("-t 0 -r 1999 -c 2", "-t 1 -r 2000", "-t 3 -r 2000", "-t 4 -r 1999 -c 2"):
        assert "Illegal data address" in ask(options)
    assert "Illegal data address" in ask("-t 4 -r 1999", 1, 2)
    assert holding(register, LAST) == WORDS[LAST:]
