"""The way down: what the upper side or the menu writes, on its way to a device (spec section 2, write requests).

An ``Outlet`` is one write request over the register's points, a ``CommandQueue`` holds the commands of one master. Both
live under the register's lock, so that a write, its number and its command are one step: the value travels with the
command, only the newest for a point is sent, and the point is held against polls until the device has answered.

It sends nothing and knows no line: ``master.py`` takes commands, and says what became of each.

Threads: ``accept`` and its like run in the thread that writes the register; the rest in the master's.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field, replace
from typing import Final

from gateway.clock import Clock
from gateway.errors import QueueFull
from gateway.modbus.pdu import Span
from gateway.register import COMMANDED, NEVER_S, RESTORED, CommandSink, DataRegister, Quality, Source, runs

QUEUE_LIMIT: Final = 100  # commands of one master that wait


@dataclass(eq=False)
class Outlet:
    """One write request: what is written to *span* goes to a device.

    on_change:      each write makes a command; False: the request is sent by cycle and only holds its points.
    whole:          a command carries all of *span*, not only what was written.
    commanded_only: the same device fills these points, too: a cyclic request is sent only once the upper side or a
                    person wrote one of them, and never with zeros that stand for a failed poll.
    expire_s:       a command not delivered for so long is dropped; 0: never.
    """

    span: Span
    source: Source
    on_change: bool = True
    whole: bool = False
    commanded_only: bool = False
    expire_s: float = 10.0
    pending: dict[int, int] = field(default_factory=dict)  # point: number of its newest undelivered write
    dropped: set[int] = field(default_factory=set)  # points whose last write was given up


@dataclass(frozen=True)
class Command:
    """One write to send: *data* for *span*, made by write *number* at *made_s* (monotonic seconds).

    data is None for a whole request some of whose points nobody has written yet: it waits for them.
    """

    outlet: Outlet
    number: int
    span: Span
    data: bytes | None
    made_s: float

    @property
    def newest_points(self) -> list[int]:
        """The points no later write has taken over."""
        pending = self.outlet.pending
        return [point for point in range(self.span.start, self.span.stop) if pending.get(point) == self.number]


class CommandQueue(CommandSink):
    """The commands of one master, oldest first; bounded."""

    def __init__(
        self, register: DataRegister, clock: Clock, wake: Callable[[], None], limit: int = QUEUE_LIMIT
    ) -> None:
        """*wake*: called after a command was queued, from the thread that wrote."""
        self._register = register
        self._clock = clock
        self._wake = wake
        self._limit = limit
        self._outlets: list[Outlet] = []
        self._queue: deque[Command] = deque()
        self._number = 0
        register.add_sink(self)

    def add(self, outlet: Outlet) -> None:
        """Have writes to the outlet's span make commands, or hold its points.

        What was a command before a restart is no command now; but what a cyclic request sends is held until it has
        been delivered: else the first poll would overwrite a setpoint with what the device was switched on with.
        """
        with self._register.lock:
            self._outlets.append(outlet)
            if not outlet.on_change:
                points = self._register.points_locked(outlet.span.table)
                restored = [p for p in range(outlet.span.start, outlet.span.stop) if points.source[p] is RESTORED]
                self._hold(outlet, [p for p in restored if points.commanded[p] == COMMANDED], self._number)

    def close(self) -> None:
        """Forget every command and let go of every point; what a command was to deliver becomes bad."""
        self._register.remove_sink(self)
        with self._register.lock:
            self._queue.clear()
            for outlet in self._outlets:
                if outlet.on_change:
                    self._judge(outlet, outlet.pending, is_delivered=False)
                self._release(outlet, list(outlet.pending))
            self._outlets.clear()

    def __len__(self) -> int:
        return len(self._queue)

    # -------------------------------------------------------------------------------------------- writer's side

    def wants(self, span: Span) -> bool:
        return any(outlet.span.overlaps(span) for outlet in self._outlets)

    def demand_room(self, span: Span) -> None:
        needed = sum(outlet.on_change for outlet in self._outlets if outlet.span.overlaps(span))
        if len(self._queue) + needed > self._limit:
            self._queue = deque(command for command in self._queue if command.newest_points)
        kept = [command for command in self._queue if not self._is_replaced(command, span)]
        if len(kept) + needed > self._limit:
            raise QueueFull(f"{self._limit} commands wait for this line already")

    @staticmethod
    def _is_replaced(command: Command, span: Span) -> bool:
        """True if a write to *span* takes over all that *command* still has to carry."""
        return command.span.table is span.table and set(command.newest_points) <= set(range(span.start, span.stop))

    def accept(self, span: Span, number: int) -> None:
        self._number = number
        for outlet in self._outlets:
            if outlet.span.overlaps(span):
                start, stop = max(span.start, outlet.span.start), min(span.stop, outlet.span.stop)
                self._hold(outlet, range(start, stop), number)
                if outlet.on_change and outlet.whole:  # this command carries what older ones were to carry
                    self._hold(outlet, list(outlet.pending), number)
                if outlet.on_change:
                    written = outlet.span if outlet.whole else Span(span.table, start, stop - start)
                    data = self._values(outlet, written)
                    self._queue.append(Command(outlet, number, written, data, self._clock.monotonic()))

    def wake(self) -> None:
        self._wake()

    def _values(self, outlet: Outlet, span: Span) -> bytes | None:
        points = self._register.points_locked(span.table)
        return self._register.known_locked(points, span, outlet.commanded_only)

    def _hold(self, outlet: Outlet, points: Iterable[int], number: int) -> None:
        held = self._register.points_locked(outlet.span.table).held
        for point in points:
            if point not in outlet.pending:
                held[point] = held.get(point, 0) + 1
            outlet.pending[point] = number

    def _release(self, outlet: Outlet, points: list[int]) -> None:
        held = self._register.points_locked(outlet.span.table).held
        for point in points:
            del outlet.pending[point]
            held[point] -= 1
            if not held[point]:
                del held[point]

    # -------------------------------------------------------------------------------------------- master's side

    def take(self, skip: Container[Outlet] = ()) -> Command | None:
        """Return the oldest command that can be sent now, without the points a later write has taken over.

        skip: outlets whose device is not to be bothered now; their commands keep their place.
        """
        if not self._queue:  # a write that comes in this moment wakes the master anyway
            return None
        with self._register.lock:
            for command in list(self._queue):
                if command.outlet in skip:
                    continue
                runs_left = self._sendable(command)
                if runs_left is None:
                    continue
                place = self._queue.index(command)
                del self._queue[place]
                for later in reversed(runs_left[1:]):
                    self._queue.insert(place, later)
                if runs_left:
                    return runs_left[0]
        return None

    def _sendable(self, command: Command) -> list[Command] | None:
        """Return what is left of *command*, one for each contiguous run; None if it has to wait."""
        newest = command.newest_points
        if not newest:
            return []
        if command.data is None:
            data = self._values(command.outlet, command.span)
            return [replace(command, data=data)] if data is not None else None
        if command.outlet.whole:
            return [command]
        return [self._part(command, start, stop) for start, stop in runs(newest)]

    def _part(self, command: Command, start: int, stop: int) -> Command:
        """Return the part of *command* from *start* to *stop*: its own values, for they are still the newest."""
        span = Span(command.span.table, start, stop - start)
        return replace(command, span=span, data=self._values(command.outlet, span))

    def put_back(self, command: Command) -> None:
        """Have *command*, which the device did not answer, sent again unless a later write replaces it."""
        with self._register.lock:
            self._queue.appendleft(command)

    def answered(self, command: Command) -> None:
        """The device has answered *command*: polls may fill its points again."""
        self._settle(command.outlet, command.span, command.number, is_delivered=True)

    def drop(self, command: Command) -> None:
        """Give *command* up: its points become bad, and polls may fill them again."""
        self._settle(command.outlet, command.span, command.number, is_delivered=False)

    def expire(self) -> list[Command]:
        """Drop and return the commands that have waited too long."""
        if not self._queue:
            return []
        now_s = self._clock.monotonic()
        with self._register.lock:
            late = [c for c in self._queue if 0 < c.outlet.expire_s <= now_s - c.made_s]
            for command in late:
                self._queue.remove(command)
            late = [command for command in late if command.newest_points]
        for command in late:
            self.drop(command)
        return late

    def next_expiry_s(self) -> float | None:
        """Return when the next command expires (monotonic seconds), or None."""
        if not self._queue:
            return None
        with self._register.lock:
            return min((c.made_s + c.outlet.expire_s for c in self._queue if c.outlet.expire_s > 0), default=None)

    def cyclic_values(self, outlet: Outlet) -> tuple[bytes, int] | None:
        """Return what a cyclic request sends now, and its number for ``delivered``; None while points are unknown."""
        with self._register.lock:
            data = self._values(outlet, outlet.span)
            return None if data is None else (data, self._number)

    def delivered(self, outlet: Outlet, number: int) -> None:
        """The device has taken a cyclic request that carried everything up to *number*."""
        with self._register.lock:
            outlet.dropped.clear()  # all its points went along
        self._settle(outlet, outlet.span, number, is_delivered=True)

    def refused(self, outlet: Outlet, number: int) -> None:
        """The device has refused a cyclic request that carried everything up to *number*."""
        self._settle(outlet, outlet.span, number, is_delivered=False)

    def restore(self, outlet: Outlet) -> None:
        """The device is back: what it took before it fell silent is good again, unless a request reads it."""
        with self._register.lock:
            points = self._register.points_locked(outlet.span.table)
            for point in self._register.unfilled_locked(points, outlet.span):
                is_taken = point not in outlet.pending and point not in outlet.dropped
                if is_taken and points.quality[point] == Quality.BAD:
                    is_written = points.time_s[point] > NEVER_S
                    is_old = points.source[point] is RESTORED
                    good = Quality.STALE if is_old else Quality.GOOD
                    points.quality[point] = good if is_written else Quality.NEVER

    def waiting(self) -> set[Outlet]:
        """Return the outlets that have commands in the queue."""
        with self._register.lock:
            return {command.outlet for command in self._queue}

    def _settle(self, outlet: Outlet, span: Span, number: int, is_delivered: bool) -> None:
        """Let go of the points of *span* that no write later than *number* holds."""
        with self._register.lock:
            points = [p for p in range(span.start, span.stop) if outlet.pending.get(p, number + 1) <= number]
            self._judge(outlet, points, is_delivered)
            self._release(outlet, points)

    def _judge(self, outlet: Outlet, points: Iterable[int], is_delivered: bool) -> None:
        """Points not delivered are bad; delivered ones no longer, but what a request reads is its affair alone."""
        table = self._register.points_locked(outlet.span.table)
        quality, unfilled = table.quality, set(self._register.unfilled_locked(table, outlet.span))
        for point in points:
            outlet.dropped.discard(point)
            if not is_delivered:
                outlet.dropped.add(point)
                quality[point] = Quality.BAD
            elif quality[point] == Quality.BAD and point in unfilled:
                quality[point] = Quality.GOOD
