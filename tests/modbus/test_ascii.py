"""ASCII frames out of a byte stream: colon, two hexadecimal characters a byte, LRC, CR LF.

Source: Modbus over Serial Line V1.02, section 2.5.2.
"""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from gateway.modbus.framing import AsciiFramer, Frame, lrc8, reply_framer, request_framer
from tests.modbus import ascii_of, drain, one_by_one, wire

POLL = wire("""
    3A              # a colon
    31 31           # "11": unit 17
    30 33           # "03": read holding registers
    30 30 36 42     # "006B": from address 107
    30 30 30 33     # "0003": 3 of them
    37 45           # "7E": LRC
    0D 0A           # CR LF
""")
POLLED = Frame(17, b"\x03\x00\x6b\x00\x03")
REPLY = wire("""
    3A                                      # a colon
    31 31                                   # "11": unit 17
    30 33                                   # "03": read holding registers
    30 36                                   # "06": 6 bytes
    41 45 34 31 35 36 35 32 34 33 34 30     # "AE4156524340": 44609, 22098, 17216
    43 43                                   # "CC": LRC
    0D 0A                                   # CR LF
""")
REPLIED = Frame(17, b"\x03\x06\xae\x41\x56\x52\x43\x40")
LONGEST = Frame(1, b"\x41" + b"\x5a" * 252)
SHORTEST = Frame(1, b"\x07")


def received(pieces: Iterable[bytes], framer: AsciiFramer | None = None) -> list[Frame]:
    framer = framer or AsciiFramer()
    found = []
    for piece in pieces:
        framer.receive_data(piece)
        found += drain(framer)
    return found


def refused(data: bytes) -> AsciiFramer:
    """The framer after *data*, which it took for damage, and after a good frame, which it still found."""
    framer = AsciiFramer()
    assert received([data], framer) == []
    assert framer.damaged == 1
    assert received([POLL], framer) == [POLLED]
    assert framer.damaged == 1
    return framer


# ------------------------------------------------------------------------------------------------ as printed


def test_the_frames_of_a_manual_are_encoded_as_printed() -> None:
    assert AsciiFramer().encode(POLLED) == POLL == b":1103006B00037E\r\n"
    assert AsciiFramer().encode(REPLIED) == REPLY == b":110306AE4156524340CC\r\n"


def test_the_lrc_makes_the_sum_of_all_bytes_zero() -> None:
    assert lrc8(b"\x11\x03\x00\x6b\x00\x03") == 0x7E
    assert lrc8(b"") == 0
    assert lrc8(b"\x00\x00") == 0
    assert lrc8(b"\x01") == 0xFF
    for body in (b"\xff" * 254, bytes(range(200)), b"\x80\x80"):
        assert ascii_of(body)[-4:-2] == b"%02X" % lrc8(body)
        assert (sum(body) + lrc8(body)) % 256 == 0


@pytest.mark.parametrize(("data", "frame"), [(POLL, POLLED), (REPLY, REPLIED)], ids=["request", "reply"])
def test_a_frame_is_found_whole_byte_by_byte_and_two_at_once(data: bytes, frame: Frame) -> None:
    assert received([data]) == [frame]
    assert received(one_by_one(data[:-1])) == []
    assert received(one_by_one(data)) == [frame]
    assert received([data + data]) == [frame, frame]
    assert received(one_by_one(data + data)) == [frame, frame]


def test_a_part_is_pending_until_its_end_has_come() -> None:
    framer = AsciiFramer()
    assert received([POLL[:9]], framer) == []
    assert framer.pending == 9
    framer.silence()  # up to 1 s of it is allowed inside a frame
    assert framer.pending == 9
    assert received([POLL[9:]], framer) == [POLLED]
    assert (framer.pending, framer.damaged) == (0, 0)


def test_both_directions_share_one_framer_that_is_never_broken() -> None:
    assert isinstance(request_framer("ascii"), AsciiFramer)
    assert isinstance(reply_framer("ascii"), AsciiFramer)
    assert not request_framer("ascii").broken


# ------------------------------------------------------------------------------------------------ tolerated


def test_lower_case_is_accepted() -> None:
    assert received([b":1103006b00037e\r\n"]) == [POLLED]
    assert received([b":1103006B00037e\r\n"]) == [POLLED]


def test_a_colon_begins_a_new_frame_wherever_it_comes() -> None:
    longest = AsciiFramer().encode(LONGEST)
    for data, frame, stops in ((POLL, POLLED, range(len(POLL) - 1)), (longest, LONGEST, (400, 511))):
        for stop in stops:
            framer = AsciiFramer()
            assert received([data[:stop] + data], framer) == [frame]
            assert received(one_by_one(data[:stop] + data), framer) == [frame]
            assert framer.damaged == 0


