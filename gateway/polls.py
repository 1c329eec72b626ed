"""A master's requests and devices as they run: what is asked, and what becomes of the points (spec section 2).

``Poll`` is one request of the configuration with its place in the register, its counters and its state; ``Device`` is
one unit of a line, alive or offline; ``StatusPoints`` shows SCADA how the requests fare; ``ProbeBudget`` says when an
offline device may be tried. None of them sends anything or knows the time: ``master.py`` does.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

from gateway.commands import Command, CommandQueue, Outlet
from gateway.config import MasterConfig, RequestConfig
from gateway.counters import PollCounters
from gateway.link import silence_s
from gateway.modbus.pdu import ReadRequest, Request, Span, Table, WriteRequest, pack_words
from gateway.register import DataRegister, Quality, Source, SourceKind
from gateway.transaction import DAMAGED, NO_ERROR, TIMEOUT, Response, Timing

OFFLINE_AFTER: Final = 3  # failures in a row
PROBE_SHARE: Final = 11  # one part probing, ten parts polling: 9.1 % of the line's time, at most 10 % is allowed
PROBE_AT_LEAST_EVERY_S: Final = 60.0
STATUS_COUNT: Final = 4  # input registers of a status_point
STATUS_EVERY_S: Final = 1.0
AGE_MAX_S: Final = 65535


class Status(IntEnum):
    """The first register of a status_point (spec section 3)."""

    NEVER = 0
    GOOD = 1
    BAD = 2
    STALE = 3
    OFFLINE = 4
    MAINTENANCE = 5


@dataclass(eq=False)
class Device:
    """One unit on the line. *polls*: its scheduled requests as bits; *outlets*: its writes; *told*: with log lines."""

    unit: int
    failures_in_row: int = 0
    is_offline: bool = False
    polls: int = 0
    outlets: set[Outlet] = field(default_factory=set)
    told: dict[str, str] = field(default_factory=dict)

    def failed(self) -> bool:
        """Count a failure; return True if it is the one that takes the device offline."""
        self.failures_in_row += 1
        goes_offline = self.failures_in_row >= OFFLINE_AFTER and not self.is_offline
        self.is_offline |= goes_offline
        return goes_offline

    def spoil(self, polls: Sequence[Poll], register: DataRegister) -> None:
        """Mark the points of those of *polls* that are its own as bad."""
        for poll in polls:
            if poll.device is self:
                poll.spoil(register)

    def sendable(self, polls: Sequence[Poll], queue: CommandQueue) -> int:
        """Return its scheduled requests, as bits in *polls*, without the writes that have no values yet."""
        bits = 0
        for index, poll in enumerate(polls):
            is_its = self.polls >> index & 1
            if is_its and (poll.outlet is None or queue.cyclic_values(poll.outlet)):
                bits |= 1 << index
        return bits


@dataclass(eq=False)
class Poll:
    """One request, as configured, and what has become of it so far."""

    config: RequestConfig
    device: Device
    source: Source
    timeout_s: float
    outlet: Outlet | None = None  # writes only
    counters: PollCounters = field(default_factory=PollCounters)
    failed_tries: int = 0
    is_bad: bool = False
    is_told: bool = False  # its failure has been logged
    last_good_s: float | None = None
    last_error: int = NO_ERROR

    @property
    def span(self) -> Span:
        """Its points in the register."""
        return Span(self.config.target, self.config.point, self.config.count)

    @property
    def is_scheduled(self) -> bool:
        """True for what is sent by cycle; False for what is only sent on change."""
        return self.config.is_read or self.config.trigger == "cycle"

    def request(self, data: bytes | None) -> Request:
        """Return what is asked: of a read, or of a write with all of its *data*."""
        if self.config.is_read:
            return ReadRequest(self.config.code, self.config.address, self.config.count)
        return WriteRequest(self.config.code, self.config.address, self.config.count, data or b"")

    def command(self, command: Command) -> Request:
        """Return the write of just the points that *command* carries."""
        address = self.config.address + command.span.start - self.config.point
        return WriteRequest(self.config.code, address, command.span.count, command.data or b"")

    def status(self, now_s: float, maintenance: bool) -> bytes:
        """Return the 4 input registers of its status_point: state, age in s, failures, last error."""
        age_s = AGE_MAX_S if self.last_good_s is None else min(AGE_MAX_S, int(now_s - self.last_good_s))
        return pack_words([self.state(now_s, maintenance), age_s, self.counters.failures & 0xFFFF, self.last_error])

    def state(self, now_s: float, maintenance: bool) -> Status:
        """Return how it fares, at *now_s* (monotonic seconds)."""
        if maintenance:
            return Status.MAINTENANCE
        if self.device.is_offline:
            return Status.OFFLINE
        if self.is_bad:
            return Status.BAD
        if self.last_good_s is None:
            return Status.NEVER
        is_old = self.config.is_read and now_s - self.last_good_s > self.config.stale_after_used
        return Status.STALE if is_old else Status.GOOD

    def count(self, response: Response, now_s: float) -> None:
        """Take *response* into the counters."""
        self.last_error = response.error_code
        count_response(self.counters, response)
        if not response.has_error():
            self.last_good_s = now_s

    def spoil(self, register: DataRegister) -> None:
        """Its points are bad; a read with ``on_failure = "zero"`` also gives zeros."""
        self.is_bad = True
        if self.outlet is not None:
            register.mark_unfilled(self.span, Quality.BAD)
        elif self.config.on_failure == "zero":
            register.write(self.span, bytes(self.span.size), self.source, Quality.BAD)
        else:
            register.mark(self.span, Quality.BAD, self.source)


def count_response(counters: PollCounters, response: Response) -> None:
    """Take *response* into *counters*."""
    if response.error_code == TIMEOUT:
        counters.timeouts += 1
    elif response.error_code == DAMAGED:
        counters.damaged += 1
    elif response.has_error():
        counters.exceptions[response.error_code] += 1
    else:
        counters.good += 1
    if response.error_code not in (TIMEOUT, DAMAGED):
        counters.times.add(response.reply_s)


def polls_of(master: MasterConfig) -> tuple[list[Poll], dict[int, Device]]:
    """Return the enabled requests of *master*, those sent by cycle first, and its devices by unit.

    The bit of a scheduled request in ``Device.polls`` is its place in the list.
    """
    devices: dict[int, Device] = {}
    enabled = [request for request in master.request if request.enabled]
    polls: list[Poll] = []
    for request in sorted(enabled, key=lambda r: not r.is_read and r.trigger == "change"):
        device = devices.setdefault(
            request.unit, Device(request.unit, told={"about": f"{master.name}: unit {request.unit}"})
        )
        source = Source(SourceKind.REQUEST, f"{master.name}/{request.title}")
        poll = Poll(request, device, source, master.response_timeout_of(request))
        if poll.is_scheduled:
            device.polls |= 1 << len(polls)
        if not request.is_read:
            poll.outlet = _outlet(poll, enabled)
            device.outlets.add(poll.outlet)
        polls.append(poll)
    return polls, devices


def _outlet(poll: Poll, requests: Sequence[RequestConfig]) -> Outlet:
    config = poll.config
    filled_by_same_device = any(
        other.is_read and other.unit == config.unit and Span(other.target, other.point, other.count).overlaps(poll.span)
        for other in requests
    )
    return Outlet(
        poll.span,
        poll.source,
        on_change=config.trigger == "change",
        whole=config.whole,
        commanded_only=(config.trigger == "cycle" or config.whole) and filled_by_same_device,
        expire_s=config.expire,
    )


def status_span(poll: Poll) -> Span | None:
    """Return where the request's status goes, or None."""
    point = poll.config.status_point
    return Span(Table.INPUT_REGISTERS, point, STATUS_COUNT) if point >= 0 else None


