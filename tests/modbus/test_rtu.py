"""RTU: checksum, encoding, and how long a frame is."""

from __future__ import annotations

import pytest

from gateway.modbus.framing import (
    Framer,
    RtuReplyFramer,
    RtuRequestFramer,
    crc16,
    encode_rtu,
    reply_framer,
    request_framer,
)
from gateway.modbus.pdu import REPLY_SHAPES, REQUEST_SHAPES, pdu_length
from tests.modbus import crc_bit_by_bit
from tests.modbus.rtu_frames import (
    MEASURED,
    METER,
    OTHERS_POLL,
    POLL,
    POLLED,
    VOLTAGES,
    frame_of,
)

# ------------------------------------------------------------------------------------------------ checksum, encoding


def test_the_crc_of_known_frames_is_the_printed_one() -> None:
    assert crc16(b"\x02\x07") == 0x1241  # serial line guide, appendix B
    assert crc16(b"123456789") == 0x4B37  # the check value by which this CRC is catalogued
    assert crc16(POLL[:-2]) == 0x3B70
    assert crc16(OTHERS_POLL[:-2]) == 0x8776
    assert crc16(b"") == 0xFFFF


def test_the_crc_is_the_one_computed_bit_by_bit() -> None:
    for length in range(257):
        data = bytes((7 * length + 31 * place) & 0xFF for place in range(length))
        assert crc16(data).to_bytes(2, "little") == crc_bit_by_bit(data)
        assert crc16(memoryview(data)) == crc16(bytearray(data)) == crc16(data)


@pytest.mark.parametrize("framer", [request_framer("rtu"), reply_framer("rtu")], ids=["slave", "master"])
def test_a_frame_is_encoded_with_its_crc_low_byte_first(framer: Framer) -> None:
    assert framer.encode(POLLED) == POLL
    assert framer.encode(MEASURED) == VOLTAGES
    assert encode_rtu(frame_of(METER)) == METER


def test_the_two_ears_are_different_framers_and_never_broken() -> None:
    assert isinstance(request_framer("rtu"), RtuRequestFramer)
    assert isinstance(reply_framer("rtu"), RtuReplyFramer)
    assert not request_framer("rtu").broken
    assert not reply_framer("rtu").broken


# ------------------------------------------------------------------------------------------------ lengths


LENGTHS = [  # section, request, reply
    ("6.1", "01 00 13 00 13", "01 03 CD 6B 05"),
    ("6.7", "07", "07 6D"),
    ("6.8", "08 00 00 A5 37", "08 00 00 A5 37"),
    ("6.9", "0B", "0B FF FF 01 08"),
    ("6.10", "0C", "0C 08 00 00 01 08 01 21 20 00"),
    ("6.11", "0F 00 13 00 0A 02 CD 01", "0F 00 13 00 0A"),
    ("6.12", "10 00 01 00 02 04 00 0A 01 02", "10 00 01 00 02"),
    ("6.13", "11", "11 02 01 FF"),
    ("6.14", "14 07 06 00 04 00 01 00 02", "14 06 05 06 0D FE 00 20"),
    ("6.15", "15 09 06 00 04 00 07 00 01 06 AF", "15 09 06 00 04 00 07 00 01 06 AF"),
    ("6.16", "16 00 04 00 F2 00 25", "16 00 04 00 F2 00 25"),
    ("6.17", "17 00 03 00 06 00 0E 00 01 02 00 FF", "17 04 00 FE 0A CD"),
    ("6.18", "18 04 DE", "18 00 06 00 02 01 B8 12 84"),
    ("6.21", "2B 0E 01 00", "AB 01"),
    ("7", "01 04 A1 00 01", "81 02"),
]


@pytest.mark.parametrize(("section", "request_", "reply"), LENGTHS, ids=[section for section, _, _ in LENGTHS])
def test_a_pdu_tells_its_length_and_a_part_of_it_never_a_greater_one(section: str, request_: str, reply: str) -> None:
    for shapes, text in ((REQUEST_SHAPES, request_), (REPLY_SHAPES, reply)):
        pdu = bytes.fromhex(text)
        assert pdu_length(shapes, pdu) == len(pdu)
        assert pdu_length(shapes, pdu + b"\xff\xff\xff") == len(pdu)
        for stop in range(1, len(pdu)):
            assert stop < (pdu_length(shapes, pdu[:stop]) or 0) <= len(pdu)


def test_an_unknown_function_and_no_bytes_at_all_have_no_length() -> None:
    assert pdu_length(REQUEST_SHAPES, b"\x41\x00\x00\x00\x00") is None
    assert pdu_length(REPLY_SHAPES, b"\x41\x00\x00\x00\x00") is None
    assert pdu_length(REQUEST_SHAPES, b"") is None
