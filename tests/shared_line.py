"""One pair of wires for tests: ptys of which each hears what all others say, a transcript, and our slaves on it.

``SharedLine`` is the copper: what comes in from one pty goes out to all others, at once or at the pace of a baud rate,
and into the transcript. ``Foreigner`` is a station that says what the test tells it to. ``OurSlave`` is a real
``SerialSlave`` in its thread, behind an ``Ear`` that counts what it read and wrote, and may be kept from reading.

Nothing is waited for by the clock, but for silences of the protocol itself (``keep_silence``). That nobody says any
more is known, not hoped: ``is_at_rest`` is true once each slave has read all that was carried to it, the line has
carried all that the slave wrote, and the slave waits for the next byte with no deadline of a frame.

Threads: the line's own, one for each slave, and the test's. All that they share is behind ``SharedLine.changed``.
"""

from __future__ import annotations

import contextlib
import os
import select
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise

from gateway.clock import SystemClock
from gateway.config import SlaveConfig
from gateway.link import Link, SerialSettings, Waker, open_serial
from gateway.register import DataRegister
from gateway.slave import SerialSlave
from tests.lines import PATIENCE_S, STOP_LIMIT_S, Pty, running

CLOCK = SystemClock()
NEVER_S = 60.0  # a slave's wait for the next byte when nothing is due
DEADLINE_MAX_S = 5.0  # above every deadline of a frame, below NEVER_S
READ_BYTES = 4096
LATELY = 8  # runs of the transcript that a failure shows

Said = list[tuple[str, bytes]]  # who said what, in the order of the wire


def keep_silence(silence_s: float) -> None:
    """Say nothing for *silence_s*: the one thing that a serial line tells by time alone (guide, section 2.5.1.1)."""
    time.sleep(silence_s)


def in_runs(said: Said) -> Said:
    """Return *said* with what one station says in a row made one: the pieces it came in mean nothing."""
    runs: Said = []
    for who, data in said:
        if runs and runs[-1][0] == who:
            runs[-1] = (who, runs[-1][1] + data)
        elif data:
            runs.append((who, data))
    return runs


class Plug:
    """Where one station is plugged in, and how many bytes the wire took from it and gave to it."""

    def __init__(self, who: str) -> None:
        self.who, self.pty = who, Pty()
        self.carried_from = self.carried_to = 0
        self.on_its_way = b""  # said, and not yet carried, where the line has a pace


