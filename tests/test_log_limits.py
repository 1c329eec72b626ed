"""How much is logged: of each cause no more than is worth its place, and what is newest late rather than never."""

from __future__ import annotations

import gc
import logging
import re
import threading
import weakref
from collections import Counter
from collections.abc import Iterator
from datetime import datetime

import pytest

from gateway.logs import AGAIN_S, ALL_BURST, BURST, REST_MOST, SETTLED_S, LogRing, RateLimited
from tests.fakes import SCADA, JumpingClock
from tests.log_desk import Desk, Told, bare, left_out_of


@pytest.fixture
def desk(clock: JumpingClock) -> Iterator[Desk]:
    made = Desk(clock)
    yield made
    made.limited.close()


def test_ten_lines_of_a_cause_are_told_at_once_then_one_in_ten_minutes_with_how_many_were_left_out(desk: Desk) -> None:
    for _ in range(BURST + 36):
        desk.log.warning("%s: %s", "field", "no reply")
    assert desk.new_lines() == ["WARNING field: no reply"] * BURST
    desk.clock.pass_s(AGAIN_S - 0.5)
    desk.log.warning("%s: %s", "field", "no reply")
    assert desk.new_lines() == []
    desk.clock.pass_s(0.5)
    desk.log.warning("%s: %s", "field", "no reply")
    desk.log.warning("%s: %s", "field", "no reply")
    assert desk.new_lines() == ["WARNING field: no reply (37 more like it were left out)"]
    desk.clock.pass_s(AGAIN_S)
    desk.log.warning("%s: %s", "field", "no reply")
    assert desk.new_lines() == ["WARNING field: no reply (1 more like it was left out)"]
    desk.clock.pass_s(AGAIN_S)
    desk.log.warning("%s: %s", "field", "no reply")
    assert desk.new_lines() == ["WARNING field: no reply"]


def test_what_was_quiet_for_long_gets_its_whole_burst_again_and_no_more(desk: Desk) -> None:
    desk.spend("%s: up", "field")
    desk.clock.pass_s(30 * AGAIN_S)
    for _ in range(2 * BURST):
        desk.log.warning("%s: up", "field")
    assert len(desk.lines) == BURST


@pytest.mark.parametrize(
    ("template", "args"),
    [
        ("%s: unit %d is offline: %s", ("yard", 5, "no reply")),  # another line
        ("%s: unit %d is offline: %s", ("field", 6, "no reply")),  # another unit
        ("%s: unit %d is back", ("field", 5)),  # another wording
    ],
)
def test_another_name_unit_or_wording_is_another_cause(desk: Desk, template: str, args: tuple[object, ...]) -> None:
    desk.spend("%s: unit %d is offline: %s", "field", 5, "no reply")
    desk.log.warning(template, *args)
    assert desk.new_lines() == ["WARNING " + template % args]


def test_the_same_words_of_another_module_are_another_cause(desk: Desk) -> None:
    desk.spend("%s: up", "field")
    other = logging.Logger("other")
    other.addHandler(desk.limited)
    other.warning("%s: up", "field")
    assert desk.new_lines() == ["WARNING field: up"]


@pytest.mark.parametrize(
    ("template", "args"),
    [
        ("%s: unit %d is offline: %s", ("field", 5, "damaged reply")),  # another reason
        ("%s: unit %d is offline: %s", ("field", 5, "")),
    ],
)
def test_another_reason_is_no_other_cause(desk: Desk, template: str, args: tuple[object, ...]) -> None:
    desk.spend("%s: unit %d is offline: %s", "field", 5, "no reply")
    desk.log.warning(template, *args)
    assert desk.new_lines() == []


def test_lines_about_the_same_are_one_cause_whatever_their_words_and_their_module(desk: Desk) -> None:
    other = logging.Logger("other")
    other.addHandler(desk.limited)
    for number in range(BURST):
        desk.log.warning("%s: ended %d times", "field", number, extra={"about": "field"})
    other.warning("%s: works again", "field", extra={"about": "field"})
    desk.log.warning("%s: works again", "field", extra={"about": "yard"})
    assert len(desk.new_lines()) == BURST + 1
    desk.settle()
    assert [bare(line) for line in desk.lines] == ["WARNING field: works again"]


def test_a_number_at_the_beginning_of_a_line_is_no_name(desk: Desk) -> None:
    for number in range(3 * BURST):
        desk.log.warning("%d bytes lost", number)
        desk.log.warning("%.1f s lost, %d times", number / 3, number)
    assert len(desk.lines) == 2 * BURST


