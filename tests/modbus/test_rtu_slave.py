"""RTU frames out of a byte stream: what a slave's ear makes of a shared line."""

from __future__ import annotations

import pytest

from gateway.modbus.framing import (
    Frame,
    RtuRequestFramer,
    encode_rtu,
)
from tests.modbus import drain, one_by_one, with_crc
from tests.modbus.rtu_frames import (
    METER,
    OTHERS_ECHO,
    OTHERS_POLL,
    OTHERS_REPLY,
    OTHERS_WRITE,
    POLL,
    POLLED,
    REFUSAL,
    TO_ALL,
    VOLTAGES,
    damaged,
    frame_of,
)


def heard(*bursts: bytes, framer: RtuRequestFramer | None = None) -> list[Frame]:
    """What a slave's ear makes of *bursts*, with a silence after each."""
    framer = framer or RtuRequestFramer()
    found = []
    for burst in bursts:
        framer.receive_data(burst)
        framer.silence()
        found += drain(framer)
    return found


def test_a_request_is_heard_after_silence_and_not_before() -> None:
    framer = RtuRequestFramer()
    framer.receive_data(POLL)
    assert framer.next_frame() is None
    assert framer.pending == 8
    framer.silence()
    assert framer.next_frame() == POLLED
    assert framer.next_frame() is None
    assert (framer.pending, framer.damaged) == (0, 0)


def test_a_request_is_heard_byte_by_byte_and_two_at_once() -> None:
    framer = RtuRequestFramer()
    for byte in one_by_one(POLL):
        framer.receive_data(byte)
        assert framer.next_frame() is None
    framer.silence()
    framer.receive_data(TO_ALL)
    framer.silence()
    assert drain(framer) == [POLLED, frame_of(TO_ALL)]  # what nobody fetched yet is not lost
    assert heard(POLL + POLL) == [POLLED, POLLED]


@pytest.mark.parametrize(
    "foreign",
    [OTHERS_POLL, OTHERS_REPLY, OTHERS_WRITE, OTHERS_ECHO, REFUSAL, METER, TO_ALL],
    ids=["read", "its reply", "write", "its reply", "exception", "meter", "broadcast"],
)
def test_others_frames_keep_the_sync_whether_alone_or_in_one_burst(foreign: bytes) -> None:
    assert heard(foreign, POLL) == [frame_of(foreign), POLLED]
    assert heard(foreign + POLL) == [frame_of(foreign), POLLED]
    assert heard(POLL + foreign) == [POLLED, frame_of(foreign)]


def test_a_whole_conversation_in_one_burst_comes_apart_frame_by_frame() -> None:
    talk = [OTHERS_POLL, OTHERS_REPLY, OTHERS_WRITE, OTHERS_ECHO, POLL, VOLTAGES, POLL, REFUSAL, TO_ALL, POLL]
    framer = RtuRequestFramer()
    assert heard(b"".join(talk), framer=framer) == [frame_of(data) for data in talk]
    assert framer.damaged == 0


@pytest.mark.parametrize(
    "data",
    [
        with_crc("02 41 01 02 03 04 05 06 07 08 09  # function 65, of some maker's own"),
        with_crc("02 41"),
        with_crc("02 03 00 00 00 01 00  # one byte too many"),
        with_crc("02 03 00 6B 00 01 00 00 00  # too many, and not as long as a reply with 0 bytes"),
        with_crc("02 03 00 00 00  # one byte too few"),
        with_crc("02 03  # nothing but the function"),
        with_crc("02 10 00 01 00 02 04 00 0A  # half the data that its byte count promises"),
        with_crc("02 10 00 01 00 02 03 00 0A 01 02  # a byte count one too small"),
        with_crc("02 2B 0E 01 01 00 00  # device identification, answered: its length stands nowhere"),
        with_crc("02 41" + " 55" * 252),
    ],
    ids=lambda data: data[:6].hex(" "),
)
def test_what_has_a_right_crc_is_one_frame_whatever_its_length(data: bytes) -> None:
    framer = RtuRequestFramer()
    assert heard(data, POLL, framer=framer) == [frame_of(data), POLLED]
    assert framer.damaged == 0


