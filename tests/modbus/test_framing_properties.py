"""What holds for any bytes at all: framers never raise, never depend on how a stream is cut, never keep much of it.

Every search is derandomized: the same examples on every run and every machine.
"""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from gateway.errors import DeviceRefused, ReplyMismatch, RequestRefused
from gateway.modbus.framing import (
    Frame,
    Framer,
    Framing,
    RtuRequestFramer,
    encode_rtu,
    reply_framer,
    request_framer,
)
from gateway.modbus.pdu import (
    MaskWriteRequest,
    ReadRequest,
    ReadWriteRequest,
    Request,
    WriteRequest,
    decode_reply,
    decode_request,
    encode_reply,
    encode_request,
)
from tests.modbus import ascii_of, crc_bit_by_bit, drain, one_by_one, pieces

FRAMINGS: list[Framing] = ["rtu", "ascii", "tcp"]
HELD_MAX = 4096
each_framing = pytest.mark.parametrize("framing", FRAMINGS)
searched = settings(derandomize=True, deadline=None, max_examples=250, suppress_health_check=[HealthCheck.too_slow])


# ------------------------------------------------------------------------------------------------ what is tried


@st.composite
def requests(draw: st.DrawFn) -> Request:
    """Any request that the specification allows."""
    function = draw(st.sampled_from([1, 2, 3, 4, 5, 6, 15, 16, 22, 23]))
    if function == 22:
        return MaskWriteRequest(*(draw(st.integers(0, 65535)) for _ in range(3)))
    most = {1: 2000, 2: 2000, 3: 125, 4: 125, 5: 1, 6: 1, 15: 1968, 16: 123, 23: 125}[function]
    quantity = draw(st.integers(1, most))
    address = draw(st.integers(0, 65536 - quantity))
    if function <= 4:
        return ReadRequest(function, address, quantity)
    if function == 23:
        written = draw(st.integers(1, 121))
        start = draw(st.integers(0, 65536 - written))
        return ReadWriteRequest(address, quantity, start, written, draw(data_of(2 * written)))
    if function == 5:
        return WriteRequest(5, address, 1, draw(st.sampled_from([b"\x00", b"\x01"])))
    return WriteRequest(
        function, address, quantity, draw(data_of((quantity + 7) // 8 if function == 15 else 2 * quantity))
    )


def data_of(size: int) -> st.SearchStrategy[bytes]:
    return st.binary(min_size=size, max_size=size)


replies = st.builds(
    lambda function, data: bytes([function, len(data)]) + data,
    st.sampled_from([1, 2, 3, 4, 23]),
    st.binary(max_size=251),
)
pdus = st.one_of(requests().map(encode_request), replies, st.binary(min_size=1, max_size=253))
units = st.one_of(st.sampled_from([1, 2]), st.integers(0, 255))
frames = st.builds(Frame, units, pdus)
REPLY_LENGTH_KNOWN = {1, 2, 3, 4, 5, 6, 7, 8, 11, 12, 15, 16, 17, 20, 21, 22, 23, 24}


@dataclass(frozen=True)
class Sent:
    """A frame and what befalls it on the line: one byte changed, an end that is missing, noise after it."""

    frame: Frame
    change: tuple[int, int] | None
    kept: int | None
    noise: bytes

    def on(self, framing: Framing) -> bytes:
        data = bytearray(encoded(framing, self.frame))
        if self.change:
            data[self.change[0] % len(data)] = self.change[1]
        return bytes(data[: self.kept]) + self.noise


sent = st.builds(
    Sent,
    frames,
    st.one_of(st.none(), st.none(), st.tuples(st.integers(0, 600), st.integers(0, 255))),
    st.one_of(st.none(), st.none(), st.integers(0, 300)),
    st.one_of(st.just(b""), st.just(b""), st.binary(max_size=6)),
)
talks = st.lists(sent, min_size=1, max_size=5)


def encoded(framing: Framing, frame: Frame) -> bytes:
    body = bytes([frame.unit]) + frame.pdu
    if framing == "rtu":
        return body + crc_bit_by_bit(body)
    return ascii_of(body) if framing == "ascii" else b"\x00\x01\x00\x00" + len(body).to_bytes(2, "big") + body


def stream_of(framing: Framing, talk: list[Sent]) -> bytes:
    return b"".join(sent.on(framing) for sent in talk)


cuts = st.lists(st.integers(0, 5000), max_size=12)


def heard(framer: Framer, parts: list[bytes]) -> list[Frame]:
    """What comes out of *parts*, with one silence at their end."""
    found = []
    for part in parts:
        framer.receive_data(part)
        found += drain(framer)
    framer.silence()
    return found + drain(framer)


def both_ears(framing: Framing, unit: int, function: int) -> list[Framer]:
    master = reply_framer(framing)
    master.expect(unit, function)
    return [request_framer(framing), master]


# ------------------------------------------------------------------------------------------------ any bytes


@each_framing
@searched
@given(talk=talks, cuts=cuts, unit=units, function=st.integers(0, 255), silent=st.sets(st.integers(0, 12)))
def test_no_bytes_make_a_framer_raise_or_give_what_is_no_frame(
    framing: Framing, talk: list[Sent], cuts: list[int], unit: int, function: int, silent: set[int]
) -> None:
    for framer in both_ears(framing, unit, function):
        for place, part in enumerate(pieces(stream_of(framing, talk), cuts)):
            framer.receive_data(part)
            if place in silent:
                framer.silence()
            for frame in drain(framer):
                assert 0 <= frame.unit <= 255
                assert 1 <= len(frame.pdu) <= 253
            assert framer.pending <= HELD_MAX


@each_framing
@searched
@given(noise=st.binary(max_size=600), cuts=cuts, unit=units, function=st.integers(0, 255))
def test_noise_without_any_frame_in_it_does_not_make_a_framer_raise(
    framing: Framing, noise: bytes, cuts: list[int], unit: int, function: int
) -> None:
    for framer in both_ears(framing, unit, function):
        heard(framer, pieces(noise, cuts))
        assert framer.pending <= HELD_MAX


@each_framing
@searched
@given(talk=talks, cuts=cuts)
def test_where_a_stream_is_cut_changes_no_frame(framing: Framing, talk: list[Sent], cuts: list[int]) -> None:
    stream = stream_of(framing, talk)
    unit, function = talk[-1].frame.unit, talk[-1].frame.pdu[0] & 0x7F
    function = function if function in REPLY_LENGTH_KNOWN else 4
    in_one_piece = [heard(framer, [stream]) for framer in both_ears(framing, unit, function)]
    in_pieces = [heard(framer, pieces(stream, cuts)) for framer in both_ears(framing, unit, function)]
    byte_by_byte = [heard(framer, one_by_one(stream)) for framer in both_ears(framing, unit, function)]
    assert in_one_piece == in_pieces == byte_by_byte


@each_framing
@searched
@given(chunk=st.binary(min_size=1, max_size=40), repeats=st.integers(1, 600), unit=st.integers(0, 255))
@example(chunk=b"\x02\x04\xff", repeats=600, unit=2)
@example(chunk=b":00", repeats=600, unit=0)
@example(chunk=b"00", repeats=600, unit=0)
@example(chunk=b"\x00\x00\x00\x00\x00\xfe", repeats=600, unit=0)
def test_no_stream_makes_a_framer_keep_more_than_its_bound(
    framing: Framing, chunk: bytes, repeats: int, unit: int
) -> None:
    for framer in both_ears(framing, unit, 4):
        bound = HELD_MAX if isinstance(framer, RtuRequestFramer) else 513  # an ASCII frame, the largest there is
        for _ in range(repeats):
            framer.receive_data(chunk)
            drain(framer)
            assert framer.pending <= bound
        framer.receive_data(chunk * repeats)
        drain(framer)
        assert framer.pending <= bound


@searched
@given(talk=talks, unit=units, request=requests())
def test_after_any_stream_and_a_reset_a_slave_hears_the_next_request(
    talk: list[Sent], unit: int, request: Request
) -> None:
    framer = request_framer("rtu")
    heard(framer, [stream_of("rtu", talk)])
    framer.reset()
    assert heard(framer, [encode_rtu(Frame(unit, encode_request(request)))]) == [Frame(unit, encode_request(request))]


@searched
@given(talk=st.lists(st.builds(Frame, st.integers(0, 255), requests().map(encode_request)), min_size=1, max_size=6))
def test_a_burst_of_whole_requests_comes_apart_into_exactly_these(talk: list[Frame]) -> None:
    framer = request_framer("rtu")
    assert heard(framer, [b"".join(encode_rtu(frame) for frame in talk)]) == talk
    assert (framer.pending, framer.damaged) == (0, 0)


@searched
@given(frame=frames, place=st.integers(0, 4000))
def test_one_bit_turned_over_is_never_taken_for_the_frame(frame: Frame, place: int) -> None:
    for framing in FRAMINGS[:2]:  # TCP leaves checksums to the network
        data = encoded(framing, frame)
        hurt = bytearray(data)
        hurt[place // 8 % len(hurt)] ^= 1 << place % 8
        if hurt.lower() != data.lower():  # bit 5 makes a small letter of a capital: the same frame
            assert frame not in heard(request_framer(framing), [bytes(hurt)])


# ------------------------------------------------------------------------------------------------ there and back


@each_framing
@searched
@given(unit=st.integers(0, 255), request=requests(), transaction=st.integers(0, 65535), cuts=cuts)
def test_any_request_survives_its_way_to_a_slave(
    framing: Framing, unit: int, request: Request, transaction: int, cuts: list[int]
) -> None:
    sent = Frame(unit, encode_request(request), transaction if framing == "tcp" else 0)
    (frame,) = heard(request_framer(framing), pieces(request_framer(framing).encode(sent), cuts))
    assert frame == sent
    assert decode_request(frame.pdu) == request


@st.composite
def answers(draw: st.DrawFn) -> tuple[Request, bytes]:
    """A request and the data that answers it, unused bits zero."""
    request = draw(requests())
    if not isinstance(request, ReadRequest | ReadWriteRequest):
        return request, b""
    if request.function > 2:
        return request, draw(data_of(2 * request.quantity))
    bits = draw(st.integers(0, (1 << request.quantity) - 1))
    return request, bits.to_bytes((request.quantity + 7) // 8, "little")


@each_framing
@searched
@given(unit=st.integers(0, 255), answer=answers(), transaction=st.integers(0, 65535), cuts=cuts)
def test_any_reply_survives_its_way_to_a_master(
    framing: Framing, unit: int, answer: tuple[Request, bytes], transaction: int, cuts: list[int]
) -> None:
    request, data = answer
    sent = Frame(unit, encode_reply(request, data), transaction if framing == "tcp" else 0)
    master = reply_framer(framing)
    master.expect(unit, request.function)
    (frame,) = heard(master, pieces(master.encode(sent), cuts))
    assert frame == sent
    assert decode_reply(request, frame.pdu) == data


@searched
@given(frame=frames)
def test_what_rtu_and_ascii_put_on_the_wire_is_what_the_guide_says(frame: Frame) -> None:
    body = bytes([frame.unit]) + frame.pdu
    assert request_framer("rtu").encode(frame) == body + crc_bit_by_bit(body)
    assert request_framer("ascii").encode(frame) == ascii_of(body)


# ------------------------------------------------------------------------------------------------ any PDU


def understood(pdu: bytes) -> Request | int:
    """The request in *pdu*, or the exception that refuses it."""
    try:
        return decode_request(pdu)
    except RequestRefused as refused:
        return refused.code


def is_encodable(request: Request) -> bool:
    """Neither a range that wraps around nor a coil's value out of the two."""
    if isinstance(request, WriteRequest) and not request.value_allowed:
        return False
    if isinstance(request, ReadWriteRequest) and request.write_address + request.write_quantity > 65536:
        return False
    return isinstance(request, MaskWriteRequest) or request.address + request.quantity <= 65536


@searched
@given(pdu=st.one_of(st.binary(max_size=300), pdus))
def test_any_bytes_are_refused_with_1_or_3_or_are_a_request_that_encodes_to_them(pdu: bytes) -> None:
    request = understood(pdu)
    if isinstance(request, int):
        assert request == (3 if pdu[:1] and pdu[0] in (1, 2, 3, 4, 5, 6, 15, 16, 22, 23) else 1)
    elif is_encodable(request):
        assert encode_request(request) == pdu


def brought(request: Request, pdu: bytes) -> bytes | int | None:
    """The data that *pdu* brings, the exception it tells, or None if it answers another question."""
    try:
        return decode_reply(request, pdu)
    except DeviceRefused as refused:
        return refused.code
    except ReplyMismatch:
        return None


@st.composite
def doubtful_replies(draw: st.DrawFn) -> tuple[Request, bytes]:
    """A request, and what may be its reply but for one thing, or any bytes at all."""
    request, data = draw(answers())
    reply = bytearray(encode_reply(request, data))
    match draw(st.sampled_from(["right", "changed", "cut", "longer", "refused", "anything"])):
        case "changed":
            reply[draw(st.integers(0, len(reply) - 1))] = draw(st.integers(0, 255))
        case "cut":
            del reply[draw(st.integers(0, len(reply))) :]
        case "longer":
            reply += draw(st.binary(min_size=1, max_size=5))
        case "refused":
            reply[:] = bytes([request.function + 128]) + draw(st.binary(max_size=2))
        case "anything":
            reply[:] = draw(st.binary(max_size=260))
    return request, bytes(reply)


@searched
@given(doubt=doubtful_replies())
def test_any_bytes_are_data_of_the_size_asked_for_or_a_refusal_or_a_mismatch(doubt: tuple[Request, bytes]) -> None:
    request, pdu = doubt
    match brought(request, pdu):
        case None:
            pass
        case int(code):
            assert pdu == bytes([request.function + 128, code])
            assert code != 0
        case data if isinstance(request, ReadRequest | ReadWriteRequest):
            size = (request.quantity + 7) // 8 if request.function <= 2 else 2 * request.quantity
            assert pdu[:2] == bytes([request.function, size])
            assert len(data) == len(pdu) - 2 == size
        case data:
            assert data == b""
            assert encode_request(request).startswith(pdu)
            assert len(pdu) == (7 if request.function == 22 else 5)
