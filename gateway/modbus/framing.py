"""Modbus frames, out of a byte stream and back: RTU, ASCII and TCP.

Pure: bytes in, frames out; no ports, no clock. Silence, which ends an RTU frame, is told to a framer by whoever has the
clock (``silence()`` and ``reset()``). No bytes, however cut, make a framer raise, or keep more than ``HELD_MAX``.

One class serves both directions where the frame says where it ends (ASCII, TCP). RTU does not, so it has two: the
slave's ear hears everything on a shared pair of wires, the master's ear waits for one reply.

Source: Modbus over Serial Line V1.02 (sections 2.5.1 RTU, 2.5.2 ASCII) and Modbus Messaging on TCP/IP V1.0b (3.1.3).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, Protocol

from gateway.modbus.pdu import EXCEPTION_BIT, PDU_MAX, REPLY_SHAPES, REQUEST_SHAPES, pdu_length

Framing = Literal["rtu", "ascii", "tcp"]

UNIT_MAX: Final = 247  # serial line guide, section 2.2; above is reserved
RTU_MIN: Final = 4  # unit, function, CRC
RTU_MAX: Final = 256  # serial line guide, section 2.5.1.1
ASCII_MAX: Final = 513  # section 2.5.2.1: colon, 2 x 255, CR LF
TCP_HEADER: Final = 7  # transaction, protocol, length, unit
TCP_LENGTH_MIN: Final = 2  # unit and function
TCP_LENGTH_MAX: Final = 254  # unit and 253 bytes of PDU
NOISE_MAX: Final = 2  # bytes that a turning RS-485 driver may put before a frame
HELD_MAX: Final = 4096  # bytes kept of a stream that makes no sense
FALSE_STARTS_MAX: Final = 128  # looked behind while one reply is awaited; each may cost the CRC of a long frame


@dataclass(frozen=True, slots=True)
class Frame:
    """One message: who it is for or from, and what it says.

    unit: 0 to 255; pdu: 1 to 253 bytes; transaction: 0 to 65535, TCP only.
    """

    unit: int
    pdu: bytes
    transaction: int = 0


class Framer(Protocol):
    """What a driver needs of a framing. ``damaged`` counts what was thrown away with a wrong checksum or form."""

    damaged: int

    @property
    def pending(self) -> int:
        """Bytes held that are not a whole frame yet."""
        ...

    @property
    def broken(self) -> bool:
        """True when the stream cannot be trusted any more and has to be closed (TCP only)."""
        ...

    def encode(self, frame: Frame) -> bytes:
        """Return the bytes of *frame* as they go on the wire."""
        ...

    def expect(self, unit: int, function: int) -> None:
        """Wait for the reply of *unit* to *function*; forgets everything held."""
        ...

    def receive_data(self, data: bytes) -> None:
        """Take what has come, in pieces of any size."""
        ...

    def next_frame(self) -> Frame | None:
        """Return the next whole, undamaged frame, or None."""
        ...

    def silence(self) -> None:
        """The line was silent for 3.5 characters (slave) or the character timeout (master)."""
        ...

    def reset(self) -> None:
        """Throw away everything held: the next byte is the first of a frame."""
        ...


# ------------------------------------------------------------------------------------------------ checksums


def _crc_table() -> tuple[int, ...]:
    """Serial line guide, appendix B: polynomial 0xA001, one entry for each byte."""
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
        table.append(crc)
    return tuple(table)


_CRC_TABLE: Final = _crc_table()


def crc16(data: bytes | bytearray | memoryview) -> int:
    """Return the CRC of *data*, 0 to 65535; its low byte goes on the wire first."""
    crc = 0xFFFF
    table = _CRC_TABLE
    for byte in data:
        crc = crc >> 8 ^ table[(crc ^ byte) & 0xFF]
    return crc


def lrc8(data: bytes) -> int:
    """Return the LRC of *data*, 0 to 255: the sum of all bytes and the LRC is 0 (section 2.5.2.2)."""
    return -sum(data) & 0xFF


def encode_rtu(frame: Frame) -> bytes:
    """Return unit, PDU and CRC."""
    body = bytes([frame.unit]) + frame.pdu
    return body + crc16(body).to_bytes(2, "little")


def _good_crc(data: bytes | bytearray, start: int, stop: int) -> bool:
    return crc16(memoryview(data)[start : stop - 2]) == data[stop - 2] | data[stop - 1] << 8


def _cut(data: bytes | bytearray, start: int, stop: int) -> Frame:
    return Frame(data[start], bytes(data[start + 1 : stop - 2]))


# ------------------------------------------------------------------------------------------------ RTU, slave's ear


class RtuRequestFramer:
    """Every frame on a shared pair of wires, requests and replies alike, as a slave hears them.

    Frames are found by length and confirmed by silence: nothing is decided before ``silence()`` was called. What
    has come by then is read from its start, frame by frame; the CRC tells a request from a reply where both have the
    same function. Where that does not come out even: the whole may be one frame (functions whose length only silence
    tells, requests that are too long or too short), or its end may be one. What makes no sense is kept, because more
    of it may come, until ``reset()``; or until a whole request stands at its end, or all since the last silence is a
    frame. A byte or two of noise before a request may look like the start of something longer, and count as damage,
    too.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._held = bytearray()
        self._frames: deque[Frame] = deque()
        self._is_counted = False  # what is held has been counted as damaged
        self._burst = 0  # where in what is held began what has come since the last silence

    broken = False

    @property
    def pending(self) -> int:
        return len(self._held)

    def encode(self, frame: Frame) -> bytes:
        return encode_rtu(frame)

    def expect(self, unit: int, function: int) -> None:  # noqa: ARG002 - a slave waits for anything
        self.reset()

    def receive_data(self, data: bytes) -> None:
        self._held += data
        if len(self._held) > HELD_MAX:  # a line that never rests: nothing in it can be for us
            self.damaged += 1
            del self._held[:-RTU_MAX]
            self._burst = 0

    def next_frame(self) -> Frame | None:
        return self._frames.popleft() if self._frames else None

    def silence(self) -> None:
        """Turn what has come into frames; see the class."""
        held, position = self._held, 0
        frames: list[Frame] = []
        while (stop := self._frame_end(position)) is not None:
            frames.append(_cut(held, position, stop))
            position = stop
        rest = len(held) - position
        if rest and _is_frame(held, position):
            frames.append(_cut(held, position, len(held)))
            rest = 0
        elif rest:
            is_lost = self._is_lost(position)
            last = self._last_frame(position, len(held) if is_lost else position + NOISE_MAX)
            if last or (is_lost and self._ends(position)):
                self._count_damage()
            if last:
                frames += last
                rest = 0
        del held[: len(held) - rest]
        self._is_counted &= rest > 0
        self._burst = rest
        self._frames += frames

    def reset(self) -> None:
        if self._held:
            self._count_damage()
        self._held.clear()
        self._is_counted = False
        self._burst = 0

    def _count_damage(self) -> None:
        """What is held is damaged: that counts once, however long it is held."""
        self.damaged += not self._is_counted
        self._is_counted = True

    def _frame_end(self, start: int) -> int | None:
        """Where the frame that begins at *start* ends, if it is whole and its CRC right."""
        for stop in self._ends(start):
            if stop <= len(self._held) and _good_crc(self._held, start, stop):
                return stop
        return None

    def _ends(self, start: int) -> list[int]:
        """Where a request, and where a reply, that begins at *start* would end, if not too long; shortest first."""
        head = self._held[start + 1 : start + 1 + PDU_MAX]
        lengths = (pdu_length(shapes, head) for shapes in (REQUEST_SHAPES, REPLY_SHAPES))
        return sorted({start + 1 + length + 2 for length in lengths if length and length <= PDU_MAX})

    def _is_lost(self, start: int) -> bool:
        """True if no more bytes can turn what begins at *start* into a frame."""
        if len(self._held) - start < 2:
            return False
        return all(stop <= len(self._held) for stop in self._ends(start))  # also where only silence tells the end

    def _last_frame(self, start: int, latest: int) -> list[Frame]:
        """The request at the very end of what has come, begun after *start* and not after *latest*; else nothing.

        What silence encloses may be any frame of a unit that there can be: FF FF 00 00, say, is noise with a right CRC.
        """
        held = self._held
        for first in range(max(start + 1, len(held) - RTU_MAX), min(latest, len(held) - RTU_MIN) + 1):
            length = pdu_length(REQUEST_SHAPES, held[first + 1 :])
            is_request = length and first + 1 + length + 2 == len(held)
            is_burst = first == self._burst and held[first] <= UNIT_MAX
            if (is_request or is_burst) and _is_frame(held, first):
                return [_cut(held, first, len(held))]
        return []


