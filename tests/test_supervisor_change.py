"""A change while the supervisor runs: which tasks are stopped, which are made, and which notice nothing."""

from __future__ import annotations

import random
import threading
from pathlib import Path
from typing import Any

import pytest

from gateway.clock import SystemClock
from gateway.link import Waker
from gateway.supervisor import Plan, Supervisor, Task
from tests.fakes import JumpingClock
from tests.lines import PATIENCE_S, STOP_LIMIT_S
from tests.tasks import CrashingAtStop, Deaf, RunningSupervisor, Tasks, Working, running


def task(run: RunningSupervisor, name: str) -> Working:
    """Return the task of that name, at work."""
    found: Any = run.supervisor.tasks[name]
    assert isinstance(found, Working)
    assert found.ready.wait(PATIENCE_S)
    return found


def test_a_task_whose_basis_is_equal_stays_and_notices_nothing() -> None:
    tasks = Tasks()
    with running(Supervisor([tasks.plan("a", basis=["equal"])], SystemClock())) as run:
        before = task(run, "a")
        run.change([tasks.plan("a", basis=["equal"])])
        assert task(run, "a") is before
        assert tasks.told == ["a made"]


def test_only_the_task_whose_basis_differs_is_stopped_and_made_anew() -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("a", "b", "c"), SystemClock())) as run:
        a, b, c = (task(run, name) for name in "abc")
        run.change([tasks.plan("a"), tasks.plan("b", basis=1), tasks.plan("c")])
        assert (task(run, "a"), task(run, "c")) == (a, c)
        assert task(run, "b") is not b
        assert tasks.told[3:] == ["b stopped", "b made"]


def test_a_task_that_is_not_wanted_any_more_stops_and_one_of_a_new_name_starts() -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("a", "b"), SystemClock())) as run:
        run.change(tasks.plans("c", "b"))
        assert sorted(run.supervisor.tasks) == ["b", "c"]
        assert tasks.told[2:] == ["a stopped", "c made"]
        run.change([])
        assert run.supervisor.tasks == {}
    assert tasks.told[4:] in (["b stopped", "c stopped"], ["c stopped", "b stopped"])
    assert run.was_clean


def test_between_finds_the_old_tasks_ended_and_the_new_ones_not_made() -> None:
    tasks = Tasks()

    def between() -> None:
        living = {thread.name for thread in threading.enumerate()}
        tasks.told.append(f"of a and b lives: {', '.join(sorted(living & {'a', 'b'})) or 'none'}")

    with running(Supervisor(tasks.plans("a", "b", "c"), SystemClock())) as run:
        assert all(task(run, name) for name in "abc")
        run.change([tasks.plan("a", basis=1), tasks.plan("b", basis=1), tasks.plan("c")], between)
    ends = sorted(tasks.told[3:5])
    assert ends == ["a stopped", "b stopped"]
    assert tasks.told[5:8] == ["of a and b lives: none", "a made", "b made"]


def test_between_is_called_even_where_no_task_differs() -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("a"), SystemClock())) as run:
        run.change(tasks.plans("a"), lambda: tasks.told.append("between"))
        assert tasks.told == ["a made", "between"]


def test_a_task_is_switched_off_and_on_and_told_only_when_that_differs() -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("a"), SystemClock())) as run:
        before = task(run, "a")
        for enabled in (True, False, False, True, True):
            run.change([tasks.plan("a", enabled=enabled)])
            assert task(run, "a") is before
            assert before.enabled == enabled
        assert tasks.told == ["a made", "a off", "a on"]


def test_a_task_made_anew_starts_as_its_plan_says_it_is_switched() -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("a"), SystemClock())) as run:
        run.change([tasks.plan("a", basis=1, enabled=False)])
        assert not task(run, "a").enabled
        run.change([tasks.plan("a", basis=1)])
        assert task(run, "a").enabled
        assert tasks.told == ["a made", "a stopped", "a made", "a off", "a on"]


def test_a_stop_during_a_change_stops_the_new_tasks_too() -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("a"), SystemClock())) as run:
        run.supervisor.submit(lambda: run.supervisor.change(tasks.plans("b"), run.supervisor.stop))
        run.wait_for_end()
    assert tasks.told == ["a made", "a stopped", "b made", "b stopped"]
    assert run.was_clean


