"""What is counted, and the reply times made of it."""

from __future__ import annotations

import pytest

from gateway.counters import REPLY_TIMES_KEPT, PollCounters, ReplyTimes, ServeCounters


def test_before_the_first_reply_all_times_are_0() -> None:
    times = ReplyTimes()
    assert (times.last_s, times.min_s, times.average_s, times.max_s, times.p95_s, times.count) == (0, 0, 0, 0, 0, 0)


def test_times_tell_last_least_average_and_most() -> None:
    times = ReplyTimes()
    for reply_s in (0.5, 0.25, 1.0, 0.25):
        times.add(reply_s)
    assert (times.last_s, times.min_s, times.average_s, times.max_s, times.count) == (0.25, 0.25, 0.5, 1.0, 4)


@pytest.mark.parametrize(("count", "p95_s"), [(1, 1.0), (19, 19.0), (20, 20.0), (100, 96.0), (200, 191.0)])
def test_95_of_100_replies_are_no_slower_than_p95(count: int, p95_s: float) -> None:
    times = ReplyTimes()
    for reply_s in range(count, 0, -1):
        times.add(float(reply_s))
    assert times.p95_s == p95_s
    assert sum(reply_s <= times.p95_s for reply_s in times.recent_s) >= 0.95 * count


def test_p95_forgets_all_but_the_last_200_and_memory_does_not_grow() -> None:
    times = ReplyTimes()
    times.add(99.0)
    for _ in range(10 * REPLY_TIMES_KEPT):
        times.add(0.5)
    assert (times.p95_s, times.max_s, len(times.recent_s)) == (0.5, 99.0, REPLY_TIMES_KEPT)


def test_failures_are_timeouts_damage_and_exceptions_of_any_code() -> None:
    counters = PollCounters(sent=9, good=2, timeouts=1, damaged=2, overruns=50, expired=60)
    counters.exceptions[2] += 1
    counters.exceptions[6] += 3
    assert counters.failures == 7


def test_two_lines_do_not_share_what_they_count() -> None:
    one, other = PollCounters(), PollCounters()
    one.exceptions[2] += 1
    one.times.add(1.0)
    assert (other.failures, other.times.count) == (0, 0)
    served, other_served = ServeCounters(), ServeCounters()
    served.exceptions[1] += 1
    assert not other_served.exceptions
