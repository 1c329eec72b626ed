"""A master at work: polls in turn, commands first, the menu's tickets, and what it tells of itself."""

from __future__ import annotations

import threading
from collections import Counter
from itertools import pairwise

import pytest

from gateway.errors import LinkUnavailable, QueueFull, RequestInvalid
from gateway.modbus.pdu import ReadRequest, Span, Table, WriteRequest
from gateway.register import Quality
from gateway.tickets import SUBMIT_LIMIT
from gateway.transaction import NO_ERROR, TIMEOUT
from tests.fakes import JumpingClock, MasterBench, reads, words, writes

UNIT = 17
INPUTS = Table.INPUT_REGISTERS


def status(it: MasterBench, point: int) -> list[int]:
    return it.values(point, 4, table=INPUTS)


# ------------------------------------------------------------------------------------------------ polls


def test_what_devices_say_goes_to_the_points_of_their_requests(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100, 2), reads(2, 200, 2))
    it.field.registers = {(1, 0): 11, (1, 1): 12, (2, 0): 21, (2, 1): 22}  # the same addresses in both
    it.run_s(0.5)
    assert it.values(99, 4) == [0, 11, 12, 0]
    assert it.values(200, 2) == [21, 22]
    assert it.qualities(100, 2) == {Quality.GOOD}
    assert [str(sample.source) for sample in it.register.samples(Span(Table.HOLDING_REGISTERS, 100, 1))] == [
        "field/u1-f3-0"
    ]


@pytest.mark.parametrize(
    ("function", "redirected", "table"),
    [
        (1, None, Table.COILS),
        (1, "discrete-inputs", Table.DISCRETE_INPUTS),
        (2, None, Table.DISCRETE_INPUTS),
        (2, "coils", Table.COILS),
        (3, None, Table.HOLDING_REGISTERS),
        (3, "input-registers", Table.INPUT_REGISTERS),
        (4, None, Table.INPUT_REGISTERS),
        (4, "holding_registers", Table.HOLDING_REGISTERS),
    ],
)
def test_each_function_fills_its_table_or_the_one_it_is_redirected_to(
    clock: JumpingClock, function: int, redirected: str | None, table: Table
) -> None:
    it = MasterBench(clock, reads(1, 50, 3, function=function, table=redirected, address=7))
    it.field.registers = {(1, 7): 70, (1, 9): 90}
    it.field.coils = {(1, 7): 1, (1, 9): 1}
    it.run_s(0.5)
    assert it.values(50, 3, table=table) == ([1, 0, 1] if table.is_bits else [70, 0, 90])
    for other in set(Table) - {table}:
        assert it.qualities(50, 3, table=other) == {Quality.NEVER}


def test_requests_go_in_turn_each_in_its_own_cycle(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0, every=1.0), reads(2, 1, every=2.0), reads(3, 2, every=0.5))
    it.run_s(10.0)
    assert [unit for _, unit, _ in it.field.asked][:3] == [1, 2, 3]
    assert Counter(unit for _, unit, _ in it.field.asked) == {1: 10, 2: 5, 3: 20}
    assert [poll.counters.overruns for poll in it.master.polls] == [0, 0, 0]


def test_a_line_that_cannot_keep_up_counts_overruns_and_starves_nobody(clock: JumpingClock) -> None:
    it = MasterBench(clock, *[reads(unit, unit, every=0.05) for unit in range(1, 11)])
    it.field.answer_after_s = 0.02
    it.run_s(60.0)
    counts = Counter(unit for _, unit, _ in it.field.asked)
    assert max(counts.values()) - min(counts.values()) <= 1
    for poll in it.master.polls:
        assert poll.counters.overruns == pytest.approx(60 / 0.05 - counts[poll.config.unit], abs=10)
    assert it.master.counters.overruns == sum(poll.counters.overruns for poll in it.master.polls)


def test_a_request_switched_off_is_never_sent(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0), reads(2, 1, enabled=False))
    it.run_s(5.0)
    assert it.field.count(2) == 0


def test_a_master_without_requests_waits_and_does_not_turn(clock: JumpingClock) -> None:
    it = MasterBench(clock)
    it.run_s(60.0)
    assert it.field.asked == []
    assert it.master.state() == "idle"


