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
from gateway.clock import SystemClock
from gateway.config_file import ConfigFile
from gateway.errors import GatewayError, LinkError
from gateway.hmi.access import Lockout
from gateway.hmi.control import AlreadyRunning, open_control
from gateway.hmi.menu import Menu, Ui
from gateway.hmi.screens.main import main_menu
from gateway.hmi.screens.writes import WriteDisplay
from gateway.hmi.seat import Seat
from gateway.hmi.session import Shared
from gateway.hmi.texts import translation
from gateway.hmi.wording import Translate
from gateway.logs import LogRing, SafeFormatter
from gateway.restart_cause import BY_MENU, CLEAN, LastRun
from gateway.retained import FILE_NAME, RetainedFile
from gateway.running import Gateway
from gateway.status import status
from gateway.wiring import control_plan, terminal_plans

SIGNALS: Final = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGHUP})
WORK_LIMIT_S: Final = 60.0  # for a save on a slow card, for tasks that are made anew
SWITCH_INTERVAL_S: Final = 0.0005  # how long a slave's answer may wait for another thread that computes

log = logging.getLogger("gateway")


def run_service(path: Path, state: Path, control_path: Path) -> int:
    """Run the gateway of the file at *path*; return the exit code. *state*: its folder for what it keeps."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # for all threads: one that comes waits until it is heeded
    ring = _start_logging()
    _make_state(state)
    clock = SystemClock()
    try:
        with _control_listener(control_path) as listen:
            gateway = Gateway(ConfigFile(path, state, clock), clock, ring, RetainedFile(state / FILE_NAME))
            is_clean = _run(gateway, LastRun(state), listen)
    except AlreadyRunning as error:
        log.error("%s", error)
        return 1
    if gateway.wants_restart:
        gateway.finish_work(WORK_LIMIT_S)  # a save would be cut off in the middle
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606 - ourselves, as we were called
    return 0 if is_clean else 1


def _run(gateway: Gateway, last_run: LastRun, listen: Callable[[], socket]) -> bool:
    """Run *gateway* until a signal or its menu ends it; return whether all its tasks have ended."""
    log.setLevel(gateway.config.log.level.upper())
    shared = shared_of(gateway)
    control = control_plan(shared, listen, {"reload": partial(_reload, gateway), "status": partial(status, gateway)})
    gateway.terminal_plans = lambda config: terminal_plans(config, shared, control)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    config, gateway.last_restart = gateway.config, last_run.begin()
    log.info("rtugate %s runs: %d masters, %d slaves", __version__, len(config.master), len(config.slave))
    log.info("last restart: %s", gateway.last_restart)
    with _signals_heeded(gateway):
        is_clean = gateway.run()
    if is_clean:
        last_run.end(BY_MENU if gateway.wants_restart else CLEAN)
    log.info("stopped")
    return is_clean


def _make_state(state: Path) -> None:
    """Where the folder cannot be made, whoever wants to keep something there says so."""
    with contextlib.suppress(OSError):
        state.mkdir(mode=0o750, parents=True, exist_ok=True)


def _start_logging() -> LogRing:
    ring, console = LogRing(), logging.StreamHandler(sys.stderr)
    console.setFormatter(SafeFormatter())
    logging.basicConfig(handlers=[console, ring], level=logging.WARNING)
    log.setLevel(logging.INFO)
    return ring


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


def _reload(gateway: Gateway, _argument: str) -> str:
    """The control socket's command: load the file anew, and say how that went."""
    job = gateway.reload()
    if not job.done.wait(WORK_LIMIT_S):
        raise GatewayError("this takes unusually long; see the log")
    if job.problem:
        raise GatewayError(job.problem)
    return "reloaded"


@contextlib.contextmanager
def _signals_heeded(gateway: Gateway) -> Iterator[None]:
    """Do meanwhile what signals ask for; those that come later are for the program that takes this one's place."""
    acts: dict[int, Callable[[], object]] = {
        signal.SIGTERM: gateway.stop,
        signal.SIGINT: gateway.stop,
        signal.SIGHUP: gateway.reload,
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
