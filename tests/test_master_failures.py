"""What a master makes of silence, damage, exceptions, lost ports and closed connections."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest

from gateway.errors import LinkUnavailable
from gateway.modbus.pdu import ReadRequest, Table
from gateway.register import Quality
from gateway.transaction import TIMEOUT
from tests.fakes import JumpingClock, LosableLink, MasterBench, reads, writes

# ------------------------------------------------------------------------------------------------ one request


@pytest.mark.parametrize(("on_failure", "value"), [("hold", 555), ("zero", 0)])
@pytest.mark.parametrize("trouble", ["silence", "damage", "exception"])
def test_a_failed_request_holds_or_zeroes_its_values_and_they_are_bad(
    clock: JumpingClock, trouble: str, on_failure: str, value: int
) -> None:
    it = MasterBench(clock, reads(1, 100, 2, on_failure=on_failure), reads(2, 200, stale_after=60.0))
    it.field.registers = {(1, 0): 555, (1, 1): 555, (2, 0): 7}
    it.run_s(0.5)
    assert it.values(100, 2) == [555, 555]
    it.field.silent = {1} if trouble == "silence" else set()
    it.field.damaging = {1} if trouble == "damage" else set()
    it.field.refusing = {(1, 3): 2} if trouble == "exception" else {}
    it.run_s(1.0)
    it.run_s(3.0)
    assert (it.values(100, 2), it.qualities(100, 2)) == ([value, value], {Quality.BAD})
    assert (it.values(200), it.qualities(200)) == ([7], {Quality.GOOD})


@pytest.mark.parametrize("retries", [0, 1, 2])
def test_points_are_bad_after_the_retries_and_not_before(clock: JumpingClock, retries: int) -> None:
    it = MasterBench(clock, reads(1, 100, every=3600.0), retries=retries)
    it.field.silent = {1}
    qualities = []
    it.field.during = lambda unit, pdu: qualities.append(it.qualities(100))
    it.run_s(60.0)
    tries = retries + 1
    assert qualities[:tries] == [{Quality.NEVER}] * tries
    assert it.qualities(100) == {Quality.BAD}
    if tries < 3:
        assert it.field.count(1) == tries  # and then not before its next cycle


def test_a_retry_that_succeeds_leaves_no_trace_but_in_the_counters(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100, every=3600.0), retries=1)
    it.field.silent = {1}
    it.field.during = lambda unit, pdu: it.field.silent.clear() if len(it.field.asked) == 2 else None
    it.run_s(20.0)
    assert it.field.count(1) == 2
    assert it.qualities(100) == {Quality.GOOD}
    assert it.master.counters.timeouts == 1


def test_an_exception_is_not_tried_again_and_spoils_no_neighbour(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100), reads(1, 200, address=50, function=4, table="holding_registers"), retries=5)
    it.field.refusing = {(1, 3): 2}
    it.run_s(60.0)
    assert it.qualities(100) == {Quality.BAD}
    assert it.qualities(200) == {Quality.GOOD}
    assert not it.master.devices[1].is_offline
    assert [poll.counters.sent for poll in it.master.polls] == [60, 60]


def test_an_exception_between_silences_keeps_a_device_online(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100, every=0.1), reads(1, 200, function=4, every=0.1))
    it.field.refusing = {(1, 3): 2}

    def silent_for_inputs(unit: int, pdu: bytes) -> None:
        it.field.silent = {1} if pdu[0] == 4 else set()

    it.field.during = silent_for_inputs
    it.run_s(120.0)
    assert not it.master.devices[1].is_offline


def test_a_failure_is_logged_once_and_so_is_its_end(clock: JumpingClock, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    it = MasterBench(clock, reads(1, 100))
    it.field.refusing = {(1, 3): 2}
    it.run_s(60.0)
    it.field.refusing = {}
    it.run_s(60.0)
    assert [record.getMessage() for record in caplog.records] == [
        "field/u1-f3-0: the device answered with exception 2",
        "field/u1-f3-0: good again",
    ]


# ------------------------------------------------------------------------------------------------ offline


@pytest.mark.parametrize("trouble", ["silent", "damaging"])
def test_a_device_is_offline_after_three_failures_and_all_its_points_are_bad(clock: JumpingClock, trouble: str) -> None:
    it = MasterBench(clock, reads(1, 100), reads(1, 200, every=3600.0), reads(2, 300), writes(1, 400))
    it.run_s(0.5)
    it.scada(400, 5)
    it.run_s(0.2)
    assert it.qualities(200) == it.qualities(400) == {Quality.GOOD}
    setattr(it.field, trouble, {1})
    while it.master.devices[1].failures_in_row < 2:
        it.master.step()
    assert not it.master.devices[1].is_offline
    assert it.qualities(200) == {Quality.GOOD}
    while it.master.devices[1].failures_in_row < 3:
        it.master.step()
    assert it.master.devices[1].is_offline
    assert it.qualities(100) == it.qualities(200) == it.qualities(400) == {Quality.BAD}
    assert it.qualities(300) == {Quality.GOOD}


def test_a_device_is_back_at_once_with_its_first_answer(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100, every=30.0), reads(1, 200, every=3600.0), reads(2, 300))
    it.field.silent = {1}
    it.run_s(120.0)
    assert it.master.devices[1].is_offline
    it.field.silent = set()
    it.field.asked.clear()
    while it.field.count(1) == 0:
        it.master.step()
    back_s = clock.monotonic()
    assert not it.master.devices[1].is_offline
    it.run_s(0.5)
    assert it.qualities(100) == it.qualities(200) == {Quality.GOOD}
    assert clock.monotonic() - back_s < 1.0


def test_offline_and_back_are_logged_once(clock: JumpingClock, caplog: pytest.LogCaptureFixture) -> None:
    it = MasterBench(clock, reads(1, 100), reads(1, 200))
    it.run_s(1.0)
    it.field.silent = {1}
    it.run_s(600.0)
    it.field.silent = set()
    it.run_s(120.0)
    messages = Counter(record.getMessage() for record in caplog.records)
    assert messages["field: unit 1 is offline: no reply"] == 1
    assert messages["field: unit 1 is back"] == 1
    assert sum(messages.values()) <= 4


def polls_in_an_hour(silent: set[int]) -> tuple[Counter[int], MasterBench]:
    clock = JumpingClock()
    it = MasterBench(clock, *[reads(unit, unit, every=2.0) for unit in range(1, 11)])
    it.field.answer_after_s = 0.2  # ten of them take all the line's time
    it.run_s(10.0)
    it.field.silent = silent
    it.field.asked.clear()
    it.run_s(3600.0)
    return Counter(unit for _, unit, _ in it.field.asked), it


def test_one_silent_device_takes_at_most_a_tenth_of_the_others_polls_and_is_tried_every_minute() -> None:
    without, _ = polls_in_an_hour(silent=set())
    with_it, it = polls_in_an_hour(silent={4})
    for unit in set(range(1, 11)) - {4}:
        assert with_it[unit] >= 0.9 * without[unit], unit
    tried_s = [when_s for when_s, unit, _ in it.field.asked if unit == 4]
    assert max(b - a for a, b in pairwise(tried_s)) <= 61.0
    assert 60 <= len(tried_s) <= 3600 / 50 + 3


def test_several_silent_devices_share_one_budget_in_turn() -> None:
    without, _ = polls_in_an_hour(silent=set())
    with_them, it = polls_in_an_hour(silent={2, 5, 9})
    for unit in set(range(1, 11)) - {2, 5, 9}:
        assert with_them[unit] >= 0.88 * without[unit], unit  # three devices had to fail three times each at first
    tried = [unit for _, unit, _ in it.field.asked if unit in (2, 5, 9)][-57:]
    assert len(tried) == 57
    assert all({a, b, c} == {2, 5, 9} for a, b, c in zip(tried, tried[1:], tried[2:], strict=False))


@pytest.mark.parametrize(("timeout_s", "every_s"), [(10.0, 60.0), (14.5, 60.0), (20.0, 80.0), (60.0, 240.0)])
def test_a_long_probe_is_sent_every_minute_unless_that_takes_more_than_half_of_the_line(
    clock: JumpingClock, timeout_s: float, every_s: float
) -> None:
    """A probe takes its timeout, and as long again to listen."""
    it = MasterBench(clock, reads(1, 100, response_timeout=timeout_s), reads(2, 200))
    it.field.silent = {1}
    it.run_s(12 * every_s)
    tried_s = [when_s for when_s, unit, _ in it.field.asked if unit == 1][4:]
    assert len(tried_s) >= 5
    assert [b - a for a, b in pairwise(tried_s)] == pytest.approx([every_s] * (len(tried_s) - 1), abs=1)
    assert it.field.count(2) >= 0.4 * 12 * every_s


def test_with_every_device_silent_the_line_is_probed_and_does_not_turn(clock: JumpingClock) -> None:
    it = MasterBench(clock, *[reads(unit, unit, every=0.01) for unit in range(1, 4)])
    it.field.silent = {1, 2, 3}
    it.run_s(3600.0)
    assert 60 <= len(it.field.asked) <= 80
    it.field.silent = set()
    it.run_s(200.0)
    assert not any(device.is_offline for device in it.master.devices.values())


def test_an_offline_device_with_nothing_to_send_is_passed_over(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(1, 100, expire=20.0), reads(2, 200))  # each of three tries takes 2.5 s twice
    it.field.silent = {1}
    it.scada(100, 5)
    it.run_s(60.0)
    assert it.master.devices[1].is_offline
    before = it.field.count(1)
    it.run_s(600.0)
    assert it.field.count(1) == before
    assert it.field.count(2) >= 0.95 * 600
    it.field.silent = set()
    it.scada(100, 6)
    it.run_s(60.0)
    assert it.field.registers[1, 0] == 6


# ------------------------------------------------------------------------------------------------ a missing port


def test_a_missing_port_is_logged_once_tried_again_later_and_later_and_its_points_are_bad(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    it = MasterBench(clock, reads(1, 100, status_point=500), writes(1, 200))
    it.missing = LinkUnavailable("/dev/ttyS2 is not there")
    it.run_s(600.0)
    assert [record.getMessage() for record in caplog.records] == ["field: /dev/ttyS2 is not there; trying again"]
    assert it.master.trouble == "/dev/ttyS2 is not there"
    gaps_s = [b - a for a, b in zip(it.opened_s, it.opened_s[1:], strict=False)]
    assert gaps_s[:7] == pytest.approx([0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0])
    assert gaps_s[7:] == pytest.approx([30.0] * len(gaps_s[7:]))
    assert it.qualities(100) == {Quality.BAD}
    assert it.qualities(200) == {Quality.NEVER}
    assert it.values(500, 4, table=Table.INPUT_REGISTERS) == [2, 65535, 0, TIMEOUT]
    it.missing = None
    it.run_s(35.0)
    assert it.master.trouble == ""
    assert it.qualities(100) == {Quality.GOOD}
    assert caplog.records[-1].getMessage() == "field: the line works again"


def test_a_port_unplugged_is_closed_and_opened_again(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100))
    it.run_s(5.0)
    old: LosableLink = it.link
    old.lose = "read"
    it.missing = LinkUnavailable("/dev/ttyS2 is not there")
    it.run_s(20.0)
    assert old.closed
    assert it.qualities(100) == {Quality.BAD}
    it.missing = None
    it.run_s(40.0)
    assert it.qualities(100) == {Quality.GOOD}


@pytest.mark.parametrize("at", ["read", "write"])
def test_a_command_on_a_link_that_is_lost_is_sent_on_the_next(clock: JumpingClock, at: str) -> None:
    it = MasterBench(clock, reads(1, 100), writes(1, 200))
    it.run_s(0.5)
    it.scada(200, 5)
    it.link.lose = at
    it.run_s(3.0)
    assert len(it.links) == 2
    assert it.field.registers[1, 0] == 5
    it.run_s(3.0)
    assert it.master.counters.expired == 0
    assert it.values(100) == [5]


def test_a_command_that_ends_every_connection_does_not_keep_the_polls_from_the_line(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100, every=0.1), writes(2, 200, expire=0.0), line="tcp://10.0.0.7:502")

    def hang_up(unit: int, pdu: bytes) -> None:
        if unit == 2:
            it.link.lose = "read"

    it.field.during = hang_up
    it.run_s(1.0)
    it.scada(200, 5)
    it.field.asked.clear()
    it.run_s(600.0)
    assert it.field.count(1) >= 5
    assert it.field.count(2) <= 2000


# ------------------------------------------------------------------------------------------------ TCP


def tcp_bench(clock: JumpingClock, every: float = 10.0) -> MasterBench:
    return MasterBench(clock, reads(1, 100, every=every), line="tcp://10.0.0.7:502")


def test_a_connection_closed_while_idle_is_opened_again_without_a_word(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    """A device that closes idle connections after a second, and is polled every ten."""
    it = tcp_bench(clock)
    bad: list[float] = []

    def close_when_idle() -> None:
        if it.links and clock.monotonic() - it.opened_s[-1] >= 1.0:
            it.link.lose = "read"
        if it.qualities(100) == {Quality.BAD}:
            bad.append(clock.monotonic())

    it.run_s(100.0, meanwhile=close_when_idle)
    assert it.field.count(1) == 10
    assert bad == []
    assert [record for record in caplog.records if record.levelname != "DEBUG"] == []
    assert len(it.links) <= 21


def test_a_connection_closed_while_idle_is_opened_again_for_a_command(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(1, 100), line="tcp://10.0.0.7:502")
    it.run_s(1.0)
    it.scada(100, 1)
    it.run_s(1.0)
    it.link.lose = "read"
    it.run_s(60.0)
    it.scada(100, 2)
    it.run_s(4.0)
    assert [write.values for write in it.field.writes] == [[1], [2]]


def test_a_refused_connection_is_trouble_until_something_answers(clock: JumpingClock) -> None:
    it = tcp_bench(clock, every=1.0)
    it.missing = LinkUnavailable("10.0.0.7:502 refuses")
    it.run_s(10.0)
    assert it.qualities(100) == {Quality.BAD}
    it.missing, it.field.silent = None, {1}
    it.run_s(6.0)
    assert it.links
    assert it.master.trouble
    it.field.silent = set()
    it.run_s(120.0)
    assert it.master.trouble == ""


def test_a_connection_on_which_nothing_answers_is_made_anew(clock: JumpingClock) -> None:
    it = MasterBench(clock, *[reads(unit, unit, every=0.5) for unit in (1, 2, 3, 4)], line="tcp://10.0.0.7:502")
    it.run_s(5.0)
    first = it.link
    it.field.silent = {1, 2, 3, 4}
    it.run_s(8.0)
    assert first.closed
    it.field.silent = set()
    it.run_s(8.0)
    assert {quality for unit in (1, 2, 3, 4) for quality in it.qualities(unit)} == {Quality.GOOD}


def test_a_server_that_hangs_up_before_it_answers_is_tried_later_and_later(clock: JumpingClock) -> None:
    it = tcp_bench(clock, every=0.1)

    def hang_up(unit: int, pdu: bytes) -> None:
        it.link.lose = "read"

    it.field.during = hang_up
    it.run_s(300.0)
    assert len(it.opened_s) <= 20
    assert it.qualities(100) == {Quality.BAD}


def test_on_tcp_one_silent_unit_does_not_close_the_connection_of_others(clock: JumpingClock) -> None:
    it = MasterBench(clock, *[reads(unit, unit, every=1.0) for unit in (1, 2)], line="tcp://10.0.0.7:502")
    it.field.silent = {1}
    it.run_s(600.0)
    assert len(it.links) == 1
    assert it.field.count(2) >= 0.85 * 600


def test_a_ticket_to_a_unit_without_requests_judges_nobody(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100))
    it.field.silent = {9}
    for _ in range(4):
        it.master.submit(9, ReadRequest(3, 0, 1))
        it.run_s(6.0)
    assert set(it.master.devices) == {1}
    assert it.qualities(100) == {Quality.GOOD}
