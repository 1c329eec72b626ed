"""Opening a port again and again: later and later, and talked about once per change (spec section 2 and 5).

How a port is opened is handed in. One thread uses it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from threading import Event
from typing import Final, TypeVar

from gateway.clock import Clock
from gateway.errors import LinkError

FIRST_S: Final = 0.5
MOST_S: Final = 30.0

T = TypeVar("T")

log = logging.getLogger(__name__)


class Backoff:
    """When a line may be opened again, and why it had to be."""

    def __init__(self, name: str, clock: Clock) -> None:
        """*name* of the line, for the log."""
        self._name = name
        self._clock = clock
        self._after_s = FIRST_S
        self._due_s = clock.monotonic()
        self.trouble = ""  # why the line cannot be used, for people; "" while it can

    def wait_s(self) -> float:
        """Return how long not to open yet; 0 when it is time."""
        return max(0.0, self._due_s - self._clock.monotonic())

    def attempt(self, open_it: Callable[[], T], ready: Event) -> T | None:
        """Return what *open_it* opens, or None if it cannot: then why has been said. *ready* is set in any case."""
        try:
            return open_it()
        except LinkError as error:
            self.failed(str(error))
            return None
        finally:
            ready.set()

    def failed(self, reason: str) -> bool:
        """Say so once, and wait longer each time. Returns True the first time since the line worked."""
        is_news = not self.trouble
        level = logging.ERROR if is_news else logging.DEBUG
        log.log(level, "%s: %s; trying again", self._name, reason)
        self.trouble = reason
        self._due_s = self._clock.monotonic() + self._after_s
        self._after_s = min(MOST_S, 2 * self._after_s)
        return is_news

    def worked(self) -> None:
        """The line is open and works."""
        if self.trouble:
            log.warning("%s: the line works again", self._name)
        self.trouble, self._after_s = "", FIRST_S
