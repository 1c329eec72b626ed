"""A person at the menu, on a fake clock: a station with real masters whose devices are scripted, and its screen.

Nothing waits: a key is typed, the masters work until what the menu waits for is done, and the screen is text.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gateway.clock import Clock
from gateway.config import Config, MasterConfig, SlaveConfig
from gateway.config_checks import cross_check
from gateway.counters import ServeCounters
from gateway.errors import ConfigError, LinkUnavailable
from gateway.hmi.keys import ENTER, KeyDecoder
from gateway.hmi.menu import Dialogue, Menu, Ui
from gateway.hmi.screens.main import main_menu
from gateway.hmi.screens.writes import WriteDisplay
from gateway.hmi.station import Job, SlaveView, Told
from gateway.hmi.texts import translation
from gateway.link import Link
from gateway.master import Master
from gateway.register import DataRegister
from gateway.store import load_text
from gateway.traffic import Tap
from tests.fakes import FakeField, JumpingClock, JumpingWaker, LosableLink

STATIONS = Path(__file__).parent / "stations"
PROMPTS = ("rtugate> ", "rtugate*> ")  # of the main menu
STEPS_MOST = 20_000
SAFE_MODE = "safe mode: {count} bad restarts in a row; all lines are in maintenance"  # as the gateway words it
STALE = "the configuration was changed from elsewhere meanwhile"


@dataclass
class AClient:
    """A SCADA system as the status shows it."""

    name: str
    active_s: float
    since_s: float
    counters: ServeCounters = field(default_factory=ServeCounters)


@dataclass
class ASlave:
    """A slave as the menu sees it; it serves nobody."""

    name: str
    enabled: bool
    config: SlaveConfig
    traffic: Tap
    counters: ServeCounters = field(default_factory=ServeCounters)
    clients: dict[int, AClient] = field(default_factory=dict)
    trouble: str = ""
    ready: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.ready.set()


class DeskStation:
    """A ``hmi.station.Station`` that does everything at once, in the test's own thread; its file is a text.

    is_slow: what takes time is not done before ``finish_work``.
    missing: why a master's port cannot be opened, by the master's name.
    """

    def __init__(self, text: str) -> None:
        self.time = JumpingClock()
        self.clock: Clock = self.time  # the same, as the screens see it
        self.started_s = self.clock.monotonic() - 3700.0
        self.last_restart = Told("clean stop")
        self.safe_until_s: float | None = None
        self.told_watchdog: Told | None = None
        self.config: Config = load_text(text, "rtugate.toml").config
        self.saved: Config | None = self.config
        self.before: Config | None = None  # the last save
        self.confirm_left_s: float | None = None
        self.file_is_edited = False
        self.changed_lines = ["- every = 1.0", "+ every = 2.0"]
        self.save_problem = ""
        self.told_alarms: list[Told] = []
        self.told_notices: list[Told] = []
        self.logged = ["11-22 09:30:00 INFO rtugate runs", "11-22 09:31:12 WARNING field: unit 9 is offline: no reply"]
        self.restarts = 0
        self.is_slow = False
        self.missing: dict[str, str] = {}
        self.links: dict[str, LosableLink] = {}
        self._unfinished: list[tuple[Job, Callable[[], None]]] = []
        self.register = DataRegister(self.clock, self.config.register_.sizes)
        self.fields: dict[str, FakeField] = {}
        self.masters: dict[str, Master] = {}
        self.slaves: dict[str, ASlave] = {}
        self._make_tasks(None)

    # -------------------------------------------------------------------------------------------- the screens' side

    @property
    def is_unsaved(self) -> bool:
        return self.saved != self.config

    def master(self, name: str) -> Master | None:
        return self.masters.get(name)

    def slave(self, name: str) -> SlaveView | None:
        return self.slaves.get(name)

    def alarms(self) -> list[Told]:
        return self.told_alarms

    @property
    def is_safe(self) -> bool:
        return self.safe_until_s is not None

    @property
    def safe_left_s(self) -> float | None:
        return None if self.safe_until_s is None else self.safe_until_s - self.clock.monotonic()

    def end_safe_mode(self, told: Callable[[], None]) -> Job:
        self.leave_safe_mode()
        return self._done(told)

    def watchdog_state(self) -> Told | None:
        return self.told_watchdog

    def notices(self, after: int) -> tuple[int, list[Told]]:
        return len(self.told_notices), self.told_notices[after:]

    def log_lines(self) -> Sequence[str]:
        return self.logged

    def change(self, old: Config, new: Config, told: Callable[[], None]) -> Job:
        errors = [finding for finding in cross_check(new) if finding.severity == "error"]
        if errors:
            raise ConfigError(errors)
        if old is not self.config:
            raise ConfigError([STALE])
        before, self.config = self.config, new
        self._make_tasks(before)
        return self._done(told)

    def undo(self, told: Callable[[], None]) -> Job:
        assert self.saved is not None
        return self.change(self.config, self.saved, told)

    def difference(self) -> list[str]:
        return self.changed_lines

    def is_file_changed(self) -> bool:
        return self.file_is_edited

    def save(self, overwrite: bool, confirm_s: float | None, told: Callable[[], None]) -> Job:
        if self.save_problem or (self.file_is_edited and not overwrite):
            return Job.failed(self.save_problem or "the file was edited")
        self.before, self.saved, self.file_is_edited = self.saved, self.config, False
        self.confirm_left_s = confirm_s
        return self._done(told)

    def confirm(self, told: Callable[[], None]) -> Job:
        self.confirm_left_s = None
        return self._done(told)

    def revert(self, told: Callable[[], None]) -> Job:
        assert self.before is not None
        self.confirm_left_s, self.saved = None, self.before
        return self.change(self.config, self.before, told)

    def reload(self, told: Callable[[], None]) -> Job:
        assert self.saved is not None
        self.file_is_edited = False
        return self.change(self.config, self.saved, told)

    def restart(self) -> None:
        self.restarts += 1

    def in_background(self, work: Callable[[], None], told: Callable[[], None]) -> Job:
        work()
        return self._done(told)

    # -------------------------------------------------------------------------------------------- the test's side

    def step(self) -> None:
        """Have each master do one thing; time passes in any case."""
        for master in list(self.masters.values()):
            master.step()
        if not self.masters:
            self.time.pass_s(0.1)

    def pass_s(self, seconds: float) -> None:
        """Have the masters work for *seconds*; nobody is at the menu yet."""
        end_s = self.clock.monotonic() + seconds
        while self.clock.monotonic() < end_s:
            self.step()

    def enter_safe_mode(self, left_s: float) -> None:
        """Be as after three bad restarts; it ends by itself in *left_s* seconds."""
        self.safe_until_s = self.clock.monotonic() + left_s
        self.told_alarms.insert(0, Told(SAFE_MODE, {"count": 3}))
        self._switch_lines()

    def leave_safe_mode(self) -> None:
        """Have all lines run as configured."""
        self.safe_until_s = None
        self.told_alarms = [alarm for alarm in self.told_alarms if alarm.text != SAFE_MODE]
        self._switch_lines()

    def finish_work(self, problem: str = "") -> None:
        """Be done with what took long; *problem*: it has failed."""
        for job, told in self._unfinished:
            job.problem = problem
            job.finish()
            told()
        self._unfinished.clear()

    def reload_from_elsewhere(self) -> None:
        """Have the file run again, as SIGHUP does: the same settings, but another ``Config``."""
        assert self.saved is not None
        before, self.config = (
            self.config,
            Config.model_validate(self.saved.model_dump(exclude_unset=True, by_alias=True)),
        )
        self.saved = self.config
        self._make_tasks(before)

    def unplug(self, name: str, reason: str) -> None:
        """Take the adapter of a master's line away."""
        self.missing[name] = reason
        self.links[name].lose = "write"

    def _done(self, told: Callable[[], None]) -> Job:
        job = Job()
        self._unfinished.append((job, told))
        if not self.is_slow:
            self.finish_work()
        return job

    def _make_tasks(self, before: Config | None) -> None:
        """Make anew what differs from *before*."""
        known = {line.name: line for line in (before.master if before else [])}
        for name in list(self.masters):
            if known[name] not in self.config.master:
                self.masters.pop(name).close()
        for line in self.config.master:
            if line.name not in self.masters:
                self.masters[line.name] = self._a_master(line)
        slaves, self.slaves = self.slaves, {}
        for slave in self.config.slave:
            kept = slaves.get(slave.name)
            if kept is None or kept.config != slave:
                kept = ASlave(slave.name, slave.enabled, slave, self._a_tap(slave))
            self.slaves[slave.name] = kept
        self._switch_lines()

    def _switch_lines(self) -> None:
        """Have each line work that is on, outside safe mode."""
        for line in self.config.master:
            works = line.enabled and not self.is_safe
            if self.masters[line.name].enabled != works:
                self.masters[line.name].set_enabled(works)
        for slave in self.config.slave:
            self.slaves[slave.name].enabled = slave.enabled and not self.is_safe

    def _a_tap(self, slave: SlaveConfig) -> Tap:
        return Tap(slave.framing_used, self.clock, slave.character_timeout_used, slave.unit)

    def _a_master(self, line: MasterConfig) -> Master:
        device = self.fields.setdefault(line.name, FakeField(self.time, line.framing_used))
        device.framing = line.framing_used
        return Master(line, self.register, self.clock, JumpingWaker(self.time), lambda: self._open(line.name, device))

    def _open(self, name: str, device: FakeField) -> Link:
        if name in self.missing:
            raise LinkUnavailable(self.missing[name])
        self.links[name] = LosableLink(self.time, device)
        return self.links[name]


