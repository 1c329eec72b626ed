"""Terminals that come by a socket: telnet, and by the control socket (spec sections 5 and 9).

What it is: a task that carries bytes between all connections of one listening socket and their ``Conversation``, and
telnet's door. The control socket's door is ``control``.
What it refuses: waiting for anybody. What cannot be sent waits in its own connection, and is bounded there.
Threads: one for each task; ``wake`` and ``trouble`` from any.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol

from gateway.clock import Clock
from gateway.hmi.seat import Rank
from gateway.hmi.session import Session, Shared
from gateway.hmi.telnet import TelnetFilter
from gateway.link import Waker
from gateway.link_tcp import is_allowed, set_tcp_options
from gateway.opening import Opening, Start, at_once

RECEIVE_MAX: Final = 1024  # bytes taken from a terminal at once
READ_PAUSE_S: Final = 0.02  # so long no more is taken from it: faster than any person, and Modbus keeps the processor
NEWCOMERS_MOST, NEWCOMERS_S = 10, 0.5  # so many in so short a time; then the next ones wait as long
SEND_BUFFER: Final = 16384  # bytes that the system holds for a terminal: more would only make its screen late
NO_DESCRIPTOR_PAUSE_S: Final = 0.5
LINGER_S: Final = 2.0  # a connection that is over is kept so long, for the other side to read the last words
CONNECTIONS_MOST: Final = 32  # of a task; sessions are far fewer
WARN_AGAIN_S: Final = 60.0
SESSIONS_MOST: Final = 8  # of telnet, and of `rtugate menu`

log = logging.getLogger(__name__)


class Conversation(Protocol):
    """What a connection's bytes mean; a ``Session``, or what becomes one."""

    @property
    def is_over(self) -> bool:
        """Once ``output`` is sent, the connection is to be closed."""
        ...

    @property
    def output(self) -> bytearray:
        """What is to be sent."""
        ...

    def receive(self, data: bytes) -> None:
        """*data* has come."""
        ...

    def end_input(self) -> None:
        """The other side sends no more."""
        ...

    def turn(self) -> None:
        """Do what has become due."""
        ...

    def sent(self, count: int) -> None:
        """So much of ``output`` was sent."""
        ...

    def due_s(self) -> float | None:
        """When ``turn`` is due by itself, monotonic."""
        ...

    def stop(self) -> None:
        """The task ends: say so and be over."""
        ...

    def hang_up(self) -> None:
        """The connection is gone."""
        ...


Welcome = Callable[[socket.socket, Callable[[], None]], Conversation | None]  # what wakes the task; None: not let in


@dataclass
class LastWords:
    """A conversation that is over before it begins: somebody is told why he cannot come in."""

    output: bytearray
    is_over: bool = True

    def receive(self, data: bytes) -> None:
        """Nobody listens."""

    def end_input(self) -> None:
        """Nothing was awaited."""

    def turn(self) -> None:
        """Nothing is due."""

    def sent(self, count: int) -> None:
        """So much was told."""
        del self.output[:count]

    def due_s(self) -> float | None:
        """Never."""
        return None

    def stop(self) -> None:
        """It has ended."""

    def hang_up(self) -> None:
        """It has ended."""


@dataclass(eq=False)
class Connection:
    """One connection and its conversation."""

    socket: socket.socket
    conversation: Conversation
    has_ended_input: bool = False
    reads_again_s: float = 0.0
    closes_at_s: float | None = None  # set when only its last words are left

    def wanted(self, now_s: float) -> int:
        """What the selector has to tell of."""
        reads = now_s >= self.reads_again_s and (not self.has_ended_input or self.closes_at_s is not None)
        writes = bool(self.conversation.output)
        return selectors.EVENT_READ * reads | selectors.EVENT_WRITE * writes


