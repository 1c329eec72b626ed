"""A terminal's life on a clock that jumps: waiting, the menu, hands changing, idleness, readers that do not read (spec
section 5). The password: test_login. Bytes come and go as a carrier would bring them; the menu is a fake one.
"""

from __future__ import annotations

import logging
from typing import Any

import pytest

from gateway.hmi.seat import Rank
from gateway.hmi.session import UNREAD_S
from tests.fakes import JumpingClock
from tests.hmi.terminals import CHEAP_HASH, MAIN_MENU, House, Screen

CONSOLE: dict[str, Any] = {"serial": {"line": "/dev/ttyS3"}}


def a_house(clock: JumpingClock, **hmi: Any) -> House:
    return House(clock, **hmi)


@pytest.fixture
def house(clock: JumpingClock) -> House:
    """Without a serial console."""
    return House(clock)


@pytest.fixture
def with_console(clock: JumpingClock) -> House:
    return House(clock, **CONSOLE)


# ------------------------------------------------------------------------------------------------ the menu


def test_without_a_serial_console_and_password_the_main_menu_comes_at_once(house: House) -> None:
    assert Screen(house).shown() == "\r\n" + MAIN_MENU


def test_keys_go_to_the_menu_one_by_one_and_line_ends_are_cr_lf(house: House) -> None:
    screen = Screen(house)
    screen.shown()
    assert screen.type("d1\r\n") == "['d']['1']['\\r']"
    house.menu.says_at_tick = "a\r\nb\nc\u00e9"
    house.menu.wake()
    assert screen.wakes == 1
    assert screen.shown() == "a\r\nb\r\nc\u00e9"


def test_the_menu_learns_what_the_terminal_is_before_each_key(house: House) -> None:
    screen = Screen(house)
    assert (house.menu.rows, house.menu.columns) == (24, 80)
    screen.session.rows, screen.session.columns = 50, 132
    screen.session.echoes, screen.session.ends_keys_with_enter = False, True
    screen.type("d")
    menu = house.menu
    assert (menu.rows, menu.columns, menu.echoes, menu.ends_keys_with_enter) == (50, 132, False, True)


def test_a_lone_esc_is_a_key_after_50_ms_of_silence_and_an_arrow_key_is_none(house: House) -> None:
    screen = Screen(house)
    screen.type(b"\x1b[A\x1b")
    assert house.menu.keys == []
    screen.run_s(0.049)
    assert house.menu.keys == []
    screen.run_s(0.002)
    assert house.menu.keys == ["\x1b"]


def test_the_menu_is_told_once_when_typing_has_stopped_for_50_ms(house: House) -> None:
    screen = Screen(house)
    screen.type("1")
    screen.run_s(0.04)
    screen.type("2")
    screen.run_s(0.049)
    assert house.menu.pauses == 0
    screen.run_s(60)
    assert house.menu.pauses == 1


def test_who_leaves_the_menu_is_over_and_the_next_one_has_it(house: House) -> None:
    first, second = Screen(house), Screen(house, address="10.0.0.6")
    first.type("q")
    assert first.session.is_over
    assert house.menus[0].is_closed
    assert second.wakes == 1
    assert second.shown().endswith(MAIN_MENU)
    assert first.session.due_s() is None
    assert first.type("more") == ""


def test_what_is_typed_behind_the_leaving_key_is_not_carried_out(house: House) -> None:
    screen = Screen(house)
    screen.type("qd")
    assert house.menu.keys == ["q"]


def test_leaving_at_a_tick_counts_too(house: House) -> None:
    screen = Screen(house)
    screen.shown()
    house.menu.has_left = True
    house.menu.wake()
    screen.shown()
    assert screen.session.is_over


def test_a_live_display_is_refreshed_when_it_is_due_and_not_while_the_last_picture_waits(
    house: House, clock: JumpingClock
) -> None:
    screen = Screen(house)
    screen.type("L")
    assert screen.run_s(3.01).count("tick") == 3
    clock.pass_s(1.0)
    screen.session.turn()
    assert screen.session.output == b"tick\r\n"
    clock.pass_s(5.0)
    screen.session.turn()
    house.menu.wake()
    screen.session.turn()
    assert screen.session.output == b"tick\r\n"
    assert house.menu.ticks == 4
    screen.session.sent(6)
    screen.session.turn()
    assert house.menu.ticks == 5


