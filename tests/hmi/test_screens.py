"""What the screens do, where a transcript shows it badly: what is written and watched, which request is sent."""

from __future__ import annotations

import struct

import pytest

from gateway.hmi.keys import ESC
from gateway.hmi.station import Told
from gateway.modbus.pdu import Span, Table
from gateway.register import Quality
from tests.fakes import SCADA
from tests.hmi.desk import PROMPTS, Desk, DeskStation


def values(desk: Desk, table: Table, start: int, count: int = 1) -> list[int]:
    return [sample.value for sample in desk.station.register.samples(Span(table, start, count))]


def asked(desk: Desk, master: str = "field") -> list[tuple[int, bytes]]:
    """What was sent on a line: units and PDUs."""
    return [(unit, pdu) for _, unit, pdu in desk.station.fields[master].asked]


# ------------------------------------------------------------------------------------------------ Z


def test_what_a_person_writes_is_manual_and_from_the_menu(boiler: Desk) -> None:
    boiler.type("z3200\r-2\r")
    sample = boiler.station.register.samples(Span(Table.HOLDING_REGISTERS, 200, 1))[0]
    assert (sample.value, sample.quality, str(sample.source)) == (65534, Quality.MANUAL, "menu")


@pytest.mark.parametrize("table", list(Table))
def test_a_person_may_write_into_any_table(boiler: Desk, table: Table) -> None:
    boiler.type(f"z{int(table)}9\r1\r")
    assert values(boiler, table, 9) == [1]


@pytest.mark.parametrize(
    ("order", "registers"),
    [("1", [0x1234, 0x5678]), ("2", [0x5678, 0x1234]), ("3", [0x3412, 0x7856]), ("4", [0x7856, 0x3412])],
)
def test_32_bits_are_written_in_the_order_asked_for(boiler: Desk, order: str, registers: list[int]) -> None:
    boiler.type(f"z3200\rl\r{order}0x12345678\r")
    assert values(boiler, Table.HOLDING_REGISTERS, 200, 2) == registers
    float_value = struct.unpack(">f", bytes.fromhex("12345678"))[0]
    boiler.type(f"z3300\rf\r{order}{float_value:.9g}\r")
    assert values(boiler, Table.HOLDING_REGISTERS, 300, 2) == registers


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e39", "4294967295e30", "x", ""])
def test_what_no_register_can_hold_is_no_float(boiler: Desk, text: str) -> None:
    boiler.type(f"z3200\rf\r1{text}\r")
    assert "Please type a number such as -12.5 or 1e6, within 3.4e38." in boiler.screen
    assert values(boiler, Table.HOLDING_REGISTERS, 200, 2) == [0, 0]


def test_a_32_bit_value_is_written_as_one_block(boiler: Desk) -> None:
    written: list[tuple[Span, bytes]] = []
    boiler.station.register.watch(lambda write: written.append((write.span, write.data)))
    boiler.type("z3200\rl\r1-1\r")
    assert written == [(Span(Table.HOLDING_REGISTERS, 200, 2), b"\xff" * 4)]


def test_a_value_that_a_request_sends_goes_to_its_device(boiler: Desk) -> None:
    boiler.type("z3110\r650\r")
    assert "field/setpoint sends it to unit 17." in boiler.screen
    boiler.wait(1.0)
    assert [(w.unit, w.address, w.values) for w in boiler.station.fields["field"].writes] == [(17, 110, [650])]


def test_of_a_master_that_is_off_nobody_says_it_would_poll(boiler: Desk) -> None:
    boiler.type("az3107\r1\r")
    assert "its next poll overwrites" not in boiler.screen


