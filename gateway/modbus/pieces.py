"""What was said on a line, cut into frames and into what is none: for a person who watches, not for the drivers.

The drivers' framers throw away what they cannot use; here nothing is thrown away, and what is no frame has a reason.
Each cutter takes what one side has said and returns the pieces it is sure of, in order and without a gap, from the
start; what is left over may become whole with the next bytes, unless *is_over*: then all of it is cut.

Pure. A cutter never raises and looks at a stretch of noise only ``STARTS_MAX`` times.

Source: as ``framing``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from gateway.modbus.framing import (
    RTU_MAX,
    RTU_MIN,
    TCP_HEADER,
    TCP_LENGTH_MAX,
    TCP_LENGTH_MIN,
    UNIT_MAX,
    AsciiFramer,
    Frame,
    Framing,
    crc16,
)
from gateway.modbus.pdu import PDU_MAX, REPLY_SHAPES, REQUEST_SHAPES, Shape, pdu_length

STARTS_MAX: Final = 64  # places in a stretch of noise where a frame is looked for
CRC_SIZE: Final = 2
HALF: Final = "cut short"

Shapes = Sequence[dict[int, Shape]]

REQUESTS: Final[Shapes] = (REQUEST_SHAPES,)
REPLIES: Final[Shapes] = (REPLY_SHAPES,)
BOTH: Final[Shapes] = (REQUEST_SHAPES, REPLY_SHAPES)


@dataclass(frozen=True, slots=True)
class Piece:
    """Some bytes, and the frame that they are; or why they are none."""

    raw: bytes
    frame: Frame | None = None
    reason: str = ""


Cutter = Callable[[bytes, Shapes, bool], list[Piece]]


# ------------------------------------------------------------------------------------------------ RTU


def cut_rtu(held: bytes, shapes: Shapes, is_over: bool) -> list[Piece]:
    """Cut RTU frames by the lengths in *shapes* and by their CRC; where neither fits, only *is_over* can tell."""
    pieces: list[Piece] = []
    at = 0
    while at < len(held):
        stop = _rtu_end(held, at, shapes, is_over)
        if stop is None and not is_over:
            break
        if stop is None:
            start, stop = _rtu_behind_noise(held, at, shapes)
            pieces.append(Piece(held[at:start], reason=_rtu_reason(held[at:start], shapes)))
            at = start
        if stop > at:
            pieces.append(Piece(held[at:stop], Frame(held[at], held[at + 1 : stop - CRC_SIZE])))
        at = stop
    return pieces


def _rtu_end(held: bytes, at: int, shapes: Shapes, is_over: bool) -> int | None:
    """Where the frame that begins at *at* ends; None if there is none, or not yet."""
    stops = _rtu_stops(held[at : at + RTU_MAX], shapes)
    if is_over:  # silence ends a frame, too: of a function that nobody knows, or a request too long or too short
        stops.append(len(held) - at)
    for stop in stops:
        if RTU_MIN <= stop <= min(RTU_MAX, len(held) - at) and crc16(held[at : at + stop]) == 0:
            return at + stop
    return None


def _rtu_stops(head: bytes, shapes: Shapes) -> list[int]:
    """How long a frame that begins like *head* is, by each of *shapes*; shortest first."""
    lengths = (pdu_length(each, head[1 : 1 + PDU_MAX]) for each in shapes)
    return sorted({1 + length + CRC_SIZE for length in lengths if length})


def _rtu_behind_noise(held: bytes, at: int, shapes: Shapes) -> tuple[int, int]:
    """Where the first frame after *at* begins and ends; where all ends if there is none."""
    for start in range(at + 1, min(len(held), at + 1 + STARTS_MAX)):
        stop = _rtu_end(held, start, shapes, is_over=False)
        if stop is not None and held[start] <= UNIT_MAX:
            return start, stop
    return len(held), len(held)


def _rtu_reason(noise: bytes, shapes: Shapes) -> str:
    stops = _rtu_stops(noise, shapes) or [RTU_MIN]
    if len(noise) < min(stops):
        return HALF
    return "CRC wrong" if len(noise) >= max(stops) else f"CRC wrong or {HALF}"


# ------------------------------------------------------------------------------------------------ ASCII


def cut_ascii(held: bytes, shapes: Shapes, is_over: bool) -> list[Piece]:  # noqa: ARG001 - CR LF ends a frame
    """Cut ASCII frames at CR LF; a colon in a frame begins a new one."""
    pieces: list[Piece] = []
    at = 0
    while (end := held.find(b"\r\n", at)) >= 0:
        colon = held.rfind(b":", at, end)
        start = end + 2 if colon < 0 else colon
        if start > at:
            pieces.append(Piece(held[at:start], reason=HALF if held[at : at + 1] == b":" else "no colon before it"))
        if colon >= 0:
            pieces.append(_ascii_piece(held[colon : end + 2]))
        at = end + 2
    if is_over and at < len(held):
        pieces.append(Piece(held[at:], reason=HALF))
    return pieces


def _ascii_piece(raw: bytes) -> Piece:
    """*raw*: from the colon to CR LF."""
    framer = AsciiFramer()
    framer.receive_data(raw)
    frame = framer.next_frame()
    if frame is not None:
        return Piece(raw, frame)
    try:
        text = raw[1:-2].decode("ascii")
        is_hexadecimal = len(bytes.fromhex(text)) * 2 == len(text)
    except ValueError:
        is_hexadecimal = False
    return Piece(raw, reason="LRC wrong" if is_hexadecimal else "not hexadecimal")


# ------------------------------------------------------------------------------------------------ TCP


def cut_tcp(held: bytes, shapes: Shapes, is_over: bool) -> list[Piece]:  # noqa: ARG001 - the header says how long
    """Cut frames with an MBAP header; after a length that cannot be nothing is a frame any more."""
    pieces: list[Piece] = []
    at = 0
    while len(held) - at >= TCP_HEADER - 1:
        length = int.from_bytes(held[at + 4 : at + 6], "big")
        if not TCP_LENGTH_MIN <= length <= TCP_LENGTH_MAX:
            return [*pieces, Piece(held[at:], reason="not Modbus TCP")]
        stop = at + TCP_HEADER - 1 + length
        if stop > len(held):
            break
        pieces.append(_tcp_piece(held[at:stop]))
        at = stop
    if is_over and at < len(held):
        pieces.append(Piece(held[at:], reason=HALF))
    return pieces


def _tcp_piece(raw: bytes) -> Piece:
    protocol = int.from_bytes(raw[2:4], "big")
    if protocol:
        return Piece(raw, reason=f"protocol {protocol}, not Modbus")
    return Piece(raw, Frame(raw[6], raw[7:], int.from_bytes(raw[:2], "big")))


CUTTERS: Final[dict[Framing, Cutter]] = {"rtu": cut_rtu, "ascii": cut_ascii, "tcp": cut_tcp}
