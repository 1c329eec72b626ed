"""The protocol code, tested with bytes alone: annotated frames, and checksums computed another way than the code's."""

from __future__ import annotations

import itertools

from gateway.modbus.framing import Frame, Framer


def wire(text: str) -> bytes:
    """Return the bytes of an annotated frame: hexadecimal pairs, and after a # what they say."""
    return b"".join(bytes.fromhex(line.partition("#")[0]) for line in text.splitlines())


def crc_bit_by_bit(data: bytes) -> bytes:
    """Return the CRC of *data* as on the wire, as the serial line guide's section 2.5.1.2 tells it, without a table."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            carry = crc & 1
            crc >>= 1
            if carry:
                crc ^= 0xA001
    return bytes([crc & 0xFF, crc >> 8])


def with_crc(text: str) -> bytes:
    """Return the RTU frame whose annotated bytes are *text*, with its CRC added."""
    return wire(text) + crc_bit_by_bit(wire(text))


def ascii_of(body: bytes) -> bytes:
    """Return the ASCII frame of *body*; the LRC as section 2.5.2.2 tells it: add, drop carries, two's complement."""
    total = 0
    for byte in body:
        total = (total + byte) % 256
    return b":" + b"".join(b"%02X" % byte for byte in [*body, (256 - total) % 256]) + b"\r\n"


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    """Return *data* cut at *cuts*, positions modulo its length."""
    places = sorted({cut % (len(data) + 1) for cut in cuts} | {0, len(data)})
    return [data[start:stop] for start, stop in itertools.pairwise(places)] or [b""]


def one_by_one(data: bytes) -> list[bytes]:
    """Return *data* in pieces of one byte."""
    return [bytes([byte]) for byte in data]


def drain(framer: Framer) -> list[Frame]:
    """Return all the frames that *framer* has to give."""
    found = []
    while (frame := framer.next_frame()) is not None:
        found.append(frame)
    return found
