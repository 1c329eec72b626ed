"""What every thread is doing, for the log; and what is left of it when the interpreter itself stands still.

``stack_lines`` words the threads of a living program. The ``Backstop`` is faulthandler, armed anew each tick: where a
call never gives the interpreter back, or the main thread never comes round again, it writes all stacks into a file and
ends the process with exit code 1. A fatal signal (SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT) leaves stacks there as
well. The next start has ``read_evidence`` name the suspects. faulthandler knows threads by number only, so a header in
front of its part of the file says which number is which task.

Suspects: while one thread holds the interpreter, all others wait for it just behind the call that let it go. So whoever
is not in a wait of this program is one; and so is the main thread, which arms the backstop, if not in its wait.

What it refuses: deciding when something hangs (``supervisor``); trusting the file, which may be cut off or damaged;
reading sources, since the disk may be what hangs. Where the file cannot be had, stacks go to the standard error output.

Source: specification of rtugate, section 7; faulthandler of CPython 3.11 to 3.14.
Threads: the main one. faulthandler's own is none of Python's: it takes no lock and no part in the interpreter.
"""

from __future__ import annotations

import contextlib
import faulthandler
import fcntl
import logging
import os
import re
import sys
import sysconfig
import threading
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Final

from gateway.files import read_start
from gateway.plain_text import cut, printable

FILE_NAME: Final = "stacks.txt"
MAIN: Final = "main thread"  # no task can be called that: it has a space
UNKNOWN: Final = "unknown"
FRAMES_MOST: Final = 40  # of one thread, the newest
LINES_MOST: Final = 600
LINE_MOST: Final = 240  # characters
NAME_MOST: Final = 64
SUSPECTS_MOST: Final = 8

HEADER_BYTES: Final = 16384  # so the header is replaced by one write, and the stacks behind it stay where they are
DUMP_BYTES: Final = 262144  # that are read of the stacks
RESERVED_BYTES: Final = HEADER_BYTES + 65536  # on the disk, so that one which fills up does not lose the stacks
STDERR: Final = 2

Place = tuple[str, str]  # the end of a file's path, and a function in it, "": any
WAITS: Final[tuple[Place, ...]] = (
    ("gateway/link.py", "wait_ready"),
    ("selectors.py", "select"),
    ("signal.py", "sigwait"),
    ("threading.py", ""),  # where these wait has another name in each Python
)
SLOW_WORK: Final[tuple[Place, ...]] = (  # has threads of its own, and lets the interpreter go
    ("gateway/files.py", ""),
    ("serial/serialposix.py", ""),
    ("socket.py", "getaddrinfo"),
)

_DUMP: Final = re.compile(r"^(?:Timeout \(|Fatal Python error: ).*", re.MULTILINE)
_THREAD: Final = re.compile(r"(?:Current thread|Thread) 0x([0-9a-f]{1,16})\b")
_FRAME: Final = re.compile(r'  File "(.*)", line (?:\d+|\?\?\?) in (.*)')
_NAMED: Final = re.compile(r"^0x([0-9a-f]{1,16}) (.{1,64})$", re.MULTILINE)

log = logging.getLogger(__name__)


# ------------------------------------------------------------------------------------------------ a living program


def stack_lines(first: Collection[str] = ()) -> list[str]:
    """Return every thread's name and stack, newest call last, as printable lines; those named in *first* come first."""
    threads, frames = threading.enumerate(), sys._current_frames()  # in this order: a thread that ended has no frame
    names = {thread.ident or 0: _name_of(thread) for thread in threads}
    idents = [ident for ident in names if ident in frames] + [ident for ident in frames if ident not in names]
    idents.sort(key=lambda ident: names.get(ident) not in first)
    return _bounded([line for ident in idents for line in _block(_title(ident, names), _calls(frames[ident]))])


def _calls(frame: FrameType | None) -> list[str]:
    """Return what *frame* does and who called it, newest first, as faulthandler words it."""
    lines: list[str] = []
    while frame is not None and len(lines) <= FRAMES_MOST:
        lines.append(f'  File "{frame.f_code.co_filename}", line {frame.f_lineno} in {frame.f_code.co_qualname}')
        frame = frame.f_back
    return lines


