"""The running gateway: its configuration, and how that changes while it runs (spec sections 5 and 6).

What it is: the ``hmi.station.Station`` that terminals see, and what the control socket and the signals talk to. It
holds the configuration that runs and the file it is saved in, and has the supervisor restart what a change touches.
What it refuses: deciding what a task is made of (``wiring``), judging a configuration (``config_checks``), writing
files (``store``).

Threads: everything may be called from any thread. Configurations are swapped under one lock, a leaf; tasks are stopped
and started in the supervisor's thread; files are read and written in one of their own, one thing after the other.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

from gateway.clock import Clock
from gateway.config import Config
from gateway.config_checks import cross_check
from gateway.config_file import ConfigFile, log_findings
from gateway.errors import ConfigError, GatewayError, SaveError
from gateway.hmi.background import Background
from gateway.hmi.station import Job, Told
from gateway.hmi.wording import N_
from gateway.logs import LogRing
from gateway.master import Master
from gateway.restart_cause import SAFE_AFTER
from gateway.retained import RetainedFile
from gateway.safe_mode import SafeMode
from gateway.slave import SerialSlave
from gateway.slave_tcp import TcpSlave
from gateway.supervisor import TICK_MOST_S, Plan, Supervisor
from gateway.wiring import Station

NOTICES_KEPT: Final = 5
GOOD_AFTER_S: Final = 60.0  # of running without a task that fails or hangs, a configuration has proved good
STALE: Final = N_("the configuration was changed from elsewhere meanwhile: nothing was done, please look again")
FAILED: Final = N_("it failed; the log says why")
STOPS: Final = "rtugate stops"

log = logging.getLogger(__name__)


class Gateway:
    """The gateway as a whole; see the module."""

    def __init__(self, file: ConfigFile, clock: Clock, log_ring: LogRing, retained: RetainedFile | None = None) -> None:
        """*file*: not read yet. *retained*: where values survive a restart; None: nowhere."""
        self.file = file
        self.path = file.path
        self.clock = clock
        self.started_s = clock.monotonic()
        self._lock = threading.Lock()
        self._config = self._first = file.start()
        self.station = Station(self._config, clock, retained)
        if retained is not None and file.saved is not None and not file.saved.register_.retain:
            retained.forget()
        self.register = self.station.register
        self.wants_restart = False
        self.terminal_plans: Callable[[Config], list[Plan]] = lambda config: []  # noqa: ARG005 - set by whoever has some
        self.supervisor = Supervisor([], clock)
        self.supervisor.chores += [self._look_after_file, self._look_after_safe_mode]
        self.last_restart = Told(N_("not known"))
        self.safe_mode = SafeMode(clock)
        self.adopted: Callable[[Config], None] = lambda config: None  # noqa: ARG005 - told what runs, in the main thread
        self.guards_alarms: Callable[[], list[Told]] = list
        self.guards_state: Callable[[], Told | None] = lambda: None
        self.background = Background("slow work", clock)  # hashes, saves: one at a time
        self._good_since_s = clock.monotonic()  # set before the configuration that it is about
        self._kept_good: Config | None = None
        self._unfinished: set[Job] = set()  # that wait for the supervisor
        self._has_ended = False
        self._reverting: Job | None = None
        self._log_ring = log_ring
        self._notices: deque[Told] = deque(maxlen=NOTICES_KEPT)
        self._noticed = 0

    # -------------------------------------------------------------------------------------------- looking

    @property
    def config(self) -> Config:
        """The configuration that runs."""
        return self._config

    @property
    def is_unsaved(self) -> bool:
        """Whether the file, as it was loaded or saved last, says something else."""
        return self.file.saved != self._config

    def master(self, name: str) -> Master | None:
        """Return the master of that name; None while it is being made anew."""
        task = self.supervisor.tasks.get(name)
        return task if isinstance(task, Master) else None

    def slave(self, name: str) -> SerialSlave | TcpSlave | None:
        """Return the slave of that name; None while it is being made anew."""
        task = self.supervisor.tasks.get(name)
        return task if isinstance(task, SerialSlave | TcpSlave) else None

    def alarms(self) -> list[Told]:
        """Return what a person should know of, worst first."""
        found = [*self._safe_mode_alarm(), *self.file.alarms, *self.guards_alarms()]
        if slow := self.background.trouble:
            found.append(Told(N_("{name}: {trouble}"), {"name": "rtugate", "trouble": slow}))
        for name, task in self.supervisor.tasks.items():
            trouble = str(getattr(task, "trouble", ""))
            if trouble:
                found.append(Told(N_("{name}: {trouble}"), {"name": name, "trouble": trouble}))
            offline = (
                sorted(unit for unit, device in task.devices.items() if device.is_offline)
                if isinstance(task, Master)
                else []
            )
            if offline:
                units = ", ".join(str(unit) for unit in offline)
                found.append(Told(N_("{name}: offline: unit {units}"), {"name": name, "units": units}))
        return found

    def notices(self, after: int) -> tuple[int, list[Told]]:
        """Return how many things whoever has the menu was to be told so far, and those beyond the first *after*."""
        with self._lock:
            count, kept = self._noticed, list(self._notices)
        return count, kept[max(0, len(kept) - (count - after)) :] if count > after else []

    def _notice(self, text: str, **values: object) -> None:
        with self._lock:
            self._notices.append(Told(text, values))
            self._noticed += 1

    def log_lines(self) -> Sequence[str]:
        """Return the newest log lines, oldest first."""
        return self._log_ring.lines()

    # -------------------------------------------------------------------------------------------- changing

    def run(self, started: Callable[[], None] = lambda: None) -> bool:
        """Run until ``stop``; False if a task did not end in time. In the main thread."""
        config = self._config

        def begin() -> None:
            self.supervisor.change(self._plans(config), lambda: self.station.adopt(config))
            started()

        try:
            is_clean = self.supervisor.run(begin)
        finally:
            self._has_ended = True
            self._give_up()
        if is_clean:
            self.station.save_last()
        return is_clean

    def stop(self) -> None:
        """Have ``run`` end, and not begin anew; from any thread and from a signal handler."""
        self.wants_restart = False
        self.supervisor.stop()

    def restart(self) -> None:
        """Have ``run`` end, and whoever called it begin anew."""
        self.wants_restart = True
        self.supervisor.stop()

    def finish_work(self, limit_s: float, meanwhile: Callable[[], float] = lambda: TICK_MOST_S) -> bool:
        """Wait until the saves that were asked for are done; False after *limit_s*.

        meanwhile: done at least once a second while it waits; says after how long to do so again.
        """
        done = threading.Event()
        self.background.run(done.set)
        while limit_s > 0 and not done.wait(wait_s := min(limit_s, meanwhile(), TICK_MOST_S)):
            limit_s -= wait_s
        return done.is_set()

    def change(self, old: Config, new: Config, told: Callable[[], None]) -> Job:
        """Have *new* run instead of *old*; raises ConfigError, with every finding, and nothing has changed."""
        errors = [finding for finding in cross_check(new) if finding.severity == "error"]
        if errors:
            raise ConfigError(errors)
        with self._lock:
            if old is not self._config:
                raise ConfigError([STALE])
            self._good_since_s, self._config = self.clock.monotonic(), new
        return self._put_to_work(new, Job(), told)

    def undo(self, told: Callable[[], None]) -> Job:
        """Have what was loaded or saved last run again."""
        saved = self.file.saved
        return (
            Job.failed(N_("there is nothing to go back to"))
            if saved is None
            else self.change(self._config, saved, told)
        )

    def _swap(self, config: Config) -> Config:
        """Have *config* be the one that runs from now on, whatever was; return that."""
        with self._lock:
            before, self._good_since_s, self._config = self._config, self.clock.monotonic(), config
        return before

    def _put_to_work(self, config: Config, job: Job, told: Callable[[], None]) -> Job:
        """Have the supervisor restart what differs; a job that is overtaken by a newer one has nothing left to do."""

        def carry_out() -> None:
            if config is self._config:
                self.supervisor.change(self._plans(config), lambda: self.station.adopt(config))
                logging.getLogger("gateway").setLevel(config.log.level.upper())
                self.adopted(config)
            with self._lock:
                self._unfinished.discard(job)
            job.finish()
            told()

        with self._lock:
            self._unfinished.add(job)
        self.supervisor.submit(carry_out)
        if self._has_ended:
            self._give_up()
        return job

    def _give_up(self) -> None:
        """Have nobody wait for what the supervisor will not do any more."""
        with self._lock:
            unfinished, self._unfinished = self._unfinished, set()
        for job in unfinished:
            job.problem = STOPS
            job.finish()

    def _plans(self, config: Config) -> list[Plan]:
        plans = self.station.plans_for(config)
        if self.safe_mode.is_on:
            plans = [replace(plan, enabled=False) for plan in plans]
        return self.terminal_plans(config) + plans

    # -------------------------------------------------------------------------------------------- safe mode

    def watchdog_state(self) -> Told | None:
        """Return how the hardware watchdog fares; None if there is to be none."""
        return self.guards_state()

    @property
    def is_safe(self) -> bool:
        """Whether it runs in safe mode: all lines in maintenance."""
        return self.safe_mode.is_on

    @property
    def safe_left_s(self) -> float | None:
        """How long until it tries once more by itself; None when not in safe mode."""
        return self.safe_mode.left_s

    def end_safe_mode(self, told: Callable[[], None] = lambda: None, row: int = 0) -> Job:
        """Have all lines run as configured; *row* bad restarts count all the same."""
        self.supervisor.submit(lambda: self._leave_safe_mode(row))
        return self._put_to_work(self._config, Job(), told)

    def _leave_safe_mode(self, row: int) -> None:
        if self.safe_mode.end(row):
            self._good_since_s = self.clock.monotonic()  # what ran until now proves nothing
            log.warning("safe mode is over: all lines run as configured")

    def _look_after_safe_mode(self) -> float:
        return self.safe_mode.look(self._try_once_more)

    def _try_once_more(self) -> None:
        self._notice(N_("Safe mode is over: all lines run as configured."))
        self.end_safe_mode(row=SAFE_AFTER - 1)

    def _safe_mode_alarm(self) -> list[Told]:
        text = N_("safe mode: {count} bad restarts in a row; all lines are in maintenance")
        return [Told(text, {"count": self.safe_mode.bad_in_row})] if self.safe_mode.is_on else []

    # -------------------------------------------------------------------------------------------- what is due

    def _look_after_file(self) -> float:
        """Undo a save that nobody confirmed, keep what has proved good; return after how long to look again."""
        left_s = self.file.confirm_left_s
        if left_s is not None:
            if left_s <= 0 and (self._reverting is None or self._reverting.is_done):
                self._reverting = self.revert()
            return left_s or GOOD_AFTER_S
        config, settled = self._config, self.file.settled
        since_s = max(self._good_since_s, self.supervisor.failed_s or 0.0)
        wait_s = since_s + max(GOOD_AFTER_S, config.watchdog.timeout) - self.clock.monotonic()
        if wait_s > 0:
            return wait_s
        if self.safe_mode.is_on:  # it proves nothing
            return GOOD_AFTER_S
        if settled is not None and settled is not self._kept_good and settled == config:
            self._kept_good = settled
            self.in_background(lambda: self._keep_good(settled), lambda: None)
        return GOOD_AFTER_S

    def _keep_good(self, config: Config) -> None:
        try:
            self.file.keep_good(config)
        except SaveError as error:
            log.warning("the last good configuration is not kept: %s", error)

    # -------------------------------------------------------------------------------------------- the file

    def difference(self) -> list[str]:
        """Return what a save would change in the file, as lines for a person. Raises SaveError."""
        return self.file.difference(self._config)

    def is_file_changed(self) -> bool:
        """Whether somebody has edited the file since it was loaded or saved."""
        return self.file.is_edited()

    def save(self, overwrite: bool, confirm_s: float | None, told: Callable[[], None]) -> Job:
        """Write the configuration that runs into the file; see ``ConfigFile.save``."""
        remarks: list[str] = []
        config, basis = self._config, self.file.saved

        def work() -> None:
            if self.file.saved is not basis:  # loaded anew since: its text is not what the person has seen
                raise SaveError(STALE)
            remarks.extend(self.file.save(config, overwrite, confirm_s))

        return self._in_turn(work, told, remarks)

    @property
    def confirm_left_s(self) -> float | None:
        """How long the last save still waits for its confirmation; None: it does not."""
        return self.file.confirm_left_s

    def confirm(self, told: Callable[[], None]) -> Job:
        """The last save is good."""
        remarks: list[str] = []
        return self._in_turn(lambda: remarks.extend(self.file.confirm()), told, remarks)

    def revert(self, told: Callable[[], None] = lambda: None) -> Job:
        """The last save is not confirmed: the previous file and configuration come back."""

        def work() -> Config | None:
            config = self.file.revert()
            if config is not None:
                self._swap(config)
                self._notice(N_("The last save was not confirmed: what was saved before runs again."))
            return config

        return self._in_turn(work, told)

    def reload(self, told: Callable[[], None] = lambda: None) -> Job:
        """Have the file as it is now run; a bad file changes nothing. Unsaved changes are dropped, and logged."""

        def work() -> Config:
            saved = self.file.saved or self._first
            config = self._reloaded()
            self.supervisor.submit(lambda: self._leave_safe_mode(0))
            if self._swap(config) != saved:
                log.warning("%s: unsaved changes of the menu are dropped", self.path.name)
                self._notice(N_("The file has been reloaded; unsaved changes of this menu are gone."))
            else:
                self._notice(N_("The file has been reloaded."))
            log.info("%s: reloaded", self.path.name)
            return config

        return self._in_turn(work, told)

    def _reloaded(self) -> Config:
        try:
            return self.file.reload()
        except ConfigError as error:
            log_findings(error)
            log.error("%s: not reloaded, nothing has changed", self.path.name, extra={"is_unlimited": True})
            self.file.refused(error)
            raise ConfigError([f"not reloaded, nothing has changed: {error.findings[0]}"]) from error

    def in_background(self, work: Callable[[], None], told: Callable[[], None]) -> Job:
        """Do *work* in a thread of its own, when its turn comes; what it raises on purpose is the job's problem."""
        return self._in_turn(work, told)

    def _in_turn(
        self, work: Callable[[], Config | None], told: Callable[[], None], remarks: list[str] | None = None
    ) -> Job:
        """Do *work* in the background; if it returns a configuration, the job is done once that runs."""
        job = Job(remarks=[] if remarks is None else remarks)

        def run() -> None:
            config, problem = None, FAILED
            try:
                config, problem = work(), ""
            except GatewayError as error:
                problem = str(error)
            finally:
                job.problem = problem
                if config is None:
                    job.finish()
                    told()
                else:
                    self._put_to_work(config, job, told)

        self.background.run(run)
        return job
