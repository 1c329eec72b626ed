"""RTU frames out of a byte stream: what a slave's ear and a master's ear make of a shared line.

Frames are annotated; a CRC that stands in hexadecimal was printed by somebody else (a manual, the serial line guide) or
worked out by hand, the others are added by ``with_crc``, which knows no table.
"""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from gateway.modbus.framing import (
    Frame,
    Framer,
    RtuReplyFramer,
    RtuRequestFramer,
    crc16,
    encode_rtu,
    reply_framer,
    request_framer,
)
from gateway.modbus.pdu import REPLY_SHAPES, REQUEST_SHAPES, pdu_length
from tests.modbus import crc_bit_by_bit, drain, one_by_one, wire, with_crc

POLL = wire("""
    02      # unit 2
    04      # read input registers
    00 00   # from address 0
    00 06   # 6 of them
    70 3B   # CRC, low byte first
""")
POLLED = Frame(2, b"\x04\x00\x00\x00\x06")
VOLTAGES = wire("""
    02              # unit 2, a three-phase meter
    04              # read input registers
    0C              # 12 bytes
    43 66 33 34     # phase 1, a float: 230.2 V
    43 65 CC CD     # phase 2: 229.8 V
    43 67 00 00     # phase 3: 231.0 V
    4C 51           # CRC
""")
MEASURED = Frame(2, VOLTAGES[1:-2])
METER = wire("""
    01              # unit 1, the example of a meter's manual
    04              # read input registers
    04              # 4 bytes
    43 66 33 34     # 230.2 V
    1B 38           # CRC
""")
REFUSAL = wire("""
    02      # unit 2
    84      # read input registers, refused
    02      # illegal data address
    32 C1   # CRC
""")
OTHERS_POLL = wire("""
    11      # unit 17
    03      # read holding registers
    00 6B   # from address 107
    00 03   # 3 of them
    76 87   # CRC
""")
OTHERS_REPLY = wire("""
    11                  # unit 17
    03                  # read holding registers
    06                  # 6 bytes
    AE 41 56 52 43 40   # 44609, 22098, 17216
    49 AD               # CRC
""")
OTHERS_WRITE = with_crc("""
    05              # unit 5
    10              # write multiple registers
    00 01           # from address 1
    00 02           # 2 of them
    04              # 4 bytes
    00 0A 01 02     # 10, 258
""")
OTHERS_ECHO = with_crc("05 10 00 01 00 02  # unit 5 has written 2 registers from address 1")
TO_ALL = with_crc("00 06 00 01 00 03  # unit 0: write 3 to register 1")


def frame_of(data: bytes) -> Frame:
    return Frame(data[0], data[1:-2])


def damaged(data: bytes) -> bytes:
    """*data* with a bit of its CRC turned over."""
    return data[:-1] + bytes([data[-1] ^ 0x10])


def heard(*bursts: bytes, framer: RtuRequestFramer | None = None) -> list[Frame]:
    """What a slave's ear makes of *bursts*, with a silence after each."""
    framer = framer or RtuRequestFramer()
    found = []
    for burst in bursts:
        framer.receive_data(burst)
        framer.silence()
        found += drain(framer)
    return found


def awaiting(unit: int = 2, function: int = 4) -> RtuReplyFramer:
    framer = RtuReplyFramer()
    framer.expect(unit, function)
    return framer


def answered(pieces: Iterable[bytes], framer: RtuReplyFramer) -> list[Frame]:
    """What a master's ear makes of *pieces*."""
    found = []
    for piece in pieces:
        framer.receive_data(piece)
        found += drain(framer)
    return found


# ------------------------------------------------------------------------------------------------ checksum, encoding


def test_the_crc_of_known_frames_is_the_printed_one() -> None:
    assert crc16(b"\x02\x07") == 0x1241  # serial line guide, appendix B
    assert crc16(b"123456789") == 0x4B37  # the check value by which this CRC is catalogued
    assert crc16(POLL[:-2]) == 0x3B70
    assert crc16(OTHERS_POLL[:-2]) == 0x8776
    assert crc16(b"") == 0xFFFF


def test_the_crc_is_the_one_computed_bit_by_bit() -> None:
    for length in range(257):
        data = bytes((7 * length + 31 * place) & 0xFF for place in range(length))
        assert crc16(data).to_bytes(2, "little") == crc_bit_by_bit(data)
        assert crc16(memoryview(data)) == crc16(bytearray(data)) == crc16(data)


