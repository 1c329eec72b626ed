"""How much is logged: no flood fills a flash card, and the log's end is true however little of it was told.

Lines that were held back are told with how many they stand for, so that none is ever lost uncounted.
"""

from __future__ import annotations

import gc
import logging
import re
import threading
import tracemalloc
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.logs import (
    AGAIN_S,
    ALL_BURST,
    BURST,
    CAUSES_MOST,
    LATE_AT_ONCE,
    LATE_BURST,
    LATE_PAUSE_S,
    REST_MOST,
    SETTLED_S,
    WORDINGS_MOST,
    LogRing,
    RateLimited,
    SafeFormatter,
)
from tests.fakes import SCADA, JumpingClock, MasterBench, reads


class Told(logging.Handler):
    """Every line that gets through; *during* is called while one is written."""

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(SafeFormatter())
        self.lines: list[str] = []
        self.during: Callable[[], object] = bool

    def emit(self, record: logging.LogRecord) -> None:
        self.during()
        self.lines += self.format(record).split("\n")


class Desk:
    """A logger, its limiter and what gets through, on a clock that jumps."""

    def __init__(self, clock: JumpingClock) -> None:
        self.clock = clock
        self.told = Told()
        self.limited = RateLimited(clock, [self.told])
        self.log = logging.Logger("test", logging.DEBUG)
        self.log.addHandler(self.limited)

    @property
    def lines(self) -> list[str]:
        return self.told.lines

    def new_lines(self) -> list[str]:
        lines, self.told.lines = self.told.lines, []
        return lines

    def pass_s(self, seconds: float) -> None:
        """Let time pass, and have the main thread look whenever it is due."""
        until_s = self.clock.monotonic() + seconds
        while True:
            wait_s = self.limited.flush_due()
            assert wait_s > 0
            left_s = until_s - self.clock.monotonic()
            if left_s <= 0:
                return
            self.clock.pass_s(min(wait_s, left_s))

    def settle(self) -> None:
        """A day without a line."""
        self.pass_s(86400.0)

    def spend(self, template: str, *args: object, **about: object) -> None:
        """Use up the burst of a cause."""
        for _ in range(BURST):
            self.log.warning(template, *args, **about)  # type: ignore[arg-type]  # extra= only
        self.new_lines()


@pytest.fixture
def desk(clock: JumpingClock) -> Iterator[Desk]:
    made = Desk(clock)
    yield made
    made.limited.close()


LATE = re.compile(r" \((told late, this was at \d\d-\d\d \d\d:\d\d:\d\d)?(; )?((\d+) more like it w\w+ left out)?\)$")


def left_out_of(line: str) -> int:
    found = LATE.search(line)
    return int(found[4] or 0) if found else 0


def bare(line: str) -> str:
    return LATE.sub("", line)


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


# ------------------------------------------------------------------------------------------------ storms


@pytest.mark.parametrize(("every_s", "most"), [(60.0, 0), (600.0, CAUSES_MOST)])
def test_storms_of_many_causes_are_no_more_than_two_lines_a_minute(desk: Desk, every_s: float, most: int) -> None:
    """*most*: what is told besides at first, where the storms pause for long enough to be over."""
    hours = 4
    for _ in range(int(hours * 3600 / every_s)):
        for number in range(500):
            desk.log.warning("%s: unit %d is offline", f"line {number // 200}", number)
        desk.pass_s(every_s)
    assert hours * 60 < len(desk.lines) <= ALL_BURST + LATE_BURST + most + hours * 120


def test_after_a_storm_all_that_waits_is_told_a_few_at_a_time(desk: Desk) -> None:
    for _ in range(2):
        for number in range(1000):
            desk.log.warning("%s: up", f"request {number}")
    assert len(desk.new_lines()) == ALL_BURST
    desk.pass_s(SETTLED_S - 1.0)
    assert desk.lines == []
    desk.clock.pass_s(1.0)
    assert desk.limited.flush_due() == LATE_PAUSE_S
    assert len(desk.lines) == LATE_AT_ONCE
    desk.pass_s(1000 / LATE_AT_ONCE * LATE_PAUSE_S)
    assert len(desk.lines) == 1000
    assert sum(1 + left_out_of(line) for line in desk.lines) == 2000 - ALL_BURST