def test_a_frame_of_more_than_256_bytes_is_none() -> None:
    for too_long in ("02 41" + " 55" * 253, "02 10 00 00 00 7F FE" + " 55" * 254, "02 03 FC" + " 55" * 252):
        framer = RtuRequestFramer()
        assert heard(with_crc(too_long), framer=framer) == []
        framer.reset()  # the driver does so after the character timeout
        assert (framer.pending, framer.damaged) == (0, 1)


@pytest.mark.parametrize(
    "request_",
    [
        with_crc("02 41 01 02 03 04 05 06 07 08 09  # function 65, of some maker's own"),
        with_crc("02 41" + " 55" * 252),
        with_crc("02 03 00 6B 00 01 00 00 00  # a read that is too long"),
        with_crc("02 2B 0E 01 01 00 00  # device identification with two bytes too many"),
        with_crc("02 10 00 01 00 02 03 00 0A 01 02  # a byte count one too small"),
    ],
    ids=lambda data: data[:6].hex(" "),
)
def test_a_request_that_earns_an_exception_is_heard_even_if_it_comes_in_slices(request_: bytes) -> None:
    """A USB adapter hands over its bytes in slices, milliseconds apart; only silence can tell where these end."""
    for stop in range(1, len(request_)):
        framer = RtuRequestFramer()
        assert heard(request_[:stop], request_[stop:], framer=framer) == [frame_of(request_)]
        assert framer.pending == 0
        assert heard(POLL, framer=framer) == [POLLED]


@pytest.mark.parametrize(
    "after",
    [
        b"\x00",
        b"\x41\x41\x41\x41",
        OTHERS_REPLY[:4],
        damaged(OTHERS_POLL),
        damaged(OTHERS_REPLY),
        b"\x05\x41" + b"\x55" * 20,
    ],
    ids=lambda data: data.hex(" "),
)
def test_a_request_that_something_follows_in_the_same_burst_is_not_the_last_that_was_said(after: bytes) -> None:
    """Whoever answers now would talk into somebody's frame: the driver looks at ``pending``."""
    framer = RtuRequestFramer()
    assert heard(POLL + after, framer=framer) == [POLLED]
    assert framer.pending == len(after)


def test_a_request_after_a_frame_that_only_silence_ends_is_heard_in_the_same_burst() -> None:
    foreign = with_crc("05 41 01 02 03 04 05 06 07 08 09  # function 65")
    assert heard(OTHERS_POLL + foreign) == [frame_of(OTHERS_POLL), frame_of(foreign)]
    assert heard(foreign + POLL) == [POLLED]


@pytest.mark.parametrize(
    "before",
    [damaged(OTHERS_POLL), damaged(OTHERS_REPLY), damaged(OTHERS_WRITE), damaged(POLL), b"\x00", b"\xff", b"\xff\xff"],
    ids=["poll", "reply", "write", "own", "a zero", "a one", "ones"],
)
def test_a_request_at_the_end_of_a_burst_is_heard_after_damage(before: bytes) -> None:
    framer = RtuRequestFramer()
    assert heard(before + POLL, framer=framer) == [POLLED]
    assert (framer.pending, framer.damaged) == (0, 1)


def test_damage_costs_its_own_frame_and_no_whole_frame_before_it() -> None:
    framer = RtuRequestFramer()
    assert heard(OTHERS_POLL + damaged(OTHERS_REPLY) + POLL, framer=framer) == [frame_of(OTHERS_POLL), POLLED]
    assert framer.damaged == 1
    assert heard(damaged(POLL), POLL, framer=framer) == [POLLED]
    assert framer.damaged == 2


