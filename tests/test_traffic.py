"""The traffic view: what is told of a line, in words; it slows no line, and hides nothing that was rejected."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from datetime import datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.modbus.framing import Framing
from gateway.traffic import BYTES_MAX, CHUNKS_MAX, REST_MAX, Seen, Tap
from tests.fakes import JumpingClock, ascii_frame, rtu, tcp
from tests.lines import CLOCK, PATIENCE_S
from tests.traffic import ANSWER, ANSWER_WORDS, ASKED, ENCODE, READ_WORDS, WRITE, on_wires, texts

GAP_S = 0.25

each_framing = pytest.mark.parametrize("framing", ["rtu", "ascii", "tcp"])


def watched(clock: JumpingClock, framing: Framing = "rtu", unit: int | None = None) -> Tap:
    """A tap that somebody watches: a master's, or that of the slave *unit*."""
    tap = Tap(framing, clock, GAP_S, unit)
    tap.watch()
    return tap


# ------------------------------------------------------------------------------------------------ frames


@each_framing
def test_a_master_shows_its_requests_and_their_replies(clock: JumpingClock, framing: Framing) -> None:
    tap, encode = watched(clock, framing), ENCODE[framing]
    tap.tell(True, encode(17, ASKED))
    clock.pass_s(0.125)
    tap.tell(False, encode(17, ANSWER))
    asked, answered = tap.take()
    assert (asked.text, asked.sent, asked.raw) == (READ_WORDS, True, encode(17, ASKED))
    assert (answered.text, answered.sent, answered.raw) == (ANSWER_WORDS, False, encode(17, ANSWER))
    assert (asked.when, answered.when) == (clock.wall() - 0.125, clock.wall())
    assert tap.take() == []


@each_framing
def test_a_slave_shows_what_it_is_asked_and_what_it_answers(clock: JumpingClock, framing: Framing) -> None:
    tap, encode = watched(clock, framing, 17), ENCODE[framing]
    tap.tell(False, encode(17, WRITE))
    tap.tell(True, encode(17, WRITE))
    tap.tell(False, encode(17, WRITE))
    tap.tell(True, encode(17, b"\x86\x02"))
    assert texts(tap.take()) == [
        "< unit 17: write register at 1: 3",
        "> unit 17: wrote register at 1: 3",
        "< unit 17: write register at 1: 3",
        "> unit 17: exception 2 illegal data address",
    ]


@each_framing
@pytest.mark.parametrize("unit", [None, 17], ids=["master", "slave"])
def test_a_frame_in_pieces_is_one_and_has_the_time_of_its_first_byte(
    clock: JumpingClock, framing: Framing, unit: int | None
) -> None:
    tap, frame = watched(clock, framing, unit), ENCODE[framing](17, WRITE)
    began = clock.wall()
    for byte in frame:
        assert tap.take() == []
        tap.tell(False, bytes([byte]))
        clock.pass_s(0.015625)
    assert [(one.raw, one.when) for one in tap.take()] == [(frame, began)]


@each_framing
def test_each_frame_has_the_time_of_its_first_byte_however_the_pieces_fall(
    clock: JumpingClock, framing: Framing
) -> None:
    tap, frame = watched(clock, framing), ENCODE[framing](17, WRITE)
    began = clock.wall()
    for piece in (frame[:5], frame[5:] + frame + frame[:3], frame[3:], frame):
        tap.tell(True, piece)
        clock.pass_s(0.125)
    assert [one.when - began for one in tap.take()] == [0.0, 0.125, 0.125, 0.375]


def test_frames_in_one_piece_are_told_apart(clock: JumpingClock) -> None:
    tap = watched(clock, "tcp", 17)
    tap.tell(False, tcp(1, 17, ASKED) + tcp(2, 255, WRITE) + tcp(3, 0, ASKED)[:6])
    tap.tell(False, tcp(3, 0, ASKED)[6:])
    assert texts(tap.take()) == [
        f"< {READ_WORDS}",
        "< unit 255: write register at 1: 3",
        "< unit 0: read 3 holding registers from 107",
    ]


