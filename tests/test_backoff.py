"""Opening again, later and later, and talking about it once."""

from __future__ import annotations

import pytest

from gateway.backoff import FIRST_S, MOST_S, Backoff
from tests.fakes import JumpingClock


def test_the_first_try_is_at_once(clock: JumpingClock) -> None:
    backoff = Backoff("field", clock)
    assert (backoff.wait_s(), backoff.trouble) == (0.0, "")


def test_each_failure_doubles_the_wait_up_to_the_most(clock: JumpingClock) -> None:
    backoff = Backoff("field", clock)
    waits_s = []
    for _ in range(9):
        backoff.failed("no port")
        waits_s.append(backoff.wait_s())
        clock.pass_s(backoff.wait_s())
    assert waits_s == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]
    assert (waits_s[0], waits_s[-1]) == (FIRST_S, MOST_S)


def test_the_wait_shrinks_as_time_passes_and_is_never_negative(clock: JumpingClock) -> None:
    backoff = Backoff("field", clock)
    backoff.failed("no port")
    clock.pass_s(0.25)
    assert backoff.wait_s() == 0.25
    clock.pass_s(60.0)
    assert backoff.wait_s() == 0.0


def test_once_it_worked_the_next_failure_waits_briefly_again(clock: JumpingClock) -> None:
    backoff = Backoff("field", clock)
    for _ in range(8):
        backoff.failed("no port")
    backoff.worked()
    backoff.failed("no port")
    assert backoff.wait_s() == FIRST_S


def test_trouble_is_one_error_until_the_line_has_worked_again_whatever_the_reason(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG")
    backoff = Backoff("field", clock)
    assert [backoff.failed("no port"), backoff.failed("no port"), backoff.failed("busy")] == [True, False, False]
    assert backoff.trouble == "busy"  # what a person sees is the latest
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ("ERROR", "field: no port; trying again"),
        ("DEBUG", "field: no port; trying again"),
        ("DEBUG", "field: busy; trying again"),
    ]
    backoff.worked()
    assert backoff.failed("busy")
    assert (caplog.records[-1].levelname, backoff.failed("busy")) == ("ERROR", False)


def test_that_it_works_is_logged_only_after_trouble(clock: JumpingClock, caplog: pytest.LogCaptureFixture) -> None:
    backoff = Backoff("field", clock)
    backoff.worked()
    assert caplog.records == []
    backoff.failed("no port")
    backoff.worked()
    backoff.worked()
    assert [record.getMessage() for record in caplog.records][1:] == ["field: the line works again"]
    assert backoff.trouble == ""
    assert backoff.failed("no port")
