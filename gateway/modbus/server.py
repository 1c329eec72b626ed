"""What a slave (server) answers: one request in, one reply out, on a register.

Pure but for the register: the whole behaviour of a slave can be tested with bytes alone, and the serial and the TCP
driver share it. Units and frames are the driver's affair.

Order of checks (spec section 3): function code (else exception 1), quantity and length (else 3), address range without
wrap-around (else 2), value (else 3). A refused request changes nothing.

Source: MODBUS Application Protocol V1.1b3, sections 6 and 7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Literal

from gateway.counters import ServeCounters
from gateway.errors import PointUnknown, QueueFull, RequestRefused
from gateway.modbus.diagnostics import LINE_FUNCTIONS, LineDiagnostics, LineReply, carry_out
from gateway.modbus.identification import Identity, read_device_identification
from gateway.modbus.pdu import (
    FIFO_MAX,
    TABLE_OF,
    ExceptionCode,
    MaskWriteRequest,
    ReadRequest,
    ReadWriteRequest,
    Request,
    Span,
    Table,
    WriteRequest,
    decode_request,
    encode_reply,
    exception_reply,
    pack_words,
    word_at,
)
from gateway.register import DataRegister, Source

READING: Final = frozenset({1, 2, 3, 4, 24, 43})
WRITING: Final = frozenset({5, 6, 15, 16, 22, 23})
READ_FIFO: Final = 24
IDENTIFY: Final = 43


@dataclass
class Server:
    """What one slave serves, and to whom.

    source:    who is asking: stamped on every point it writes.
    functions: what is answered; empty: everything.
    first, count: the window of points served in each table; count 0: to the end of the table.
    stale:     "exception" answers 0x0B instead of a polled point that is bad, stale or never read.
    line:      the serial line's counters and log; None on Modbus TCP, where functions 7, 8, 11, 12 and 17 are unknown.
    exception_status: the 8 outputs of function 7.
    read_fifo: gives the registers of the queue at an address, at most 31, or None where there is no queue.
    """

    register: DataRegister
    source: Source
    writable: bool = True
    stale: Literal["serve", "exception"] = "serve"
    functions: frozenset[int] = frozenset()
    first: int = 0
    count: int = 0
    counters: ServeCounters = field(default_factory=ServeCounters)
    identity: Identity = field(default_factory=Identity)
    line: LineDiagnostics | None = None
    exception_status: Callable[[], int] = lambda: 0
    read_fifo: Callable[[int], list[int] | None] = lambda address: None  # noqa: ARG005 - there is no queue anywhere

    def serves(self, function: int) -> bool:
        """Return whether *function* is answered at all."""
        if function in WRITING and not self.writable:
            return False
        if function in LINE_FUNCTIONS and self.line is None:
            return False
        return function in READING | WRITING | LINE_FUNCTIONS and (not self.functions or function in self.functions)


def answer(request: bytes, server: Server, broadcast: bool = False) -> bytes:
    """Return the reply to *request*.

    request:   a PDU, function code and body, 1 to 253 bytes.
    broadcast: it was for everybody: the caller throws the reply away, and the line counts it as unanswered.
    returns:   a PDU: the reply, or an exception reply (section 7); b"" where the line listens only (section 6.8).
    """
    server.counters.requests += 1
    line, function = server.line, request[0] if request else 0
    if line is not None:
        line.received(broadcast)
    outcome, code = LineReply(b""), 0
    try:
        if line is not None and line.listen_only and request[:3] != b"\x08\x00\x01":
            outcome = LineReply(b"", silent=True)  # only a restart is carried out
        elif broadcast and function in READING:
            outcome = LineReply(b"", silent=True)  # nobody would see what was read, or taken out of the queue
        else:
            outcome = _outcome(request, server)
            server.counters.good += 1
    except RequestRefused as refused:
        code = refused.code
        outcome = LineReply(exception_reply(function, code), silent=line is not None and line.listen_only)
        server.counters.exceptions[code] += 1
    if line is not None:
        line.carried_out(function, code, answered=not (outcome.silent or broadcast))
    outcome.then()
    return b"" if outcome.silent else outcome.reply


def _outcome(request: bytes, server: Server) -> LineReply:
    """Return the whole reply to a request that is not refused."""
    if not request or not server.serves(request[0]):
        raise RequestRefused(ExceptionCode.ILLEGAL_FUNCTION)
    function = request[0]
    if server.line is not None and function in LINE_FUNCTIONS:
        return carry_out(request, server.line, server.identity.server_id, server.exception_status())
    if function == IDENTIFY:
        return LineReply(read_device_identification(request, server.identity))
    if function == READ_FIFO:
        return LineReply(_read_fifo(request, server))
    try:
        decoded = decode_request(request)
        return LineReply(encode_reply(decoded, _carry_out(decoded, server)))
    except QueueFull:
        raise RequestRefused(ExceptionCode.SERVER_DEVICE_BUSY) from None
    except PointUnknown:
        raise RequestRefused(ExceptionCode.SERVER_DEVICE_FAILURE) from None


def _read_fifo(request: bytes, server: Server) -> bytes:
    """Function 24, section 6.18: byte count, register count, registers."""
    if len(request) != 3:
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_VALUE)
    registers = server.read_fifo(word_at(request[1:], 0))
    if registers is None:
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_ADDRESS)
    if len(registers) > FIFO_MAX:
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_VALUE)
    return bytes([READ_FIFO]) + pack_words([2 + 2 * len(registers), len(registers), *registers])


def _carry_out(request: Request, server: Server) -> bytes:
    """Do what *request* asks; return what a read found."""
    span = _span(server, TABLE_OF[request.function], request.address, getattr(request, "quantity", 1))
    match request:
        case ReadRequest():
            return _read(server, span)
        case WriteRequest():
            if not request.value_allowed:
                raise RequestRefused(ExceptionCode.ILLEGAL_DATA_VALUE)
            server.register.write(span, request.data, server.source)
            return b""
        case MaskWriteRequest():
            server.register.mask_write(span, request.and_mask, request.or_mask, server.source)
            return b""
        case ReadWriteRequest():
            written = _span(server, span.table, request.write_address, request.write_quantity)
            _read(server, span)  # refused before anything changes
            server.register.write(written, request.data, server.source)
            return server.register.read(span)


def _span(server: Server, table: Table, start: int, count: int) -> Span:
    """Return the points asked for, if the window and the table have them all."""
    size = server.register.size(table)
    stop = min(size, server.first + server.count) if server.count else size
    if start < server.first or start + count > stop:
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_ADDRESS)
    return Span(table, start, count)


def _read(server: Server, span: Span) -> bytes:
    if server.stale == "serve":
        return server.register.read(span)
    data = server.register.read_fresh(span)
    if data is None:
        raise RequestRefused(ExceptionCode.GATEWAY_TARGET_FAILED)
    return data
