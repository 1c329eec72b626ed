"""tshark decodes every request and every reply of a slave as they were meant, and finds nothing wrong with any.

The session is written out in literal bytes, from the examples and limits of the application protocol V1.1b3, with the
fields that tshark has to find in each frame. What passed on the wire is compared with it byte by byte first. Of every
frame tshark is asked for the function, the exception and the unit, the CRC or the transaction, and of a reply for the
request that it answers.

tshark 4.0 knows less of RTU on a bare line than of RTU over TCP: without ports it cannot tell a request from a reply of
most functions and then shows the function alone; and it takes no frame under 5 bytes for RTU. It overlooks a byte count
that is one off, so the data of each reply is compared as well.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from gateway.events import EventQueue
from gateway.modbus.identification import Identity
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister
from gateway.serving import Station
from tests.fakes import JumpingClock
from tests.lines import MENU, PATIENCE_S, UNIT, a_register, rtu_frame, tcp_frame
from tests.system.tapped import Kind, Packet, Served, served
from tests.system.tshark import SHORTEST_RTU, complaints, read

Fields = dict[str, str]
SAME: Fields = {"same": ""}  # the reply has the fields of its request


@dataclass(frozen=True)
class Exchange:
    """A request and its reply without unit and checksum, in hexadecimal, and what tshark has to tell of each."""

    request: str
    reply: str
    asked: Fields = field(default_factory=dict)
    told: Fields = field(default_factory=dict)
    unit: int = UNIT


COILS = "1,0,1,1,0,0,1,1,1,1,0,1,0,1,1,0,1,0,1"  # CD 6B 05, the lowest bit first
INPUTS = "0,0,1,1,0,1,0,1,1,1,0,1,1,0,1,1,1,0,1,0,1,1"  # AC DB 35
WRITTEN = "17 00 03 00 06 00 0E 00 03 06 00 FF 00 FF 00 FF"  # read 6 from 3, write 3 from 14

DATA = [
    Exchange(
        "01 00 13 00 13",
        "01 03 CD 6B 05",
        {"reference_num": "19", "bit_cnt": "19"},
        {"byte_cnt": "3", "bitval": COILS},
    ),
    Exchange(
        "02 00 C4 00 16",
        "02 03 AC DB 35",
        {"reference_num": "196", "bit_cnt": "22"},
        {"byte_cnt": "3", "bitval": INPUTS},
    ),
    Exchange(
        "03 00 6B 00 03",
        "03 06 02 2B 00 00 00 64",
        {"reference_num": "107", "word_cnt": "3"},
        {"byte_cnt": "6", "regval_uint16": "555,0,100"},
    ),
    Exchange(
        "04 00 08 00 01",
        "04 02 00 0A",
        {"reference_num": "8", "word_cnt": "1"},
        {"byte_cnt": "2", "regval_uint16": "10"},
    ),
    Exchange("05 00 AC FF 00", "05 00 AC FF 00", {"reference_num": "172", "data": "ff00"}, SAME),
    Exchange("05 00 AC 00 00", "05 00 AC 00 00", {"reference_num": "172", "data": "0000"}, SAME),
    Exchange("06 00 01 00 03", "06 00 01 00 03", {"reference_num": "1", "data": "0003"}, SAME),
    Exchange(
        "0F 00 13 00 0A 02 CD 01",
        "0F 00 13 00 0A",
        {"reference_num": "19", "bit_cnt": "10", "byte_cnt": "2", "data": "cd01"},
        {"reference_num": "19", "bit_cnt": "10"},
    ),
    Exchange(
        "10 00 01 00 02 04 00 0A 01 02",
        "10 00 01 00 02",
        {"reference_num": "1", "word_cnt": "2", "byte_cnt": "4", "regval_uint16": "10,258"},
        {"reference_num": "1", "word_cnt": "2"},
    ),
    Exchange(
        "16 00 04 00 F2 00 25",
        "16 00 04 00 F2 00 25",
        {"reference_num": "4", "and_mask": "0x00f2", "or_mask": "0x0025"},
        SAME,
    ),
    Exchange(
        WRITTEN,
        "17 0C 00 00 00 17 00 00 00 00 00 00 00 0A",
        {
            "read_reference_num": "3",
            "read_word_cnt": "6",
            "write_reference_num": "14",
            "write_word_cnt": "3",
            "byte_cnt": "6",
            "data": "00ff00ff00ff",
        },
        {"byte_cnt": "12", "data": "00000017000000000000000a"},
    ),
]
LIMITS = [  # the longest requests and replies there are
    Exchange("0F 00 00 07 B0 F6" + 246 * " A5", "0F 00 00 07 B0", {"bit_cnt": "1968", "byte_cnt": "246"}),
    Exchange(
        "01 00 00 07 B0",
        "01 F6" + 246 * " A5",
        {"bit_cnt": "1968"},
        {"bitval": ",".join(246 * ["1,0,1,0,0,1,0,1"])},
    ),
    Exchange("02 00 00 07 D0", "02 FA" + 24 * " 00" + " C0 BA 5D 03" + 222 * " 00", {"bit_cnt": "2000"}),
    Exchange(
        "10 04 00 00 7B F6" + 123 * " 12 34",
        "10 04 00 00 7B",
        {"word_cnt": "123", "regval_uint16": ",".join(123 * ["4660"])},
    ),
    Exchange(
        "17 04 00 00 7D 04 00 00 79 F2" + 121 * " AB CD",
        "17 FA" + 121 * " AB CD" + 2 * " 12 34" + 2 * " 00 00",
        {"read_word_cnt": "125", "write_word_cnt": "121", "data": 121 * "abcd"},
        {"byte_cnt": "250", "data": 121 * "abcd" + 2 * "1234" + 2 * "0000"},
    ),
    Exchange(
        "03 04 00 00 7D",
        "03 FA" + 121 * " AB CD" + 2 * " 12 34" + 2 * " 00 00",
        {"word_cnt": "125"},
        {"regval_uint16": ",".join([*121 * ["43981"], "4660", "4660", "0", "0"])},
    ),
]
EXCEPTIONS = [
    Exchange("03 00 00 00 00", "83 03"),
    Exchange("03 00 00 00 7E", "83 03"),
    Exchange("04 FF FF 00 02", "84 02"),
    Exchange("01 07 CF 00 02", "81 02"),
    Exchange("02 00 00 07 D1", "82 03"),
    Exchange("05 00 00 12 34", "85 03"),
    Exchange("06 07 D0 00 00", "86 02"),
    Exchange("0F 00 00 00 00 00", "8F 03"),
    Exchange("10 00 00 00 02 02 00 00", "90 03"),
    Exchange("14 07 06 00 04 00 01 00 02", "94 01"),
    Exchange("16 07 D0 00 00 00 00", "96 02"),
    Exchange("17 00 00 00 01 07 D0 00 01 02 00 00", "97 02"),
    Exchange("18 02 59", "98 02"),
    Exchange("2B 0D 00 00", "AB 01"),
    Exchange("2B 0E 04 05", "AB 02"),
    Exchange("2B 0E 05 00", "AB 03"),
    Exchange("41 00", "C1 01"),
]
IDENTIFICATION = [
    Exchange(
        "2B 0E 01 00",
        "2B 0E 01 82 00 00 03 00 05 4D 61 6B 65 72 01 06 47 61 74 65 20 34 02 03 31 2E 32",
        {"mei": "14", "read_device_id": "1", "object_id": "0"},
        {"conformity_level": "0x82", "num_objects": "3", "object_id": "0,1,2", "object_str_value": "Maker,Gate 4,1.2"},
    ),
    Exchange(
        "2B 0E 02 02",
        "2B 0E 02 82 00 00 02 02 03 31 2E 32 04 06 47 61 74 65 20 34",
        {"mei": "14", "read_device_id": "2", "object_id": "2"},
        {"num_objects": "2", "object_id": "2,4", "object_str_value": "1.2,Gate 4"},
    ),
    Exchange(
        "2B 0E 04 01",
        "2B 0E 04 82 00 00 01 01 06 47 61 74 65 20 34",
        {"read_device_id": "4", "object_id": "1"},
        {"num_objects": "1", "object_str_value": "Gate 4"},
    ),
]
CHANGES = "00 01 00 03 01 F4 00 01 01 8B CF E5 68 00 00 02 00 03 01 F5 FF FF 01 8B CF E5 68 00"
EVENTS = [  # two changes wait, none was lost; then nothing waits
    Exchange(
        "18 02 58",
        "18 00 22 00 10 00 02 00 00 " + CHANGES,
        {"reference_num": "600"},
        {"word_cnt": "16", "data": "00020000" + CHANGES.replace(" ", "").lower()},
    ),
    Exchange("18 02 58", "18 00 06 00 02 00 00 00 00", {"reference_num": "600"}, {"word_cnt": "2", "data": "00000000"}),
]
TCP_ALONE = [
    Exchange("07", "87 01"),
    Exchange("08 00 00 12 34", "88 01"),
    Exchange("0B", "8B 01"),
    Exchange("0C", "8C 01"),
    Exchange("11", "91 01"),
    Exchange("03 00 6B 00 01", "03 02 02 2B", told={"regval_uint16": "555"}, unit=0),
    Exchange("03 00 6B 00 01", "03 02 02 2B", told={"regval_uint16": "555"}, unit=255),
    Exchange("03 00 6B 00 01", "83 0B", unit=99),
]
SERIAL_ALONE = [  # everything begins anew with the restart, so that counters and log are known
    Exchange("08 00 01 FF 00", "08 00 01 FF 00", {"diagnostic_code": "1"}, {"diagnostic_code": "1"}),
    Exchange(
        "08 00 00 A5 37",
        "08 00 00 A5 37",
        {"diagnostic_code": "0"},
        {"diagnostic.return_query_data.echo": "a537"},
    ),
    Exchange("08 00 0B 00 00", "08 00 0B 00 02", told={"diagnostic.bus_message_count": "2"}),
    Exchange("08 00 0E 00 00", "08 00 0E 00 03", told={"diagnostic.slave_message_count": "3"}),
    Exchange("08 00 02 00 00", "08 00 02 00 00", {"diagnostic_code": "2"}, {"diagnostic_code": "2"}),
    Exchange("08 00 03 00 00", "88 01"),
    Exchange("08 00 0D 00 00", "08 00 0D 00 01", told={"diagnostic.bus_exception_error_count": "1"}),
    Exchange("07", "07 05", told={"data": "05"}),
    Exchange("11", "11 12 01 FF 4D 61 6B 65 72 20 47 61 74 65 20 34 20 31 2E 32"),
    Exchange("0B", "0B 00 00 00 07", told={"ev_status": "0x0000", "ev_count": "7"}),
    Exchange(  # newest first: this one received; sent and received nine times, once with exception 1; the restart
        "0C",
        "0C 1A 00 00 00 07 00 0A 80 40 80 40 80 40 80 40 80 41 80 40 80 40 80 40 80 40 80 00",
        told={
            "ev_count": "7",
            "ev_msg_count": "10",
            "event": ",".join([*4 * ["128", "64"], "128", "65", *4 * ["128", "64"], "128", "0"]),
        },
    ),
]
COMMON = [*DATA, *LIMITS, *EXCEPTIONS, *IDENTIFICATION, *EVENTS]
SESSIONS: dict[Kind, list[Exchange]] = {
    "tcp": COMMON + TCP_ALONE,
    "rtu over tcp": COMMON + SERIAL_ALONE,
    "rtu": COMMON + SERIAL_ALONE,
}
TOLD_WITHOUT_PORTS = {1, 2, 3, 4, 15, 16}  # functions whose frames tshark tells apart by their length

every_kind = pytest.mark.parametrize("kind", SESSIONS)


# ------------------------------------------------------------------------------------------------ the session


def a_station(register: DataRegister) -> Station:
    """Return what is served beside the register: holding registers 500 and 501 have changed, the queue is at 600."""
    changes = EventQueue(register, JumpingClock(), [Span(Table.HOLDING_REGISTERS, 500, 2)], 16, fifo_address=600)
    for words in ("00 00 00 00", "00 01 FF FF"):
        register.write(Span(Table.HOLDING_REGISTERS, 500, 2), bytes.fromhex(words), MENU)
    return Station(Identity("Maker", "Gate 4", "1.2"), lambda: 0x05, changes.read_fifo)


@contextmanager
def descriptor(slave: Served) -> Iterator[int]:
    """Give the client's end, which takes and gives bytes."""
    if slave.kind == "rtu":
        end = os.open(slave.place, os.O_RDWR | os.O_NOCTTY)
        try:
            yield end
        finally:
            os.close(end)
    else:
        with contextlib.closing(socket.create_connection(("127.0.0.1", slave.place))) as connection:
            yield connection.fileno()


