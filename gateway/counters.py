"""What a line, a request, a slave and a client count (spec sections 2 and 3).

Plain numbers, written by one thread and read by any: a person sees them, nothing is decided by them.
"""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

REPLY_TIMES_KEPT: Final = 200  # for the 95th percentile


@dataclass
class ReplyTimes:
    """Reply times in seconds. What it keeps of them takes its room from the start: a week's run grows by nothing."""

    last_s: float = 0.0
    min_s: float = 0.0
    max_s: float = 0.0
    count: int = 0
    total_s: float = 0.0
    recent_s: array[float] = field(default_factory=lambda: array("f", bytes(4 * REPLY_TIMES_KEPT)), repr=False)

    def add(self, reply_s: float) -> None:
        """Take one more."""
        self.last_s = reply_s
        self.min_s = reply_s if not self.count else min(self.min_s, reply_s)
        self.max_s = max(self.max_s, reply_s)
        self.recent_s[self.count % REPLY_TIMES_KEPT] = reply_s
        self.count += 1
        self.total_s += reply_s

    @property
    def average_s(self) -> float:
        """Mean of all, 0 before the first."""
        return self.total_s / self.count if self.count else 0.0

    @property
    def p95_s(self) -> float:
        """95th percentile of the last 200, 0 before the first."""
        ordered = sorted(self.recent_s[: min(self.count, REPLY_TIMES_KEPT)])
        return ordered[min(len(ordered) - 1, len(ordered) * 95 // 100)] if ordered else 0.0


@dataclass
class PollCounters:
    """What a master counts, for its line and for each request."""

    sent: int = 0
    good: int = 0
    timeouts: int = 0
    damaged: int = 0  # CRC errors, and replies to another question
    exceptions: Counter[int] = field(default_factory=Counter)
    overruns: int = 0  # cycles missed
    expired: int = 0  # commands dropped because the device did not answer in time
    times: ReplyTimes = field(default_factory=ReplyTimes)

    @property
    def failures(self) -> int:
        """Requests that brought nothing."""
        return self.timeouts + self.damaged + sum(self.exceptions.values())


@dataclass
class ServeCounters:
    """What a slave counts, for itself and for each client."""

    requests: int = 0
    good: int = 0
    exceptions: Counter[int] = field(default_factory=Counter)
    broadcasts: int = 0
    damaged: int = 0
    foreign: int = 0  # frames of and for other units
    unanswered: int = 0  # requests for us that others' bytes followed: too late to answer
