"""RTU frames out of a byte stream: what a master's ear makes of it while it waits for one reply."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from gateway.modbus.framing import (
    FALSE_STARTS_MAX,
    Frame,
    RtuReplyFramer,
)
from tests.modbus import drain, one_by_one, with_crc
from tests.modbus.rtu_frames import (
    MEASURED,
    METER,
    OTHERS_ECHO,
    OTHERS_REPLY,
    REFUSAL,
    VOLTAGES,
    damaged,
    frame_of,
)


def awaiting(unit: int = 2, function: int = 4) -> RtuReplyFramer:
    framer = RtuReplyFramer()
    framer.expect(unit, function)
    return framer


def answered(pieces: Iterable[bytes], framer: RtuReplyFramer) -> list[Frame]:
    """What a master's ear makes of *pieces*."""
    found = []
    for piece in pieces:
        framer.receive_data(piece)
        found += drain(framer)
    return found


@pytest.mark.parametrize(
    ("data", "unit", "function"),
    [
        (VOLTAGES, 2, 4),
        (REFUSAL, 2, 4),
        (METER, 1, 4),
        (OTHERS_REPLY, 17, 3),
        (OTHERS_ECHO, 5, 16),
        (with_crc("02 01 03 CD 6B 05"), 2, 1),
        (with_crc("02 05 00 AC FF 00"), 2, 5),
        (with_crc("02 16 00 04 00 F2 00 25"), 2, 22),
        (with_crc("02 17 04 00 FE 0A CD"), 2, 23),
        (with_crc("02 18 00 06 00 02 01 B8 12 84"), 2, 24),
        (with_crc("02 03 00  # no data at all: its request will tell that this is wrong"), 2, 3),
        (with_crc("02 03 FA" + " 5A" * 250), 2, 3),
    ],
    ids=lambda value: value[:3].hex(" ") if isinstance(value, bytes) else str(value),
)
def test_a_reply_is_whole_with_its_last_byte_and_not_before(data: bytes, unit: int, function: int) -> None:
    framer = awaiting(unit, function)
    assert answered(one_by_one(data[:-1]), framer) == []
    assert answered([data[-1:]], framer) == [frame_of(data)]
    assert answered([data], awaiting(unit, function)) == [frame_of(data)]
    assert (framer.pending, framer.damaged) == (0, 0)


def test_two_replies_at_once_are_two_and_the_second_is_pending_until_asked_for() -> None:
    framer = awaiting()
    framer.receive_data(VOLTAGES + REFUSAL)
    assert framer.next_frame() == MEASURED
    assert framer.pending == len(REFUSAL)
    assert framer.next_frame() == frame_of(REFUSAL)
    assert framer.pending == 0


def test_bytes_after_the_reply_stay_pending() -> None:
    framer = awaiting()
    framer.receive_data(VOLTAGES + b"\x00")
    assert framer.next_frame() == MEASURED
    assert framer.pending == 1


@pytest.mark.parametrize(
    "before",
    [
        b"\x00",
        b"\xff\x00\xff",
        b"\x02",  # the unit, then not the function
        b"\x02\x02\x02",
        b"\x02\x03\x04",  # the unit with another function
        OTHERS_REPLY,
        METER,
        with_crc("02 03 02 00 0A  # the right unit, to another question"),
    ],
    ids=lambda data: data.hex(" "),
)
def test_what_comes_before_the_awaited_unit_and_function_is_dropped(before: bytes) -> None:
    assert answered([before + VOLTAGES], awaiting()) == [MEASURED]
    assert answered(one_by_one(before + VOLTAGES), awaiting()) == [MEASURED]


def test_another_unit_alone_leaves_nothing_behind() -> None:
    framer = awaiting()
    assert answered([METER], framer) == []
    assert (framer.pending, framer.damaged) == (0, 0)


def test_a_wrong_crc_is_counted_and_the_good_frame_after_it_found() -> None:
    framer = awaiting()
    assert answered([damaged(VOLTAGES)], framer) == []
    assert framer.damaged == 1
    assert answered([VOLTAGES], framer) == [MEASURED]


def test_a_start_inside_a_damaged_frame_is_tried_too() -> None:
    framer = awaiting()
    assert answered([b"\x02\x04\x02" + VOLTAGES], framer) == [MEASURED]
    assert framer.damaged == 1