def test_a_wake_is_not_lost_while_the_last_picture_waits(house: House) -> None:
    screen = Screen(house)
    screen.session.turn()
    house.menu.wake()
    assert house.menu.ticks == 0
    assert screen.session.due_s() is not None
    screen.session.sent(len(screen.session.output))
    assert screen.session.due_s() == house.clock.monotonic()
    assert screen.shown() == "tick\r\n"


def test_a_menu_that_is_due_again_and_again_does_not_spin(house: House, clock: JumpingClock) -> None:
    screen = Screen(house)
    screen.shown()
    house.menu.says_at_tick = ""
    for _ in range(100):
        house.menu.live_s = clock.monotonic() - 1  # as a menu may that waits for the person
        screen.session.turn()
    assert house.menu.ticks <= 1
    assert (screen.session.due_s() or 0) > clock.monotonic()


# ------------------------------------------------------------------------------------------------ the serial console


def test_any_serial_character_takes_the_menu_and_is_not_a_choice_in_it(with_console: House) -> None:
    serial = Screen(with_console, Rank.SERIAL)
    assert "Press any key" in serial.shown()
    assert serial.type("d") == "\r\n" + MAIN_MENU
    assert with_console.menu.keys == []
    assert serial.type("d") == "['d']"


@pytest.mark.parametrize(
    ("pressed", "kept"),
    [
        ([b"\r", b"\n", b"d"], ["d"]),  # one Enter, in two pieces
        ([b"\x1b[A", b"d"], ["d"]),  # an arrow key is no choice, and the next key is one
        ([b"\x1b", b"[A", b"d"], ["d"]),
        ([b"\xc3", b"\xa9", b"d"], ["d"]),  # one letter, in two pieces
        ([b"xd"], ["d"]),
    ],
)
def test_the_first_key_only_wakes_however_it_comes(with_console: House, pressed: list[bytes], kept: list[str]) -> None:
    serial = Screen(with_console, Rank.SERIAL)
    for part in pressed:
        serial.type(part)
    assert with_console.menu.keys == kept


def test_a_first_esc_only_wakes(with_console: House) -> None:
    serial = Screen(with_console, Rank.SERIAL)
    serial.type("\x1b")
    serial.run_s(0.1)
    serial.type("d")
    assert with_console.menu.keys == ["d"]


def test_serial_takes_the_menu_from_telnet_who_is_told_and_whose_keys_are_ignored(
    with_console: House, clock: JumpingClock
) -> None:
    clock.pass_s(30)
    telnet, serial = Screen(with_console), Screen(with_console, Rank.SERIAL)
    telnet.type("d")
    old = with_console.menu
    serial.type(" ")
    assert old.keys == ["d"]
    assert telnet.wakes == 1
    told = telnet.type("zzz")
    assert "The serial console has taken the menu." in told
    assert "it is free in 30 s if nobody types there" in told
    assert old.is_closed
    assert old.keys == ["d"]
    assert with_console.menu.who == "serial console"
    assert with_console.menu.keys == []


def test_telnet_gets_a_new_menu_after_the_hold_time_and_serial_is_told_how_to_take_it_back(
    with_console: House, clock: JumpingClock
) -> None:
    clock.pass_s(30)
    telnet, serial = Screen(with_console), Screen(with_console, Rank.SERIAL)
    serial.type("  ")
    telnet.type("typed while waiting")
    assert MAIN_MENU not in telnet.run_s(29.9)
    assert telnet.run_s(0.2).endswith(MAIN_MENU)
    assert with_console.menu.keys == []
    assert "The menu is now with 10.0.0.5 (telnet). Press any key to take it back." in serial.shown()
    assert serial.type("d") == "\r\n" + MAIN_MENU
    assert with_console.menu.keys == []


def test_a_silent_serial_person_keeps_the_menu_while_nobody_waits(with_console: House) -> None:
    serial = Screen(with_console, Rank.SERIAL)
    serial.type("  ")
    serial.run_s(200)
    serial.type("d")
    assert with_console.menu.keys == [" ", "d"]


def test_serial_goes_back_to_any_key_when_it_leaves_and_when_it_is_idle(with_console: House) -> None:
    serial = Screen(with_console, Rank.SERIAL)
    serial.type(" ")
    assert "Press any key" in serial.type("q")
    assert not serial.session.is_over
    assert with_console.seat.holder is None
    serial.type(" ")
    told = serial.run_s(300.1)
    assert "Too long without a key" in told
    assert "Press any key" in told
    assert with_console.menu.is_closed
    assert with_console.seat.holder is None
    assert serial.run_s(1000) == ""


