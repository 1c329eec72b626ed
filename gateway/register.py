"""The data register: four tables of points that every master fills and every slave serves (spec section 1).

One lock, and it is a leaf: it is never held while anything outside is called. A block is read or written whole, so a
32-bit value over two registers never tears. Registers are kept as big-endian bytes: answering a read is a slice. Each
point also knows its quality, the time of its last update, and its source.

What the upper side or the menu writes to a point that a device is to get is a *command*. Commands are taken and
numbered under the same lock as the write itself (``commands.py`` has their queues), and hold their points: until the
device has answered, no poll overwrites them.

Threads: any thread may call anything here. Watchers run in the writer's thread, outside the lock, in order of writing.
"""

from __future__ import annotations

import threading
from array import array
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from math import inf
from typing import Final

from gateway.clock import Clock
from gateway.errors import PointsOutOfRange, PointUnknown, RequestInvalid
from gateway.modbus.pdu import Span, Table

SIZE_DEFAULT: Final = 2000
SIZE_MAX: Final = 65536
NEVER_S: Final = -inf  # time of last update of a point that was never written; of a retained one it may be below 0
LONG_AGO_S: Final = -1e15  # the same of a retained one whose age nobody knows
COMMANDED: Final = 1  # the upper side, a person or a retained value wrote it
STAND_IN: Final = 2  # zero for a failed poll, not what the device has


class Quality(IntEnum):
    """How far a value can be trusted."""

    NEVER = 0  # nothing was written yet
    GOOD = 1
    BAD = 2  # its request fails
    STALE = 3  # older than its stale_after, which is found out when read; or retained, and not written since
    MANUAL = 4  # set by a person


class SourceKind(Enum):
    """Who can write a point."""

    REQUEST = "request"  # a master's request
    CLIENT = "client"  # a slave's client: the upper side
    MENU = "menu"  # a person
    RETAINED = "retained"  # a value kept over a restart


@dataclass(frozen=True, slots=True)
class Source:
    """Who wrote a point: its kind, and its name for people ("field/boiler", "scada 10.0.0.5:40232")."""

    kind: SourceKind
    name: str

    @property
    def commands(self) -> bool:
        """True for the upper side and the menu: what they write is to reach the device."""
        return self.kind in (SourceKind.CLIENT, SourceKind.MENU)

    def __str__(self) -> str:
        return self.name


RESTORED: Final = Source(SourceKind.RETAINED, "before the restart")


@dataclass(frozen=True, slots=True)
class Sample:
    """One point for a person: value 0 or 1, or 0 to 65535; age in seconds, None where nobody knows it."""

    value: int
    quality: Quality
    age_s: float | None
    source: Source | None


@dataclass(frozen=True, slots=True)
class Written:
    """One block write as watchers are told of it; *data* as on the wire."""

    span: Span
    data: bytes
    source: Source
    quality: Quality


@dataclass(frozen=True, slots=True)
class Claim:
    """A request fills *span*; its values count as stale when older than *stale_after_s*."""

    span: Span
    source: Source
    stale_after_s: float


@dataclass(frozen=True, slots=True)
class Kept:
    """What is to be known after a restart of points that are alike, last written *age_s* ago (None: who knows).

    values:       a big-endian word, or the character 0 or 1, for each point.
    is_commanded: the upper side or a person wrote them at some time: they are not only what a device said.
    """

    span: Span
    values: bytes
    age_s: float | None
    is_commanded: bool


class CommandSink:
    """What the register knows of a command queue; ``commands.CommandQueue`` is the one there is.

    All but ``wake`` are called with the register's lock held and must only change the sink's own data.
    """

    def wants(self, span: Span) -> bool:
        """Return whether a write to *span* concerns this queue."""
        raise NotImplementedError

    def demand_room(self, span: Span) -> None:
        """Raise QueueFull if the commands that a write to *span* makes do not fit."""
        raise NotImplementedError

    def accept(self, span: Span, number: int) -> None:
        """Queue the commands that write *number* to *span* makes; the values are already stored."""
        raise NotImplementedError

    def wake(self) -> None:
        """Tell whoever sends the commands; called without the lock."""
        raise NotImplementedError