def receive(end: int, count: int) -> bytes:
    """Return the next *count* bytes, fewer after a silence."""
    data = b""
    while (
        len(data) < count and select.select([end], [], [], PATIENCE_S)[0] and (more := os.read(end, count - len(data)))
    ):
        data += more
    return data


def frames_of(kind: Kind, exchange: Exchange, number: int) -> list[bytes]:
    """Return the request and the reply as they are on the wire."""
    if kind == "tcp":
        return [tcp_frame(number, pdu, exchange.unit) for pdu in (exchange.request, exchange.reply)]
    return [rtu_frame(pdu, exchange.unit) for pdu in (exchange.request, exchange.reply)]


def converse(kind: Kind, exchanges: Sequence[Exchange]) -> list[Packet]:
    """Ask a slave of ours; return what passed on its wire."""
    register = a_register()
    with served(kind, register, a_station(register)) as slave, descriptor(slave) as end:
        for number, exchange in enumerate(exchanges):
            request, reply = frames_of(kind, exchange, number)
            os.write(end, request)
            assert receive(end, len(reply)).hex(" ") == reply.hex(" "), exchange.request
        return slave.tap.packets


def expected(kind: Kind, exchange: Exchange, number: int) -> list[Fields]:
    """Return the fields that tshark has to find in the request and in the reply."""
    both = []
    for place, (pdu, fields) in enumerate([(exchange.request, exchange.asked), (exchange.reply, exchange.told)]):
        code = bytes.fromhex(pdu)[0]
        values = exchange.asked if fields is SAME else fields
        wanted = {"func_code": str(code & 0x7F)} | ({} if is_nameless(kind, code) else values)
        if code > 0x7F:
            wanted["exception_code"] = str(bytes.fromhex(pdu)[1])
        elif place == 1 and not is_nameless(kind, code) and len(bytes.fromhex(exchange.request)) > 1:
            wanted["request_frame"] = str(2 * number + 1)
        named = {f"modbus.{name}": value for name, value in wanted.items()}
        if kind == "tcp":
            both.append(named | {"mbtcp.trans_id": str(number), "mbtcp.unit_id": str(exchange.unit)})
        else:
            both.append(named | {"mbrtu.crc16.status": "1", "mbrtu.unit_id": str(exchange.unit)})
    return both


