"""Slow calls, one after the other, in a thread that lives only while there are some (spec section 5: one password
hash computed at a time).

What it refuses: running two calls at once, keeping a thread without work, deciding what a result means.
Threads: ``run`` and ``Call.cancel`` from any; the calls and *told* run in the thread of its own. One lock, a leaf.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

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

    def __init__(self, name: str) -> None:
        """*name* of the thread."""
        self._name = name
        self._lock = threading.Lock()
        self._calls: deque[Call] = deque()
        self._is_working = False

    def run(self, work: Callable[[], None]) -> Call:
        """Have *work* called soon; it tells its result by itself. What it raises is a bug, and goes to the log."""
        call = Call(work)
        with self._lock:
            self._calls = deque(waiting for waiting in self._calls if not waiting.is_cancelled)
            self._calls.append(call)
            has_to_start, self._is_working = not self._is_working, True
        if has_to_start:
            threading.Thread(target=self._work, name=self._name).start()
        return call

    def _work(self) -> None:
        while (call := self._next()) is not None:
            if call.is_cancelled:
                continue
            try:
                call.work()
            except Exception:  # a bug in one call must not keep all later ones from their turn
                log.exception("%s: ended with an error", self._name)

    def _next(self) -> Call | None:
        with self._lock:
            self._is_working = bool(self._calls)
            return self._calls.popleft() if self._calls else None