@pytest.mark.parametrize("framer", [request_framer("rtu"), reply_framer("rtu")], ids=["slave", "master"])
def test_a_frame_is_encoded_with_its_crc_low_byte_first(framer: Framer) -> None:
    assert framer.encode(POLLED) == POLL
    assert framer.encode(MEASURED) == VOLTAGES
    assert encode_rtu(frame_of(METER)) == METER


def test_the_two_ears_are_different_framers_and_never_broken() -> None:
    assert isinstance(request_framer("rtu"), RtuRequestFramer)
    assert isinstance(reply_framer("rtu"), RtuReplyFramer)
    assert not request_framer("rtu").broken
    assert not reply_framer("rtu").broken


# ------------------------------------------------------------------------------------------------ lengths


LENGTHS = [  # section, request, reply
    ("6.1", "01 00 13 00 13", "01 03 CD 6B 05"),
    ("6.7", "07", "07 6D"),
    ("6.8", "08 00 00 A5 37", "08 00 00 A5 37"),
    ("6.9", "0B", "0B FF FF 01 08"),
    ("6.10", "0C", "0C 08 00 00 01 08 01 21 20 00"),
    ("6.11", "0F 00 13 00 0A 02 CD 01", "0F 00 13 00 0A"),
    ("6.12", "10 00 01 00 02 04 00 0A 01 02", "10 00 01 00 02"),
    ("6.13", "11", "11 02 01 FF"),
    ("6.14", "14 07 06 00 04 00 01 00 02", "14 06 05 06 0D FE 00 20"),
    ("6.15", "15 09 06 00 04 00 07 00 01 06 AF", "15 09 06 00 04 00 07 00 01 06 AF"),
    ("6.16", "16 00 04 00 F2 00 25", "16 00 04 00 F2 00 25"),
    ("6.17", "17 00 03 00 06 00 0E 00 01 02 00 FF", "17 04 00 FE 0A CD"),
    ("6.18", "18 04 DE", "18 00 06 00 02 01 B8 12 84"),
    ("6.21", "2B 0E 01 00", "AB 01"),
    ("7", "01 04 A1 00 01", "81 02"),
]


@pytest.mark.parametrize(("section", "request_", "reply"), LENGTHS, ids=[section for section, _, _ in LENGTHS])
def test_a_pdu_tells_its_length_and_a_part_of_it_never_a_greater_one(section: str, request_: str, reply: str) -> None:
    for shapes, text in ((REQUEST_SHAPES, request_), (REPLY_SHAPES, reply)):
        pdu = bytes.fromhex(text)
        assert pdu_length(shapes, pdu) == len(pdu)
        assert pdu_length(shapes, pdu + b"\xff\xff\xff") == len(pdu)
        for stop in range(1, len(pdu)):
            assert stop < (pdu_length(shapes, pdu[:stop]) or 0) <= len(pdu)


def test_an_unknown_function_and_no_bytes_at_all_have_no_length() -> None:
    assert pdu_length(REQUEST_SHAPES, b"\x41\x00\x00\x00\x00") is None
    assert pdu_length(REPLY_SHAPES, b"\x2b\x0e\x01\x01") is None
    assert pdu_length(REQUEST_SHAPES, b"") is None


# ------------------------------------------------------------------------------------------------ a slave's ear


def test_a_request_is_heard_after_silence_and_not_before() -> None:
    framer = RtuRequestFramer()
    framer.receive_data(POLL)
    assert framer.next_frame() is None
    assert framer.pending == 8
    framer.silence()
    assert framer.next_frame() == POLLED
    assert framer.next_frame() is None
    assert (framer.pending, framer.damaged) == (0, 0)


def test_a_request_is_heard_byte_by_byte_and_two_at_once() -> None:
    framer = RtuRequestFramer()
    for byte in one_by_one(POLL):
        framer.receive_data(byte)
        assert framer.next_frame() is None
    framer.silence()
    framer.receive_data(TO_ALL)
    framer.silence()
    assert drain(framer) == [POLLED, frame_of(TO_ALL)]  # what nobody fetched yet is not lost
    assert heard(POLL + POLL) == [POLLED, POLLED]


@pytest.mark.parametrize(
    "foreign",
    [OTHERS_POLL, OTHERS_REPLY, OTHERS_WRITE, OTHERS_ECHO, REFUSAL, METER, TO_ALL],
    ids=["read", "its reply", "write", "its reply", "exception", "meter", "broadcast"],
)
def test_others_frames_keep_the_sync_whether_alone_or_in_one_burst(foreign: bytes) -> None:
    assert heard(foreign, POLL) == [frame_of(foreign), POLLED]
    assert heard(foreign + POLL) == [frame_of(foreign), POLLED]
    assert heard(POLL + foreign) == [POLLED, frame_of(foreign)]


