"""`rtugate run`: from a file to a gateway that runs, with its terminals, until a signal ends it.

What it is: the order in which things come up, and what each signal means. Whatever the file looks like, it starts.
What it refuses: a second gateway with the same control socket (exit code 1).

Threads: the main one, and one that waits for signals. A handler would run in the main thread, and be as late as that
one waits: the signal may come just before it begins to.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from socket import socket
from typing import Final

from gateway import __version__
from gateway.clock import Clock, SystemClock
from gateway.config_file import ConfigFile
from gateway.errors import GatewayError, LinkError
from gateway.guard import Guard
from gateway.hmi.access import Lockout
from gateway.hmi.control import AlreadyRunning, open_control
from gateway.hmi.menu import Menu, Ui
from gateway.hmi.screens.main import main_menu
from gateway.hmi.screens.writes import WriteDisplay
from gateway.hmi.seat import Seat
from gateway.hmi.session import Shared
from gateway.hmi.station import Job, Told
from gateway.hmi.texts import translation
from gateway.hmi.wording import Translate
from gateway.logs import LogRing, RateLimited, console_formatter
from gateway.restart_cause import BY_MENU, CLEAN, LastRun
from gateway.retained import FILE_NAME, RetainedFile
from gateway.running import Gateway
from gateway.safe_mode import SafeMode
from gateway.stacks import FILE_NAME as STACKS
from gateway.stacks import Backstop, is_in_use, read_evidence
from gateway.status import status, status_line
from gateway.systemd import Systemd
from gateway.wiring import control_plan, terminal_plans

SIGNALS: Final = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGHUP})
WORK_LIMIT_S: Final = 60.0  # for a save on a slow card, for tasks that are made anew
STOP_WORK_LIMIT_S: Final = 0.5  # for a save while it is stopped: what is cut off leaves the old file as it was
SWITCH_INTERVAL_S: Final = 0.0005  # how long a slave's answer may wait for another thread that computes

log = logging.getLogger("gateway")


def run_service(path: Path, state: Path, control_path: Path) -> int:
    """Run the gateway of the file at *path*; return the exit code. *state*: its folder for what it keeps."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # for all threads: one that comes waits until it is heeded
    clock = SystemClock()
    ring, limiter = _start_logging(clock)
    _make_state(state)
    try:
        with _control_listener(control_path) as listen, _bugs_end_it():
            if is_in_use(state / STACKS):  # by one whose control socket is elsewhere, or was removed
                log.error("rtugate runs already (state directory %s)", state)
                return 1
            service = _Service(path, state, clock, ring)
            service.gateway.supervisor.chores.append(limiter.flush_due)
            service.run(listen)
    except AlreadyRunning as error:
        log.error("%s", error)
        return 1
    if service.gateway.wants_restart:
        limiter.tell_rest()
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606 - ourselves, as we were called
    return 0


@contextlib.contextmanager
def _bugs_end_it() -> Iterator[None]:
    """A bug in the main thread ends the program at once, whatever other threads there still are."""
    try:
        yield
    except BaseException:
        log.critical("rtugate: ended with an error", exc_info=True)
        os._exit(1)


class _Service:
    """The gateway, what guards it, and how it ended last."""

    def __init__(self, path: Path, state: Path, clock: Clock, ring: LogRing) -> None:
        self._last_run = LastRun(state)
        beginning = self._last_run.begin(read_evidence(state / STACKS))
        self.gateway = Gateway(ConfigFile(path, state, clock), clock, ring, RetainedFile(state / FILE_NAME))
        self.gateway.last_restart = beginning.cause
        count = beginning.bad_in_row
        self.gateway.safe_mode = SafeMode(clock, count, self._last_run.lasted, self._last_run.forgiven)
        self._guard = Guard(
            self.gateway.supervisor,
            clock,
            self._last_run,
            Backstop(state / STACKS),
            Systemd.from_environment(clock),
            lambda: self.gateway.wants_restart,
        )

    def run(self, listen: Callable[[], socket]) -> None:
        """Run until a signal or the menu ends it. A task that does not end then ends the process."""
        if not self._run(listen):
            self._guard.did_not_stop()
        limit_s = WORK_LIMIT_S if self.gateway.wants_restart else STOP_WORK_LIMIT_S
        self.gateway.finish_work(limit_s, self._guard.tick)  # a save would be cut off in the middle
        self._guard.close()
        self._last_run.end(BY_MENU if self.gateway.wants_restart else CLEAN)
        log.info("stopped", extra={"is_unlimited": True})

    def _run(self, listen: Callable[[], socket]) -> bool:
        gateway, guard = self.gateway, self._guard
        shared = shared_of(gateway)
        control = control_plan(shared, listen, {"reload": self._reload_now, "status": partial(status, gateway)})
        gateway.terminal_plans = lambda config: terminal_plans(config, shared, control)
        gateway.adopted = lambda config: guard.configure(config.watchdog)
        gateway.guards_alarms, gateway.guards_state = guard.alarms, guard.device_state
        guard.status, guard.has_reset = partial(status_line, gateway), self._was_reset
        config = gateway.config
        gateway.adopted(config)
        log.setLevel(config.log.level.upper())
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        log.info("rtugate %s runs: %d masters, %d slaves", __version__, len(config.master), len(config.slave))
        log.info("last restart: %s", gateway.last_restart.words(str))
        if gateway.is_safe:
            count = gateway.safe_mode.bad_in_row
            log.error("safe mode: %d bad restarts in a row; all lines are in maintenance", count)
        with _signals_heeded(gateway, self._reload):
            return gateway.run()

    def _was_reset(self, cause: Told) -> None:
        self.gateway.last_restart = cause
        log.info("last restart: %s", cause.words(str))

    def _reload(self) -> Job:
        """Load the file anew; systemd is told when that begins and ends. From any thread."""
        submit, systemd = self.gateway.supervisor.submit, self._guard.systemd
        submit(systemd.reloading)
        return self.gateway.reload(lambda: submit(systemd.ready))

    def _reload_now(self, _argument: str) -> str:
        """The control socket's command: load the file anew, and say how that went."""
        job = self._reload()
        if not job.done.wait(WORK_LIMIT_S):
            raise GatewayError("this takes unusually long; see the log")
        if job.problem:
            raise GatewayError(job.problem)
        return "reloaded"


