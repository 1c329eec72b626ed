"""What a slave answers, byte for byte, on a real register (application protocol V1.1b3, sections 6 and 7; spec 3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.commands import CommandQueue, Outlet
from gateway.modbus.pdu import Span, Table, decode_reply, decode_request
from gateway.modbus.server import Server, answer
from gateway.register import DataRegister, Quality, Sample, Source, SourceKind
from tests.fakes import JumpingClock
from tests.modbus import wire

SCADA = Source(SourceKind.CLIENT, "scada 10.0.0.5:40232")
FIELD = Source(SourceKind.REQUEST, "field/boiler")
HOLDING = Table.HOLDING_REGISTERS
EVERY_FUNCTION = [1, 2, 3, 4, 5, 6, 15, 16, 22, 23]


@pytest.fixture
def server(register: DataRegister) -> Server:
    return Server(register, SCADA)


def fill(register: DataRegister, table: Table, start: int, count: int, data: str) -> None:
    register.write(Span(table, start, count), bytes.fromhex(data), FIELD)


def everything(register: DataRegister) -> list[list[Sample]]:
    """Value, quality, age and source of every point."""
    return [register.samples(Span(table, 0, register.size(table))) for table in Table]


def asked(server: Server, request: str) -> str:
    return answer(wire(request), server).hex(" ").upper()


# ------------------------------------------------------------------------------------------------ as printed


def test_coils_are_read_as_in_section_6_1(server: Server) -> None:
    fill(server.register, Table.COILS, 19, 19, "CD 6B 05")
    assert asked(server, "01 00 13 00 13  # 19 from address 19") == "01 03 CD 6B 05"


def test_discrete_inputs_are_read_as_in_section_6_2(server: Server) -> None:
    fill(server.register, Table.DISCRETE_INPUTS, 196, 22, "AC DB 35")
    assert asked(server, "02 00 C4 00 16  # 22 from address 196") == "02 03 AC DB 35"


def test_holding_registers_are_read_as_in_section_6_3(server: Server) -> None:
    fill(server.register, HOLDING, 107, 3, "02 2B 00 00 00 64")
    assert asked(server, "03 00 6B 00 03  # 3 from address 107") == "03 06 02 2B 00 00 00 64"


def test_input_registers_are_read_as_in_section_6_4(server: Server) -> None:
    fill(server.register, Table.INPUT_REGISTERS, 8, 1, "00 0A")
    assert asked(server, "04 00 08 00 01  # 1 from address 8") == "04 02 00 0A"


def test_a_coil_is_written_as_in_section_6_5(server: Server) -> None:
    assert asked(server, "05 00 AC FF 00  # coil 173 on") == "05 00 AC FF 00"
    assert asked(server, "01 00 AB 00 03") == "01 01 02"
    assert asked(server, "05 00 AC 00 00  # coil 173 off") == "05 00 AC 00 00"
    assert asked(server, "01 00 AB 00 03") == "01 01 00"


def test_a_register_is_written_as_in_section_6_6(server: Server) -> None:
    assert asked(server, "06 00 01 00 03  # register 2 becomes 3") == "06 00 01 00 03"
    assert asked(server, "03 00 00 00 03") == "03 06 00 00 00 03 00 00"


def test_coils_are_written_as_in_section_6_11(server: Server) -> None:
    fill(server.register, Table.COILS, 16, 16, "FF FF")
    assert asked(server, "0F 00 13 00 0A 02 CD 01  # 10 from address 19") == "0F 00 13 00 0A"
    #  address 16 to 18 were on; 19 to 26 are CD, 27 and 28 are 1 and 0; 29 to 31 were on
    assert asked(server, "01 00 10 00 10") == "01 02 6F EE"


def test_registers_are_written_as_in_section_6_12(server: Server) -> None:
    assert asked(server, "10 00 01 00 02 04 00 0A 01 02  # 10 and 258 from address 1") == "10 00 01 00 02"
    assert asked(server, "03 00 00 00 04") == "03 08 00 00 00 0A 01 02 00 00"


def test_a_register_is_masked_as_in_section_6_16(server: Server) -> None:
    fill(server.register, HOLDING, 4, 1, "00 12")
    assert asked(server, "16 00 04 00 F2 00 25  # address 4, AND F2, OR 25") == "16 00 04 00 F2 00 25"
    assert asked(server, "03 00 04 00 01") == "03 02 00 17"


def test_every_bit_of_a_mask_write_follows_the_formula(server: Server) -> None:
    #      register  0000 1111 0000 1111
    #      AND       0011 0011 0011 0011   1: the register's bit stays
    #      OR        0101 0101 0101 0101   where AND is 0: this bit instead
    fill(server.register, HOLDING, 0, 1, "0F 0F")
    assert asked(server, "16 00 00 33 33 55 55") == "16 00 00 33 33 55 55"
    assert asked(server, "03 00 00 00 01") == "03 02 47 47"


def test_registers_are_read_and_written_as_in_section_6_17(server: Server) -> None:
    fill(server.register, HOLDING, 3, 6, "00 FE 0A CD 00 01 00 03 00 0D 00 FF")
    request = """
        17                  # read/write multiple registers
        00 03               # read from address 3
        00 06               # 6 of them
        00 0E               # write from address 14
        00 03               # 3 of them
        06                  # 6 bytes
        00 FF 00 FF 00 FF   # 255 each
    """
    assert asked(server, request) == "17 0C 00 FE 0A CD 00 01 00 03 00 0D 00 FF"
    assert asked(server, "03 00 0D 00 05") == "03 0A 00 00 00 FF 00 FF 00 FF 00 00"


def test_read_write_writes_before_it_reads(server: Server) -> None:
    fill(server.register, HOLDING, 0, 3, "00 01 00 02 00 03")
    assert asked(server, "17 00 00 00 03 00 01 00 01 02 AB CD") == "17 06 00 01 AB CD 00 03"


def test_a_write_is_good_and_carries_its_clients_name(server: Server) -> None:
    asked(server, "06 00 01 00 03")
    assert server.register.samples(Span(HOLDING, 0, 2)) == [
        Sample(0, Quality.NEVER, None, None),
        Sample(3, Quality.GOOD, 0.0, SCADA),
    ]


def test_the_four_tables_are_apart(server: Server) -> None:
    asked(server, "05 00 07 FF 00")
    asked(server, "06 00 07 00 01")
    assert asked(server, "02 00 07 00 01") == "02 01 00"
    assert asked(server, "04 00 07 00 01") == "04 02 00 00"


# ------------------------------------------------------------------------------------------------ limits and ends


@pytest.fixture
def large(clock: JumpingClock) -> Server:
    """All four tables as large as the protocol can address."""
    return Server(DataRegister(clock, dict.fromkeys(Table, 65536)), SCADA)


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("01 FF FF 00 01", "01 01 00"),
        ("02 F8 30 07 D0  # 2000 up to the last", "02 FA" + " 00" * 250),
        ("03 FF 83 00 7D  # 125 up to the last", "03 FA" + " 00" * 250),
        ("04 FF FF 00 01", "04 02 00 00"),
        ("05 FF FF FF 00", "05 FF FF FF 00"),
        ("06 FF FF 12 34", "06 FF FF 12 34"),
        ("0F F8 50 07 B0 F6" + " FF" * 246, "0F F8 50 07 B0"),
        ("10 FF 85 00 7B F6" + " 12" * 246, "10 FF 85 00 7B"),
        ("16 FF FF 00 00 12 34", "16 FF FF 00 00 12 34"),
        ("17 FF 83 00 7D FF 87 00 79 F2" + " 12" * 242, "17 FA" + " 00" * 8 + " 12" * 242),
    ],
    ids=lambda text: text[:14],
)
def test_the_last_points_of_a_full_table_are_served(large: Server, request_: str, reply: str) -> None:
    assert asked(large, request_) == reply


@pytest.mark.parametrize(
    "request_",
    [
        "01 FF FF 00 02",
        "02 FF FF 00 02",
        "03 FF FF 00 02",
        "04 FF FF 00 02",
        "04 FF FF 00 7D",
        "0F FF FF 00 02 01 03",
        "10 FF FF 00 02 04 00 01 00 02",
        "17 FF FF 00 02 00 00 00 01 02 00 01  # the read",
        "17 00 00 00 01 FF FF 00 02 04 00 01 00 02  # the write",
    ],
)
def test_a_range_never_wraps_around_to_address_0(large: Server, request_: str) -> None:
    spans = [Span(table, start, 130) for table in Table for start in (0, 65536 - 130)]
    before = [large.register.samples(span) for span in spans]
    assert asked(large, request_) == f"{int(request_[:2], 16) | 0x80:02X} 02"
    assert [large.register.samples(span) for span in spans] == before


def test_the_first_point_that_a_table_lacks_is_refused(server: Server) -> None:
    assert asked(server, "03 07 CF 00 01  # 1999") == "03 02 00 00"
    assert asked(server, "03 07 D0 00 01  # 2000") == "83 02"
    assert asked(server, "03 07 CF 00 02  # 1999 and 2000") == "83 02"
    assert asked(server, "05 07 D0 FF 00") == "85 02"


# ------------------------------------------------------------------------------------------------ order of checks


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("", "80 01"),
        ("41  # a function nobody knows", "C1 01"),
        ("41 FF FF 00 00 00", "C1 01"),
        ("07", "87 01"),
        ("00 00 00 00 01", "80 01"),
        ("83 00 00 00 01  # an exception is no request", "83 01"),
        ("FF", "FF 01"),
        ("03", "83 03"),
        ("03 00 00 00", "83 03"),
        ("03 00 00 00 01 00  # one byte too many", "83 03"),
        ("03 FF FF 00 00  # no points, where none are", "83 03"),
        ("03 FF FF 00 7E  # 126 points, where none are", "83 03"),
        ("01 FF FF 07 D1  # 2001 coils, where none are", "81 03"),
        ("05 FF FF 12 34 00  # one byte too many, no such coil, no such value", "85 03"),
        ("05 FF FF 12 34  # no such coil, no such value", "85 02"),
        ("05 00 00 12 34  # no such value", "85 03"),
        ("05 00 00 00 01", "85 03"),
        ("06 FF FF 00  # one byte missing, no such register", "86 03"),
        ("0F FF FF 00 09 01 FF  # a byte count too small, no such coils", "8F 03"),
        ("10 FF FF 00 01 03 00 0A  # a wrong byte count, no such register", "90 03"),
        ("10 FF FF 00 01 02 00  # data missing, no such register", "90 03"),
        ("10 FF FF 00 7C F8" + " 00" * 248, "90 03"),
        ("10 FF FF 00 01 02 00 0A", "90 02"),
        ("16 FF FF 00 F2 00  # one byte missing, no such register", "96 03"),
        ("16 FF FF 00 F2 00 25", "96 02"),
        ("17 FF FF 00 01 00 00 00 00 00  # nothing to write, no such register to read", "97 03"),
        ("17 FF FF 00 7E 00 00 00 01 02 00 0A  # 126 to read, where none are", "97 03"),
        ("17 FF FF 00 01 00 00 00 01 02 00 0A  # no such register to read", "97 02"),
        ("17 00 00 00 01 FF FF 00 01 02 00 0A  # no such register to write", "97 02"),
    ],
    ids=lambda text: text.partition("#")[0].strip()[:26] or "nothing",
)
def test_function_then_length_then_address_then_value_is_checked(server: Server, request_: str, reply: str) -> None:
    before = everything(server.register)
    assert asked(server, request_) == reply
    assert everything(server.register) == before


def test_a_function_that_is_closed_is_refused_before_its_length_is_looked_at(server: Server) -> None:
    closed = replace(server, writable=False, functions=frozenset({3, 6}))
    assert asked(closed, "06 FF FF") == "86 01"
    assert asked(closed, "01 FF FF") == "81 01"
    assert asked(closed, "03 FF FF") == "83 03"


# ------------------------------------------------------------------------------------------------ what is served


SMALLEST = {
    1: "01 00 00 00 01",
    2: "02 00 00 00 01",
    3: "03 00 00 00 01",
    4: "04 00 00 00 01",
    5: "05 00 00 FF 00",
    6: "06 00 00 00 01",
    15: "0F 00 00 00 01 01 01",
    16: "10 00 00 00 01 02 00 01",
    22: "16 00 00 00 00 00 01",
    23: "17 00 00 00 01 00 00 00 01 02 00 01",
}


def served(server: Server) -> list[int]:
    """The functions that are answered with something other than exception 1."""
    return [function for function in SMALLEST if asked(server, SMALLEST[function]) != f"{function | 128:02X} 01"]


def test_without_a_word_everything_is_served(server: Server) -> None:
    assert served(server) == EVERY_FUNCTION


def test_what_is_not_writable_is_read_only_and_stays_as_it_was(server: Server) -> None:
    read_only = replace(server, writable=False)
    before = everything(server.register)
    assert served(read_only) == [1, 2, 3, 4]
    assert everything(server.register) == before


@pytest.mark.parametrize("function", EVERY_FUNCTION)
def test_functions_narrows_what_is_answered(server: Server, function: int) -> None:
    assert served(replace(server, functions=frozenset({function}))) == [function]
    assert served(replace(server, functions=frozenset(EVERY_FUNCTION) - {function})) == [
        other for other in EVERY_FUNCTION if other != function
    ]


def test_functions_opens_nothing_that_does_not_exist_or_is_not_writable(server: Server) -> None:
    assert asked(replace(server, functions=frozenset({65})), "41 00") == "C1 01"
    assert served(replace(server, functions=frozenset({3, 6}), writable=False)) == [3]


@pytest.mark.parametrize("function", EVERY_FUNCTION)
def test_only_the_window_is_served(server: Server, function: int) -> None:
    window = replace(server, first=10, count=5)
    for address in (0, 9, 15, 1999):
        assert asked(window, moved(function, address)) == f"{function | 128:02X} 02"
    for address in (10, 14):
        assert asked(window, moved(function, address)).startswith(f"{function:02X}")


def moved(function: int, address: int) -> str:
    """The smallest request of *function*, for *address*; function 23 reads and writes there."""
    pdu = bytearray.fromhex(SMALLEST[function])
    for place in (1, 5) if function == 23 else (1,):
        pdu[place : place + 2] = address.to_bytes(2, "big")
    return pdu.hex(" ")


def test_a_range_that_leaves_the_window_is_refused_whole(server: Server) -> None:
    window = replace(server, first=10, count=5)
    before = everything(server.register)
    assert asked(window, "10 00 0D 00 03 06 00 01 00 02 00 03") == "90 02"
    assert asked(window, "10 00 09 00 02 04 00 01 00 02") == "90 02"
    assert asked(window, "17 00 0A 00 05 00 0F 00 01 02 00 01") == "97 02"
    assert asked(window, "17 00 09 00 05 00 0A 00 01 02 00 01") == "97 02"
    assert everything(server.register) == before
    assert asked(window, "03 00 0A 00 05") == "03 0A" + " 00" * 10


def test_a_window_without_an_end_goes_to_the_end_of_the_table_and_never_beyond(server: Server) -> None:
    for count in (0, 65535):
        window = replace(server, first=1998, count=count)
        assert asked(window, "03 07 CE 00 02") == "03 04 00 00 00 00"
        assert asked(window, "03 07 CE 00 03") == "83 02"
        assert asked(window, "03 07 CD 00 01") == "83 02"


# ------------------------------------------------------------------------------------------------ old data


@pytest.fixture
def careful(server: Server) -> Server:
    """Answers 0x0B rather than old data; registers 10 to 14 are polled, stale after 5 s."""
    server.register.claim(Span(HOLDING, 10, 5), FIELD, 5.0)
    return replace(server, stale="exception")


def test_a_point_never_polled_yet_is_not_served_and_one_nobody_polls_is(careful: Server) -> None:
    assert asked(careful, "03 00 0A 00 05") == "83 0B"
    assert asked(careful, "03 00 0E 00 02  # one polled, one not") == "83 0B"
    assert asked(careful, "03 00 00 00 0A  # up to the first polled") == "03 14" + " 00" * 20
    assert asked(careful, "03 00 0F 00 01  # after the last polled") == "03 02 00 00"
    assert asked(careful, "04 00 0A 00 01  # another table") == "04 02 00 00"


def test_a_polled_point_is_served_up_to_its_age_and_not_beyond(careful: Server, clock: JumpingClock) -> None:
    fill(careful.register, HOLDING, 10, 5, "00 01 00 02 00 03 00 04 00 05")
    assert asked(careful, "03 00 0A 00 05") == "03 0A 00 01 00 02 00 03 00 04 00 05"
    clock.pass_s(5.0)
    assert asked(careful, "03 00 0E 00 01") == "03 02 00 05"
    clock.pass_s(0.001)
    assert asked(careful, "03 00 0E 00 01") == "83 0B"


def test_a_bad_point_is_not_served_and_its_good_neighbours_are(careful: Server) -> None:
    fill(careful.register, HOLDING, 10, 5, "00 01 00 02 00 03 00 04 00 05")
    careful.register.mark(Span(HOLDING, 12, 1), Quality.BAD, FIELD)
    assert asked(careful, "03 00 0A 00 02") == "03 04 00 01 00 02"
    assert asked(careful, "03 00 0A 00 03") == "83 0B"
    assert asked(careful, "03 00 0D 00 02") == "03 04 00 04 00 05"


def test_stale_serve_gives_old_and_bad_data_all_the_same(careful: Server, clock: JumpingClock) -> None:
    fill(careful.register, HOLDING, 10, 5, "00 01 00 02 00 03 00 04 00 05")
    careful.register.mark(Span(HOLDING, 12, 1), Quality.BAD, FIELD)
    clock.pass_s(1000.0)
    assert asked(replace(careful, stale="serve"), "03 00 0A 00 03") == "03 06 00 01 00 02 00 03"


def test_old_data_may_be_overwritten_but_read_write_is_refused_before_it_writes(careful: Server) -> None:
    before = everything(careful.register)
    assert asked(careful, "17 00 0A 00 01 00 00 00 01 02 00 01") == "97 0B"
    assert everything(careful.register) == before
    assert asked(careful, "06 00 0A 00 07") == "06 00 0A 00 07"
    assert asked(careful, "03 00 0A 00 01") == "03 02 00 07"
    assert asked(careful, "17 00 0A 00 01 00 0A 00 01 02 00 08") == "17 02 00 08"


def test_an_address_that_does_not_exist_is_told_before_old_data_is(careful: Server) -> None:
    assert asked(careful, "03 FF FF 00 01") == "83 02"
    assert asked(replace(careful, first=0, count=12), "03 00 0B 00 02") == "83 02"
    assert asked(careful, "17 00 0A 00 01 FF FF 00 01 02 00 01") == "97 02"


# ------------------------------------------------------------------------------------------------ the way down


@pytest.fixture
def full(server: Server, clock: JumpingClock) -> Iterator[Server]:
    """Points 0 to 9 of coils and holding registers go to a device, whose queue takes no command at all."""
    queue = CommandQueue(server.register, clock, wake=lambda: None, limit=0)
    queue.add(Outlet(Span(HOLDING, 0, 10), FIELD))
    queue.add(Outlet(Span(Table.COILS, 0, 10), FIELD))
    server.register.write(Span(HOLDING, 0, 10), bytes(20), FIELD)  # a poll: they are known
    yield server
    queue.close()


@pytest.mark.parametrize("function", [5, 6, 15, 16, 22, 23])
def test_a_write_whose_command_has_no_room_is_refused_whole_with_exception_6(full: Server, function: int) -> None:
    before = everything(full.register)
    assert asked(full, SMALLEST[function]) == f"{function | 128:02X} 06"
    assert everything(full.register) == before


def test_a_write_that_reaches_a_full_queue_with_one_point_stores_none(full: Server) -> None:
    before = everything(full.register)
    assert asked(full, "10 00 09 00 02 04 00 01 00 02") == "90 06"
    assert everything(full.register) == before
    assert asked(full, "10 00 0A 00 02 04 00 01 00 02  # not one of them") == "10 00 0A 00 02"


def test_a_full_queue_is_told_after_length_address_and_value(full: Server) -> None:
    assert asked(full, "10 00 00 00 01 02 00") == "90 03"
    assert asked(full, "10 00 09 FF 00 02 00 00") == "90 03"
    assert asked(full, "05 00 00 12 34") == "85 03"
    assert asked(replace(full, first=5), "06 00 00 00 01") == "86 02"


# ------------------------------------------------------------------------------------------------ counting


def test_every_request_is_counted_as_good_or_by_its_exception(server: Server) -> None:
    for request in ("03 00 00 00 01", "06 00 00 00 01", "41", "03 FF FF 00 01", "03 00 00 00 00", "03"):
        asked(server, request)
    assert (server.counters.requests, server.counters.good) == (6, 2)
    assert server.counters.exceptions == {1: 1, 2: 1, 3: 2}


# ------------------------------------------------------------------------------------------------ any PDU


address = st.integers(0, 12)
word = st.one_of(st.integers(0, 4), st.sampled_from([1, 2, 12, 13, 0xFF00, 0xFFFF]))


@st.composite
def pdus(draw: st.DrawFn) -> bytes:
    """PDUs at and around the limits of a register with 12 points in each table."""
    function, written = draw(st.sampled_from(EVERY_FUNCTION)), draw(word)
    pdu = bytes([function]) + draw(address).to_bytes(2, "big") + written.to_bytes(2, "big")
    if function in (15, 16, 23):
        if function == 23:
            written = draw(st.integers(0, 4))
            pdu += draw(address).to_bytes(2, "big") + written.to_bytes(2, "big")
        size = min(250, (written + 7) // 8 if function == 15 else 2 * written)
        pdu += bytes([size]) + draw(st.binary(min_size=size, max_size=size))
    if function == 22:
        pdu += draw(word).to_bytes(2, "big")
    return pdu + draw(st.sampled_from([b""] * 9 + [b"\x00"]))


def read_backs(pdu: bytes, reply: bytes) -> Iterator[tuple[bytes, bytes]]:
    """What to read after *pdu* was answered with *reply*, and what must come, on a register that was all zero."""
    address = pdu[1:3]
    match pdu[0]:
        case 5:
            yield b"\x01" + address + b"\x00\x01", b"\x01\x01" + (b"\x01" if pdu[3] == 0xFF else b"\x00")
        case 6:
            yield b"\x03" + address + b"\x00\x01", b"\x03\x02" + pdu[3:5]
        case 15:
            used = int.from_bytes(pdu[6:], "little") % (1 << pdu[4])
            yield b"\x01" + pdu[1:5], b"\x01" + pdu[5:6] + used.to_bytes(pdu[5], "little")
        case 16:
            yield b"\x03" + pdu[1:5], b"\x03" + pdu[5:]
        case 22:
            value = int.from_bytes(pdu[5:7], "big") & ~int.from_bytes(pdu[3:5], "big")
            yield b"\x03" + address + b"\x00\x01", b"\x03\x02" + value.to_bytes(2, "big")
        case 23:
            yield b"\x03" + pdu[5:9], b"\x03" + pdu[9:]
            yield b"\x03" + pdu[1:5], b"\x03" + reply[1:]
        case _:
            yield pdu, reply


@settings(derandomize=True, deadline=None, max_examples=1000)
@given(pdu=st.one_of(pdus(), st.binary(max_size=253)), stale=st.booleans(), full=st.booleans())
def test_any_request_is_answered_as_asked_or_refused_with_nothing_changed(pdu: bytes, stale: bool, full: bool) -> None:
    clock = JumpingClock()
    register = DataRegister(clock, dict.fromkeys(Table, 12))
    queue = CommandQueue(register, clock, wake=lambda: None, limit=0 if full else 1)
    queue.add(Outlet(Span(HOLDING, 8, 4), FIELD))
    register.claim(Span(Table.INPUT_REGISTERS, 3, 3), FIELD, 5.0)
    before = everything(register)
    reply = answer(pdu, Server(register, SCADA, stale="exception" if stale else "serve"))
    if len(reply) == 2 and reply[0] & 0x80:
        assert reply[0] == (pdu[0] if pdu else 0) | 0x80
        unknown = {4} if pdu[:1] == b"\x16" else set()  # a mask on a value nobody knows, which would go to a device
        assert reply[1] in {1, 2, 3} | unknown | ({6} if full else set()) | ({11} if stale else set())
        assert everything(register) == before
        return
    decode_reply(decode_request(pdu), reply)  # raises if it is no answer to this request
    for read, found in read_backs(pdu, reply):
        assert answer(read, Server(register, SCADA)) == found