def test_a_whole_conversation_in_one_burst_comes_apart_frame_by_frame() -> None:
    talk = [OTHERS_POLL, OTHERS_REPLY, OTHERS_WRITE, OTHERS_ECHO, POLL, VOLTAGES, POLL, REFUSAL, TO_ALL, POLL]
    framer = RtuRequestFramer()
    assert heard(b"".join(talk), framer=framer) == [frame_of(data) for data in talk]
    assert framer.damaged == 0


@pytest.mark.parametrize(
    "data",
    [
        with_crc("02 41 01 02 03 04 05 06 07 08 09  # function 65, of some maker's own"),
        with_crc("02 41"),
        with_crc("02 03 00 00 00 01 00  # one byte too many"),
        with_crc("02 03 00 6B 00 01 00 00 00  # too many, and not as long as a reply with 0 bytes"),
        with_crc("02 03 00 00 00  # one byte too few"),
        with_crc("02 03  # nothing but the function"),
        with_crc("02 10 00 01 00 02 04 00 0A  # half the data that its byte count promises"),
        with_crc("02 10 00 01 00 02 03 00 0A 01 02  # a byte count one too small"),
        with_crc("02 2B 0E 01 01 00 00  # device identification, answered: its length stands nowhere"),
        with_crc("02 41" + " 55" * 252),
    ],
    ids=lambda data: data[:6].hex(" "),
)
def test_what_has_a_right_crc_is_one_frame_whatever_its_length(data: bytes) -> None:
    framer = RtuRequestFramer()
    assert heard(data, POLL, framer=framer) == [frame_of(data), POLLED]
    assert framer.damaged == 0


def test_a_frame_of_more_than_256_bytes_is_none() -> None:
    for too_long in ("02 41" + " 55" * 253, "02 10 00 00 00 7F FE" + " 55" * 254, "02 03 FC" + " 55" * 252):
        framer = RtuRequestFramer()
        assert heard(with_crc(too_long), framer=framer) == []
        assert (framer.pending, framer.damaged) == (0, 1)


def test_a_request_after_a_frame_that_only_silence_ends_is_heard_in_the_same_burst() -> None:
    foreign = with_crc("05 41 01 02 03 04 05 06 07 08 09  # function 65")
    assert heard(OTHERS_POLL + foreign) == [frame_of(OTHERS_POLL), frame_of(foreign)]
    assert heard(foreign + POLL) == [POLLED]


@pytest.mark.parametrize(
    "before",
    [damaged(OTHERS_POLL), damaged(OTHERS_REPLY), damaged(OTHERS_WRITE), damaged(POLL), b"\x00", b"\xff", b"\xff\xff"],
    ids=["poll", "reply", "write", "own", "a zero", "a one", "ones"],
)
def test_a_request_at_the_end_of_a_burst_is_heard_after_damage(before: bytes) -> None:
    framer = RtuRequestFramer()
    assert heard(before + POLL, framer=framer) == [POLLED]
    assert (framer.pending, framer.damaged) == (0, 1)


def test_damage_costs_its_own_frame_and_no_whole_frame_before_it() -> None:
    framer = RtuRequestFramer()
    assert heard(OTHERS_POLL + damaged(OTHERS_REPLY) + POLL, framer=framer) == [frame_of(OTHERS_POLL), POLLED]
    assert framer.damaged == 1
    assert heard(damaged(POLL), POLL, framer=framer) == [POLLED]
    assert framer.damaged == 2


def test_a_part_is_kept_over_a_silence_and_completed_later() -> None:
    for stop in range(1, len(POLL)):
        framer = RtuRequestFramer()
        assert heard(POLL[:stop], framer=framer) == []
        assert framer.pending == stop
        assert heard(POLL[stop:], framer=framer) == [POLLED]
        assert (framer.pending, framer.damaged) == (0, 0)


def test_a_part_after_a_whole_frame_is_kept_and_only_the_part() -> None:
    framer = RtuRequestFramer()
    assert heard(OTHERS_REPLY + POLL[:5], framer=framer) == [frame_of(OTHERS_REPLY)]
    assert framer.pending == 5
    assert heard(POLL[5:], framer=framer) == [POLLED]


def test_reset_throws_a_part_away_and_counts_it() -> None:
    framer = RtuRequestFramer()
    assert heard(POLL[:5], framer=framer) == []
    framer.reset()
    assert (framer.pending, framer.damaged) == (0, 1)
    assert heard(POLL, framer=framer) == [POLLED]
    framer.reset()
    assert framer.damaged == 1  # there was nothing to throw away


