"""Telnet clients that behave badly, in a process of their own: `python -m tests.system.storm PORT SECONDS KIND...`.

Each KIND is one client in a thread of its own, which comes again whenever it is closed. The process ends after SECONDS
and prints, for each client, how often it came and how many bytes it could send. No key of a storm changes anything, so
that whatever has the menu can do its worst: M, ?, D, I and L show, and all other letters are left out.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import random
import select
import socket
import string
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

IAC, WILL, WONT, DO, DONT, SB, SE, NAWS = 255, 251, 252, 253, 254, 250, 240, 31
HARMFUL = "".join(set(string.ascii_letters) - set("mMdDiIlL")).encode()
PIECES, PIECE = 16, 16384  # made before, so that the storm costs the machine little


def random_bytes(chance: random.Random) -> bytes:
    """Anything but keys that change something: telnet commands, invalid UTF-8, control characters."""
    return chance.randbytes(PIECE).translate(None, HARMFUL)


def options(chance: random.Random) -> bytes:
    """Every option offered, asked for and taken back."""
    verbs = (WILL, WONT, DO, DONT)
    return b"".join(bytes([IAC, chance.choice(verbs), chance.randrange(256)]) for _ in range(PIECE // 3))


def subnegotiations(chance: random.Random) -> bytes:
    """Window sizes, and subnegotiations that a command cuts short."""
    size = chance.randbytes(4).replace(bytes([IAC]), b"\0")
    whole = bytes([IAC, SB, NAWS]) + size + bytes([IAC, SE])
    cut = [bytes([IAC, SB, chance.randrange(240), IAC, chance.randrange(240, 255)]) for _ in range(PIECE // 14)]
    return whole.join(cut)


def endless(chance: random.Random) -> bytes:
    """A subnegotiation that never ends."""
    return bytes([IAC, SB, NAWS]) + bytes(PIECE)


def keys(chance: random.Random) -> bytes:
    """Keys, escape sequences whole and broken, letters cut in two, CR, LF and NUL in every mix."""
    broken = (b"\x1b", b"\x1b\0", b"\x1b[", b"\x1b[1;2", b"\x1b[A", b"\xc3", b"\xe2\x82", b"\r", b"\n", b"\0")
    whole = [bytes([key]) for key in b"?md310il \x7f\x15"]
    return b"".join(chance.choices([*broken, *whole], k=PIECE // 2))


STREAMS: dict[str, Callable[[random.Random], bytes]] = {
    "random": random_bytes,
    "options": options,
    "subnegotiations": subnegotiations,
    "endless": endless,
    "keys": keys,
    "deaf": keys,
    "dribbles": keys,
}


@dataclass
class Client:
    """One client; ``came`` and ``sent`` count connections and bytes."""

    port: int
    kind: str
    number: int
    until_s: float
    came: int = 0
    sent: int = 0

    def run(self) -> None:
        pieces = self._pieces()
        while time.monotonic() < self.until_s:
            with contextlib.suppress(OSError), self._connected() as connection:
                self.came += 1
                self._behave(connection, pieces)

    def _connected(self) -> socket.socket:
        """Come from an address of its own, so that one that is locked out keeps nobody else out."""
        source = f"127.0.{self.number}.{1 + self.came % 250}"
        connection = socket.create_connection(("127.0.0.1", self.port), 2.0, source_address=(source, 0))
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def _pieces(self) -> Iterator[bytes]:
        chance = random.Random(self.number)
        return itertools.cycle([STREAMS.get(self.kind, keys)(chance) for _ in range(PIECES)])

    def _behave(self, connection: socket.socket, pieces: Iterator[bytes]) -> None:
        if self.kind == "resets":
            connection.recv(PIECE)
            self.sent += connection.send(next(pieces)[:100])
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        elif self.kind == "guesses":
            self._guess(connection)
        else:
            self._pour(connection, pieces)

    def _pour(self, connection: socket.socket, pieces: Iterator[bytes]) -> None:
        """Send as fast as it is taken, unless mute, and read all that comes, unless deaf."""
        connection.setblocking(False)
        reads = [] if self.kind == "deaf" else [connection]
        writes = [] if self.kind == "mute" else [connection]
        rest = b""
        while (left_s := self.until_s - time.monotonic()) > 0:
            readable, writable, _ = select.select(reads, writes, [], min(left_s, 0.5))
            if readable and not connection.recv(65536):
                return
            if writable:
                rest = rest or next(pieces)
                sent = connection.send(rest[:1] if self.kind == "dribbles" else rest)
                self.sent += sent
                rest = rest[sent:]

    def _guess(self, connection: socket.socket) -> None:
        """Try passwords, each as soon as the last was refused, until locked out."""
        connection.settimeout(10.0)
        said = b""
        while time.monotonic() < self.until_s and (data := connection.recv(PIECE)):
            said += data
            if said.endswith(b"Password: "):
                said = b""
                self.sent += connection.send(b"not this one\r")


def main() -> None:
    port, until_s, kinds = int(sys.argv[1]), time.monotonic() + float(sys.argv[2]), sys.argv[3:]
    clients = [Client(port, kind, number, until_s) for number, kind in enumerate(kinds)]
    threads = [threading.Thread(target=client.run) for client in clients]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(json.dumps([[client.kind, client.came, client.sent] for client in clients]))


if __name__ == "__main__":
    main()
