"""Whose turn it is: which of a line's requests is polled next (spec section 2).

Requests go in turn, from the one after the last sent, each when its own cycle time is due; one never sent is due at
once. The cost of a choice does not grow with the number of requests: those not yet due wait in a heap, those that are
due are bits of one integer.

Pure: the time is handed in, in monotonic seconds. One thread uses it.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence


class Schedule:
    """The cycle of each request of one line, known by its index."""

    def __init__(self, every_s: Sequence[float]) -> None:
        """*every_s*: the cycle time of each request; all are due at once."""
        self._every_s = list(every_s)
        self._due_s: list[float | None] = [None] * len(every_s)  # None: never sent, or asked for at once
        self._ready = (1 << len(every_s)) - 1
        self._waiting: list[tuple[float, int]] = []
        self._last = -1

    def pick(self, now_s: float, among: int = -1) -> int | None:
        """Return the index of the request whose turn it is, or None if none is due.

        among: bits of the requests that may be sent at all; -1: any.
        """
        self._wake_due(now_s)
        ready = self._ready & among
        if not ready:
            return None
        return self.next_in_turn(ready)

    def due(self, now_s: float) -> int:
        """Return the requests that are due, as bits."""
        self._wake_due(now_s)
        return self._ready

    def next_in_turn(self, among: int) -> int:
        """Return the request after the last sent, due or not; *among* has at least one bit."""
        after = among >> (self._last + 1) << (self._last + 1) or among
        return (after & -after).bit_length() - 1

    def sent(self, index: int, now_s: float) -> int:
        """Say that request *index* is sent; return how many of its cycles were missed since the last time."""
        self._last = index
        self._ready &= ~(1 << index)
        due_s, every_s = self._due_s[index], self._every_s[index]
        missed = 0 if due_s is None else int((now_s - due_s) / every_s)
        next_s = now_s + every_s if due_s is None else due_s + (missed + 1) * every_s
        self._due_s[index] = next_s
        heapq.heappush(self._waiting, (next_s, index))
        return missed

    def at_once(self, indexes: int) -> None:
        """Make the requests in the bits of *indexes* due now, and begin their cycles anew."""
        self._ready |= indexes
        while indexes:
            lowest = indexes & -indexes
            self._due_s[lowest.bit_length() - 1] = None
            indexes ^= lowest

    def next_due_s(self) -> float | None:
        """Return when the next request not yet due will be, or None."""
        return self._waiting[0][0] if self._waiting else None

    def _wake_due(self, now_s: float) -> None:
        waiting = self._waiting
        while waiting and waiting[0][0] <= now_s:
            due_s, index = heapq.heappop(waiting)
            if self._due_s[index] == due_s:  # else asked for at once in the meantime
                self._ready |= 1 << index