def test_a_name_may_be_anything_that_has_words_and_a_line_may_have_none(desk: Desk) -> None:
    for _ in range(2 * BURST):
        desk.log.warning("%s: up", SCADA)
        desk.log.warning("%(name)s: up", {"name": "field"})
        desk.log.warning("up")
    assert Counter(desk.lines) == {f"WARNING {SCADA.name}: up": BURST, "WARNING field: up": BURST, "WARNING up": BURST}


def test_debug_critical_and_what_says_so_is_never_held_back(desk: Desk) -> None:
    for _ in range(5 * BURST):
        desk.log.debug("asked for")
        desk.log.critical("the end")
        desk.log.warning("stack", extra={"is_unlimited": True})
        desk.log.warning("limited", extra={"is_unlimited": False})
    assert Counter(desk.lines) == {
        "DEBUG asked for": 5 * BURST,
        "CRITICAL the end": 5 * BURST,
        "WARNING stack": 5 * BURST,
        "WARNING limited": BURST,
    }


def test_a_handler_that_wants_less_gets_less(clock: JumpingClock, desk: Desk) -> None:
    desk.told.setLevel(logging.ERROR)
    desk.log.warning("w")
    desk.log.error("e")
    assert desk.new_lines() == ["ERROR e"]
    desk.limited.addFilter(lambda record: record.msg != "unwanted")
    desk.log.error("unwanted")
    desk.log.error("wanted")
    assert desk.new_lines() == ["ERROR wanted"]


# ------------------------------------------------------------------------------------------------ told late


def flap(desk: Desk, is_back: bool) -> None:
    about = {"about": "field: unit 5"}
    if is_back:
        desk.log.warning("%s: unit %d is back", "field", 5, extra=about)
    else:
        desk.log.warning("%s: unit %d is offline: %s", "field", 5, "no reply", extra=about)


@pytest.mark.parametrize("last", [False, True])
def test_a_device_that_flapped_for_a_day_ends_in_the_log_as_it_is(desk: Desk, last: bool) -> None:
    for _ in range(1440):
        flap(desk, not last)
        desk.pass_s(30.0)
        flap(desk, last)
        desk.pass_s(30.0)
    assert BURST + 130 < len(desk.lines) < BURST + 150
    for _ in range(2):  # one of these may be told at once, the last is not
        flap(desk, not last)
        flap(desk, last)
    desk.new_lines()
    desk.pass_s(SETTLED_S)
    (line,) = desk.lines
    words = "unit 5 is back" if last else "unit 5 is offline: no reply"
    assert bare(line) == f"WARNING field: {words}"
    assert left_out_of(line) > 0
    desk.settle()
    assert len(desk.lines) == 1


def test_a_late_line_says_when_it_happened(desk: Desk) -> None:
    desk.spend("%s: up", "field")
    record = logging.LogRecord("test", logging.INFO, "", 0, "%s: up", ("field",), None)
    record.created = datetime(2024, 2, 29, 23, 59, 58).timestamp()
    desk.limited.handle(record)
    desk.pass_s(SETTLED_S)
    assert desk.lines == ["INFO field: up (told late, this was at 02-29 23:59:58)"]


def test_in_the_ring_a_late_line_stands_at_the_time_it_was_told(clock: JumpingClock) -> None:
    ring = LogRing()
    limited = RateLimited(clock, [ring])
    for _ in range(BURST + 1):
        limited.handle(logging.LogRecord("test", logging.INFO, "", 0, "up", None, None))
    clock.pass_s(SETTLED_S)
    limited.flush_due()
    assert ring.lines()[-1].startswith(
        datetime.fromtimestamp(clock.wall()).strftime("%m-%d %H:%M:%S INFO up (told late")
    )
    limited.close()


def test_a_line_is_told_late_only_once_its_cause_is_quiet(desk: Desk) -> None:
    desk.spend("%s: up", "field")
    for number in range(5):
        desk.log.warning("%s: up", "field")
        assert desk.limited.flush_due() == SETTLED_S, number
        desk.clock.pass_s(60.0)
    assert desk.limited.flush_due() == SETTLED_S - 60.0
    assert desk.lines == []
    desk.clock.pass_s(SETTLED_S - 60.0)
    assert desk.limited.flush_due() == SETTLED_S
    assert [left_out_of(line) for line in desk.lines] == [4]


