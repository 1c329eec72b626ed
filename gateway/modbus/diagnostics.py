"""What a serial line counts and logs, and the functions that tell it: 7, 8, 11, 12 and 17.

They belong to the serial line only: a server on Modbus TCP has no ``LineDiagnostics`` and does not know them.
Pure: numbers and bytes. Words and bits of the register are ``server``'s affair.

Source: application protocol V1.1b3, sections 6.7 to 6.10 and 6.13; counters: serial line guide V1.02, appendix A.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gateway.errors import RequestRefused
from gateway.modbus.pdu import ExceptionCode, pack_words, word_at

LINE_FUNCTIONS: Final = frozenset({7, 8, 11, 12, 17})
EVENTS_KEPT: Final = 64  # section 6.10
COUNTER_LIMIT: Final = 0x10000
RUNNING: Final = 0xFF  # section 6.13, run indicator status
READY: Final = 0x0000  # sections 6.9 and 6.10, status word: no program function in progress

RECEIVED: Final = 0x80  # events, section 6.10
RECEIVED_DAMAGED: Final = 0x02
RECEIVED_BROADCAST: Final = 0x40
SENT: Final = 0x40
LISTENING_ONLY: Final = 0x20
ENTERED_LISTEN_ONLY: Final = 0x04
RESTARTED: Final = 0x00
SENT_EXCEPTION: Final = {1: 0x01, 2: 0x01, 3: 0x01, 4: 0x02, 5: 0x04, 6: 0x04, 7: 0x08}

RETURN_QUERY_DATA: Final = 0  # sub-functions, section 6.8.1
RESTART: Final = 1
RETURN_REGISTER: Final = 2
FORCE_LISTEN_ONLY: Final = 4
CLEAR: Final = 10
CLEAR_LOG: Final = 0xFF00
COUNTERS: Final = {
    11: "bus_messages",
    12: "bus_errors",
    13: "exceptions",
    14: "messages",
    15: "unanswered",
    16: "naks",
    17: "busy",
    18: "overruns",
}


@dataclass
class LineDiagnostics:
    """One serial line as its slave sees it. Counters wrap at 65536.

    bus_messages: undamaged messages on the line, whoever they are for (CPT1).
    bus_errors:   damaged ones (CPT2).
    exceptions:   exceptions, those of broadcasts that nobody is told of included (CPT3).
    messages:     messages for this slave, broadcasts included (CPT4).
    unanswered:   of those, the ones that got no answer at all: broadcasts, and everything while listening only (CPT5).
    naks, busy:   answers with exception 7 (CPT6) and 6 (CPT7).
    overruns:     messages lost to a character overrun (CPT8); Linux tells nobody which: it stays 0.
    events:       section 6.9: messages carried out without an exception, function 11 not counted.
    """

    bus_messages: int = 0
    bus_errors: int = 0
    exceptions: int = 0
    messages: int = 0
    unanswered: int = 0
    naks: int = 0
    busy: int = 0
    overruns: int = 0
    events: int = 0
    listen_only: bool = False
    log: deque[int] = field(default_factory=lambda: deque(maxlen=EVENTS_KEPT))  # newest first

    def heard(self) -> None:
        """An undamaged message was on the line."""
        self.bus_messages = (self.bus_messages + 1) % COUNTER_LIMIT

    def heard_damaged(self) -> None:
        """A damaged message was on the line."""
        self.bus_errors = (self.bus_errors + 1) % COUNTER_LIMIT
        self.log.appendleft(RECEIVED | RECEIVED_DAMAGED | self._mode())

    def received(self, broadcast: bool) -> None:
        """A message for this slave is about to be carried out."""
        self.messages = (self.messages + 1) % COUNTER_LIMIT
        self.log.appendleft(RECEIVED | (RECEIVED_BROADCAST if broadcast else 0) | self._mode())

    def carried_out(self, function: int, exception: int, answered: bool) -> None:
        """The message with *function* was carried out, or earned *exception* (0: none); *answered* or not."""
        if exception:
            self.exceptions = (self.exceptions + 1) % COUNTER_LIMIT
            self.naks = (self.naks + (exception == 7 and answered)) % COUNTER_LIMIT
            self.busy = (self.busy + (exception == ExceptionCode.SERVER_DEVICE_BUSY and answered)) % COUNTER_LIMIT
        elif function != 11 and not self.listen_only:
            self.events = (self.events + 1) % COUNTER_LIMIT
        if not answered:
            self.unanswered = (self.unanswered + 1) % COUNTER_LIMIT
        self.log.appendleft(SENT | (SENT_EXCEPTION.get(exception, 0) if answered else 0) | self._mode())

    def clear(self) -> None:
        """Set every counter to 0 (sub-functions 1 and 10)."""
        for name in (*COUNTERS.values(), "events"):
            setattr(self, name, 0)

    def _mode(self) -> int:
        return LISTENING_ONLY if self.listen_only else 0


@dataclass(frozen=True)
class LineReply:
    """A reply PDU, whether it is sent at all, and what is done after it has been counted."""

    reply: bytes
    silent: bool = False
    then: Callable[[], None] = lambda: None


def carry_out(pdu: bytes, line: LineDiagnostics, server_id: bytes, exception_status: int) -> LineReply:
    """Return the reply to *pdu*, whose function is one of LINE_FUNCTIONS.

    server_id: what function 17 tells after the run indicator; exception_status: the 8 outputs of function 7.
    raises:    RequestRefused(1): unknown sub-function, RequestRefused(3): wrong length or data.
    """
    function = pdu[:1]
    if pdu[0] == 8:
        return _diagnose(pdu, line)
    if len(pdu) != 1:
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_VALUE)
    if pdu[0] == 7:
        return LineReply(function + bytes([exception_status]))
    if pdu[0] == 11:
        return LineReply(function + pack_words([READY, line.events]))
    if pdu[0] == 12:
        log = bytes(line.log)
        counted = pack_words([READY, line.events, line.bus_messages])
        return LineReply(function + bytes([len(counted) + len(log)]) + counted + log)
    text = server_id[:1] + bytes([RUNNING]) + server_id[1:]
    return LineReply(function + bytes([len(text)]) + text)


def _diagnose(pdu: bytes, line: LineDiagnostics) -> LineReply:
    """Function 8, section 6.8: sub-functions 0, 1, 2, 4 and 10 to 18."""
    if len(pdu) < 3:
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_VALUE)
    sub, data = word_at(pdu[1:3], 0), pdu[3:]
    if sub not in (RETURN_QUERY_DATA, RESTART, RETURN_REGISTER, FORCE_LISTEN_ONLY, CLEAR, *COUNTERS):
        raise RequestRefused(ExceptionCode.ILLEGAL_FUNCTION)
    if sub == RETURN_QUERY_DATA:
        if not data or len(data) % 2:
            raise RequestRefused(ExceptionCode.ILLEGAL_DATA_VALUE)
        return LineReply(pdu)
    value = word_at(data, 0)
    if len(data) != 2 or (value and not (sub == RESTART and value == CLEAR_LOG)):
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_VALUE)
    if sub == RESTART:
        return LineReply(pdu, silent=line.listen_only, then=lambda: _restart(line, value == CLEAR_LOG))
    if sub == FORCE_LISTEN_ONLY:
        return LineReply(b"", silent=True, then=lambda: _listen_only(line))
    if sub == CLEAR:
        return LineReply(pdu, then=line.clear)
    counted = 0 if sub == RETURN_REGISTER else getattr(line, COUNTERS[sub])
    return LineReply(pdu[:1] + pack_words([sub, counted]))


def _restart(line: LineDiagnostics, clear_log: bool) -> None:
    """All counters begin anew, and listening only ends; the event is all that is left of a cleared log."""
    line.clear()
    line.listen_only = False
    if clear_log:
        line.log.clear()
    line.log.appendleft(RESTARTED)


def _listen_only(line: LineDiagnostics) -> None:
    line.listen_only = True
    line.log.appendleft(ENTERED_LISTEN_ONLY)