def _make_state(state: Path) -> None:
    """Where the folder cannot be made, whoever wants to keep something there says so."""
    with contextlib.suppress(OSError):
        state.mkdir(mode=0o750, parents=True, exist_ok=True)


def _start_logging(clock: Clock) -> tuple[LogRing, RateLimited]:
    ring, console = LogRing(), logging.StreamHandler(sys.stderr)
    console.setFormatter(console_formatter(os.environ.get("JOURNAL_STREAM", ""), _stat_of_stderr()))
    limiter = RateLimited(clock, [console, ring])
    logging.basicConfig(handlers=[limiter], level=logging.WARNING)
    log.setLevel(logging.INFO)
    return ring, limiter


def _stat_of_stderr() -> os.stat_result | None:
    try:
        return os.fstat(sys.stderr.fileno())
    except (OSError, AttributeError):  # closed from the start
        return None


@contextlib.contextmanager
def _control_listener(path: Path) -> Iterator[Callable[[], socket]]:
    """Open the control socket now, to see whether another gateway has it; give what hands it to its task.

    raises: AlreadyRunning. A folder that is not there is an alarm of the task.
    """
    opened: list[socket] = []
    try:
        opened.append(open_control(path))
    except AlreadyRunning:
        raise
    except LinkError:
        pass  # the task tries again, and says why it cannot
    try:
        yield lambda: opened.pop() if opened else open_control(path)
    finally:
        for never_used in opened:  # a signal came before the task
            never_used.close()
            path.unlink(missing_ok=True)


def shared_of(gateway: Gateway) -> Shared:
    """Return what all terminals of *gateway* have in common."""
    clock = gateway.clock

    def hold_s() -> float:
        hmi = gateway.config.hmi
        return hmi.serial_hold if hmi.serial.line else 0.0

    def translate() -> Translate:
        return translation(gateway.config.hmi.language, gateway.config.hmi.ascii)

    def make_menu(_who: str, wake: Callable[[], None]) -> Menu:
        ui = Ui(clock, translate(), wake)
        display = partial(WriteDisplay, gateway.register, clock)
        return Menu(lambda ui: main_menu(ui, gateway, display), ui, lambda: gateway.config.hmi.ascii)

    return Shared(
        clock=clock,
        seat=Seat(clock, hold_s),
        make_menu=make_menu,
        hmi=lambda: gateway.config.hmi,
        lockout=Lockout(clock),
        passwords=gateway.background,
        translation=translate,
    )


@contextlib.contextmanager
def _signals_heeded(gateway: Gateway, reload: Callable[[], object]) -> Iterator[None]:
    """Do meanwhile what signals ask for; those that come later are for the program that takes this one's place."""
    acts: dict[int, Callable[[], object]] = {
        signal.SIGTERM: gateway.stop,
        signal.SIGINT: gateway.stop,
        signal.SIGHUP: reload,
    }
    is_over = threading.Event()

    def wait() -> None:
        while True:
            number = signal.sigwait(SIGNALS)
            if is_over.is_set():
                break
            acts[number]()
        if number != signal.SIGHUP:  # which ends this wait, and asks for nothing that the next start does not do
            os.kill(os.getpid(), number)

    thread = threading.Thread(target=wait, name="signals")
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        signal.pthread_kill(thread.ident or 0, signal.SIGHUP)
        thread.join()
