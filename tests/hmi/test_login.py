"""The password, its delays and the lock-out, as a terminal sees them (spec section 5, "Access"); a clock that jumps."""

from __future__ import annotations

import logging
import threading
from typing import Any

import pytest

from gateway.hmi.background import Background
from gateway.hmi.seat import Rank
from tests.fakes import JumpingClock
from tests.hmi.terminals import CHEAP_HASH, MAIN_MENU, PASSWORD, House, PatientBackground, Screen
from tests.lines import PATIENCE_S

CONSOLE = {"line": "/dev/ttyS3", "password_required": True}

WRONG = "wrong password"


class Locked(House):
    """A house with a password; checks are done when the test says so."""

    def __init__(self, clock: JumpingClock, **hmi: Any) -> None:
        self.checks = PatientBackground()
        super().__init__(clock, self.checks, password=CHEAP_HASH, **hmi)


@pytest.fixture
def house(clock: JumpingClock) -> Locked:
    return Locked(clock)


@pytest.fixture
def with_console(clock: JumpingClock) -> Locked:
    return Locked(clock, serial=CONSOLE)


def tried(screen: Screen, password: str = WRONG) -> str:
    """Type a password, have it checked, and return what is shown at once."""
    shown = screen.type(password + "\r")
    assert isinstance(screen.house, Locked)
    screen.house.checks.work()
    return shown + screen.shown()


def test_telnet_is_asked_for_the_password_and_sees_nothing_of_it(house: Locked) -> None:
    screen = Screen(house)
    assert screen.shown() == "Password: "
    assert screen.type(PASSWORD) == ""
    assert house.seat.holder is None


def test_the_right_password_opens_the_menu(house: Locked) -> None:
    screen = Screen(house)
    screen.type(PASSWORD + "\r")
    assert screen.wakes == 0
    house.checks.work()
    assert screen.wakes == 1
    assert screen.shown().endswith("\r\n" + MAIN_MENU)


def test_what_is_typed_while_the_password_is_checked_is_no_choice_in_the_menu(house: Locked) -> None:
    screen = Screen(house)
    screen.type(PASSWORD + "\rqqq")
    house.checks.work()
    screen.shown()
    assert house.menu.keys == []


def test_the_session_waits_for_no_check(house: Locked) -> None:
    screen, other = Screen(house), Screen(house, address="10.0.0.6")
    screen.type("wrong password\r")
    assert tried(other, PASSWORD).endswith(MAIN_MENU)


def test_a_wrong_password_is_answered_after_1_s_then_2_s_and_typing_meanwhile_is_ignored(house: Locked) -> None:
    screen = Screen(house)
    assert "Wrong" not in tried(screen)
    screen.type(PASSWORD + "\r")
    assert not house.checks.waiting
    assert screen.run_s(0.99) == ""
    assert screen.run_s(0.02) == "Wrong password.\r\nPassword: "
    tried(screen)
    assert screen.run_s(1.99) == ""
    assert "Wrong password." in screen.run_s(0.02)
    assert tried(screen, PASSWORD).endswith(MAIN_MENU)