def test_expect_makes_a_slave_forget_parts_and_still_hear_everybody() -> None:
    framer = RtuRequestFramer()
    framer.receive_data(POLL[:5])
    framer.expect(17, 3)
    assert framer.pending == 0
    assert heard(POLL, framer=framer) == [POLLED]


def test_damage_that_promises_more_bytes_is_over_at_reset() -> None:
    broken_poll = damaged(with_crc("05 03 20 00 00 01  # as a reply this would have 32 bytes of data"))
    framer = RtuRequestFramer()
    assert heard(broken_poll, framer=framer) == []
    assert framer.pending == 8
    framer.reset()  # the driver does so after the character timeout
    assert heard(POLL, framer=framer) == [POLLED]


def test_a_request_inside_anothers_whole_frame_is_not_taken() -> None:
    quoting_reply = with_crc("05 03 08" + POLL.hex(" "))
    quoting_write = with_crc("05 10 00 00 00 04 08" + POLL.hex(" "))
    quoting_unknown = with_crc("05 41 " + POLL.hex(" "))
    for quoting in (quoting_reply, quoting_write, quoting_unknown):
        assert heard(quoting) == [frame_of(quoting)]
        assert heard(OTHERS_POLL + quoting) == [frame_of(OTHERS_POLL), frame_of(quoting)]


def test_a_request_in_the_middle_of_damage_is_not_taken() -> None:
    framer = RtuRequestFramer()
    assert heard(damaged(OTHERS_WRITE) + POLL + b"\x41\x41\x41\x41", framer=framer) == []
    assert (framer.pending, framer.damaged) == (0, 1)


def test_a_line_that_never_rests_fills_no_more_than_4096_bytes() -> None:
    framer = RtuRequestFramer()
    for _ in range(1000):
        framer.receive_data(b"\x55" * 100)
        assert framer.pending <= 4096
    assert framer.damaged > 0
    framer.receive_data(b"\x55" * 100_000)
    assert framer.pending <= 4096
    framer.reset()
    assert heard(POLL, framer=framer) == [POLLED]


# ------------------------------------------------------------------------------------------------ a master's ear


@pytest.mark.parametrize(
    ("data", "unit", "function"),
    [
        (VOLTAGES, 2, 4),
        (REFUSAL, 2, 4),
        (METER, 1, 4),
        (OTHERS_REPLY, 17, 3),
        (OTHERS_ECHO, 5, 16),
        (with_crc("02 01 03 CD 6B 05"), 2, 1),
        (with_crc("02 05 00 AC FF 00"), 2, 5),
        (with_crc("02 16 00 04 00 F2 00 25"), 2, 22),
        (with_crc("02 17 04 00 FE 0A CD"), 2, 23),
        (with_crc("02 18 00 06 00 02 01 B8 12 84"), 2, 24),
        (with_crc("02 03 00  # no data at all: its request will tell that this is wrong"), 2, 3),
        (with_crc("02 03 FA" + " 5A" * 250), 2, 3),
    ],
    ids=lambda value: value[:3].hex(" ") if isinstance(value, bytes) else str(value),
)
def test_a_reply_is_whole_with_its_last_byte_and_not_before(data: bytes, unit: int, function: int) -> None:
    framer = awaiting(unit, function)
    assert answered(one_by_one(data[:-1]), framer) == []
    assert answered([data[-1:]], framer) == [frame_of(data)]
    assert answered([data], awaiting(unit, function)) == [frame_of(data)]
    assert (framer.pending, framer.damaged) == (0, 0)


def test_two_replies_at_once_are_two_and_the_second_is_pending_until_asked_for() -> None:
    framer = awaiting()
    framer.receive_data(VOLTAGES + REFUSAL)
    assert framer.next_frame() == MEASURED
    assert framer.pending == len(REFUSAL)
    assert framer.next_frame() == frame_of(REFUSAL)
    assert framer.pending == 0


def test_bytes_after_the_reply_stay_pending() -> None:
    framer = awaiting()
    framer.receive_data(VOLTAGES + b"\x00")
    assert framer.next_frame() == MEASURED
    assert framer.pending == 1


@pytest.mark.parametrize(
    "before",
    [
        b"\x00",
        b"\xff\x00\xff",
        b"\x02",  # the unit, then not the function
        b"\x02\x02\x02",
        b"\x02\x03\x04",  # the unit with another function
        OTHERS_REPLY,
        METER,
        with_crc("02 03 02 00 0A  # the right unit, to another question"),
    ],
    ids=lambda data: data.hex(" "),
)
def test_what_comes_before_the_awaited_unit_and_function_is_dropped(before: bytes) -> None:
    assert answered([before + VOLTAGES], awaiting()) == [MEASURED]
    assert answered(one_by_one(before + VOLTAGES), awaiting()) == [MEASURED]


