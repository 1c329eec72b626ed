"""A gateway as it is run in the field, a process with a file and a state directory, and hands at its terminals."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from tests.peers import client_tcp, unit_kwargs

REPOSITORY = Path(__file__).parents[2]
SOON_S = 20.0  # for what another program has to do; a test that needs it has failed
LOOK_EVERY_S = 0.02  # nothing tells a test how far another program is
T = TypeVar("T")


def eventually(look: Callable[[], T], is_it: Callable[[T], object] = bool, limit_s: float = SOON_S) -> T:
    """Look until *is_it* says so of what is seen, and return that; what was seen last is in the error."""
    until_s = time.monotonic() + limit_s
    while not is_it(seen := look()):
        assert time.monotonic() < until_s, f"not within {limit_s:g} s; seen last:\n{seen}"
        time.sleep(LOOK_EVERY_S)
    return seen


# ------------------------------------------------------------------------------------------------ the gateway


class RealStation:
    """`rtugate run` on a file of its own; it can be stopped and started again."""

    def __init__(self, folder: Path, text: str) -> None:
        """*folder*: where its file and its state directory are made."""
        self.file, self.state, self._log = folder / "rtugate.toml", folder / "state", folder / "log"
        self.file.write_text(text)
        self._log.touch()
        self._starts = 0
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def process(self) -> subprocess.Popen[bytes]:
        assert self._process is not None, "it was never started"
        return self._process

    @property
    def said(self) -> str:
        """What all its runs have logged."""
        return self._log.read_text()

    def start(self) -> None:
        """Start it; return once telnet is let in."""
        arguments = ["run", "-c", str(self.file), "--state", str(self.state)]
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "RUNTIME_DIRECTORY": "", "TZ": "UTC"}
        with self._log.open("ab") as log:
            self._process = subprocess.Popen([sys.executable, "-m", "gateway", *arguments], stderr=log, env=environment)
        self.has_started()

    def has_started(self) -> None:
        """Wait until it has started once more, by ``start`` or by itself, and telnet is let in."""
        self._starts += 1
        self.wait_for("telnet server: listening", self._starts)

    def wait_for(self, words: str, times: int = 1) -> None:
        """Wait until it has logged *words* so often."""
        eventually(lambda: self.said, lambda said: said.count(words) >= times)

    def reload(self, text: str) -> None:
        """Give it another file while it runs."""
        told = "rtugate.toml: reloaded"
        times = self.said.count(told) + 1
        self.file.write_text(text)
        self.process.send_signal(signal.SIGHUP)
        self.wait_for(told, times)

    def stop(self) -> int:
        """End it as systemd does; return its exit code."""
        self.process.terminate()
        return self.process.wait(SOON_S)


@contextmanager
def real_station(folder: Path, text: str) -> Iterator[RealStation]:
    """Run a gateway on the file *text* until the block ends."""
    station = RealStation(folder, text)
    try:
        station.start()
        yield station
    finally:
        station.process.kill()
        station.process.wait()


def scada_reads(port: int, unit: int, point: int, count: int) -> list[int] | str:
    """Return what a SCADA system gets for these holding registers, or in words why it gets nothing."""
    try:
        with client_tcp(port) as client:
            reply = client.read_holding_registers(point, count=count, **unit_kwargs(unit))
    except AssertionError as error:
        return str(error)
    return str(reply) if reply.isError() else list(reply.registers)


# ------------------------------------------------------------------------------------------------ hands


Steps = Sequence[tuple[str, str]]  # what the screen says at last, and which keys a person then types; "\r" is Enter


class Hands:
    """Somebody who types into a descriptor what the steps say, and types nothing before he was asked for it.

    ``seen``: all that has come so far.
    """

    def __init__(self, descriptor: int, ends_keys_with_enter: bool = False) -> None:
        """*ends_keys_with_enter*: his terminal sends whole lines only, a CR LF behind each."""
        self._descriptor = descriptor
        self._ends_keys_with_enter = ends_keys_with_enter
        self._got = b""
        self.seen = b""

    def carry_out(self, steps: Steps) -> None:
        for asked, keys in steps:
            self.sees(asked)
            self.type(keys)

    def type(self, keys: str) -> None:
        if self._ends_keys_with_enter and keys:
            keys = keys.removesuffix("\r") + "\r\n"
        os.write(self._descriptor, keys.encode())

    def sees(self, words: str) -> str:
        """Wait for *words*; return all that came up to them."""
        while words.encode() not in self._got:
            data = self._next()
            assert data, f"{words!r} has not come, but {self._got.decode(errors='replace')}"
            self._got += data
        text, _, self._got = self._got.partition(words.encode())
        return text.decode(errors="replace") + words

    def sees_the_end(self) -> str:
        """Wait for the other side to close; return all that came before."""
        while data := self._next():
            self._got += data
        text, self._got = self._got, b""
        return text.decode(errors="replace")

    def _next(self) -> bytes:
        ready = select.select([self._descriptor], [], [], SOON_S)[0]
        assert ready, f"silence after {self._got.decode(errors='replace')}"
        data = os.read(self._descriptor, 4096)
        self.seen += data
        return data