def test_a_part_is_kept_over_a_silence_and_completed_later() -> None:
    for stop in range(1, len(POLL)):
        framer = RtuRequestFramer()
        assert heard(POLL[:stop], framer=framer) == []
        assert framer.pending == stop
        assert heard(POLL[stop:], framer=framer) == [POLLED]
        assert (framer.pending, framer.damaged) == (0, 0)


def test_a_part_after_a_whole_frame_is_kept_and_only_the_part() -> None:
    framer = RtuRequestFramer()
    assert heard(OTHERS_REPLY + POLL[:5], framer=framer) == [frame_of(OTHERS_REPLY)]
    assert framer.pending == 5
    assert heard(POLL[5:], framer=framer) == [POLLED]


def test_reset_throws_a_part_away_and_counts_it() -> None:
    framer = RtuRequestFramer()
    assert heard(POLL[:5], framer=framer) == []
    framer.reset()
    assert (framer.pending, framer.damaged) == (0, 1)
    assert heard(POLL, framer=framer) == [POLLED]
    framer.reset()
    assert framer.damaged == 1  # there was nothing to throw away


def test_expect_makes_a_slave_forget_parts_and_still_hear_everybody() -> None:
    framer = RtuRequestFramer()
    framer.receive_data(POLL[:5])
    framer.expect(17, 3)
    assert framer.pending == 0
    assert heard(POLL, framer=framer) == [POLLED]


def test_damage_that_promises_more_bytes_is_over_at_reset() -> None:
    broken_poll = damaged(with_crc("05 03 20 00 00 01  # as a reply this would have 32 bytes of data"))
    framer = RtuRequestFramer()
    assert heard(broken_poll, framer=framer) == []
    assert framer.pending == 8
    framer.reset()  # the driver does so after the character timeout
    assert heard(POLL, framer=framer) == [POLLED]


def test_a_request_inside_anothers_whole_frame_is_not_taken() -> None:
    quoting_reply = with_crc("05 03 08" + POLL.hex(" "))
    quoting_write = with_crc("05 10 00 00 00 04 08" + POLL.hex(" "))
    quoting_unknown = with_crc("05 41 " + POLL.hex(" "))
    for quoting in (quoting_reply, quoting_write, quoting_unknown):
        assert heard(quoting) == [frame_of(quoting)]
        assert heard(OTHERS_POLL + quoting) == [frame_of(OTHERS_POLL), frame_of(quoting)]


def test_a_request_in_the_middle_of_damage_is_not_taken() -> None:
    framer = RtuRequestFramer()
    assert heard(damaged(OTHERS_WRITE) + POLL + b"\x41\x41\x41\x41", framer=framer) == []
    assert framer.pending == len(OTHERS_WRITE + POLL) + 4
    framer.reset()
    assert (framer.pending, framer.damaged) == (0, 1)


def test_a_line_that_never_rests_fills_no_more_than_4096_bytes() -> None:
    framer = RtuRequestFramer()
    for _ in range(1000):
        framer.receive_data(b"\x55" * 100)
        assert framer.pending <= 4096
    assert framer.damaged > 0
    framer.receive_data(b"\x55" * 100_000)
    assert framer.pending <= 4096
    framer.reset()
    assert heard(POLL, framer=framer) == [POLLED]


@pytest.mark.parametrize("noise", [b"\x00", b"\xff", b"\x00\x00", b"\xff\x00"])
@pytest.mark.parametrize("unit", [1, 3, 6, 15, 16, 17, 22, 23])
def test_noise_of_a_turning_driver_makes_no_slave_deaf(noise: bytes, unit: int) -> None:
    """With the noise as a unit and our unit as a function, it looks like the start of a longer frame."""
    for pdu in (bytes.fromhex("03 0000 0001"), bytes.fromhex("06 0001 0003"), bytes.fromhex("10 0001 0001 02 000A")):
        framer = RtuRequestFramer()
        framer.receive_data(noise + encode_rtu(Frame(unit, pdu)))
        framer.silence()
        frames = drain(framer)
        assert frames[-1] == Frame(unit, pdu)
        assert framer.pending == 0
