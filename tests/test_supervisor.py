"""The supervisor with tasks that work, crash, and do not stop."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from gateway.clock import SystemClock
from gateway.link import Waker
from gateway.supervisor import Plan, Supervisor


class Working:
    """A task that works until it is told to stop; it waits on its waker like any other."""

    def __init__(self, name: str, waker: Waker, told: list[str]) -> None:
        self.name = name
        self.ready = threading.Event()
        self._waker = waker
        self._told = told

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        self.ready.set()
        while not stop.is_set():
            alive()
            self._waker.wait(60.0)
        self._told.append(f"{self.name} stopped")

    def wake(self) -> None:
        self._waker.wake()


class Crashing(Working):
    """A task with a bug."""

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        self._told.append(f"{self.name} ran")
        self.ready.set()
        raise ZeroDivisionError("a bug")


class Deaf(Working):
    """A task that does not see that it is to stop until the test lets it."""

    let_go = threading.Event()

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        self.ready.set()
        self.let_go.wait(20.0)


@contextmanager
def running(supervisor: Supervisor, clean: list[bool]) -> Iterator[None]:
    started = threading.Event()
    thread = threading.Thread(target=lambda: clean.append(supervisor.run(started.set)))
    thread.start()
    assert started.wait(5.0)
    try:
        yield
    finally:
        supervisor.stop()
        thread.join()


def test_all_tasks_are_told_to_stop_at_once_and_end() -> None:
    told: list[str] = []
    clean: list[bool] = []
    plans = [Plan(name, lambda waker, name=name: Working(name, waker, told)) for name in ("a", "b")]  # type: ignore[misc] # a default binds the loop's value
    supervisor = Supervisor(plans, SystemClock())
    with running(supervisor, clean):
        assert sorted(supervisor.tasks) == ["a", "b"]
        assert all(task.ready.wait(5.0) for task in supervisor.tasks.values())
    assert sorted(told) == ["a stopped", "b stopped"]
    assert clean == [True]


def test_a_task_that_ends_with_an_error_is_told_and_made_anew(caplog: pytest.LogCaptureFixture) -> None:
    made: list[Working] = []
    again = threading.Event()

    def make(waker: Waker) -> Working:
        kind = Working if made else Crashing
        made.append(kind("weak", waker, []))
        if len(made) == 2:
            again.set()
        return made[-1]

    clean: list[bool] = []
    with caplog.at_level(logging.ERROR), running(Supervisor([Plan("weak", make)], SystemClock()), clean):
        assert again.wait(5.0)
    assert "weak: ended with an error; starting it again in 1 s" in caplog.text
    assert "ZeroDivisionError: a bug" in caplog.text
    assert clean == [True]


def test_a_task_that_cannot_even_be_made_leaves_the_others_alone(caplog: pytest.LogCaptureFixture) -> None:
    told: list[str] = []
    clean: list[bool] = []

    def fail(waker: Waker) -> Working:
        raise ZeroDivisionError("a bug")

    supervisor = Supervisor([Plan("unborn", fail), Plan("well", lambda w: Working("well", w, told))], SystemClock())
    with running(supervisor, clean):
        assert list(supervisor.tasks) == ["well"]
    assert told == ["well stopped"]
    assert clean == [True]


def test_a_task_that_does_not_stop_is_named(caplog: pytest.LogCaptureFixture) -> None:
    clean: list[bool] = []
    supervisor = Supervisor([Plan("deaf", lambda waker: Deaf("deaf", waker, []))], SystemClock())
    with running(supervisor, clean):
        assert supervisor.tasks["deaf"].ready.wait(5.0)
    Deaf.let_go.set()
    assert clean == [False]
    assert "deaf: does not stop" in caplog.text
