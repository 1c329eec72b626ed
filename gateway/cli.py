"""The `rtugate` command (spec section 9).

Exit codes: 0 done, 1 the answer is no, 2 wrong usage. Errors go to stderr, a line each, never a traceback. A file that
is not there is wrong usage; one that is there and cannot be used is an answer: `check` says no, `run` goes on without.
"""

from __future__ import annotations

import argparse
import io
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, TextIO

from gateway import __version__
from gateway.clock import SystemClock
from gateway.config import Config, MasterConfig
from gateway.config_fields import escaped
from gateway.errors import ConfigError
from gateway.line_load import line_load
from gateway.store import NAME_CHARACTERS, Loaded, load
from gateway.supervisor import Supervisor
from gateway.wiring import build

CONFIG_DEFAULT: Final = "/etc/rtugate/rtugate.toml"
STATE_DEFAULT: Final = "/var/lib/rtugate"
DEMO_PORT: Final = 5020
SIGNALS: Final = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGHUP})
SWITCH_INTERVAL_S: Final = 0.0005  # how long a slave's answer may wait for another thread that computes

log = logging.getLogger("gateway")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a terminal that does not know a letter is no error
    try:
        return _run_command(arguments)
    except BrokenPipeError:  # the reader of our output has gone: `rtugate check | head`
        _silence(sys.stdout)
    except OSError as error:  # a full disk behind our output
        _silence(sys.stdout)
        _complain(f"rtugate: the output cannot be written: {error.strerror or error}")
    return 1


def _run_command(arguments: Sequence[str] | None) -> int:
    try:
        parsed = _parser().parse_args(arguments)
        return int(parsed.command(parsed))
    finally:  # what cannot be written is told here, not by the interpreter at its end
        _complain()
        if sys.stdout is not None:
            sys.stdout.flush()


def _complain(*lines: object) -> None:
    """Print *lines* on stderr; where that cannot be written the exit code must do."""
    if sys.stderr is None:  # closed from the start
        return
    try:
        for line in lines:
            print(line, file=sys.stderr)
        sys.stderr.flush()
    except OSError:
        _silence(sys.stderr)