def test_each_request_has_its_own_response_timeout(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0, response_timeout=0.5, every=60.0), reads(2, 1, every=60.0))
    it.field.silent = {1, 2}
    it.run_s(10.0)
    first_s, second_s = [when_s for when_s, _ in it.link.written]
    assert second_s - first_s == pytest.approx(2 * 0.5)
    assert [poll.timeout_s for poll in it.master.polls] == [0.5, 2.5]
    assert it.master.busy_s == pytest.approx(2 * 0.5 + 2 * 2.5, abs=0.01)  # waiting, and as long listening


def test_between_frames_the_line_is_silent_and_the_delay_kept(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0, every=0.01), delay=0.25)
    it.run_s(5.0)
    times_s = [when_s for when_s, _ in it.link.written]
    assert min(b - a for a, b in pairwise(times_s)) >= 0.25 + it.field.answer_after_s - 1e-9


# ------------------------------------------------------------------------------------------------ commands first


def test_a_command_goes_before_any_poll_and_after_four_one_poll_goes_through(clock: JumpingClock) -> None:
    polls = [reads(unit, unit, every=0.01) for unit in range(1, 4)]
    it = MasterBench(clock, *polls, writes(9, 100, 50))
    it.run_s(0.2)
    it.field.asked.clear()
    for point in range(0, 20, 2):
        it.scada(100 + point, 1)
    it.steps(14)
    kinds = "".join("c" if unit == 9 else "p" for _, unit, _ in it.field.asked)
    assert kinds.startswith("ccccpccccpcc")


def test_under_a_steady_stream_of_commands_every_fifth_request_is_a_poll_and_all_get_their_turn(
    clock: JumpingClock,
) -> None:
    it = MasterBench(clock, *[reads(unit, unit, every=0.01) for unit in range(1, 4)], writes(9, 100))
    value = iter(range(1, 60000))
    it.run_s(20.0, meanwhile=lambda: it.scada(100, next(value)))
    counts = Counter(unit for _, unit, _ in it.field.asked)
    assert min(counts[unit] for unit in (1, 2, 3)) >= sum(counts.values()) / 5 / 3 - 2


def test_commands_go_on_without_a_break_while_no_poll_is_due(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0, every=3600.0), writes(9, 100, 50))
    it.run_s(0.2)
    it.field.asked.clear()
    for point in range(0, 20, 2):
        it.scada(100 + point, 1)
    it.steps(10)
    assert [unit for _, unit, _ in it.field.asked] == [9] * 10


# ------------------------------------------------------------------------------------------------ tickets


def test_a_ticket_is_sent_before_polls_and_brings_the_response(clock: JumpingClock) -> None:
    it = MasterBench(clock, *[reads(unit, unit, every=0.01) for unit in (1, 2, 3)])
    it.run_s(0.2)
    it.field.asked.clear()
    ticket = it.master.submit(5, WriteRequest(6, 7, 1, words(77)))
    assert it.waker.is_woken
    assert not ticket.done.is_set()
    it.steps(1)
    assert ticket.done.is_set()
    assert ticket.response is not None
    assert ticket.response.error_code == NO_ERROR
    assert ticket.response.reply_s == pytest.approx(it.field.answer_after_s)
    assert it.field.asked[0][1] == 5
    assert it.field.registers[5, 7] == 77


def test_tickets_are_counted_for_the_line(clock: JumpingClock) -> None:
    it = MasterBench(clock)
    it.field.silent = {6}
    for unit in (5, 6):
        it.master.submit(unit, ReadRequest(3, 0, 1))
    it.run_s(10.0)
    counters = it.master.counters
    assert (counters.sent, counters.good, counters.timeouts) == (2, 1, 1)


def test_a_full_queue_of_tickets_is_an_error_to_the_sender(clock: JumpingClock) -> None:
    it = MasterBench(clock)
    for _ in range(SUBMIT_LIMIT):
        it.master.submit(1, ReadRequest(3, 0, 1))
    with pytest.raises(QueueFull):
        it.master.submit(1, ReadRequest(3, 0, 1))
    it.run_s(0.2)
    it.master.submit(1, ReadRequest(3, 0, 1))
    it.run_s(0.2)
    assert len(it.field.asked) == SUBMIT_LIMIT + 1


@pytest.mark.parametrize(
    ("unit", "request_"),
    [(1, ReadRequest(3, 0, 126)), (256, ReadRequest(3, 0, 1)), (-1, ReadRequest(3, 0, 1)), (0, ReadRequest(3, 0, 1))],
    ids=["126 registers", "unit 256", "unit -1", "broadcast read"],
)
def test_a_ticket_that_cannot_be_sent_is_refused_to_its_sender_and_harms_nobody(
    clock: JumpingClock, unit: int, request_: ReadRequest
) -> None:
    it = MasterBench(clock, reads(1, 0))
    with pytest.raises(RequestInvalid):
        it.master.submit(unit, request_)
    it.run_s(2.0)
    assert it.field.count(1) == 2