def test_on_tcp_a_pause_ends_nothing(clock: JumpingClock) -> None:
    tap, frame = watched(clock, "tcp", 17), tcp(1, 17, ASKED)
    tap.tell(False, frame[:9])
    clock.pass_s(3600.0)
    assert tap.take() == []
    tap.tell(True, tcp(9, 17, ANSWER))  # what we say meanwhile ends nothing either
    tap.tell(False, frame[9:])
    assert texts(tap.take()) == [f"> {ANSWER_WORDS}", f"< {READ_WORDS}"]


def test_clients_on_tcp_are_never_mixed_up(clock: JumpingClock) -> None:
    tap, frame = watched(clock, "tcp", 17), tcp(1, 17, ASKED)
    tap.tell(False, frame[:5], "a:1")
    tap.tell(False, frame[:9], "b:2")
    tap.tell(False, frame[5:], "a:1")
    tap.tell(False, frame[9:], "b:2")
    assert [(one.client, one.text) for one in tap.take()] == [("a:1", READ_WORDS), ("b:2", READ_WORDS)]


# ------------------------------------------------------------------------------------------------ a shared pair


@on_wires
def test_a_slave_shows_others_requests_and_replies_as_what_they_are(clock: JumpingClock, framing: Framing) -> None:
    tap, encode = watched(clock, framing, 17), ENCODE[framing]
    for pdu in (ASKED, ANSWER, ASKED, b"\x83\x02", WRITE, WRITE, WRITE):
        tap.tell(False, encode(18, pdu))
    assert texts(tap.take()) == [
        "< unit 18: read 3 holding registers from 107, not for us",
        "< unit 18: 3 registers: 555 0 100",
        "< unit 18: read 3 holding registers from 107, not for us",
        "< unit 18: exception 2 illegal data address",
        "< unit 18: write register at 1: 3, not for us",
        "< unit 18: wrote register at 1: 3",
        "< unit 18: write register at 1: 3, not for us",
    ]


@on_wires
def test_what_is_said_to_all_or_to_us_twice_is_no_reply(clock: JumpingClock, framing: Framing) -> None:
    tap, encode = watched(clock, framing, 17), ENCODE[framing]
    for unit in (0, 0, 17, 17):
        tap.tell(False, encode(unit, WRITE))
    assert {one.text.partition(": ")[2] for one in tap.take()} == {"write register at 1: 3"}


def test_a_reply_of_our_own_unit_that_we_did_not_send_is_told(clock: JumpingClock) -> None:
    tap = watched(clock, "rtu", 17)
    tap.tell(False, rtu(17, ANSWER))
    assert texts(tap.take()) == [f"< {ANSWER_WORDS}, another of our unit, or our echo"]


def test_foreign_units_on_tcp_are_told(clock: JumpingClock) -> None:
    tap = watched(clock, "tcp", 17)
    tap.tell(False, tcp(1, 18, ASKED))
    assert texts(tap.take()) == ["< unit 18: read 3 holding registers from 107, not for us"]


# ------------------------------------------------------------------------------------------------ what a master rejects


@pytest.mark.parametrize(
    ("said", "text"),
    [
        (rtu(18, ANSWER), "unit 18: 3 registers: 555 0 100, not asked for"),
        (rtu(17, b"\x04" + ANSWER[1:]), f"{ANSWER_WORDS}, not asked for"),
        (rtu(17, b"\x84\x02"), "unit 17: exception 2 illegal data address, not asked for"),
        (rtu(17, b"\x83\x02"), "unit 17: exception 2 illegal data address"),
        (rtu(17, ASKED), f"{READ_WORDS}, our own echo"),
        (rtu(17, ANSWER)[:-1] + b"\x00", "11 bytes, CRC wrong"),
        (rtu(17, ANSWER)[:-1], "10 bytes, CRC wrong or cut short"),
        (rtu(17, ANSWER)[:-4], "7 bytes, cut short"),
        (b"\x00", "1 byte, cut short"),
    ],
)
def test_a_master_shows_what_it_rejects_and_why(clock: JumpingClock, said: bytes, text: str) -> None:
    tap = watched(clock)
    tap.tell(True, rtu(17, ASKED))
    tap.tell(False, said)
    clock.pass_s(GAP_S)
    assert texts(tap.take())[1:] == [f"< {text}"]


