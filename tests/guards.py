"""A guard and all that it talks to, for its tests: the process that it ends, systemd, its device."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import pytest

from gateway.config import WatchdogConfig
from gateway.guard import Guard
from gateway.restart_cause import FILE, LastRun
from gateway.stacks import Backstop
from gateway.supervisor import Supervisor
from gateway.systemd import Systemd
from tests.fakes import JumpingClock
from tests.tasks import Obedient, RunningSupervisor, Tasks
from tests.watchdogs import KernelWatchdog

DEVICE = "/dev/watchdog"
WATCHDOG_S = 24.0  # systemd's


class LeftError(Exception):
    """The process has ended."""


class StillSupervisor(Supervisor):
    """A supervisor without tasks; the test says how they are."""

    flags, ready, stopping = False, False, False
    crashed: dict[str, int] = {}  # noqa: RUF012 - never changed, only replaced
    late: list[str] = []  # noqa: RUF012 - never changed, only replaced

    @property
    def are_flags_up(self) -> bool:
        return self.flags

    @property
    def are_ready(self) -> bool:
        return self.ready

    @property
    def is_stopping(self) -> bool:
        return self.stopping

    @property
    def crashes(self) -> dict[str, int]:
        return self.crashed

    @property
    def leaving(self) -> list[str]:
        return self.late


class NotedBackstop(Backstop):
    """A backstop that never strikes. ``armed_s``: for how long it was armed, each time; ``named``: how often."""

    def __init__(self) -> None:
        self.armed_s: list[float] = []
        self.named = 0
        self.is_closed = False

    def arm(self, timeout_s: float) -> None:
        self.armed_s.append(timeout_s)

    def name_threads(self) -> None:
        self.named += 1

    def close(self) -> None:
        self.is_closed = True


class Notified:
    """The service manager: a real socket, and what came through it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.setblocking(False)

    def told(self) -> list[str]:
        """What it was told since it was asked last, without statuses."""
        return [text for text in self.all_told() if not text.startswith("STATUS=")]

    def all_told(self) -> list[str]:
        found = []
        while True:
            try:
                found.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return found

    def close(self) -> None:
        self._socket.close()


class Bench:
    """A guard over a supervisor, and all that it talks to. ``left``: with which codes the process was to end."""

    def __init__(self, folder: Path, clock: JumpingClock, supervisor: Supervisor, systemd: Notified) -> None:
        self.clock, self.folder = clock, folder
        self.supervisor, self.systemd = supervisor, systemd
        self.backstop = NotedBackstop()
        self.is_restart = False
        self.left: list[int] = []
        self.mark_at_leaving: object = None
        self.boot = folder / "boot_id"
        self.boot.write_text("today\n")
        self.last_run = LastRun(folder, self.boot, bool)
        self.last_run.begin()
        self.guard = Guard(
            supervisor,
            clock,
            self.last_run,
            self.backstop,
            Systemd(os.fsencode(systemd.path), WATCHDOG_S, clock),
            lambda: self.is_restart,
            self._leave,
        )

    def _leave(self, code: int) -> NoReturn:
        self.left.append(code)
        self.mark_at_leaving = self.kept()["hung"]
        raise LeftError

    def kept(self) -> dict[str, object]:
        found = json.loads((self.folder / FILE).read_text())
        assert isinstance(found, dict)
        return found

    def configure(self, device: str = DEVICE, device_timeout: int = 30, timeout: float = 10.0) -> None:
        self.guard.configure(WatchdogConfig(device=device, device_timeout=device_timeout, timeout=timeout))

    def state(self) -> str | None:
        told = self.guard.device_state()
        return None if told is None else told.words(str)

    def alarms(self) -> list[str]:
        return [told.words(str) for told in self.guard.alarms()]

    def hang(self, *names: str) -> None:
        with pytest.raises(LeftError):
            self.guard.hung(names)

    def tick_for(self, seconds: float) -> None:
        """Tick as the supervisor does: when it was told to, and once a second."""
        until_s = self.clock.monotonic() + seconds
        while self.clock.monotonic() < until_s:
            self.clock.pass_s(min(1.0, self.guard.tick()))


class StillBench(Bench):
    """The same over a supervisor without tasks, with a fake kernel's device."""

    def __init__(self, folder: Path, clock: JumpingClock, systemd: Notified, kernel: KernelWatchdog) -> None:
        self.still = StillSupervisor([], clock)
        super().__init__(folder, clock, self.still, systemd)
        self.kernel = kernel

    def begin(self) -> None:
        """All tasks have raised their flags."""
        self.still.flags = True
        self.guard.tick()


@contextmanager
def a_fifo(folder: Path) -> Iterator[tuple[Path, Callable[[], bytes]]]:
    """A device that refuses ioctls, and what was written to it since last time."""
    path = folder / "watchdog"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)

    def written() -> bytes:
        try:
            return os.read(reader, 65536)
        except BlockingIOError:
            return b""

    yield path, written
    os.close(reader)


class Whole:
    """A guard over a supervisor that runs, on a clock that jumps, with a FIFO as its device."""

    def __init__(self, folder: Path, clock: JumpingClock, systemd: Notified, path: Path) -> None:
        self.tasks = Tasks()
        plans = [self.tasks.plan(name, kind=Obedient) for name in ("field", "scada")]
        self.bench = Bench(folder, clock, Supervisor(plans, clock), systemd)
        self.bench.configure(str(path))

    def flags(self, run: RunningSupervisor, *names: str) -> None:
        for name in names:
            self.tasks.obedient(name).raise_flag()
        run.look()