def _block(title: str, calls: Sequence[str]) -> list[str]:
    """Return *title* and the *calls*, which come newest first, the other way round."""
    kept = list(calls[:FRAMES_MOST])
    return [f"{title}, newest call last:", *(["  older calls are left out"] * (len(calls) > len(kept))), *kept[::-1]]


def _title(ident: int, names: dict[int, str]) -> str:
    return f"{names.get(ident, 'a thread without a name')} (0x{ident:x})"


def _name_of(thread: threading.Thread) -> str:
    return MAIN if thread is threading.main_thread() else cut(printable(thread.name), NAME_MOST)


def _bounded(lines: Sequence[str]) -> list[str]:
    kept = [cut(printable(line), LINE_MOST) for line in lines[:LINES_MOST]]
    return kept + [f"{len(lines) - len(kept)} more lines are left out"] * (len(lines) > len(kept))


# ------------------------------------------------------------------------------------------------ the backstop


class Backstop:
    """Ends the process with exit code 1, all stacks in the file at *path*, unless it is armed anew in time."""

    def __init__(self, path: Path, is_monotonic: bool | None = None) -> None:
        """*is_monotonic*: whether this Python's waits go by the monotonic clock; None: find out."""
        self._path = path
        self._names: dict[int, str] = {}  # as the file has them
        self._told: set[str] = set()
        self._is_monotonic = (
            bool(sysconfig.get_config_var("HAVE_SEM_CLOCKWAIT")) if is_monotonic is None else is_monotonic
        )
        self._had_handlers = faulthandler.is_enabled()  # by -X faulthandler: they come back in the end
        self._fd = self._open()
        self._is_closed = False
        self.name_threads()
        faulthandler.enable(file=self._fd, all_threads=True)

    def arm(self, timeout_s: float) -> None:
        """From now on: so many seconds without being armed anew, and it strikes. Never raises.

        A Python without sem_clockwait(3) would wait by the wall clock, and strike when that is set: it is left unarmed.
        """
        if not self._is_monotonic:
            self._warn("this Python waits by the wall clock: a call that holds the interpreter ends nothing here")
            return
        try:
            faulthandler.dump_traceback_later(timeout_s, exit=True, file=self._fd)
        except RuntimeError as error:  # no room for one more thread: the next tick tries again
            self._warn(f"a call that holds the interpreter would not be noticed: {error}")

    def disarm(self) -> None:
        """It strikes no more until it is armed again."""
        faulthandler.cancel_dump_traceback_later()

    def name_threads(self) -> None:
        """Have the file say which thread is which task; it is written only when there is a new one. Never raises.

        Daemons are short-lived helpers, and not worth a write each: they stay without a name, and get nobody else's.
        """
        threads = [(thread.ident, thread) for thread in threading.enumerate() if thread.ident is not None]
        names = {ident: _name_of(thread) for ident, thread in threads if not thread.daemon}
        has_misnamed = any(thread.daemon and ident in self._names for ident, thread in threads)
        if self._fd == STDERR or (names.items() <= self._names.items() and not has_misnamed):
            return
        self._names = names
        try:
            os.pwrite(self._fd, _header(names), 0)
        except OSError as error:
            self._warn(f"which thread is which cannot be kept: {error.strerror}")

    def close(self) -> None:
        """Disarm it, and leave no evidence; calling again does nothing. Never raises."""
        if self._is_closed:
            return
        self._is_closed = True
        self.disarm()
        if self._had_handlers:
            faulthandler.enable(file=STDERR)
        else:
            faulthandler.disable()
        if self._fd != STDERR:
            with contextlib.suppress(OSError):
                os.close(self._fd)
            with contextlib.suppress(OSError):
                self._path.unlink()

    def _open(self) -> int:
        """Make the file anew, and room for what may have to be written when there is none left."""
        try:
            self._path.unlink(missing_ok=True)
            fd = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        except OSError as error:
            return self._without_file(error)
        try:
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)  # for ``is_in_use``; it goes with the process
            os.posix_fallocate(fd, 0, RESERVED_BYTES)
            os.lseek(fd, HEADER_BYTES, os.SEEK_SET)
        except OSError as error:
            os.close(fd)
            with contextlib.suppress(OSError):
                self._path.unlink()
            return self._without_file(error)
        return fd

    def _without_file(self, error: OSError) -> int:
        self._warn(f"{self._path.name} cannot be written, so stacks go to the standard error output: {error.strerror}")
        return STDERR

    def _warn(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            log.warning("%s", text)


def _header(names: dict[int, str]) -> bytes:
    lines: list[bytes] = []
    room = HEADER_BYTES
    for ident, name in names.items():
        line = f"0x{ident:x} {name}\n".encode()
        room -= len(line)
        if room >= 0:
            lines.append(line)
    return b"".join(lines).ljust(HEADER_BYTES, b"\n")


# ------------------------------------------------------------------------------------------------ the next start


@dataclass(frozen=True)
class Evidence:
    """What a run that was ended by its backstop or by a fatal signal has left.

    is_hang: by its backstop.
    first_line: as faulthandler words it: "Timeout (0:00:10)!", "Fatal Python error: Segmentation fault".
    names: of the threads that it was the fault of, as far as can be told; never none.
    lines: all of it for the log, printable, newest calls last.
    """

    is_hang: bool
    first_line: str
    names: tuple[str, ...]
    lines: tuple[str, ...]


@dataclass(frozen=True)
class _Stack:
    """One thread in the file; *calls* newest first."""

    ident: int
    is_current: bool  # faulthandler says "Current" of whoever got the signal
    calls: list[str]


def read_evidence(path: Path) -> Evidence | None:
    """Return what the run before has left in the file at *path*; None where there is nothing, or nothing of use."""
    content = start_of(path, HEADER_BYTES + DUMP_BYTES)
    text = (content or b"").replace(b"\0", b"").decode("utf-8", "replace")
    dump = _DUMP.search(text)
    if dump is None:
        return None
    names = {int(found[1], 16): printable(found[2]) for found in _NAMED.finditer(text[: dump.start()])}
    is_hang = dump[0].startswith("Timeout")
    stacks = list(_stacks(text[dump.end() :].splitlines()))
    guilty = [one for one in stacks if (_is_suspect(one, names) if is_hang else one.is_current)]
    stacks.sort(key=lambda one: one not in guilty)
    lines = [line for one in stacks for line in _block(_title(one.ident, names), one.calls)]
    suspects = tuple(islice(dict.fromkeys(names.get(one.ident, UNKNOWN) for one in guilty), SUSPECTS_MOST))
    first_line = cut(printable(dump[0]), LINE_MOST)
    return Evidence(is_hang, first_line, suspects or (UNKNOWN,), (first_line, *_bounded(lines)))


def is_in_use(path: Path) -> bool:
    """Whether the file at *path* is that of a backstop whose process lives."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks
        return False
    finally:
        os.close(fd)
    return False


def start_of(path: Path, most: int) -> bytes | None:
    """Return the regular file at *path*, or its first *most* bytes; None where there is none, or it cannot be read."""
    try:
        return read_start(path, most)
    except OSError:
        return None


def _stacks(lines: Iterable[str]) -> Iterator[_Stack]:
    """Return the threads among *lines*; what does not belong to one is passed over."""
    stack: _Stack | None = None
    for line in lines:
        if head := _THREAD.match(line):
            stack = _Stack(int(head[1], 16), line.startswith("Current"), [])
            yield stack
        elif stack is not None and _FRAME.fullmatch(line):
            stack.calls.append(line)


def _is_suspect(stack: _Stack, names: dict[int, str]) -> bool:
    found = _FRAME.fullmatch(stack.calls[0]) if stack.calls else None
    if found is None:  # it has no Python of its own to hang in
        return False
    innocent = WAITS if names.get(stack.ident) == MAIN else WAITS + SLOW_WORK
    return not any(f"/{found[1]}".endswith(f"/{file}") and function in ("", found[2]) for file, function in innocent)