def test_a_second_reply_was_not_asked_for(clock: JumpingClock) -> None:
    tap = watched(clock)
    tap.tell(True, rtu(17, ASKED))
    tap.tell(False, 2 * rtu(17, ANSWER))
    assert texts(tap.take())[1:] == [f"< {ANSWER_WORDS}", f"< {ANSWER_WORDS}, not asked for"]


def test_who_begins_to_watch_between_request_and_reply_is_told_no_tales(clock: JumpingClock) -> None:
    tap = watched(clock)
    tap.tell(False, rtu(17, ANSWER))
    assert texts(tap.take()) == [f"< {ANSWER_WORDS}"]


def test_on_tcp_a_late_reply_is_known_by_its_transaction(clock: JumpingClock) -> None:
    tap = watched(clock, "tcp")
    tap.tell(True, tcp(1, 17, ASKED))
    tap.tell(True, tcp(2, 17, ASKED))
    tap.tell(False, tcp(1, 17, ANSWER) + tcp(2, 17, ANSWER))
    assert texts(tap.take())[2:] == [f"< {ANSWER_WORDS}, not asked for", f"< {ANSWER_WORDS}"]


@on_wires
def test_half_a_frame_is_over_when_the_other_side_speaks(clock: JumpingClock, framing: Framing) -> None:
    tap, encode = watched(clock, framing), ENCODE[framing]
    tap.tell(True, encode(17, ASKED))
    tap.tell(False, encode(17, ANSWER)[:5])
    tap.tell(True, encode(17, ASKED))
    assert texts(tap.take()) == [f"> {READ_WORDS}", "< 5 bytes, cut short", f"> {READ_WORDS}"]


@on_wires
def test_a_pause_ends_half_a_frame_and_what_follows_is_read_afresh(clock: JumpingClock, framing: Framing) -> None:
    tap, frame = watched(clock, framing, 17), ENCODE[framing](17, ASKED)
    tap.tell(False, frame[:5])
    clock.pass_s(GAP_S)
    tap.tell(False, frame)
    half, whole = tap.take()
    assert (half.raw, whole.raw, whole.text) == (frame[:5], frame, READ_WORDS)
    assert half.text.startswith("5 bytes, ")


def test_babble_without_end_is_shown_in_portions(clock: JumpingClock) -> None:
    tap = watched(clock)
    for _ in range(30):
        tap.tell(False, b"\x00" * 100)
    seen = tap.take()
    assert [len(one.raw) for one in seen] == [1100, 1100]
    assert all(REST_MAX < len(one.raw) <= REST_MAX + 100 for one in seen)


# ------------------------------------------------------------------------------------------------ the end of it


def test_half_a_frame_ends_with_its_connection_and_the_next_begins_afresh(clock: JumpingClock) -> None:
    tap, frame = watched(clock, "tcp"), tcp(1, 17, ANSWER)
    tap.tell(False, frame[:9])
    tap.ended()
    tap.tell(False, frame)
    assert texts(tap.take()) == ["< 9 bytes, cut short", f"< {ANSWER_WORDS}"]


def test_nothing_is_kept_of_clients_that_are_gone(clock: JumpingClock) -> None:
    tap = watched(clock, "tcp", 17)
    for number in range(100):
        tap.tell(False, tcp(1, 17, ASKED)[:9], f"a:{number}")
        tap.ended(f"a:{number}")
    tap.ended("never seen")
    assert len(tap.take()) == 100
    assert tap._ear._talks == {}


# ------------------------------------------------------------------------------------------------ watching


def test_nothing_is_kept_while_nobody_watches(clock: JumpingClock) -> None:
    tap = Tap("rtu", clock, GAP_S)
    tap.tell(True, rtu(17, ASKED))
    tap.ended()
    undo = tap.watch()
    assert tap.take() == []
    tap.tell(True, rtu(17, ASKED))
    undo()
    tap.tell(True, rtu(17, WRITE))
    tap.watch()
    assert tap.take() == []
    assert tap.dropped == 0