def test_a_newer_line_takes_the_place_of_what_waits(desk: Desk) -> None:
    desk.spend("%s: %s", "field", "a")
    desk.log.warning("%s: %s", "field", "b")
    desk.clock.pass_s(AGAIN_S)
    desk.log.warning("%s: %s", "field", "c")
    desk.settle()
    assert desk.lines == ["WARNING field: c (1 more like it was left out)"]


def test_a_newer_line_never_overtakes_a_late_one_that_is_being_written(desk: Desk) -> None:
    desk.spend("%s: %s", "field", "a")
    desk.log.warning("%s: %s", "field", "offline")
    desk.clock.pass_s(2 * AGAIN_S)  # there is enough for two
    desk.told.during = lambda: desk.log.warning("%s: %s", "field", "back")
    desk.limited.flush_due()
    desk.told.during = bool
    desk.settle()
    assert [bare(line) for line in desk.lines] == ["WARNING field: offline", "WARNING field: back"]


def test_a_late_line_is_one_of_those_that_its_cause_has(desk: Desk) -> None:
    desk.spend("%s: up", "field")
    desk.log.warning("%s: up", "field")
    desk.pass_s(SETTLED_S)
    assert len(desk.new_lines()) == 1
    desk.log.warning("%s: up", "field")
    assert desk.new_lines() == []
    desk.clock.pass_s(AGAIN_S)
    desk.log.warning("%s: up", "field")
    assert desk.new_lines() == ["WARNING field: up (1 more like it was left out)"]


def test_late_lines_are_told_in_the_order_they_happened(desk: Desk) -> None:
    for name in "abcd":
        desk.spend("%s: up", name)
    for name in "abcdbca":
        desk.log.warning("%s: up", name)
        desk.clock.pass_s(1.0)
    desk.settle()
    assert [line.split()[1] for line in desk.lines] == ["d:", "b:", "c:", "a:"]


def test_clocks_that_are_set_trip_nothing(desk: Desk, clock: JumpingClock) -> None:
    desk.spend("up")
    desk.log.warning("up")
    for seconds in (-1.6e9, 3.2e9):
        clock.jump_wall(seconds)
        desk.log.warning("up")
        assert desk.limited.flush_due() == SETTLED_S
    assert desk.lines == []


# ------------------------------------------------------------------------------------------------ tracebacks


def fail(text: str) -> None:
    raise ValueError(text)


def log_failure(desk: Desk, text: str) -> None:
    try:
        fail(text)
    except ValueError:
        desk.log.exception("%s: ended with an error", "field")


def test_the_traceback_of_a_late_line_is_told_with_it(desk: Desk) -> None:
    for number in range(BURST + 3):
        log_failure(desk, f"number {number}")
    desk.new_lines()
    desk.settle()
    assert bare(desk.lines[0]) == "ERROR field: ended with an error"
    assert left_out_of(desk.lines[0]) == 2
    assert desk.lines[-1] == f"ValueError: number {BURST + 2}"


def test_what_waits_holds_on_to_nothing_of_the_program(desk: Desk) -> None:
    class Frame:
        """Something that a traceback would keep alive."""

    def die(held: Frame) -> None:
        raise ValueError(type(held).__name__)

    seen = []
    for _ in range(BURST + 1):
        thing = Frame()
        seen.append(weakref.ref(thing))
        try:
            die(thing)
        except ValueError:
            desk.log.exception("%s: ended", "field", extra={"thing": thing})
        del thing
    gc.collect()
    assert [ref() for ref in seen] == [None] * (BURST + 1)


# ------------------------------------------------------------------------------------------------ when things go wrong


class Unspeakable:
    """Something that cannot be put into words."""

    def __str__(self) -> str:
        raise ZeroDivisionError("a bug")


def test_what_cannot_be_worded_costs_neither_the_line_nor_the_one_who_logs(
    desk: Desk, capsys: pytest.CaptureFixture[str]
) -> None:
    for _ in range(2 * BURST):
        desk.log.warning("%d", "three")
        desk.log.warning("%s: up", Unspeakable())
    assert len(desk.lines) == 2 * BURST
    assert re.fullmatch(r"WARNING '%d' cannot be worded: TypeError \(test_log_limits.py, line \d+\)", desk.lines[0])
    assert desk.lines[1].startswith("WARNING '%s: up' cannot be worded: ZeroDivisionError (test_log_limits.py")
    assert capsys.readouterr().err == ""


