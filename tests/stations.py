"""A whole station for tests: a configuration text, running in this process, with the real clock and real lines."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from gateway.clock import SystemClock
from gateway.register import DataRegister
from gateway.retained import RetainedFile
from gateway.store import load_text
from gateway.supervisor import Supervisor
from gateway.wiring import build


class RunningStation:
    """What a test may look at and wait for."""

    def __init__(self, register: DataRegister, supervisor: Supervisor) -> None:
        self.register = register
        self.supervisor = supervisor
        self._written = threading.Condition()
        register.watch(lambda written: self._tell())

    def wait_until(self, condition: Callable[[], bool], limit_s: float = 10.0) -> None:
        """Look at *condition* after each write to the register (and now and then) until it is true."""
        deadline_s = time.monotonic() + limit_s
        with self._written:
            while not condition():
                assert time.monotonic() < deadline_s, "it never came true"
                self._written.wait(0.05)

    def _tell(self) -> None:
        with self._written:
            self._written.notify_all()


@contextmanager
def running_station(text: str, retained: Path | None = None) -> Iterator[RunningStation]:
    """*retained*: the file through which values survive a restart."""
    clock = SystemClock()
    station = build(load_text(text, "test.toml").config, clock, RetainedFile(retained) if retained else None)
    supervisor = Supervisor(station.plans, clock)
    started = threading.Event()
    clean: list[bool] = []
    thread = threading.Thread(target=lambda: clean.append(supervisor.run(started.set)), name="supervisor")
    thread.start()
    try:
        assert started.wait(5.0)
        assert all(task.ready.wait(5.0) for task in supervisor.tasks.values())
        yield RunningStation(station.register, supervisor)
    finally:
        supervisor.stop()
        thread.join()
    assert clean == [True]
