"""Opening again, later and later, and talking about it once."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from gateway.errors import LinkUnavailable
from gateway.link import Waker
from gateway.opening import FIRST_S, LIMIT_S, MOST_S, Opening, in_thread
from tests.fakes import JumpingClock, JumpingWaker
from tests.lines import PATIENCE_S


class Port:
    """What is opened."""

    def __init__(self) -> None:
        self.closed = threading.Event()

    def close(self) -> None:
        self.closed.set()


class SlowPort:
    """A driver that takes its time to open a port, until ``answer``."""

    def __init__(self) -> None:
        self.port, self.may_go, self.error = Port(), threading.Event(), ""

    def open(self) -> Port:
        assert self.may_go.wait(PATIENCE_S)
        if self.error:
            raise LinkUnavailable(self.error)
        return self.port


@dataclass
class Slow:
    """A slow opening in a thread of its own, on a clock that jumps; ``waker`` is the real one of whoever waits."""

    clock: JumpingClock
    driver: SlowPort
    waker: Waker
    opening: Opening[Port]
    ready: threading.Event

    def attempt(self) -> Port | None:
        return self.opening.attempt(self.ready)

    def attempt_when_woken(self) -> Port | None:
        assert self.waker.wait(PATIENCE_S)
        return self.attempt()

    def answer(self, error: str = "") -> None:
        """The driver is done; return once the one who waits has been woken."""
        self.driver.error = error
        self.driver.may_go.set()
        assert self.waker.wait(PATIENCE_S)


@pytest.fixture
def slow(clock: JumpingClock) -> Iterator[Slow]:
    waker, driver = Waker(), SlowPort()
    opening = Opening("field", clock, driver.open, waker, in_thread)
    yield Slow(clock, driver, waker, opening, threading.Event())
    driver.may_go.set()
    opening.close()
    waker.close()


def attempt_until_over(opening: Opening[Port], waker: Waker) -> Port:
    while (port := opening.attempt(threading.Event())) is None:
        assert waker.wait(PATIENCE_S)
    return port


def an_opening(clock: JumpingClock) -> Opening[Port]:
    return Opening("field", clock, Port, JumpingWaker(clock))


def test_the_first_try_is_at_once(clock: JumpingClock) -> None:
    opening = an_opening(clock)
    assert (opening.wait_s(), opening.trouble) == (0.0, "")


def test_each_failure_doubles_the_wait_up_to_the_most(clock: JumpingClock) -> None:
    opening = an_opening(clock)
    waits_s = []
    for _ in range(9):
        opening.failed("no port")
        waits_s.append(opening.wait_s())
        clock.pass_s(opening.wait_s())
    assert waits_s == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]
    assert (waits_s[0], waits_s[-1]) == (FIRST_S, MOST_S)


def test_the_wait_shrinks_as_time_passes_and_is_never_negative(clock: JumpingClock) -> None:
    opening = an_opening(clock)
    opening.failed("no port")
    clock.pass_s(0.25)
    assert opening.wait_s() == 0.25
    clock.pass_s(60.0)
    assert opening.wait_s() == 0.0


def test_once_it_worked_the_next_failure_waits_briefly_again(clock: JumpingClock) -> None:
    opening = an_opening(clock)
    for _ in range(8):
        opening.failed("no port")
    opening.worked()
    opening.failed("no port")
    assert opening.wait_s() == FIRST_S


def test_trouble_is_one_error_until_the_line_has_worked_again_whatever_the_reason(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG")
    opening = an_opening(clock)
    assert [opening.failed("no port"), opening.failed("no port"), opening.failed("busy")] == [True, False, False]
    assert opening.trouble == "busy"  # what a person sees is the latest
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ("ERROR", "field: no port; trying again"),
        ("DEBUG", "field: no port; trying again"),
        ("DEBUG", "field: busy; trying again"),
    ]
    opening.worked()
    assert opening.failed("busy")
    assert (caplog.records[-1].levelname, opening.failed("busy")) == ("ERROR", False)


def test_that_it_works_is_logged_only_after_trouble(clock: JumpingClock, caplog: pytest.LogCaptureFixture) -> None:
    opening = an_opening(clock)
    opening.worked()
    assert caplog.records == []
    opening.failed("no port")
    opening.worked()
    opening.worked()
    assert [record.getMessage() for record in caplog.records][1:] == ["field: the line works again"]
    assert opening.trouble == ""
    assert opening.failed("no port")


# --- in a thread of its own


def test_who_waits_for_a_slow_opening_is_free_meanwhile_and_woken_when_it_is_over(slow: Slow) -> None:
    assert slow.attempt() is None
    assert (slow.opening.wait_s(), slow.opening.trouble, slow.ready.is_set()) == (LIMIT_S, "", False)
    slow.answer()
    assert slow.opening.wait_s() == 0.0
    assert slow.attempt() is slow.driver.port
    assert slow.ready.is_set()


def test_an_opening_that_fails_later_is_told_and_tried_again_as_any_other(slow: Slow) -> None:
    slow.attempt()
    slow.answer("no such port")
    assert slow.attempt() is None
    assert (slow.opening.trouble, slow.opening.wait_s()) == ("no such port", FIRST_S)
    slow.clock.pass_s(FIRST_S)
    slow.driver.error = ""
    assert (slow.attempt() or slow.attempt_when_woken()) is slow.driver.port


def test_an_opening_that_takes_over_a_minute_is_an_alarm_and_still_awaited(
    slow: Slow, caplog: pytest.LogCaptureFixture
) -> None:
    slow.attempt()
    slow.clock.pass_s(LIMIT_S)
    for _ in range(5):
        assert slow.opening.wait_s() == 0.0
        assert slow.attempt() is None
        slow.clock.pass_s(slow.opening.wait_s())
    assert slow.opening.trouble == "opening it takes more than 60 s"
    assert slow.ready.is_set()  # it has been said why not
    assert len(caplog.records) == 1
    slow.answer()
    assert slow.attempt() is slow.driver.port


def test_what_is_opened_when_nobody_wants_it_any_more_is_closed(slow: Slow) -> None:
    slow.attempt()
    slow.opening.close()
    slow.driver.may_go.set()
    assert slow.driver.port.closed.wait(PATIENCE_S)


def test_what_was_opened_and_never_taken_is_closed(slow: Slow) -> None:
    slow.attempt()
    slow.answer()
    slow.opening.close()
    assert slow.driver.port.closed.is_set()


def test_an_opening_that_the_end_interrupts_is_no_trouble(slow: Slow, caplog: pytest.LogCaptureFixture) -> None:
    slow.attempt()
    slow.answer("interrupted")
    slow.waker.end()
    assert slow.attempt() is None
    assert (slow.opening.trouble, caplog.records) == ("", [])


def test_a_bug_in_what_opens_is_raised_where_it_was_asked(clock: JumpingClock) -> None:
    def broken() -> Port:
        raise ZeroDivisionError

    waker = Waker()
    opening = Opening("field", clock, broken, waker, in_thread)
    with pytest.raises(ZeroDivisionError):
        attempt_until_over(opening, waker)
    waker.close()