def test_a_change_before_the_start_is_carried_out_at_the_start() -> None:
    tasks = Tasks()
    supervisor = Supervisor([], SystemClock())
    supervisor.submit(lambda: supervisor.change(tasks.plans("a")))
    with running(supervisor) as run:
        run.do(lambda: None)
        assert list(run.supervisor.tasks) == ["a"]


# ------------------------------------------------------------------------------------------------ tasks with bugs


def test_a_task_that_waits_to_be_made_again_is_made_at_once_by_a_plan_that_differs(clock: JumpingClock) -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("weak"), clock)) as run:
        task(run, "weak").crash()
        assert run.supervisor.tasks == {}
        run.change([tasks.plan("weak", basis=1)])
        assert task(run, "weak") is tasks.made[1]


def test_a_task_that_waits_to_be_made_again_still_waits_where_its_plan_does_not_differ(clock: JumpingClock) -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("weak"), clock)) as run:
        task(run, "weak").crash()
        run.change([tasks.plan("weak", enabled=False)])
        assert run.supervisor.tasks == {}
        clock.pass_s(1.0)
        wait_for_made(run, tasks, 2)
        assert not task(run, "weak").enabled  # switched off while there was nobody to tell


def test_a_task_that_crashed_and_is_not_wanted_any_more_does_not_come_back(clock: JumpingClock) -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("gone", "weak"), clock)) as run:
        task(run, "gone").crash()
        task(run, "weak").crash()
        run.change(tasks.plans("weak"))
        clock.pass_s(1.0)
        wait_for_made(run, tasks, 3)  # the one that is due later in the round has had its turn
        assert [made.name for made in tasks.made] == ["gone", "weak", "weak"]


def wait_for_made(run: RunningSupervisor, tasks: Tasks, count: int) -> None:
    """Wake the supervisor until *count* tasks have been made."""
    for _ in range(1000):
        if len(tasks.made) >= count and len(run.supervisor.tasks) >= 1:
            return
        run.do(lambda: None)
    raise AssertionError(f"{len(tasks.made)} tasks were made, not {count}")


class CrashingSwitch:
    """Stands for ``enabled``: when a change compares it, the task crashes; just then its thread might have anyway."""

    def __init__(self) -> None:
        self.task: Working | None = None

    def __ne__(self, other: object) -> bool:
        assert self.task is not None
        self.task.crash()
        return True

    def __eq__(self, other: object) -> bool:
        return not self != other

    __hash__ = None  # type: ignore[assignment] # as Python has it for whoever has __eq__ alone


def test_a_task_that_crashes_in_the_moment_it_is_switched_off_takes_nothing_with_it(clock: JumpingClock) -> None:
    tasks = Tasks()
    switch: Any = CrashingSwitch()
    with running(Supervisor(tasks.plans("weak", "well"), clock)) as run:
        switch.task = task(run, "weak")
        run.change([tasks.plan("weak", enabled=switch), *tasks.plans("well")])
        assert list(run.supervisor.tasks) == ["well"]
    assert run.was_clean