@pytest.mark.parametrize("why", ["maintenance", "no line"])
def test_a_ticket_that_cannot_be_sent_in_10_s_is_given_up_and_never_sent_late(clock: JumpingClock, why: str) -> None:
    it = MasterBench(clock, enabled=why != "maintenance")
    it.missing = LinkUnavailable("not there") if why == "no line" else None
    ticket = it.master.submit(5, WriteRequest(6, 7, 1, words(77)))
    it.run_s(9.0)
    assert not ticket.done.is_set()
    it.run_s(5.0)
    assert (ticket.done.is_set(), ticket.response) == (True, None)
    it.missing = None
    it.master.set_enabled(True)
    it.run_s(120.0)
    assert it.field.asked == []


def test_a_ticket_on_a_line_that_is_lost_is_a_timeout_that_says_so(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0))
    it.run_s(0.5)
    ticket = it.master.submit(5, WriteRequest(6, 7, 1, words(77)))
    it.link.lose = "write"
    it.steps(1)
    assert ticket.done.is_set()
    assert ticket.response is not None
    assert (ticket.response.error_code, ticket.response.reason) == (TIMEOUT, "the port is gone")


def test_tickets_left_at_the_end_are_done(clock: JumpingClock) -> None:
    it = MasterBench(clock)
    ticket = it.master.submit(5, ReadRequest(3, 0, 1))
    it.master.close()
    assert (ticket.done.is_set(), ticket.response) == (True, None)


def test_a_ticket_that_a_device_answers_brings_it_back_at_once(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0))
    it.field.silent = {1}
    it.run_s(30.0)
    assert it.master.devices[1].is_offline
    it.field.silent = set()
    it.master.submit(1, ReadRequest(3, 0, 1))
    it.steps(1)
    assert not it.master.devices[1].is_offline


# ------------------------------------------------------------------------------------------------ states


def test_maintenance_sends_nothing_and_lets_the_port_go(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0, status_point=500), writes(1, 10, expire=5.0))
    it.run_s(3.0)
    assert it.master.state() == "idle"
    it.field.asked.clear()
    it.master.set_enabled(False)
    assert it.waker.is_woken
    it.scada(10, 1)
    it.run_s(60.0)
    assert it.field.asked == []
    assert it.link.closed
    assert it.master.state() == "maintenance"
    assert status(it, 500)[0] == 5
    assert it.master.counters.expired == 1
    it.master.set_enabled(True)
    it.run_s(2.0)
    assert it.field.count(1) >= 1
    assert it.field.writes == []  # nothing old
    assert status(it, 500)[0] == 1


def test_a_master_that_starts_in_maintenance_never_opens_its_port(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0), enabled=False)
    it.run_s(60.0)
    assert it.opened_s == []


def test_a_state_is_told_in_words(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0))
    assert it.master.state() == "no line"
    seen: list[str] = []
    it.field.during = lambda unit, pdu: seen.append(it.master.state())
    it.run_s(0.5)
    assert seen == ["held back"]
    assert it.master.state() == "idle"


def test_a_line_has_an_alarm_while_a_device_is_offline_or_the_port_is_gone(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0), reads(2, 1))
    it.run_s(2.0)
    assert not it.master.has_alarm
    it.field.silent = {1}
    it.run_s(60.0)
    assert it.master.has_alarm
    it.field.silent = set()
    it.run_s(120.0)
    assert not it.master.has_alarm
    it.link.lose, it.missing = "read", LinkUnavailable("/dev/ttyS2 is not there")
    it.run_s(5.0)
    assert it.master.has_alarm


def test_run_polls_until_it_is_stopped_and_lets_go_of_everything(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0), writes(1, 10))
    stop = threading.Event()
    flags: list[float] = []

    def alive() -> None:
        flags.append(clock.monotonic())
        if clock.monotonic() > 1005.0:
            stop.set()

    it.scada(10, 5)
    it.master.run(stop, alive)
    assert it.field.count(1) >= 5
    assert it.link.closed
    assert max(b - a for a, b in pairwise(flags)) <= 3.0
    clock.pass_s(100.0)
    assert it.register.read_fresh(Span(Table.HOLDING_REGISTERS, 0, 1)) is not None  # claimed by nobody any more