class StatusPoints:
    """The status points of a line's requests: written whenever something has become of a request, and once a second."""

    def __init__(self, polls: Sequence[Poll], register: DataRegister) -> None:
        self._polls = [poll for poll in polls if status_span(poll)]
        self._register = register
        self._due_s = 0.0

    def due_s(self) -> float | None:
        """Return from when on ``show_all`` has something to do (monotonic seconds); None: never."""
        return self._due_s if self._polls else None

    def show_all(self, now_s: float, maintenance: bool) -> None:
        """Write all of them, if a second has passed since the last time."""
        if now_s >= self._due_s:
            self._due_s = now_s + STATUS_EVERY_S
            for poll in self._polls:
                self.show(poll, now_s, maintenance)

    def show(self, poll: Poll, now_s: float, maintenance: bool) -> None:
        """Write that of *poll*, if it has one."""
        span = status_span(poll)
        if span is not None:
            self._register.write(span, poll.status(now_s, maintenance), poll.source)


def take_points(polls: Sequence[Poll], register: DataRegister, queue: CommandQueue) -> list[Callable[[], None]]:
    """Have each read of *polls* fill its points, and each write follow its own through *queue*; return the undoing."""
    undo = [queue.close]
    for poll in polls:
        if poll.outlet:
            queue.add(poll.outlet)
        else:
            undo.append(register.claim(poll.span, poll.source, poll.config.stale_after_used))
    return undo


def timing_of(master: MasterConfig, character_s: float) -> Timing:
    """Return the times of the master's line; *character_s*: one character on the wire, 0 on TCP."""
    return Timing(
        master.response_timeout,
        master.character_timeout_used,
        0.0 if master.is_tcp else silence_s(master.baudrate, character_s),
        master.delay,
        master.turnaround,
        character_s,
    )


class ProbeBudget:
    """When the next offline device may be tried: one at a time, in turn, at most 10 % of the line's time."""

    def __init__(self) -> None:
        self._next_s = 0.0
        self._last_unit = -1
        self._wanted_last = False

    def due_s(self) -> float:
        """Return from when on a probe may be sent (monotonic seconds)."""
        return self._next_s

    def in_turn(self, offline: Collection[Device], wanted: Collection[Device]) -> list[Device]:
        """Return the offline devices in the order of their turns; every other time those *wanted* go first."""
        ordered = sorted(offline, key=lambda device: (device.unit <= self._last_unit, device.unit))
        if self._wanted_last:
            return ordered
        return sorted(ordered, key=lambda device: device not in wanted)

    def picked(self, device: Device, is_wanted: bool) -> None:
        """*device* is probed now; where it goes first because it is wanted, that is not its turn."""
        goes_first = is_wanted and not self._wanted_last
        if not goes_first:
            self._last_unit = device.unit
        self._wanted_last = goes_first

    def spent(self, began_s: float, free_s: float) -> None:
        """A probe took the line from *began_s* until it is free again at *free_s*, listening included.

        Where one takes more than 5 s, one a minute is more than the share; half of the time is the polls' in any case.
        """
        took_s = free_s - began_s
        self._next_s = began_s + max(2 * took_s, min(PROBE_SHARE * took_s, PROBE_AT_LEAST_EVERY_S))