def _silence(stream: TextIO | None) -> None:
    """Send what still waits in *stream* nowhere."""
    if stream is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _parser() -> argparse.ArgumentParser:
    state = os.environ.get("STATE_DIRECTORY", STATE_DEFAULT)
    common = _common_options(argparse.SUPPRESS, argparse.SUPPRESS)  # no default overrides what stood before the command
    parser = argparse.ArgumentParser(
        prog="rtugate",
        description="Modbus gateway: polls field devices, serves their data to SCADA.",
        parents=[_common_options(CONFIG_DEFAULT, state)],
    )
    parser.add_argument("--version", action="version", version=f"rtugate {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    run = commands.add_parser("run", parents=[common], help="the gateway, in the foreground; SIGTERM stops it")
    run.set_defaults(command=_run)
    check = commands.add_parser("check", parents=[common], help="validate a configuration, show each line's load")
    check.add_argument("file", metavar="FILE", nargs="?", help="instead of -c FILE")
    check.set_defaults(command=_check)
    demo = commands.add_parser("demo", parents=[common], help="simulated devices and the gateway; needs no hardware")
    demo.add_argument(
        "--seconds", metavar="N", type=_positive, help="end after N seconds with a verdict (10 is enough)"
    )
    demo.add_argument("--port", metavar="PORT", type=_port, default=DEMO_PORT, help="where to serve: %(default)s")
    demo.add_argument("--silent", choices=["meter", "boiler", "io"], help="a device that does not answer")
    demo.set_defaults(command=_demo)
    return parser


def _common_options(config: str, state: str) -> argparse.ArgumentParser:
    """What belongs to every command, before or behind it, with these defaults; the last one counts."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("-c", metavar="FILE", dest="config", default=config, help=f"default: {CONFIG_DEFAULT}")
    options.add_argument(
        "--state",
        metavar="DIR",
        default=state,
        help=f"state directory, not used yet; default: $STATE_DIRECTORY, else {STATE_DEFAULT}",
    )
    return options


def _positive(text: str) -> float:
    seconds = float(text)
    if not 0 < seconds < 1e9:
        raise ValueError(text)
    return seconds


def _port(text: str) -> int:
    port = int(text)
    if not 1 <= port <= 65535:
        raise ValueError(text)
    return port


# ------------------------------------------------------------------------------------------------ run


def _run(parsed: argparse.Namespace) -> int:
    path = Path(parsed.config)
    if _is_missing(path):
        return _no_such_file(path)
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # one that comes early waits until it can be heeded
    logging.basicConfig(format="%(levelname)s %(message)s", stream=sys.stderr)
    config = _usable(path)
    log.setLevel(config.log.level.upper())
    clock = SystemClock()
    supervisor = Supervisor(build(config, clock).plans, clock)
    _stop_on_signals(supervisor.stop)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    log.info("rtugate %s runs: %d masters, %d slaves", __version__, len(config.master), len(config.slave))
    is_clean = supervisor.run()
    log.info("stopped")
    return 0 if is_clean else 1


def _usable(path: Path) -> Config:
    """Return the configuration in *path*; where it cannot be used, say why and go on with nothing switched on."""
    try:
        loaded = load(path)
    except ConfigError as error:
        for finding in error.findings:
            log.error("%s", finding)
        log.error("%s cannot be used: running with factory settings, no line is polled or served", _shown(path))
        return Config()
    for finding in loaded.findings:
        log.log(logging.INFO if finding.severity == "note" else logging.WARNING, "%s", finding)
    return loaded.config


def _stop_on_signals(stop: Callable[[], None]) -> None:
    signal.signal(signal.SIGTERM, lambda *_: stop())
    signal.signal(signal.SIGINT, lambda *_: stop())
    signal.signal(signal.SIGHUP, lambda *_: log.warning("reloading is not there yet: restart to use a new file"))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


# ------------------------------------------------------------------------------------------------ check


def _check(parsed: argparse.Namespace) -> int:
    path = Path(parsed.config if parsed.file is None else parsed.file)
    if _is_missing(path):
        return _no_such_file(path)
    try:
        loaded = load(path)
    except ConfigError as error:
        _complain(*error.findings)
        return 1
    print(f"{_shown(path)}: valid")
    _print_loads(loaded)
    return 0


def _print_loads(loaded: Loaded) -> None:
    for finding in loaded.findings:
        print(finding)
    for master in loaded.config.master:
        print(_load_text(master))


def _load_text(master: MasterConfig) -> str:
    load_of = line_load(master)
    line = "its connection" if master.is_tcp else f"{master.baudrate} baud"
    return f"{master.name}: {load_of.percent:.0f} % of {line}, slowest cycle {load_of.slowest_cycle_s:.1f} s"


# ------------------------------------------------------------------------------------------------ demo


def _demo(parsed: argparse.Namespace) -> int:
    from gateway.demo import run_demo  # imports pymodbus and asyncio, which `run` does not pay for

    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    signal.signal(signal.SIGINT, lambda *_: stop.set())
    logging.basicConfig(format="%(levelname)s %(message)s", stream=sys.stderr)
    return run_demo(parsed.seconds, parsed.port, parsed.silent, sys.stdout, stop)


# ------------------------------------------------------------------------------------------------ files


def _is_missing(path: Path) -> bool:
    """Whether nothing is there; what is there, or may be, is for ``load`` to judge."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: no file can be called that
        return True
    except OSError:
        return False
    return False


def _no_such_file(path: Path) -> int:
    _complain(f"rtugate: {_shown(path)}: no such file")
    return 2


def _shown(path: Path) -> str:
    return escaped(str(path), NAME_CHARACTERS)
