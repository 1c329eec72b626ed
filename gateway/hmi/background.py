"""Slow calls, one after the other, in a thread that lives only while there are some (spec section 5: one password
hash computed at a time; section 7: what is slow is an alarm and no hang).

What it refuses: running two calls at once, keeping a thread without work, deciding what a result means, ending a call
that takes too long (nothing can: it waits for a card or a resolver).
Threads: ``run``, ``trouble`` and ``Call.cancel`` from any; the calls and *told* run in the thread of its own. One lock,
a leaf.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Final

from gateway.clock import Clock, SystemClock

LIMIT_S: Final = 60.0  # of one call, then it is an alarm (spec section 7)

log = logging.getLogger(__name__)


class Call:
    """One call that was asked for."""

    def __init__(self, work: Callable[[], None]) -> None:
        self.work = work
        self.is_cancelled = False

    def cancel(self) -> None:
        """Nobody waits for it any more: it is left out, unless it runs already."""
        self.is_cancelled = True


class Background:
    """Where the calls wait for their turn."""

    def __init__(self, name: str, clock: Clock | None = None) -> None:
        """*name* of the thread."""
        self._name = name
        self._clock = clock or SystemClock()
        self._lock = threading.Lock()
        self._calls: deque[Call] = deque()
        self._is_working = False
        self._began_s: float | None = None  # when the call that runs was begun, monotonic
        self._is_told = False  # that it takes too long

    @property
    def trouble(self) -> str:
        """What a person should know of a call that does not end; "" while all is well. Whoever looks logs the change.

        The thread itself cannot: it is stuck. So this is for somebody who looks every second or so.
        """
        now_s = self._clock.monotonic()
        with self._lock:
            is_slow = self._began_s is not None and now_s - self._began_s >= LIMIT_S
            is_news, self._is_told = is_slow is not self._is_told, is_slow
        trouble = f"{self._name}: has taken over {LIMIT_S:.0f} s by now (a slow card?)" if is_slow else ""
        if is_news and is_slow:
            log.error("%s", trouble)
        elif is_news:
            log.warning("%s: goes on again", self._name)
        return trouble

    def run(self, work: Callable[[], None]) -> Call:
        """Have *work* called soon; it tells its result by itself. What it raises is a bug, and goes to the log."""
        call = Call(work)
        with self._lock:
            self._calls = deque(waiting for waiting in self._calls if not waiting.is_cancelled)
            self._calls.append(call)
            has_to_start, self._is_working = not self._is_working, True
        if has_to_start:
            self._start()
        return call

    def _start(self) -> None:
        try:
            threading.Thread(target=self._work, name=self._name, daemon=True).start()
        except RuntimeError as error:  # no thread is left: the calls wait, and the next one tries again
            with self._lock:
                self._is_working = False
            log.error("%s: cannot begin: %s", self._name, error)

    def _work(self) -> None:
        while (call := self._next()) is not None:
            if call.is_cancelled:
                continue
            try:
                call.work()
            except BaseException:  # a bug in one call, or a panic of pydantic's core, must not end all later ones
                log.exception("%s: ended with an error", self._name)

    def _next(self) -> Call | None:
        with self._lock:
            self._is_working = bool(self._calls)
            self._began_s = self._clock.monotonic() if self._calls else None
            return self._calls.popleft() if self._calls else None