class Desk:
    """A terminal with a person at it: ``type`` keys, look at ``screen``.

    is_working: the masters work while the menu waits for them; False: everything stands still.
    echoes: the terminal shows what is typed where the menu does not.
    """

    def __init__(
        self, station: DeskStation, language: str = "en", is_ascii: bool = False, rows: int = 24, columns: int = 80
    ) -> None:
        self.station = station
        self.is_working = self.echoes = True
        self.ui = Ui(station.clock, translation(language))
        self.menu = Menu(self._main_menu, self.ui, lambda: is_ascii)
        self.menu.rows, self.menu.columns = rows, columns
        self.screen = self.menu.start()

    def _main_menu(self, ui: Ui) -> Dialogue[None]:
        return main_menu(ui, self.station, lambda: WriteDisplay(self.station.register, self.station.clock))

    def type(self, keys: str) -> str:
        """Type *keys* ("\\r" is Enter), each when the menu is ready for it; return what they brought to the screen."""
        before = len(self.screen)
        decoder = KeyDecoder()
        if self.echoes and not self.menu.echoes:  # at once; then it sends the line
            self.screen += keys.replace(ENTER, "\n")
        for character in keys:
            decoder.receive(character.encode())
            decoder.pause()
            while (key := decoder.next_key()) is not None:
                self.screen += self.menu.key(key)
                self.work()
        self.screen += self.menu.pause()
        return self.screen[before:]

    @property
    def told(self) -> str:
        """What was said last, above the prompt."""
        return self.screen.splitlines()[-2]

    def wait(self, seconds: float) -> str:
        """Let *seconds* pass at the station; return what they brought to the screen."""
        before = len(self.screen)
        end_s = self.station.clock.monotonic() + seconds
        while self.station.clock.monotonic() < end_s:
            self.station.step()
            self.screen += self.menu.tick()
        self.screen += self.menu.tick()
        return self.screen[before:]

    def work(self) -> None:
        """Have the masters work until the menu waits for a person."""
        for _ in range(STEPS_MOST):
            if not (self.menu.is_busy and self.is_working):
                return
            self.station.step()
            self.screen += self.menu.tick()
        raise AssertionError("the menu waits for ever")


def desk_of(station: str) -> Desk:
    """Return the menu of a station of the folder stations."""
    return Desk(DeskStation((STATIONS / f"{station}.toml").read_text()))
