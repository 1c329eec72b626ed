"""Function 43/14, read device identification, byte for byte (application protocol V1.1b3, section 6.21)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.pdu import DecodePDU

from gateway.modbus.diagnostics import LineDiagnostics
from gateway.modbus.identification import Identity, read_device_identification
from gateway.modbus.server import Server, answer
from gateway.register import DataRegister
from tests import peers
from tests.fakes import SCADA
from tests.lines import UNIT, serving_tcp, tcp_config
from tests.modbus import wire

#  Section 6.21's own example; its "Product code XX" is longer than its length byte 0D, so two letters are left out.
EXAMPLE = Identity("Company identification", "Product codeX", "V2.11")
LONG = Identity("V" * 64, "P" * 64, "R" * 64)  # as long as a configuration allows


@pytest.fixture
def server(register: DataRegister) -> Server:
    return Server(register, SCADA, identity=EXAMPLE)


def asked(server: Server, request: str) -> str:
    return answer(wire(request), server).hex(" ").upper()


def told(reply: str) -> str:
    """An annotated reply as ``asked`` gives it."""
    return wire(reply).hex(" ").upper()


VENDOR = "00 16 43 6F 6D 70 61 6E 79 20 69 64 65 6E 74 69 66 69 63 61 74 69 6F 6E  # Company identification"
PRODUCT = "01 0D 50 72 6F 64 75 63 74 20 63 6F 64 65 58                            # Product codeX"
REVISION = "02 05 56 32 2E 31 31                                                    # V2.11"
NAME = "04 0D 50 72 6F 64 75 63 74 20 63 6F 64 65 58                            # Product codeX"


# ------------------------------------------------------------------------------------------------ as printed


def test_basic_identification_is_told_as_in_section_6_21(server: Server) -> None:
    reply = f"""
        2B 0E 01    # function, MEI type, read device ID code: basic
        82          # conformity level: the example's 01, here regular, stream and individual access
        00 00 03    # nothing more follows, next object 0, 3 objects
        {VENDOR}
        {PRODUCT}
        {REVISION}
    """
    assert asked(server, "2B 0E 01 00") == told(reply)


def test_regular_identification_adds_the_product_name(server: Server) -> None:
    reply = f"""
        2B 0E 02 82 00 00 04
        {VENDOR}
        {PRODUCT}
        {REVISION}
        {NAME}
    """
    assert asked(server, "2B 0E 02 00") == told(reply)


def test_extended_identification_tells_what_there_is_the_regular(server: Server) -> None:
    """A level above the conformity level is answered at the conformity level; the code asked for is echoed."""
    regular = asked(server, "2B 0E 02 00")
    assert asked(server, "2B 0E 03 00") == regular[:6] + "03" + regular[8:]


@pytest.mark.parametrize(("number", "text"), [("00", VENDOR), ("01", PRODUCT), ("02", REVISION), ("04", NAME)])
def test_one_object_is_told_by_itself(server: Server, number: str, text: str) -> None:
    assert asked(server, f"2B 0E 04 {number}") == told(f"2B 0E 04 82 00 00 01\n{text}")


def test_an_empty_text_is_an_object_without_bytes(server: Server) -> None:
    unknown = replace(server, identity=Identity("A", "B", ""))
    assert asked(unknown, "2B 0E 04 02") == "2B 0E 04 82 00 00 01 02 00"
    assert asked(unknown, "2B 0E 01 00") == "2B 0E 01 82 00 00 03 00 01 41 01 01 42 02 00"


def test_a_letter_outside_ascii_is_told_as_a_question_mark(server: Server) -> None:
    assert asked(replace(server, identity=Identity("Ä", "", "")), "2B 0E 04 00") == "2B 0E 04 82 00 00 01 00 01 3F"


def test_the_serial_line_tells_the_same_as_tcp(server: Server) -> None:
    on_line = replace(server, line=LineDiagnostics())
    for request in ("2B 0E 01 00", "2B 0E 02 00", "2B 0E 04 01", "2B 0E 04 03", "2B 0D 00"):
        assert asked(on_line, request) == asked(server, request)


def test_functions_narrows_it_and_writable_does_not(server: Server) -> None:
    assert asked(replace(server, functions=frozenset({3})), "2B 0E 01 00") == "AB 01"
    assert asked(replace(server, functions=frozenset({43}), writable=False), "2B 0E 01 00")[:8] == "2B 0E 01"


# ------------------------------------------------------------------------------------------------ what is refused


@pytest.mark.parametrize("number", [3, 5, 6, 7, 0x7F, 0x80, 0xFE, 0xFF])
def test_an_object_that_there_is_not_is_refused_by_itself_with_exception_2(server: Server, number: int) -> None:
    assert asked(server, f"2B 0E 04 {number:02X}") == "AB 02"


def test_every_code_but_1_to_4_is_refused_with_exception_3(server: Server) -> None:
    refused = [code for code in range(256) if asked(server, f"2B 0E {code:02X} 00") == "AB 03"]
    assert refused == [0, *range(5, 256)]


def test_a_wrong_code_is_told_before_a_missing_object(server: Server) -> None:
    assert asked(server, "2B 0E 05 FF") == "AB 03"


def test_every_other_mei_type_is_unknown_whatever_follows(server: Server) -> None:
    for follows in ("", "01", "01 00", "01 00 00"):
        unknown = [mei for mei in range(256) if asked(server, f"2B {mei:02X} {follows}") == "AB 01"]
        assert unknown == [mei for mei in range(256) if mei != 0x0E]


@pytest.mark.parametrize("request_", ["2B", "2B 0E", "2B 0E 01", "2B 0E 04", "2B 0E 01 00 00", "2B 0E 04 FF 00"])
def test_a_wrong_length_is_refused_with_exception_3(server: Server, request_: str) -> None:
    assert asked(server, request_) == "AB 03"


# ------------------------------------------------------------------------------------------------ streams


def objects_of(reply: str) -> list[int]:
    """The identifiers of the objects in *reply*, whose lengths have to come out even."""
    data, numbers = bytes.fromhex(reply)[7:], []
    while data:
        numbers.append(data[0])
        assert len(data) >= 2 + data[1]
        data = data[2 + data[1] :]
    assert len(numbers) == bytes.fromhex(reply)[6]
    return numbers


@pytest.mark.parametrize(
    ("code", "first", "numbers"),
    [
        (1, 1, [1, 2]),
        (1, 2, [2]),
        (1, 4, [0, 1, 2]),  # no basic object
        (2, 1, [1, 2, 4]),
        (2, 4, [4]),
        (3, 4, [4]),
        *((code, unknown, [0, 1, 2]) for code in (1,) for unknown in (3, 5, 0x7F, 0x80, 0xFF)),
        *((code, unknown, [0, 1, 2, 4]) for code in (2, 3) for unknown in (3, 5, 0x7F, 0x80, 0xFF)),
    ],
)
def test_a_stream_starts_where_it_is_told_to_and_over_at_an_unknown_object(
    server: Server, code: int, first: int, numbers: list[int]
) -> None:
    reply = asked(server, f"2B 0E {code:02X} {first:02X}")
    assert objects_of(reply) == numbers
    assert reply[12:17] == "00 00"  # nothing more follows


def test_what_does_not_fit_follows_in_the_next_request(server: Server) -> None:
    long = replace(server, identity=LONG)
    first = asked(long, "2B 0E 02 00")
    #  7 + 3 x 66 are 205 bytes; 66 more would be 271, above 253
    header = """
        2B 0E 02 82
        FF 04       # more follows, from object 4
        03          # 3 objects
    """
    assert first == told(header) + " 00 40" + " 56" * 64 + " 01 40" + " 50" * 64 + " 02 40" + " 52" * 64
    assert asked(long, "2B 0E 02 04") == "2B 0E 02 82 00 00 01 04 40" + " 50" * 64


@pytest.mark.parametrize(
    ("length", "last_of_first"),
    [
        (232, 2),  # 7 + (2 + 4) + 2 + 232 + 6 = 253: the third just fits
        (233, 1),  # one byte more, and it does not
    ],
)
def test_a_reply_is_filled_to_253_bytes_and_not_beyond(server: Server, length: int, last_of_first: int) -> None:
    reply = asked(replace(server, identity=Identity("Acme", "P" * length, "2.11")), "2B 0E 01 00")
    assert objects_of(reply) == list(range(last_of_first + 1))
    assert len(bytes.fromhex(reply)) == (253 if last_of_first == 2 else 248)
    assert reply[12:17] == ("00 00" if last_of_first == 2 else "FF 02")


def test_the_longest_object_that_a_reply_can_carry_is_told(server: Server) -> None:
    long = replace(server, identity=Identity("V" * 244, "P" * 244, "R" * 244))
    assert asked(long, "2B 0E 04 00") == "2B 0E 04 82 00 00 01 00 F4" + " 56" * 244  # 253 bytes
    assert asked(long, "2B 0E 02 00") == "2B 0E 02 82 FF 01 01 00 F4" + " 56" * 244


@given(st.builds(Identity, *[st.text("abc", max_size=244)] * 3), st.sampled_from([1, 2, 3]))
def test_asking_on_until_nothing_follows_fetches_each_object_once(identity: Identity, code: int) -> None:
    decoder = DecodePDU(is_server=False)
    fetched: dict[int, bytes] = {}
    following: int | None = 0
    while following is not None:
        reply = read_device_identification(bytes([43, 14, code, following]), identity)
        assert len(reply) <= 253
        found: Any = decoder.decode(reply)
        assert found.number_of_objects == len(found.information) > 0
        assert not fetched.keys() & found.information.keys()
        fetched |= found.information
        assert (found.more_follows == 0xFF) or (found.more_follows, found.next_object_id) == (0, 0)
        following = found.next_object_id if found.more_follows else None
    expected = {0: identity.vendor, 1: identity.product, 2: identity.revision} | (
        {4: identity.product} if code > 1 else {}
    )
    assert fetched == {number: text.encode() for number, text in expected.items()}


# ------------------------------------------------------------------------------------------------ another's reading


def test_pymodbus_reads_us_over_tcp(register: DataRegister) -> None:
    with serving_tcp(tcp_config(), register) as served:
        served.task.server.identity = LONG
        with peers.client_tcp(served.port) as client:
            ask = client.read_device_information
            to_us = peers.unit_kwargs(UNIT)
            first: Any = ask(read_code=2, object_id=0, **to_us)
            rest: Any = ask(read_code=2, object_id=first.next_object_id, **to_us)
            one: Any = ask(read_code=4, object_id=2, **to_us)
            missing: Any = ask(read_code=4, object_id=3, **to_us)
    assert (first.conformity, first.more_follows, first.next_object_id) == (0x82, 0xFF, 4)
    assert first.information == {0: b"V" * 64, 1: b"P" * 64, 2: b"R" * 64}
    assert (rest.more_follows, rest.next_object_id, rest.information) == (0, 0, {4: b"P" * 64})
    assert (one.read_code, one.number_of_objects, one.information) == (4, 1, {2: b"R" * 64})
    assert (missing.isError(), missing.function_code, missing.exception_code) == (True, 0xAB, 2)
