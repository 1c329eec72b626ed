"""What was said on a line, in pieces: nothing is lost, what is a frame is found, what is none has a reason."""

from __future__ import annotations

from time import perf_counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.modbus.framing import Frame, Framing
from gateway.modbus.pieces import (
    BOTH,
    CUTTERS,
    HALF,
    REPLIES,
    REQUESTS,
    STARTS_MAX,
    Piece,
    Shapes,
    cut_ascii,
    cut_rtu,
    cut_tcp,
)
from tests.fakes import tcp
from tests.modbus import ascii_of, wire, with_crc
from tests.modbus.rtu_frames import (
    MEASURED,
    METER,
    OTHERS_POLL,
    OTHERS_REPLY,
    POLL,
    POLLED,
    REFUSAL,
    VOLTAGES,
    damaged,
    frame_of,
)

UNKNOWN = with_crc("02 63 01 02 03  # function 99: only silence tells how long it is")
IN_ASCII = ascii_of(VOLTAGES[:-2])


def reasons(pieces: list[Piece]) -> list[tuple[bytes, str]]:
    return [(piece.raw, piece.reason) for piece in pieces]


# ------------------------------------------------------------------------------------------------ RTU


def test_rtu_requests_and_replies_in_one_piece_are_each_a_frame() -> None:
    held = POLL + VOLTAGES + OTHERS_POLL + OTHERS_REPLY + REFUSAL + METER
    pieces = cut_rtu(held, BOTH, is_over=False)
    assert [piece.frame for piece in pieces] == [
        POLLED,
        MEASURED,
        frame_of(OTHERS_POLL),
        frame_of(OTHERS_REPLY),
        frame_of(REFUSAL),
        frame_of(METER),
    ]


def test_a_part_of_an_rtu_frame_waits_for_the_rest_until_it_is_over() -> None:
    for size in range(1, len(VOLTAGES)):
        assert cut_rtu(VOLTAGES[:size], BOTH, is_over=False) == []
        assert reasons(cut_rtu(VOLTAGES[:size], REPLIES, is_over=True)) == [(VOLTAGES[:size], HALF)]
    assert cut_rtu(VOLTAGES, REPLIES, is_over=False) == [Piece(VOLTAGES, MEASURED)]


def test_where_it_may_be_a_request_with_a_wrong_crc_or_part_of_a_reply_both_are_told() -> None:
    for size, reason in {7: HALF, 8: "CRC wrong or cut short", len(VOLTAGES) - 1: "CRC wrong or cut short"}.items():
        assert reasons(cut_rtu(VOLTAGES[:size], BOTH, is_over=True)) == [(VOLTAGES[:size], reason)]
    assert reasons(cut_rtu(damaged(VOLTAGES), BOTH, is_over=True)) == [(damaged(VOLTAGES), "CRC wrong")]


def test_a_frame_of_unknown_length_is_one_when_silence_ends_it() -> None:
    assert cut_rtu(UNKNOWN, BOTH, is_over=False) == []
    assert cut_rtu(UNKNOWN, BOTH, is_over=True) == [Piece(UNKNOWN, frame_of(UNKNOWN))]
    assert reasons(cut_rtu(damaged(UNKNOWN), BOTH, is_over=True)) == [(damaged(UNKNOWN), "CRC wrong")]


def test_a_request_with_a_byte_too_many_is_a_frame_when_silence_ends_it() -> None:
    too_long = with_crc("02 04 00 00 00 06 00")
    assert cut_rtu(too_long, BOTH, is_over=True) == [Piece(too_long, frame_of(too_long))]


def test_a_wrong_crc_is_told_and_the_frame_behind_it_found() -> None:
    held = damaged(VOLTAGES) + POLL
    assert cut_rtu(held, BOTH, is_over=False) == []
    assert cut_rtu(held, BOTH, is_over=True) == [Piece(damaged(VOLTAGES), reason="CRC wrong"), Piece(POLL, POLLED)]


@pytest.mark.parametrize("noise", [b"\x00", b"\xff\xff", b"\x02\x04\xff"], ids=lambda noise: noise.hex())
def test_noise_before_a_frame_is_a_piece_of_its_own(noise: bytes) -> None:
    assert cut_rtu(noise + POLL + METER, BOTH, is_over=True) == [
        Piece(noise, reason=HALF),
        Piece(POLL, POLLED),
        Piece(METER, frame_of(METER)),
    ]


def test_a_frame_is_looked_for_in_so_many_places_and_no_more() -> None:
    noise = b"\x00" * (STARTS_MAX - 1)
    assert cut_rtu(b"\x01" + noise + POLL, BOTH, is_over=True)[-1].frame == POLLED
    assert reasons(cut_rtu(b"\x01\x00" + noise + POLL, BOTH, is_over=True)) == [
        (b"\x01\x00" + noise + POLL, "CRC wrong")
    ]


def test_a_unit_that_there_cannot_be_is_no_start_of_a_frame_in_noise() -> None:
    fill = with_crc("F8 04 00 00 00 06")  # unit 248 with a right CRC, as idle lines give FF FF 00 00
    assert cut_rtu(fill, BOTH, is_over=False) == [Piece(fill, frame_of(fill))]
    assert [piece.frame for piece in cut_rtu(b"\x00" + fill + b"\x00", BOTH, is_over=True)] == [None]


