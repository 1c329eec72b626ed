"""Safe mode: after three bad restarts in a row the menu runs and all lines are in maintenance (spec section 7).

It ends by a person (the menu, a reload), who begins a new row, or after an hour with one more try, which is the third
bad restart if it goes wrong. A run that lasts ten minutes outside safe mode ends the row. What is counted is running
time, never a date: boards have no clock.

What it refuses: counting restarts (``restart_cause``), switching lines (``running``).
Threads: ``is_on``, ``left_s`` from any; the rest belongs to the main one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from gateway.clock import Clock
from gateway.restart_cause import SAFE_AFTER

LONGEST_S: Final = 3600.0
LASTED_S: Final = 600.0  # a restart after less running than this is a bad one
NEVER_S: Final = 3600.0  # until somebody looks again though nothing is due


class SafeMode:
    """Whether it is on, and what is due about it."""

    def __init__(
        self,
        clock: Clock,
        bad_in_row: int = 0,
        lasted: Callable[[], None] = lambda: None,
        forgiven: Callable[[int], None] = lambda row: None,  # noqa: ARG005 - nobody counts
    ) -> None:
        """*bad_in_row* restarts; *lasted* and *forgiven* are ``LastRun``'s."""
        self.bad_in_row = bad_in_row
        self._clock = clock
        self._lasted = lasted
        self._forgiven = forgiven
        self._is_on = bad_in_row >= SAFE_AFTER
        self._due_s: float | None = clock.monotonic() + (LONGEST_S if self._is_on else LASTED_S)

    @property
    def is_on(self) -> bool:
        """Whether all lines are to be in maintenance."""
        return self._is_on

    @property
    def left_s(self) -> float | None:
        """How long until it ends by itself; None when it is not on."""
        due_s = self._due_s
        return due_s - self._clock.monotonic() if self._is_on and due_s is not None else None

    def end(self, row: int) -> bool:
        """It is over, and *row* bad restarts count all the same; False if it was over already."""
        if not self._is_on:
            return False
        self._is_on, self._due_s = False, self._clock.monotonic() + LASTED_S
        self._forgiven(row)
        return True

    def look(self, hour_is_over: Callable[[], None]) -> float:
        """Do what is due; return after how long to look again. *hour_is_over* has to end it."""
        if self._due_s is None:
            return NEVER_S
        left_s = self._due_s - self._clock.monotonic()
        if left_s > 0:
            return left_s
        self._due_s = None
        if self._is_on:
            hour_is_over()
        else:
            self._lasted()
        return NEVER_S
