"""The event queue: each change of a marked point, with its time, until SCADA has taken it (spec sections 2 and 3).

Modbus has no events; this gives SCADA two ways to them, described in README. The queue watches the register: the first
value of a point is no change, a value written again is none either. When the queue is full the newest change is lost,
and counted: what SCADA has been shown already stays where it is.

An entry is 7 registers: sequence number (1 to 65535, then 1 again), table (1 to 4, by the code of its read function),
point, value, and the time in milliseconds since 1970 in three registers, highest first.

Threads: changes come in the threads that write the register; SCADA's side runs in the slaves'; ``change`` in the main
thread, while the others go on. One lock, a leaf.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final

from gateway.clock import Clock
from gateway.config import EVENT_BLOCK_ENTRIES, EVENT_ENTRY
from gateway.errors import PointsOutOfRange
from gateway.modbus.pdu import Span, Table, bit_at, pack_words, word_at
from gateway.register import DataRegister, Source, SourceKind, Written

FIFO_ENTRIES: Final = 4  # 2 + 4 x 7 = 30 registers; function 24 carries 31
SEQUENCE_MAX: Final = 0xFFFF
COUNT_MAX: Final = 0xFFFF


@dataclass(frozen=True, slots=True)
class Change:
    """One change of one point; *when_ms* since 1970."""

    sequence: int
    table: Table
    point: int
    value: int
    when_ms: int

    @property
    def registers(self) -> list[int]:
        """The entry as SCADA reads it."""
        time = [self.when_ms >> 32 & 0xFFFF, self.when_ms >> 16 & 0xFFFF, self.when_ms & 0xFFFF]
        return [self.sequence, int(self.table), self.point, self.value, *time]


class EventQueue:
    """The changes of the points of *spans*; see the module."""

    def __init__(
        self,
        register: DataRegister,
        clock: Clock,
        spans: Sequence[Span],
        size: int,
        fifo_address: int | None = None,
        block: Span | None = None,
    ) -> None:
        """*size*: changes kept; *fifo_address*: what function 24 asks for; *block*: 3 + 7 n registers."""
        self._register = register
        self._clock = clock
        self._set(spans, size, fifo_address, block)
        self._source = Source(SourceKind.REQUEST, "events")
        self._lock = threading.Lock()
        self._known: dict[tuple[Table, int], int] = {}
        self._changes: deque[Change] = deque()
        self._sequence = 0
        self._lost = 0
        self._acknowledged = 0
        register.watch(self._written)
        self._show()

    def change(self, spans: Sequence[Span], size: int, fifo_address: int | None, block: Span | None) -> None:
        """Go on by other settings; what waits stays, and a point watched anew has no known value."""
        with self._lock:
            self._set(spans, size, fifo_address, block)
            watched = {(span.table, point) for span in spans for point in range(span.start, span.stop)}
            self._known = {place: self._known[place] for place in self._known.keys() & watched}
        self._show()

    def _set(self, spans: Sequence[Span], size: int, fifo_address: int | None, block: Span | None) -> None:
        self._spans = list(spans)
        self._size = size
        self._fifo_address = fifo_address
        self._block = block

    @property
    def waiting(self) -> int:
        """Changes that SCADA has not taken yet."""
        return len(self._changes)

    @property
    def lost(self) -> int:
        """Changes that found no room."""
        return self._lost

    # -------------------------------------------------------------------------------------------- SCADA's side

    def read_fifo(self, address: int) -> list[int] | None:
        """Take the oldest changes out, at most 4: waiting (these included), lost, entries. None: not our address."""
        if address != self._fifo_address:
            return None
        with self._lock:
            head = [min(len(self._changes), COUNT_MAX), min(self._lost, COUNT_MAX)]
            taken = [self._changes.popleft() for _ in range(min(FIFO_ENTRIES, len(self._changes)))]
        if taken:
            self._show()
        return head + [number for change in taken for number in change.registers]

    def acknowledge(self, sequence: int) -> None:
        """SCADA has taken everything up to *sequence*; one that the block does not show is no news."""
        with self._lock:
            self._acknowledged = sequence
            if sequence in [change.sequence for change in islice(self._changes, EVENT_BLOCK_ENTRIES)]:
                while self._changes.popleft().sequence != sequence:
                    pass
        self._show()

    # -------------------------------------------------------------------------------------------- the register's side

    def _written(self, written: Written) -> None:
        block = self._block  # looked at once: another thread may change it
        with contextlib.suppress(PointsOutOfRange):  # the block's end was cut off just now: ``change`` shows it anew
            if block is not None and written.source != self._source and written.span.overlaps(block):
                self._block_written(block, written)
            if self._spans and self._compare(written):
                self._show()

    def _block_written(self, block: Span, written: Written) -> None:
        """Someone wrote into the block: its first register acknowledges, the others are ours and are set right."""
        if written.span.start <= block.start:
            self.acknowledge(word_at(written.data, block.start - written.span.start))
        else:
            self._show()

    def _compare(self, written: Written) -> bool:
        """Queue what has changed; return whether anything has."""
        when_ms = int(self._clock.wall() * 1000)
        with self._lock:
            before = len(self._changes), self._lost
            for span in self._spans:
                if span.overlaps(written.span):
                    self._compare_points(written, span, when_ms)
            return (len(self._changes), self._lost) != before

    def _compare_points(self, written: Written, span: Span, when_ms: int) -> None:
        table, value_at = span.table, bit_at if span.table.is_bits else word_at
        for point in range(max(span.start, written.span.start), min(span.stop, written.span.stop)):
            value = int(value_at(written.data, point - written.span.start))
            old = self._known.get((table, point))
            self._known[table, point] = value
            if old is not None and old != value:
                self._add(table, point, value, when_ms)

    def _add(self, table: Table, point: int, value: int, when_ms: int) -> None:
        self._sequence = self._sequence % SEQUENCE_MAX + 1
        if len(self._changes) < self._size:
            self._changes.append(Change(self._sequence, table, point, value, when_ms))
        else:
            self._lost += 1

    def _show(self) -> None:
        """Write the block anew; again if it has changed meanwhile, so that the newest is written last."""
        shown = None
        while (block := self._block) is not None and shown != (now := (block, self._block_registers(block.count))):
            self._register.write(block, pack_words(now[1]), self._source)
            shown = now

    def _block_registers(self, count: int) -> list[int]:
        """Return what SCADA acknowledged last, how many changes wait and were lost, and the oldest of them."""
        with self._lock:
            shown = [self._acknowledged, min(len(self._changes), COUNT_MAX), min(self._lost, COUNT_MAX)]
            for change in islice(self._changes, (count - len(shown)) // EVENT_ENTRY):
                shown += change.registers
        return shown + [0] * (count - len(shown))
