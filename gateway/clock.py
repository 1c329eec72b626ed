"""Time, handed in: the only module that calls ``time``.

Intervals are always monotonic, so that a clock set by NTP or a wrong RTC trips nothing (spec section 7); wall time is
only for people. Tests hand in a clock of their own that jumps.
"""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """What the rest of the program knows of time."""

    def monotonic(self) -> float:
        """Seconds since some fixed moment; never jumps, never goes back."""
        ...

    def wall(self) -> float:
        """Seconds since 1970 as this machine believes them to be; may jump."""
        ...


class SystemClock:
    """The machine's own clocks."""

    def monotonic(self) -> float:
        """CLOCK_MONOTONIC in seconds."""
        return time.monotonic()

    def wall(self) -> float:
        """CLOCK_REALTIME in seconds."""
        return time.time()