def test_a_stop_does_not_wait_for_a_silent_device(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0, response_timeout=3600.0), writes(2, 10, response_timeout=3600.0))
    it.field.silent = {1, 2}
    stop = threading.Event()

    def alive() -> None:
        if clock.monotonic() > 1001.0:
            stop.set()

    it.master.run(stop, alive)
    assert clock.monotonic() <= 1000.0 + 2 * 3.0
    assert it.master.polls[0].counters.timeouts == 0


def test_a_stop_ends_a_probe_too_and_a_command_cut_short_is_not_taken_for_delivered(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(2, 10, expire=0.0))
    it.field.silent = {2}
    it.scada(10, 1)
    it.run_s(30.0)
    stop = threading.Event()
    calls: list[float] = []

    def alive() -> None:
        calls.append(clock.monotonic())
        if len(it.field.asked) > 3:
            stop.set()

    it.master.run(stop, alive)
    assert it.qualities(10) == {Quality.BAD}


# ------------------------------------------------------------------------------------------------ counters and status


def test_line_and_requests_count_what_became_of_each(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0), reads(2, 1), reads(3, 2), reads(4, 3))
    it.field.refusing = {(2, 3): 2}
    it.field.silent = {3}
    it.field.damaging = {4}
    it.run_s(1.0)
    it.run_s(9.0)
    one, two, three, four = [poll.counters for poll in it.master.polls]
    assert one.sent == one.good == one.times.count > 0
    assert two.sent == two.exceptions[2] == two.failures > 0
    assert three.sent == three.timeouts > 0
    assert four.sent == four.damaged > 0
    line = it.master.counters
    assert line.sent == sum(each.sent for each in (one, two, three, four))
    assert line.failures == two.failures + three.failures + four.failures
    assert (line.good, line.times.count) == (one.good, one.good + two.failures)
    assert one.times.last_s == pytest.approx(0.01)
    assert it.master.busy_s <= clock.monotonic() - 1000.0


def test_a_status_point_tells_state_age_failures_and_last_error(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0, every=3600.0, stale_after=5.0, status_point=500))
    it.steps(1)
    assert status(it, 500) == [0, 65535, 0, 0]  # never
    it.run_s(0.1)
    assert status(it, 500) == [1, 0, 0, 0]
    it.run_s(4.0)
    assert (status(it, 500)[0], status(it, 500)[1] in (3, 4)) == (1, True)
    it.run_s(4.0)
    assert (status(it, 500)[0], status(it, 500)[1] in (7, 8)) == (3, True)


@pytest.mark.parametrize("trouble", ["exception", "timeout", "damage"])
def test_a_status_point_tells_of_a_failing_request(clock: JumpingClock, trouble: str) -> None:
    it = MasterBench(clock, reads(1, 0, every=1.0, status_point=500), reads(2, 1))
    it.field.refusing = {(1, 3): 4} if trouble == "exception" else {}
    it.field.silent = {1} if trouble == "timeout" else set()
    it.field.damaging = {1} if trouble == "damage" else set()
    it.run_s(1.0)
    code = {"exception": 4, "timeout": 0xFFFF, "damage": 0xFFFE}[trouble]
    state, age_s, failures, error = status(it, 500)
    assert (state, age_s, error) == (2, 65535, code)
    assert failures == it.master.polls[0].counters.failures >= 1
    it.run_s(30.0)
    assert status(it, 500)[0] == (2 if trouble == "exception" else 4)
    it.field.refusing, it.field.silent, it.field.damaging = {}, set(), set()
    it.run_s(120.0)
    state, age_s, failures, error = status(it, 500)
    assert (state, error) == (1, 0)
    assert age_s <= 1
    assert failures == it.master.polls[0].counters.failures


def test_the_failures_of_a_status_point_wrap_and_its_age_stops_at_65535(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0, status_point=500))
    poll = it.master.polls[0]
    poll.counters.timeouts = 65537
    poll.last_good_s = clock.monotonic()
    assert poll.status(clock.monotonic() + 65534.9, maintenance=False) == words(3, 65534, 1, 0)
    assert poll.status(clock.monotonic() + 1e6, maintenance=False) == words(3, 65535, 1, 0)
    assert poll.last_error != TIMEOUT


def test_a_status_is_kept_up_to_date_while_nothing_is_polled(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 0, every=3600.0, status_point=500))
    it.run_s(30.0)
    assert status(it, 500)[1] == pytest.approx(29, abs=1)