def test_half_a_frame_of_an_earlier_look_does_not_show_in_the_next(clock: JumpingClock) -> None:
    tap, frame = Tap("tcp", clock, GAP_S), tcp(1, 17, ANSWER)
    undo = tap.watch()
    tap.tell(False, frame[:9])
    assert tap.take() == []
    undo()
    tap.watch()
    tap.tell(False, frame)
    assert texts(tap.take()) == [f"< {ANSWER_WORDS}"]


def test_the_watcher_is_woken_once_until_it_has_looked(clock: JumpingClock) -> None:
    tap, woken = Tap("rtu", clock, GAP_S), []
    undo = tap.watch(lambda: woken.append(clock.monotonic()))
    tap.tell(True, rtu(17, ASKED))
    tap.tell(False, rtu(17, ANSWER))
    assert len(woken) == 1
    tap.take()
    tap.tell(True, rtu(17, ASKED))
    assert len(woken) == 2
    undo()
    tap.tell(False, rtu(17, ANSWER))
    assert len(woken) == 2


def test_two_may_watch_and_each_leaves_on_its_own(clock: JumpingClock) -> None:
    tap, woken = Tap("rtu", clock, GAP_S), []
    both: Callable[[], None] = lambda: woken.append(1)  # noqa: E731 - one and the same for both
    first, second = tap.watch(both), tap.watch(both)
    tap.tell(True, rtu(17, ASKED))
    assert len(woken) == 2
    first()
    first()
    assert tap.is_watched
    assert len(tap.take()) == 1
    tap.tell(True, rtu(17, ASKED))
    assert len(woken) == 3
    second()
    assert not tap.is_watched


def test_what_finds_no_room_is_dropped_and_counted(clock: JumpingClock) -> None:
    tap = watched(clock)
    for _ in range(CHUNKS_MAX + 7):
        tap.tell(True, rtu(17, ASKED))
    assert tap.dropped == 7
    assert len(tap.take()) == CHUNKS_MAX
    tap.tell(True, rtu(17, ASKED))
    assert (len(tap.take()), tap.dropped) == (1, 7)


def test_room_is_counted_in_bytes_too(clock: JumpingClock) -> None:
    tap = watched(clock, "tcp", 17)
    requests = 1000 * tcp(1, 17, ASKED)
    for _ in range(4):
        tap.tell(False, requests)
    assert tap.dropped == 4 - BYTES_MAX // len(requests)
    assert len(tap.take()) == 2000
    tap.tell(False, requests)
    assert (len(tap.take()), tap.dropped) == (1000, 2)


def test_what_stands_before_and_behind_a_gap_is_not_joined(clock: JumpingClock) -> None:
    tap, frame = watched(clock, "tcp", 17), tcp(1, 17, ASKED)
    for _ in range(CHUNKS_MAX - 1):
        tap.tell(False, frame)
    tap.tell(False, frame[:9])
    tap.tell(False, frame[9:])  # no room
    tap.take()
    tap.tell(False, frame)
    assert texts(tap.take()) == ["< 9 bytes, cut short", f"< {READ_WORDS}"]


def test_a_count_begins_anew_with_each_look(clock: JumpingClock) -> None:
    tap = Tap("rtu", clock, GAP_S)
    undo = tap.watch()
    tap.tell(True, bytes(BYTES_MAX + 1))
    assert tap.dropped == 1
    undo()
    tap.watch()
    assert tap.dropped == 0


def test_a_wall_clock_that_jumps_between_does_not_disturb(clock: JumpingClock) -> None:
    tap, frame = watched(clock), rtu(17, ANSWER)
    tap.tell(False, frame[:5])
    clock.jump_wall(-1e6)
    tap.tell(False, frame[5:])
    assert [(one.text, one.when) for one in tap.take()] == [(ANSWER_WORDS, clock.wall())]


