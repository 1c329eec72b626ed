"""What a slave (server) answers: one request in, one reply out, on a register.

Pure but for the register: the whole behaviour of a slave can be tested with bytes alone, and the serial and the TCP
driver share it. Units, frames and broadcasts are the driver's affair.

Order of checks (spec section 3): function code (else exception 1), quantity and length (else 3), address range without
wrap-around (else 2), value (else 3). A refused request changes nothing.

Source: MODBUS Application Protocol V1.1b3, sections 6 and 7.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

from gateway.counters import ServeCounters
from gateway.errors import QueueFull, RequestRefused
from gateway.modbus.pdu import (
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
)
from gateway.register import DataRegister, Source

READING: Final = frozenset({1, 2, 3, 4})
WRITING: Final = frozenset({5, 6, 15, 16, 22, 23})


@dataclass
class Server:
    """What one slave serves, and to whom.

    source:    who is asking: stamped on every point it writes.
    functions: what is answered; empty: everything.
    first, count: the window of points served in each table; count 0: to the end of the table.
    stale:     "exception" answers 0x0B instead of a polled point that is bad, stale or never read.
    """

    register: DataRegister
    source: Source
    writable: bool = True
    stale: Literal["serve", "exception"] = "serve"
    functions: frozenset[int] = frozenset()
    first: int = 0
    count: int = 0
    counters: ServeCounters = field(default_factory=ServeCounters)

    def serves(self, function: int) -> bool:
        """Return whether *function* is answered at all."""
        if function in WRITING and not self.writable:
            return False
        return function in READING | WRITING and (not self.functions or function in self.functions)


def answer(request: bytes, server: Server) -> bytes:
    """Return the reply to *request*.

    request: a PDU, function code and body, 1 to 253 bytes.
    returns: a PDU: the reply, or an exception reply (section 7).
    """
    server.counters.requests += 1
    try:
        reply = _reply(request, server)
    except RequestRefused as refused:
        server.counters.exceptions[refused.code] += 1
        return exception_reply(request[0] if request else 0, refused.code)
    server.counters.good += 1
    return reply


def _reply(pdu: bytes, server: Server) -> bytes:
    if not pdu or not server.serves(pdu[0]):
        raise RequestRefused(ExceptionCode.ILLEGAL_FUNCTION)
    request = decode_request(pdu)
    try:
        return encode_reply(request, _carry_out(request, server))
    except QueueFull:
        raise RequestRefused(ExceptionCode.SERVER_DEVICE_BUSY) from None


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
