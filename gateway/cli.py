"""The `rtugate` command (spec section 9).

Exit codes: 0 done, 1 the answer is no, 2 wrong usage. Errors go to stderr, a line each, never a traceback. A file that
is not there is wrong usage; one that is there and cannot be used is an answer: `check` says no, `run` goes on without.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, TextIO, TypeVar

from gateway import __version__
from gateway.config import MasterConfig
from gateway.errors import ConfigError, GatewayError
from gateway.line_load import line_load
from gateway.plain_text import printable
from gateway.store import Loaded, load, shown

CONFIG_DEFAULT: Final = "/etc/rtugate/rtugate.toml"
STATE_DEFAULT: Final = "/var/lib/rtugate"
DEMO_PORT: Final = 5020
SIGNALS: Final = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGHUP})
SWITCH_INTERVAL_S: Final = 0.0005  # how long a slave's answer may wait for another thread that computes

N = TypeVar("N", int, float)

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
    menu = commands.add_parser("menu", parents=[common], help="the menu of the gateway that runs, in this terminal")
    menu.set_defaults(command=_menu)
    status = commands.add_parser("status", parents=[common], help="what the gateway that runs says of itself")
    status.add_argument("--json", action="store_true", help="as one JSON object, for programs")
    status.set_defaults(command=_status)
    passwd = commands.add_parser("passwd", parents=[common], help="set the password that telnet asks for")
    passwd.set_defaults(command=_passwd)
    history = commands.add_parser("history", parents=[common], help="the configurations that were saved last")
    history.set_defaults(command=_history)
    rollback = commands.add_parser("rollback", parents=[common], help="go back to one of them, and have it run")
    rollback.add_argument("number", metavar="N", type=_version_number, help="its number in `rtugate history`")
    rollback.set_defaults(command=_rollback)
    check = commands.add_parser("check", parents=[common], help="validate a configuration, show each line's load")
    check.add_argument("file", metavar="FILE", nargs="?", help="instead of -c FILE")
    check.set_defaults(command=_check)
    _add_documents(commands, common)
    demo = commands.add_parser("demo", parents=[common], help="simulated devices and the gateway; needs no hardware")
    demo.add_argument("--seconds", metavar="N", type=_seconds, help="end after N seconds with a verdict (10 is enough)")
    demo.add_argument(
        "--port",
        metavar="PORT",
        type=_demo_port,
        default=DEMO_PORT,
        help="where to serve; telnet is one above: %(default)s",
    )
    demo.add_argument("--silent", choices=["meter", "boiler", "io"], help="a device that does not answer")
    demo.set_defaults(command=_demo)
    return parser


def _add_documents(commands: Any, common: argparse.ArgumentParser) -> None:
    """Add `init`, `show` and `schema`. *commands*: what ``add_subparsers`` returned, a type without a public name."""
    init = commands.add_parser("init", parents=[common], help="write a commented file to start from, and its schema")
    init.add_argument("file", metavar="FILE", nargs="?", help="instead of -c FILE")
    init.add_argument("--force", action="store_true", help="keep a file that is there as FILE.replaced-DATE")
    init.set_defaults(command=_init)
    show = commands.add_parser("show", parents=[common], help="every key with the value in effect, without secrets")
    show.add_argument("file", metavar="FILE", nargs="?", help="instead of -c FILE")
    show.set_defaults(command=_show)
    schema = commands.add_parser("schema", parents=[common], help="the JSON Schema of the file, for editors")
    schema.set_defaults(command=_schema)


def _common_options(config: str, state: str) -> argparse.ArgumentParser:
    """What belongs to every command, before or behind it, with these defaults; the last one counts."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument(
        "-c", metavar="FILE", dest="config", default=config, help=f"the configuration; default: {CONFIG_DEFAULT}"
    )
    options.add_argument(
        "--state",
        metavar="DIR",
        default=state,
        help=f"state directory; default: $STATE_DIRECTORY, else {STATE_DEFAULT}",
    )
    return options


def _within(kind: Callable[[str], N], least: N, most: N, wanted: str) -> Callable[[str], N]:
    """Return what reads an argument; *wanted*: what it has to be, for people."""

    def read(text: str) -> N:
        number: N | None
        try:
            number = kind(text)
        except ValueError:
            number = None
        if number is None or not least <= number <= most:  # nan is neither
            raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}")
        return number

    return read


