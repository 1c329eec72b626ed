"""Time, handed in: the only module that calls ``time``.

Intervals are always monotonic, so that a clock set by NTP or a wrong RTC trips nothing (spec section 7); wall time
is only for people. Tests hand in a clock of their own that jumps.
"""

from __future__ import annotations

import contextlib
import ctypes
import time
from typing import Final, Protocol

_PR_SET_TIMERSLACK: Final = 29  # linux/prctl.h


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


def sharpen_timers() -> None:
    """Ask Linux to wake the calling thread on time: it may be 50 us late otherwise, which frame gaps feel.

    source: prctl(2), PR_SET_TIMERSLACK; quietly without effect where there is none.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