class _Points:
    """One table. ``values`` has *width* bytes a point: a big-endian word, or the character 0 or 1 for a bit."""

    def __init__(self, table: Table, size: int) -> None:
        self.table = table
        self.size = size
        self.width = 1 if table.is_bits else 2
        self.values = bytearray(b"0" * size if table.is_bits else 2 * size)
        self.quality = bytearray(size)
        self.time_s = array("d", [NEVER_S]) * size
        self.source: list[Source | None] = [None] * size
        self.commanded = bytearray(size)  # COMMANDED, STAND_IN, or 0
        self.held: dict[int, int] = {}  # point: how many commands are on their way to a device
        self.claims: list[Claim] = []

    def resize(self, size: int) -> None:
        """Cut off points, or add some that were never written."""
        fresh = _Points(self.table, max(0, size - self.size))
        for name in ("values", "quality", "time_s", "source", "commanded"):
            kept = getattr(self, name)
            del kept[size * (self.width if name == "values" else 1) :]
            kept.extend(getattr(fresh, name))
        self.size = size

    def unpack(self, span: Span, data: bytes) -> bytes:
        """Return wire *data* as ``values`` keeps it."""
        if self.width == 2:
            return data
        number = int.from_bytes(data, "little") & (1 << span.count) - 1
        return format(number, f"0{span.count}b")[::-1].encode("ascii")

    def wire(self, start: int, stop: int) -> bytes:
        """Return the points *start* up to *stop* as on the wire."""
        values = bytes(self.values[start * self.width : stop * self.width])
        if self.width == 2:
            return values
        return int(values[::-1], 2).to_bytes((stop - start + 7) // 8, "little")

    def free_runs(self, span: Span) -> list[tuple[int, int]]:
        """Return the runs (start, stop) of *span* that no command holds."""
        if not self.held:
            return [(span.start, span.stop)]
        return runs([point for point in range(span.start, span.stop) if point not in self.held])


def runs(points: Sequence[int]) -> list[tuple[int, int]]:
    """Return ascending *points* as contiguous runs (start, stop)."""
    found: list[tuple[int, int]] = []
    for point in points:
        if found and found[-1][1] == point:
            found[-1] = (found[-1][0], point + 1)
        else:
            found.append((point, point + 1))
    return found


class DataRegister:
    """Four tables, one lock; see the module."""

    def __init__(self, clock: Clock, sizes: Mapping[Table, int] | None = None) -> None:
        """*sizes*: points of each table, 1 to 65536; 2000 where nothing is said. All values are 0 at start."""
        self._clock = clock
        self._lock = threading.Lock()
        chosen = {table: (sizes or {}).get(table, SIZE_DEFAULT) for table in Table}
        for table, size in chosen.items():
            if not 1 <= size <= SIZE_MAX:
                raise RequestInvalid(f"{size} points in table {table} are not within 1 to {SIZE_MAX}")
        self._tables = {table: _Points(table, size) for table, size in chosen.items()}
        self._sinks: list[CommandSink] = []
        self._number = 0
        self._watchers: list[Callable[[Written], None]] = []
        self._untold: deque[Written] = deque()
        self._telling = False

    def size(self, table: Table) -> int:
        """Return how many points *table* has."""
        return self._tables[table].size

    def resize(self, sizes: Mapping[Table, int]) -> None:
        """Give each table its new size; the points that remain keep all that is known of them, new ones are 0.

        Nobody may claim or hold a point beyond the new end. Raises RequestInvalid, and nothing has changed.
        """
        for table, size in sizes.items():
            if not 1 <= size <= SIZE_MAX:
                raise RequestInvalid(f"{size} points in table {table} are not within 1 to {SIZE_MAX}")
        with self._lock:
            for table, size in sizes.items():
                self._tables[table].resize(size)

    # -------------------------------------------------------------------------------------------- reading

    def read(self, span: Span) -> bytes:
        """Return the block as on the wire: big-endian words or packed bits. Raises PointsOutOfRange."""
        with self._lock:
            return self._demand(span).wire(span.start, span.stop)

    def read_fresh(self, span: Span) -> bytes | None:
        """Return the block like ``read``, or None if a point that a request fills is bad, stale or never read."""
        now_s = self._clock.monotonic()
        with self._lock:
            points = self._demand(span)
            for claim in points.claims:
                if claim.span.overlaps(span) and not _is_fresh(points, claim, span, now_s):
                    return None
            return points.wire(span.start, span.stop)

    def samples(self, span: Span) -> list[Sample]:
        """Return one Sample a point: for people, not for the hot path. Raises PointsOutOfRange."""
        now_s = self._clock.monotonic()
        with self._lock:
            points = self._demand(span)
            limits = _stale_limits(points, span)
            return [_sample(points, point, now_s, limits.get(point)) for point in range(span.start, span.stop)]

    def known(self, span: Span, commanded: bool = False) -> bytes | None:
        """Return the block, or None unless every point was written by someone.

        commanded: at least one of them by the upper side, a person or a retained value, and no zero for a failed poll.
        """
        with self._lock:
            return self.known_locked(self._demand(span), span, commanded)

    @staticmethod
    def known_locked(points: _Points, span: Span, commanded: bool) -> bytes | None:
        """``known`` for whoever holds the lock already."""
        marks = points.commanded[span.start : span.stop]
        if commanded and (COMMANDED not in marks or STAND_IN in marks):
            return None
        return points.wire(span.start, span.stop) if min(points.time_s[span.start : span.stop]) > NEVER_S else None

    # -------------------------------------------------------------------------------------------- writing

    def write(self, span: Span, data: bytes, source: Source, quality: Quality = Quality.GOOD) -> None:
        """Write the block whole, stamp its time, then tell the watchers.

        data:   as on the wire, exactly ``span.size`` bytes.
        A master's request leaves out the points that a command holds. A write by the upper side or the menu queues the
        commands it makes, or is refused whole.
        raises: PointsOutOfRange, RequestInvalid (wrong size), QueueFull; nothing was stored then.
        """
        with self._lock:
            points = self._demand(span)
            if len(data) != span.size:
                raise RequestInvalid(f"{span.count} points take {span.size} bytes, not {len(data)}")
            woken = self._write_locked(points, span, points.unpack(span, data), source, quality)
        self._tell(woken)

    def mask_write(self, span: Span, and_mask: int, or_mask: int, source: Source) -> None:
        """Change one register as function 22 does, in one step.

        raises: as ``write`` does; PointUnknown where a value that nobody knows would go to a device.
        """
        with self._lock:
            points = self._demand(span)
            is_unknown = points.time_s[span.start] == NEVER_S or points.commanded[span.start] == STAND_IN
            if is_unknown and any(sink.wants(span) for sink in self._sinks):
                raise PointUnknown(f"nobody knows point {span.start} yet: a part of it cannot be sent to its device")
            old = int.from_bytes(points.wire(span.start, span.stop), "big")
            raw = (old & and_mask | or_mask & ~and_mask & 0xFFFF).to_bytes(2, "big")
            woken = self._write_locked(points, span, raw, source, Quality.GOOD)
        self._tell(woken)

    def mark(self, span: Span, quality: Quality, source: Source) -> None:
        """Set the quality of a failed poll's points; values, times and sources stay."""
        del source  # of interest to readers of the call; the points keep the source of their value
        with self._lock:
            self._demand(span).quality[span.start : span.stop] = bytes([quality]) * span.count

    def mark_unfilled(self, span: Span, quality: Quality) -> None:
        """Like ``mark``, but only the points that no request fills: a failed write says nothing of what is read."""
        with self._lock:
            points = self._demand(span)
            for point in self.unfilled_locked(points, span):
                points.quality[point] = quality

    @staticmethod
    def unfilled_locked(points: _Points, span: Span) -> list[int]:
        """Return the points of *span* that no request fills, to whoever holds the lock."""
        filled = _stale_limits(points, span)
        return [point for point in range(span.start, span.stop) if point not in filled]

    def claim(self, span: Span, source: Source, stale_after_s: float) -> Callable[[], None]:
        """Say that *source* fills *span*, and from what age its values are stale. Returns its own undo."""
        claim = Claim(span, source, stale_after_s)
        with self._lock:
            points = self._demand(span)
            points.claims.append(claim)

        def undo() -> None:
            with self._lock:
                points.claims.remove(claim)

        return undo

    def watch(self, told: Callable[[Written], None]) -> Callable[[], None]:
        """Have *told* called after each block write; it must only queue. Returns its own undo."""
        with self._lock:
            self._watchers.append(told)

        def undo() -> None:
            with self._lock:
                self._watchers.remove(told)

        return undo

    # -------------------------------------------------------------------------------------------- over a restart

    def copy_of_known(self, table: Table) -> _Points:
        """Return a copy of *table* without its qualities and sources: bare memory, for the lock is held meanwhile."""
        copied = _Points(table, 0)
        with self._lock:
            points = self._tables[table]
            copied.size = points.size
            copied.values, copied.time_s, copied.commanded = points.values[:], points.time_s[:], points.commanded[:]
        return copied

    def restore(self, blocks: Sequence[Kept]) -> None:
        """Fill points that nobody has written yet, as far as there are such; then tell the watchers.

        They are stale until somebody writes them; those that were a command are one again, but none is queued now.
        """
        with self._lock:
            for block in blocks:
                points, first = self._tables[block.span.table], block.span.start
                never = [p for p in range(first, min(block.span.stop, points.size)) if points.time_s[p] == NEVER_S]
                for start, stop in runs(never):
                    raw = block.values[(start - first) * points.width : (stop - first) * points.width]
                    self._restore(points, start, raw, block)
        self._tell([])

    def _restore(self, points: _Points, start: int, raw: bytes, block: Kept) -> None:
        count = len(raw) // points.width
        time_s = LONG_AGO_S if block.age_s is None else self._clock.monotonic() - block.age_s
        self._store(points, Span(block.span.table, start, count), raw, RESTORED, Quality.STALE)
        points.time_s[start : start + count] = array("d", [time_s]) * count
        points.commanded[start : start + count] = bytes([COMMANDED if block.is_commanded else 0]) * count

    # -------------------------------------------------------------------------------------------- for commands.py

    @property
    def lock(self) -> threading.Lock:
        """The one lock; ``commands.py`` keeps its queues under it, so that a command is one step with its write."""
        return self._lock

    def add_sink(self, sink: CommandSink) -> None:
        """Have *sink* asked about each write by the upper side or the menu."""
        with self._lock:
            self._sinks.append(sink)

    def remove_sink(self, sink: CommandSink) -> None:
        """Undo ``add_sink``."""
        with self._lock:
            self._sinks.remove(sink)

    def points_locked(self, table: Table) -> _Points:
        """Return a table to whoever holds the lock."""
        return self._tables[table]

    # -------------------------------------------------------------------------------------------- inside

    def _demand(self, span: Span) -> _Points:
        """Return the table of *span* to whoever holds the lock: its size may change."""
        points = self._tables[span.table]
        if span.start < 0 or span.count < 1 or span.stop > points.size:
            raise PointsOutOfRange(f"points {span.start} to {span.stop - 1} are not within 0 to {points.size - 1}")
        return points

    def _write_locked(
        self, points: _Points, span: Span, raw: bytes, source: Source, quality: Quality
    ) -> list[CommandSink]:
        sinks = [sink for sink in self._sinks if sink.wants(span)] if source.commands else []
        for sink in sinks:
            sink.demand_room(span)
        for start, stop in points.free_runs(span) if source.kind is SourceKind.REQUEST else [(span.start, span.stop)]:
            first = (start - span.start) * points.width
            block = raw[first : first + (stop - start) * points.width]
            self._store(points, Span(span.table, start, stop - start), block, source, quality)
        self._number += 1
        for sink in sinks:
            sink.accept(span, self._number)
        return sinks

    def _store(self, points: _Points, span: Span, raw: bytes, source: Source, quality: Quality) -> None:
        start, stop, count = span.start, span.stop, span.count
        points.values[start * points.width : stop * points.width] = raw
        points.quality[start:stop] = bytes([quality]) * count
        now_s = self._clock.monotonic()
        is_stand_in = source.kind is SourceKind.REQUEST and quality is Quality.BAD  # zeros for a failed poll
        if is_stand_in:  # they make no point known that was not
            times_s = [now_s if old_s > NEVER_S else old_s for old_s in points.time_s[start:stop]]
            points.time_s[start:stop] = array("d", times_s)
        else:
            points.time_s[start:stop] = array("d", [now_s]) * count
        points.source[start:stop] = [source] * count
        if source.kind is not SourceKind.REQUEST:
            points.commanded[start:stop] = bytes([COMMANDED]) * count
        elif is_stand_in:  # nobody wanted them written anywhere
            points.commanded[start:stop] = bytes([STAND_IN]) * count
        elif STAND_IN in points.commanded[start:stop]:
            points.commanded[start:stop] = points.commanded[start:stop].replace(bytes([STAND_IN]), b"\0")
        if self._watchers:
            self._untold.append(Written(span, points.wire(start, stop), source, quality))

    def _tell(self, sinks: list[CommandSink]) -> None:
        """Wake the sinks, then tell the watchers what is untold, unless another thread is at it and will."""
        for sink in sinks:
            sink.wake()
        while self._untold:
            with self._lock:
                if self._telling or not self._untold:
                    return
                self._telling = True
                written, watchers = self._untold.popleft(), tuple(self._watchers)
            try:
                for told in watchers:
                    told(written)
            finally:
                with self._lock:
                    self._telling = False


def _is_fresh(points: _Points, claim: Claim, span: Span, now_s: float) -> bool:
    start, stop = max(span.start, claim.span.start), min(span.stop, claim.span.stop)
    quality = points.quality[start:stop]
    if Quality.BAD in quality or Quality.NEVER in quality or Quality.STALE in quality:
        return False
    return now_s - min(points.time_s[start:stop]) <= claim.stale_after_s  # as in _sample, to the last bit


def _stale_limits(points: _Points, span: Span) -> dict[int, float]:
    """Return stale_after_s of each claimed point in *span*."""
    limits: dict[int, float] = {}
    for claim in points.claims:
        if claim.span.overlaps(span):
            start, stop = max(span.start, claim.span.start), min(span.stop, claim.span.stop)
            limits.update(dict.fromkeys(range(start, stop), claim.stale_after_s))
    return limits


def _sample(points: _Points, point: int, now_s: float, stale_after_s: float | None) -> Sample:
    raw = points.values[point * points.width : (point + 1) * points.width]
    value = raw[0] & 1 if points.width == 1 else int.from_bytes(raw, "big")
    quality = Quality(points.quality[point])
    age_s = age_s_of(points.time_s[point], now_s)
    old = age_s is not None and stale_after_s is not None and age_s > stale_after_s
    if old and quality in (Quality.GOOD, Quality.MANUAL):
        quality = Quality.STALE
    return Sample(value, quality, age_s, points.source[point])


def age_s_of(time_s: float, now_s: float) -> float | None:
    """Return how long ago *time_s* was; None where nobody knows."""
    return None if time_s <= LONG_AGO_S else now_s - time_s
