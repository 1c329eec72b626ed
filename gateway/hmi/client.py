"""`rtugate menu`: this terminal, made raw, and the control socket of the gateway that runs (spec sections 5 and 9).

What it is: bytes both ways until one side ends; Ctrl-] leaves whatever the menu does. The terminal is what it was
afterwards, also when the program is told to end (SIGTERM, SIGHUP).
What it refuses: understanding what goes through; control characters that the menu does not use, since a gateway that
has been broken into must not speak to root's terminal.
Threads: the main one alone, because of the signals.
"""

from __future__ import annotations

import codecs
import contextlib
import errno
import os
import pwd
import signal
import socket
import sys
import termios
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from gateway.link import Waker, plain_reason, wait_ready
from gateway.plain_text import printable

LEAVE: Final = b"\x1d"  # Ctrl-], as in telnet
READ_BYTES: Final = 4096
CONTROLS: Final = "\r\n\b"  # all that the menu uses
WRITE_BYTES: Final = 512  # so many always fit when a pipe says that it is ready
SIGNALS: Final = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
_ABSENT: Final = (errno.ENOENT, errno.ECONNREFUSED, errno.ENOTDIR)


def run_menu(socket_path: Path, stdin_fd: int, stdout_fd: int) -> int:
    """Show the menu in this terminal until one side ends.

    returns: 0; 1 if no gateway runs here, it is gone, or a signal came.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        try:
            connection.connect(str(socket_path))
            connection.sendall(_hello(stdout_fd))
        except OSError as error:
            _complain(_why_not(socket_path, error))
            return 1
        with _signals_caught() as waker, _raw(stdin_fd):
            problem = _relay(connection, waker, stdin_fd, stdout_fd)
    if problem:
        _complain(problem)
    return 1 if problem else 0


def _why_not(path: Path, error: OSError) -> str:
    if error.errno in _ABSENT:
        return f"no gateway runs here (no socket at {path})"
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"{path}: permission denied; only root and the service's group may use it"
    return f"{path}: {plain_reason(error, {})}"


def _complain(text: str) -> None:
    sys.stderr.write(f"rtugate: {text}\n")
    sys.stderr.flush()


def _hello(stdout_fd: int) -> bytes:
    try:
        columns, rows = os.get_terminal_size(stdout_fd)
    except OSError:  # no terminal
        columns, rows = 0, 0
    try:
        name = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        name = f"user {os.getuid()}"
    return f"menu {columns or 80} {rows or 24} {name}\n".encode()


@contextlib.contextmanager
def _signals_caught() -> Iterator[Waker]:
    """Give a waker that a signal ends: the way out leads past the terminal's restoring."""
    with contextlib.closing(Waker()) as waker:
        before = {number: signal.signal(number, lambda _number, _frame: waker.end()) for number in SIGNALS}
        try:
            yield waker
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextlib.contextmanager
def _raw(descriptor: int) -> Iterator[None]:
    """The terminal gives each key at once and shows nothing by itself; a pipe stays as it is."""
    if not os.isatty(descriptor):
        yield
        return
    before = termios.tcgetattr(descriptor)
    try:
        tty.setraw(descriptor, termios.TCSADRAIN)
        yield
    finally:
        with contextlib.suppress(termios.error):  # the terminal itself may be gone
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _relay(connection: socket.socket, waker: Waker, stdin_fd: int, stdout_fd: int) -> str:
    """Carry bytes both ways; return what went wrong, "" if nothing did."""
    reading = [connection.fileno(), stdin_fd]
    text = codecs.getincrementaldecoder("utf-8")("replace")
    try:
        while True:
            ready = wait_ready((*reading, waker.fileno()), (), None)
            if connection.fileno() in ready:
                shown = connection.recv(READ_BYTES)
                if not shown:
                    return ""
                _show(waker, stdout_fd, printable(text.decode(shown), CONTROLS).encode())
            if waker.ended:
                return "ended by a signal"
            if stdin_fd in ready:
                typed = _typed(stdin_fd)
                keys, leave, _ = typed.partition(LEAVE)
                connection.sendall(keys)
                if leave:
                    _show(waker, stdout_fd, b"\r\n")
                    return ""
                if not typed:  # the end of a pipe: what it said is still answered
                    reading.remove(stdin_fd)
                    connection.shutdown(socket.SHUT_WR)
    except _OutputGone:
        return "its output goes nowhere"
    except ConnectionError:
        return "the gateway is gone"


def _typed(descriptor: int) -> bytes:
    """What was typed; b"" at the end, also that of a terminal."""
    try:
        return os.read(descriptor, READ_BYTES)
    except OSError:
        return b""


class _OutputGone(Exception):
    """Nobody can be shown anything any more."""


def _show(waker: Waker, descriptor: int, data: bytes) -> None:
    """Write all of *data*, unless a signal comes: a terminal that is stopped must not keep the program from ending."""
    while data and not waker.ended:
        if descriptor in wait_ready((waker.fileno(),), (descriptor,), None):
            try:
                data = data[os.write(descriptor, data[:WRITE_BYTES]) :]
            except BlockingIOError:  # somebody else's terminal as well, and full meanwhile
                continue
            except OSError as error:
                raise _OutputGone from error
