"""Terminals for tests: a menu that shows which keys it got, what sessions share, and a small client of sockets."""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from gateway.clock import Clock, SystemClock
from gateway.config import HmiConfig
from gateway.hmi.access import Lockout
from gateway.hmi.background import Background, Call
from gateway.hmi.seat import Rank, Seat
from gateway.hmi.session import Session, Shared
from tests.fakes import JumpingClock
from tests.lines import PATIENCE_S

CLOCK = SystemClock()
PASSWORD = "open sesame"  # noqa: S105 - opens nothing but these tests
_SALT = bytes(range(16))
CHEAP_HASH = (
    f"scrypt$16$1$1${_SALT.hex()}${hashlib.scrypt(PASSWORD.encode(), salt=_SALT, n=16, r=1, p=1, dklen=32).hex()}"
)
MAIN_MENU = "MAIN MENU\r\n> "


@dataclass(eq=False)
class FakeMenu:
    """A menu that shows each key it gets in brackets.

    Q leaves; L starts a live display, one line each second; B (big) shows 3000 characters; X is a bug.
    """

    who: str
    clock: Clock
    wake: Callable[[], None]
    echoes: bool = True
    ends_keys_with_enter: bool = False
    has_left: bool = False
    rows: int = 0
    columns: int = 0
    keys: list[str] = field(default_factory=list)
    pauses: int = 0
    ticks: int = 0
    is_closed: bool = False
    live_s: float | None = None
    says_at_tick: str = "tick\n"

    def start(self) -> str:
        return "MAIN MENU\n> "

    def key(self, key: str) -> str:
        assert not self.is_closed, "a closed menu got a key"
        self.keys.append(key)
        if key == "X":
            raise ZeroDivisionError("a bug in the menu")
        self.has_left = self.has_left or key in "qQ"
        if key == "L":
            self.live_s = self.clock.monotonic() + 1.0
        return "b" * 3000 if key == "B" else f"[{key!a}]"

    def pause(self) -> str:
        self.pauses += 1
        return ""

    def tick(self) -> str:
        assert not self.is_closed, "a closed menu got a tick"
        self.ticks += 1
        if self.live_s is not None:
            self.live_s = self.clock.monotonic() + 1.0
        return self.says_at_tick

    def due_s(self) -> float | None:
        return self.live_s

    def close(self) -> None:
        self.is_closed = True


class PatientBackground(Background):
    """Calls wait until the test has them run."""

    def __init__(self) -> None:
        super().__init__("not used")
        self.waiting: list[Call] = []

    def run(self, work: Callable[[], None]) -> Call:
        self.waiting.append(Call(work))
        return self.waiting[-1]

    def work(self) -> None:
        """Run all that waits and was not cancelled."""
        while self.waiting:
            call = self.waiting.pop(0)
            if not call.is_cancelled:
                call.work()


class House:
    """All that the terminals of one station share; ``menus`` are those that were made, the newest last."""

    def __init__(self, clock: Clock, passwords: Background | None = None, **hmi: Any) -> None:
        self.clock = clock
        self.menus: list[FakeMenu] = []
        self.passwords = passwords or PatientBackground()
        self.seat = Seat(clock, lambda: self.hmi.serial_hold if self.hmi.serial.line else 0.0)
        self.hmi = HmiConfig()
        self.configure(**hmi)
        self.shared = Shared(
            clock,
            self.seat,
            self._make_menu,
            lambda: self.hmi,
            Lockout(clock),
            self.passwords,
            lambda: lambda text: text,
        )

    def configure(self, **hmi: Any) -> None:
        """A new configuration, while everything runs."""
        self.hmi = HmiConfig.model_validate(hmi)

    @property
    def menu(self) -> FakeMenu:
        return self.menus[-1]

    def _make_menu(self, who: str, wake: Callable[[], None]) -> FakeMenu:
        self.menus.append(FakeMenu(who, self.clock, wake))
        return self.menus[-1]


class Screen:
    """A session on a clock that jumps, seen from its keyboard and its screen; ``wakes`` counts what woke its thread."""

    def __init__(self, house: House, rank: Rank = Rank.TELNET, who: str = "", address: str = "10.0.0.5") -> None:
        names = {Rank.SERIAL: "serial console", Rank.LOCAL: "maria (rtugate menu)", Rank.TELNET: f"{address} (telnet)"}
        self.house = house
        self.wakes = 0
        self.session = Session(house.shared, who or names[rank], rank, address, self._wake)
        self.session.start()

    def type(self, text: str | bytes) -> str:
        """Type *text*; return what is shown since last time."""
        self.session.receive(text.encode() if isinstance(text, str) else text)
        self.session.turn()
        return self.shown()

    def shown(self) -> str:
        """Let the session do what is due; return what is shown since last time."""
        self.session.turn()
        text = ""
        while self.session.output:
            text += self.session.output.decode()
            self.session.sent(len(self.session.output))
            self.session.turn()
        return text

    def run_s(self, seconds: float) -> str:
        """Let time pass as the carrier would, from due time to due time; return what is shown meanwhile."""
        clock = self.house.clock
        assert isinstance(clock, JumpingClock)
        until_s, text, turns = clock.monotonic() + seconds, self.shown(), 0
        while clock.monotonic() < until_s:
            due_s = self.session.due_s()
            step_s = until_s if due_s is None else min(due_s, until_s)
            clock.pass_s(max(0.0, step_s - clock.monotonic()))
            text += self.shown()
            turns += 1
            assert turns < 50 + 50 * seconds, "the session turns without waiting"
        return text

    def _wake(self) -> None:
        self.wakes += 1


# ------------------------------------------------------------------------------------------------ real terminals


class Client:
    """A client of a socket who keeps all that came, so that a test can wait for words."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.socket.settimeout(PATIENCE_S)
        self.got = b""

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def read_until(self, words: str) -> str:
        """Return all up to *words*, which have to come; what follows them waits for the next time."""
        wanted = words.encode()
        while wanted not in self.got:
            try:
                data = self.socket.recv(4096)
            except TimeoutError:
                data = b""
            assert data, f"{words!r} has not come, but {self.got!r}"
            self.got += data
        text, _, self.got = self.got.partition(wanted)
        return (text + wanted).decode("utf-8", "replace")

    def read_all(self) -> str:
        """Return all until the other side closes."""
        with contextlib.suppress(ConnectionError):
            while data := self.socket.recv(4096):
                self.got += data
        text, self.got = self.got, b""
        return text.decode("utf-8", "replace")

    def has_nothing(self) -> bool:
        """Tell whether nothing has come by now."""
        return not self.got and not select.select([self.socket], [], [], 0)[0]

    def reset(self) -> None:
        """End the connection with RST."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()


@contextmanager
def tcp_client(port: int | None, source: str = "127.0.0.1") -> Iterator[Client]:
    """Give a client of *port*, coming from *source*."""
    assert port is not None, "nobody listens"
    connection = socket.create_connection(("127.0.0.1", port), PATIENCE_S, source_address=(source, 0))
    with contextlib.closing(connection):
        yield Client(connection)


@contextmanager
def unix_client(path: os.PathLike[str]) -> Iterator[Client]:
    """Give a client of the unix socket at *path*."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.connect(str(path))
        yield Client(connection)