def test_five_failures_in_a_row_lock_the_address_out_for_5_minutes(
    house: Locked, clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    screen = Screen(house)
    for _ in range(5):
        tried(screen)
        told = screen.run_s(8.1)
    assert "Too many wrong passwords: try again in 5 minutes." in told
    assert screen.session.is_over
    again = Screen(house)
    assert "Too many wrong passwords" in again.shown()
    assert again.session.is_over
    assert Screen(house, address="10.0.0.6").shown() == "Password: "
    assert "10.0.0.5 is locked out" in caplog.text
    clock.pass_s(300)
    assert Screen(house).shown() == "Password: "


def test_a_session_open_before_the_lock_out_gets_no_further_guess(house: Locked) -> None:
    early, screen = Screen(house), Screen(house)
    early.shown()
    for _ in range(5):
        tried(screen)
        screen.run_s(8.1)
    assert "Too many wrong passwords" in tried(early, PASSWORD)
    assert early.session.is_over


def test_checks_asked_for_all_at_once_are_five_guesses_all_the_same(house: Locked) -> None:
    screens = [Screen(house) for _ in range(7)]
    for screen in screens[:6]:
        screen.type("wrong password\r")
    screens[6].type(PASSWORD + "\r")  # the seventh guess, right, and asked for before the fifth was wrong
    house.checks.work()
    assert all(MAIN_MENU not in screen.run_s(9) for screen in screens)
    assert house.menus == []


def test_a_terminal_that_hangs_up_before_its_check_began_costs_no_check(house: Locked) -> None:
    screen = Screen(house)
    screen.type("wrong password\r")
    screen.session.hang_up()
    assert house.checks.waiting[0].is_cancelled


def test_every_failure_is_logged_with_the_address_and_without_the_password(
    house: Locked, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    screen = Screen(house)
    tried(screen, "sesame open\x07\x1b[2J")
    assert caplog.messages == ["menu: wrong password from 10.0.0.5"]
    assert "sesame" not in caplog.text


def test_a_login_not_finished_in_60_s_is_ended_whatever_is_typed(house: Locked) -> None:
    screen = Screen(house)
    for _ in range(59):
        screen.run_s(1)
        screen.type("a")
    assert not screen.session.is_over
    assert "Too long without a login." in screen.run_s(1.1)
    assert screen.session.is_over


def test_a_check_that_takes_longer_than_the_login_may_is_forgotten(house: Locked) -> None:
    screen = Screen(house)
    screen.type(PASSWORD + "\r")
    screen.run_s(61)
    house.checks.work()
    assert screen.shown() == ""
    assert house.menus == []


def test_an_empty_password_esc_and_erasing_ask_again_and_cost_no_check(house: Locked) -> None:
    screen = Screen(house)
    screen.shown()
    assert screen.type("\r") == "\r\nPassword: "
    screen.type("abc\x1b")
    assert screen.run_s(0.1) == "\r\nPassword: "
    assert screen.type("abc\b\b\b\r") == "\r\nPassword: "
    assert not house.checks.waiting


def test_an_absurdly_long_password_is_refused_as_a_whole(house: Locked) -> None:
    screen = Screen(house)
    screen.shown()
    screen.type("a" * 1000)
    assert screen.run_s(0.1) == ""
    assert screen.type("\r") == "\r\nA password has 64 characters at most.\r\nPassword: "
    assert not house.checks.waiting
    assert tried(screen, PASSWORD).endswith(MAIN_MENU)


def test_the_password_that_counts_is_the_one_configured_when_it_is_typed(house: Locked) -> None:
    screen = Screen(house)
    house.configure(password=CHEAP_HASH.replace("scrypt$16", "scrypt$32"))
    assert MAIN_MENU not in tried(screen, PASSWORD)


def test_a_waiting_telnet_person_learns_who_has_the_menu_only_after_the_password(house: Locked) -> None:
    Screen(house, Rank.LOCAL)
    screen = Screen(house)
    assert screen.shown() == "Password: "
    assert "maria (rtugate menu) has the menu." in tried(screen, PASSWORD)


# ------------------------------------------------------------------------------------------------ the serial console


def test_the_serial_console_asks_only_if_it_has_to(clock: JumpingClock) -> None:
    serial = Screen(Locked(clock, serial={"line": "/dev/ttyS3"}), Rank.SERIAL)
    assert serial.type(" ").endswith(MAIN_MENU)


def test_the_serial_console_is_asked_after_any_key_and_holds_the_menu_meanwhile(with_console: Locked) -> None:
    serial = Screen(with_console, Rank.SERIAL)
    assert serial.type(" ").endswith("Password: ")
    assert with_console.seat.holder is not None
    assert tried(serial, PASSWORD).endswith(MAIN_MENU)


def test_the_serial_console_is_delayed_but_never_locked_out(with_console: Locked) -> None:
    serial = Screen(with_console, Rank.SERIAL, address="serial console")
    for count in range(12):
        serial.type("  ")  # the first of them only wakes; the second is erased by the Esc behind it
        serial.type("\x1b")
        serial.run_s(0.1)
        assert "Wrong" not in tried(serial)
        assert serial.run_s(min(8, 2**count) - 0.01) == ""
        assert serial.run_s(0.02) == "Wrong password.\r\nPassword: "
        if count % 4 == 3:
            assert "Press any key" in serial.run_s(60)
    serial.type(" ")
    assert tried(serial, PASSWORD).endswith(MAIN_MENU)


def test_a_serial_login_that_is_not_finished_goes_back_to_any_key(with_console: Locked) -> None:
    serial = Screen(with_console, Rank.SERIAL)
    serial.type(" ")
    told = serial.run_s(60.1)
    assert "Too long without a login." in told
    assert told.endswith("Press any key for the menu.\r\n")
    assert with_console.seat.holder is None
    assert serial.type(" ").endswith("Password: ")


def test_a_serial_login_may_lose_the_menu_to_somebody_who_waits(with_console: Locked) -> None:
    serial, local = Screen(with_console, Rank.SERIAL), Screen(with_console, Rank.LOCAL)
    serial.type(" ")
    assert local.run_s(30.1).endswith(MAIN_MENU)
    assert "The menu is now with maria (rtugate menu)." in serial.shown()
    assert serial.type(" ").endswith("Password: ")


def test_a_serial_person_who_lost_the_menu_for_a_while_is_not_asked_again_but_after_idle_time_is(
    with_console: Locked,
) -> None:
    serial, local = Screen(with_console, Rank.SERIAL), Screen(with_console, Rank.LOCAL)
    serial.type(" ")
    tried(serial, PASSWORD)
    local.run_s(30.1)
    assert "now with" in serial.shown()
    assert serial.type(" ").endswith(MAIN_MENU)
    local.run_s(30.1)
    serial.shown()
    serial.run_s(300)
    assert serial.type(" ").endswith("Password: ")


def test_leaving_the_menu_logs_the_serial_console_out(with_console: Locked) -> None:
    serial = Screen(with_console, Rank.SERIAL)
    serial.type(" ")
    tried(serial, PASSWORD)
    serial.type("q")
    assert serial.type(" ").endswith("Password: ")


# ------------------------------------------------------------------------------------------------ the background


def test_slow_calls_run_one_after_the_other_and_leave_no_thread(caplog: pytest.LogCaptureFixture) -> None:
    background = Background("slow")
    go, done = threading.Event(), threading.Event()
    running: list[str] = []
    most = 0

    def work(name: str) -> None:
        nonlocal most
        running.append(name)
        most = max(most, len(running))
        go.wait(PATIENCE_S)
        running.remove(name)

    def fault() -> None:
        raise ZeroDivisionError("a bug")

    background.run(lambda: work("a"))
    background.run(fault)
    background.run(lambda: work("never")).cancel()
    background.run(lambda: work("b"))
    background.run(done.set)
    go.set()
    assert done.wait(PATIENCE_S)
    assert most == 1
    assert "slow: ended with an error" in caplog.text


def test_after_its_work_the_background_starts_again() -> None:
    background = Background("slow")
    for _ in range(50):
        done = threading.Event()
        background.run(done.set)
        assert done.wait(PATIENCE_S)


def test_a_call_that_is_cancelled_while_it_waits_is_left_out() -> None:
    background = Background("slow")
    begun, go, done = threading.Event(), threading.Event(), threading.Event()
    carried_out: list[str] = []

    def work() -> None:
        begun.set()
        go.wait(PATIENCE_S)

    background.run(work)
    assert begun.wait(PATIENCE_S)
    call = background.run(lambda: carried_out.append("cancelled"))
    background.run(done.set)
    call.cancel()
    go.set()
    assert done.wait(PATIENCE_S)
    assert carried_out == []