def test_a_master_whose_wire_breaks_and_heals_for_hours_fills_no_flash_card(clock: JumpingClock) -> None:
    bench = MasterBench(
        clock,
        *(reads(1 + number // 5, number, name=f"r{number}", every=10.0) for number in range(200)),
        response_timeout=0.1,
        baudrate=115200,
    )
    every, desk = Told(), Desk(clock)
    log = logging.getLogger("gateway.master")
    before = log.level
    log.setLevel(logging.INFO)
    log.addHandler(every)
    log.addHandler(desk.limited)
    began_s = clock.monotonic()

    def meanwhile() -> None:
        is_broken = int((clock.monotonic() - began_s) / 30.0) % 2
        bench.field.silent = set(range(1, 41)) if is_broken else set()
        desk.limited.flush_due()

    try:
        bench.run_s(1800.0, meanwhile)
    finally:
        log.removeHandler(every)
        log.removeHandler(desk.limited)
        log.setLevel(before)
    desk.settle()
    assert len(every.lines) > 1000
    assert sum(1 + left_out_of(line) for line in desk.lines) == len(every.lines)
    assert len(desk.lines) < ALL_BURST + LATE_BURST + 60 + 2 * 240  # the last: each request and unit, at the end
    desk.limited.close()


@given(
    st.lists(
        st.tuples(st.sampled_from(range(70)), st.booleans(), st.sampled_from([0.0, 1.0, 59.0, 600.0])), max_size=400
    )
)
def test_whatever_comes_when_the_last_line_of_each_state_is_true_and_none_is_uncounted(
    events: list[tuple[int, bool, float]],
) -> None:
    desk, last = Desk(JumpingClock()), {}
    for _ in range(4):
        for unit, is_back, pause_s in events:
            template = "%s: unit %d is back" if is_back else "%s: unit %d is offline"
            desk.log.warning(template, "field", unit, extra={"about": unit})
            last[unit] = f"WARNING {template % ('field', unit)}"
            desk.pass_s(pause_s)
    desk.settle()
    told = {int(line.split()[3]): bare(line) for line in desk.lines}
    assert told == last
    assert sum(1 + left_out_of(line) for line in desk.lines) == 4 * len(events)
    desk.limited.close()


def test_causes_without_end_take_no_memory_without_end(desk: Desk) -> None:
    def storm(numbers: range) -> None:
        for number in numbers:
            desk.log.warning("%s is not allowed %d", f"{number} " + "x" * 9000, number)
            desk.log.warning(f"{number} " + "y" * 9000)  # worded too early: a template of its own

    storm(range(CAUSES_MOST + 100))
    tracemalloc.start()
    try:
        storm(range(10_000, 11_000))
        grown, _peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert grown < 500_000
    assert len(desk.lines) == ALL_BURST


def test_beyond_the_causes_that_are_known_the_wording_counts_and_then_anything(desk: Desk) -> None:
    for number in range(CAUSES_MOST):
        desk.log.warning("%s: up", f"host {number}")
    desk.settle()
    desk.new_lines()
    for number in range(CAUSES_MOST):  # all are known, and most have a line that waits
        desk.log.warning("%s: up", f"host {number}")
    for number in range(5):
        desk.log.warning("%s: down", f"stranger {number}")
    for number in range(WORDINGS_MOST + 4):
        desk.log.warning(f"wording {number}")  # worded too early: a template of its own
    desk.settle()
    others = [line for line in desk.lines if "host" not in line]
    assert len(others) == WORDINGS_MOST + 1
    assert {bare(line): left_out_of(line) for line in others if left_out_of(line)} == {
        "WARNING stranger 4: down": 4,
        f"WARNING wording {WORDINGS_MOST + 3}": 4,
    }


def test_who_is_long_quiet_makes_room_for_a_newcomer(desk: Desk) -> None:
    for number in range(CAUSES_MOST):
        desk.log.warning("%s: up", f"host {number}")
    desk.settle()
    desk.new_lines()
    for _ in range(BURST):
        desk.log.warning("%s: up", "newcomer")
        desk.log.warning("%s: up", "another")
    assert Counter(desk.lines) == {"WARNING newcomer: up": BURST, "WARNING another: up": BURST}


# ------------------------------------------------------------------------------------------------ tracebacks


def fail(text: str) -> None:
    raise ValueError(text)


def log_failure(desk: Desk, text: str) -> None:
    try:
        fail(text)
    except ValueError:
        desk.log.exception("%s: ended with an error", "field")


def test_a_traceback_is_told_once_and_again_only_where_it_differs_or_a_day_later(desk: Desk) -> None:
    log_failure(desk, "one")
    assert desk.lines[1] == "Traceback (most recent call last):"
    assert desk.new_lines()[-1] == "ValueError: one"
    desk.clock.pass_s(3600.0)
    log_failure(desk, "one")
    (line,) = desk.new_lines()
    assert re.fullmatch(r"ERROR field: ended with an error \(the traceback is that of \d\d-\d\d \d\d:\d\d:\d\d\)", line)
    log_failure(desk, "two")
    assert desk.new_lines()[-1] == "ValueError: two"
    desk.clock.pass_s(86400.0)
    log_failure(desk, "two")
    assert desk.new_lines()[-1] == "ValueError: two"


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
