"""The slave (server) on TCP: requests of all its clients to ``modbus/server.py``, and replies back (spec section 3).

It knows units, connections and their limits, and nothing of what a request means.

Threads: one for each ``[[slave]]``, for all its clients. ``wake`` and ``set_enabled`` may be called from any thread.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

from gateway.clock import Clock
from gateway.config import SlaveConfig
from gateway.counters import ServeCounters
from gateway.link import Waker
from gateway.link_tcp import is_allowed, set_tcp_options
from gateway.modbus.framing import Frame, Framer, request_framer
from gateway.modbus.pdu import BROADCAST, ExceptionCode, exception_reply
from gateway.modbus.server import Server, answer
from gateway.opening import Opening, Start, at_once
from gateway.register import DataRegister, Source, SourceKind
from gateway.serving import STATION_ALONE, Station, count_traffic, frames_in, server_of
from gateway.traffic import Tap

RECEIVE_MAX: Final = 2048  # bytes taken from a client at once: a step answers all that all have asked
NO_DESCRIPTOR_PAUSE_S: Final = 0.5
UNSENT_MAX: Final = 65536  # bytes a client may leave unread before it is not listened to any more
OWN_UNITS: Final = frozenset({0, 255})  # on Modbus TCP: "this gateway"

log = logging.getLogger(__name__)


@dataclass(eq=False)
class Client:
    """One TCP connection of the upper side."""

    name: str  # "10.0.0.5:40232"
    connection: socket.socket
    framer: Framer
    server: Server
    active_s: float  # when it last sent something, monotonic
    since_s: float
    unsent: bytearray = field(default_factory=bytearray)
    listening_to: int = selectors.EVENT_READ

    @property
    def counters(self) -> ServeCounters:
        """What it asked and was answered."""
        return self.server.counters


class TcpSlave:
    """One ``[[slave]]`` on TCP, all its clients in one thread; a ``Task``."""

    def __init__(
        self,
        config: SlaveConfig,
        register: DataRegister,
        clock: Clock,
        waker: Waker,
        listen: Callable[[], socket.socket],
        wait_limit_s: float = 3.0,
        station: Station = STATION_ALONE,
        start: Start = at_once,
    ) -> None:
        """*listen* gives a listening, non-blocking socket or raises LinkError; *start* has that done somewhere."""
        self.name = config.name
        self.config = config
        self.enabled = config.enabled
        self.ready = threading.Event()
        self.server = server_of(config, register, station)
        self.traffic = Tap(config.framing_used, clock, config.character_timeout_used, config.unit)
        self.clients: dict[int, Client] = {}
        self.refused_clients = 0
        self.port: int | None = None  # that is listened on; None while it is not
        self._clock = clock
        self._waker = waker
        self._wait_limit_s = wait_limit_s
        self._opening = Opening(config.name, clock, listen, waker, start)
        self._listener: socket.socket | None = None
        self._selector = selectors.DefaultSelector()
        self._selector.register(waker, selectors.EVENT_READ)

    @property
    def counters(self) -> ServeCounters:
        """What all clients together asked and were answered."""
        return self.server.counters

    @property
    def trouble(self) -> str:
        """Why nothing can be served, for people; "" while it can."""
        return self._opening.trouble

    def wake(self) -> None:
        """End any wait of this slave's thread."""
        self._waker.wake()

    def set_enabled(self, enabled: bool) -> None:
        """False: maintenance, nobody is listened to and all clients are let go."""
        self.enabled = enabled
        self.wake()

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        """Answer until *stop*; *alive* is called whenever something has been got on with."""
        try:
            while not stop.is_set():
                if self.step():
                    alive()
        finally:
            self.close()

    def close(self) -> None:
        """Let go of every client and of the port."""
        self._let_go()
        self._opening.close()
        self._selector.close()

    def step(self) -> bool:
        """Wait for something to happen, and do what follows; False if nothing came of it."""
        if not self.enabled:
            self.ready.set()
            self._let_go()
        elif self._listener is None and not self._opening.wait_s():
            self._open()
        wait_s = self._wait_s()
        found = self._selector.select(wait_s)
        has_got_on = not found and wait_s > 0.0
        for key, events in found:
            if key.fileobj is self._waker:
                self._waker.clear()
                has_got_on = True
            elif key.fileobj is self._listener:
                has_got_on |= self._accept()
            elif key.fd in self.clients:
                has_got_on |= self._serve(self.clients[key.fd], events)
        self._close_idle()
        return has_got_on

    def _open(self) -> None:
        self._listener = self._opening.attempt(self.ready)
        if self._listener is None:
            return
        self._opening.worked()
        self.port = self._listener.getsockname()[1]
        self._selector.register(self._listener, selectors.EVENT_READ)
        log.info("%s: listening on %s", self.name, self.config.line, extra={"about": self.name})

    def _let_go(self) -> None:
        for client in list(self.clients.values()):
            self._close(client, "the slave stops")
        if self._listener is not None:
            self._selector.unregister(self._listener)
            self._listener.close()
            self._listener = self.port = None

    # -------------------------------------------------------------------------------------------- time

    def _wait_s(self) -> float:
        now_s = self._clock.monotonic()
        due_s = [now_s + self._wait_limit_s]
        if self._listener is None and self.enabled:
            due_s.append(now_s + self._opening.wait_s())
        for client in self.clients.values():
            if self.config.idle_timeout:
                due_s.append(client.active_s + self.config.idle_timeout)
            if client.framer.pending and self._forgets_parts:
                due_s.append(client.active_s + self.config.character_timeout_used)
        return max(0.0, min(due_s) - now_s)

    @property
    def _forgets_parts(self) -> bool:
        """True for RTU and ASCII over TCP, where a pause ends a frame as on a serial line."""
        return self.config.framing_used != "tcp"

    def _close_idle(self) -> None:
        now_s = self._clock.monotonic()
        for client in list(self.clients.values()):
            idle_s = now_s - client.active_s
            if self.config.idle_timeout and idle_s >= self.config.idle_timeout:
                self._close(client, f"nothing asked for {idle_s:.0f} s")
            elif self._forgets_parts and client.framer.pending and idle_s >= self.config.character_timeout_used:
                client.framer.reset()
                self._count_damage(client)

    # -------------------------------------------------------------------------------------------- clients

    def _accept(self) -> bool:
        """Let a newcomer in, or not; False if there is none."""
        assert self._listener is not None  # noqa: S101 - only a registered listener is selected
        try:
            connection, address = self._listener.accept()
        except BlockingIOError:
            return False
        except ConnectionError:  # gone again
            return True
        except OSError as error:
            self._make_room(error)
            return True
        host, port = address[0], address[1]
        if not is_allowed(host, self.config.allow):
            self.refused_clients += 1
            log.warning("%s: %s is not in the allowed networks", self.name, host)
            connection.close()
            return True
        if len(self.clients) >= self.config.max_clients:
            self._close(min(self.clients.values(), key=lambda c: c.active_s), "there are too many clients")
        self._welcome(connection, f"[{host}]:{port}" if ":" in host else f"{host}:{port}")
        return True

    def _make_room(self, error: OSError) -> None:
        """No descriptor is left for a client: let the longest idle go, or wait a little."""
        log.error("%s: a client could not be accepted: %s", self.name, error.strerror)
        if self.clients:
            self._close(min(self.clients.values(), key=lambda c: c.active_s), "there are no descriptors left")
        else:
            self._waker.wait(NO_DESCRIPTOR_PAUSE_S)

    def _welcome(self, connection: socket.socket, name: str) -> None:
        connection.setblocking(False)
        with contextlib.suppress(OSError):  # it may be gone already; reading will tell
            set_tcp_options(connection)
        now_s = self._clock.monotonic()
        source = Source(SourceKind.CLIENT, f"{self.name} {name}")
        server = replace(self.server, source=source, counters=ServeCounters())
        client = Client(name, connection, request_framer(self.config.framing_used), server, now_s, now_s)
        self.clients[connection.fileno()] = client
        self._selector.register(connection, client.listening_to)
        log.debug("%s: %s connected", self.name, name)

    def _close(self, client: Client, reason: str) -> None:
        log.debug("%s: %s closed: %s", self.name, client.name, reason)
        del self.clients[client.connection.fileno()]
        self._selector.unregister(client.connection)
        client.connection.close()
        self.traffic.ended(client.name)

    def _serve(self, client: Client, events: int) -> bool:
        """Answer what came, send what goes; False if neither came to anything."""
        try:
            received = self._receive(client) if events & selectors.EVENT_READ else 0
            if received is None:
                self._close(client, "by the client")
                return True
            sent = self._send(client)
        except OSError as error:
            self._close(client, error.strerror or str(error))
            return True
        if client.framer.broken:
            self._close(client, "what it sends is not Modbus TCP")
        return received + sent > 0

    def _receive(self, client: Client) -> int | None:
        """Take what the client sent and answer it; return how many bytes, None when it has closed."""
        try:
            data = client.connection.recv(RECEIVE_MAX)
        except BlockingIOError:
            return 0
        if not data:
            return None
        client.active_s = self._clock.monotonic()
        self.traffic.tell(False, data, client.name)
        client.framer.receive_data(data)
        client.framer.silence()
        frames = frames_in(client.framer)
        count_traffic(client.server, frames, 0)
        for frame in frames:
            reply = self._reply(client, frame)
            if reply:
                client.unsent += client.framer.encode(Frame(frame.unit, reply, frame.transaction))
        self._count_damage(client)
        return len(data)

    def _reply(self, client: Client, frame: Frame) -> bytes:
        """Return the PDU that answers *frame*; b"" where nothing is answered."""
        if self.config.framing_used == "tcp":
            if frame.unit in OWN_UNITS or frame.unit == self.config.unit:
                return self._answer(client, frame)
            self._count_foreign(client)
            return exception_reply(frame.pdu[0], ExceptionCode.GATEWAY_TARGET_FAILED)
        if frame.unit == BROADCAST:
            client.server.counters.broadcasts += 1
            self.counters.broadcasts += 1
            self._answer(client, frame, broadcast=True)
        elif frame.unit == self.config.unit:
            return self._answer(client, frame)
        else:
            self._count_foreign(client)
        return b""

    def _count_foreign(self, client: Client) -> None:
        client.server.counters.foreign += 1
        self.counters.foreign += 1

    def _count_damage(self, client: Client) -> None:
        count_traffic(client.server, [], client.framer.damaged - client.server.counters.damaged)
        self.counters.damaged += client.framer.damaged - client.server.counters.damaged
        client.server.counters.damaged = client.framer.damaged

    def _answer(self, client: Client, frame: Frame, broadcast: bool = False) -> bytes:
        reply = answer(frame.pdu, client.server, broadcast)
        counters = self.counters
        counters.requests += 1
        if reply[:1] >= b"\x80":
            counters.exceptions[reply[1]] += 1
        else:
            counters.good += 1
        return reply

    def _send(self, client: Client) -> int:
        """Send what the client takes, return how much; while it takes too little it is not listened to."""
        sent = 0
        if client.unsent:
            with contextlib.suppress(BlockingIOError):
                sent = client.connection.send(client.unsent)
                if self.traffic.is_watched:
                    self.traffic.tell(True, bytes(client.unsent[:sent]), client.name)
                del client.unsent[:sent]
        wanted = selectors.EVENT_READ if len(client.unsent) < UNSENT_MAX else 0
        wanted |= selectors.EVENT_WRITE if client.unsent else 0
        if wanted != client.listening_to:
            client.listening_to = wanted
            self._selector.modify(client.connection, wanted)
        return sent
