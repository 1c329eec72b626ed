"""Flags and restarts: which tasks hang, which have ended by themselves, and when those are made anew (spec section 7).

What stops and changes do is in ``test_supervisor`` and ``test_supervisor_change``.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from functools import partial

import pytest

from gateway.clock import SystemClock
from gateway.link import Waker
from gateway.supervisor import GOOD_RUN_S, STOP_LIMIT_S, TICK_MOST_S, Plan, Supervisor
from tests.fakes import JumpingClock
from tests.lines import PATIENCE_S
from tests.tasks import Deaf, Obedient, RunningSupervisor, Tasks, Working, running

TIMEOUT_S = 5.0
SHORT_S = 0.5  # for the real clock
MACHINE_S = 1.0  # that others may have the processor; how soon it is exactly, `tests/system/test_hangs.py` tells


class Watched:
    """A supervisor of obedient tasks on a clock that jumps; ``hung``: what it was told to be hanging, each time."""

    def __init__(self, clock: JumpingClock, *names: str, timeout_s: float = TIMEOUT_S) -> None:
        self.tasks = Tasks()
        self.clock = clock
        self.hung: list[list[str]] = []
        self.supervisor = Supervisor([self.plan(name) for name in names], clock, timeout_s)
        self.supervisor.hung = self.hung.append

    def plan(self, name: str, basis: object = 0, enabled: bool = True) -> Plan:
        return self.tasks.plan(name, basis, enabled, Obedient)

    def raise_flags(self, *names: str) -> None:
        for name in names:
            self.tasks.obedient(name).raise_flag()

    def run_s(self, run: RunningSupervisor, seconds: float, *names: str) -> None:
        """Let time pass; the tasks of these *names* get on with something each second."""
        for _ in range(round(seconds)):
            self.clock.pass_s(1.0)
            self.raise_flags(*names)
            run.look()


# ------------------------------------------------------------------------------------------------ hangs


def test_a_task_whose_flag_stays_down_hangs_and_one_that_goes_on_does_not(clock: JumpingClock) -> None:
    it = Watched(clock, "still", "well")
    with running(it.supervisor) as run:
        it.raise_flags("still", "well")
        it.run_s(run, TIMEOUT_S, "well")
        assert it.hung == []  # not for longer than the timeout
        clock.pass_s(0.1)
        run.look()
        assert it.hung
        assert all(names == ["still"] for names in it.hung)
        assert it.supervisor.hanging() == ["still"]


def test_a_task_that_gets_on_after_all_hangs_no_more(clock: JumpingClock) -> None:
    it = Watched(clock, "still")
    with running(it.supervisor) as run:
        clock.pass_s(TIMEOUT_S + 0.1)
        it.raise_flags("still")
        run.look()
        it.hung.clear()
        run.look()
        assert (it.hung, it.supervisor.hanging()) == ([], [])


def test_all_that_hang_are_named_at_once(clock: JumpingClock) -> None:
    it = Watched(clock, "a", "well", "b")
    with running(it.supervisor) as run:
        clock.pass_s(TIMEOUT_S + 0.1)
        it.raise_flags("well")
        run.look()
        assert it.hung[-1] == ["a", "b"]


@pytest.mark.parametrize("kind", [Deaf, Working])
def test_a_hang_is_noticed_within_the_timeout_and_one_tick(kind: type[Working]) -> None:
    """One that has never raised its flag, and one that has, once."""
    tasks, clock, is_told = Tasks(), SystemClock(), threading.Event()
    supervisor = Supervisor([tasks.plan("still", kind=kind)], clock, SHORT_S)
    told_s: list[float] = []

    def hung(names: list[str]) -> None:
        told_s.append(clock.monotonic())
        is_told.set()

    supervisor.hung = hung
    began_s = clock.monotonic()
    with running(supervisor):
        assert is_told.wait(PATIENCE_S)
        tasks.let_go()
    assert SHORT_S <= told_s[0] - began_s <= SHORT_S + supervisor.tick_s + MACHINE_S


def test_a_task_has_the_whole_timeout_for_its_first_flag_also_when_it_is_made_anew(clock: JumpingClock) -> None:
    it = Watched(clock, "weak")
    with running(it.supervisor) as run:
        it.run_s(run, TIMEOUT_S - 1.0)
        it.tasks.obedient("weak").fail(ZeroDivisionError())
        it.run_s(run, TIMEOUT_S + 1.0)  # it is made anew after one of them
        assert len(it.tasks.made) == 2
        assert it.hung == []
        it.run_s(run, 1.0)
        assert it.hung[0] == ["weak"]


def test_a_task_that_waits_to_be_made_anew_does_not_hang(clock: JumpingClock) -> None:
    it = Watched(clock, "weak")
    with running(it.supervisor) as run:
        for _ in range(6):  # until the wait is longer than the timeout
            it.tasks.obedient("weak").fail(ZeroDivisionError())
            count = len(it.tasks.made)
            while len(it.tasks.made) == count:
                it.run_s(run, 1.0)
        assert it.hung == []


def test_a_timeout_that_is_set_while_it_runs_is_heeded(clock: JumpingClock) -> None:
    it = Watched(clock, "still", timeout_s=60.0)
    with running(it.supervisor) as run:
        it.run_s(run, 3.0)
        run.do(lambda: setattr(it.supervisor, "timeout_s", 2.0))
        run.look()
        assert it.hung[0] == ["still"]


def test_a_task_told_to_stop_that_does_not_is_named_until_it_ends(clock: JumpingClock) -> None:
    it = Watched(clock)
    with running(it.supervisor) as run:
        run.change([it.tasks.plan("deaf", kind=Deaf), it.plan("well")])
        assert it.tasks.made[0].ready.wait(PATIENCE_S)
        assert it.supervisor.leaving == []
        run.change([it.plan("well")])
        assert it.supervisor.leaving == ["deaf"]
        run.look()
        assert it.hung == []
        it.run_s(run, TIMEOUT_S + 1.0, "well")
        assert it.hung[0] == it.supervisor.hanging() == ["deaf"]
        it.tasks.let_go()
        run.look()
        it.hung.clear()
        run.look()
        assert (it.hung, it.supervisor.hanging()) == ([], [])
        run.change([it.plan("well")])
        assert it.supervisor.leaving == []


def test_a_task_that_does_not_stop_at_the_end_is_left_named(clock: JumpingClock) -> None:
    it = Watched(clock)
    with running(it.supervisor) as run:
        run.change([it.tasks.plan("deaf", kind=Deaf), it.plan("well")])
        assert it.tasks.made[0].ready.wait(PATIENCE_S)
    assert (run.was_clean, it.supervisor.leaving) == (False, ["deaf"])
    it.tasks.let_go()


def test_whoever_watches_is_told_before_tasks_are_stopped_by_a_change_and_by_the_end(clock: JumpingClock) -> None:
    it = Watched(clock)
    it.supervisor.before_stops = lambda: it.tasks.told.append(f"stops; the end: {it.supervisor.is_stopping}")
    with running(it.supervisor) as run:
        run.change(it.tasks.plans("a"))
        run.change([it.tasks.plan("a", basis=1)])
        assert it.tasks.made[1].ready.wait(PATIENCE_S)
    before_change, before_end = "stops; the end: False", "stops; the end: True"
    assert it.tasks.told == [
        *(before_change, "a made"),
        *(before_change, "a stopped", "a made"),
        *(before_end, "a stopped"),
    ]


@pytest.mark.parametrize(("timeout_s", "tick_s"), [(1.0, 0.1), (2.0, 0.2), (10.0, 1.0), (86400.0, TICK_MOST_S)])
def test_flags_are_looked_at_ten_times_in_a_timeout_and_once_a_second_at_least(timeout_s: float, tick_s: float) -> None:
    assert Supervisor([], SystemClock(), timeout_s).tick_s == pytest.approx(tick_s)


def test_it_looks_around_at_each_tick_by_itself() -> None:
    looks, clock = threading.Semaphore(0), SystemClock()
    supervisor = Supervisor([], clock, SHORT_S)

    def chore() -> float:
        looks.release()
        return 3600.0

    supervisor.chores.append(chore)
    with running(supervisor):
        began_s = clock.monotonic()
        for _ in range(5):
            assert looks.acquire(timeout=PATIENCE_S)
        assert clock.monotonic() - began_s < 6 * supervisor.tick_s + MACHINE_S


# ------------------------------------------------------------------------------------------------ ends


ENDS: dict[str, Callable[[Obedient], None]] = {
    "error": lambda task: task.fail(ZeroDivisionError("a bug")),
    "SystemExit": lambda task: task.fail(SystemExit(0)),
    "KeyboardInterrupt": lambda task: task.fail(KeyboardInterrupt()),
    "return": lambda task: task.leave(),
}


@pytest.mark.parametrize("end", ENDS.values(), ids=ENDS)
def test_a_task_that_ends_without_being_told_to_is_made_anew_and_the_others_feel_nothing(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture, end: Callable[[Obedient], None]
) -> None:
    it = Watched(clock, "weak", "well")
    with running(it.supervisor) as run:
        it.raise_flags("weak", "well")
        well = it.tasks.obedient("well")
        end(it.tasks.obedient("weak"))
        assert list(it.supervisor.tasks) == ["well"]
        assert (it.supervisor.crashes, it.supervisor.failed_s) == ({"weak": 1}, clock.monotonic())
        it.run_s(run, 1.0, "well")
        assert [task.name for task in it.tasks.made] == ["weak", "well", "weak"]
        it.raise_flags("weak")
        assert it.tasks.obedient("well") is well
    assert run.was_clean
    assert "weak: ended with an error; starting it again in 1 s" in caplog.text


def test_a_task_that_only_returns_is_said_to_have_done_so(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    it = Watched(clock, "weak")
    with running(it.supervisor):
        it.tasks.obedient("weak").leave()
    assert "it has ended without being told to" in caplog.text


def test_crashes_are_counted_and_waits_grow_until_a_good_run_ends_both(clock: JumpingClock) -> None:
    it = Watched(clock, "weak", "well", timeout_s=3600.0)
    with running(it.supervisor) as run:
        assert waits_s(it, run, 4) == [1, 2, 4, 8]
        assert it.supervisor.crashes == {"weak": 4}
        it.run_s(run, GOOD_RUN_S - 1.0)
        assert it.supervisor.crashes == {"weak": 4}
        it.run_s(run, 1.0)
        assert it.supervisor.crashes == {}
        assert waits_s(it, run, 8) == [1, 2, 4, 8, 16, 32, 60, 60]


def test_a_run_that_was_not_good_ends_neither(clock: JumpingClock) -> None:
    it = Watched(clock, "weak", timeout_s=3600.0)
    with running(it.supervisor) as run:
        assert waits_s(it, run, 2) == [1, 2]
        it.run_s(run, GOOD_RUN_S - 2.0)
        assert waits_s(it, run, 1) == [4]


def test_what_cannot_be_made_is_a_crash_too(clock: JumpingClock) -> None:
    it, tried_s = Watched(clock), []

    def fail(waker: Waker) -> Working:
        tried_s.append(clock.monotonic())
        raise ZeroDivisionError("a bug")

    with running(it.supervisor) as run:
        run.change([Plan("unborn", fail)])
        it.run_s(run, 7.0)
        assert it.supervisor.crashes == {"unborn": 4}
        assert it.hung == []
    assert [s - tried_s[0] for s in tried_s] == [0, 1, 3, 7]


def waits_s(it: Watched, run: RunningSupervisor, crashes: int) -> list[int]:
    """Have "weak" crash so often; return after how many seconds it was made anew each time."""
    found = []
    for _ in range(crashes):
        before = it.tasks.obedient("weak")
        before.fail(ZeroDivisionError("a bug"))
        found.append(0)
        while it.tasks.obedient("weak") is before:
            it.run_s(run, 1.0)
            found[-1] += 1
            assert found[-1] < 100, "it is not made anew"
    return found


# ------------------------------------------------------------------------------------------------ what is logged


def a_bug() -> None:
    raise ZeroDivisionError("here")


def another_bug() -> None:
    raise ZeroDivisionError("there")


def error_of(bug: Callable[[], None]) -> BaseException:
    try:
        bug()
    except ZeroDivisionError as error:
        return error
    raise AssertionError


def test_a_traceback_is_logged_once_for_each_cause_and_then_counted(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    it = Watched(clock, "weak", timeout_s=3600.0)
    with running(it.supervisor) as run:
        for bug in (a_bug, a_bug, another_bug, a_bug, another_bug):
            it.tasks.obedient("weak").fail(error_of(bug))
            it.run_s(run, 60.0)
    assert [bool(record.exc_info) for record in caplog.records] == [True, False, True, False, False]
    assert caplog.messages == [
        "weak: ended with an error; starting it again in 1 s",
        "weak: ended with the same error, 2 times by now: ZeroDivisionError('here')",
        "weak: ended with an error; starting it again in 4 s",
        "weak: ended with the same error, 3 times by now: ZeroDivisionError('here')",
        "weak: ended with the same error, 2 times by now: ZeroDivisionError('there')",
    ]
    assert caplog.text.count("in a_bug") == caplog.text.count("in another_bug") == 1


def test_the_same_fault_with_other_words_is_the_same_cause(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    it = Watched(clock, "weak", timeout_s=3600.0)

    def bug(number: int) -> None:
        raise ZeroDivisionError(f"{number} by zero")

    with running(it.supervisor) as run:
        for number in range(3):
            it.tasks.obedient("weak").fail(error_of(partial(bug, number)))
            it.run_s(run, 4.0)
    assert [bool(record.exc_info) for record in caplog.records] == [True, False, False]


# ------------------------------------------------------------------------------------------------ at the start


def test_flags_are_up_once_each_task_has_got_on_with_something(clock: JumpingClock) -> None:
    it = Watched(clock, "a", "b")
    with running(it.supervisor):
        assert not it.supervisor.are_flags_up
        it.raise_flags("a")
        assert not it.supervisor.are_flags_up
        it.raise_flags("b")
        assert it.supervisor.are_flags_up


def test_what_waits_to_be_made_anew_is_not_waited_for_but_what_was_is(clock: JumpingClock) -> None:
    it = Watched(clock, "a", "weak")
    with running(it.supervisor) as run:
        it.tasks.obedient("a").ready.set()
        it.raise_flags("a")
        assert (it.supervisor.are_flags_up, it.supervisor.are_ready) == (False, False)
        it.tasks.obedient("weak").fail(ZeroDivisionError())
        assert (it.supervisor.are_flags_up, it.supervisor.are_ready) == (True, True)
        it.run_s(run, 1.0)
        assert (it.supervisor.are_flags_up, it.supervisor.are_ready) == (False, False)


def test_all_are_ready_once_each_has_its_line_or_has_said_why_not(clock: JumpingClock) -> None:
    it = Watched(clock, "a", "b")
    with running(it.supervisor):
        it.raise_flags("a", "b")
        for name in ("a", "b"):
            assert not it.supervisor.are_ready
            it.tasks.obedient(name).ready.set()
        assert it.supervisor.are_ready


def test_when_the_last_one_becomes_ready_nobody_waits_for_the_next_tick(clock: JumpingClock) -> None:
    it = Watched(clock, "a", "b", timeout_s=86400.0)
    is_seen, ticks = threading.Event(), threading.Semaphore(0)

    def chore() -> float:
        if it.supervisor.are_ready:
            is_seen.set()
        ticks.release()
        return 3600.0

    it.supervisor.chores.append(chore)
    with running(it.supervisor) as run:
        it.tasks.obedient("a").ready.set()
        it.raise_flags("a")
        run.look()
        while ticks.acquire(blocking=False):
            pass
        assert ticks.acquire(timeout=PATIENCE_S)  # the next tick is a whole one away
        assert not is_seen.is_set()
        it.tasks.obedient("b").ready.set()
        it.raise_flags("b")
        assert is_seen.wait(TICK_MOST_S / 2)


def test_a_task_whose_plan_is_switched_off_starts_so_and_again_after_a_crash(clock: JumpingClock) -> None:
    it = Watched(clock)
    with running(it.supervisor) as run:
        run.change([it.plan("weak", enabled=False), it.plan("well")])
        it.tasks.obedient("weak").fail(ZeroDivisionError())
        it.run_s(run, 1.0)
        assert it.tasks.told == ["weak made", "weak off", "well made", "weak made", "weak off"]
        run.change([it.plan("weak"), it.plan("well")])
        it.tasks.obedient("weak").fail(ZeroDivisionError())
        it.run_s(run, 2.0)
        assert it.tasks.told[5:] == ["weak on", "weak made"]


def test_the_limit_of_a_stop_is_under_two_seconds() -> None:
    assert STOP_LIMIT_S < 2.0  # spec section 7


def test_the_tasks_of_a_supervisor_that_is_over_hang_no_more(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    it = Watched(clock, "a")
    with caplog.at_level(logging.ERROR), running(it.supervisor) as run:
        it.raise_flags("a")
    clock.pass_s(2 * TIMEOUT_S)
    assert (run.was_clean, it.supervisor.hanging(), caplog.messages) == (True, [], [])
