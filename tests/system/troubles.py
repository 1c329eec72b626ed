"""What goes wrong at a station, and comes right again: devices, adapters, clients, people, the file itself.

A ``Trouble`` begins and ends; afterwards the station is to be what it was before. All are called by one thread.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

from gateway.simulator import Device, Simulator
from tests.hmi.real_station import SOON_S

TCP_REPAIR = 19  # linux/tcp.h: a connection closed while it is on ends without a word to the other side
READ = bytes.fromhex("0001 0000 0006 01 03 0000 000A")  # 10 holding registers of unit 1
PAUSE_S = 0.2  # of those that come and go
KEPT = 8192  # bytes of a terminal


class Trouble(Protocol):
    """See the module."""

    def begin(self) -> None:
        """Let it go wrong."""
        ...

    def end(self) -> None:
        """Let it come right again."""
        ...


# ------------------------------------------------------------------------------------------------ devices


class Silence:
    """A device answers nothing; its port and its connections stay."""

    def __init__(self, device: Device) -> None:
        self._device = device

    def begin(self) -> None:
        self._device.silent = True

    def end(self) -> None:
        self._device.silent = False


class Refusal:
    """A TCP device closes its connections and takes no new ones."""

    def __init__(self, simulator: Simulator, devices: Sequence[Device]) -> None:
        """*simulator*: its own."""
        self._simulator, self._devices = simulator, devices
        self._port = simulator.add_tcp(devices)
        self.line = f"tcp://127.0.0.1:{self._port}"

    def begin(self) -> None:
        self._simulator.stop()

    def end(self) -> None:
        self._simulator.start()
        self._simulator.add_tcp(self._devices, self._port)


class Unplugging:
    """A USB adapter vanishes, with its link of a name that stays, and comes back at another number."""

    def __init__(self, simulator: Simulator, devices: Sequence[Device], link: Path) -> None:
        """*simulator*: its own. *link*: what is configured, as /dev/serial/by-id/... is."""
        self._simulator, self._devices, self._link = simulator, devices, link
        self._others: list[int] = []  # that take the numbers which became free
        self._plug()

    def begin(self) -> None:
        self._link.unlink()
        self._simulator.stop()

    def end(self) -> None:
        self.close()
        self._others = [descriptor for _ in range(2) for descriptor in os.openpty()]
        self._simulator.start()
        self._plug()

    def close(self) -> None:
        for descriptor in self._others:
            os.close(descriptor)
        self._others = []

    def _plug(self) -> None:
        self._link.symlink_to(self._simulator.add_serial(self._devices))


# ------------------------------------------------------------------------------------------------ clients


class HalfOpen:
    """Clients of a slave, every other one in the middle of a request, whose machine is switched off: no FIN, no RST."""

    def __init__(self, port: int, count: int) -> None:
        self._port, self._count = port, count

    def begin(self) -> None:
        for number in range(self._count):
            with connected(self._port) as client:
                client.sendall(READ)
                assert client.recv(512)
                client.sendall(READ[: 7 * (number % 2)])
                client.setsockopt(socket.IPPROTO_TCP, TCP_REPAIR, 1)

    def end(self) -> None:
        """Nobody tells the gateway: it has to find out by itself."""


class Coming:
    """Somebody who comes and goes, again and again; what stops him is raised by ``end``."""

    def __init__(self, visit: Callable[[int], None]) -> None:
        """*visit* is given the number of the visit."""
        self.visits = 0
        self._visit = visit
        self._stop = threading.Event()
        self._thread = threading.Thread()
        self._error: Exception | None = None

    def begin(self) -> None:
        self._stop.clear()
        self._thread = threading.Thread(target=self._come_and_go)
        self._thread.start()

    def end(self) -> None:
        self._stop.set()
        self._thread.join()
        if self._error is not None:
            raise self._error

    def _come_and_go(self) -> None:
        try:
            while not self._stop.wait(PAUSE_S):
                self._visit(self.visits)
                self.visits += 1
        except (OSError, AssertionError) as error:
            self._error = error


def reads_once(port: int, number: int) -> None:
    """A client that connects for each request; every other one closes with an RST."""
    with connected(port) as client:
        client.sendall(READ)
        assert client.recv(512)[7] == READ[7], "an exception"
        if number % 2:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


@contextlib.contextmanager
def connected(port: int) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", port), SOON_S) as client:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield client


# ------------------------------------------------------------------------------------------------ people


class Terminal:
    """A telnet client for a long time: of what has come it keeps the newest KEPT bytes."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._got = b""

    def carry_out(self, steps: Sequence[tuple[str, str]]) -> None:
        """See what each step asks for, then type its keys."""
        for asked, keys in steps:
            self.sees(asked)
            self._connection.sendall(keys.encode())

    def sees(self, words: str) -> None:
        until_s = time.monotonic() + SOON_S
        while words.encode() not in self._got:
            assert self._read(until_s), f"{words!r} has not come, but {self._got.decode(errors='replace')}"
        self._got = self._got.partition(words.encode())[2]

    def looks_on(self, stop: threading.Event, seconds: float) -> int:
        """Read what comes for so long; return how many bytes."""
        until_s, count = time.monotonic() + seconds, 0
        while not stop.is_set() and (came := self._read(until_s)):
            count += came
        return count

    def _read(self, until_s: float) -> int:
        """Read what comes by then; return how many bytes, 0 for none."""
        if not select.select([self._connection], [], [], max(0.0, until_s - time.monotonic()))[0]:
            return 0
        data = self._connection.recv(4096)
        assert data, f"the menu was closed after {self._got.decode(errors='replace')}"
        self._got = (self._got + data)[-KEPT:]
        return len(data)


def is_told_who_has_the_menu(port: int, _number: int) -> None:
    """A visitor finds the menu taken, and leaves."""
    with connected(port) as connection:
        Terminal(connection).sees("127.0.0.1 (telnet) has the menu.")


VIEWS = (  # keys from the main menu to something that moves, and the one that leads back
    ([("Table: ", "3"), ("First point (0-1999): ", "0\r"), (" [1]: ", "20\r"), ("quality", "")], "d", "m"),
    ([("Line: ", "1"), ("until any key", "")], "t", "m"),
    ([("last restart", "")], "i", "m"),
    ([("E ends it.", "")], "e", "e"),
)


class Onlooker(Coming):
    """Somebody at the menu who has one thing after the other shown as it happens: values, traffic, status, writes."""

    def __init__(self, port: int, each_s: float) -> None:
        super().__init__(lambda _number: self._look(port, each_s))
        self.bytes = 0

    def _look(self, port: int, each_s: float) -> None:
        with connected(port) as connection:
            terminal = Terminal(connection)
            while not self._stop.is_set():
                for steps, there, back in VIEWS:
                    terminal.carry_out([("rtugate> ", there), *steps])
                    self.bytes += terminal.looks_on(self._stop, each_s)
                    connection.sendall(back.encode())
