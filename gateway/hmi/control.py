"""The control socket: how `rtugate menu`, `status` and others reach the gateway that runs (spec sections 5 and 9).

What it is: the socket itself, and the door behind it. A client's first line, at most 200 bytes of UTF-8, is a command:
``menu COLUMNS ROWS [NAME]`` makes the connection a terminal; anything else is looked up, answered and closed.
What it refuses: knowing the commands; passwords (who may open the socket is in its group already).
Threads: the task's; commands run in ``Background``'s, one at a time, and may take their time.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import socket
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

from gateway.config_fields import escaped
from gateway.errors import GatewayError, LinkUnavailable
from gateway.hmi.background import Background
from gateway.hmi.seat import Rank
from gateway.hmi.session import Session, Shared
from gateway.hmi.telnet import COLUMNS_MAX, COLUMNS_MIN, ROWS_MAX, ROWS_MIN
from gateway.hmi.terminals import SESSIONS_MOST, Conversation, too_many
from gateway.link import plain_reason

MODE: Final = 0o660
LINE_MOST: Final = 200  # bytes of a command
LINE_S: Final = 5.0  # so long a client may take for it
NAME_MOST: Final = 32
MENU: Final = "menu"

log = logging.getLogger(__name__)

Commands = Mapping[str, Callable[[str], str]]  # by the first word; the rest of the line in, text out


class AlreadyRunning(LinkUnavailable):
    """Another gateway answers on the control socket."""


# ------------------------------------------------------------------------------------------------ the socket


def open_control(path: Path) -> socket.socket:
    """Return the socket at *path*, listening and non-blocking; a stale one, left by a crash, is replaced.

    raises: AlreadyRunning (a living one), LinkUnavailable (no such folder, no permission, a file that is no socket).
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with _folder_locked(path):
            _remove_stale(path)
            listener.bind(str(path))
            path.chmod(MODE)
            listener.listen(16)  # only now can anybody connect
        listener.setblocking(False)
    except LinkUnavailable:
        listener.close()
        raise
    except OSError as error:
        listener.close()
        raise LinkUnavailable(f"control socket {path}: {plain_reason(error, {})}") from error
    return listener


@contextlib.contextmanager
def _folder_locked(path: Path) -> Iterator[None]:
    """Two that start at once must not each take the other's socket for a stale one."""
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise AlreadyRunning(f"control socket {path}: another rtugate starts there at this moment") from error
        yield
    finally:
        os.close(folder)