def _is_frame(data: bytearray, start: int) -> bool:
    """True if all of *data* from *start* is one frame with a right CRC."""
    return RTU_MIN <= len(data) - start <= RTU_MAX and _good_crc(data, start, len(data))


# ------------------------------------------------------------------------------------------------ RTU, master's ear


class RtuReplyFramer:
    """One reply, as a master waits for it (spec section 2).

    Bytes before the awaited unit are dropped; then comes the function, or it with the top bit set; then as many
    bytes as the function implies; then the CRC. Where that fails, the search goes on one byte later; not for ever:
    after ``FALSE_STARTS_MAX`` the line talks nonsense, and all that comes is dropped until ``expect``.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._held = bytearray()
        self._unit = -1
        self._function = -1
        self._false_starts = 0

    broken = False

    @property
    def pending(self) -> int:
        return len(self._held)

    def encode(self, frame: Frame) -> bytes:
        return encode_rtu(frame)

    def expect(self, unit: int, function: int) -> None:
        self._held.clear()
        self._unit, self._function = unit, function
        self._false_starts = 0

    def receive_data(self, data: bytes) -> None:
        self._held += data

    def next_frame(self) -> Frame | None:
        """Return the awaited unit's frame; what follows it stays ``pending``."""
        while self._to_next_start():
            stop = self._end()
            if len(self._held) < stop <= RTU_MAX:
                return None
            if stop <= RTU_MAX and _good_crc(self._held, 0, stop):
                frame = _cut(self._held, 0, stop)
                del self._held[:stop]
                return frame
            self._give_up_start()
        return None

    def silence(self) -> None:
        """What looked like the start of the reply was none: it goes no further."""
        if self._held:
            self._give_up_start()

    def reset(self) -> None:
        self._held.clear()

    def _give_up_start(self) -> None:
        self.damaged += 1
        self._false_starts += 1
        del self._held[: 1 if self._false_starts < FALSE_STARTS_MAX else None]

    def _to_next_start(self) -> bool:
        """Drop bytes up to the awaited unit and function; True if both are there."""
        held = self._held
        if self._false_starts >= FALSE_STARTS_MAX:
            held.clear()
        while held:
            start = held.find(self._unit) if self._unit >= 0 else -1
            del held[: start if start >= 0 else len(held)]
            if len(held) < 2:
                return False
            if held[1] & ~EXCEPTION_BIT == self._function:
                return True
            del held[0]
        return False

    def _end(self) -> int:
        """Where the frame ends, as far as can be told yet; a function without a length ends with what has come."""
        length = pdu_length(REPLY_SHAPES, self._held[1 : 1 + PDU_MAX])
        return 1 + length + 2 if length else max(len(self._held), RTU_MIN)


