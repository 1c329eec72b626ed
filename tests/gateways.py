"""Gateways for tests: one that does not run, on a clock that jumps, and one that runs in a thread of its own."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from gateway.clock import SystemClock
from gateway.config import Config
from gateway.config_file import ConfigFile
from gateway.hmi.station import Job
from gateway.logs import LogRing
from gateway.running import Gateway
from gateway.snapshots import read_last_good
from tests.config_files import Place, counting
from tests.lines import PATIENCE_S
from tests.tasks import Tasks


def nobody() -> None:
    """Who waits for nothing."""


def done(job: Job) -> Job:
    """Wait for *job*."""
    assert job.done.wait(PATIENCE_S), "the job is never done"
    return job


class Bench:
    """A gateway that is not running, on a clock that jumps; ``look`` is what it does now and then while it runs."""

    def __init__(self, place: Place, kind: type[ConfigFile] = ConfigFile) -> None:
        self.place, self.clock = place, place.clock
        self.gateway = Gateway(kind(place.path, place.state, place.clock), place.clock, LogRing())

    @property
    def config(self) -> Config:
        return self.gateway.config

    def look(self) -> float:
        """Have it look after its file; return after how long it wants to look again."""
        chore = self.gateway.supervisor.chores[0]
        wait_s = chore()
        self.finish()
        return wait_s

    def run_s(self, seconds: float) -> None:
        """Let time pass as while it runs."""
        until_s = self.clock.monotonic() + seconds
        while (left_s := until_s - self.clock.monotonic()) > 0:
            self.clock.pass_s(min(left_s, 3.0))
            self.look()

    def finish(self) -> None:
        assert self.gateway.finish_work(PATIENCE_S)

    def change(self, count: int) -> Config:
        """Change the configuration as the menu does; return the new one."""
        self.gateway.change(self.config, counting(self.config, count), nobody)
        return self.config

    def save(self, confirm_s: float | None = None, overwrite: bool = False) -> Job:
        return done(self.gateway.save(overwrite, confirm_s, nobody))

    def save_soon(self) -> Job:
        return self.gateway.save(False, None, nobody)

    @contextmanager
    def busy(self) -> Iterator[None]:
        """The thread for slow work is at something else meanwhile."""
        may_go = threading.Event()

        def wait() -> None:
            may_go.wait(PATIENCE_S)

        self.gateway.in_background(wait, nobody)
        try:
            yield
        finally:
            may_go.set()

    def told(self) -> list[str]:
        return [told.words(str) for told in self.gateway.notices(0)[1]]

    def last_good(self) -> Config | None:
        return read_last_good(self.place.state)


class Live:
    """A gateway that runs in a thread of its own, with fake tasks beside the lines of its file."""

    def __init__(self, place: Place, clock: SystemClock) -> None:
        self.place = place
        self.tasks = Tasks()
        self.gateway = Gateway(place.file(), clock, LogRing())
        self.gateway.terminal_plans = lambda config: self.tasks.plans("menu")
        self.was_clean: bool | None = None
        self.thread = threading.Thread(target=self._run, name="gateway")
        self._started = threading.Event()

    @property
    def station_config(self) -> Config:
        """What the lines were made of last."""
        return self.gateway.station.config

    def start(self) -> None:
        self.thread.start()
        assert self._started.wait(PATIENCE_S)

    def does_not_end(self, started: Callable[[], None]) -> bool:
        """What the supervisor's ``run`` is like with a task that does not stop."""
        return False

    def _run(self) -> None:
        log = logging.getLogger("gateway")
        level = log.level
        try:
            self.was_clean = self.gateway.run(self._started.set)
        finally:
            log.setLevel(level)  # which follows the configuration

    def stop(self) -> None:
        self.gateway.stop()
        self.thread.join()

    @contextmanager
    def held(self) -> Iterator[None]:
        """The supervisor's thread is busy meanwhile."""
        is_held, may_go = threading.Event(), threading.Event()

        def hold() -> None:
            is_held.set()
            may_go.wait(PATIENCE_S)

        self.gateway.supervisor.submit(hold)
        assert is_held.wait(PATIENCE_S)
        try:
            yield
        finally:
            may_go.set()


@contextmanager
def live(place: Place) -> Iterator[Live]:
    made = Live(place, SystemClock())
    made.start()
    try:
        yield made
    finally:
        made.stop()
    assert made.was_clean
