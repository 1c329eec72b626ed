"""Requests and replies to and from bytes: the specification's own examples, and every limit from both sides.

Limits stand here as numbers, not as the code's names for them. Sections are those of the application protocol V1.1b3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from gateway.errors import DeviceRefused, ReplyMismatch, RequestInvalid, RequestRefused
from gateway.modbus.pdu import (
    MaskWriteRequest,
    ReadRequest,
    ReadWriteRequest,
    Request,
    Span,
    Table,
    WriteRequest,
    bit_at,
    decode_reply,
    decode_request,
    encode_reply,
    encode_request,
    exception_reply,
    pack_bits,
    pack_words,
    word_at,
)
from tests.modbus import wire


@dataclass(frozen=True)
class Example:
    """One exchange as the specification prints it; *data* is what the reply brings."""

    section: str
    request: Request
    asked: bytes
    replied: bytes
    data: bytes = b""


EXAMPLES = [
    Example(
        "6.1 read coils",
        ReadRequest(1, address=19, quantity=19),
        wire("""
            01      # read coils
            00 13   # from address 19: coil 20
            00 13   # 19 of them, up to coil 38
        """),
        wire("""
            01      # read coils
            03      # 3 bytes
            CD      # coils 27 to 20
            6B      # coils 35 to 28
            05      # coils 38 to 36, the rest unused
        """),
        b"\xcd\x6b\x05",
    ),
    Example(
        "6.2 read discrete inputs",
        ReadRequest(2, address=196, quantity=22),
        wire("""
            02      # read discrete inputs
            00 C4   # from address 196: input 197
            00 16   # 22 of them
        """),
        wire("""
            02          # read discrete inputs
            03          # 3 bytes
            AC DB 35    # inputs 204 to 197, 212 to 205, 218 to 213
        """),
        b"\xac\xdb\x35",
    ),
    Example(
        "6.3 read holding registers",
        ReadRequest(3, address=107, quantity=3),
        wire("""
            03      # read holding registers
            00 6B   # from address 107: register 108
            00 03   # 3 of them
        """),
        wire("""
            03      # read holding registers
            06      # 6 bytes
            02 2B   # 555
            00 00   # 0
            00 64   # 100
        """),
        b"\x02\x2b\x00\x00\x00\x64",
    ),
    Example(
        "6.4 read input registers",
        ReadRequest(4, address=8, quantity=1),
        wire("""
            04      # read input registers
            00 08   # address 8: input register 9
            00 01   # 1 of them
        """),
        wire("""
            04      # read input registers
            02      # 2 bytes
            00 0A   # 10
        """),
        b"\x00\x0a",
    ),
    Example(
        "6.5 write single coil",
        WriteRequest(5, address=172, quantity=1, data=b"\x01"),
        wire("""
            05      # write single coil
            00 AC   # address 172: coil 173
            FF 00   # on
        """),
        wire("05 00 AC FF 00  # the request repeated"),
    ),
    Example(
        "6.6 write single register",
        WriteRequest(6, address=1, quantity=1, data=b"\x00\x03"),
        wire("""
            06      # write single register
            00 01   # address 1: register 2
            00 03   # 3
        """),
        wire("06 00 01 00 03  # the request repeated"),
    ),
    Example(
        "6.11 write multiple coils",
        WriteRequest(15, address=19, quantity=10, data=b"\xcd\x01"),
        wire("""
            0F      # write multiple coils
            00 13   # from address 19: coil 20
            00 0A   # 10 of them
            02      # 2 bytes
            CD      # coils 27 to 20
            01      # coils 29 and 28
        """),
        wire("0F 00 13 00 0A  # address and quantity repeated"),
    ),
    Example(
        "6.12 write multiple registers",
        WriteRequest(16, address=1, quantity=2, data=b"\x00\x0a\x01\x02"),
        wire("""
            10      # write multiple registers
            00 01   # from address 1: register 2
            00 02   # 2 of them
            04      # 4 bytes
            00 0A   # 10
            01 02   # 258
        """),
        wire("10 00 01 00 02  # address and quantity repeated"),
    ),
    Example(
        "6.16 mask write register",
        MaskWriteRequest(address=4, and_mask=0x00F2, or_mask=0x0025),
        wire("""
            16      # mask write register
            00 04   # address 4: register 5
            00 F2   # AND mask
            00 25   # OR mask
        """),
        wire("16 00 04 00 F2 00 25  # the request repeated"),
    ),
    Example(
        "6.17 read/write multiple registers",
        ReadWriteRequest(3, 6, write_address=14, write_quantity=3, data=b"\x00\xff\x00\xff\x00\xff"),
        wire("""
            17                  # read/write multiple registers
            00 03               # read from address 3: register 4
            00 06               # 6 of them
            00 0E               # write from address 14: register 15
            00 03               # 3 of them
            06                  # 6 bytes
            00 FF 00 FF 00 FF   # 255 each
        """),
        wire("""
            17                                  # read/write multiple registers
            0C                                  # 12 bytes
            00 FE 0A CD 00 01 00 03 00 0D 00 FF # 254, 2765, 1, 3, 13, 255
        """),
        bytes.fromhex("00 FE 0A CD 00 01 00 03 00 0D 00 FF"),
    ),
]

each_example = pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.section)


# ------------------------------------------------------------------------------------------------ as printed


@each_example
def test_a_request_is_encoded_as_the_specification_prints_it(example: Example) -> None:
    assert encode_request(example.request) == example.asked


@each_example
def test_a_request_is_decoded_as_the_specification_means_it(example: Example) -> None:
    assert decode_request(example.asked) == example.request


@each_example
def test_a_reply_gives_the_data_that_the_specification_prints(example: Example) -> None:
    assert decode_reply(example.request, example.replied) == example.data


@each_example
def test_a_reply_is_encoded_as_the_specification_prints_it(example: Example) -> None:
    assert encode_reply(example.request, example.data) == example.replied


def test_an_exception_reply_is_the_one_of_section_7() -> None:
    assert exception_reply(1, 2) == wire("""
        81      # read coils, refused
        02      # illegal data address
    """)


def test_a_coil_is_switched_off_by_zero_and_only_the_lowest_bit_of_its_data_counts() -> None:
    for off in (b"\x00", b"\xfe"):
        assert encode_request(WriteRequest(5, 172, 1, off)) == bytes.fromhex("05 00 AC 00 00")


# ------------------------------------------------------------------------------------------------ limits, sending


def sized(function: int, quantity: int, address: int = 0) -> Request:
    """A request of *function* for *quantity* points whose data fits, so that only its limits can be wrong."""
    if function <= 4:
        return ReadRequest(function, address, quantity)
    size = (quantity + 7) // 8 if function in (5, 15) else 2 * quantity
    return WriteRequest(function, address, quantity, bytes(max(0, size)))


def sized_23(read: int, written: int, address: int = 0, write_address: int = 0) -> ReadWriteRequest:
    return ReadWriteRequest(address, read, write_address, written, bytes(max(0, 2 * written)))


MOST = [(1, 2000), (2, 2000), (3, 125), (4, 125), (5, 1), (6, 1), (15, 1968), (16, 123)]
each_function = pytest.mark.parametrize(("function", "most"), MOST)


@each_function
def test_one_point_and_the_most_allowed_are_encoded_within_253_bytes(function: int, most: int) -> None:
    for quantity in (1, most):
        pdu = encode_request(sized(function, quantity))
        assert pdu[0] == function
        assert len(pdu) <= 253


@each_function
def test_no_points_and_one_too_many_are_not_encoded(function: int, most: int) -> None:
    for quantity in (-1, 0, most + 1, 65535, 65536):
        with pytest.raises(RequestInvalid, match=rf"^quantity {quantity} is not within 1 to {most}$"):
            encode_request(sized(function, quantity))


@each_function
def test_addresses_go_from_0_to_65535_and_never_around(function: int, most: int) -> None:
    assert encode_request(sized(function, 1, address=0))[1:3] == b"\x00\x00"
    assert encode_request(sized(function, 1, address=65535))[1:3] == b"\xff\xff"
    assert encode_request(sized(function, most, address=65536 - most))[1:3] == (65536 - most).to_bytes(2, "big")
    for address in (-1, 65536, 100_000):
        with pytest.raises(RequestInvalid, match=rf"^address {address} is not within 0 to 65535$"):
            encode_request(sized(function, 1, address))
    if most > 1:
        with pytest.raises(RequestInvalid, match="address 65535 and quantity 2 end beyond 65535"):
            encode_request(sized(function, 2, address=65535))
        with pytest.raises(RequestInvalid, match="end beyond 65535"):
            encode_request(sized(function, most, address=65537 - most))


@pytest.mark.parametrize(("read", "written"), [(1, 1), (125, 1), (1, 121), (125, 121)])
def test_read_write_takes_1_to_125_read_and_1_to_121_written(read: int, written: int) -> None:
    pdu = encode_request(sized_23(read, written, address=65536 - read, write_address=65536 - written))
    assert len(pdu) == 10 + 2 * written <= 253
    assert decode_request(pdu) == sized_23(read, written, address=65536 - read, write_address=65536 - written)


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        (sized_23(0, 1), "quantity 0 is not within 1 to 125"),
        (sized_23(126, 1), "quantity 126 is not within 1 to 125"),
        (sized_23(1, 0), "quantity 0 is not within 1 to 121"),
        (sized_23(1, 122), "quantity 122 is not within 1 to 121"),
        (sized_23(1, 1, address=65536), "address 65536 is not within"),
        (sized_23(1, 1, write_address=-1), "address -1 is not within"),
        (sized_23(2, 1, address=65535), "address 65535 and quantity 2 end beyond"),
        (sized_23(1, 2, write_address=65535), "address 65535 and quantity 2 end beyond"),
        (replace(sized_23(1, 2), data=b"\0\0\0"), "2 points take 4 bytes, not 3"),
        (MaskWriteRequest(65536, 0, 0), "address 65536 is not within"),
        (MaskWriteRequest(-1, 0, 0), "address -1 is not within"),
        (MaskWriteRequest(0, 65536, 0), "mask 65536 is not within 0 to 65535"),
        (MaskWriteRequest(0, 0, -1), "mask -1 is not within 0 to 65535"),
        (ReadRequest(5, 0, 1), "function 5 is no read"),
        (ReadRequest(0, 0, 1), "function 0 is no read"),
        (WriteRequest(3, 0, 1, b"\0\0"), "function 3 is no write"),
        (WriteRequest(22, 0, 1, b"\0\0"), "function 22 is no write"),
    ],
    ids=str,
)
def test_what_breaks_a_limit_is_not_encoded_and_says_which(request_: Request, why: str) -> None:
    with pytest.raises(RequestInvalid, match=why):
        encode_request(request_)


@pytest.mark.parametrize("function", [5, 6, 15, 16])
def test_data_of_another_size_than_its_points_is_not_encoded(function: int) -> None:
    fits = sized(function, 1)
    assert isinstance(fits, WriteRequest)
    for data in (b"", fits.data + b"\0"):
        with pytest.raises(RequestInvalid, match=rf"1 points take {len(fits.data)} bytes, not {len(data)}"):
            encode_request(replace(fits, data=data))


def test_a_mask_write_reaches_the_last_register_with_any_masks() -> None:
    assert encode_request(MaskWriteRequest(65535, 65535, 0)) == bytes.fromhex("16 FF FF FF FF 00 00")


# ------------------------------------------------------------------------------------------------ limits, listening


def refusal(pdu: bytes) -> int:
    with pytest.raises(RequestRefused) as refused:
        decode_request(pdu)
    return refused.value.code


@pytest.mark.parametrize(("function", "most"), [(1, 2000), (2, 2000), (3, 125), (4, 125), (15, 1968), (16, 123)])
def test_no_points_and_one_too_many_are_refused_with_exception_3(function: int, most: int) -> None:
    for quantity in (0, most + 1, 65535):
        data = b"" if function <= 4 else bytes((quantity + 7) // 8 if function == 15 else 2 * quantity)
        count = b"" if function <= 4 else bytes([len(data) & 0xFF])
        assert refusal(bytes([function, 0, 0]) + quantity.to_bytes(2, "big") + count + data) == 3


@each_function
def test_one_point_and_the_most_allowed_are_understood(function: int, most: int) -> None:
    for quantity in (1, most):
        assert decode_request(encode_request(sized(function, quantity))) == sized(function, quantity)


@pytest.mark.parametrize(("read", "written"), [(0, 1), (126, 1), (65535, 1), (1, 0), (1, 122), (1, 65535)])
def test_read_write_quantities_out_of_limits_are_refused_with_exception_3(read: int, written: int) -> None:
    header = b"\x17\0\0" + read.to_bytes(2, "big") + b"\0\0" + written.to_bytes(2, "big")
    assert refusal(header + bytes([2 * written & 0xFF]) + bytes(2 * written)) == 3


@each_example
def test_bytes_missing_or_left_over_are_refused_with_exception_3(example: Example) -> None:
    for stop in range(1, len(example.asked)):
        assert refusal(example.asked[:stop]) == 3
    assert refusal(example.asked + b"\0") == 3


@pytest.mark.parametrize(("section", "count_at"), [("6.11", 5), ("6.12", 5), ("6.17", 9)])
def test_a_byte_count_that_is_one_off_is_refused_with_exception_3(section: str, count_at: int) -> None:
    (asked,) = [example.asked for example in EXAMPLES if example.section.startswith(section)]
    count = asked[count_at]
    for wrong in (0, count - 1, count + 1, 255):
        assert refusal(asked[:count_at] + bytes([wrong]) + asked[count_at + 1 :]) == 3
    # count and data agree with each other, but not with the quantity
    assert refusal(asked[:count_at] + bytes([count + 1]) + asked[count_at + 1 :] + b"\0") == 3
    assert refusal(asked[:count_at] + bytes([count - 1]) + asked[count_at + 1 : -1]) == 3


@pytest.mark.parametrize("function", [0, 7, 8, 9, 10, 13, 14, 17, 20, 21, 24, 43, 65, 127, 128, 0x83, 0x90, 255])
def test_a_function_that_moves_no_data_is_refused_with_exception_1_whatever_its_length(function: int) -> None:
    for body in (b"", b"\0\0\0\1", bytes(252)):
        assert refusal(bytes([function]) + body) == 1


def test_nothing_at_all_is_refused_with_exception_1() -> None:
    assert refusal(b"") == 1


@pytest.mark.parametrize(
    ("value", "on", "allowed"),
    [
        ("FF 00", True, True),
        ("00 00", False, True),
        ("00 01", False, False),
        ("00 FF", False, False),
        ("01 00", False, False),
        ("FF 01", False, False),
        ("FE 00", False, False),
        ("FF FF", False, False),
    ],
)
def test_a_coil_is_written_by_ff00_or_0000_and_nothing_else(value: str, on: bool, allowed: bool) -> None:
    request = decode_request(wire(f"05 00 AC {value}"))
    assert request == WriteRequest(5, 172, 1, bytes([on]), value_allowed=allowed)


def test_a_range_that_wraps_around_is_decoded_because_only_the_server_judges_addresses() -> None:
    assert decode_request(bytes.fromhex("03 FF FF 00 02")) == ReadRequest(3, 65535, 2)


# ------------------------------------------------------------------------------------------------ replies


@each_example
def test_an_exception_reply_tells_its_code(example: Example) -> None:
    for code in (1, 2, 3, 4, 5, 6, 8, 10, 11, 255):
        with pytest.raises(DeviceRefused) as refused:
            decode_reply(example.request, bytes([example.asked[0] + 128, code]))
        assert refused.value.code == code


def mismatches(request: Request, pdu: bytes) -> None:
    with pytest.raises(ReplyMismatch):
        decode_reply(request, pdu)


def test_an_exception_without_a_code_is_no_reply_because_0_means_no_error() -> None:
    mismatches(ReadRequest(3, 0, 1), bytes.fromhex("83 00"))


@each_example
def test_a_reply_to_another_function_is_a_mismatch(example: Example) -> None:
    for other in {0, 1, 2, 3, 4, 5, 6, 15, 16, 22, 23, 127} - {example.replied[0]}:
        mismatches(example.request, bytes([other]) + example.replied[1:])
        mismatches(example.request, bytes([other + 128, 2]))


@each_example
def test_a_reply_too_short_or_too_long_is_a_mismatch(example: Example) -> None:
    for stop in range(len(example.replied)):
        mismatches(example.request, example.replied[:stop])
    mismatches(example.request, example.replied + b"\0")
    mismatches(example.request, bytes([example.replied[0] + 128]))
    mismatches(example.request, bytes([example.replied[0] + 128, 2, 0]))


@pytest.mark.parametrize("example", [e for e in EXAMPLES if not e.data], ids=lambda example: example.section)
def test_an_echo_that_differs_in_any_one_bit_is_a_mismatch(example: Example) -> None:
    for bit in range(8, 8 * len(example.replied)):  # the first byte is the function
        echo = bytearray(example.replied)
        echo[bit // 8] ^= 1 << bit % 8
        mismatches(example.request, bytes(echo))


@pytest.mark.parametrize("example", [e for e in EXAMPLES if e.data], ids=lambda example: example.section)
def test_a_byte_count_other_than_what_was_asked_for_is_a_mismatch(example: Example) -> None:
    count = len(example.data)
    for wrong in (0, count - 1, count + 1, 255):
        mismatches(example.request, example.replied[:1] + bytes([wrong]) + example.data)
    # a whole reply, but to another quantity
    mismatches(example.request, bytes([example.replied[0], count - 1]) + example.data[:-1])
    mismatches(example.request, bytes([example.replied[0], count + 1]) + example.data + b"\0")


def test_unused_bits_of_the_last_byte_are_cleared() -> None:
    assert decode_reply(ReadRequest(1, 0, 9), b"\x01\x02\xff\xff") == b"\xff\x01"
    assert decode_reply(ReadRequest(2, 0, 1), b"\x02\x01\xfe") == b"\x00"
    assert decode_reply(ReadRequest(2, 0, 7), b"\x02\x01\xff") == b"\x7f"


def test_a_last_byte_in_full_use_is_left_alone_and_so_is_a_register() -> None:
    assert decode_reply(ReadRequest(1, 0, 16), b"\x01\x02\xff\xff") == b"\xff\xff"
    assert decode_reply(ReadRequest(3, 0, 1), b"\x03\x02\xff\xff") == b"\xff\xff"


def test_the_largest_replies_are_252_bytes_and_understood() -> None:
    assert decode_reply(ReadRequest(1, 0, 2000), b"\x01\xfa" + b"\xa5" * 250) == b"\xa5" * 250
    assert decode_reply(ReadRequest(4, 0, 125), b"\x04\xfa" + b"\xa5" * 250) == b"\xa5" * 250


# ------------------------------------------------------------------------------------------------ values


def test_bits_are_packed_with_the_first_in_the_lowest_bit() -> None:
    assert pack_bits([True, False, True, True, False, False, True, True]) == b"\xcd"  # coils 20 to 27 of section 6.11
    assert pack_bits([False] * 8 + [True]) == b"\x00\x01"
    assert pack_bits([]) == b""
    assert [bit_at(b"\xcd\x01", index) for index in range(10)] == [1, 0, 1, 1, 0, 0, 1, 1, 1, 0]


def test_words_are_packed_with_the_high_byte_first() -> None:
    assert pack_words([10, 258, 65535]) == b"\x00\x0a\x01\x02\xff\xff"
    assert [word_at(b"\x00\x0a\x01\x02", index) for index in range(2)] == [10, 258]


def test_a_span_knows_its_end_and_its_size_on_the_wire() -> None:
    assert Span(Table.HOLDING_REGISTERS, 65535, 1).stop == 65536
    assert Span(Table.INPUT_REGISTERS, 0, 125).size == 250
    assert [Span(Table.COILS, 3, count).size for count in (1, 8, 9, 2000)] == [1, 1, 2, 250]
    assert [table.is_bits for table in Table] == [True, True, False, False]


def test_spans_overlap_only_in_one_table_and_on_a_common_point() -> None:
    middle = Span(Table.COILS, 10, 10)
    assert middle.overlaps(Span(Table.COILS, 19, 1))
    assert middle.overlaps(Span(Table.COILS, 0, 11))
    assert not middle.overlaps(Span(Table.COILS, 20, 1))
    assert not middle.overlaps(Span(Table.COILS, 0, 10))
    assert not middle.overlaps(Span(Table.DISCRETE_INPUTS, 10, 10))