def test_what_is_typed_into_a_lost_turn_in_the_same_moment_is_ignored(with_console: House, clock: JumpingClock) -> None:
    clock.pass_s(30)
    telnet, serial = Screen(with_console), Screen(with_console, Rank.SERIAL)
    serial.type(" ")
    serial.type("q")
    with_console.configure()  # the console is taken out of the configuration: no more waiting
    assert with_console.seat.standing(telnet.session._person).has_menu  # telnet has it again, and has not noticed
    assert telnet.type("z").endswith(MAIN_MENU)
    assert with_console.menus[0].is_closed
    assert with_console.menu.keys == []


def test_a_loss_to_somebody_who_is_gone_already_is_told_as_well(with_console: House, clock: JumpingClock) -> None:
    clock.pass_s(30)
    telnet, serial = Screen(with_console), Screen(with_console, Rank.SERIAL)
    serial.type(" ")
    serial.type("q")
    told = telnet.shown()
    assert "has taken the menu." in told
    assert "goes first: the menu is free in 30 s" in told


# ------------------------------------------------------------------------------------------------ waiting


def test_who_waits_is_told_why_and_how_long_at_once_and_every_10_s_and_not_more(with_console: House) -> None:
    telnet = Screen(with_console)
    assert telnet.shown() == "The serial console goes first: the menu is free in 30 s if nobody types there.\r\n"
    assert telnet.run_s(9.9) == ""
    assert "in 20 s" in telnet.run_s(0.2)
    assert telnet.run_s(9.8) == ""
    assert telnet.run_s(0.2).count("\n") == 1


def test_who_waits_is_told_at_once_when_the_reason_changes(with_console: House, clock: JumpingClock) -> None:
    telnet, serial = Screen(with_console), Screen(with_console, Rank.SERIAL)
    telnet.shown()
    serial.type(" ")
    assert telnet.shown() == "The serial console has the menu: it is free in 30 s if nobody types there.\r\n"
    clock.pass_s(1)
    serial.type(" ")
    assert telnet.shown() == ""


def test_a_second_telnet_person_is_told_who_has_the_menu_and_a_third_how_many_are_before(house: House) -> None:
    Screen(house, address="192.168.1.7")
    second, third = Screen(house), Screen(house)
    assert second.shown() == "192.168.1.7 (telnet) has the menu.\r\n"
    assert third.shown() == "192.168.1.7 (telnet) has the menu. 1 before you.\r\n"


def test_the_local_menu_takes_it_from_telnet_who_is_told(house: House) -> None:
    telnet, local = Screen(house), Screen(house, Rank.LOCAL)
    assert local.shown().endswith(MAIN_MENU)
    telnet.session.receive(b"z")
    told = telnet.shown()
    assert "maria (rtugate menu) has taken the menu." in told
    assert house.menus[0].keys == []
    local.type("q")
    assert telnet.shown().endswith(MAIN_MENU)


def test_the_local_menu_asks_no_password(clock: JumpingClock) -> None:
    house = a_house(clock, password=CHEAP_HASH)
    assert Screen(house, Rank.LOCAL).shown().endswith(MAIN_MENU)


def test_a_turn_that_begins_while_the_due_time_is_asked_for_is_due_at_once(clock: JumpingClock) -> None:
    telnet = Screen(a_house(clock, serial_hold=5, **CONSOLE))
    telnet.shown()
    clock.pass_s(5)
    assert telnet.session.due_s() == clock.monotonic()
    assert telnet.session.due_s() == clock.monotonic()
    assert telnet.shown().endswith(MAIN_MENU)


# ------------------------------------------------------------------------------------------------ time


def test_a_telnet_session_without_a_typed_character_is_told_and_ended(house: House) -> None:
    screen = Screen(house)
    screen.run_s(200)
    screen.type("d")
    assert not screen.session.is_over
    assert "Too long" not in screen.run_s(299)
    assert "Too long without a key: the menu is closed." in screen.run_s(2)
    assert screen.session.is_over
    assert house.menu.is_closed
    assert house.seat.holder is None


def test_what_telnet_itself_says_is_no_typed_character(house: House) -> None:
    screen = Screen(house)
    for _ in range(4):
        screen.run_s(80)
        screen.session.receive(b"")
    assert screen.session.is_over


def test_who_gets_the_menu_after_long_waiting_has_the_whole_idle_time(house: House) -> None:
    first, second = Screen(house), Screen(house)
    second.run_s(299)
    first.type("q")
    second.shown()
    second.run_s(250)
    assert not second.session.is_over