def test_a_write_that_cannot_be_queued_is_refused_and_said_so() -> None:
    keys = 'unit = 1\nfunction = 6\ncount = 1\ntrigger = "change"\n'
    requests = [f"[[master.request]]\n{keys}address = {n}\npoint = {n}\n" for n in range(101)]
    desk = Desk(DeskStation('[[master]]\nname = "field"\nline = "/dev/ttyS2"\n' + "".join(requests)))
    for point in range(100):
        desk.station.register.write(Span(Table.HOLDING_REGISTERS, point, 1), b"\x00\x01", SCADA)
    desk.type("z3100\r5\r")
    assert desk.told == "100 commands wait for this line already"
    assert desk.screen.endswith(PROMPTS)
    assert values(desk, Table.HOLDING_REGISTERS, 100) == [0]


# ------------------------------------------------------------------------------------------------ D


def test_a_table_that_becomes_smaller_is_shown_as_far_as_it_goes(boiler: Desk) -> None:
    boiler.type("d31990\r10\r")
    boiler.station.register.resize({Table.HOLDING_REGISTERS: 1995})
    shown = boiler.wait(1.0)
    assert "  1994 " in shown
    assert "  1995 " not in shown
    boiler.station.register.resize({Table.HOLDING_REGISTERS: 200})
    assert "  1990 " not in boiler.wait(1.0)


def test_the_last_of_an_odd_count_is_shown_with_the_next_and_without_one_as_none(boiler: Desk) -> None:
    boiler.type("z3101\rl\r17\rd3100\r1\r" + ESC)
    shown = boiler.type("d399\r3\rf")
    assert "40100    99               0" in shown
    assert "40102   101               7" in shown
    shown = boiler.type(ESC + "d31997\r3\rf")
    assert "42000  1999               -             -             -             -" in shown


def test_of_two_registers_the_worse_quality_counts(boiler: Desk) -> None:
    boiler.type("z3300\r1\r")
    assert "never" in boiler.type("d3300\r2\rf").splitlines()[-22]


# ------------------------------------------------------------------------------------------------ C


def test_a_command_looks_asks_writes_and_looks_again(boiler: Desk) -> None:
    read, write = bytes.fromhex("03 00 0A 00 01"), bytes.fromhex("06 00 0A FF FF")
    boiler.type("c17\r310\r-1\r")
    assert asked(boiler) == [(17, read)]
    boiler.type("y")
    assert asked(boiler) == [(17, read), (17, write), (17, read)]


@pytest.mark.parametrize(("typed", "sent"), [("true", "FF 00"), ("1", "FF 00"), ("0", "00 00"), ("0x0", "00 00")])
def test_a_command_to_a_coil(boiler: Desk, typed: str, sent: str) -> None:
    boiler.type(f"c18\r10x20\r{typed}\ry")
    read = bytes.fromhex("01 00 20 00 01")
    assert asked(boiler) == [(18, read), (18, bytes.fromhex("05 00 20" + sent)), (18, read)]


@pytest.mark.parametrize("answer", ["n", ESC])
def test_who_does_not_say_yes_writes_nothing(boiler: Desk, answer: str) -> None:
    boiler.type("c17\r310\r5\r" + answer)
    assert boiler.station.fields["field"].writes == []
    assert boiler.screen.endswith(PROMPTS)


def test_a_broadcast_is_written_and_nothing_is_read(boiler: Desk) -> None:
    boiler.type("c0\r310\r5\ry")
    assert asked(boiler) == [(0, bytes.fromhex("06 00 0A 00 05"))]


def test_what_is_not_waited_for_is_written_all_the_same(boiler: Desk) -> None:
    boiler.type("c17\r310\r5\r")
    boiler.is_working = False
    boiler.type("y" + ESC)
    assert boiler.told == "Not waited for: it may be written all the same."
    boiler.wait(1.0)
    assert [w.values for w in boiler.station.fields["field"].writes] == [[5]]


def test_more_commands_than_a_line_takes_are_refused_at_the_main_menu(boiler: Desk) -> None:
    boiler.is_working = False
    for _ in range(16):
        boiler.type("c17\r310\r5\r" + ESC)
    boiler.type("c17\r310\r5\r")
    assert boiler.told == "16 commands wait for this line already"
    assert boiler.screen.endswith(PROMPTS)