class Failing(logging.Handler):
    """A handler with a bug."""

    def emit(self, record: logging.LogRecord) -> None:
        raise ZeroDivisionError("a bug")


def test_a_handler_that_fails_costs_the_others_nothing(clock: JumpingClock, capsys: pytest.CaptureFixture[str]) -> None:
    told = Told()
    limited = RateLimited(clock, [Failing(), told])
    limited.handle(logging.LogRecord("test", logging.INFO, "", 0, "up", None, None))
    assert told.lines == ["INFO up"]
    assert "ZeroDivisionError: a bug" in capsys.readouterr().err
    limited.close()


class BrokenClock(JumpingClock):
    """A clock that cannot be asked."""

    def monotonic(self) -> float:
        raise OSError("no such clock")


def test_even_a_bug_in_the_limiter_is_not_for_the_one_who_logs(capsys: pytest.CaptureFixture[str]) -> None:
    limited = RateLimited(BrokenClock(), [])
    limited.handle(logging.LogRecord("test", logging.INFO, "", 0, "up", None, None))
    assert "OSError: no such clock" in capsys.readouterr().err
    limited.close()


def test_nobody_waits_for_a_slow_handler_whose_line_is_held_back(desk: Desk) -> None:
    desk.spend("%s: up", "field")
    is_writing, may_end = threading.Event(), threading.Event()

    def write_slowly() -> None:
        is_writing.set()
        assert may_end.wait(10.0)

    desk.told.during = write_slowly
    thread = threading.Thread(target=desk.log.warning, args=("%s: slow", "yard"))
    thread.start()
    try:
        assert is_writing.wait(10.0)
        desk.log.warning("%s: up", "field")
        assert desk.limited.flush_due() == SETTLED_S
        assert not may_end.is_set()
        assert desk.lines == []
    finally:
        may_end.set()
        thread.join()
    assert desk.lines == ["WARNING yard: slow"]


def test_whoever_logs_from_a_finalizer_meets_no_closed_door(desk: Desk) -> None:
    class Clock(JumpingClock):
        """Asked within the limiter's lock, as a finalizer may run there."""

        def monotonic(self) -> float:
            if not told:
                told.append("once")
                desk.log.warning("%s: finalized", "socket")
            return super().monotonic()

    told: list[str] = []
    desk.limited._clock = Clock()
    thread = threading.Thread(target=desk.log.warning, args=("%s: up", "field"), daemon=True)
    thread.start()
    thread.join(5.0)
    desk.limited._lock = threading.RLock()  # one that waits for itself must not keep the test from ending
    assert sorted(desk.lines) == ["WARNING field: up", "WARNING socket: finalized"]


def test_many_threads_lose_no_line_uncounted(desk: Desk) -> None:
    def chatter(name: str) -> None:
        for number in range(1500):
            desk.log.warning("%s: %s", "field", f"{name} {number}")

    threads = [threading.Thread(target=chatter, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        desk.pass_s(AGAIN_S)
    for thread in threads:
        thread.join()
    desk.settle()
    assert sum(1 + left_out_of(line) for line in desk.lines) == 6000


# ------------------------------------------------------------------------------------------------ the end


def test_at_the_end_the_newest_of_what_waits_is_told_and_how_many_are_lost(desk: Desk) -> None:
    for _ in range(3):
        for number in range(ALL_BURST + REST_MOST + 7):
            desk.log.warning("%s: up", f"request {number}")
    desk.new_lines()
    desk.limited.tell_rest()
    *newest, lost = desk.new_lines()
    assert [bare(line) for line in newest] == [
        f"WARNING request {number}: up" for number in range(ALL_BURST + 7, ALL_BURST + 7 + REST_MOST)
    ]
    untold = 3 * (ALL_BURST + REST_MOST + 7) - ALL_BURST - sum(1 + left_out_of(line) for line in newest)
    assert lost == f"WARNING {untold} lines of the log were held back and are left out: the program ends"
    desk.limited.close()
    assert desk.lines == []


def test_when_logging_ends_what_waits_is_told(desk: Desk) -> None:
    desk.spend("%s: up", "field")
    desk.log.warning("%s: up", "field")
    desk.limited.close()
    assert [bare(line) for line in desk.lines] == ["WARNING field: up"]