def test_the_idle_time_may_change_while_the_session_runs(house: House) -> None:
    screen = Screen(house)
    house.configure(idle_timeout=10)
    screen.run_s(11)
    assert screen.session.is_over


def test_a_hang_up_frees_the_seat_and_closes_the_menu_in_the_middle_of_a_dialogue(house: House) -> None:
    first, second = Screen(house), Screen(house)
    first.type("z1")
    first.session.hang_up()
    assert house.menu.is_closed
    assert second.shown().endswith(MAIN_MENU)


def test_a_session_that_the_station_ends_says_why_once(house: House) -> None:
    screen = Screen(house)
    screen.shown()
    screen.session.stop()
    screen.session.stop()
    assert screen.shown() == "\r\nThe menu is closed: rtugate stops, or is configured anew.\r\n"


# ------------------------------------------------------------------------------------------------ slow readers


def test_a_flood_of_keys_is_carried_out_in_portions_and_no_faster_than_it_is_read(house: House) -> None:
    screen = Screen(house)
    screen.session.receive(b"B" * 1000)
    screen.session.turn()
    assert len(screen.session.output) < 4096 + 3000
    assert len(house.menu.keys) <= 64
    screen.session.turn()
    assert len(screen.session.output) < 4096 + 3000
    screen.shown()
    screen.run_s(1)
    assert len(house.menu.keys) == 1000


def test_keys_that_show_little_are_carried_out_in_portions_as_well(house: House) -> None:
    screen = Screen(house)
    screen.shown()
    screen.session.receive(b"d" * 200)
    screen.session.turn()
    assert len(house.menu.keys) == 64
    assert screen.session.due_s() == house.clock.monotonic()
    screen.run_s(0.1)
    assert len(house.menu.keys) == 200


def test_who_reads_nothing_is_given_up_and_frees_the_seat_although_he_types(
    house: House, clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    deaf, second = Screen(house), Screen(house)
    second.shown()
    for _ in range(int(UNREAD_S)):
        deaf.session.receive(b"B" * 4096)
        deaf.session.turn()
        assert len(deaf.session.output) < 4096 + 3000
        clock.pass_s(1)
    deaf.session.turn()
    assert deaf.session.is_over
    assert not deaf.session.output
    assert "does not read" in caplog.text
    assert second.shown().endswith(MAIN_MENU)


def test_who_reads_slowly_is_not_given_up(house: House, clock: JumpingClock) -> None:
    slow = Screen(house)
    slow.session.receive(b"B" * 10)
    for _ in range(10 * int(UNREAD_S)):
        slow.session.turn()
        slow.session.sent(min(10, len(slow.session.output)))
        clock.pass_s(0.9)
        slow.session.receive(b"1")
    assert not slow.session.is_over


def test_one_picture_larger_than_all_bounds_ends_the_session(house: House) -> None:
    screen = Screen(house)
    screen.shown()
    house.menu.says_at_tick = "x" * 70000
    house.menu.wake()
    screen.session.turn()
    assert screen.session.is_over
    assert not screen.session.output


# ------------------------------------------------------------------------------------------------ the end of a pipe


def test_what_a_pipe_has_said_is_carried_out_before_the_session_ends(house: House) -> None:
    screen = Screen(house, Rank.LOCAL)
    screen.session.receive(b"d" * 200)
    screen.session.end_input()
    screen.run_s(0.2)
    assert screen.session.is_over
    assert len(house.menu.keys) == 200


def test_after_the_end_of_a_pipe_a_menu_has_some_seconds_to_come_to_its_result(house: House) -> None:
    screen = Screen(house, Rank.LOCAL)
    screen.session.receive(b"L")
    screen.session.end_input()
    shown = screen.run_s(4.9)
    assert not screen.session.is_over
    assert shown.count("tick") == 4
    screen.run_s(0.2)
    assert screen.session.is_over


def test_a_pipe_that_ends_while_waiting_ends_the_session(house: House) -> None:
    Screen(house)
    waiting = Screen(house)
    waiting.session.end_input()
    waiting.shown()
    assert waiting.session.is_over


def test_comings_and_goings_are_logged(with_console: House, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    serial = Screen(with_console, Rank.SERIAL)
    serial.type(" ")
    serial.type("q")
    assert [record.message for record in caplog.records] == [
        "menu: serial console has the menu",
        "menu: serial console has left it",
    ]
