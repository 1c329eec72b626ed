"""What the menu can see and do of the station: the window between screens and the running gateway.

Protocols only: ``running.Gateway`` is the station there is, and the tasks themselves are the masters and slaves.
Everything here may be called from any terminal's thread and waits for nothing; what takes time is a ``Job``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from gateway.clock import Clock
from gateway.config import Config, MasterConfig, SlaveConfig
from gateway.counters import PollCounters, ServeCounters
from gateway.hmi.wording import Translate
from gateway.modbus.pdu import AnyRequest
from gateway.polls import Device, Poll
from gateway.register import DataRegister
from gateway.tickets import Ticket
from gateway.traffic import Tap


@dataclass(frozen=True)
class Told:
    """Something to tell a person, in any language: an English text with {names}, and what stands for them."""

    text: str
    values: Mapping[str, object] = field(default_factory=dict)

    def words(self, _: Translate) -> str:
        """Return it in a person's language."""
        return _(self.text).format(**self.values)


@dataclass(eq=False)
class Job:
    """Something that another thread does for the menu.

    problem: why it failed, for a person; "" when it did not.
    remarks: what else there is to tell.
    """

    done: threading.Event = field(default_factory=threading.Event)
    problem: str = ""
    remarks: list[str] = field(default_factory=list)

    @classmethod
    def failed(cls, problem: str) -> Job:
        """Return a job that has come to nothing already."""
        job = cls(problem=problem)
        job.finish()
        return job

    @property
    def is_done(self) -> bool:
        """Whether there is nothing more to wait for."""
        return self.done.is_set()

    def finish(self) -> None:
        """There is nothing more to do."""
        self.done.set()


class LineView(Protocol):
    """What masters and slaves have in common."""

    name: str
    enabled: bool
    traffic: Tap
    ready: threading.Event  # its line is open, or it has been said why not

    @property
    def trouble(self) -> str:
        """Why the line cannot be used; "" while it can."""
        ...


class MasterView(LineView, Protocol):
    """A master at work; see ``master.Master``."""

    config: MasterConfig
    counters: PollCounters
    polls: list[Poll]
    devices: dict[int, Device]

    @property
    def busy_share(self) -> float:
        """Share of the line's time in use, 0 to 1, silences and listening included."""
        ...

    def state(self) -> str:
        """Return what the line does."""
        ...

    def submit(self, unit: int, request: AnyRequest, told: Callable[[], None] | None = None) -> Ticket:
        """Queue a command."""
        ...


class ClientView(Protocol):
    """A TCP client of a slave."""

    name: str
    active_s: float
    since_s: float

    @property
    def counters(self) -> ServeCounters:
        """What it asked."""
        ...


class SlaveView(LineView, Protocol):
    """A slave at work; see ``slave.SerialSlave`` and ``slave_tcp.TcpSlave``."""

    config: SlaveConfig

    @property
    def counters(self) -> ServeCounters:
        """What was asked and answered."""
        ...

    @property
    def clients(self) -> Mapping[int, ClientView]:
        """TCP clients; none on a serial line."""
        ...


class Station(Protocol):
    """The running gateway as a terminal sees it."""

    clock: Clock
    register: DataRegister
    started_s: float  # monotonic
    last_restart: Told  # why it was started last

    @property
    def config(self) -> Config:
        """The configuration that runs."""
        ...

    @property
    def is_unsaved(self) -> bool:
        """Whether the file says something else than what runs."""
        ...

    def master(self, name: str) -> MasterView | None:
        """Return the master of that name; None while it is being made anew."""
        ...

    def slave(self, name: str) -> SlaveView | None:
        """Return the slave of that name; None while it is being made anew."""
        ...

    def alarms(self) -> list[Told]:
        """Return what a person should know of, worst first."""
        ...

    @property
    def is_safe(self) -> bool:
        """Whether it runs in safe mode: after three bad restarts in a row, all lines in maintenance (section 7)."""
        ...

    @property
    def safe_left_s(self) -> float | None:
        """How long until safe mode ends by itself, for one more try; None: there is no safe mode."""
        ...

    def end_safe_mode(self, told: Callable[[], None]) -> Job:
        """Have all lines run as configured again; does nothing where there is no safe mode."""
        ...

    def watchdog_state(self) -> Told | None:
        """Return how the hardware watchdog fares; None where none is configured."""
        ...

    def notices(self, after: int) -> tuple[int, list[Told]]:
        """Return how many things whoever has the menu was to be told so far, and those beyond the first *after*."""
        ...

    def log_lines(self) -> Sequence[str]:
        """Return the newest log lines, oldest first."""
        ...

    def change(self, old: Config, new: Config, told: Callable[[], None]) -> Job:
        """Have *new* run instead of *old*; *told* is called when it does.

        raises: ConfigError: *new* has errors, or *old* no longer runs; nothing has changed then.
        """
        ...

    def undo(self, told: Callable[[], None]) -> Job:
        """Have what the file says run again."""
        ...

    def difference(self) -> list[str]:
        """Return what a save would change in the file, as lines for a person. Raises ConfigError."""
        ...

    def is_file_changed(self) -> bool:
        """Whether somebody has edited the file since it was loaded or saved."""
        ...

    def save(self, overwrite: bool, confirm_s: float | None, told: Callable[[], None]) -> Job:
        """Write the configuration that runs into the file.

        overwrite: whatever stands there now.
        confirm_s: without ``confirm`` within so many seconds, what was saved before comes back by itself.
        """
        ...

    @property
    def confirm_left_s(self) -> float | None:
        """How long the last save still waits for its confirmation; None: it does not."""
        ...

    def confirm(self, told: Callable[[], None]) -> Job:
        """The last save is good."""
        ...

    def revert(self, told: Callable[[], None]) -> Job:
        """The last save is not good: what was saved before comes back."""
        ...

    def reload(self, told: Callable[[], None]) -> Job:
        """Have the file as it is now run; unsaved changes are dropped."""
        ...

    def restart(self) -> None:
        """End the program and begin it anew."""
        ...

    def in_background(self, work: Callable[[], None], told: Callable[[], None]) -> Job:
        """Do *work*, which may take seconds, in a thread of its own."""
        ...
