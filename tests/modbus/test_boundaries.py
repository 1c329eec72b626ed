"""Every row of ``tests/data/boundaries.csv``: literal requests at every edge, and the literal replies they must get.

The rows are written from the application protocol V1.1b3 and from spec section 3 (order of checks); what the columns
say and what the register holds stands in ``tests/data/README.md``. No limit and no encoder of the gateway is used
here: frames and checksums are made by ``tests/lines.py``, bit by bit, and the register's pattern below.

Each row goes through every framing, whole and byte by byte, and then over a real socket and real ptys. After it the
register must hold the pattern and what the row says it changes, not a bit more.
"""

from __future__ import annotations

import contextlib
import csv
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from gateway.config import SlaveConfig
from gateway.link import Link, SerialSettings, Waker, open_serial
from gateway.modbus.diagnostics import LineDiagnostics
from gateway.modbus.framing import Frame as GatewayFrame
from gateway.modbus.framing import Framing, reply_framer, request_framer
from gateway.modbus.identification import Identity
from gateway.modbus.pdu import Span, Table
from gateway.modbus.server import Server, answer
from gateway.register import DataRegister, Written
from gateway.slave import SerialSlave
from tests import peers
from tests.lines import (
    CLOCK,
    MENU,
    PATIENCE_S,
    UNIT,
    Pty,
    ascii_frame,
    pty_pair,
    rtu_frame,
    running,
    serving_tcp,
    tcp_config,
    tcp_frame,
)
from tests.modbus import drain, one_by_one

ROWS_FILE = Path(__file__).parents[1] / "data" / "boundaries.csv"
TRANSACTION = 0xA55A
EVERY_FUNCTION = set(range(256))
SERIAL_LINE_ONLY = {7, 8, 11, 12, 17}

FRAMINGS: tuple[Framing, ...] = ("rtu", "ascii", "tcp")
CUTS: dict[str, Callable[[bytes], list[bytes]]] = {"whole": lambda frame: [frame], "byte by byte": one_by_one}

# ------------------------------------------------------------------------------------------------ the rows


def expanded(text: str) -> str:
    """Return the digits that *text* stands for: ``0F0F``, ``FF*246`` or ``A000..A07A``, in any order."""
    return "".join(_expanded_word(word) for word in text.split())


def _expanded_word(word: str) -> str:
    if counting := re.fullmatch(r"([0-9A-F]{4})\.\.([0-9A-F]{4})", word):
        first, last = (int(end, 16) for end in counting.groups())
        step = 1 if first < last else -1
        return "".join(f"{value:04X}" for value in range(first, last + step, step))
    digits, _, times = word.partition("*")
    assert re.fullmatch(r"[0-9A-F]+", digits), word
    return digits * int(times or 1)


@dataclass(frozen=True)
class Row:
    """One line of the file; requests and replies as hexadecimal PDUs, "" where nothing is answered."""

    line: int
    function: int
    request: str
    reply: str
    tcp_reply: str
    section: str
    note: str
    points: int  # in each table
    changes: str

    def reply_in(self, framing: str) -> str:
        return self.tcp_reply if framing == "tcp" else self.reply

    @property
    def is_refused(self) -> bool:
        """True if the serial line answers with an exception."""
        return len(self.reply) == 4 and int(self.reply[:2], 16) >= 0x80

    def __str__(self) -> str:
        return f"line {self.line} ({self.section}, {self.note}): {short(self.request)}"


def short(digits: str) -> str:
    return digits if len(digits) <= 64 else f"{digits[:48]}... ({len(digits) // 2} bytes)"


def _row(line: int, cells: dict[str, str]) -> Row:
    reply = expanded(cells["expected_reply"].replace("-", ""))
    return Row(
        line,
        int(cells["function"]),
        expanded(cells["request"]),
        reply,
        expanded(cells["tcp_reply"]) or reply,
        cells["section"],
        cells["note"],
        int(cells["tables"] or 2000),
        cells["changes"],
    )


def all_rows() -> list[Row]:
    with ROWS_FILE.open(newline="", encoding="ascii") as file:
        return [_row(line, cells) for line, cells in enumerate(csv.DictReader(file), 2)]


ROWS = all_rows()


# ------------------------------------------------------------------------------------------------ the register


State = dict[str, bytes]  # by table: packed bits, or big-endian words, of all its points

TABLES: dict[str, Table] = {
    "coils": Table.COILS,
    "inputs": Table.DISCRETE_INPUTS,
    "holding": Table.HOLDING_REGISTERS,
    "input registers": Table.INPUT_REGISTERS,
}


def packed(bits: Sequence[bool]) -> bytes:
    """Return *bits* eight a byte, the first in the lowest bit (section 6.1)."""
    groups = [bits[start : start + 8] for start in range(0, len(bits), 8)]
    return bytes(sum(2**place for place, bit in enumerate(group) if bit) for group in groups)


