"""A logger, the limiter of the log and what gets through, on a clock that jumps: what the tests of limits share."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable

from gateway.logs import BURST, RateLimited, SafeFormatter
from tests.fakes import JumpingClock


class Told(logging.Handler):
    """Every line that gets through; *during* is called while one is written."""

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(SafeFormatter())
        self.lines: list[str] = []
        self.during: Callable[[], object] = bool

    def emit(self, record: logging.LogRecord) -> None:
        self.during()
        self.lines += self.format(record).split("\n")


class Desk:
    """A logger, its limiter and what gets through, on a clock that jumps."""

    def __init__(self, clock: JumpingClock) -> None:
        self.clock = clock
        self.told = Told()
        self.limited = RateLimited(clock, [self.told])
        self.log = logging.Logger("test", logging.DEBUG)
        self.log.addHandler(self.limited)

    @property
    def lines(self) -> list[str]:
        return self.told.lines

    def new_lines(self) -> list[str]:
        lines, self.told.lines = self.told.lines, []
        return lines

    def pass_s(self, seconds: float) -> None:
        """Let time pass, and have the main thread look whenever it is due."""
        until_s = self.clock.monotonic() + seconds
        while True:
            wait_s = self.limited.flush_due()
            assert wait_s > 0
            left_s = until_s - self.clock.monotonic()
            if left_s <= 0:
                return
            self.clock.pass_s(min(wait_s, left_s))

    def settle(self) -> None:
        """A day without a line."""
        self.pass_s(86400.0)

    def spend(self, template: str, *args: object) -> None:
        """Use up the burst of a cause."""
        for _ in range(BURST):
            self.log.warning(template, *args)
        self.new_lines()


LATE = re.compile(r" \((told late, this was at \d\d-\d\d \d\d:\d\d:\d\d)?(; )?((\d+) more like it w\w+ left out)?\)$")


def left_out_of(line: str) -> int:
    found = LATE.search(line)
    return int(found[4] or 0) if found else 0


def bare(line: str) -> str:
    return LATE.sub("", line)
