"""Tasks for tests of the supervisor: they work, crash, or do not stop, and tell of what happens to them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from gateway.link import Waker
from gateway.supervisor import Plan, Supervisor
from tests.lines import PATIENCE_S


class Working:
    """A task that works until it is told to stop; it waits on its waker like any other."""

    def __init__(self, name: str, enabled: bool, waker: Waker, told: list[str]) -> None:
        self.name = name
        self.enabled = enabled
        self.ready = threading.Event()
        self.crashes = False
        self.thread: threading.Thread | None = None
        self.told = told
        self._waker = waker

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        self.thread = threading.current_thread()
        self.ready.set()
        while not stop.is_set():
            alive()
            self._waker.wait(60.0)
            if self.crashes:
                raise ZeroDivisionError("a bug")
        self.told.append(f"{self.name} stopped")

    def wake(self) -> None:
        self._waker.wake()

    def set_enabled(self, enabled: bool) -> None:
        self.enabled = enabled
        self.told.append(f"{self.name} {'on' if enabled else 'off'}")

    def crash(self) -> None:
        """End with an error; return once the thread has ended."""
        self.crashes = True
        self.wake()
        assert self.ready.wait(PATIENCE_S)
        assert self.thread is not None
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()


class Crashing(Working):
    """A task with a bug that shows at once."""

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        self.ready.set()
        raise ZeroDivisionError("a bug")


class CrashingAtStop(Working):
    """A task with a bug that shows when it is to stop."""

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        super().run(stop, alive)
        raise ZeroDivisionError("a bug")


class Deaf(Working):
    """A task that does not see that it is to stop until the test lets it."""

    def __init__(self, name: str, enabled: bool, waker: Waker, told: list[str]) -> None:
        super().__init__(name, enabled, waker, told)
        self.let_go = threading.Event()

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        self.thread = threading.current_thread()
        self.ready.set()
        self.let_go.wait(20.0)


class Obedient(Working):
    """A task that does what the test has it do, in its own thread, and nothing by itself: no flag, no ``ready``."""

    def __init__(self, name: str, enabled: bool, waker: Waker, told: list[str]) -> None:
        super().__init__(name, enabled, waker, told)
        self._orders: deque[tuple[Callable[[Callable[[], None]], object], threading.Event]] = deque()
        self._has_to_leave = False
        self._has_begun = threading.Event()

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        self.thread = threading.current_thread()
        self._has_begun.set()
        while not stop.is_set() and not self._has_to_leave:
            self._waker.wait(60.0)
            while self._orders:
                order, done = self._orders.popleft()
                try:
                    order(alive)
                finally:
                    done.set()

    def raise_flag(self) -> None:
        """Have it get on with something; return once it has."""
        self._obey(lambda alive: alive())

    def fail(self, error: BaseException) -> None:
        """Have it end with *error*; return once its thread has ended."""

        def raise_it(alive: Callable[[], None]) -> None:
            raise error

        self._obey(raise_it)
        self._wait_for_end()

    def leave(self) -> None:
        """Have it return though nobody has told it to stop; return once its thread has ended."""
        self._has_to_leave = True
        self.wake()
        self._wait_for_end()

    def _obey(self, order: Callable[[Callable[[], None]], object]) -> None:
        done = threading.Event()
        self._orders.append((order, done))
        self.wake()
        assert done.wait(PATIENCE_S), "the task does not obey"

    def _wait_for_end(self) -> None:
        assert self._has_begun.wait(PATIENCE_S)
        assert self.thread is not None
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()


class Tasks:
    """Plans of such tasks. ``made``: each one, in order; ``told``: what happened, in order."""

    def __init__(self) -> None:
        self.made: list[Working] = []
        self.told: list[str] = []

    def plan(self, name: str, basis: object = 0, enabled: bool = True, kind: type[Working] = Working) -> Plan:
        return Plan(name, partial(self._make, name, enabled, kind), basis, enabled)

    def plans(self, *names: str) -> list[Plan]:
        return [self.plan(name) for name in names]

    def obedient(self, name: str) -> Obedient:
        """The one of that name that was made last."""
        found = [task for task in self.made if task.name == name][-1]
        assert isinstance(found, Obedient)
        return found

    def let_go(self) -> None:
        """Have all the deaf ones end; return when they have."""
        for task in self.made:
            if isinstance(task, Deaf):
                task.let_go.set()
                if task.thread is not None:
                    task.thread.join(PATIENCE_S)

    def _make(self, name: str, enabled: bool, kind: type[Working], waker: Waker) -> Working:
        self.told.append(f"{name} made")
        self.made.append(kind(name, enabled, waker, self.told))
        return self.made[-1]


class RunningSupervisor:
    """A supervisor in a thread of its own, seen from the test."""

    def __init__(self, supervisor: Supervisor) -> None:
        self.supervisor = supervisor
        self.was_clean: bool | None = None  # what ``run`` returned
        self._thread = threading.Thread(target=self._run, name="supervisor")
        self._started = threading.Event()
        self._thread.start()
        assert self._started.wait(PATIENCE_S)

    def do(self, job: Callable[[], None], limit_s: float = PATIENCE_S) -> None:
        """Have the supervisor's thread do *job*; return once that is done."""
        done = threading.Event()
        self.supervisor.submit(job)
        self.supervisor.submit(done.set)
        assert done.wait(limit_s), "the supervisor does not get to it"

    def look(self) -> None:
        """Return once it has looked at everything anew."""
        for _ in range(2):  # the first comes in the middle of a look
            self.do(lambda: None)

    def change(self, plans: list[Plan], between: Callable[[], None] = lambda: None) -> None:
        self.do(partial(self.supervisor.change, plans, between))

    def stop(self) -> None:
        self.supervisor.stop()
        self.wait_for_end()

    def wait_for_end(self) -> None:
        self._thread.join()

    def _run(self) -> None:
        self.was_clean = self.supervisor.run(self._started.set)


@contextmanager
def running(supervisor: Supervisor) -> Iterator[RunningSupervisor]:
    run = RunningSupervisor(supervisor)
    try:
        yield run
    finally:
        run.stop()