class SharedLine:
    """The wires; the transcript is in ``said`` and ``when_s``.

    character_s: seconds that a byte takes; 0.0: each piece is carried at once. Two who talk at the same time are both
                 carried, byte by byte in turn: a collision shows in the transcript.
    """

    def __init__(self, character_s: float = 0.0) -> None:
        self.changed = threading.Condition()
        self.said: Said = []
        self.when_s: list[float] = []  # when each piece of it was carried
        self._character_s = character_s
        self._plugs: dict[str, Plug] = {}
        self._error: BaseException | None = None
        self._done, self._pull = os.pipe()
        self._thread = threading.Thread(target=self._run, name="shared line")

    def plug_in(self, who: str) -> Plug:
        """Give *who* a pty; only before ``start``."""
        self._plugs[who] = Plug(who)
        os.set_blocking(self._plugs[who].pty.wire, False)  # a station that does not listen holds up nobody
        return self._plugs[who]

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Take the wires away; raise what went wrong on them."""
        os.close(self._pull)
        if self._thread.ident is not None:
            self._thread.join(STOP_LIMIT_S)
        os.close(self._done)
        for plug in self._plugs.values():
            plug.pty.unplug()
        if self._error is not None:
            raise self._error

    def wait_until(self, condition: Callable[[], object], what: str) -> None:
        """Return once *condition* is true; asked again at each change on the line or in an ear."""
        with self.changed:
            happened = self.changed.wait_for(lambda: self._error or condition(), PATIENCE_S)
            assert happened, f"{what}: not within {PATIENCE_S:g} s; {self.lately()}"
            assert self._error is None, f"the line broke: {self._error!r}"

    def pauses_before(self, who: str) -> list[float]:
        """The silence, in seconds, before each time that *who* began to speak after somebody else."""
        pieces = [(*piece, when) for piece, when in zip(self.said, self.when_s, strict=True)]
        turns = [(last, this) for last, this in pairwise(pieces) if this[0] == who != last[0]]
        return [this[2] - last[2] for last, this in turns]

    def lately(self) -> str:
        """The end of the transcript, for people."""
        runs = in_runs(self.said)[-LATELY:]
        return "lately: " + "; ".join(f"{who} said {data.hex(' ')}" for who, data in runs)

    def _run(self) -> None:
        try:
            self._carry()
        except BaseException as error:  # noqa: BLE001 - raised again in the test's own thread
            with self.changed:
                self._error = error
                self.changed.notify_all()

    def _carry(self) -> None:
        by_wire = {plug.pty.wire: plug for plug in self._plugs.values()}
        due_at = 0.0
        while True:
            busy = any(plug.on_its_way for plug in by_wire.values())
            ready, _, _ = select.select([*by_wire, self._done], [], [], max(0.0, due_at - now_s()) if busy else None)
            if self._done in ready:
                return
            if not busy:
                due_at = now_s() + self._character_s
            for wire in ready:
                by_wire[wire].on_its_way += os.read(wire, READ_BYTES)
            if now_s() >= due_at:
                due_at += self._character_s
                for plug in by_wire.values():
                    self._carry_from(plug)

    def _carry_from(self, plug: Plug) -> None:
        """Carry the next byte of what *plug* says, or all of it where the line has no pace."""
        count = 1 if self._character_s else len(plug.on_its_way)
        data, plug.on_its_way = plug.on_its_way[:count], plug.on_its_way[count:]
        if not data:
            return
        with self.changed:
            self.said.append((plug.who, data))
            self.when_s.append(now_s())
            plug.carried_from += len(data)
            for other in self._plugs.values():
                if other is not plug:
                    other.carried_to += len(data)
                    assert os.write(other.pty.wire, data) == len(data), f"{other.who} has stopped listening"
            self.changed.notify_all()


def now_s() -> float:
    return CLOCK.monotonic()


class Foreigner:
    """A station that is not ours: it says what it is told to, and hears without listening."""

    def __init__(self, line: SharedLine, who: str) -> None:
        self.who, self._line, self._plug = who, line, line.plug_in(who)
        self._fd = os.open(self._plug.pty.device, os.O_RDWR | os.O_NOCTTY)
        self._said = 0

    def say(self, data: bytes, cuts: tuple[int, ...] = (), pause_s: float = 0.0) -> None:
        """Say *data*, in pieces where *cuts* are given, with *pause_s* between them; return once it was carried."""
        termios.tcflush(self._fd, termios.TCIFLUSH)  # what others said meanwhile
        for start, stop in zip((0, *cuts), (*cuts, len(data)), strict=True):
            if start:
                keep_silence(pause_s)
            self._said += stop - start
            assert os.write(self._fd, data[start:stop]) == stop - start
            self._line.wait_until(lambda: self._plug.carried_from == self._said, f"{self.who} is carried")

    def close(self) -> None:
        os.close(self._fd)


class Ear:
    """A slave's link; it may be held, as if the thread were kept from running.

    Held ``together``: all that comes meanwhile is read in one piece afterwards. Held ``in hand``: the first piece has
    just been read and is handed on afterwards; the rest lies in the port.
    """

    def __init__(self, link: Link, line: SharedLine, plug: Plug) -> None:
        self.character_s = link.character_s
        self.discard, self.close = link.discard, link.close
        self._link, self._line, self._plug = link, line, plug
        self._heard = self._spoken = 0
        self._is_waiting = False  # for the next byte; the last wait ended with nothing
        self._is_idle = False  # waits for a byte, and for nothing else
        self._is_silent = True  # the last read brought nothing
        self._held = ""
        self._is_stuck = False  # has read, and is held
        self._backlog = b""  # read, and not handed on yet

    def read(self, timeout_s: float) -> bytes:
        with self._line.changed:
            self._is_waiting = self._is_silent
            self._is_idle = timeout_s > DEADLINE_MAX_S and not self._backlog
            self._line.changed.notify_all()
        backlog, self._backlog = self._backlog, b""
        if backlog:
            return backlog  # counted when it was read
        data = self._link.read(timeout_s)
        with self._line.changed:
            self._is_waiting = self._is_idle = False
            self._is_silent = not data
            self._heard += len(data)
            how = self._wait_for_release() if self._held and data else ""
            self._line.changed.notify_all()
        rest = self._read_rest() if how else b""
        if how == "in hand":
            self._backlog, rest = rest, b""
        return data + rest

    def write(self, data: bytes) -> None:
        with self._line.changed:
            self._spoken += len(data)
        self._link.write(data)

    def hold(self, how: str) -> None:
        """Keep the slave from what it reads next; *how*: "together" or "in hand"."""
        with self._line.changed:
            self._held = how

    def release(self) -> None:
        """Let the slave go on."""
        self._line.wait_until(lambda: self._is_stuck, "the held slave has read something")
        with self._line.changed:
            self._held = ""
            self._line.changed.notify_all()

    def has_heard_silence(self) -> bool:
        """True if it has read all, and has waited in vain for more."""
        return self._is_waiting and self._heard == self._plug.carried_to

    def is_at_rest(self) -> bool:
        """True if it has read all, all it wrote was carried, and no silence or part of a frame is waited out."""
        is_told = (self._heard, self._spoken) == (self._plug.carried_to, self._plug.carried_from)
        return self._is_idle and is_told

    def _wait_for_release(self) -> str:
        """Return how it was held, once it is not any more."""
        how, self._is_stuck = self._held, True
        self._line.changed.notify_all()
        self._line.changed.wait_for(lambda: not self._held)
        self._is_stuck = False
        return how

    def _read_rest(self) -> bytes:
        """Return all that was carried to it meanwhile; a pty passes bytes on in its own time."""
        rest = b""
        while self._heard < self._plug.carried_to and (more := self._link.read(PATIENCE_S)):
            rest += more
            self._heard += len(more)
        return rest


class OurSlave:
    """A ``SerialSlave`` on the line, and what it serves."""

    def __init__(self, config: SlaveConfig, register: DataRegister, line: SharedLine, waker: Waker) -> None:
        self.unit, self.who, self.register = config.unit, config.name, register
        self._line, self._plug, self._waker, self._baud = line, line.plug_in(config.name), waker, config.baudrate
        self._ear: Ear | None = None
        self.task = SerialSlave(config, register, CLOCK, waker, self._open, wait_limit_s=NEVER_S)

    @property
    def ear(self) -> Ear:
        assert self._ear is not None
        return self._ear

    def is_at_rest(self) -> bool:
        return self._ear is not None and self._ear.is_at_rest()

    def has_said(self, count: int) -> bool:
        """Tell whether the line has carried *count* bytes of it, or more, since the beginning."""
        return self._plug.carried_from >= count

    def _open(self) -> Link:
        settings = SerialSettings(self._plug.pty.device, self._baud, "none")
        self._ear = Ear(open_serial(settings, self._waker, CLOCK), self._line, self._plug)
        return self._ear


@contextmanager
def slaves_on(line: SharedLine, configs: list[SlaveConfig], registers: list[DataRegister]) -> Iterator[list[OurSlave]]:
    """Plug our slaves in, start the line, and give the slaves, all listening."""
    with contextlib.ExitStack() as stack:
        slaves = []
        for config, register in zip(configs, registers, strict=True):
            waker = stack.enter_context(contextlib.closing(Waker()))
            slaves.append(OurSlave(config, register, line, waker))
        line.start()
        for slave in slaves:
            stack.enter_context(running(slave.task))
        line.wait_until(lambda: all(slave.is_at_rest() for slave in slaves), "the slaves listen")
        yield slaves