def test_a_start_that_promises_too_much_is_given_up_at_silence() -> None:
    framer = awaiting()
    assert answered([b"\x02\x04\xc8" + VOLTAGES], framer) == []  # "200 bytes follow"
    assert framer.pending == 3 + len(VOLTAGES)
    framer.silence()
    assert drain(framer) == [MEASURED]
    assert (framer.pending, framer.damaged) == (0, 1)


def test_silence_with_nothing_held_is_no_damage() -> None:
    framer = awaiting()
    framer.silence()
    assert framer.damaged == 0
    framer.receive_data(b"\x02")
    framer.silence()
    assert (framer.pending, framer.damaged) == (0, 1)


def test_a_function_without_a_length_ends_with_what_has_come() -> None:
    identification = with_crc("02 2B 0E 01 01 00 00 01 00 03 41 42 43")
    assert answered([identification], awaiting(2, 43)) == [frame_of(identification)]


def test_expect_and_reset_forget_what_is_held() -> None:
    framer = awaiting()
    framer.receive_data(VOLTAGES)
    framer.expect(1, 4)
    assert framer.pending == 0
    assert answered([VOLTAGES + METER], framer) == [frame_of(METER)]
    framer.receive_data(METER[:5])
    framer.reset()
    assert (framer.pending, framer.damaged) == (0, 0)
    assert answered([METER], framer) == [frame_of(METER)]


def test_whoever_awaits_nobody_hears_nothing_and_keeps_nothing() -> None:
    framer = RtuReplyFramer()
    assert answered([VOLTAGES, b"\xff\xff"], framer) == []
    assert framer.pending == 0


@pytest.mark.parametrize("babble", [b"\x00", b"\x02\x04\xff", b"\x02\x04", b"\x02", bytes(range(256))], ids=len)
def test_endless_babble_is_held_up_to_one_frame(babble: bytes) -> None:
    framer = awaiting()
    for _ in range(2000 // len(babble) + 2):
        framer.receive_data(babble)
        drain(framer)
        assert framer.pending < 256
    framer.receive_data(babble * 20_000 if len(babble) < 4 else babble)
    drain(framer)
    assert framer.pending < 256


def test_a_start_that_promises_more_than_256_bytes_is_given_up_at_once() -> None:
    for too_many in (252, 255):  # unit, function, count, so many bytes and CRC would be 257 and 260
        framer = awaiting()
        assert answered([bytes([2, 4, too_many]) + VOLTAGES], framer) == [MEASURED]
        assert answered([with_crc(f"02 04 {too_many:02X}" + " 5A" * too_many)], framer) == []
        assert framer.pending == 0
    longest = with_crc("02 04 FB" + " 5A" * 251)
    assert len(longest) == 256
    assert answered([longest], awaiting()) == [frame_of(longest)]


def test_a_reply_is_found_behind_so_many_false_starts_and_no_more() -> None:
    false_start = b"\x02\x04\xff"  # the awaited unit and function, and more bytes than a frame has
    framer = awaiting()
    assert answered([false_start * (FALSE_STARTS_MAX - 1) + VOLTAGES], framer) == [MEASURED]
    assert framer.damaged == FALSE_STARTS_MAX - 1
    framer = awaiting()
    assert answered([false_start * FALSE_STARTS_MAX + VOLTAGES, VOLTAGES], framer) == []
    assert (framer.pending, framer.damaged) == (0, FALSE_STARTS_MAX)


def test_false_starts_are_counted_over_all_that_comes_and_forgotten_with_the_next_question() -> None:
    framer = awaiting()
    assert answered([damaged(VOLTAGES)] * FALSE_STARTS_MAX, framer) == []
    assert answered([VOLTAGES], framer) == []
    framer.expect(2, 4)
    assert answered([VOLTAGES], framer) == [MEASURED]


def test_a_silence_behind_a_false_start_counts_as_one_too() -> None:
    framer = awaiting()
    for _ in range(FALSE_STARTS_MAX):
        assert answered([b"\x02\x04\x0c"], framer) == []
        framer.silence()
    assert (framer.pending, framer.damaged) == (0, FALSE_STARTS_MAX)
    assert answered([VOLTAGES], framer) == []