@pytest.mark.parametrize("shapes", [REQUESTS, REPLIES, BOTH], ids=["requests", "replies", "both"])
def test_the_longest_frame_is_found_and_one_byte_more_is_none(shapes: Shapes) -> None:
    longest = with_crc("02 63" + " 5A" * 252)
    assert len(longest) == 256
    assert cut_rtu(longest, shapes, is_over=True) == [Piece(longest, frame_of(longest))]
    assert [piece.frame for piece in cut_rtu(with_crc("02 63" + " 5A" * 253), shapes, is_over=True)] == [None]


@pytest.mark.parametrize("babble", [b"\x00", b"\x02\x04\xff", b"\x10\x10\xf6", b"\x03", b"\x17\x17"], ids=bytes.hex)
def test_a_kilobyte_of_babble_takes_milliseconds(babble: bytes) -> None:
    held = (babble * 1024)[:1024]
    began_s = perf_counter()
    for _ in range(5):
        cut_rtu(held, BOTH, is_over=True)
    assert perf_counter() - began_s < 5 * 0.1


# ------------------------------------------------------------------------------------------------ ASCII


def test_ascii_frames_end_with_cr_lf_and_begin_with_the_last_colon() -> None:
    held = IN_ASCII + b":0204" + IN_ASCII + b"noise" + IN_ASCII
    assert cut_ascii(held, BOTH, is_over=False) == [
        Piece(IN_ASCII, MEASURED),
        Piece(b":0204", reason=HALF),
        Piece(IN_ASCII, MEASURED),
        Piece(b"noise", reason="no colon before it"),
        Piece(IN_ASCII, MEASURED),
    ]


@pytest.mark.parametrize(
    ("held", "reason"),
    [
        (IN_ASCII[:-3] + b"0\r\n", "LRC wrong"),
        (b":02\r\n", "LRC wrong"),
        (b":020G00\r\n", "not hexadecimal"),
        (b":02 400\r\n", "not hexadecimal"),
        (b":0204000\r\n", "not hexadecimal"),
        (b":\xff\xfe0000\r\n", "not hexadecimal"),
        (b"hello\r\n", "no colon before it"),
        (b"\r\n", "no colon before it"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.hex(),
)
def test_a_line_that_is_no_ascii_frame_says_why(held: bytes, reason: str) -> None:
    assert reasons(cut_ascii(held, BOTH, is_over=False)) == [(held, reason)]


def test_a_part_of_an_ascii_frame_waits_for_the_rest_until_it_is_over() -> None:
    for size in range(1, len(IN_ASCII)):
        assert cut_ascii(IN_ASCII[:size], BOTH, is_over=False) == []
        assert reasons(cut_ascii(IN_ASCII[:size], BOTH, is_over=True)) == [(IN_ASCII[:size], HALF)]


# ------------------------------------------------------------------------------------------------ TCP


ON_TCP = tcp(7, 2, POLLED.pdu)


def test_tcp_frames_are_cut_by_their_length() -> None:
    held = ON_TCP + tcp(8, 2, MEASURED.pdu) + ON_TCP[:5]
    assert cut_tcp(held, BOTH, is_over=False) == [
        Piece(ON_TCP, Frame(2, POLLED.pdu, 7)),
        Piece(tcp(8, 2, MEASURED.pdu), Frame(2, MEASURED.pdu, 8)),
    ]
    assert cut_tcp(held, BOTH, is_over=True)[2:] == [Piece(ON_TCP[:5], reason=HALF)]


def test_another_protocol_on_tcp_is_told_and_what_follows_is_still_cut() -> None:
    other = wire("00 01 00 02 00 06 02 04 00 00 00 06")
    assert cut_tcp(other + ON_TCP, BOTH, is_over=False) == [
        Piece(other, reason="protocol 2, not Modbus"),
        Piece(ON_TCP, Frame(2, POLLED.pdu, 7)),
    ]


@pytest.mark.parametrize("length", ["00 00", "00 01", "00 FF", "47 45"])
def test_after_a_length_that_cannot_be_nothing_is_a_frame_any_more(length: str) -> None:
    lost = wire(f"00 01 00 00 {length} 02 04") + ON_TCP
    assert cut_tcp(ON_TCP + lost, BOTH, is_over=False)[1:] == [Piece(lost, reason="not Modbus TCP")]


# ------------------------------------------------------------------------------------------------ all


FRAGMENTS = st.sampled_from([POLL, VOLTAGES, METER, REFUSAL, OTHERS_POLL, UNKNOWN, IN_ASCII, ON_TCP, b":", b"\r\n"])


@given(
    framing=st.sampled_from(["rtu", "ascii", "tcp"]),
    said=st.lists(st.one_of(FRAGMENTS, st.binary(max_size=20)), max_size=8).map(b"".join),
    shapes=st.sampled_from([REQUESTS, REPLIES, BOTH]),
)
def test_nothing_is_lost_nothing_is_twice_and_all_is_cut_when_it_is_over(
    framing: Framing, said: bytes, shapes: Shapes
) -> None:
    sure, over = (CUTTERS[framing](said, shapes, is_over) for is_over in (False, True))
    assert said.startswith(b"".join(piece.raw for piece in sure))
    assert b"".join(piece.raw for piece in over) == said
    for piece in sure + over:
        assert piece.raw
        assert (piece.frame is None) == bool(piece.reason)