def test_another_unit_alone_leaves_nothing_behind() -> None:
    framer = awaiting()
    assert answered([METER], framer) == []
    assert (framer.pending, framer.damaged) == (0, 0)


def test_a_wrong_crc_is_counted_and_the_good_frame_after_it_found() -> None:
    framer = awaiting()
    assert answered([damaged(VOLTAGES)], framer) == []
    assert framer.damaged == 1
    assert answered([VOLTAGES], framer) == [MEASURED]


def test_a_start_inside_a_damaged_frame_is_tried_too() -> None:
    framer = awaiting()
    assert answered([b"\x02\x04\x02" + VOLTAGES], framer) == [MEASURED]
    assert framer.damaged == 1


def test_a_start_that_promises_too_much_is_given_up_at_silence() -> None:
    framer = awaiting()
    assert answered([b"\x02\x04\xc8" + VOLTAGES], framer) == []  # "200 bytes follow"
    assert framer.pending == 3 + len(VOLTAGES)
    framer.silence()
    assert drain(framer) == [MEASURED]
    assert (framer.pending, framer.damaged) == (0, 1)


def test_silence_with_nothing_held_is_no_damage() -> None:
    framer = awaiting()
    framer.silence()
    assert framer.damaged == 0
    framer.receive_data(b"\x02")
    framer.silence()
    assert (framer.pending, framer.damaged) == (0, 1)


def test_a_function_without_a_length_ends_with_what_has_come() -> None:
    identification = with_crc("02 2B 0E 01 01 00 00 01 00 03 41 42 43")
    assert answered([identification], awaiting(2, 43)) == [frame_of(identification)]


def test_expect_and_reset_forget_what_is_held() -> None:
    framer = awaiting()
    framer.receive_data(VOLTAGES)
    framer.expect(1, 4)
    assert framer.pending == 0
    assert answered([VOLTAGES + METER], framer) == [frame_of(METER)]
    framer.receive_data(METER[:5])
    framer.reset()
    assert (framer.pending, framer.damaged) == (0, 0)
    assert answered([METER], framer) == [frame_of(METER)]


def test_whoever_awaits_nobody_hears_nothing_and_keeps_nothing() -> None:
    framer = RtuReplyFramer()
    assert answered([VOLTAGES, b"\xff\xff"], framer) == []
    assert framer.pending == 0


@pytest.mark.parametrize("babble", [b"\x00", b"\x02\x04\xff", b"\x02\x04", b"\x02", bytes(range(256))], ids=len)
def test_endless_babble_is_held_up_to_one_frame(babble: bytes) -> None:
    framer = awaiting()
    for _ in range(2000 // len(babble) + 2):
        framer.receive_data(babble)
        drain(framer)
        assert framer.pending < 256
    framer.receive_data(babble * 20_000 if len(babble) < 4 else babble)
    drain(framer)
    assert framer.pending < 256


def test_a_start_that_promises_more_than_256_bytes_is_given_up_at_once() -> None:
    for too_many in (252, 255):  # unit, function, count, so many bytes and CRC would be 257 and 260
        framer = awaiting()
        assert answered([bytes([2, 4, too_many]) + VOLTAGES], framer) == [MEASURED]
        assert answered([with_crc(f"02 04 {too_many:02X}" + " 5A" * too_many)], framer) == []
        assert framer.pending == 0
    longest = with_crc("02 04 FB" + " 5A" * 251)
    assert len(longest) == 256
    assert answered([longest], awaiting()) == [frame_of(longest)]


@pytest.mark.parametrize("noise", [b"\x00", b"\xff", b"\x00\x00", b"\xff\x00"])
@pytest.mark.parametrize("unit", [1, 3, 6, 15, 16, 17, 22, 23])
def test_noise_of_a_turning_driver_makes_no_slave_deaf(noise: bytes, unit: int) -> None:
    """With the noise as a unit and our unit as a function, it looks like the start of a longer frame."""
    for pdu in (bytes.fromhex("03 0000 0001"), bytes.fromhex("06 0001 0003"), bytes.fromhex("10 0001 0001 02 000A")):
        framer = RtuRequestFramer()
        framer.receive_data(noise + encode_rtu(Frame(unit, pdu)))
        framer.silence()
        frames = drain(framer)
        assert frames[-1] == Frame(unit, pdu)
        assert framer.pending == 0
