"""The supervisor with tasks that work, crash, and do not stop; what a change does is in ``test_supervisor_change``."""

from __future__ import annotations

import logging
import threading
from itertools import pairwise

import pytest

from gateway.clock import SystemClock
from gateway.link import Waker
from gateway.supervisor import TICK_MOST_S, Plan, Supervisor
from tests.fakes import JumpingClock
from tests.lines import PATIENCE_S
from tests.tasks import Crashing, CrashingAtStop, Deaf, RunningSupervisor, Tasks, Working, running


def test_all_tasks_are_told_to_stop_at_once_and_end() -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("a", "b"), SystemClock())) as run:
        assert sorted(run.supervisor.tasks) == ["a", "b"]
        assert all(task.ready.wait(PATIENCE_S) for task in run.supervisor.tasks.values())
    assert sorted(tasks.told[2:]) == ["a stopped", "b stopped"]
    assert run.was_clean


def test_a_task_that_ends_with_an_error_is_told_and_made_anew(caplog: pytest.LogCaptureFixture) -> None:
    made: list[Working] = []
    again = threading.Event()

    def make(waker: Waker) -> Working:
        kind = Working if made else Crashing
        made.append(kind("weak", True, waker, []))
        if len(made) == 2:
            again.set()
        return made[-1]

    with caplog.at_level(logging.ERROR), running(Supervisor([Plan("weak", make)], SystemClock())) as run:
        assert again.wait(PATIENCE_S)
        for _ in range(3):
            run.do(lambda: None)
        assert len(made) == 2
    assert "weak: ended with an error; starting it again in 1 s" in caplog.text
    assert "ZeroDivisionError: a bug" in caplog.text
    assert run.was_clean


def test_a_task_that_fails_again_and_again_is_tried_later_and_later_once_a_minute_at_the_least(
    clock: JumpingClock,
) -> None:
    tried_s: list[float] = []

    def fail(waker: Waker) -> Working:
        tried_s.append(clock.monotonic())
        raise ZeroDivisionError("a bug")

    with running(Supervisor([Plan("weak", fail)], clock)) as run:
        while len(tried_s) < 10:
            clock.pass_s(0.25)
            assert clock.monotonic() - tried_s[-1] < 70.0, "it is not tried any more"
            run.do(lambda: None)
    waits_s = [after_s - before_s for before_s, after_s in pairwise(tried_s)]
    for wait_s, expected_s in zip(waits_s, [1, 2, 4, 8, 16, 32, 60, 60, 60], strict=True):
        assert expected_s <= wait_s < expected_s + 1.0


def test_a_task_that_cannot_even_be_made_leaves_the_others_alone(caplog: pytest.LogCaptureFixture) -> None:
    tasks = Tasks()

    def fail(waker: Waker) -> Working:
        raise ZeroDivisionError("a bug")

    with running(Supervisor([Plan("unborn", fail), *tasks.plans("well")], SystemClock())) as run:
        assert list(run.supervisor.tasks) == ["well"]
    assert tasks.told == ["well made", "well stopped"]
    assert run.was_clean


def test_a_task_that_does_not_stop_is_named_and_the_others_stop(caplog: pytest.LogCaptureFixture) -> None:
    tasks = Tasks()
    with running(Supervisor([tasks.plan("deaf", kind=Deaf), *tasks.plans("well")], SystemClock())) as run:
        assert run.supervisor.tasks["deaf"].ready.wait(PATIENCE_S)
    let_go(tasks)
    assert run.was_clean is False
    assert "deaf: does not stop" in caplog.text
    assert "well: does not stop" not in caplog.text
    assert tasks.told[2:] == ["well stopped"]


def test_an_error_on_the_way_out_is_told_and_the_task_not_said_to_start_again(caplog: pytest.LogCaptureFixture) -> None:
    tasks = Tasks()
    with running(Supervisor([tasks.plan("weak", kind=CrashingAtStop)], SystemClock())) as run:
        pass
    assert run.was_clean
    assert "weak: ended with an error while it was to stop" in caplog.text
    assert "ZeroDivisionError: a bug" in caplog.text
    assert "again" not in caplog.text


# ------------------------------------------------------------------------------------------------ jobs


def test_jobs_are_done_in_the_supervisors_thread_in_the_order_they_came() -> None:
    done: list[tuple[int, str]] = []
    with running(Supervisor([], SystemClock())) as run:
        for number in range(100):
            run.supervisor.submit(lambda number=number: done.append((number, threading.current_thread().name)))  # type: ignore[misc] # a default binds the loop's value
        run.do(lambda: None)
    assert done == [(number, "supervisor") for number in range(100)]


def test_a_job_does_not_wait_until_the_supervisor_looks_around_by_itself() -> None:
    with running(Supervisor([], SystemClock())) as run:
        for _ in range(3):
            run.do(lambda: None, TICK_MOST_S / 2)


def test_a_job_submitted_before_the_start_is_done_after_it() -> None:
    done = threading.Event()
    supervisor = Supervisor([], SystemClock())
    supervisor.submit(done.set)
    with running(supervisor):
        assert done.wait(PATIENCE_S)


def test_a_job_submitted_after_the_stop_is_forgotten() -> None:
    done: list[str] = []
    with running(Supervisor([], SystemClock())) as run:

        def stop_and_go_on() -> None:
            run.supervisor.stop()
            run.supervisor.submit(lambda: done.append("after the stop"))

        run.supervisor.submit(stop_and_go_on)
        run.wait_for_end()
    run.supervisor.submit(lambda: done.append("after the end"))
    assert (run.was_clean, done) == (True, [])


def test_a_job_with_a_bug_ends_the_gateway_but_leaves_no_task_behind() -> None:
    tasks = Tasks()
    supervisor = Supervisor(tasks.plans("a", "b"), SystemClock())
    supervisor.submit(lambda: 1 // 0)  # type: ignore[arg-type] # it returns nothing in any case
    with pytest.raises(ZeroDivisionError):
        supervisor.run()
    assert sorted(tasks.told[2:]) == ["a stopped", "b stopped"]


def test_a_stop_before_the_start_is_heeded() -> None:
    tasks = Tasks()
    supervisor = Supervisor(tasks.plans("a"), SystemClock())
    supervisor.stop()
    RunningSupervisor(supervisor).wait_for_end()
    assert tasks.told == ["a made", "a stopped"]


def test_a_chore_is_done_in_the_supervisors_thread_and_again_after_the_time_it_says() -> None:
    seen: list[str] = []
    often = threading.Semaphore(0)

    def chore() -> float:
        seen.append(threading.current_thread().name)
        often.release()
        return 0.01

    supervisor = Supervisor([], SystemClock())
    supervisor.chores.append(chore)
    with running(supervisor):
        for _ in range(5):
            assert often.acquire(timeout=TICK_MOST_S / 2), "it is not done again"
    assert set(seen) == {"supervisor"}


def test_it_is_known_when_a_task_ended_with_an_error_last(clock: JumpingClock) -> None:
    tasks = Tasks()
    with running(Supervisor(tasks.plans("weak", "well"), clock)) as run:
        assert run.supervisor.failed_s is None
        clock.pass_s(5.0)
        tasks.made[0].crash()
        assert run.supervisor.failed_s == clock.monotonic()


def let_go(tasks: Tasks) -> None:
    for task in tasks.made:
        if isinstance(task, Deaf):
            task.let_go.set()