def _remove_stale(path: Path) -> None:
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise LinkUnavailable(f"control socket {path}: there is a file of this name that is no socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        code = probe.connect_ex(str(path))
    if code in (0, errno.EAGAIN):  # EAGAIN: many wait to be let in
        raise AlreadyRunning(f"rtugate runs already (control socket {path})")
    if code != errno.ECONNREFUSED:
        raise OSError(code, os.strerror(code))
    path.unlink()


# ------------------------------------------------------------------------------------------------ the door


class ControlDoor:
    """Everybody who opens the socket may come in; a ``Welcome``."""

    def __init__(self, shared: Shared, commands: Commands) -> None:
        self.shared = shared
        self.commands = commands
        self.background = Background("control commands")
        self._sessions: list[Session] = []

    def __call__(self, _accepted: socket.socket, wake: Callable[[], None]) -> Conversation:
        """Wait for the newcomer's command."""
        return ControlClient(self, wake)

    def session(self, who: str, wake: Callable[[], None]) -> Session | None:
        """Return a session for a newcomer at the menu; None if there are too many."""
        self._sessions = [session for session in self._sessions if not session.is_over]
        if len(self._sessions) >= SESSIONS_MOST:
            return None
        self._sessions.append(Session(self.shared, who, Rank.LOCAL, who, wake))
        return self._sessions[-1]


class ControlClient:
    """One client: its command, and what becomes of it; a ``Conversation``."""

    def __init__(self, door: ControlDoor, wake: Callable[[], None]) -> None:
        self._door = door
        self._wake = wake
        self._line: bytearray | None = bytearray()  # None once it is complete
        self._line_s = door.shared.clock.monotonic() + LINE_S
        self._answer: str | None = None  # set by the background's thread
        self._session: Session | None = None
        self._output = bytearray()
        self._is_over = False

    @property
    def output(self) -> bytearray:
        """What is to be sent."""
        return self._session.output if self._session else self._output

    @property
    def is_over(self) -> bool:
        """Whether nothing but the output is left."""
        return self._session.is_over if self._session else self._is_over

    def receive(self, data: bytes) -> None:
        """Collect the command; what follows it is for the menu."""
        if self._session is not None:
            self._session.receive(data)
        elif self._line is not None and not self._is_over:
            self._line += data
            line, end, rest = self._line.partition(b"\n")
            if len(line) > LINE_MOST:
                self._end(f"error: a command has {LINE_MOST} bytes at most")
            elif end:
                self._line = None
                self._carry_out(line.decode("utf-8", "replace").strip())
                if self._session is not None:
                    self._session.receive(bytes(rest))

    def end_input(self) -> None:
        """A command that has come is still answered."""
        if self._session is not None:
            self._session.end_input()
        elif self._line is not None:
            self.hang_up()

    def turn(self) -> None:
        """Answer, or wait no longer for a command."""
        if self._session is not None:
            self._session.turn()
        elif self._answer is not None:
            self._end(self._answer)
        elif self._line is not None and self._door.shared.clock.monotonic() >= self._line_s:
            self._end("error: no command")

    def sent(self, count: int) -> None:
        """So much of the output was sent."""
        if self._session is not None:
            self._session.sent(count)
        else:
            del self._output[:count]

    def due_s(self) -> float | None:
        """When the command has to be there, or what the session says."""
        if self._session is not None:
            return self._session.due_s()
        return None if self._line is None else self._line_s

    def stop(self) -> None:
        """The control socket is closed."""
        if self._session is not None:
            self._session.stop()
        else:
            self._end("error: rtugate stops")

    def hang_up(self) -> None:
        """The client is gone."""
        if self._session is not None:
            self._session.hang_up()
        self._is_over = True

    # ------------------------------------------------------------------------------------------------ commands

    def _end(self, told: str) -> None:
        if not self._is_over:
            self._is_over = True
            self._output += told.encode("utf-8", "replace") + (b"" if told.endswith("\n") else b"\n")

    def _carry_out(self, line: str) -> None:
        word, _space, rest = line.partition(" ")
        if word == MENU:
            self._open_menu(rest.split(maxsplit=2))
        elif word in self._door.commands:
            log.debug("control socket: %s", escaped(line))  # a monitor asks for the status all day; a reload says so
            self._run(self._door.commands[word], rest.strip())
        else:
            self._end(f"error: there is no command {escaped(word) or 'without a name'}")

    def _run(self, command: Callable[[str], str], rest: str) -> None:
        def work() -> None:
            answer = "error: it failed; the log says why"
            try:
                answer = command(rest)
            except GatewayError as error:
                answer = f"error: {error}"
            finally:
                self._answer = answer
                self._wake()

        self._door.background.run(work)

    def _open_menu(self, words: list[str]) -> None:
        if len(words) < 2 or not (words[0] + words[1]).isdecimal() or len(words[0] + words[1]) > 8:
            self._end("error: menu COLUMNS ROWS [NAME]")
            return
        name = escaped(words[2], NAME_MOST) if len(words) > 2 else "somebody"
        session = self._door.session(f"{name} (rtugate menu)", self._wake)
        if session is None:
            self._end(too_many(self._door.shared))
            return
        session.columns = min(max(int(words[0]), COLUMNS_MIN), COLUMNS_MAX)
        session.rows = min(max(int(words[1]), ROWS_MIN), ROWS_MAX)
        log.debug("control socket: %s has come", session.who)
        session.start()
        self._session = session
