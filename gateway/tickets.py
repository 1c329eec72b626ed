"""Commands of the menu on their way to a device: a ticket for each, a bounded queue of them (spec section 2).

A ticket is always done in the end, exactly once: answered, given up after 10 s, or because the master stops. So whoever
holds one never waits for nothing. What is sent, and when, is the master's affair; these are not the writes of the upper
side, which ``commands`` carries.

Threads: ``submit`` from any; all else from the master's. The lock is a leaf: nobody is told while it is held.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gateway.clock import Clock
from gateway.errors import QueueFull
from gateway.modbus.pdu import AnyRequest
from gateway.transaction import Response, check_asked

SUBMIT_LIMIT: Final = 16  # tickets that wait
SUBMIT_EXPIRE_S: Final = 10.0


def _nobody() -> None:
    """Is told when nobody wants to be."""


@dataclass(eq=False)
class Ticket:
    """A command from the menu, and later its response: None if it was never sent or the master was stopped.

    A line lost on the way is a timeout whose reason says so. *told* is called right after *done* is set.
    """

    unit: int
    request: AnyRequest
    made_s: float
    told: Callable[[], None] = _nobody
    response: Response | None = None
    done: threading.Event = field(default_factory=threading.Event)

    def finish(self, response: Response | None) -> None:
        """Say what has become of it; called once, by whoever has taken it from the queue."""
        self.response = response
        self.done.set()
        self.told()


class TicketQueue:
    """The tickets that wait for one line, the oldest first."""

    def __init__(self, clock: Clock, wake: Callable[[], None], has_broadcast: bool) -> None:
        """*wake*: called after each new ticket; *has_broadcast*: unit 0 is all of the line, and none answers."""
        self._clock = clock
        self._wake = wake
        self._has_broadcast = has_broadcast
        self._lock = threading.Lock()
        self._waiting: deque[Ticket] = deque()
        self._is_closed = False

    def __len__(self) -> int:
        """How many wait."""
        return len(self._waiting)

    def submit(self, unit: int, request: AnyRequest, told: Callable[[], None] | None = None) -> Ticket:
        """Queue a command. Raises QueueFull, RequestInvalid.

        told: called when the ticket is done; from the master's thread, or at once where the master has stopped.
        """
        check_asked(unit, request, self._has_broadcast)
        ticket = Ticket(unit, request, self._clock.monotonic(), told or _nobody)
        with self._lock:
            is_closed = self._is_closed
            if len(self._waiting) >= SUBMIT_LIMIT:
                raise QueueFull(f"{SUBMIT_LIMIT} commands wait for this line already")
            if not is_closed:
                self._waiting.append(ticket)
        if is_closed:
            ticket.finish(None)
        else:
            self._wake()
        return ticket

    def take(self) -> Ticket | None:
        """Take the oldest out: it is now the caller's to finish. None if there is none."""
        if not self._waiting:  # one that comes in this moment wakes the master anyway
            return None
        with self._lock:
            return self._waiting.popleft() if self._waiting else None

    def next_expiry_s(self) -> float | None:
        """Return when the oldest is given up (monotonic seconds), or None."""
        if not self._waiting:
            return None
        with self._lock:
            return self._waiting[0].made_s + SUBMIT_EXPIRE_S if self._waiting else None

    def expire(self) -> list[Ticket]:
        """Give up what has waited too long; return it."""
        if not self._waiting:
            return []
        oldest_s, gone = self._clock.monotonic() - SUBMIT_EXPIRE_S, []
        with self._lock:
            while self._waiting and self._waiting[0].made_s <= oldest_s:
                gone.append(self._waiting.popleft())
        for ticket in gone:
            ticket.finish(None)
        return gone

    def close(self) -> None:
        """Give up all, and from now on each new one at once."""
        with self._lock:
            self._is_closed = True
            left, self._waiting = list(self._waiting), deque()
        for ticket in left:
            ticket.finish(None)