def coil_pattern(points: int) -> list[bool]:
    """Return coils of which every seventh is on, the first included: 81 40 20 10 08 04 02, again and again."""
    return [address % 7 == 0 for address in range(points)]


@cache
def pattern(points: int) -> State:
    """Return what the tables hold before each row: a register its own address, an input register 65535 less that."""
    coils = coil_pattern(points)
    return {
        "coils": packed(coils),
        "inputs": packed([not coil for coil in coils]),
        "holding": b"".join(address.to_bytes(2, "big") for address in range(points)),
        "input registers": b"".join((0xFFFF - address).to_bytes(2, "big") for address in range(points)),
    }


def state_after(row: Row) -> State:
    """Return what the tables have to hold after *row*."""
    state = dict(pattern(row.points))
    if row.changes:
        table, place, text = re.split(r" |: ", row.changes, maxsplit=2)
        address, digits = int(place, 16), expanded(text)
        if table == "coils":
            coils = coil_pattern(row.points)
            coils[address : address + len(digits)] = [digit == "1" for digit in digits]
            state["coils"] = packed(coils)
        else:
            words = bytearray(state[table])
            words[2 * address : 2 * address + len(digits) // 2] = bytes.fromhex(digits)
            state[table] = bytes(words)
    return state


class Bench:
    """A register with the pattern, restored after each row, and what else is served."""

    def __init__(self, points: int) -> None:
        self.register = DataRegister(CLOCK, dict.fromkeys(Table, points))
        self._spans = {name: Span(table, 0, points) for name, table in TABLES.items()}
        self._points = points
        self._writes = 0
        self.register.watch(self._count_write)
        self.restore(dict.fromkeys(TABLES, b""))

    def _count_write(self, written: Written) -> None:
        self._writes += 1

    def restore(self, state: State) -> None:
        """Write the pattern wherever *state* is another."""
        for name, data in pattern(self._points).items():
            if state[name] != data:
                self.register.write(self._spans[name], data, MENU)
        self._writes = 0

    def check_state(self, row: Row) -> list[str]:
        """Return, in words, what is not as *row* leaves it; restore all tables."""
        found = {name: self.register.read(span) for name, span in self._spans.items()}
        wanted = state_after(row)
        wrong = [f"the {name} are not as they should be" for name in TABLES if found[name] != wanted[name]]
        if self._writes != bool(row.changes):
            wrong.append(f"{self._writes} writes")
        self.restore(found)
        return [f"{row}\n    {what}" for what in wrong]


def read_fifo(address: int) -> list[int] | None:
    """Return the queues that README.md tells of."""
    return {
        0x0000: [],
        0x0001: [0xB000 + place for place in range(31)],
        0x0002: [0] * 32,
        0x04DE: [0x01B8, 0x1284],
        0xFFFF: [0xBEEF],
    }.get(address)


def serve_all(server: Server) -> None:
    """Give *server* what the rows ask for beside the register."""
    server.identity = Identity(vendor="ACME", product="PUMP", revision="2.1")
    server.exception_status = lambda: 0x6D
    server.read_fifo = read_fifo


@cache
def bench_with(points: int) -> Bench:
    return Bench(points)


# ------------------------------------------------------------------------------------------------ frames


def framed(framing: str, pdu: str) -> bytes:
    """Return the frame of *pdu* as it goes on the wire; b"" for no PDU."""
    if not pdu:
        return b""
    if framing == "tcp":
        return tcp_frame(TRANSACTION, pdu)
    return rtu_frame(pdu) if framing == "rtu" else ascii_frame(pdu)


def replies_to(row: Row, framing: Framing, cut: Callable[[bytes], list[bytes]]) -> bytes:
    """Return the bytes that go back when *row* is heard in the pieces that *cut* makes of it, on a line just opened."""
    server = Server(bench_with(row.points).register, MENU)
    serve_all(server)
    framer = request_framer(framing)
    frames = []
    for piece in cut(framed(framing, row.request)):
        framer.receive_data(piece)
        frames += drain(framer)
    framer.silence()
    frames += drain(framer)
    assert not framer.pending
    assert not framer.damaged
    if framing != "tcp":
        server.line = LineDiagnostics()
        for _ in frames:
            server.line.heard()
    assert [frame.unit for frame in frames] == [UNIT]
    replies = [(frame, answer(frame.pdu, server)) for frame in frames]
    return b"".join(framer.encode(GatewayFrame(UNIT, pdu, frame.transaction)) for frame, pdu in replies if pdu)


def difference(row: Row, framing: str, found: bytes) -> list[str]:
    """Return, in words, how *found* is not the reply that *row* wants."""
    wanted = framed(framing, row.reply_in(framing))
    if found == wanted:
        return []
    return [f"{row}\n    wanted {short(wanted.hex().upper())}\n    found  {short(found.hex().upper())}"]


# ------------------------------------------------------------------------------------------------ the file itself


def test_the_file_has_every_function_and_says_nothing_twice() -> None:
    assert {row.function for row in ROWS} == EVERY_FUNCTION
    assert len({(row.request, row.points) for row in ROWS}) == len(ROWS)
    assert len(ROWS) * len(FRAMINGS) * len(CUTS) > 5000


def test_every_row_fits_its_function_and_a_frame_and_says_why() -> None:
    wrong = []
    for row in ROWS:
        request, reply = bytes.fromhex(row.request), bytes.fromhex(row.reply)
        fits = request[0] == row.function and len(request) <= 253 and len(reply) <= 253
        fits &= not reply or reply[0] in (row.function, row.function | 0x80)
        fits &= not (row.is_refused and row.changes)
        fits &= bool(row.note and re.fullmatch(r"\d\.\d+(\.\d)?", row.section))
        wrong += [] if fits else [str(row)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("function", [1, 2, 3, 4, 5, 6, 15, 16, 22, 23, 24, 43])
def test_every_data_function_is_answered_and_refused_for_quantity_and_for_address(function: int) -> None:
    codes = {row.reply[2:4] if row.is_refused else "" for row in ROWS if row.function == function}
    assert codes >= {"", "02", "03"}


def test_serial_line_functions_are_unknown_on_tcp_and_no_others_differ() -> None:
    assert {row.function for row in ROWS if row.tcp_reply != row.reply} == {7, 8, 11, 12, 17}
    assert {row.tcp_reply for row in ROWS if row.function in (7, 8, 11, 12, 17)} == {
        "8701",
        "8801",
        "8B01",
        "8C01",
        "9101",
    }


# ------------------------------------------------------------------------------------------------ in every framing


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("framing", FRAMINGS)
def test_every_row_gets_its_reply_and_changes_what_it_says(framing: Framing, cut: str) -> None:
    wrong: list[str] = []
    for row in ROWS:
        wrong += difference(row, framing, replies_to(row, framing, CUTS[cut]))
        wrong += bench_with(row.points).check_state(row)
    assert not wrong, f"{len(wrong)} of {len(ROWS)} rows\n" + "\n".join(wrong)


def is_told_by_its_start(row: Row) -> bool:
    """True if function and byte count of the reply say how long it is: not for 43, nor for 8 with more than a word."""
    return row.is_refused or (row.function != 43 and (row.function != 8 or len(row.reply) == 10))


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("framing", FRAMINGS)
def test_every_reply_is_found_by_a_master_that_waits_for_it(framing: Framing, cut: str) -> None:
    rows = [row for row in ROWS if row.reply and 0 < row.function < 0x80]
    wrong: list[str] = []
    for row in rows if framing != "rtu" else filter(is_told_by_its_start, rows):
        framer = reply_framer(framing)
        framer.expect(UNIT, row.function)
        frames = []
        for piece in CUTS[cut](framed(framing, row.reply_in(framing))):
            framer.receive_data(piece)
            frames += drain(framer)
        if [(frame.unit, frame.pdu.hex().upper()) for frame in frames] != [(UNIT, row.reply_in(framing))]:
            wrong.append(f"{row}\n    found {frames}")
    assert not wrong, f"{len(wrong)} of {len(rows)} rows\n" + "\n".join(wrong)


# ------------------------------------------------------------------------------------------------ over real lines


def rows_with(points: int, functions: set[int]) -> list[Row]:
    """Return the rows that ask for *functions* and can share one register with *points* in each table."""
    return [row for row in ROWS if row.points == points and row.function in functions]


every_size = pytest.mark.parametrize("points", [2000, 65536])


@every_size
@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("framing", FRAMINGS)
def test_every_row_gets_its_reply_over_a_socket(framing: str, cut: str, points: int) -> None:
    bench = bench_with(points)
    with serving_tcp(tcp_config(framing=framing), bench.register) as served:
        serve_all(served.task.server)
        with served.client() as client:
            for row in rows_with(points, EVERY_FUNCTION if framing == "tcp" else EVERY_FUNCTION - SERIAL_LINE_ONLY):
                for piece in CUTS[cut](framed(framing, row.request)):
                    client.send(piece)
                found = client.receive(len(framed(framing, row.reply_in(framing))))
                assert difference(row, framing, found) + bench.check_state(row) == []


@contextmanager
def serving_pty(framing: str, register: DataRegister) -> Iterator[Pty]:
    """Give the wire of a serial slave that runs."""
    keys = {"name": "scada", "line": "/dev/ttyS2", "framing": framing, "unit": UNIT}
    config = SlaveConfig.model_validate(keys | {"baudrate": 115200, "parity": "none", "data_bits": 8})
    opened = threading.Event()
    with pty_pair() as pty, contextlib.closing(Waker()) as waker:

        def opening() -> Link:
            link = open_serial(SerialSettings(pty.device, 115200, "none"), waker, CLOCK)
            opened.set()
            return link

        slave = SerialSlave(config, register, CLOCK, waker, opening)
        serve_all(slave.server)
        with running(slave):
            assert opened.wait(PATIENCE_S)
            yield pty


def ask_over_pty(framing: str, points: int, rows: Sequence[Row]) -> None:
    bench = bench_with(points)
    with serving_pty(framing, bench.register) as pty:
        for row in rows:
            pty.send(framed(framing, row.request))
            found = pty.receive(len(framed(framing, row.reply)))
            assert difference(row, framing, found) + bench.check_state(row) == []
        assert pty.is_silent()


@every_size
@pytest.mark.parametrize("framing", ["rtu", "ascii"])
def test_every_row_gets_its_reply_over_a_serial_line(framing: str, points: int) -> None:
    ask_over_pty(framing, points, rows_with(points, EVERY_FUNCTION - SERIAL_LINE_ONLY))


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
def test_a_serial_line_just_opened_knows_the_functions_that_are_its_own(framing: str) -> None:
    for row in (row for row in rows_with(2000, SERIAL_LINE_ONLY) if row.reply):
        ask_over_pty(framing, 2000, [row])


# ------------------------------------------------------------------------------------------------ pymodbus


def words_of(digits: str) -> list[int]:
    return [int(digits[place : place + 4], 16) for place in range(0, len(digits), 4)]


def bits_of(digits: str, quantity: int) -> list[bool]:
    return [bool(byte >> place & 1) for byte in bytes.fromhex(digits) for place in range(8)][:quantity]


def asked_by_pymodbus(client: Any, row: Row) -> Any:
    """Return what pymodbus makes of the reply to the well-formed request of *row*, which it encodes by itself."""
    data, to_unit = row.request[2:], peers.unit_kwargs(UNIT)
    if row.function == 43:
        code, number = bytes.fromhex(data[2:])
        return client.read_device_information(read_code=code, object_id=number, **to_unit)
    address, second, *more = words_of(data[: len(data) // 4 * 4])
    match row.function:
        case 1:
            return client.read_coils(address, count=second, **to_unit)
        case 2:
            return client.read_discrete_inputs(address, count=second, **to_unit)
        case 3:
            return client.read_holding_registers(address, count=second, **to_unit)
        case 4:
            return client.read_input_registers(address, count=second, **to_unit)
        case 5:
            return client.write_coil(address, second == 0xFF00, **to_unit)
        case 6:
            return client.write_register(address, second, **to_unit)
        case 15:
            return client.write_coils(address, bits_of(data[10:], second), **to_unit)
        case 16:
            return client.write_registers(address, words_of(data[10:]), **to_unit)
        case 22:
            return client.mask_write_register(address=address, and_mask=second, or_mask=more[0], **to_unit)
    return client.readwrite_registers(
        read_address=address, read_count=second, write_address=more[0], values=words_of(data[18:]), **to_unit
    )


def is_what_pymodbus_found(row: Row, found: Any) -> bool:
    """True if *found*, as pymodbus decoded it, is what the file says."""
    if row.is_refused:
        return found.isError() and [found.exception_code] == [int(row.reply[2:], 16)]
    if row.function in (1, 2):
        quantity = int(row.request[6:10], 16)
        return bool(found.bits[:quantity] == bits_of(row.reply[4:], quantity))
    if row.function == 43:
        objects = [bytes([number, len(text)]) + text for number, text in found.information.items()]
        return b"".join(objects) == bytes.fromhex(row.reply[14:])
    return not found.isError() and (row.function not in (3, 4, 23) or found.registers == words_of(row.reply[4:]))


@every_size
def test_pymodbus_reads_the_same_out_of_the_replies(points: int) -> None:
    """It encodes no request that breaks a rule of length or quantity, so exception 2 is the only one it can earn."""
    rows = rows_with(points, {1, 2, 3, 4, 5, 6, 15, 16, 22, 23, 43})  # 24: pymodbus 3.8.6 loses registers of it
    wellformed = [row for row in rows if not row.is_refused or (row.reply[2:] == "02" and row.function != 5)]
    bench = bench_with(points)
    wrong: list[str] = []
    with serving_tcp(tcp_config(), bench.register) as served:
        serve_all(served.task.server)
        with peers.client_tcp(served.port) as client:
            for row in wellformed:
                wrong += [] if is_what_pymodbus_found(row, asked_by_pymodbus(client, row)) else [str(row)]
                wrong += bench.check_state(row)
    assert not wrong, "\n".join(wrong)