# ------------------------------------------------------------------------------------------------ ASCII


_HEX: Final = frozenset(b"0123456789ABCDEFabcdef")


class AsciiFramer:
    """Frames from a colon to CR LF, two hexadecimal characters a byte; both directions.

    What stands before a colon is dropped; a colon in a frame begins a new one. The master's reply is checked for its
    unit after ``expect``: frames of other units are skipped.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._held = bytearray()
        self._unit: int | None = None

    broken = False

    @property
    def pending(self) -> int:
        return len(self._held)

    def encode(self, frame: Frame) -> bytes:
        body = bytes([frame.unit]) + frame.pdu
        return b":" + (body + bytes([lrc8(body)])).hex().upper().encode() + b"\r\n"

    def expect(self, unit: int, function: int) -> None:  # noqa: ARG002 - the frame itself says where it ends
        self._held.clear()
        self._unit = unit

    def receive_data(self, data: bytes) -> None:
        self._held += data

    def next_frame(self) -> Frame | None:
        while (text := self._next_text()) is not None:
            frame = _decode_ascii(text)
            if frame is None:
                self.damaged += 1
            elif self._unit is None or frame.unit == self._unit:
                return frame
        return None

    def silence(self) -> None:
        """Nothing to do: CR LF ends a frame, and a pause of up to 1 s in it is allowed."""

    def reset(self) -> None:
        self.damaged += bool(self._held)
        self._held.clear()

    def _next_text(self) -> bytes | None:
        """Return what stands between the last colon before a CR LF and that; None where it has not come yet."""
        held = self._held
        end = held.find(b"\r\n")
        start = held.rfind(b":", 0, end) if end >= 0 else held.rfind(b":")
        if end >= 0:
            text = bytes(held[start + 1 : end]) if start >= 0 else b""
            del held[: end + 2]
            return text
        del held[: start if start >= 0 else len(held)]
        if len(held) > ASCII_MAX:
            self.reset()
        return None


def _decode_ascii(text: bytes) -> Frame | None:
    """Return the frame in the characters between colon and CR LF; None if form, length or LRC is wrong."""
    if len(text) % 2 or not 6 <= len(text) <= 2 * (PDU_MAX + 2) or not _HEX.issuperset(text):
        return None
    body = bytes.fromhex(text.decode("ascii"))
    return Frame(body[0], body[1:-1]) if sum(body) & 0xFF == 0 else None


# ------------------------------------------------------------------------------------------------ TCP


class TcpFramer:
    """Frames with an MBAP header; both directions.

    A frame of another protocol is discarded. A length outside 2 to 254 means that the two sides have lost each other:
    the framer is ``broken``, gives nothing more, and its connection has to be closed.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self.broken = False
        self._held = bytearray()

    @property
    def pending(self) -> int:
        return len(self._held)

    def encode(self, frame: Frame) -> bytes:
        return (
            frame.transaction.to_bytes(2, "big")
            + b"\x00\x00"
            + (1 + len(frame.pdu)).to_bytes(2, "big")
            + bytes([frame.unit])
            + frame.pdu
        )

    def expect(self, unit: int, function: int) -> None:
        """Nothing to forget: the transaction identifier tells a late reply from the awaited one."""

    def receive_data(self, data: bytes) -> None:
        if not self.broken:
            self._held += data

    def next_frame(self) -> Frame | None:
        held = self._held
        while len(held) >= TCP_HEADER - 1:
            length = int.from_bytes(held[4:6], "big")
            if not TCP_LENGTH_MIN <= length <= TCP_LENGTH_MAX:
                self.damaged += 1
                self.broken = True
                held.clear()
                return None
            stop = TCP_HEADER - 1 + length
            if len(held) < stop:
                return None
            head, pdu = bytes(held[:TCP_HEADER]), bytes(held[TCP_HEADER:stop])
            del held[:stop]
            if head[2:4] == b"\x00\x00":
                return Frame(head[6], pdu, int.from_bytes(head[:2], "big"))
            self.damaged += 1
        return None

    def silence(self) -> None:
        """Nothing to do: the header says where a frame ends."""

    def reset(self) -> None:
        self._held.clear()


_REQUEST_FRAMERS: Final[dict[Framing, Callable[[], Framer]]] = {
    "rtu": RtuRequestFramer,
    "ascii": AsciiFramer,
    "tcp": TcpFramer,
}
_REPLY_FRAMERS: Final[dict[Framing, Callable[[], Framer]]] = {**_REQUEST_FRAMERS, "rtu": RtuReplyFramer}


def request_framer(framing: Framing) -> Framer:
    """Return what a slave listens with."""
    return _REQUEST_FRAMERS[framing]()


def reply_framer(framing: Framing) -> Framer:
    """Return what a master listens with; ``expect`` tells it whose reply to wait for."""
    return _REPLY_FRAMERS[framing]()
