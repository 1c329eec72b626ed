"""What the program logs, made safe and kept: one formatter for every way out, and the newest lines for the menu.

Whatever a person or a device can put into a name or a line is logged with its control characters escaped (spec section
5); a traceback keeps its line ends.

Threads: any thread logs; ``lines`` may be read by any.
"""

from __future__ import annotations

import logging
from collections import deque
from datetime import datetime
from typing import Any, Final

from gateway.plain_text import printable

KEPT: Final = 300  # lines that the menu can show
LONGEST: Final = 2000  # characters of one message, and of one line that is kept


class SafeFormatter(logging.Formatter):
    """LEVEL and message; nothing in them moves a cursor or makes a second line."""

    def __init__(self) -> None:
        super().__init__("%(levelname)s %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the name is logging's
        """Return the first line, without a traceback."""
        return printable(super().formatMessage(record)[:LONGEST])

    def formatException(self, ei: Any) -> str:  # noqa: N802 - the name is logging's, as is what stands in *ei*
        """Return a traceback; what its error tells of a name or a line is made safe as well."""
        return printable(super().formatException(ei), kept="\n")


class LogRing(logging.Handler):
    """The newest lines, each with its time."""

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(SafeFormatter())
        self._lines: deque[str] = deque(maxlen=KEPT)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep *record*, every line of it on its own; one that cannot be worded is logging's to complain of."""
        try:
            lines = self.format(record).split("\n")
        except Exception:  # noqa: BLE001 - as in logging's own handlers: whoever logs must not suffer
            self.handleError(record)
            return
        when = datetime.fromtimestamp(record.created).strftime("%m-%d %H:%M:%S")
        self._lines.extend(f"{when} {line[:LONGEST]}" for line in lines)

    def lines(self) -> list[str]:
        """Return the lines, oldest first."""
        self.acquire()
        try:
            return list(self._lines)
        finally:
            self.release()