def is_nameless(kind: Kind, code: int) -> bool:
    """True where tshark cannot tell a request from a reply, and shows the function alone."""
    return kind == "rtu" and code <= 0x7F and code not in TOLD_WITHOUT_PORTS


@every_kind
def test_tshark_decodes_every_frame_as_it_was_meant(
    kind: Kind, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    session = SESSIONS[kind]
    packets = converse(kind, session)
    numbered = list(enumerate(session))
    assert [packet.data for packet in packets] == [
        frame for number, exchange in numbered for frame in frames_of(kind, exchange, number)
    ]
    assert complaints(packets, kind, tmp_path) == []
    wanted = [fields for number, exchange in numbered for fields in expected(kind, exchange, number)]
    decoded = right = 0
    for packet, told, fields in zip(packets, read(packets, kind, tmp_path), wanted, strict=True):
        if kind == "tcp" or len(packet.data) >= SHORTEST_RTU:
            assert {name: told.get(name) for name in fields} == fields, packet.data.hex(" ")
            decoded, right = decoded + 1, right + len(fields)
    short = [packet for packet in packets if len(packet.data) < SHORTEST_RTU]
    assert decoded == len(packets) - (0 if kind == "tcp" else 4)
    assert {packet.data[1] for packet in short} == (set() if kind == "tcp" else {7, 11, 12, 17})
    record_property(f"{kind}: frames, fields that tshark found right", f"{decoded}, {right}")


# ------------------------------------------------------------------------------------------------ the proof


def one(frame: bytes, is_request: bool = True) -> list[Packet]:
    """A good exchange, *frame*, and another good one: a complaint names *frame* alone."""
    return [Packet(True, GOOD[0]), Packet(False, GOOD[1]), Packet(is_request, frame), Packet(False, GOOD[1])]


GOOD = [rtu_frame(DATA[2].request), rtu_frame(DATA[2].reply)]


@pytest.mark.parametrize("kind", ["rtu", "rtu over tcp"])
def test_one_wrong_bit_in_a_crc_is_complained_of(kind: Kind, tmp_path: Path) -> None:
    for place in (-2, -1):
        frame = bytearray(GOOD[0])
        frame[place] ^= 0x01
        told = complaints(one(bytes(frame)), kind, tmp_path)
        assert [line.partition(":")[0] for line in told] == 2 * [frame.hex(" ")]
        assert "Incorrect CRC" in told[0]


@pytest.mark.parametrize("exchange", [*DATA, IDENTIFICATION[0], EVENTS[0]], ids=lambda it: it.request)
def test_a_reply_cut_short_is_complained_of(exchange: Exchange, tmp_path: Path) -> None:
    request, reply = frames_of("tcp", exchange, 1)
    short = reply[:5] + b"\x02" + reply[6:8]  # unit and function; the header agrees
    told = complaints([Packet(True, request), Packet(False, short)], "tcp", tmp_path)
    assert told
    assert all(line.startswith(short.hex(" ")) for line in told)


def test_a_frame_that_is_no_modbus_tcp_is_complained_of(tmp_path: Path) -> None:
    assert complaints([Packet(True, b"GET / HTTP/1.0\r\n\r\n")], "tcp", tmp_path)
