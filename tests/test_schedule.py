"""Whose turn it is: in turn, each when due, none starved, at the same cost for many as for few."""

from __future__ import annotations

import random
import sys
from collections import Counter
from collections.abc import Callable
from types import FrameType
from typing import Any

import pytest

from gateway.schedule import Schedule


def turn(schedule: Schedule, now_s: float, among: int = -1) -> int | None:
    """Pick and send; return which."""
    index = schedule.pick(now_s, among)
    if index is not None:
        schedule.sent(index, now_s)
    return index


def turns(schedule: Schedule, now_s: float) -> list[int]:
    """Send all that is due now; return which, in order."""
    sent = []
    while (index := turn(schedule, now_s)) is not None:
        sent.append(index)
    return sent


def test_requests_never_sent_are_all_due_at_once_in_order() -> None:
    assert turns(Schedule([5.0, 1.0, 3.0]), 100.0) == [0, 1, 2]


def test_without_requests_nothing_is_ever_due() -> None:
    schedule = Schedule([])
    assert schedule.pick(100.0) is None
    assert schedule.next_due_s() is None


def test_a_request_is_due_again_exactly_one_cycle_later() -> None:
    schedule = Schedule([2.0])
    assert turn(schedule, 100.0) == 0
    assert schedule.next_due_s() == 102.0
    assert schedule.pick(101.9) is None
    assert schedule.pick(102.0) == 0


def test_the_turn_goes_on_from_the_one_after_the_last_sent() -> None:
    schedule = Schedule([1.0] * 4)
    assert turns(schedule, 100.0) == [0, 1, 2, 3]
    assert [turn(schedule, 101.0), turn(schedule, 101.0)] == [0, 1]
    assert turns(schedule, 102.0) == [2, 3, 0, 1]


def test_a_request_due_before_the_last_sent_waits_for_those_after_it() -> None:
    schedule = Schedule([1.0, 10.0, 10.0])
    assert turn(schedule, 100.0) == 0
    assert turn(schedule, 101.0) == 1  # 0 is due again, but it is the turn of those after it
    assert turn(schedule, 101.0) == 2
    assert turn(schedule, 101.0) == 0


def test_picking_alone_changes_nothing() -> None:
    schedule = Schedule([1.0, 1.0])
    assert [schedule.pick(100.0), schedule.pick(100.0)] == [0, 0]


def test_only_the_requests_of_the_mask_are_picked_and_the_others_stay_due() -> None:
    schedule = Schedule([1.0] * 4)
    assert turn(schedule, 100.0, among=0b1010) == 1
    assert turn(schedule, 100.0, among=0b1010) == 3
    assert turn(schedule, 100.0, among=0b1010) is None
    assert schedule.pick(100.0, among=0) is None
    assert turns(schedule, 100.0) == [0, 2]


@pytest.mark.parametrize(("late_s", "missed"), [(0.0, 0), (0.75, 0), (1.0, 1), (1.5, 1), (3.0, 3), (7.25, 7)], ids=str)
def test_cycles_missed_are_counted_not_queued(late_s: float, missed: int) -> None:
    schedule = Schedule([1.0])
    assert schedule.sent(0, 100.0) == 0
    assert schedule.sent(0, 101.0 + late_s) == missed
    assert schedule.pick(101.0 + late_s) is None


def test_a_request_sent_late_keeps_its_grid() -> None:
    schedule = Schedule([1.0])
    turn(schedule, 100.0)
    turn(schedule, 101.5)
    assert schedule.next_due_s() == 102.0
    turn(schedule, 105.25)
    assert schedule.next_due_s() == 106.0


def test_a_grid_does_not_drift_in_a_million_seconds() -> None:
    schedule = Schedule([0.25])
    turn(schedule, 0.0)
    turn(schedule, 1_000_000.1)
    assert schedule.next_due_s() == 1_000_000.25


def test_asked_for_at_once_a_request_is_due_now_and_begins_its_cycle_anew() -> None:
    schedule = Schedule([10.0, 10.0, 10.0])
    assert turns(schedule, 100.0) == [0, 1, 2]
    schedule.at_once(0b101)
    assert turn(schedule, 103.0) == 0
    assert schedule.sent(2, 104.0) == 0
    assert schedule.pick(109.9) is None
    assert schedule.pick(110.0) == 1
    schedule.sent(1, 110.0)
    assert schedule.pick(112.9) is None
    assert schedule.pick(113.0) == 0


def test_a_cycle_begun_anew_is_not_cut_short_by_the_old_one() -> None:
    schedule = Schedule([10.0])
    schedule.sent(0, 100.0)
    schedule.at_once(1)
    schedule.sent(0, 105.0)
    assert schedule.pick(110.0) is None
    assert schedule.pick(115.0) == 0


def test_no_request_is_starved_by_others_that_are_always_due() -> None:
    """Ten requests want every moment of the line; each gets its turn, whatever its cycle."""
    schedule = Schedule([0.01] * 9 + [0.5])
    sent: Counter[int | None] = Counter(turn(schedule, 100.0 + 0.1 * step) for step in range(1000))
    assert sum(sent.values()) == 1000
    assert all(sent[index] >= 100 for index in range(10))


@pytest.mark.parametrize("seed", range(5))
def test_between_two_turns_of_one_request_each_other_has_at_most_one(seed: int) -> None:
    """In turn: while a request waits, though it is due, no other is sent twice."""
    rng = random.Random(seed)
    schedule = Schedule([rng.choice([0.05, 0.3, 2.0]) for _ in range(12)])
    due_since: dict[int, list[int]] = {}
    now_s = 100.0
    for _ in range(3000):
        now_s += rng.choice([0.0, 0.01, 0.2])
        for index in range(12):
            if schedule.pick(now_s, 1 << index) is not None:
                due_since.setdefault(index, [])
        sent = turn(schedule, now_s)
        if sent is None:
            continue
        due_since.pop(sent)
        for others in due_since.values():
            others.append(sent)
            assert len(others) == len(set(others))


def lines_run(requests: int) -> int:
    """Count the lines of Python that 1000 turns of *requests* requests run, each due just once a round."""
    schedule = Schedule([1.0] * requests)
    turns(schedule, 100.0)
    lines = 0

    def count(frame: FrameType, event: str, arg: object) -> Callable[..., Any]:
        nonlocal lines
        lines += event == "line"
        return count

    before = sys.gettrace()
    sys.settrace(count)
    try:
        for step in range(1000):
            turn(schedule, 101.0 + step // requests)
    finally:
        sys.settrace(before)
    return lines


def test_1000_requests_are_picked_as_cheaply_as_10() -> None:
    assert lines_run(1000) <= 1.2 * lines_run(10)
