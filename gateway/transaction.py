"""One request and its reply on a link, without waiting: a program's interface to a line (spec section 2).

    line = Line(link, "rtu")
    line.read_holding_registers(unit=0x10, address=0x24, quantity=5)
    ...                                      # do something else, then look
    response = line.available()              # None, or a Response

``Line`` keeps the silences between frames, checks the reply against its request, and knows when the line is spoiled:
after a timeout or a damaged frame a late reply may still come, which looks just like the answer to the next request of
the same shape. It waits for the time in which a reply was due to end, listens for one reply time more, throws away what
comes, and only then sends again: what damage there was may not have been the reply. On Modbus TCP the
transaction identifier tells late replies apart, so there is nothing to listen for.

It decides nothing: which request is next, what is done about an error, is the master's affair.

Threads: none; one thread uses a Line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, Protocol

from gateway.clock import Clock, SystemClock
from gateway.errors import DeviceRefused, LinkLost, ReplyMismatch, RequestInvalid
from gateway.modbus import pdu
from gateway.modbus.framing import ASCII_MAX, RTU_MAX, Frame, Framing, reply_framer
from gateway.modbus.pdu import BROADCAST, AnyRequest, ReadRequest, WriteRequest

NO_ERROR: Final = 0
DAMAGED: Final = 0xFFFE  # error codes of our own, beyond the exceptions 1 to 255
TIMEOUT: Final = 0xFFFF


class ByteLink(Protocol):
    """What a Line needs of a link; ``link.Link`` is one."""

    def read(self, timeout_s: float) -> bytes:
        """Return what has come; b"" after *timeout_s* or when woken."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of *data*."""
        ...


@dataclass(frozen=True)
class Response:
    """What became of one request.

    error_code: 0; 1 to 255: the device's exception; ``DAMAGED``: what came was no reply to it; ``TIMEOUT``: silence.
    data:       big-endian words or packed bits as on the wire; b"" for a write or an error.
    reply_s:    seconds from the last bit sent to the reply, or to giving up.
    reason:     in words, for the log.
    """

    unit: int
    function: int
    error_code: int
    data: bytes = b""
    reply_s: float = 0.0
    reason: str = ""

    def has_error(self) -> bool:
        """Return whether there is nothing to read here."""
        return self.error_code != NO_ERROR

    def is_coil_set(self, index: int) -> bool:
        """Return coil *index* of the reply, counted from 0. Raises IndexError beyond the reply."""
        return self._bit(index)

    def is_discrete_input_set(self, index: int) -> bool:
        """Return discrete input *index* of the reply, counted from 0. Raises IndexError beyond the reply."""
        return self._bit(index)

    def register(self, index: int) -> int:
        """Return register *index* of the reply, 0 to 65535, counted from 0. Raises IndexError beyond the reply."""
        if not 0 <= 2 * index < len(self.data):
            raise IndexError(f"the reply has no register {index}")
        return pdu.word_at(self.data, index)

    def _bit(self, index: int) -> bool:
        if not 0 <= index < 8 * len(self.data):
            raise IndexError(f"the reply has no bit {index}")
        return pdu.bit_at(self.data, index)


class State(Enum):
    """Where a line is."""

    IDLE = "idle"  # nothing asked, nothing expected
    HELD_BACK = "held back"  # a request waits until the line has been silent long enough
    AWAITING = "awaiting reply"
    CONFIRMING = "confirming"  # a whole reply is here; silence has to prove that it was all
    TURNAROUND = "turnaround"  # after a broadcast, which nobody answers
    SPOILED = "spoiled"  # a late reply may still come


class Event(Enum):
    """What happens to a line."""

    ASKED = "asked"
    SENT = "sent"
    SENT_TO_ALL = "sent to all"
    REPLY = "reply"
    SILENCE = "silence"
    TIMEOUT = "timeout"
    DAMAGE = "damage"


