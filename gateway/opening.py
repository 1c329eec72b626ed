"""Opening a line again and again: later and later, each time within a limit, talked about once per change.

How a line is opened is handed in, and so is where: at once, or in a thread of its own, so that a driver or a name
server that takes its time is an alarm after ``LIMIT_S`` and no hang (spec sections 2, 5 and 7). What such a thread
opens after nobody wants it any more, it closes.

Threads: an ``Opening`` belongs to its task's thread; ``trouble`` may be read from any. Its own thread lives as long as
one call, and nobody waits for it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final, Generic, Protocol, TypeVar

from gateway.clock import Clock
from gateway.errors import LinkError
from gateway.link import Waker

FIRST_S: Final = 0.5
MOST_S: Final = 30.0
LIMIT_S: Final = 60.0  # of one opening (spec section 7)

log = logging.getLogger(__name__)

Start = Callable[[Callable[[], None]], object]  # has a call made, somewhere


class Closable(Protocol):
    """What is opened."""

    def close(self) -> None:
        """Let go of it."""
        ...


T = TypeVar("T", bound=Closable)


def at_once(work: Callable[[], None]) -> None:
    """Have *work* done here and now."""
    work()


def in_thread(work: Callable[[], None]) -> None:
    """Have *work* done in a thread of its own, which does not keep the program from ending."""
    threading.Thread(target=work, name="opening", daemon=True).start()


class Opening(Generic[T]):
    """When a line may be opened again, how that goes, and why it had to be."""

    def __init__(self, name: str, clock: Clock, open_it: Callable[[], T], waker: Waker, start: Start = at_once) -> None:
        """*name* of the line, for the log; *waker* of the thread that waits for it."""
        self.trouble = ""  # why the line cannot be used, for people; "" while it can
        self._name = name
        self._clock = clock
        self._open_it = open_it
        self._waker = waker
        self._start = start
        self._after_s = FIRST_S
        self._due_s = clock.monotonic()
        self._call: _Call[T] | None = None

    def wait_s(self) -> float:
        """Return how long there is nothing to attempt; 0 when there is. The waker is woken when an opening is over."""
        if self._call is not None and self._call.is_over.is_set():
            return 0.0
        return max(0.0, self._due_s - self._clock.monotonic())

    def attempt(self, ready: threading.Event, failed: Callable[[str], object] | None = None) -> T | None:
        """Return the line, or None: it is being opened, or cannot be, of which *failed* (else ours) has been told.

        ready: set once it is open, or it has been said why not.
        """
        call = self._call
        if call is None:
            call = self._call = _Call(self._open_it, self._waker)
            self._due_s = self._clock.monotonic() + LIMIT_S
            self._start(call.run)
        failed = failed or self.failed
        if not call.is_over.is_set():
            if not self.wait_s():
                failed(f"opening it takes more than {LIMIT_S:.0f} s")
                ready.set()
            return None
        self._call, self._due_s = None, self._clock.monotonic()
        try:
            return call.take()
        except LinkError as error:
            if not self._waker.ended:  # else it was interrupted
                failed(str(error))
            return None
        finally:
            ready.set()

    def failed(self, reason: str) -> bool:
        """Say so once, and wait longer each time. Returns True the first time since the line worked."""
        is_news = not self.trouble
        level = logging.ERROR if is_news else logging.DEBUG
        log.log(level, "%s: %s; trying again", self._name, reason, extra={"about": self._name})
        self.trouble = reason
        self._due_s = self._clock.monotonic() + self._after_s
        self._after_s = min(MOST_S, 2 * self._after_s)
        return is_news

    def worked(self) -> None:
        """The line is open and works."""
        if self.trouble:
            log.warning("%s: the line works again", self._name, extra={"about": self._name})
        self.trouble, self._after_s = "", FIRST_S

    def close(self) -> None:
        """Want nothing any more: what is being opened is closed as soon as it is open."""
        call, self._call = self._call, None
        if call is not None:
            call.give_up()


class _Call(Generic[T]):
    """One call of what opens a line, in whatever thread, and what came of it."""

    def __init__(self, open_it: Callable[[], T], waker: Waker) -> None:
        self.is_over = threading.Event()
        self._open_it = open_it
        self._waker = waker
        self._asked_by = threading.get_ident()
        self._lock = threading.Lock()
        self._is_unwanted = False
        self._opened: T | None = None
        self._error: Exception | None = None

    def run(self) -> None:
        try:
            opened, error = self._open_it(), None
        except Exception as raised:  # noqa: BLE001 - whatever it is, it is raised again in the thread that asked
            opened, error = None, raised
        with self._lock:
            self._opened, self._error = opened, error
            self.is_over.set()
        if self._is_unwanted:
            self._close()
        if threading.get_ident() != self._asked_by:
            self._waker.wake()

    def take(self) -> T:
        """Return what was opened, or raise what was raised; once, and only when it is over."""
        if self._error is not None:
            raise self._error
        assert self._opened is not None  # noqa: S101 - it is over, and nothing was raised
        return self._opened

    def give_up(self) -> None:
        with self._lock:
            self._is_unwanted = True
        if self.is_over.is_set():
            self._close()

    def _close(self) -> None:
        with self._lock:
            opened, self._opened = self._opened, None
        if opened is not None:
            opened.close()