class Terminals:
    """All connections of one listening socket, in one thread; a ``Task``."""

    def __init__(
        self,
        name: str,
        clock: Clock,
        waker: Waker,
        listen: Callable[[], socket.socket],
        welcome: Welcome,
        wait_limit_s: float = 3.0,
        start: Start = at_once,
    ) -> None:
        """*listen* gives a listening, non-blocking socket or raises LinkError; *start* has that done somewhere.

        welcome: says who a newcomer is.
        """
        self.name = name
        self.ready = threading.Event()
        self.connections: dict[int, Connection] = {}
        self.port: int | None = None  # TCP: that is listened on; None while it is not
        self._clock = clock
        self._waker = waker
        self._welcome = welcome
        self._wait_limit_s = wait_limit_s
        self._opening = Opening(name, clock, listen, waker, start)
        self._listener: socket.socket | None = None
        self._accepts_again_s: float | None = None  # set while newcomers have to wait
        self._newcomers_s: deque[float] = deque(maxlen=NEWCOMERS_MOST)  # when they came
        self._selector = selectors.DefaultSelector()
        self._selector.register(waker, selectors.EVENT_READ)

    @property
    def trouble(self) -> str:
        """Why nobody can come in, for people; "" while they can."""
        return self._opening.trouble

    def wake(self) -> None:
        """End any wait of this task's thread."""
        self._waker.wake()

    def set_enabled(self, enabled: bool) -> None:
        """The menu is never in maintenance."""

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        """Carry bytes until *stop*; *alive* is called whenever something has been got on with."""
        try:
            while not stop.is_set():
                if self.step():
                    alive()
        finally:
            self.close()

    def step(self) -> bool:
        """Wait for something to happen, and do what follows; False if nothing came of it."""
        self._open_if_due()
        wait_s = self._wait_s()
        found = self._selector.select(wait_s)
        has_got_on = not found and wait_s > 0.0
        for key, events in found:
            if key.fileobj is self._waker:
                self._waker.clear()
                has_got_on = True
            elif key.fileobj is self._listener:
                has_got_on |= self._accept()
            elif events & selectors.EVENT_READ and key.fd in self.connections:
                has_got_on |= self._receive(self.connections[key.fd])
        for connection in list(self.connections.values()):
            has_got_on |= self._attend(connection)
        return has_got_on

    def close(self) -> None:
        """Say goodbye to everybody, and let go of the socket."""
        self._opening.close()
        for connection in list(self.connections.values()):
            connection.conversation.stop()
            with contextlib.suppress(OSError):
                connection.socket.send(connection.conversation.output)
            self._close(connection)
        if self._listener is not None:
            name = self._listener.getsockname()
            self._listener.close()
            if isinstance(name, str):  # a unix socket is a file that stays
                Path(name).unlink(missing_ok=True)
            self._listener = self.port = None
        self._selector.close()

    # ------------------------------------------------------------------------------------------------ the door

    def _open_if_due(self) -> None:
        now_s = self._clock.monotonic()
        if self._listener is None and not self._opening.wait_s():
            self._start_listening(self._opening.attempt(self.ready))
        elif self._listener is not None and self._accepts_again_s is not None and now_s >= self._accepts_again_s:
            self._accepts_again_s = None
            self._selector.register(self._listener, selectors.EVENT_READ)

    def _start_listening(self, listener: socket.socket | None) -> None:
        if listener is None:
            return
        self._listener = listener
        self._opening.worked()
        self._selector.register(listener, selectors.EVENT_READ)
        name = listener.getsockname()
        self.port = None if isinstance(name, str) else name[1]
        log.info("%s: listening on %s", self.name, name if isinstance(name, str) else f"port {self.port}")

    def _accept(self) -> bool:
        """Let a newcomer in, or not; False if there is none."""
        assert self._listener is not None  # noqa: S101 - only a registered listener is selected
        try:
            accepted, _address = self._listener.accept()
        except BlockingIOError:
            return False
        except ConnectionError:  # gone again
            return True
        except OSError as error:
            log.error("%s: a connection could not be accepted: %s", self.name, error.strerror)
            self._accept_again_after(NO_DESCRIPTOR_PAUSE_S)
            return True
        self._newcomers_s.append(self._clock.monotonic())
        if self._newcomers_s[-1] - self._newcomers_s[0] < NEWCOMERS_S and len(self._newcomers_s) == NEWCOMERS_MOST:
            self._accept_again_after(NEWCOMERS_S)
        conversation = self._welcomed(accepted) if len(self.connections) < CONNECTIONS_MOST else None
        if conversation is None:
            accepted.close()
            return True
        self.connections[accepted.fileno()] = Connection(accepted, conversation)
        self._selector.register(accepted, selectors.EVENT_READ)
        return True

    def _accept_again_after(self, pause_s: float) -> None:
        assert self._listener is not None  # noqa: S101 - only a registered listener is selected
        self._selector.unregister(self._listener)
        self._accepts_again_s = self._clock.monotonic() + pause_s

    def _welcomed(self, accepted: socket.socket) -> Conversation | None:
        try:
            accepted.setblocking(False)
            accepted.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            return self._welcome(accepted, self.wake)
        except OSError:  # gone already: there is nobody to welcome
            return None

    # ------------------------------------------------------------------------------------------------ bytes

    def _wait_s(self) -> float:
        now_s = self._clock.monotonic()
        due_s = [now_s + self._wait_limit_s]
        if self._listener is None:
            due_s.append(now_s + self._opening.wait_s())
        if self._accepts_again_s is not None:
            due_s.append(self._accepts_again_s)
        for connection in self.connections.values():
            moment_s = connection.conversation.due_s() if connection.closes_at_s is None else connection.closes_at_s
            due_s += [] if moment_s is None else [moment_s]
            if connection.reads_again_s > now_s:
                due_s.append(connection.reads_again_s)
        return max(0.0, min(due_s) - now_s)

    def _receive(self, connection: Connection) -> bool:
        """Take what came; False if nothing did."""
        try:
            data = connection.socket.recv(RECEIVE_MAX)
        except BlockingIOError:
            return False
        except OSError:
            self._close(connection)
            return True
        connection.reads_again_s = self._clock.monotonic() + READ_PAUSE_S
        if data:
            connection.conversation.receive(data)
        elif connection.closes_at_s is not None:
            self._close(connection)
        else:
            connection.has_ended_input = True
            connection.conversation.end_input()
        return True

    def _attend(self, connection: Connection) -> bool:
        """Do what is due, send what can be sent, and close what is over; False if nothing was sent or closed."""
        connection.conversation.turn()
        now_s = self._clock.monotonic()
        is_over = connection.conversation.is_over
        if is_over and connection.closes_at_s is None:
            connection.closes_at_s = now_s + LINGER_S
        try:
            sent = self._send(connection)
            if sent and is_over:
                connection.closes_at_s = now_s + LINGER_S
            if is_over and not connection.conversation.output:
                connection.socket.shutdown(socket.SHUT_WR)
        except OSError:
            self._close(connection)
            return True
        if connection.closes_at_s is not None and now_s >= connection.closes_at_s:
            self._close(connection)
            return True
        self._select(connection)
        return sent > 0

    def _send(self, connection: Connection) -> int:
        """Send what the other side takes now; return how many bytes."""
        if not connection.conversation.output:
            return 0
        try:
            count = connection.socket.send(connection.conversation.output)
        except BlockingIOError:
            return 0
        connection.conversation.sent(count)
        return count

    def _select(self, connection: Connection) -> None:
        wanted, descriptor = connection.wanted(self._clock.monotonic()), connection.socket.fileno()
        known = self._selector.get_map().get(descriptor)
        if known is not None and known.events == wanted:
            return
        if known is not None:
            self._selector.unregister(connection.socket)
        if wanted:
            self._selector.register(connection.socket, wanted)

    def _close(self, connection: Connection) -> None:
        connection.conversation.hang_up()
        del self.connections[connection.socket.fileno()]
        if connection.socket.fileno() in self._selector.get_map():
            self._selector.unregister(connection.socket)
        connection.socket.close()