NEXT: Final[dict[State, dict[Event, State]]] = {  # the whole life of a line, in one place
    State.IDLE: {Event.ASKED: State.HELD_BACK},
    State.HELD_BACK: {
        Event.SENT: State.AWAITING,
        Event.SENT_TO_ALL: State.TURNAROUND,
        Event.DAMAGE: State.IDLE,  # it never was silent
    },
    State.AWAITING: {
        Event.REPLY: State.CONFIRMING,
        Event.TIMEOUT: State.SPOILED,
        Event.DAMAGE: State.SPOILED,
    },
    State.CONFIRMING: {Event.SILENCE: State.IDLE, Event.DAMAGE: State.SPOILED},
    State.TURNAROUND: {Event.SILENCE: State.IDLE},
    State.SPOILED: {Event.SILENCE: State.IDLE},
}


@dataclass(frozen=True)
class Timing:
    """The times of one line, in seconds (spec sections 2 and 4)."""

    response_timeout_s: float = 2.5
    character_timeout_s: float = 0.2
    silence_s: float = 0.00175  # between frames; 0 on TCP
    delay_s: float = 0.0  # more of it before each request
    turnaround_s: float = 0.1
    character_s: float = 0.0  # one character on the wire; 0 on TCP


@dataclass(frozen=True)
class _Asked:
    unit: int
    request: AnyRequest
    timeout_s: float


