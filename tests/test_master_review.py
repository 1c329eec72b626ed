"""A master where things meet: a value that changes while the line is busy, zeros and commands, probes and commands.

Each test stands for a fault that a review found once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from gateway.errors import LinkUnavailable, QueueFull
from gateway.modbus.pdu import Span, Table
from gateway.register import Quality
from tests.fakes import JumpingClock, MasterBench, reads, writes


def cyclic(unit: int, point: int, count: int = 1, **settings: Any) -> dict[str, Any]:
    return writes(unit, point, count, **{"trigger": "cycle", **settings})


def written(it: MasterBench) -> list[tuple[int, list[int]]]:
    """What devices got: unit and values."""
    return [(write.unit, write.values) for write in it.field.writes]


def probes(it: MasterBench, *units: int) -> list[tuple[float, int, int]]:
    """When which of the *units* was asked, and with which function."""
    return [(when_s, unit, pdu[0]) for when_s, unit, pdu in it.field.asked if unit in units]


def make_offline(it: MasterBench, *units: int) -> None:
    """Have *units* fall silent, wait until they are offline, and forget what was asked until then."""
    it.field.silent |= set(units)
    while not all(it.master.devices[unit].is_offline for unit in units):
        it.master.step()
    it.field.asked.clear()


# ------------------------------------------------------------------------------------------------ before it is sent


def spoiled(clock: JumpingClock, *requests: dict[str, Any], **line: Any) -> MasterBench:
    """A line that listens for a late reply of unit 1."""
    it = MasterBench(clock, reads(1, 10, every=3600.0), *requests, **line)
    it.field.silent = {1}
    it.steps(2)
    assert it.master.state() == "spoiled"
    return it


def after_a_poll(clock: JumpingClock, *requests: dict[str, Any]) -> MasterBench:
    """A line that keeps its delay after the reply of unit 1."""
    it = MasterBench(clock, reads(1, 10, every=3600.0), *requests, delay=2.0)
    it.steps(2)
    assert it.field.count(1) == 1
    return it


BUSY = pytest.mark.parametrize("busy", [spoiled, after_a_poll], ids=["spoiled", "delay"])
Busy = Callable[..., MasterBench]


@BUSY
def test_a_command_is_not_taken_before_the_line_can_send_it_so_that_only_the_newest_is_sent(
    clock: JumpingClock, busy: Busy
) -> None:
    it = busy(clock, writes(9, 100))
    it.scada(100, 5)
    clock.pass_s(0.5)
    it.steps(1)
    it.scada(100, 6)
    it.run_s(10.0)
    assert written(it) == [(9, [6])]


@BUSY
def test_a_cyclic_write_takes_its_values_when_the_line_can_send_them(clock: JumpingClock, busy: Busy) -> None:
    it = busy(clock, cyclic(9, 100, every=3600.0))
    it.scada(100, 5)
    clock.pass_s(0.5)
    it.steps(1)
    it.scada(100, 6)
    it.run_s(10.0)
    assert written(it) == [(9, [6])]


def test_a_command_that_expires_while_the_line_is_spoiled_is_never_sent(clock: JumpingClock) -> None:
    it = spoiled(clock, writes(9, 100, expire=10.0), response_timeout=20.0)
    it.scada(100, 5)
    it.run_s(120.0)
    assert written(it) == []
    assert it.master.counters.expired == 1


@BUSY
@pytest.mark.parametrize("request_", [writes(9, 100), cyclic(9, 100)], ids=["change", "cycle"])
def test_maintenance_switched_on_while_the_line_is_busy_sends_nothing_any_more(
    clock: JumpingClock, busy: Busy, request_: dict[str, Any]
) -> None:
    it = busy(clock, request_)
    it.scada(100, 5)
    it.steps(1)
    it.master.set_enabled(False)
    it.run_s(60.0)
    assert written(it) == []


def test_a_line_that_babbles_without_end_fails_its_polls_and_recovers(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100), delay=0.25)
    it.run_s(1.0)
    it.link.arriving = [(clock.monotonic() + i / 512, b"\x00") for i in range(512 * 60)]
    it.run_s(59.0)
    assert it.qualities(100) == {Quality.BAD}
    assert it.master.polls[0].counters.damaged >= 3
    it.run_s(120.0)
    assert it.qualities(100) == {Quality.GOOD}


# ------------------------------------------------------------------------------------------------ zeros, read-backs


def test_zeros_for_a_device_that_fails_are_never_written_into_it(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(3, 300, 2, on_failure="zero"), cyclic(3, 300, 2))
    it.scada(300, 71, 72)
    it.run_s(3.0)
    make_offline(it, 3)
    assert it.values(300, 2) == [0, 0]
    it.field.silent = set()
    it.run_s(120.0)
    assert {tuple(values) for _, values in written(it)} == {(71, 72)}
    assert it.values(300, 2) == [71, 72]
    it.scada(301, 9)
    it.run_s(2.0)
    assert written(it)[-1] == (3, [71, 9])


@pytest.mark.parametrize(
    "request_", [cyclic(3, 300, 2), writes(3, 300, 2, whole=True, expire=0.0)], ids=["cycle", "whole"]
)
def test_a_setpoint_written_while_its_neighbour_is_such_a_zero_waits_for_the_read(
    clock: JumpingClock, request_: dict[str, Any]
) -> None:
    it = MasterBench(clock, request_, reads(3, 300, 2, on_failure="zero"))
    it.scada(300, 71, 72)
    it.run_s(3.0)
    make_offline(it, 3)
    it.scada(300, 9)
    it.field.silent = set()
    it.run_s(120.0)
    assert {tuple(values) for _, values in written(it)} == {(71, 72), (9, 72)}


def test_zeros_for_a_device_never_read_make_its_points_not_known(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(3, 300, on_failure="zero"), cyclic(4, 300), writes(4, 299, 2, whole=True, expire=0.0))
    it.field.silent = {3}
    it.scada(299, 5)
    it.run_s(120.0)
    assert written(it) == []
    assert it.register.known(Span(Table.HOLDING_REGISTERS, 300, 1)) is None
    assert it.values(300) == [0]
    assert it.qualities(300) == {Quality.BAD}


def test_one_setpoint_goes_out_with_the_other_as_the_device_has_it(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(3, 300, 2), cyclic(3, 300, 2))
    it.field.registers = {(3, 0): 7, (3, 1): 8}
    it.run_s(60.0)
    assert written(it) == []  # nobody has written anything
    it.scada(301, 80)
    it.run_s(2.0)
    assert written(it)[0] == (3, [7, 80])
    assert it.values(300, 2) == [7, 80]


@pytest.mark.parametrize("trouble", ["silence", "exception"])
@pytest.mark.parametrize("trigger", ["cycle", "change"])
def test_what_becomes_of_a_write_says_nothing_of_points_that_another_devices_read_fills(
    clock: JumpingClock, trigger: str, trouble: str
) -> None:
    it = MasterBench(clock, reads(1, 100, every=0.5, stale_after=600.0), writes(2, 100, trigger=trigger, expire=0.0))
    it.field.silent = {2} if trouble == "silence" else set()
    it.field.refusing = {(2, 16): 4} if trouble == "exception" else {}
    seen: set[Quality] = set()
    it.run_s(1.0)
    if trigger == "change":
        it.scada(100, 5)
        it.run_s(20.0 if trouble == "silence" else 3.0)
    it.run_s(60.0, meanwhile=lambda: seen.update(it.qualities(100)))
    assert seen == {Quality.GOOD}
    assert it.master.polls[1].is_bad
    make_offline(it, 1)
    it.field.silent, it.field.refusing = {1}, {}
    seen.clear()
    it.run_s(30.0, meanwhile=lambda: seen.update(it.qualities(100)))
    assert seen == {Quality.BAD}


def test_a_command_delivered_makes_no_point_good_whose_read_fails(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100), writes(2, 100, expire=0.0))
    make_offline(it, 1)
    read = it.master.polls[0]
    it.field.during = lambda unit, pdu: it.register.mark(read.span, Quality.BAD, read.source)  # fails once more
    it.scada(100, 5)
    while not written(it):
        it.master.step()
    assert it.qualities(100) == {Quality.BAD}


def test_a_refused_cyclic_write_lets_go_of_its_points_and_the_next_read_shows_the_device(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(3, 300, every=0.5), cyclic(3, 300))
    it.field.registers[3, 0] = 7
    it.run_s(1.2)
    it.field.refusing = {(3, 16): 3}
    it.scada(300, 100)
    assert it.values(300) == [100]
    it.run_s(3.0)
    assert (it.values(300), it.qualities(300)) == ([7], {Quality.GOOD})


# ------------------------------------------------------------------------------------------------ probes


def test_an_offline_device_that_a_command_waits_for_has_every_other_probe(clock: JumpingClock) -> None:
    polled = [reads(unit, unit, response_timeout=0.5) for unit in range(1, 6)]
    it = MasterBench(clock, *polled, writes(5, 100, expire=0.0, response_timeout=0.5), reads(7, 7))
    make_offline(it, 1, 2, 3, 4, 5)
    it.scada(100, 9)
    it.run_s(130.0)
    tried = [(unit, function) for _, unit, function in probes(it, 1, 2, 3, 4, 5)]
    assert len(tried) >= 10
    assert set(tried[::2]) == {(5, 16)}
    assert {unit for unit, _ in tried[1:10:2]} == {1, 2, 3, 4, 5}  # the others are not starved


def test_a_probe_that_finds_nothing_to_send_goes_to_the_next_device(clock: JumpingClock) -> None:
    it = MasterBench(
        clock, writes(1, 100, expire=20.0), reads(2, 200, response_timeout=0.5), cyclic(3, 300, response_timeout=0.5)
    )
    it.scada(100, 1)
    it.field.silent = {1, 2}
    it.run_s(60.0)
    make_offline(it, 1, 2)
    it.run_s(200.0)
    assert {unit for _, unit, _ in probes(it, 1, 2)} == {2}
    gaps_s = [b - a for (a, _, _), (b, _, _) in pairwise(probes(it, 2))]
    assert gaps_s == pytest.approx([11.0] * len(gaps_s), abs=0.2)  # 1 s of probing, 10 s of polling


def test_no_probe_is_spent_on_a_cyclic_write_without_values(clock: JumpingClock) -> None:
    it = MasterBench(clock, cyclic(2, 100), cyclic(2, 110), reads(2, 200), response_timeout=0.5)
    make_offline(it, 2)
    it.run_s(200.0)
    assert {function for _, _, function in probes(it, 2)} == {3}
    gaps_s = [b - a for (a, _, _), (b, _, _) in pairwise(probes(it, 2))]
    assert gaps_s == pytest.approx([11.0] * len(gaps_s), abs=0.2)


def test_the_polls_of_a_probed_device_take_turns(clock: JumpingClock) -> None:
    it = MasterBench(
        clock,
        *[
            reads(2, point, function=function, table="holding_registers", every=3600.0)
            for point, function in ((1, 3), (2, 4))
        ],
    )
    make_offline(it, 2)
    it.run_s(600.0)
    functions = [function for _, _, function in probes(it, 2)]
    assert len(functions) >= 8
    assert all(a != b for a, b in pairwise(functions))


# ------------------------------------------------------------------------------------------------ back again


def test_what_was_delivered_before_a_device_went_offline_is_good_again_when_it_is_back_and_the_rest_stays_bad(
    clock: JumpingClock,
) -> None:
    it = MasterBench(clock, writes(9, 100, 3, expire=5.0), reads(9, 200), response_timeout=0.5)
    it.scada(100, 1, 2)
    it.run_s(2.0)
    make_offline(it, 9)
    it.scada(101, 3)
    it.run_s(20.0)
    assert it.qualities(100, 3) == {Quality.BAD}
    it.field.silent = set()
    it.run_s(30.0)
    assert it.qualities(100) == {Quality.GOOD}  # delivered
    assert it.qualities(101) == {Quality.BAD}  # given up
    assert it.qualities(102) == {Quality.NEVER}
    it.scada(101, 4)
    it.run_s(2.0)
    assert it.qualities(100, 2) == {Quality.GOOD}


def test_one_outage_is_told_in_few_lines(clock: JumpingClock, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    it = MasterBench(
        clock, *[reads(1, point, every=0.5, address=point) for point in range(100, 108)], writes(1, 200, expire=0.0)
    )
    it.run_s(3.0)
    it.field.silent = {1}
    it.run_s(600.0)
    it.scada(200, 5)
    it.run_s(600.0)
    it.scada(200, 6)
    it.field.silent = set()
    it.run_s(120.0)
    lines = Counter(record.getMessage() for record in caplog.records)
    assert set(lines.values()) == {1}
    assert lines["field: unit 1 is offline: no reply"] == lines["field: unit 1 is back"] == 1
    failed = {line.removesuffix(": no reply") for line in lines if line.endswith(": no reply")}
    again = {line.removesuffix(": good again") for line in lines if line.endswith(": good again")}
    assert again == {name for name in failed if name.startswith("field/")}
    assert sum(lines.values()) == 2 + 2 * len(again)
    assert len(again) <= 3


# ------------------------------------------------------------------------------------------------ ports, connections


def test_a_stop_while_the_line_is_being_opened_is_no_trouble(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    it = MasterBench(clock, reads(1, 100))
    it.missing = LinkUnavailable("tcp 10.0.0.7:502: interrupted")
    it.waker.ended = True
    it.steps(1)
    assert (it.opened_s, it.master.trouble, caplog.records) == ([1000.0], "", [])
    assert it.qualities(100) == {Quality.NEVER}


def test_cycles_missed_while_the_port_was_gone_are_no_overruns(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100, every=0.5))
    it.run_s(5.0)
    it.link.lose = "read"
    it.missing = LinkUnavailable("/dev/ttyS2 is not there")
    it.run_s(600.0)
    it.missing = None
    it.run_s(40.0)
    assert it.qualities(100) == {Quality.GOOD}
    assert it.master.counters.overruns == 0


def test_a_port_that_opens_and_fails_at_the_first_read_is_in_trouble_and_tried_later_and_later(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    it = MasterBench(clock, reads(1, 100))

    def break_each() -> None:
        if it.links:
            it.link.lose = "read"

    it.run_s(600.0, meanwhile=break_each)
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [
        "field: the port is gone; trying again"
    ]
    assert "field: the line works again" not in caplog.text
    assert len(it.opened_s) <= 30
    assert it.master.trouble == "the port is gone"
    it.run_s(60.0)
    assert (it.master.trouble, it.qualities(100)) == ("", {Quality.GOOD})
    assert caplog.text.count("field: the line works again") == 1


def test_a_reopened_connection_polls_what_is_due_and_not_all_at_once(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    """A device that closes idle connections after half a second; one request a second, another once a minute."""
    it = MasterBench(clock, reads(1, 100), cyclic(1, 200, every=60.0), line="tcp://10.0.0.7:502")
    it.scada(200, 5)

    def close_when_idle() -> None:
        if it.links and clock.monotonic() - it.opened_s[-1] >= 0.5:
            it.link.lose = "idle"

    it.run_s(170.0, meanwhile=close_when_idle)
    assert len(it.links) >= 100
    assert written(it) == [(1, [5])] * 3
    assert it.field.count(1) == pytest.approx(170 + 3, abs=2)
    assert it.qualities(100) == {Quality.GOOD}
    assert caplog.records == []
    assert it.master.counters.overruns == 0


@pytest.mark.parametrize("request_", [reads(2, 200), writes(2, 200, expire=0.0)], ids=["poll", "command"])
@pytest.mark.parametrize("every", [0.5, 30.0])
def test_a_unit_whose_requests_end_the_connection_is_offline_and_its_neighbours_live_on(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture, request_: dict[str, Any], every: float
) -> None:
    it = MasterBench(clock, reads(1, 100, every=every), request_, line="tcp://10.0.0.7:502")

    def hang_up(unit: int, pdu: bytes) -> None:
        if unit == 2:
            it.link.lose = "read"

    it.field.during = hang_up
    it.run_s(0.5)
    it.scada(200, 5)
    seen: set[Quality] = set()
    it.run_s(600.0, meanwhile=lambda: seen.update(it.qualities(100)))
    assert it.master.devices[2].is_offline
    assert it.master.counters.timeouts == it.field.count(2)
    assert seen == {Quality.GOOD}
    assert it.field.count(1) >= 0.9 * 600 / every
    assert it.field.count(1) <= 600 / every + 2
    assert 10 <= it.field.count(2) <= 25  # a connection lost is a probe of 2.5 s
    assert [record.levelname for record in caplog.records if record.levelname == "ERROR"] == []
    it.field.during = lambda unit, pdu: None
    it.run_s(60.0)
    assert not it.master.devices[2].is_offline


def test_a_server_that_hangs_up_on_everybody_is_trouble_and_tried_later_and_later(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    it = MasterBench(clock, reads(1, 100), reads(2, 200), line="tcp://10.0.0.7:502")

    def hang_up(unit: int, pdu: bytes) -> None:
        it.link.lose = "read"

    it.field.during = hang_up
    it.run_s(600.0)
    assert len(it.opened_s) <= 40
    assert it.master.trouble == "the port is gone"
    assert it.qualities(100) == it.qualities(200) == {Quality.BAD}
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [
        "field: the port is gone; trying again"
    ]


def test_a_device_that_hangs_up_after_each_reply_is_asked_on_a_new_connection_each_time(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    it = MasterBench(clock, *[reads(1, point) for point in (100, 101, 102)], line="tcp://10.0.0.7:502")

    def hang_up_after_the_reply() -> None:
        if it.links and it.link.written and it.master.state() == "idle":
            it.link.lose = "idle"

    it.run_s(60.0, meanwhile=hang_up_after_the_reply)
    assert it.master.counters.timeouts == 0
    assert it.field.count(1) == pytest.approx(3 * 60, abs=3)
    assert caplog.records == []


# ------------------------------------------------------------------------------------------------ a full queue


def test_a_full_queue_takes_a_new_value_for_a_point_that_waits_and_no_new_point(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(9, 0, 120, expire=0.0), enabled=False)
    for point in range(100):
        it.scada(point, 1)
    for point in range(100):
        it.scada(point, 2)
    with pytest.raises(QueueFull):
        it.scada(100, 2)
    assert it.values(99, 2) == [2, 0]
    it.master.set_enabled(True)
    it.run_s(30.0)
    assert written(it) == [(9, [2])] * 100