def test_a_command_that_could_not_be_sent_says_so(boiler: Desk) -> None:
    boiler.type("c17\r310\r5\r")
    boiler.is_working = False
    boiler.type("y")
    boiler.station.masters["field"].close()  # it is made anew by somebody else
    boiler.wait(0.1)
    assert boiler.told == "not sent: the line was busy or was stopped"


def test_a_master_that_is_made_anew_cannot_be_used_for_a_moment(boiler: Desk) -> None:
    boiler.station.masters.pop("field").close()
    boiler.type("c")
    assert boiler.told == "field is being started anew: try again in a moment."


def test_the_traffic_of_a_line_that_is_made_anew_is_followed_on(boiler: Desk) -> None:
    boiler.type("t1")
    boiler.wait(1.0)
    old = boiler.station.masters["field"]
    assert old.traffic.is_watched
    boiler.station.masters.pop("field").close()
    boiler.wait(0.5)
    assert not old.traffic.is_watched
    boiler.station.masters["field"] = boiler.station._a_master(boiler.station.config.master[0])
    assert "> unit 17: read 3 holding registers" in boiler.wait(2.0)
    boiler.type(" ")
    assert not boiler.station.masters["field"].traffic.is_watched
    assert boiler.screen.endswith("rtugate> ")


# ------------------------------------------------------------------------------------------------ E, T, L, notices


def test_writes_are_watched_only_while_they_are_shown(boiler: Desk) -> None:
    register = boiler.station.register
    assert len(register._watchers) == 0
    boiler.type("e")
    assert len(register._watchers) == 1
    boiler.type("e")
    assert len(register._watchers) == 0
    boiler.type("eq")
    assert len(register._watchers) == 0
    boiler = Desk(boiler.station)
    boiler.type("ed")
    boiler.menu.close()
    assert len(register._watchers) == 0


def test_writes_beyond_a_hundred_are_counted(boiler: Desk) -> None:
    boiler.type("ed")
    for value in range(130):
        boiler.station.register.write(Span(Table.HOLDING_REGISTERS, 0, 1), bytes([0, value]), SCADA)
    boiler.type(ESC)
    boiler.is_working = False
    boiler.station.masters.clear()
    shown = [boiler.wait(0.5) for _ in range(6)]
    assert [text.count("<- scada") for text in shown] == [20] * 5 + [0]
    assert "... not shown: 30 more." in shown[0]
    assert "not shown" not in "".join(shown[1:])


def test_traffic_is_watched_only_while_it_is_shown(boiler: Desk) -> None:
    tap = boiler.station.masters["field"].traffic
    boiler.type("t1")
    assert tap.is_watched
    boiler.type(" ")
    assert not tap.is_watched
    boiler.type("t1")
    boiler.menu.close()
    assert not tap.is_watched


def test_more_frames_than_a_terminal_can_follow_are_counted(boiler: Desk) -> None:
    boiler.type("t2")
    tap = boiler.station.slaves["scada"].traffic
    for n in range(30):
        tap.tell(False, bytes.fromhex(f"00 {n:02X} 00 00 00 06 01 03 00 00 00 01"), "10.0.0.5:40232")
    shown = boiler.wait(0.3)
    assert shown.count("read 1 holding register at 0") == 20
    assert "... not shown: 10 more." in shown


def test_notices_are_told_once_and_not_those_from_before(boiler: Desk) -> None:
    boiler.station.told_notices.append(Told("{what} was first", {"what": "This"}))
    desk = Desk(boiler.station)
    assert "first" not in desk.wait(5.0)
    boiler.station.told_notices.append(Told("{what} was second", {"what": "This"}))
    assert "This was second\n" in desk.wait(5.0)
    assert "second" not in desk.wait(5.0)
