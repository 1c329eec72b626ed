"""What a field engineer with the specification in hand tripped over at the menu (spec section 5)."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gateway.hmi.keys import ESC
from gateway.hmi.seat import Person, Rank, Seat
from gateway.hmi.station import Job
from gateway.hmi.wording import plain_reference_problem
from gateway.modbus.pdu import Table
from tests.fakes import JumpingClock
from tests.hmi.desk import PROMPTS, STATIONS, Desk, DeskStation, desk_of

DIFFERENCE = [f"+ line {n}" for n in range(1, 41)]  # of a station that was made from nothing


def line_starting(text: str, words: str) -> str:
    return next(line for line in text.splitlines() if line.startswith(words))


# ------------------------------------------------------------------------------------------------ who has the menu


@pytest.mark.parametrize("hold_s", [0.5, 2.0, 4.5])
def test_a_short_hold_time_is_kept_to_the_second_also_when_the_serial_person_has_the_menu(hold_s: float) -> None:
    clock = JumpingClock()
    seat = Seat(clock, lambda: hold_s)
    serial, telnet = (Person(who, rank, lambda: None) for who, rank in (("s", Rank.SERIAL), ("t", Rank.TELNET)))
    seat.take(serial)
    seat.enter(telnet)
    assert seat.standing(telnet).wait_s == hold_s
    clock.pass_s(hold_s - 0.25)
    assert not seat.standing(telnet).has_menu
    clock.pass_s(0.25)
    assert seat.standing(telnet).has_menu


# ------------------------------------------------------------------------------------------------ help on any screen


@pytest.mark.parametrize(
    ("keys", "told", "live"),
    [
        ("d3107\r\r", "Shows points of the register.", "Holding 108 (40108"),
        ("i", "The whole station at a glance", "Running for"),
        ("l", "The newest lines of the log", "Log, newest first"),
    ],
)
def test_help_in_a_live_picture_stays_until_a_key_and_leads_back_to_it(
    boiler: Desk, keys: str, told: str, live: str
) -> None:
    boiler.type(keys)
    assert told in boiler.type("?")
    assert boiler.wait(5.0) == ""
    assert live in boiler.type("x")
    assert PROMPTS[0] in boiler.type("x")


def test_help_in_the_traffic_is_told_and_the_frames_go_on(boiler: Desk) -> None:
    boiler.type("t1")
    assert "> was sent, < was heard." in boiler.type("?")
    assert "> unit 17" in boiler.wait(3.0)
    assert PROMPTS[0] in boiler.type("x")


# ------------------------------------------------------------------------------------------------ D


def test_the_source_of_a_request_with_the_factory_names_is_shown_whole_in_80_columns() -> None:
    factory = desk_of("factory")
    factory.type("a/dev/ttyS2\r\r\r\rrn17\r3\r107\r3\r\r0\r0")
    factory.station.fields["field"].registers.update({(17, address): 0x8000 for address in (107, 108, 109)})
    factory.wait(2.0)
    row = line_starting(factory.type("d30\r\r"), " 40001 ")
    assert "-32768 8000" in row
    assert row.endswith(" field/u17-f3-107")
    assert len(row) <= 79


def test_a_single_register_can_be_seen_as_32_bits_with_the_one_behind_it(boiler: Desk) -> None:
    boiler.type("z3200\rl\r165537\r")
    boiler.type("d3200\r\r")
    assert line_starting(boiler.type("f"), " 40201 ").split()[2] == "65537"
    last = boiler.station.register.size(Table.HOLDING_REGISTERS) - 1
    assert "F: 32-bit" not in boiler.type(f"xd3{last}\r\r")


# ------------------------------------------------------------------------------------------------ addresses


@pytest.mark.parametrize(
    ("table", "typed", "address"),
    [
        (Table.HOLDING_REGISTERS, "400108", 107),
        (Table.INPUT_REGISTERS, "365536", 65535),
        (Table.DISCRETE_INPUTS, "100001", 0),
        (Table.COILS, "00108", 107),
        (Table.COILS, "000108", 107),
    ],
)
def test_a_reference_number_that_can_be_no_address_is_told_with_what_to_type(
    boiler: Desk, table: Table, typed: str, address: int
) -> None:
    told = f"{typed} looks like a reference number: for it type {address}."
    assert told in boiler.type(f"d{int(table)}{typed}\r")
    assert "First point" in boiler.screen.splitlines()[-1]


@pytest.mark.parametrize(
    ("table", "typed"),
    [
        (Table.HOLDING_REGISTERS, "40108"),  # an address as well: ``reference_problem`` tells both
        (Table.HOLDING_REGISTERS, "400000"),
        (Table.HOLDING_REGISTERS, "465537"),
        (Table.HOLDING_REGISTERS, "00108"),
        (Table.INPUT_REGISTERS, "400108"),
        (Table.COILS, "0108"),
        (Table.COILS, "00000"),
        (Table.COILS, "0x0108"),
        (Table.COILS, "10108"),
    ],
)
def test_other_numbers_are_no_plain_references(table: Table, typed: str) -> None:
    assert plain_reference_problem(table, typed, str) is None


# ------------------------------------------------------------------------------------------------ R


@pytest.mark.parametrize("code", [5, 6])
def test_a_new_request_asks_for_the_count_also_where_it_can_only_be_one(boiler: Desk, code: int) -> None:
    boiler.type(f"rn9\r{code}\r300\r1\r2\r300\r")
    new = boiler.station.config.master[0].request[-1]
    assert (new.unit, new.code, new.address, new.count, new.every, new.point) == (9, code, 300, 1, 2.0, 300)


# ------------------------------------------------------------------------------------------------ W


@pytest.mark.parametrize(("keys", "is_saved"), [("y", True), (" y", True), ("\r  y", True), ("n", False), (ESC, False)])
def test_a_difference_of_many_lines_can_be_saved_or_left_below_each_screenful(
    boiler: Desk, keys: str, is_saved: bool
) -> None:
    boiler.station.changed_lines = DIFFERENCE
    boiler.type("k9\r")
    asked = boiler.type("w").splitlines()
    assert asked[-1] == "Save this? (y/n/c), Space: more: "
    assert asked[1:-1] == DIFFERENCE[:18]
    boiler.type(keys)
    assert boiler.station.is_unsaved is not is_saved
    assert boiler.screen.endswith(PROMPTS[not is_saved])


def test_all_lines_of_a_difference_are_shown_and_the_last_question_offers_no_more(boiler: Desk) -> None:
    boiler.station.changed_lines = DIFFERENCE
    boiler.type("k9\r")
    shown = boiler.type("w  ").splitlines()
    assert [line for line in shown if line.startswith("+ line")] == DIFFERENCE
    assert shown[-1] == "Save this? (y/n/c): "
    assert "one of: Y N C. Esc" in boiler.type(" ")


class SlowDisk(DeskStation):
    """Its file is read no sooner than ``reads``."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._asked: list[tuple[Callable[[], None], Job]] = []

    def in_background(self, work: Callable[[], None], told: Callable[[], None]) -> Job:
        self._asked.append((work, Job()))
        return self._asked[-1][1]

    def reads(self, problem: str = "") -> None:
        for work, job in self._asked:
            job.problem = problem
            if not problem:
                work()
            job.finish()
        self._asked.clear()