def test_a_task_that_crashes_when_a_change_stops_it_holds_up_nothing(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    tasks = Tasks()
    with running(Supervisor([tasks.plan("weak", kind=CrashingAtStop)], clock)) as run:
        run.change([tasks.plan("weak", basis=1)])
        assert task(run, "weak") is tasks.made[1]
    assert caplog.text.count("weak: ended with an error while it was to stop") == 1
    assert run.was_clean


def test_a_new_task_that_cannot_be_made_is_tried_again_and_the_others_start(clock: JumpingClock) -> None:
    tasks = Tasks()
    failures = [ZeroDivisionError("a bug")]

    def make(waker: Waker) -> Task:
        if failures:
            raise failures.pop()
        return tasks.plan("weak").make(waker)

    with running(Supervisor([], clock)) as run:
        run.change([Plan("weak", make), *tasks.plans("well")])
        assert list(run.supervisor.tasks) == ["well"]
        clock.pass_s(1.0)
        wait_for_made(run, tasks, 2)
        assert task(run, "weak")


def test_a_change_that_fails_half_way_ends_the_gateway_but_leaves_no_task_behind() -> None:
    tasks = Tasks()
    supervisor = Supervisor(tasks.plans("a", "b"), SystemClock())
    plans = [tasks.plan("a", basis=1), *tasks.plans("b")]
    supervisor.submit(lambda: supervisor.change(plans, lambda: 1 // 0))  # type: ignore[arg-type] # it returns nothing in any case
    with pytest.raises(ZeroDivisionError):
        supervisor.run()
    assert tasks.told == ["a made", "b made", "a stopped", "b stopped"]


# ------------------------------------------------------------------------------------------------ tasks that hang


class Hanging:
    """A supervisor with a task that does not stop, and one that is well."""

    def __init__(self) -> None:
        self.tasks = Tasks()
        self.plans = [self.tasks.plan("deaf", kind=Deaf), *self.tasks.plans("well")]

    def let_go(self) -> None:
        """Have the deaf one end; return when it has."""
        deaf = self.tasks.made[0]
        assert isinstance(deaf, Deaf)
        deaf.let_go.set()
        assert deaf.thread is not None
        deaf.thread.join(PATIENCE_S)
        assert not deaf.thread.is_alive()


def test_a_task_that_does_not_stop_is_told_of_once_and_the_rest_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    hanging = Hanging()
    tasks, well = hanging.tasks, hanging.tasks.plans("well")
    with running(Supervisor(hanging.plans, SystemClock())) as run:
        task(run, "deaf")
        before = task(run, "well")
        run.change([tasks.plan("deaf", basis=1), *well])
        assert caplog.messages == ["deaf: does not stop"]
        assert task(run, "deaf") is tasks.made[2]
        assert task(run, "well") is before
        for basis in (2, 3, 4):  # and later changes have nothing more to do with it
            run.change([tasks.plan("deaf", basis=basis), *well])
        assert caplog.messages == ["deaf: does not stop"]
        hanging.let_go()
    assert run.was_clean  # it has ended after all


def test_a_change_does_not_wait_for_what_an_earlier_one_could_not_stop() -> None:
    hanging = Hanging()
    with running(Supervisor(hanging.plans, SystemClock())) as run:
        task(run, "deaf")
        run.change(hanging.tasks.plans("well"))
        done = threading.Event()
        for number in range(20):
            plans = [*hanging.tasks.plans("well"), hanging.tasks.plan("other", basis=number)]
            run.supervisor.submit(lambda plans=plans: run.supervisor.change(plans))  # type: ignore[misc] # a default binds the loop's value
        run.supervisor.submit(done.set)
        assert done.wait(10 * STOP_LIMIT_S), "twenty changes have waited, each"
        hanging.let_go()


def test_a_task_left_behind_that_still_hangs_at_the_end_makes_the_stop_unclean(
    caplog: pytest.LogCaptureFixture,
) -> None:
    hanging = Hanging()
    with running(Supervisor(hanging.plans, SystemClock())) as run:
        task(run, "deaf")
        run.change(hanging.tasks.plans("well"))
        run.change([])  # it is not forgotten over other changes
    assert run.was_clean is False
    assert caplog.messages == ["deaf: does not stop"] * 2
    hanging.let_go()


# ------------------------------------------------------------------------------------------------ many changes


def test_300_random_changes_leave_no_thread_and_no_descriptor_behind() -> None:
    rng, tasks = random.Random(1), Tasks()
    descriptors = open_descriptors()
    with running(Supervisor([], SystemClock())) as run:
        for _ in range(300):
            names = rng.sample("abcdef", rng.randrange(7))
            plans = [tasks.plan(name, basis=rng.randrange(3), enabled=rng.random() < 0.7) for name in names]
            before = {name: (found.plan.basis, found.task) for name, found in runners(run).items()}
            run.change(plans)
            assert sorted(run.supervisor.tasks) == sorted(names)
            for plan in plans:
                basis, old = before.get(plan.name, (None, None))
                assert (run.supervisor.tasks[plan.name] is old) == (basis == plan.basis)
                assert task(run, plan.name).enabled == plan.enabled
            living = {thread.name for thread in threading.enumerate()} & set("abcdef")
            assert living == set(names)
    assert run.was_clean
    assert open_descriptors() == descriptors


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def runners(run: RunningSupervisor) -> dict[str, Any]:
    return {runner.plan.name: runner for runner in run.supervisor._runners}