class Line:
    """One line: one request at a time."""

    def __init__(
        self,
        link: ByteLink,
        framing: Framing,
        timing: Timing | None = None,
        clock: Clock | None = None,
        traffic: Callable[[bool, bytes], None] | None = None,
        late_until_s: float = 0.0,
    ) -> None:
        """Begin as a line that nothing is expected on, or, until *late_until_s* (monotonic), as a spoiled one.

        traffic: told of all bytes: True and what was sent, False and what came; it must only queue.
        """
        self._link = link
        self._timing = timing or Timing()
        self._clock = clock or SystemClock()
        self._traffic = traffic
        self._framer = reply_framer(framing)
        self._has_transactions = framing == "tcp"
        self._transaction = 0
        self.state = State.SPOILED if late_until_s > self._clock.monotonic() else State.IDLE
        self._asked: _Asked | None = None
        self._reply: Response | None = None
        self._done: Response | None = None
        self._quiet_since_s = self._clock.monotonic() - self._timing.silence_s - self._timing.delay_s
        self._held_back_s = 0.0  # since when a request waits for silence
        self._sent_s = 0.0  # when the last bit of the request has left
        self._heard_s = 0.0  # when the last byte came
        self._until_s = late_until_s  # how long TURNAROUND or SPOILED last
        self.over_by_s = 0.0  # when the request is over at the latest, monotonic, whatever the other side does

    # -------------------------------------------------------------------------------------------- for programs

    def read_coils(self, unit: int, address: int, quantity: int) -> bool:
        """Ask for 1 to 2000 coils; see ``send``."""
        return self.send(unit, ReadRequest(1, address, quantity))

    def read_discrete_inputs(self, unit: int, address: int, quantity: int) -> bool:
        """Ask for 1 to 2000 discrete inputs; see ``send``."""
        return self.send(unit, ReadRequest(2, address, quantity))

    def read_holding_registers(self, unit: int, address: int, quantity: int) -> bool:
        """Ask for 1 to 125 holding registers; see ``send``."""
        return self.send(unit, ReadRequest(3, address, quantity))

    def read_input_registers(self, unit: int, address: int, quantity: int) -> bool:
        """Ask for 1 to 125 input registers; see ``send``."""
        return self.send(unit, ReadRequest(4, address, quantity))

    def write_single_coil(self, unit: int, address: int, value: bool) -> bool:
        """Set one coil on or off; see ``send``."""
        return self.send(unit, WriteRequest(5, address, 1, pdu.pack_bits([bool(value)])))

    def write_single_register(self, unit: int, address: int, value: int) -> bool:
        """Write one holding register, 0 to 65535; see ``send``."""
        return self.send(unit, WriteRequest(6, address, 1, _words([value])))

    def write_multiple_coils(self, unit: int, address: int, values: Sequence[bool]) -> bool:
        """Write 1 to 1968 coils; see ``send``."""
        return self.send(unit, WriteRequest(15, address, len(values), pdu.pack_bits([bool(v) for v in values])))

    def write_multiple_registers(self, unit: int, address: int, values: Sequence[int]) -> bool:
        """Write 1 to 123 holding registers, 0 to 65535 each; see ``send``."""
        return self.send(unit, WriteRequest(16, address, len(values), _words(values)))

    def available(self) -> Response | None:
        """Return what became of the request, once; None before. Never waits. Raises LinkLost."""
        return self.advance(0.0)

    # -------------------------------------------------------------------------------------------- for the master

    def send(self, unit: int, request: AnyRequest, timeout_s: float | None = None) -> bool:
        """Send *request* to *unit*; at once if the line has been silent long enough, else as soon as it has.

        unit:      0 to 255; 0 is a broadcast except on Modbus TCP, and only for writes.
        timeout_s: another response timeout than the line's.
        returns:   False while a request is pending: nothing was done; else True.
        raises:    RequestInvalid (nothing was sent), LinkLost.
        """
        if self._asked is not None or self._done is not None:
            return False
        check_asked(unit, request, has_broadcast=not self._has_transactions)
        self._asked = _Asked(unit, request, timeout_s or self._timing.response_timeout_s)
        self.over_by_s = self._latest_s(self._asked.timeout_s)
        if self.state is State.IDLE:
            self._hold_back()
        return True

    @property
    def is_free(self) -> bool:
        """True when nothing is pending and no late reply is listened for."""
        return self._asked is None and self.state is State.IDLE

    @property
    def late_until_s(self) -> float:
        """Return until when a late reply may come on these wires (monotonic seconds), for the next Line; 0: none."""
        if self.state in (State.AWAITING, State.CONFIRMING) and self._asked is not None:
            return max(self._clock.monotonic(), self._deadline_s()) + self._asked.timeout_s
        return self._until_s if self.state in (State.SPOILED, State.TURNAROUND) else 0.0

    def silent_in_s(self) -> float:
        """Return how long the line has to stay silent until a request would be sent at once; 0: it is by now."""
        return max(0.0, self._silent_s() - self._clock.monotonic())

    def advance(self, wait_s: float) -> Response | None:
        """Wait at most *wait_s* for the next thing to happen, and return what became of the request, once.

        Whatever comes while nothing is asked is thrown away, and the silence before the next request counts anew.
        """
        if self._done is None:
            self._step(wait_s)
        done, self._done = self._done, None
        return done

    # -------------------------------------------------------------------------------------------- inside

    def _step(self, wait_s: float) -> None:
        if self.state not in (
            State.AWAITING,
            State.CONFIRMING,
        ):  # a reply that came in time may lie unread: first look, then judge
            self._time_passes()
        if self._done is not None:
            return
        due_s = self._next_s()
        limit_s = wait_s if due_s is None else min(wait_s, max(0.0, due_s - self._clock.monotonic()))
        data = self._link.read(limit_s)
        if data:
            self._heard(data)
        self._time_passes()

    def _next_s(self) -> float | None:
        """When something happens by itself: monotonic seconds, or None."""
        timing = self._timing
        match self.state:
            case State.HELD_BACK:
                return self._silent_s()
            case State.AWAITING:
                if self._has_begun and not self._has_transactions:
                    return min(self._heard_s + timing.character_timeout_s, self._last_chance_s())
                return self._last_chance_s() if self._framer.pending else self._deadline_s()
            case State.CONFIRMING:
                return self._heard_s + timing.silence_s
            case State.TURNAROUND | State.SPOILED:
                return self._until_s
            case _:
                return None

    @property
    def _has_begun(self) -> bool:
        """True if something came that is, or was to be, part of a reply; on Modbus TCP the right one may still come."""
        return self._framer.pending > 0 or (self._framer.damaged > 0 and not self._has_transactions)

    def _latest_s(self, timeout_s: float) -> float:
        """When a request that is asked now is over: behind late replies, the wait for silence, and its own time."""
        timing = self._timing
        began_s = max(self._clock.monotonic(), self.late_until_s) + timeout_s + timing.delay_s + timing.silence_s
        ends_s = began_s + timeout_s + timing.turnaround_s + timing.character_timeout_s
        return ends_s + 2 * ASCII_MAX * timing.character_s

    def _silent_s(self) -> float:
        return self._quiet_since_s + self._timing.silence_s + self._timing.delay_s

    def _deadline_s(self) -> float:
        return self._sent_s + self._asked.timeout_s if self._asked else self._sent_s

    def _last_chance_s(self) -> float:
        """A reply that has begun in time may end later, but a device that never ends is cut off."""
        return self._deadline_s() + self._timing.character_timeout_s + RTU_MAX * self._timing.character_s

    def _heard(self, data: bytes) -> None:
        self._tell(False, data)
        self._heard_s = self._quiet_since_s = self._clock.monotonic()
        if self.state is State.AWAITING:
            self._framer.receive_data(data)
            self._look_for_reply()
        elif self.state is State.CONFIRMING:
            self._fail(Event.DAMAGE, DAMAGED, "more bytes after the end of the reply")
        elif self._has_transactions:
            self._framer.receive_data(data)  # a late reply: kept in step, not kept
            while self._framer.next_frame():
                pass
            self._demand_sense()

    def _look_for_reply(self) -> None:
        while self.state is State.AWAITING and (frame := self._framer.next_frame()) is not None:
            if self._is_awaited(frame):
                self._judge(frame)
        self._demand_sense()

    def _demand_sense(self) -> None:
        if self._framer.broken:
            raise LinkLost("the other side does not speak Modbus TCP")

    def _is_awaited(self, frame: Frame) -> bool:
        asked = self._asked
        if asked is None or frame.unit != asked.unit:
            return False
        return not self._has_transactions or frame.transaction == self._transaction

    def _judge(self, frame: Frame) -> None:
        asked = self._asked
        assert asked is not None  # noqa: S101 - a reply is only judged while one is awaited
        reply_s = max(0.0, self._heard_s - self._sent_s)
        try:
            data, code = pdu.decode_reply(asked.request, frame.pdu), NO_ERROR
            reason = ""
        except DeviceRefused as refused:
            data, code, reason = b"", refused.code, str(refused)
        except ReplyMismatch as mismatch:
            self._fail(Event.DAMAGE, DAMAGED, str(mismatch))
            return
        if self._framer.pending and not self._has_transactions:
            self._fail(Event.DAMAGE, DAMAGED, "more bytes after the end of the reply")
            return
        self._reply = Response(asked.unit, asked.request.function, code, data, reply_s, reason)
        self._pass(Event.REPLY)

    def _time_passes(self) -> None:
        """Do what is due by now."""
        now_s = self._clock.monotonic()
        match self.state:
            case State.HELD_BACK:
                self._send_when_silent()
            case State.AWAITING:
                self._wait_no_longer(now_s)
            case State.CONFIRMING if now_s >= self._heard_s + self._timing.silence_s:
                self._finish(self._reply)
            case State.TURNAROUND if now_s >= self._until_s and self._asked is not None:
                self._finish(Response(self._asked.unit, self._asked.request.function, NO_ERROR))
            case State.SPOILED if now_s >= self._until_s:
                self._pass(Event.SILENCE)
                if self._asked is not None:
                    self._hold_back()

    def _wait_no_longer(self, now_s: float) -> None:
        is_quiet = not self._has_transactions and now_s >= self._heard_s + self._timing.character_timeout_s
        if is_quiet and self._framer.pending:
            self._look_behind_false_starts()
        if self.state is not State.AWAITING:
            return
        late = self._last_chance_s() if self._framer.pending else self._deadline_s()
        if self._has_begun and (is_quiet or now_s >= late):
            self._fail(Event.DAMAGE, DAMAGED, "what came was no undamaged reply")
        elif now_s >= late:
            self._fail(Event.TIMEOUT, TIMEOUT, "no reply")

    def _look_behind_false_starts(self) -> None:
        """After a pause: what looked like the start of the reply goes no further, but the reply may stand behind it."""
        before = self._framer.pending + 1
        while self.state is State.AWAITING and 0 < self._framer.pending < before:
            before = self._framer.pending
            self._framer.silence()
            self._look_for_reply()

    def _hold_back(self) -> None:
        self._pass(Event.ASKED)
        self._held_back_s = self._clock.monotonic()
        self._send_when_silent()

    def _send_when_silent(self) -> None:
        asked, now_s = self._asked, self._clock.monotonic()
        if asked is None:
            return
        if now_s < self._silent_s():
            if now_s >= self._held_back_s + asked.timeout_s + self._timing.delay_s:
                self._fail(Event.DAMAGE, DAMAGED, "the line is never silent")
            return
        if not self._has_transactions and (unread := self._link.read(0.0)):  # a late reply that nobody looked for
            self._heard(unread)
            return
        self._transaction = (self._transaction + 1) & 0xFFFF
        self._framer.reset()  # half a reply that has not become whole by now never will
        self._framer.expect(asked.unit, asked.request.function)
        self._framer.damaged = 0
        frame = Frame(asked.unit, pdu.encode_request(asked.request), self._transaction)
        data = self._framer.encode(frame)
        self._link.write(data)
        self._tell(True, data)
        self._sent_s = self._quiet_since_s = self._clock.monotonic() + len(data) * self._timing.character_s
        self.over_by_s = self._latest_s(asked.timeout_s)  # the write may have waited for its last bit
        if self._is_broadcast(asked.unit):
            self._until_s = self._sent_s + self._timing.turnaround_s
            self._pass(Event.SENT_TO_ALL)
        else:
            self._pass(Event.SENT)

    def _is_broadcast(self, unit: int) -> bool:
        return unit == BROADCAST and not self._has_transactions

    def _fail(self, event: Event, code: int, reason: str) -> None:
        asked = self._asked
        assert asked is not None  # noqa: S101 - only what was asked can fail
        now_s, deadline_s = self._clock.monotonic(), self._deadline_s()
        self._pass(event)
        self._asked, self._reply = None, None
        self._done = Response(asked.unit, asked.request.function, code, b"", now_s - self._sent_s, reason)
        if self.state is State.SPOILED and self._has_transactions:
            self._pass(Event.SILENCE)  # a late reply is known by its number; half of one may become whole until then
        elif self.state is State.SPOILED:
            self._framer.reset()
            self._until_s = max(now_s, deadline_s) + asked.timeout_s  # damage makes no late reply come earlier

    def _finish(self, response: Response | None) -> None:
        self._pass(Event.SILENCE)
        self._asked, self._reply, self._done = None, None, response

    def _pass(self, event: Event) -> None:
        self.state = NEXT[self.state][event]

    def _tell(self, sent: bool, data: bytes) -> None:
        if self._traffic is not None:
            self._traffic(sent, data)


def check_asked(unit: int, request: AnyRequest, has_broadcast: bool) -> None:
    """Raise RequestInvalid unless *request* can be sent to *unit*; *has_broadcast*: unit 0 is all, and none answers."""
    if not 0 <= unit <= 255:
        raise RequestInvalid(f"unit {unit} is not within 0 to 255")
    pdu.check_request(request)
    if has_broadcast and unit == BROADCAST and not isinstance(request, WriteRequest):
        raise RequestInvalid("a broadcast (unit 0) can only write: nobody answers it")


def _words(values: Sequence[int]) -> bytes:
    for value in values:
        if not 0 <= value <= 0xFFFF:
            raise RequestInvalid(f"value {value} is not within 0 to 65535")
    return pdu.pack_words(list(values))