# ---------------------------------------------------------------------------------------------------- telnet's door


class TelnetSession(Session):
    """A session whose bytes carry telnet's commands; what it shows is UTF-8, which has no 0xFF to be quoted."""

    def __init__(self, shared: Shared, host: str, wake: Callable[[], None]) -> None:
        super().__init__(shared, f"{host} (telnet)", Rank.TELNET, host, wake)
        self._filter = TelnetFilter()

    def start(self) -> None:
        """Negotiate, then as any session."""
        self.output += self._filter.start()
        super().start()

    def receive(self, data: bytes) -> None:
        """Take the commands out; what they say of the terminal is kept, what they ask is answered."""
        if self.is_over:  # no answers behind the last words
            return
        typed = self._filter.receive(data)
        self.output += self._filter.replies()
        self.echoes = self._filter.echoes
        self.ends_keys_with_enter = self._filter.refuses_characters
        self.rows, self.columns = self._filter.rows, self._filter.columns
        super().receive(typed)

    def end_input(self) -> None:
        """A telnet client that sends no more is gone."""
        self.hang_up()


@dataclass
class TelnetDoor:
    """Who may come in by telnet; a ``Welcome``."""

    shared: Shared
    sessions: list[Session] = field(default_factory=list)
    _warned_s: dict[str, float] = field(default_factory=dict)  # when each warning was logged last

    def __call__(self, accepted: socket.socket, wake: Callable[[], None]) -> Conversation | None:
        """Give a newcomer a session, or a reason, or nothing."""
        host = accepted.getpeername()[0]
        if not is_allowed(host, self.shared.hmi().telnet.allow):
            self._warn("telnet: %s is not in the allowed networks", host)
            return None
        set_tcp_options(accepted)
        accepted.setsockopt(socket.SOL_SOCKET, socket.SO_OOBINLINE, 1)  # telnet's data mark stays in its place
        self.sessions = [session for session in self.sessions if not session.is_over]
        if len(self.sessions) >= SESSIONS_MOST:
            self._warn("telnet: %s finds all sessions taken and is closed", host)
            return LastWords(bytearray(too_many(self.shared).encode()))
        log.debug("telnet: %s has come", host)
        session = TelnetSession(self.shared, host, wake)
        session.start()
        self.sessions.append(session)
        return session

    def _warn(self, text: str, host: str) -> None:
        """Log it, but each warning once a minute at most: a storm of connections fills no flash card."""
        now_s = self.shared.clock.monotonic()
        if now_s - self._warned_s.get(text, -WARN_AGAIN_S) >= WARN_AGAIN_S:
            self._warned_s[text] = now_s
            log.warning(text, host, extra={"about": text})  # not the host: there are many


def too_many(shared: Shared) -> str:
    """What somebody is told who finds all places taken."""
    _ = shared.translation()
    return _("There are {count} sessions already: try again later.").format(count=SESSIONS_MOST) + "\r\n"
