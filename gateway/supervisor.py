"""The supervisor: starts every task in a thread of its own, makes anew what ended, notices what hangs, stops them all.

It knows tasks only as ``Task``. What a task is made of, and from what configuration, is ``wiring``'s affair: a new
configuration comes as new plans, and only the tasks whose plan differs are stopped and made anew. What follows from a
hang is ``guard``'s.

A task has a flag: when it got on with something last. It hangs when that was longer ago than ``timeout_s``. A task that
has ended, by an error or without being told to, is made anew, later each time (spec section 7).

Threads: ``run`` belongs to the main thread, and so does ``change``; ``stop`` and ``submit`` may be called from a signal
handler or any thread.
"""

from __future__ import annotations

import logging
import math
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from gateway.clock import Clock, sharpen_timers
from gateway.link import Waker

RESTART_FIRST_S: Final = 1.0
RESTART_MOST_S: Final = 60.0
GOOD_RUN_S: Final = 600.0  # a task that has run for so long is no crashing one any more
STOP_LIMIT_S: Final = 1.8  # a clean stop takes under 2 s (spec section 7)
TICK_MOST_S: Final = 1.0

log = logging.getLogger(__name__)


class Task(Protocol):
    """A master, a slave, a console: something with a thread of its own."""

    name: str
    ready: threading.Event  # set once its line is open, or it has said why not

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        """Work until *stop*; call *alive* whenever something has been got on with.

        That is: work was done, bytes went either way, or a wait has run its time. To have looped is not enough.
        """
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

    def __init__(self, plans: Sequence[Plan], clock: Clock, timeout_s: float = 10.0) -> None:
        """*timeout_s*: a task that has got on with nothing for longer hangs."""
        self.timeout_s = timeout_s
        self.hung: Callable[[list[str]], None] = lambda names: None  # noqa: ARG005 - told of tasks that hang, each tick
        self.before_stops: Callable[[], None] = lambda: None  # told that tasks are stopped now, which takes a while
        self._clock = clock
        self._waker = Waker()
        self._stop = threading.Event()
        self.chores: list[Callable[[], float]] = []  # of the main thread; each says after how long to come again
        self.failed_s: float | None = None  # when a task ended with an error last, monotonic
        self._jobs: deque[Callable[[], None]] = deque()
        self._runners = [_Runner(plan, clock, self._told) for plan in plans]
        self._leaving: list[_Runner] = []  # told to stop, and not ended yet

    @property
    def tasks(self) -> dict[str, Task]:
        """The tasks that run, by name."""
        return {runner.plan.name: task for runner in self._runners if (task := runner.task) is not None}

    @property
    def crashes(self) -> dict[str, int]:
        """How often tasks have ended by themselves, by name; until they have run well for ``GOOD_RUN_S``."""
        return {runner.plan.name: runner.crashes for runner in self._runners if runner.crashes}

    @property
    def are_flags_up(self) -> bool:
        """Whether every task has shown its first flag; one that waits to be made anew cannot."""
        return all(runner.has_flag for runner in self._runners)

    @property
    def are_ready(self) -> bool:
        """Whether every task has its line, or has said why not."""
        return all(runner.is_ready for runner in self._runners)

    @property
    def tick_s(self) -> float:
        """How often flags are looked at."""
        return min(TICK_MOST_S, self.timeout_s / 10)

    @property
    def is_stopping(self) -> bool:
        """Whether it has been told to stop."""
        return self._stop.is_set()

    def hanging(self) -> list[str]:
        """Return the names of the tasks that hang, those included that were told to stop."""
        limit_s = self._clock.monotonic() - self.timeout_s
        return [runner.plan.name for runner in self._watched if runner.quiet_since_s < limit_s]

    def _look_at_flags(self) -> float:
        """Tell of tasks that hang; return how long no other can."""
        hanging = self.hanging()
        if hanging:
            self.hung(hanging)
        quiet_since_s = min((runner.quiet_since_s for runner in self._watched), default=math.inf)
        left_s = quiet_since_s + self.timeout_s - self._clock.monotonic()
        return min(self.tick_s, left_s) if left_s > 0 else self.tick_s

    @property
    def _watched(self) -> list[_Runner]:
        return [*self._runners, *self._leaving]

    @property
    def leaving(self) -> list[str]:
        """The names of the tasks that were told to stop, and have not in time."""
        return [runner.plan.name for runner in self._leaving]

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
        self.before_stops()
        wanted = {plan.name: plan for plan in plans}
        gone = [runner for runner in self._runners if not runner.suits(wanted.get(runner.plan.name))]
        kept = {runner.plan.name: runner for runner in self._runners if runner not in gone}
        self._leaving = [runner for runner in self._leaving if not runner.end(0.0)] + self._end(gone)
        between()
        self._runners = [kept.get(plan.name) or _Runner(plan, self._clock, self._told) for plan in plans]
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
                waits_s = [runner.look_after() for runner in self._runners]
                waits_s.append(self._look_at_flags())
                self._waker.wait(min(waits_s + [do() for do in self.chores]))
        finally:
            clean = self._stop_all()
        return clean

    def _told(self, has_failed: bool) -> None:
        """A task is ready, or has ended by itself; in its own thread."""
        if has_failed:
            self.failed_s = self._clock.monotonic()
        self._waker.wake()

    def _stop_all(self) -> bool:
        self._stop.set()
        self.before_stops()
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
    """One task and its thread, over all its restarts. *told*: the task is ready (False), or has failed (True)."""

    def __init__(self, plan: Plan, clock: Clock, told: Callable[[bool], None]) -> None:
        self.plan = plan
        self.task: Task | None = None
        self.crashes = 0  # since it last ran well
        self._clock = clock
        self._stop = threading.Event()
        self._told = told
        self._waker = Waker()
        self._waker.progress = self._alive
        self._thread: threading.Thread | None = None
        self._restart_s: float | None = None
        self._restart_after_s = RESTART_FIRST_S
        self._causes: Counter[str] = Counter()
        self._started_s = self._alive_s = clock.monotonic()
        self._has_flag = self._has_told_ready = False

    @property
    def has_flag(self) -> bool:
        """Whether it has got on with something since it was started."""
        return self._restart_s is not None or self._has_flag

    @property
    def is_ready(self) -> bool:
        """Whether it has its line, or it has been said why not."""
        task = self.task
        return self._restart_s is not None or (task is not None and task.ready.is_set())

    @property
    def quiet_since_s(self) -> float:
        """When it got on with something last, monotonic; infinity while it is not expected to."""
        if self._thread is None or self._restart_s is not None:
            return math.inf
        is_expected = self._thread.is_alive() or not self._stop.is_set()
        return self._alive_s if is_expected else math.inf

    def start(self) -> None:
        self._restart_s = None
        self._started_s = self._alive_s = self._clock.monotonic()
        self._has_flag = self._has_told_ready = False
        try:
            self.task = self.plan.make(self._waker)
        except Exception as error:  # noqa: BLE001 - a bug in one task is no reason to take the others down
            self._failed(error)
            return
        if not self.plan.enabled:
            self.task.set_enabled(False)
        self._thread = threading.Thread(target=self._work, args=(self.task,), name=self.plan.name)
        self._thread.start()

    def look_after(self) -> float:
        """Start the task again if it has ended and its time has come; return how long nothing is due."""
        now_s = self._clock.monotonic()
        if self._restart_s is None:
            if self.crashes and now_s - self._started_s >= GOOD_RUN_S:
                self.crashes, self._restart_after_s = 0, RESTART_FIRST_S
            return TICK_MOST_S
        left_s = self._restart_s - now_s
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
        self._has_flag = True
        if not self._has_told_ready and self.is_ready:
            self._has_told_ready = True
            self._told(False)

    def _work(self, task: Task) -> None:
        sharpen_timers()
        error: BaseException | None = None
        try:
            task.run(self._stop, self._alive)
        except BaseException as raised:  # noqa: BLE001 - also SystemExit, which would end the thread without a word
            error = raised
        if error is not None or not self._stop.is_set():
            self.task = None
            self._failed(error or RuntimeError("it has ended without being told to"))

    def _failed(self, error: BaseException) -> None:
        name = self.plan.name
        if self._stop.is_set():
            log.error("%s: ended with an error while it was to stop", name, exc_info=error)
            return
        cause = _cause_of(error)
        self._causes[cause] += 1
        self.crashes += 1
        if self._causes[cause] == 1:
            log.error(
                "%s: ended with an error; starting it again in %.0f s", name, self._restart_after_s, exc_info=error
            )
        else:
            times, about = self._causes[cause], {"about": f"{name}: errors"}  # or each count were a cause of its own
            log.error("%s: ended with the same error, %d times by now: %r", name, times, error, extra=about)
        self._restart_s = self._clock.monotonic() + self._restart_after_s
        self._restart_after_s = min(RESTART_MOST_S, 2 * self._restart_after_s)
        self._told(True)


def _cause_of(error: BaseException) -> str:
    """Return what kind of error it was and where, the same for the same fault."""
    frames = traceback.extract_tb(error.__traceback__)
    return f"{type(error).__name__} {frames[-1].filename} {frames[-1].lineno}" if frames else type(error).__name__
