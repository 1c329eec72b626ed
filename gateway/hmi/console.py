"""The serial console: bytes between a serial port and its session (spec section 5, "Serial console").

What it is: a task that keeps the port open, tells characters from breaks, NULs and damaged characters, and writes
slowly enough to hear a key in the middle of a screen.
What it refuses: knowing what is typed or shown; answering to noise.
Source: termios(3), PARMRK: a damaged character X comes as FF 00 X, a break as FF 00 00, a real FF as FF FF.
Threads: one. ``wake`` may be called from any; ``trouble`` may be read from any.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Final

from gateway.clock import Clock
from gateway.errors import LinkError
from gateway.hmi.seat import Rank
from gateway.hmi.session import Session, Shared
from gateway.link import Link, Waker
from gateway.opening import Opening, Start, at_once

WRITE_S: Final = 0.1  # so much is written at once, as time on the wire: then it is listened again
WRITE_MOST: Final = 1024  # bytes; a pty says that its characters take no time
NOISE_MOST: Final = 100  # breaks, NULs and damaged characters in a minute; more are an alarm (section 5)
NOISE_S: Final = 60.0
MARK: Final = 0xFF
ABOUT: Final = {"about": "serial console: noise"}  # one cause, for the log

log = logging.getLogger(__name__)


class MarkedBytes:
    """Characters out of a port's bytes in which errors are marked (PARMRK); pure.

    ``faults`` counts what is no character: breaks, NULs, characters with a line error.
    """

    def __init__(self) -> None:
        self.faults = 0
        self._mark = b""  # what has come of FF, FF 00 or FF 00 X

    def receive(self, data: bytes) -> bytes:
        """Take bytes in pieces of any size; return the characters in them."""
        if not self._mark and MARK not in data:
            self.faults += data.count(0)
            return data.replace(b"\0", b"")
        return b"".join(self._byte(byte) for byte in data)

    def _byte(self, byte: int) -> bytes:
        mark, self._mark = self._mark, b""
        if len(mark) == 2:
            self.faults += 1
        elif mark and byte == MARK:
            return b"\xff"
        elif (mark and byte == 0) or byte == MARK:
            self._mark = mark + bytes([byte])
        elif byte == 0:
            self.faults += 1
        else:
            return bytes([byte])
        return b""


class Noise:
    """An alarm while a line is noisier than it may be; pure but for its log lines."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._heard_s: deque[float] = deque(maxlen=NOISE_MOST + 1)
        self._is_alarm = False

    @property
    def trouble(self) -> str:
        """What is wrong, for people; "" while the line is quiet enough."""
        return f"noise on the line: more than {NOISE_MOST} breaks or damaged characters in a minute" * self._is_alarm

    def count(self, faults: int) -> None:
        """So many more were heard; 0: look at the time."""
        now_s = self._clock.monotonic()
        self._heard_s.extend([now_s] * min(faults, NOISE_MOST + 1))
        is_many = len(self._heard_s) > NOISE_MOST and now_s - self._heard_s[0] <= NOISE_S
        if is_many and not self._is_alarm:
            self._is_alarm = True
            log.warning("serial console: %s", self.trouble, extra=ABOUT)
        elif self._is_alarm and now_s - self._heard_s[-1] >= NOISE_S:
            self._is_alarm = False
            log.warning("serial console: the line is quiet again", extra=ABOUT)


class SerialConsole:
    """The menu's serial console; a ``Task``."""

    def __init__(
        self,
        shared: Shared,
        clock: Clock,
        waker: Waker,
        open_link: Callable[[], Link],
        wait_limit_s: float = 3.0,
        start: Start = at_once,
    ) -> None:
        """*open_link* opens the port, errors marked, or raises LinkError; *start* has that done somewhere."""
        self.name = "serial console"
        self.ready = threading.Event()
        self._shared = shared
        self._clock = clock
        self._waker = waker
        self._wait_limit_s = wait_limit_s
        self._opening = Opening(self.name, clock, open_link, waker, start)
        self._noise = Noise(clock)
        self._link: Link | None = None
        self._bytes = MarkedBytes()
        self._session: Session | None = None
        self._sends_again_s = 0.0  # when what was written last is on the wire, monotonic

    @property
    def trouble(self) -> str:
        """Why the console cannot be used, or hardly; "" while it can."""
        return self._opening.trouble or self._noise.trouble

    def wake(self) -> None:
        """End any wait of this console's thread."""
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
            self._let_go()
            self._opening.close()

    def step(self) -> bool:
        """Wait for keys or for what is due, and do what follows; False if nothing came of it."""
        self._noise.count(0)
        if self._link is None or self._session is None:
            self._open()
            return True
        try:
            return self._carry(self._link, self._session)
        except LinkError as error:
            self._let_go()
            self._opening.failed(str(error))
            return True

    def _open(self) -> None:
        wait_s = self._opening.wait_s()
        if wait_s:
            self._waker.wait(min(wait_s, self._wait_limit_s))
            return
        self._link = self._opening.attempt(self.ready)
        if self._link is None:
            return
        self._bytes = MarkedBytes()
        self._session = Session(self._shared, "serial console", Rank.SERIAL, "serial console", self.wake)
        self._session.start()
        log.info("%s: open", self.name, extra={"about": self.name})

    def _let_go(self) -> None:
        session, self._session = self._session, None
        link, self._link = self._link, None
        if link is not None:
            link.close()
        if session is not None:
            session.hang_up()

    def _carry(self, link: Link, session: Session) -> bool:
        """Return whether bytes went either way, a wake came, or the wait has run its time."""
        began_s, wakes = self._clock.monotonic(), self._waker.wakes
        wait_s = self._wait_s(session)
        data = link.read(wait_s)
        has_waited = wait_s > 0.0 and self._clock.monotonic() >= began_s + wait_s
        if self._opening.trouble:
            self._opening.worked()  # a port that opens has to be read from once before it counts
        typed = self._bytes.receive(data)
        if self._bytes.faults:
            self._noise.count(self._bytes.faults)
            self._bytes.faults = 0
        session.receive(typed)
        session.turn()
        part = bytes(session.output[: self._part(link)]) if self._clock.monotonic() >= self._sends_again_s else b""
        if part:
            link.write(part)
            self._sends_again_s = self._clock.monotonic() + len(part) * link.character_s
            session.sent(len(part))
        return bool(data or part) or self._waker.wakes > wakes or has_waited

    def _wait_s(self, session: Session) -> float:
        """How long nothing is to be done but listen. What is written next waits until the last part is on the wire:
        in the kernel's buffer it could not be stopped by a key."""
        due_s = self._sends_again_s if session.output else session.due_s()
        left_s = self._wait_limit_s if due_s is None else due_s - self._clock.monotonic()
        return min(self._wait_limit_s, max(0.0, left_s))

    @staticmethod
    def _part(link: Link) -> int:
        """How many bytes are written at once."""
        return min(WRITE_MOST, max(1, int(WRITE_S / link.character_s))) if link.character_s else WRITE_MOST
