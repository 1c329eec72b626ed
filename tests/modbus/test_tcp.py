"""Modbus TCP frames out of a byte stream: an MBAP header says how long each is (messaging guide V1.0b, 3.1.3)."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from gateway.modbus.framing import Frame, TcpFramer, reply_framer, request_framer
from tests.modbus import drain, one_by_one, wire

POLL = wire("""
    15 01   # transaction
    00 00   # protocol: Modbus
    00 06   # 6 bytes follow
    FF      # unit 255: the server itself
    03      # read holding registers
    00 04   # from address 4
    00 01   # 1 of them
""")
POLLED = Frame(255, b"\x03\x00\x04\x00\x01", transaction=0x1501)
REPLY = wire("""
    15 01   # transaction, repeated
    00 00   # protocol: Modbus
    00 05   # 5 bytes follow
    FF      # unit 255, repeated
    03      # read holding registers
    02      # 2 bytes
    00 05   # 5
""")
REPLIED = Frame(255, b"\x03\x02\x00\x05", transaction=0x1501)
FOREIGN = wire("""
    15 02   # transaction
    00 01   # protocol 1: not Modbus
    00 06   # 6 bytes follow
    FF 03 00 04 00 01
""")
SHORTEST = wire("""
    00 00   # transaction 0
    00 00   # protocol
    00 02   # the least there is: unit and function
    01      # unit 1
    07      # read exception status
""")
LONGEST = (
    wire("""
    FF FF   # transaction 65535
    00 00   # protocol
    00 FE   # 254: unit and 253 bytes
    01      # unit 1
    41      # function 65
""")
    + b"\x5a" * 252
)


def received(pieces: Iterable[bytes], framer: TcpFramer | None = None) -> list[Frame]:
    framer = framer or TcpFramer()
    found = []
    for piece in pieces:
        framer.receive_data(piece)
        found += drain(framer)
    return found


@pytest.mark.parametrize(
    ("data", "frame"),
    [
        (POLL, POLLED),
        (REPLY, REPLIED),
        (SHORTEST, Frame(1, b"\x07", 0)),
        (LONGEST, Frame(1, b"\x41" + b"\x5a" * 252, 65535)),
    ],
    ids=["request", "reply", "length 2", "length 254"],
)
def test_a_frame_goes_both_ways_whole_byte_by_byte_and_two_at_once(data: bytes, frame: Frame) -> None:
    assert TcpFramer().encode(frame) == data
    assert received([data]) == [frame]
    assert received(one_by_one(data[:-1])) == []
    assert received(one_by_one(data)) == [frame]
    assert received([data + data]) == [frame, frame]
    assert received(one_by_one(data + data)) == [frame, frame]


def test_a_part_is_pending_until_the_rest_has_come_however_long_that_takes() -> None:
    framer = TcpFramer()
    for stop in range(1, len(POLL)):
        assert received([POLL[:stop]], framer) == []
        assert framer.pending == stop
        framer.silence()
        framer.expect(255, 3)  # the transaction tells frames apart: nothing is forgotten
        assert received([POLL[stop:]], framer) == [POLLED]
        assert framer.pending == 0
    assert (framer.damaged, framer.broken) == (0, False)


def test_pipelined_frames_come_in_their_order_wherever_the_stream_is_cut() -> None:
    frames = [Frame(1, b"\x03\x00\x00\x00" + bytes([number]), transaction=number) for number in range(20)]
    stream = b"".join(TcpFramer().encode(frame) for frame in frames)
    for size in range(1, 40):
        assert received(stream[start : start + size] for start in range(0, len(stream), size)) == frames


def test_a_frame_of_another_protocol_is_discarded_and_counted() -> None:
    framer = TcpFramer()
    assert received([FOREIGN + POLL + FOREIGN + POLL], framer) == [POLLED, POLLED]
    assert (framer.damaged, framer.broken) == (2, False)
    assert received(one_by_one(FOREIGN + POLL)) == [POLLED]
    for protocol in (b"\x01\x00", b"\xff\xff"):
        assert received([POLL[:2] + protocol + POLL[4:], REPLY]) == [REPLIED]


@pytest.mark.parametrize("length", [0, 1, 255, 256, 258, 32768, 65535])
def test_a_length_outside_2_to_254_breaks_the_connection_for_good(length: int) -> None:
    framer = TcpFramer()
    framer.receive_data(POLL + b"\x00\x01\x00\x00" + length.to_bytes(2, "big") + POLL)
    assert framer.next_frame() == POLLED  # it came before
    assert not framer.broken
    assert framer.next_frame() is None
    assert (framer.broken, framer.damaged, framer.pending) == (True, 1, 0)
    assert received([POLL] * 3, framer) == []
    framer.reset()
    framer.expect(255, 3)
    framer.silence()
    assert received([POLL], framer) == []
    assert (framer.broken, framer.damaged, framer.pending) == (True, 1, 0)


def test_a_bad_length_is_seen_as_soon_as_it_has_come() -> None:
    framer = TcpFramer()
    assert received([b"\x00\x01\x00\x00\xff"], framer) == []
    assert not framer.broken
    assert received([b"\xff"], framer) == []
    assert framer.broken


def test_a_bad_length_breaks_under_another_protocol_too() -> None:
    framer = TcpFramer()
    assert received([b"\x00\x01\x00\x01\x00\xff"], framer) == []
    assert framer.broken


def test_reset_throws_a_part_away() -> None:
    framer = TcpFramer()
    assert received([POLL[:7]], framer) == []
    framer.reset()
    assert framer.pending == 0
    assert received([POLL], framer) == [POLLED]


def test_a_stream_is_held_up_to_one_frame() -> None:
    framer = TcpFramer()
    for _ in range(50):
        received([LONGEST[:100], LONGEST[100:] + LONGEST[:259]], framer)
        assert framer.pending < 260
        framer.reset()


def test_both_directions_share_one_framer() -> None:
    assert isinstance(request_framer("tcp"), TcpFramer)
    assert isinstance(reply_framer("tcp"), TcpFramer)
