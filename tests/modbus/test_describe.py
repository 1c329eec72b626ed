"""Requests and replies in words: what a field engineer reads, whatever the bytes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.modbus.describe import WIDTH, describe_reply, describe_request, exception_name
from gateway.modbus.pdu import REPLY_SHAPES, REQUEST_SHAPES, ExceptionCode, Function
from gateway.plain_text import cut
from tests.modbus import wire

REQUESTS = [
    ("01 00 13 00 13", "read 19 coils from 19"),
    ("02 00 C4 00 01", "read 1 discrete input at 196"),
    ("03 00 6B 00 03", "read 3 holding registers from 107"),
    ("04 00 08 00 01", "read 1 input register at 8"),
    ("05 00 AC FF 00", "write coil at 172: on"),
    ("05 00 AC 00 00", "write coil at 172: off"),
    ("05 00 AC 12 34", "write coil at 172: 0x1234, neither on nor off"),
    ("06 00 01 00 03", "write register at 1: 3"),
    ("07", "read exception status"),
    ("08 00 00 A5 37", "diagnostics 0: 0xA537"),
    ("0B", "read event counter"),
    ("0C", "read event log"),
    ("0F 00 13 00 0A 02 CD 01", "write 10 coils from 19: 1011001110"),
    ("10 00 01 00 02 04 00 0A 01 02", "write 2 registers from 1: 10 258"),
    ("11", "report server ID"),
    ("14 07 06 00 04 00 01 00 02", "read file records, 7 bytes"),
    ("15 09 06 00 04 00 07 00 01 06 AF", "write file records, 9 bytes"),
    ("16 00 04 00 F2 00 25", "mask register at 4: and 0x00F2, or 0x0025"),
    (
        "17 00 03 00 06 00 0E 00 03 06 00 FF 00 FF 00 FF",
        "read 6 registers from 3, write 3 from 14: 255 255 255",
    ),
    ("18 04 DE", "read FIFO queue at 1246"),
    ("2B 0E 01 00", "read device identification, code 1 from object 0"),
    ("2B 0D 01 00", "function 43, type 13"),
    ("63 01 02 03 04", "function 99, 4 bytes"),
    ("63 01", "function 99, 1 byte"),
    ("03 00 6B 00", "function 3, wrong length: 3 bytes"),
    ("10 00 01 00 02 04 00 0A 01", "function 16, wrong length: 8 bytes"),
    ("", "nothing"),
]
REPLIES = [
    ("01 03 CD 6B 05", "24 bits: 101100111101011010100000"),
    ("02 01 01", "8 bits: 10000000"),
    ("03 06 02 2B 00 00 00 64", "3 registers: 555 0 100"),
    ("04 02 00 0A", "1 register: 10"),
    ("03 03 00 01 02", "3 bytes, no whole registers"),
    ("05 00 AC FF 00", "wrote coil at 172: on"),
    ("06 00 6B 02 2B", "wrote register at 107: 555"),
    ("07 6D", "exception status 10110110"),
    ("08 00 00 A5 37", "diagnostics 0: 0xA537"),
    ("0B FF FF 01 08", "264 events, status 0xFFFF"),
    ("0C 08 00 00 01 08 01 21 20 00", "event log: 264 events, 289 messages, log 20 00"),
    ("0C 06 00 00 00 01 00 01", "event log: 1 event, 1 message, log empty"),
    ("0C 02 00 00", "event log without counters"),
    ("0F 00 13 00 0A", "wrote 10 coils from 19"),
    ("10 00 6B 00 01", "wrote 1 register at 107"),
    ("11 05 01 FF 41 7F 1B", "server ID: ..A.."),
    ("14 0C 05 06 0D FE 00 20 05 06 33 CD 00 40", "file records, 12 bytes"),
    ("15 09 06 00 04 00 07 00 01 06 AF", "wrote file records, 9 bytes"),
    ("16 00 04 00 F2 00 25", "masked register at 4: and 0x00F2, or 0x0025"),
    ("17 04 00 FE 0A CD", "2 registers: 254 2765"),
    ("18 00 06 00 02 01 B8 12 84", "2 in the queue: 440 4740"),
    ("18 00 01 00", "queue without a count"),
    ("2B 0E 01 01 00 00 02 00 03 41 42 43 01 01 44", "identification: ABC, D"),
    ("2B 0D 01 01 00 00 00", "function 43, type 13"),
    ("83 02", "exception 2 illegal data address"),
    ("8B 0B", "exception 11 gateway target device failed to respond"),
    ("83 63", "exception 99 not in the standard"),
    ("83 02 00", "function 131, 2 bytes"),
    ("63 01 02 03 04", "function 99, 4 bytes"),
    ("03 06 02 2B", "function 3, wrong length: 3 bytes"),
    ("", "nothing"),
]


@pytest.mark.parametrize(("pdu", "words"), REQUESTS)
def test_a_request_says_what_it_asks_for(pdu: str, words: str) -> None:
    assert describe_request(wire(pdu)) == words


@pytest.mark.parametrize(("pdu", "words"), REPLIES)
def test_a_reply_says_what_it_brings(pdu: str, words: str) -> None:
    assert describe_reply(wire(pdu)) == words


def test_every_function_whose_length_is_known_has_its_words() -> None:
    assert {wire(pdu)[0] for pdu, _ in REQUESTS if pdu} >= REQUEST_SHAPES.keys() >= set(Function)
    assert {wire(pdu)[0] for pdu, _ in REPLIES if pdu} >= {code for code in REPLY_SHAPES if code < 128}


def test_what_is_long_is_cut_where_a_line_of_words_ends() -> None:
    values = describe_reply(b"\x03\xfa" + bytes(range(250)))
    assert len(values) == WIDTH
    assert values.startswith("125 registers: 1 515 1029 ")
    assert values.endswith("..")
    assert len(describe_request(b"\x10\x00\x00\x00\x7b\xf6" + b"\xff" * 246)) == WIDTH


@pytest.mark.parametrize(
    ("width", "text"), [(7, "seventy"), (6, "seve.."), (3, "s.."), (2, ".."), (1, "."), (0, ""), (-1, "")]
)
def test_a_text_is_cut_to_its_width_however_narrow(width: int, text: str) -> None:
    assert cut("seventy", width) == text


def test_every_exception_of_the_standard_has_its_name() -> None:
    names = {code: exception_name(code) for code in ExceptionCode}
    assert len(set(names.values())) == len(ExceptionCode)
    assert names[ExceptionCode.GATEWAY_TARGET_FAILED] == "gateway target device failed to respond"
    for code in ExceptionCode:
        assert names[code].startswith(code.name.lower().replace("_", " ").removesuffix(" failed"))
    assert exception_name(7) == "negative acknowledge"
    assert {exception_name(code) for code in (0, 9, 12, 255, 256, -1)} == {"not in the standard"}


@st.composite
def almost_whole(draw: st.DrawFn) -> bytes:
    """A known function with any body, so that lengths and counts are often right by chance."""
    return bytes([draw(st.sampled_from(sorted(REQUEST_SHAPES)))]) + draw(st.binary(max_size=12))


@given(pdu=st.one_of(st.binary(max_size=300), almost_whole()))
def test_any_bytes_are_described_in_a_line_of_plain_ascii(pdu: bytes) -> None:
    for words in (describe_request(pdu), describe_reply(pdu)):
        assert 0 < len(words) <= WIDTH
        assert words.isascii()
        assert words.isprintable()
