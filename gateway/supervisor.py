"""The supervisor: starts every task in a thread of its own, starts again what ended with an error, stops them all.

It knows tasks only as ``Task``. What a task is made of, and from what configuration, is ``wiring``'s affair.

Threads: ``run`` belongs to the main thread; ``stop`` may be called from a signal handler or any thread.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from gateway.clock import Clock, sharpen_timers
from gateway.link import Waker

RESTART_FIRST_S: Final = 1.0
RESTART_MOST_S: Final = 60.0
STOP_LIMIT_S: Final = 1.8  # a clean stop takes under 2 s (spec section 7)
LOOK_EVERY_S: Final = 3.0

log = logging.getLogger(__name__)


class Task(Protocol):
    """A master, a slave, a console: something with a thread of its own."""

    name: str
    ready: threading.Event  # set once its line is open, or it has said why not

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        """Work until *stop*; call *alive* whenever something has been got on with."""
        ...

    def wake(self) -> None:
        """End any wait, so that *stop* is seen."""
        ...


@dataclass(frozen=True)
class Plan:
    """How a task is made; it is made anew after each error. Its waker belongs to the supervisor."""

    name: str
    make: Callable[[Waker], Task]


class Supervisor:
    """All tasks of the station."""

    def __init__(self, plans: Sequence[Plan], clock: Clock) -> None:
        self._clock = clock
        self._waker = Waker()
        self._stop = threading.Event()
        self._runners = [_Runner(plan, clock, self._stop, self._waker.wake) for plan in plans]

    @property
    def tasks(self) -> dict[str, Task]:
        """The tasks that run, by name."""
        return {runner.plan.name: runner.task for runner in self._runners if runner.task is not None}

    def stop(self) -> None:
        """Have ``run`` end; from any thread, and from a signal handler."""
        self._stop.set()
        self._waker.wake()

    def run(self, started: Callable[[], None] = lambda: None) -> bool:
        """Run all tasks until ``stop``. Returns False if one of them did not end in time.

        started: called once all tasks are made and their threads run.
        """
        try:
            for runner in self._runners:
                runner.start()
            started()
            while not self._stop.is_set():
                waits_s = [LOOK_EVERY_S] + [runner.look_after() for runner in self._runners]
                self._waker.wait(min(waits_s))
        finally:
            clean = self._stop_all()
        return clean

    def _stop_all(self) -> bool:
        self._stop.set()
        deadline_s = self._clock.monotonic() + STOP_LIMIT_S
        for runner in self._runners:
            runner.wake()
        late = [r.plan.name for r in self._runners if not r.end(max(0.0, deadline_s - self._clock.monotonic()))]
        for name in late:
            log.error("%s: does not stop", name)
        self._waker.close()
        return not late


class _Runner:
    """One task and its thread, over all its restarts."""

    def __init__(self, plan: Plan, clock: Clock, stop: threading.Event, told: Callable[[], None]) -> None:
        self.plan = plan
        self.task: Task | None = None
        self._clock = clock
        self._stop = stop
        self._told = told
        self._waker = Waker()
        self._thread: threading.Thread | None = None
        self._restart_s: float | None = None
        self._restart_after_s = RESTART_FIRST_S
        self._alive_s = 0.0

    def start(self) -> None:
        self._restart_s = None
        try:
            self.task = self.plan.make(self._waker)
        except Exception:  # noqa: BLE001 - a bug in one task is no reason to take the others down
            self._failed()
            return
        self._thread = threading.Thread(target=self._work, args=(self.task,), name=self.plan.name)
        self._thread.start()

    def look_after(self) -> float:
        """Start the task again if it ended with an error and its time has come; return how long nothing is due."""
        if self._restart_s is None:
            return LOOK_EVERY_S
        left_s = self._restart_s - self._clock.monotonic()
        if left_s <= 0:
            self.start()
        return max(0.0, left_s)

    def wake(self) -> None:
        self._waker.end()

    def end(self, limit_s: float) -> bool:
        """Wait for the thread; True when it has ended."""
        if self._thread is not None:
            self._thread.join(limit_s)
            if self._thread.is_alive():
                return False
        self._waker.close()
        return True

    def _alive(self) -> None:
        self._alive_s = self._clock.monotonic()

    def _work(self, task: Task) -> None:
        sharpen_timers()
        try:
            task.run(self._stop, self._alive)
        except Exception:  # noqa: BLE001 - a bug ends its own task only: it is told, and the task made anew
            self.task = None
            self._failed()

    def _failed(self) -> None:
        log.exception("%s: ended with an error; starting it again in %.0f s", self.plan.name, self._restart_after_s)
        self._restart_s = self._clock.monotonic() + self._restart_after_s
        self._restart_after_s = min(RESTART_MOST_S, 2 * self._restart_after_s)
        self._told()
