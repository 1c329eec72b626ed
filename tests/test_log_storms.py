"""Storms in the log: a broken wire of 1000 requests, or a thousand strangers, fill no flash card and no memory.

Lines that were held back are told with how many they stand for, so that none is ever lost uncounted.
"""

from __future__ import annotations

import logging
import tracemalloc
from collections import Counter
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.logs import (
    ALL_BURST,
    BURST,
    CAUSES_MOST,
    LATE_AT_ONCE,
    LATE_BURST,
    LATE_PAUSE_S,
    SETTLED_S,
    WORDINGS_MOST,
)
from tests.fakes import JumpingClock, MasterBench, reads
from tests.log_desk import Desk, Told, bare, left_out_of


@pytest.fixture
def desk(clock: JumpingClock) -> Iterator[Desk]:
    made = Desk(clock)
    yield made
    made.limited.close()


@pytest.mark.parametrize(("every_s", "most"), [(60.0, 0), (600.0, CAUSES_MOST)])
def test_storms_of_many_causes_are_no_more_than_two_lines_a_minute(desk: Desk, every_s: float, most: int) -> None:
    """*most*: what is told besides at first, where the storms pause for long enough to be over."""
    hours = 4
    for _ in range(int(hours * 3600 / every_s)):
        for number in range(500):
            desk.log.warning("%s: unit %d is offline", f"line {number // 200}", number)
        desk.pass_s(every_s)
    assert hours * 60 < len(desk.lines) <= ALL_BURST + LATE_BURST + most + hours * 120


def test_a_storm_of_slow_changes_leaves_enough_to_tell_how_it_ended(desk: Desk) -> None:
    hours = 8
    for minute in range(hours * 60):  # each of 900 changes every 15 minutes: it is quiet for long enough between
        for number in range(minute % 15, 900, 15):
            desk.log.warning("%s: %s", f"request {number}", f"minute {minute}")
        desk.pass_s(60.0)
    assert hours * 90 < len(desk.new_lines()) <= ALL_BURST + LATE_BURST + hours * 120
    desk.pass_s(SETTLED_S + 900 / LATE_AT_ONCE * LATE_PAUSE_S)
    told = {bare(line) for line in desk.lines}
    last = {number: max(m for m in range(hours * 60) if m % 15 == number % 15) for number in range(900)}
    assert len(told) > 400
    assert told <= {f"WARNING request {number}: minute {minute}" for number, minute in last.items()}
    desk.settle()
    assert len({bare(line) for line in desk.lines}) == len(told)


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
    tracemalloc.start()
    try:
        for number in range(CAUSES_MOST + 1000):
            desk.log.warning("%s is not allowed %d", f"{number} " + "x" * 9000, number)
            desk.log.warning(f"wording {number}")  # worded too early: a template of its own
        taken, _peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert taken < 8_000_000
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


def test_who_was_the_first_and_is_still_busy_keeps_nobody_out(desk: Desk) -> None:
    for number in range(CAUSES_MOST):
        desk.log.warning("%s: up", f"host {number}")
    desk.settle()
    desk.spend("%s: up", "host 0")
    for _ in range(BURST):
        desk.log.warning("%s: up", "newcomer")
        desk.log.warning("%s: up", "another")
    assert Counter(desk.lines) == {"WARNING newcomer: up": BURST, "WARNING another: up": BURST}


def test_a_cause_whose_line_waits_is_not_forgotten(desk: Desk) -> None:
    about = {"about": "field: unit 5"}
    busy = [f"busy {number}" for number in range(ALL_BURST // BURST)]
    for name in busy:
        desk.spend("%s: up", name)
    desk.log.warning("%s: unit %d is offline", "field", 5, extra=about)  # nothing is left to tell it with
    for name in [f"host {number}" for number in range(CAUSES_MOST - len(busy) - 1)] + busy:
        desk.log.warning("%s: up", name)
    desk.pass_s(60.0)
    desk.log.warning("%s: up", "newcomer")  # for whom there is no room: all have a line that waits
    desk.pass_s(60.0)
    desk.log.warning("%s: unit %d is back", "field", 5, extra=about)
    desk.settle()
    assert [bare(line) for line in desk.lines if "unit 5" in line] == ["WARNING field: unit 5 is back"]