def test_a_line_that_talks_while_others_look_and_leave_loses_no_count() -> None:
    """The line's thread never stops; each look gives whole frames only, and in the end nothing is held."""
    tap, frame, stop = Tap("tcp", CLOCK, GAP_S, 17), tcp(1, 17, ASKED), threading.Event()

    def talk() -> None:
        while not stop.is_set():
            tap.tell(False, frame)

    line = threading.Thread(target=talk)
    line.start()
    try:
        for _ in range(50):
            woken = threading.Event()
            undo = tap.watch(woken.set)
            assert woken.wait(PATIENCE_S)
            assert {one.text for one in tap.take()} == {READ_WORDS}
            undo()
    finally:
        stop.set()
        line.join()
    tap.watch()()
    assert (len(tap._chunks), tap._told_bytes) == (0, tap._taken_bytes)


# ------------------------------------------------------------------------------------------------ on the screen


def a_line(columns: int, client: str = "", raw: bytes = rtu(17, ASKED), sent: bool = True) -> str:
    when = datetime(2024, 5, 6, 12, 3, 4, 123456).timestamp()  # local time, as a person's watch has it
    return Seen(when, sent, client, READ_WORDS, raw).line(columns)


def test_a_line_of_the_screen_has_local_time_direction_words_and_bytes() -> None:
    assert a_line(200) == f"12:03:04.123 > {READ_WORDS}  | 11 03 00 6B 00 03 76 87"
    assert a_line(200, "10.0.0.5:40232", sent=False).startswith(f"12:03:04.123 < 10.0.0.5:40232 {READ_WORDS}  | ")


@pytest.mark.parametrize("columns", [0, 1, 2, 3, 20, 79, 80, 82, 200])
def test_a_line_of_the_screen_is_cut_to_its_columns(columns: int) -> None:
    whole = a_line(1000)
    line = a_line(columns)
    assert len(line) == min(columns, len(whole))
    assert line == whole if columns >= len(whole) else line.endswith(".." if columns >= 2 else "." * columns)


def test_an_ascii_frame_is_shown_as_it_stands_and_bytes_that_only_begin_like_one_are_not() -> None:
    assert a_line(200, raw=ascii_frame(17, ASKED)).endswith("  | :1103006B00037E")
    assert a_line(200, raw=b":\xff").endswith("  | 3A FF")
    assert a_line(200, raw=b":\x1b[2J").endswith("  | 3A 1B 5B 32 4A")
    assert a_line(200, raw=b":\r\n").endswith("  | 3A 0D 0A")


CHUNKS = st.tuples(
    st.booleans(),
    st.one_of(
        st.binary(max_size=30), st.sampled_from([rtu(17, ASKED), ascii_frame(17, ANSWER), tcp(1, 17, WRITE), b":"])
    ),
    st.sampled_from(["", "a:1", "b:2"]),
    st.sampled_from([0.0, 0.125, 0.5]),
)


@given(
    framing=st.sampled_from(["rtu", "ascii", "tcp"]),
    unit=st.sampled_from([None, 17]),
    chunks=st.lists(CHUNKS, max_size=20),
    often=st.booleans(),
)
def test_every_byte_told_is_shown_once_and_in_order_whatever_is_said(
    framing: Framing, unit: int | None, chunks: list[tuple[bool, bytes, str, float]], often: bool
) -> None:
    clock = JumpingClock()
    tap = watched(clock, framing, unit)
    seen: list[Seen] = []
    for sent, data, client, pause_s in chunks:
        tap.tell(sent, data, client)
        clock.pass_s(pause_s)
        seen += tap.take() if often else []
    for client in ("", "a:1", "b:2"):
        tap.ended(client)
    seen += tap.take()
    for side in {(sent, client) for sent, _, client, _ in chunks}:
        told = b"".join(data for sent, data, client, _ in chunks if (sent, client) == side)
        assert b"".join(one.raw for one in seen if (one.sent, one.client) == side) == told
    assert all(re.fullmatch(r"[ -~]{1,80}", one.line(80)) for one in seen)