@pytest.fixture
def slow() -> Desk:
    """A person at a station whose disk is slow, with something to save."""
    desk = Desk(SlowDisk((STATIONS / "boiler.toml").read_text()))
    desk.is_working = False
    desk.type("k9\r")
    return desk


def reads(desk: Desk, problem: str = "") -> str:
    assert isinstance(desk.station, SlowDisk)
    desk.station.reads(problem)
    return desk.wait(0.1)


def test_a_slow_disk_is_waited_for_by_who_saves_alone(slow: Desk) -> None:
    assert slow.type("w") == "w\n"
    assert slow.menu.is_busy
    assert reads(slow) == ""  # that nobody edited it; now the difference is looked for
    assert slow.menu.is_busy
    assert reads(slow).endswith("Save this? (y/n/c): ")


def test_esc_ends_the_wait_for_a_slow_disk(slow: Desk) -> None:
    slow.type("w")
    assert slow.type(ESC).endswith(PROMPTS[1])
    assert reads(slow) == ""
    assert "Unit identifier" in slow.type("k")


def test_what_is_wrong_with_the_file_is_told_at_the_main_menu(slow: Desk) -> None:
    slow.type("w")
    reads(slow)
    assert reads(slow, "it would not load").endswith(f"it would not load\n{PROMPTS[1]}")


# ------------------------------------------------------------------------------------------------ whole lines


def test_the_enter_that_sends_an_esc_answers_nothing(boiler: Desk) -> None:
    boiler.menu.echoes, boiler.menu.ends_keys_with_enter = False, True
    boiler.type("r\r")
    boiler.type("n\r")
    shown = boiler.type(ESC + "\r")
    assert "Nothing is changed." in shown
    assert shown.count("Request 1 of 3") == 1  # Enter alone would show the next one
    assert "Request 2 of 3" in boiler.type("s\r")
