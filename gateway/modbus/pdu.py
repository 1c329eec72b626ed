"""Modbus requests and replies, to and from bytes.

Pure: bytes in, values out. It knows nothing of units, checksums, lines or time (see ``framing``), and decides nothing
that depends on a register (see ``server``). A reply is only ever decoded against its request.

Data is kept as it goes on the wire and in the register: words big-endian, bits packed with the first in the lowest bit.

Source: MODBUS Application Protocol Specification V1.1b3; section numbers below are its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from gateway.errors import DeviceRefused, ReplyMismatch, RequestInvalid, RequestRefused

ADDRESSES: Final = 65536  # section 4.4: PDU addresses are 0 to 65535
PDU_MAX: Final = 253  # section 4.1: bytes, function code included
EXCEPTION_BIT: Final = 0x80  # section 7
COIL_ON: Final = 0xFF00  # section 6.5
COIL_OFF: Final = 0x0000
FIFO_MAX: Final = 31  # registers, section 6.18
BROADCAST: Final = 0  # serial line guide V1.02, section 2.2


class Table(IntEnum):
    """The four tables, numbered by the code of the function that reads them."""

    COILS = 1
    DISCRETE_INPUTS = 2
    HOLDING_REGISTERS = 3
    INPUT_REGISTERS = 4

    @property
    def is_bits(self) -> bool:
        """True for coils and discrete inputs: one bit a point; False: 16 bits a point."""
        return self <= Table.DISCRETE_INPUTS


class Function(IntEnum):
    """The functions that move data, with the section that defines each."""

    READ_COILS = 1  # 6.1
    READ_DISCRETE_INPUTS = 2  # 6.2
    READ_HOLDING_REGISTERS = 3  # 6.3
    READ_INPUT_REGISTERS = 4  # 6.4
    WRITE_SINGLE_COIL = 5  # 6.5
    WRITE_SINGLE_REGISTER = 6  # 6.6
    WRITE_MULTIPLE_COILS = 15  # 6.11
    WRITE_MULTIPLE_REGISTERS = 16  # 6.12
    MASK_WRITE_REGISTER = 22  # 6.16
    READ_WRITE_MULTIPLE_REGISTERS = 23  # 6.17


class ExceptionCode(IntEnum):
    """Section 7."""

    ILLEGAL_FUNCTION = 1
    ILLEGAL_DATA_ADDRESS = 2
    ILLEGAL_DATA_VALUE = 3
    SERVER_DEVICE_FAILURE = 4
    ACKNOWLEDGE = 5
    SERVER_DEVICE_BUSY = 6
    MEMORY_PARITY_ERROR = 8
    GATEWAY_PATH_UNAVAILABLE = 10
    GATEWAY_TARGET_FAILED = 11


READS: Final = frozenset({1, 2, 3, 4})
WRITES: Final = frozenset({5, 6, 15, 16})

# The most points of one request, by function code: sections 6.1 to 6.4, 6.11, 6.12.
QUANTITY_LIMITS: Final[dict[int, int]] = {
    1: 2000,
    2: 2000,
    3: 125,
    4: 125,
    5: 1,
    6: 1,
    15: 1968,
    16: 123,
}
READ_WRITE_READ_LIMIT: Final = 125  # section 6.17
READ_WRITE_WRITE_LIMIT: Final = 121

# Bytes after the function code: sections 6.7, 6.8 (one word of data), 6.9, 6.10, 6.13, 6.18, 6.21.
PLAIN_BODY_SIZES: Final[dict[int, int]] = {7: 0, 8: 4, 11: 0, 12: 0, 17: 0, 24: 2, 43: 3}

TABLE_OF: Final[dict[int, Table]] = {
    1: Table.COILS,
    2: Table.DISCRETE_INPUTS,
    3: Table.HOLDING_REGISTERS,
    4: Table.INPUT_REGISTERS,
    5: Table.COILS,
    6: Table.HOLDING_REGISTERS,
    15: Table.COILS,
    16: Table.HOLDING_REGISTERS,
    22: Table.HOLDING_REGISTERS,
    23: Table.HOLDING_REGISTERS,
}


@dataclass(frozen=True, slots=True)
class Span:
    """*count* points of one table from *start*; PDU addresses or points, both count from 0."""

    table: Table
    start: int
    count: int

    @property
    def stop(self) -> int:
        """The first point after the span."""
        return self.start + self.count

    @property
    def size(self) -> int:
        """Bytes its data takes on the wire."""
        return (self.count + 7) // 8 if self.table.is_bits else 2 * self.count

    def overlaps(self, other: Span) -> bool:
        """True if both name at least one same point."""
        return self.table is other.table and self.start < other.stop and other.start < self.stop


@dataclass(frozen=True, slots=True)
class ReadRequest:
    """Functions 1 to 4: *quantity* points from *address*."""

    function: int
    address: int
    quantity: int


@dataclass(frozen=True, slots=True)
class WriteRequest:
    """Functions 5, 6, 15 and 16: *data* to *quantity* points from *address*.

    data:          packed bits or big-endian words, also for the single writes (one bit in one byte, one word).
    value_allowed: False only on a decoded request whose coil value is neither 0xFF00 nor 0x0000: its address has to
                   be judged before its value, so decoding cannot refuse it yet.
    """

    function: int
    address: int
    quantity: int
    data: bytes
    value_allowed: bool = True


@dataclass(frozen=True, slots=True)
class MaskWriteRequest:
    """Function 22: register = (register AND and_mask) OR (or_mask AND NOT and_mask)."""

    address: int
    and_mask: int
    or_mask: int
    function: int = Function.MASK_WRITE_REGISTER


@dataclass(frozen=True, slots=True)
class ReadWriteRequest:
    """Function 23: *data* is written to *write_address* first, then the read is done."""

    address: int
    quantity: int
    write_address: int
    write_quantity: int
    data: bytes
    function: int = Function.READ_WRITE_MULTIPLE_REGISTERS


@dataclass(frozen=True, slots=True)
class PlainRequest:
    """Functions 7, 8, 11, 12, 17, 24 and 43, for commands of the master: *body* is all after the function code."""

    function: int
    body: bytes = b""


Request = ReadRequest | WriteRequest | MaskWriteRequest | ReadWriteRequest  # moves data
AnyRequest = Request | PlainRequest


# ------------------------------------------------------------------------------------------------ bits and words


def pack_bits(bits: list[bool]) -> bytes:
    """Return *bits* as on the wire: eight a byte, the first in the lowest bit, the rest zero."""
    number = sum(1 << i for i, bit in enumerate(bits) if bit)
    return number.to_bytes((len(bits) + 7) // 8, "little")


def pack_words(words: list[int]) -> bytes:
    """Return *words* (0 to 65535 each) as on the wire: big-endian."""
    return b"".join(word.to_bytes(2, "big") for word in words)


def bit_at(data: bytes, index: int) -> bool:
    """Return bit *index* of packed bits."""
    return bool(data[index // 8] >> (index % 8) & 1)


def word_at(data: bytes, index: int) -> int:
    """Return word *index* of big-endian words, 0 to 65535."""
    return int.from_bytes(data[2 * index : 2 * index + 2], "big")


# ------------------------------------------------------------------------------------------------ requests


def encode_request(request: AnyRequest) -> bytes:
    """Return the PDU of *request*: function code and body, 5 to 253 bytes.

    raises: RequestInvalid where a limit of sections 6.1 to 6.17 is broken: nothing wrong ever leaves the house.
    """
    check_request(request)
    match request:
        case ReadRequest():
            return _header(request.function, request.address, request.quantity)
        case WriteRequest(function=Function.WRITE_SINGLE_COIL):
            on = COIL_ON if request.data[0] & 1 else COIL_OFF
            return _header(request.function, request.address, on)
        case WriteRequest(function=Function.WRITE_SINGLE_REGISTER):
            return bytes([request.function]) + _word(request.address) + request.data
        case WriteRequest():
            header = _header(request.function, request.address, request.quantity)
            return header + bytes([len(request.data)]) + request.data
        case MaskWriteRequest():
            return _header(request.function, request.address, request.and_mask) + _word(request.or_mask)
        case ReadWriteRequest():
            return (
                _header(request.function, request.address, request.quantity)
                + _word(request.write_address)
                + _word(request.write_quantity)
                + bytes([len(request.data)])
                + request.data
            )
        case PlainRequest():
            return bytes([request.function]) + request.body


def check_request(request: AnyRequest) -> None:
    """Raise RequestInvalid, in words, unless *request* keeps every limit of the specification."""
    match request:
        case ReadRequest():
            if request.function not in READS:
                raise RequestInvalid(f"function {request.function} is no read (1, 2, 3, 4)")
            _check_range(request.address, request.quantity, QUANTITY_LIMITS[request.function])
        case WriteRequest():
            if request.function not in WRITES:
                raise RequestInvalid(f"function {request.function} is no write (5, 6, 15, 16)")
            _check_range(request.address, request.quantity, QUANTITY_LIMITS[request.function])
            _check_size(request.data, Span(TABLE_OF[request.function], 0, request.quantity))
        case MaskWriteRequest():
            _check_range(request.address, 1, 1)
            for mask in (request.and_mask, request.or_mask):
                if not 0 <= mask <= 0xFFFF:
                    raise RequestInvalid(f"mask {mask} is not within 0 to 65535")
        case ReadWriteRequest():
            _check_range(request.address, request.quantity, READ_WRITE_READ_LIMIT)
            _check_range(request.write_address, request.write_quantity, READ_WRITE_WRITE_LIMIT)
            _check_size(request.data, Span(Table.HOLDING_REGISTERS, 0, request.write_quantity))
        case PlainRequest():
            if PLAIN_BODY_SIZES.get(request.function) != len(request.body):
                raise RequestInvalid(f"function {request.function} with {len(request.body)} bytes is no request")


def _check_range(address: int, quantity: int, limit: int) -> None:
    if not 1 <= quantity <= limit:
        raise RequestInvalid(f"quantity {quantity} is not within 1 to {limit}")
    if not 0 <= address < ADDRESSES:
        raise RequestInvalid(f"address {address} is not within 0 to {ADDRESSES - 1}")
    if address + quantity > ADDRESSES:
        raise RequestInvalid(f"address {address} and quantity {quantity} end beyond 65535")


def _check_size(data: bytes, span: Span) -> None:
    if len(data) != span.size:
        raise RequestInvalid(f"{span.count} points take {span.size} bytes, not {len(data)}")


def decode_request(pdu: bytes) -> Request:
    """Return the request in *pdu*: function code and body, unit and checksum already gone.

    Checked here: function code, then quantity and length, byte count included. Left to the server, which alone can
    tell: whether the addresses exist (a range that wraps around included), then the value of a coil.
    raises: RequestRefused(1) for a function it does not know, RequestRefused(3) for a wrong quantity or length.
    """
    function = pdu[0] if pdu else 0
    decode = _DECODERS.get(function)
    if decode is None:
        raise RequestRefused(ExceptionCode.ILLEGAL_FUNCTION)
    return decode(function, pdu)


def _decode_read(function: int, pdu: bytes) -> ReadRequest:
    _demand(len(pdu) == 5)
    quantity = word_at(pdu[3:], 0)
    _demand(1 <= quantity <= QUANTITY_LIMITS[function])
    return ReadRequest(function, word_at(pdu[1:], 0), quantity)


def _decode_single(function: int, pdu: bytes) -> WriteRequest:
    _demand(len(pdu) == 5)
    address, value = word_at(pdu[1:], 0), word_at(pdu[1:], 1)
    if function == Function.WRITE_SINGLE_REGISTER:
        return WriteRequest(function, address, 1, pdu[3:5])
    on = b"\x01" if value == COIL_ON else b"\x00"
    return WriteRequest(function, address, 1, on, value_allowed=value in (COIL_ON, COIL_OFF))


def _decode_multiple(function: int, pdu: bytes) -> WriteRequest:
    _demand(len(pdu) >= 6)
    address, quantity, data = word_at(pdu[1:], 0), word_at(pdu[1:], 1), pdu[6:]
    _demand(1 <= quantity <= QUANTITY_LIMITS[function])
    _demand(pdu[5] == len(data) == Span(TABLE_OF[function], 0, quantity).size)
    return WriteRequest(function, address, quantity, data)


def _decode_mask(function: int, pdu: bytes) -> MaskWriteRequest:
    _demand(len(pdu) == 7)
    return MaskWriteRequest(word_at(pdu[1:], 0), word_at(pdu[1:], 1), word_at(pdu[1:], 2), function)


def _decode_read_write(function: int, pdu: bytes) -> ReadWriteRequest:
    _demand(len(pdu) >= 10)
    address, quantity, write_address, write_quantity = (word_at(pdu[1:9], i) for i in range(4))
    data = pdu[10:]
    _demand(1 <= quantity <= READ_WRITE_READ_LIMIT)
    _demand(1 <= write_quantity <= READ_WRITE_WRITE_LIMIT)
    _demand(pdu[9] == len(data) == 2 * write_quantity)
    return ReadWriteRequest(address, quantity, write_address, write_quantity, data, function)


_DECODERS: Final[dict[int, Callable[[int, bytes], Request]]] = {
    **dict.fromkeys(READS, _decode_read),
    **dict.fromkeys((5, 6), _decode_single),
    **dict.fromkeys((15, 16), _decode_multiple),
    22: _decode_mask,
    23: _decode_read_write,
}


def _demand(condition: bool) -> None:
    """Refuse the request with exception 3 unless its quantity and length are right."""
    if not condition:
        raise RequestRefused(ExceptionCode.ILLEGAL_DATA_VALUE)


# ------------------------------------------------------------------------------------------------ replies


def encode_reply(request: Request, data: bytes = b"") -> bytes:
    """Return the PDU that answers *request*; *data* is what a read found, b"" for a write."""
    if isinstance(request, ReadRequest | ReadWriteRequest):
        return bytes([request.function, len(data)]) + data
    return _echo(request)


def exception_reply(function: int, code: int) -> bytes:
    """Return the two bytes that refuse *function* with exception *code* (section 7)."""
    return bytes([(function | EXCEPTION_BIT) & 0xFF, code])


def decode_reply(request: AnyRequest, pdu: bytes) -> bytes:
    """Return the data that *pdu* carries in answer to *request*.

    pdu:     function code and body, 1 to 253 bytes; unit and checksum already gone.
    returns: big-endian words or packed bits as on the wire, unused bits cleared; b"" for a write; all after the
             function code for a ``PlainRequest``.
    raises:  ReplyMismatch (answer to another question), DeviceRefused (exception reply).
    source:  sections 6.1 to 6.17 and 7.
    """
    if len(pdu) == 2 and pdu[0] == request.function | EXCEPTION_BIT:
        if pdu[1] == 0:  # no exception has this code, and to the callers 0 means no error
            raise ReplyMismatch("an exception reply without an exception code")
        raise DeviceRefused(pdu[1])
    if not pdu or pdu[0] != request.function:
        raise ReplyMismatch(f"a reply to function {pdu[0] if pdu else None}")
    if isinstance(request, ReadRequest | ReadWriteRequest):
        return _decode_data(request, pdu)
    if isinstance(request, PlainRequest):
        if len(pdu) != pdu_length(REPLY_SHAPES, pdu) or not _answers(request, pdu[1:]):
            raise ReplyMismatch(f"no reply to function {request.function} as it was asked")
        return pdu[1:]
    if pdu != _echo(request):
        raise ReplyMismatch("the reply does not repeat address and value of the request")
    return b""


def _decode_data(request: ReadRequest | ReadWriteRequest, pdu: bytes) -> bytes:
    span = Span(TABLE_OF[request.function], 0, request.quantity)
    data = pdu[2:]
    if len(pdu) < 2 or pdu[1] != len(data) or len(data) != span.size:
        raise ReplyMismatch(f"{len(data)} bytes of data where {span.size} were asked for")
    used = request.quantity % 8
    if span.table.is_bits and used:
        return data[:-1] + bytes([data[-1] & (1 << used) - 1])
    return data


def _answers(request: PlainRequest, body: bytes) -> bool:
    """True if *body*, of the length that it says it has, repeats what it must and its counts agree."""
    if request.function == 24:  # section 6.18: the bytes that follow, then how many registers they are
        return word_at(body, 0) == len(body) - 2 == 2 + 2 * word_at(body, 1) <= 2 + 2 * FIFO_MAX
    repeated = {8: 2, 43: 2}.get(request.function, 0)  # sub-function; MEI type and code
    if request.function == 8 and request.body[:2] == bytes(2):  # section 6.8.1: return query data
        repeated = 4
    return body[:repeated] == request.body[:repeated]


def _echo(request: WriteRequest | MaskWriteRequest) -> bytes:
    """What a device repeats of a write: all of it, or without the data of a multiple write."""
    return encode_request(request)[: 7 if isinstance(request, MaskWriteRequest) else 5]


def _header(function: int, first: int, second: int) -> bytes:
    return bytes([function]) + _word(first) + _word(second)


def _word(value: int) -> bytes:
    return value.to_bytes(2, "big")


# ------------------------------------------------------------------------------------------------ lengths


@dataclass(frozen=True, slots=True)
class Shape:
    """How long a PDU is: *fixed* bytes, and as many more as the byte at *count_at* says.

    objects: after *fixed* bytes come as many objects as the last of them says, each with a number and a length.
    """

    fixed: int
    count_at: int | None = None
    objects: bool = False


# Sections 6.1 to 6.21. Where a function is missing, only silence can tell where its frame ends.
REQUEST_SHAPES: Final[dict[int, Shape]] = {
    **dict.fromkeys((1, 2, 3, 4, 5, 6, 8), Shape(5)),
    **dict.fromkeys((7, 11, 12, 17), Shape(1)),
    **dict.fromkeys((15, 16), Shape(6, 5)),
    **dict.fromkeys((20, 21), Shape(2, 1)),
    22: Shape(7),
    23: Shape(10, 9),
    24: Shape(3),
    43: Shape(4),
}
REPLY_SHAPES: Final[dict[int, Shape]] = {
    **dict.fromkeys((1, 2, 3, 4, 12, 17, 20, 21, 23), Shape(2, 1)),
    **dict.fromkeys((5, 6, 8, 11, 15, 16), Shape(5)),
    7: Shape(2),
    22: Shape(7),
    24: Shape(3, 2),
    43: Shape(7, objects=True),
    **{function | EXCEPTION_BIT: Shape(2) for function in range(1, 128)},
}


def pdu_length(shapes: dict[int, Shape], pdu: bytes | bytearray) -> int | None:
    """Return how many bytes the PDU that begins with *pdu* has, or at least has while its byte count is not there.

    returns: None where the function's length is not known, or *pdu* is empty.
    """
    shape = shapes.get(pdu[0]) if pdu else None
    if shape is None:
        return None
    if shape.objects:
        return _length_with_objects(shape.fixed, pdu)
    if shape.count_at is None:
        return shape.fixed
    return shape.fixed + (pdu[shape.count_at] if len(pdu) > shape.count_at else 0)


def _length_with_objects(end: int, pdu: bytes | bytearray) -> int:
    """Return where the objects of section 6.21 that begin at *end* end, or as far as can be told."""
    for _ in range(pdu[end - 1] if len(pdu) >= end else 0):
        if len(pdu) < end + 2:
            return end + 2
        end += 2 + pdu[end + 1]
    return end