@pytest.mark.parametrize("noise", [b"\x00", b"\xff\xfe", b"1103", b"\r", b"\n", b"hello "])
def test_what_stands_before_a_colon_is_dropped(noise: bytes) -> None:
    framer = AsciiFramer()
    assert received([noise], framer) == []
    assert framer.pending == 0
    assert received([noise + POLL, noise + POLL], framer) == [POLLED, POLLED]
    assert framer.damaged == 0


# ------------------------------------------------------------------------------------------------ refused


def test_a_wrong_lrc_is_damage() -> None:
    refused(b":1103006B00037F\r\n")
    refused(b":1103006B00047E\r\n")


def test_an_odd_number_of_characters_is_damage() -> None:
    refused(b":1103006B00037E0\r\n")
    refused(b":1103006B00037\r\n")


@pytest.mark.parametrize("character", [b"G", b"g", b" ", b"-", b"_", b"\x00", b"\xb0", b"\n", b"\r", b"@", b"/"])
def test_a_character_that_is_no_hexadecimal_digit_is_damage(character: bytes) -> None:
    refused(b":1103006B0003" + character + b"E\r\n")
    refused(b":" + character + b"1103006B00037E\r\n")


def test_spaces_between_the_digits_are_damage() -> None:
    refused(b":11 03 00 6B 00 03 7E\r\n")


def test_less_than_unit_function_and_lrc_is_damage() -> None:
    refused(b":\r\n")
    refused(b":00\r\n")
    refused(b":11EF\r\n")  # the LRC is right
    assert received([ascii_of(b"\x01\x07")]) == [SHORTEST]


def test_253_bytes_of_pdu_pass_and_254_are_damage() -> None:
    longest = ascii_of(bytes([LONGEST.unit]) + LONGEST.pdu)
    assert len(longest) == 513  # serial line guide, section 2.5.2.1
    assert received([longest]) == [LONGEST]
    assert received(one_by_one(longest)) == [LONGEST]
    too_long = ascii_of(bytes([LONGEST.unit]) + LONGEST.pdu + b"\x00")
    refused(too_long)
    assert received([*one_by_one(too_long), POLL]) == [POLLED]


def test_cr_without_lf_and_lf_without_cr_end_nothing() -> None:
    framer = AsciiFramer()
    assert received([POLL[:-1], b"\x00"], framer) == []  # CR, then something else
    assert received([POLL[:-2] + b"\n"], framer) == []
    assert received([b"\r\n"], framer) == []
    assert framer.damaged == 1  # an LF stands inside the frame that CR LF has ended now
    assert received([POLL], framer) == [POLLED]


def test_an_end_without_a_beginning_is_damage() -> None:
    refused(b"1103006B00037E\r\n")
    refused(b"\r\n")


def test_a_frame_that_never_ends_is_thrown_away_and_held_up_to_its_largest_size() -> None:
    framer = AsciiFramer()
    received([b":"], framer)
    for _ in range(513):
        received([b"0"], framer)
        assert framer.pending <= 513
    assert (framer.pending, framer.damaged) == (0, 1)
    assert received([b"0" * 100_000, b":" * 100_000, b":" + b"0" * 100_000], framer) == []
    assert framer.pending <= 513
    assert received([POLL], framer) == [POLLED]


# ------------------------------------------------------------------------------------------------ a master's ear


def test_after_expect_the_frames_of_other_units_are_skipped() -> None:
    framer = AsciiFramer()
    framer.expect(17, 3)
    others = ascii_of(b"\x12\x03\x02\x00\x0a")
    assert received([others + REPLY + others], framer) == [REPLIED]
    assert framer.damaged == 0  # nothing is wrong with them
    assert received([ascii_of(b"\x11\x83\x02")], framer) == [Frame(17, b"\x83\x02")]


def test_before_expect_a_slave_hears_every_unit() -> None:
    assert received([ascii_of(bytes([unit, 7])) for unit in range(256)]) == [
        Frame(unit, b"\x07") for unit in range(256)
    ]


def test_expect_forgets_a_part_and_reset_counts_it() -> None:
    framer = AsciiFramer()
    received([POLL[:9]], framer)
    framer.expect(17, 3)
    assert (framer.pending, framer.damaged) == (0, 0)
    received([POLL[:9]], framer)
    framer.reset()
    assert (framer.pending, framer.damaged) == (0, 1)
    framer.reset()
    assert framer.damaged == 1  # there was nothing to throw away
    assert received([POLL[9:], POLL], framer) == [POLLED]
