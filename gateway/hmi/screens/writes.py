"""Key E: every write to the register as it happens (spec section 5).

The register tells of a write in the writer's thread; here it is only queued, and lines are dropped, with a count,
rather than waited for.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Final

from gateway.clock import Clock
from gateway.hmi.menu import Ui
from gateway.hmi.wording import Translate, reference, table_name, time_text
from gateway.modbus.pdu import bit_at, word_at
from gateway.plain_text import cut
from gateway.register import DataRegister, Written

KEPT: Final = 100  # writes that wait to be shown
LINES_AT_ONCE: Final = 20
VALUES_SHOWN: Final = 16
VALUE_LEAST: Final = 5  # characters: one value is always shown


class WriteDisplay:
    """The writes that one terminal has still to show."""

    def __init__(self, register: DataRegister, clock: Clock) -> None:
        self._register = register
        self._clock = clock
        self._lock = threading.Lock()
        self._waiting: deque[tuple[float, Written]] = deque()
        self._dropped = 0
        self._undo: Callable[[], None] | None = None

    @property
    def is_on(self) -> bool:
        """Whether writes are shown."""
        return self._undo is not None

    def switch(self, _: Translate) -> str:
        """Switch on, or off; return what to tell."""
        if self.is_on:
            self.switch_off()
            return _("Writes are no longer shown.")
        self._undo = self._register.watch(self._take)
        return _("Writes are shown as they happen, here at the main menu. E ends it.")

    def switch_off(self) -> None:
        """Show no more of them."""
        if self._undo is not None:
            self._undo()
            self._undo = None
        self._waiting.clear()
        self._dropped = 0

    def lines(self, ui: Ui) -> list[str]:
        """Return a line for each write since the last time, 20 at most, and how many were left out."""
        _ = ui.translate
        with self._lock:
            taken = [self._waiting.popleft() for _turn in range(min(LINES_AT_ONCE, len(self._waiting)))]
            dropped, self._dropped = self._dropped, 0
        lines = [_line(when_s, written, ui) for when_s, written in taken]
        if dropped:
            lines.append(_("... not shown: {count} more.").format(count=dropped))
        return lines

    def _take(self, written: Written) -> None:
        with self._lock:
            if len(self._waiting) < KEPT:
                self._waiting.append((self._clock.wall(), written))
            else:
                self._dropped += 1


def _line(when_s: float, written: Written, ui: Ui) -> str:
    """Return table, point, values, source; of the values as many as there is room for."""
    span = written.span
    value_at = bit_at if span.table.is_bits else word_at
    values = [str(int(value_at(written.data, place))) for place in range(min(span.count, VALUES_SHOWN))]
    if span.count > VALUES_SHOWN:
        values.append("..")
    where = f"{table_name(span.table, ui.translate)} {span.start} ({reference(span.table, span.start)})"
    head, tail = f"{time_text(when_s)} {where}: ", f"  <- {written.source}"
    room = max(VALUE_LEAST, ui.columns - 1 - len(head) - len(tail))
    return cut(head + cut(" ".join(values), room) + tail, ui.columns - 1)