_seconds = _within(float, 0.001, 1e9, "a number of seconds above 0")
_version_number = _within(int, 1, sys.maxsize, "a number that `rtugate history` shows")
_demo_port = _within(int, 1, 65534, "a port from 1 to 65534")


# ------------------------------------------------------------------------------------------------ run


def _run(parsed: argparse.Namespace) -> int:
    from gateway.service import run_service  # other commands do not pay for it

    path = Path(parsed.config)
    if _is_missing(path):
        return _no_such_file(path)
    return run_service(path, Path(parsed.state), _control_path(parsed))


def _control_path(parsed: argparse.Namespace) -> Path:
    """Where the control socket of the gateway is, or is to be."""
    return Path(os.environ.get("RUNTIME_DIRECTORY") or parsed.state) / "control"


def _menu(parsed: argparse.Namespace) -> int:
    from gateway.hmi.client import run_menu

    return run_menu(_control_path(parsed), sys.stdin.fileno(), sys.stdout.fileno())


def _status(parsed: argparse.Namespace) -> int:
    from gateway.edits import ask_gateway

    def ask() -> list[str]:
        answer = ask_gateway(_control_path(parsed), "status --json" if parsed.json else "status")
        if answer is None:
            raise GatewayError(f"rtugate: no gateway runs here (no socket at {_control_path(parsed)})")
        return [answer]

    return _tell(ask)


# ------------------------------------------------------------------------------------------------ the file


def _passwd(parsed: argparse.Namespace) -> int:
    from gateway.edits import set_password

    path = Path(parsed.config)
    if _is_missing(path):
        return _no_such_file(path)
    return _tell(lambda: set_password(path, _control_path(parsed)), path.parent)


def _history(parsed: argparse.Namespace) -> int:
    from gateway.edits import history

    return _tell(lambda: history(Path(parsed.state)), Path(parsed.state))


def _rollback(parsed: argparse.Namespace) -> int:
    from gateway.edits import rollback

    path, state = Path(parsed.config), Path(parsed.state)
    return _tell(lambda: rollback(path, state, _control_path(parsed), parsed.number), path.parent)


def _init(parsed: argparse.Namespace) -> int:
    from gateway import documents
    from gateway.edits import start_file

    path = _file_of(parsed)
    text, schema_text = documents.starting_file().encode(), documents.schema_text().encode()  # imports, as who we are
    return _tell(lambda: start_file(path, text, schema_text, parsed.force), path.parent)


def _tell(work: Callable[[], list[str]], folder: Path | None = None) -> int:
    """Print what *work* has to tell; 1 where it cannot be done. *folder*: whose owner does it, and not root."""
    from gateway.files import as_owner_of

    try:
        with as_owner_of(folder) if folder else contextlib.nullcontext():
            told = work()
        for line in told:
            print(printable(line, "\n"))  # a gateway that has been broken into must not speak to root's terminal
    except GatewayError as error:
        _complain(*(printable(line) for line in str(error).splitlines()))
        return 1
    return 0


# ------------------------------------------------------------------------------------------------ show, schema


def _show(parsed: argparse.Namespace) -> int:
    from gateway.documents import effective_text

    path = _file_of(parsed)
    if _is_missing(path):
        return _no_such_file(path)
    try:
        config = load(path).config
    except ConfigError as error:
        _complain(*error.findings)
        return 1
    _print_document(effective_text(config, path.name))
    return 0


def _schema(_parsed: argparse.Namespace) -> int:
    from gateway.documents import schema_text

    _print_document(schema_text())
    return 0


def _print_document(text: str) -> None:
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(encoding="utf-8")  # as TOML and JSON are, whatever the terminal speaks
    print(text, end="")


# ------------------------------------------------------------------------------------------------ check


def _check(parsed: argparse.Namespace) -> int:
    path = _file_of(parsed)
    if _is_missing(path):
        return _no_such_file(path)
    try:
        loaded = load(path)
    except ConfigError as error:
        _complain(*error.findings)
        return 1
    print(f"{shown(path)}: valid")
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


def _file_of(parsed: argparse.Namespace) -> Path:
    return Path(parsed.config if parsed.file is None else parsed.file)


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
    _complain(f"rtugate: {shown(path)}: no such file")
    return 2
