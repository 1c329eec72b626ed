"""The supervisor: starts every task in a thread of its own, starts again what ended with an error, stops them all.

It knows tasks only as ``Task``. What a task is made of, and from what configuration, is ``wiring``'s affair: a new
configuration comes as new plans, and only the tasks whose plan differs are stopped and made anew.

Threads: ``run`` belongs to the main thread, and so does ``change``; ``stop`` and ``submit`` may be called from a signal
handler or any thread.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
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

    def set_enabled(self, enabled: bool) -> None:
        """False: maintenance; True: at work again. The task itself stays."""
        ...


@dataclass(frozen=True)
class Plan:
    """How a task is made; it is made anew after each error. Its waker belongs to the supervisor.

    basis:   all that the task depends on but *enabled*; a plan with an equal basis needs no new task.
    enabled: False: it starts in maintenance.
    """

    name: str
    make: Callable[[Waker], Task]
    basis: object = None
    enabled: bool = True


class Supervisor:
    """All tasks of the station."""

    def __init__(self, plans: Sequence[Plan], clock: Clock) -> None:
        self._clock = clock
        self._waker = Waker()
        self._stop = threading.Event()
        self.chores: list[Callable[[], float]] = []  # of the main thread; each says after how long to come again
        self.failed_s: float | None = None  # when a task ended with an error last, monotonic
        self._jobs: deque[Callable[[], None]] = deque()
        self._runners = [_Runner(plan, clock, self._failed) for plan in plans]
        self._leaving: list[_Runner] = []  # told to stop, and not ended yet

    @property
    def tasks(self) -> dict[str, Task]:
        """The tasks that run, by name."""
        return {runner.plan.name: task for runner in self._runners if (task := runner.task) is not None}

    def stop(self) -> None:
        """Have ``run`` end; from any thread, and from a signal handler."""
        self._stop.set()
        self._waker.wake()

    def submit(self, job: Callable[[], None]) -> None:
        """Have *job* done by the main thread; from any thread. After ``stop`` it is forgotten."""
        self._jobs.append(job)
        self._waker.wake()

    def change(self, plans: Sequence[Plan], between: Callable[[], None] = lambda: None) -> None:
        """Have the tasks of *plans* and no others: those with an equal basis stay; in the main thread only.

        between: called when the old tasks have stopped and before the new ones start.
        """
        wanted = {plan.name: plan for plan in plans}
        gone = [runner for runner in self._runners if not runner.suits(wanted.get(runner.plan.name))]
        kept = {runner.plan.name: runner for runner in self._runners if runner not in gone}
        self._leaving = [runner for runner in self._leaving if not runner.end(0.0)] + self._end(gone)
        between()
        self._runners = [kept.get(plan.name) or _Runner(plan, self._clock, self._failed) for plan in plans]
        for plan, runner in zip(plans, self._runners, strict=True):
            if plan.name in kept:
                runner.take(plan)
            else:
                runner.start()

    def run(self, started: Callable[[], None] = lambda: None) -> bool:
        """Run all tasks until ``stop``. Returns False if one of them did not end in time.

        started: called once all tasks are made and their threads run.
        """
        try:
            for runner in self._runners:
                runner.start()
            started()
            while not self._stop.is_set():
                while self._jobs and not self._stop.is_set():
                    self._jobs.popleft()()
                waits_s = (
                    [LOOK_EVERY_S] + [runner.look_after() for runner in self._runners] + [do() for do in self.chores]
                )
                self._waker.wait(min(waits_s))
        finally:
            clean = self._stop_all()
        return clean

    def _failed(self) -> None:
        """A task has ended with an error, in its own thread."""
        self.failed_s = self._clock.monotonic()
        self._waker.wake()

    def _stop_all(self) -> bool:
        self._stop.set()
        self._leaving = self._end([*self._leaving, *self._runners])
        self._waker.close()
        return not self._leaving

    def _end(self, runners: Sequence[_Runner]) -> list[_Runner]:
        """Stop *runners*, all at once; return those that do not end in time: they are told of, and left alone."""
        deadline_s = self._clock.monotonic() + STOP_LIMIT_S
        for runner in runners:
            runner.stop()
        late = [runner for runner in runners if not runner.end(max(0.0, deadline_s - self._clock.monotonic()))]
        for runner in late:
            log.error("%s: does not stop", runner.plan.name)
        return late


class _Runner:
    """One task and its thread, over all its restarts."""

    def __init__(self, plan: Plan, clock: Clock, told: Callable[[], None]) -> None:
        self.plan = plan
        self.task: Task | None = None
        self._clock = clock
        self._stop = threading.Event()
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

    def suits(self, plan: Plan | None) -> bool:
        """Whether the task of *plan* is this one, switched on or off."""
        return plan is not None and plan.basis == self.plan.basis

    def take(self, plan: Plan) -> None:
        """Go on by *plan*, which differs in ``enabled`` at most."""
        before, self.plan = self.plan, plan
        task = self.task  # looked at once: its thread takes it away when it ends with an error
        if task is not None and plan.enabled != before.enabled:
            task.set_enabled(plan.enabled)

    def stop(self) -> None:
        self._stop.set()
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
        if self._stop.is_set():
            log.exception("%s: ended with an error while it was to stop", self.plan.name)
            return
        log.exception("%s: ended with an error; starting it again in %.0f s", self.plan.name, self._restart_after_s)
        self._restart_s = self._clock.monotonic() + self._restart_after_s
        self._restart_after_s = min(RESTART_MOST_S, 2 * self._restart_after_s)
        self._told()
