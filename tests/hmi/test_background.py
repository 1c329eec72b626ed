"""Slow calls: one that does not end is an alarm, told once, and over when it ends; nothing ends those behind it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator

import pytest

from gateway.hmi.background import LIMIT_S, Background
from tests.fakes import JumpingClock
from tests.lines import PATIENCE_S

SLOW = "slow work: has taken over 60 s by now (a slow card?)"
OVER = "slow work: goes on again"


class Card:
    """A call that lasts until the test lets it go, as an fsync on a card that does not answer."""

    def __init__(self) -> None:
        self.begun, self.answers = threading.Event(), threading.Event()

    def work(self) -> None:
        self.begun.set()
        assert self.answers.wait(PATIENCE_S)


@pytest.fixture
def background(clock: JumpingClock) -> Background:
    return Background("slow work", clock)


@pytest.fixture
def card(background: Background) -> Iterator[Card]:
    """A card on which a call has begun just now."""
    card = Card()
    background.run(card.work)
    assert card.begun.wait(PATIENCE_S)
    yield card
    card.answers.set()


def ended(background: Background) -> None:
    """Wait until all calls so far have ended, and this one as well."""
    done = threading.Event()
    background.run(done.set)
    assert done.wait(PATIENCE_S)
    for thread in threading.enumerate():
        if thread.name == "slow work":
            thread.join(PATIENCE_S)


def told(caplog: pytest.LogCaptureFixture) -> list[tuple[str, str]]:
    return [(record.levelname, record.getMessage()) for record in caplog.records]


# ------------------------------------------------------------------------------------------------ the alarm


def test_a_call_is_no_alarm_within_its_limit(background: Background, card: Card, clock: JumpingClock) -> None:
    assert background.trouble == ""
    clock.pass_s(LIMIT_S - 0.001)
    assert background.trouble == ""


def test_a_call_that_does_not_end_is_an_alarm_until_it_ends_and_logged_once(
    background: Background, card: Card, clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    clock.pass_s(LIMIT_S)
    assert [background.trouble for _ in range(3)] == [SLOW] * 3
    clock.pass_s(24 * 3600)
    assert background.trouble == SLOW
    assert told(caplog) == [("ERROR", SLOW)]
    card.answers.set()
    ended(background)
    assert [background.trouble for _ in range(3)] == [""] * 3
    assert told(caplog) == [("ERROR", SLOW), ("WARNING", OVER)]


def test_each_slow_call_is_told_anew(
    background: Background, clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(2):
        card = Card()
        background.run(card.work)
        assert card.begun.wait(PATIENCE_S)
        clock.pass_s(LIMIT_S)
        assert background.trouble == SLOW
        card.answers.set()
        ended(background)
        assert background.trouble == ""
    assert told(caplog) == [("ERROR", SLOW), ("WARNING", OVER)] * 2


def test_the_limit_is_of_one_call_and_not_of_all_together(background: Background, clock: JumpingClock) -> None:
    cards = [Card() for _ in range(4)]
    for card in cards:
        background.run(card.work)
    for card in cards:
        assert card.begun.wait(PATIENCE_S)
        clock.pass_s(LIMIT_S - 1)
        assert background.trouble == ""
        card.answers.set()
    ended(background)


def test_a_call_that_waits_for_its_turn_is_not_what_is_slow(background: Background, clock: JumpingClock) -> None:
    first, second = Card(), Card()
    background.run(first.work)
    background.run(second.work)
    assert first.begun.wait(PATIENCE_S)
    clock.pass_s(LIMIT_S - 1)
    first.answers.set()
    assert second.begun.wait(PATIENCE_S)
    clock.pass_s(2)
    assert background.trouble == ""
    clock.pass_s(LIMIT_S - 2)
    assert background.trouble == SLOW
    second.answers.set()
    ended(background)


def test_without_work_nothing_is_slow_however_long(background: Background, clock: JumpingClock) -> None:
    ended(background)
    clock.pass_s(1000 * LIMIT_S)
    assert background.trouble == ""


def test_a_clock_set_by_years_is_no_alarm(background: Background, card: Card, clock: JumpingClock) -> None:
    clock.jump_wall(1e9)
    assert background.trouble == ""
    clock.jump_wall(-2e9)
    assert background.trouble == ""


def test_many_who_look_at_once_log_it_once(
    background: Background, card: Card, clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    clock.pass_s(LIMIT_S)
    together = threading.Barrier(8)

    def look() -> None:
        together.wait(PATIENCE_S)
        assert background.trouble == SLOW

    lookers = [threading.Thread(target=look) for _ in range(8)]
    for looker in lookers:
        looker.start()
    for looker in lookers:
        looker.join()
    assert told(caplog) == [("ERROR", SLOW)]


def test_by_the_machines_own_clock_a_short_call_is_no_alarm() -> None:
    background, card = Background("slow work"), Card()
    background.run(card.work)
    assert card.begun.wait(PATIENCE_S)
    assert background.trouble == ""
    card.answers.set()
    ended(background)


# ------------------------------------------------------------------------------------------------ those behind it


def quits() -> None:
    raise SystemExit(1)


def panics() -> None:
    raise BaseException("as pydantic's core does when it panics")


def is_wrong() -> None:
    raise ZeroDivisionError("a bug")


@pytest.mark.parametrize("work", [quits, panics, is_wrong])
def test_whatever_a_call_raises_is_logged_and_the_next_ones_have_their_turn(
    work: Callable[[], None], background: Background, caplog: pytest.LogCaptureFixture
) -> None:
    background.run(work)
    ended(background)
    ended(background)  # in another thread
    assert told(caplog) == [("ERROR", "slow work: ended with an error")]
    assert background.trouble == ""


def test_when_no_thread_is_left_the_calls_wait_for_the_next_that_finds_one(
    background: Background, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    done: list[str] = []

    def none_left(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as without_threads:
        without_threads.setattr(threading.Thread, "start", none_left)
        background.run(lambda: done.append("first"))
    assert told(caplog) == [("ERROR", "slow work: cannot begin: can't start new thread")]
    with caplog.at_level(logging.CRITICAL):
        background.run(lambda: done.append("second"))
        ended(background)
    assert done == ["first", "second"]
