"""Setpoints on their way through a master: each arrives, once, with its value, and nothing old ever does."""

from __future__ import annotations

import random
from typing import Any

import pytest

from gateway.errors import QueueFull
from gateway.modbus.pdu import Span, Table
from gateway.register import Quality, Source, SourceKind
from tests.fakes import FieldWrite, JumpingClock, MasterBench, reads, words, writes

MENU = Source(SourceKind.MENU, "console")


def written(it: MasterBench) -> list[tuple[int, int, list[int]]]:
    """What devices got: unit, address, values."""
    return [(write.unit, write.address, write.values) for write in it.field.writes]


def cyclic(unit: int, point: int, count: int = 1, **settings: Any) -> dict[str, Any]:
    return writes(unit, point, count, **{"trigger": "cycle", **settings})


# ------------------------------------------------------------------------------------------------ on change


@pytest.mark.parametrize(
    ("function", "table", "asked"),
    [
        (5, Table.COILS, "05 0007 FF00"),
        (6, Table.HOLDING_REGISTERS, "06 0007 0001"),
        (15, Table.COILS, "0F 0007 0001 01 01"),
        (16, Table.HOLDING_REGISTERS, "10 0007 0001 02 0001"),
    ],
)
def test_each_write_function_carries_the_value_to_the_device(
    clock: JumpingClock, function: int, table: Table, asked: str
) -> None:
    it = MasterBench(clock, writes(9, 100, function=function, address=7))
    it.run_s(5.0)
    assert it.field.asked == []
    it.scada(100, 1, table=table)
    it.run_s(3.1)
    assert [(unit, pdu) for _, unit, pdu in it.field.asked] == [(9, bytes.fromhex(asked))]
    assert it.qualities(100, table=table) == {Quality.GOOD}


def test_only_the_points_written_are_sent_to_their_addresses_in_contiguous_runs(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(9, 100, 10, address=1000))
    it.scada(98, 1, 2, 3, 4)
    it.scada(105, 5)
    it.run_s(1.0)
    assert written(it) == [(9, 1000, [3, 4]), (9, 1005, [5])]


def test_the_masters_own_reads_change_nothing_in_the_device(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(9, 100, 5), writes(9, 100, 5))
    it.field.registers = {(9, i): 50 + i for i in range(5)}
    it.run_s(60.0)
    assert written(it) == []


def test_a_menu_write_goes_to_the_device_too(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(9, 100))
    it.register.write(Span(Table.HOLDING_REGISTERS, 100, 1), words(5), MENU, Quality.MANUAL)
    it.run_s(1.0)
    assert written(it) == [(9, 0, [5])]
    assert it.qualities(100) == {Quality.MANUAL}


def test_a_whole_request_is_sent_whole_once_all_its_points_are_known(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(9, 100, 3, whole=True, expire=0.0))
    it.scada(100, 1)
    it.scada(101, 2)
    it.run_s(60.0)
    assert written(it) == []
    it.scada(102, 3)
    it.run_s(1.0)
    it.scada(101, 20)
    it.run_s(1.0)
    assert written(it) == [(9, 0, [1, 2, 3]), (9, 0, [1, 20, 3])]


def test_a_refused_setpoint_is_bad_is_not_tried_again_and_the_next_read_shows_the_device(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(9, 100, every=5.0), writes(9, 100, status_point=500))
    it.field.registers[9, 0] = 7
    it.field.refusing = {(9, 16): 3}
    it.run_s(1.0)
    it.scada(100, 5)
    it.run_s(2.5)
    assert it.qualities(100) == {Quality.BAD}
    assert it.values(500, 4, table=Table.INPUT_REGISTERS) == [2, 65535, 1, 3]
    it.run_s(10.0)
    assert (it.values(100), it.qualities(100)) == ([7], {Quality.GOOD})
    assert [pdu[0] for _, _, pdu in it.field.asked].count(16) == 1
    it.field.refusing = {}
    it.scada(100, 6)
    it.run_s(1.0)
    assert it.values(500, 1, table=Table.INPUT_REGISTERS) == [1]


def test_a_silent_device_is_sent_the_same_command_again(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(9, 100), response_timeout=0.5)
    it.field.silent = {9}
    it.field.during = lambda unit, pdu: it.field.silent.clear() if len(it.field.asked) == 2 else None
    it.scada(100, 5)
    it.run_s(5.0)
    assert len(it.field.asked) == 2
    assert written(it) == [(9, 0, [5])]
    assert it.qualities(100) == {Quality.GOOD}


def test_a_write_that_finds_the_queue_full_is_refused_whole(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(9, 0, 120, address=0), enabled=False)
    refused = 0
    for point in range(120):
        try:
            it.scada(point, 1)
        except QueueFull:
            refused += 1
            assert it.qualities(point) == {Quality.NEVER}
    assert refused == 20


# ------------------------------------------------------------------------------------------------ the read-back


@pytest.mark.parametrize("function", [6, 16])
def test_a_setpoint_is_not_overwritten_by_the_read_back_of_a_poll_in_flight(clock: JumpingClock, function: int) -> None:
    it = MasterBench(clock, reads(9, 100), writes(9, 100, function=function))
    it.field.registers[9, 0] = 7
    seen: list[list[int]] = []

    def scada_writes_now(unit: int, pdu: bytes) -> None:
        if pdu[0] == 3 and len(it.field.asked) == 3:
            it.scada(100, 555)
        seen.append(it.values(100))

    it.field.during = scada_writes_now
    it.run_s(10.0)
    assert seen[:5] == [[0], [7], [555], [555], [555]]
    assert written(it) == [(9, 0, [555])]
    assert (it.values(100), it.qualities(100)) == ([555], {Quality.GOOD})


def test_an_older_value_answered_late_does_not_free_the_point_for_the_read_back(clock: JumpingClock) -> None:
    """SCADA writes again while the first value is on its way: polls still leave the point alone."""
    it = MasterBench(clock, reads(9, 100, every=0.1), writes(9, 100))
    it.run_s(0.5)

    def write_again(unit: int, pdu: bytes) -> None:
        if pdu[0] == 16 and pdu[-1] < 10:
            it.scada(100, pdu[-1] + 1)

    it.field.during = write_again
    values: list[int] = []
    it.scada(100, 1)
    it.run_s(5.0, meanwhile=lambda: values.append(it.values(100)[0]))
    assert [values for _, _, values in written(it)] == [[value] for value in range(1, 11)]
    assert values == sorted(values)


@pytest.mark.parametrize("seed", range(4))
def test_each_of_1000_setpoints_written_while_its_point_is_polled_arrives_once_with_its_value(seed: int) -> None:
    clock = JumpingClock()
    it = MasterBench(
        clock, reads(9, 100, 10, every=0.05), reads(9, 300, 10, address=100, every=0.05), writes(9, 100, 10)
    )
    rng = random.Random(seed)
    expected: dict[int, list[int]] = {point: [] for point in range(10)}
    value = 0

    def scada_writes_now(unit: int, pdu: bytes) -> None:
        nonlocal value
        if pdu[0] == 3 and pdu[2] == 0 and value < 250:  # just these points are being polled
            value += 1
            point = rng.randrange(10)
            expected[point].append(value)
            it.scada(100 + point, value)

    it.field.answer_after_s = rng.uniform(0.001, 0.04)
    it.field.during = scada_writes_now
    while value < 250:
        it.run_s(rng.uniform(0.0, 0.3))
    it.field.during = lambda unit, pdu: None
    it.run_s(2.0)
    got: dict[int, list[int]] = {point: [] for point in range(10)}
    for write in it.field.writes:
        for i, each in enumerate(write.values):
            got[write.address + i].append(each)
    assert sum(len(values) for values in got.values()) == 250
    assert got == expected
    assert it.values(100, 10) == [values[-1] if values else 0 for values in expected.values()]
    assert it.qualities(100, 10) == {Quality.GOOD}


@pytest.mark.parametrize("seed", range(12))
def test_on_a_bad_line_each_last_setpoint_arrives_nothing_old_after_it_and_nothing_that_nobody_wrote(seed: int) -> None:
    """Replies get lost and damaged; a device whose reply was lost has carried out the write all the same."""
    clock = JumpingClock()
    it = MasterBench(
        clock,
        reads(9, 100, 6, every=0.2),
        writes(9, 100, 6, expire=0.0, whole=seed % 2 == 1),
        reads(8, 200, every=0.2),
        response_timeout=0.2,
    )
    rng = random.Random(seed)
    it.field.registers = {(9, i): 0 for i in range(6)}
    last: dict[int, int] = {}
    value = 0

    def anything(unit: int, pdu: bytes) -> None:
        nonlocal value
        it.field.damaging = {9} if rng.random() < 0.3 else set()
        if rng.random() < 0.3 and value < 300:
            point = rng.randrange(6)
            value += 1
            try:
                it.scada(100 + point, value)
            except QueueFull:
                return
            last[point] = value

    it.field.during = anything
    it.run_s(300.0)
    it.field.during = lambda unit, pdu: None
    it.field.damaging = set()
    it.run_s(120.0)
    for point, final in last.items():
        got = values_at(it.field.writes, point)
        assert got == sorted(got)
        assert got[-1] == it.field.registers[9, point] == final
        assert max(got) <= value


def values_at(writes_: list[FieldWrite], address: int) -> list[int]:
    """What was written to one address, in order."""
    return [w.values[address - w.address] for w in writes_ if 0 <= address - w.address < len(w.values)]


# ------------------------------------------------------------------------------------------------ cyclic


def test_nothing_is_written_after_a_start_that_nobody_wrote(clock: JumpingClock) -> None:
    it = MasterBench(
        clock,
        cyclic(1, 100, 4),  # never written
        cyclic(2, 200, 4),  # written in part
        reads(3, 300, 4),
        cyclic(3, 300, 4),  # only the device itself has said something
        writes(4, 400, 4),
    )
    it.field.registers = {(3, i): 30 + i for i in range(4)}
    it.scada(200, 1, 2)
    it.run_s(600.0)
    assert written(it) == []
    assert it.values(300, 4) == [30, 31, 32, 33]


def test_a_cyclic_write_sends_each_cycle_what_scada_wrote_once_all_was_written(clock: JumpingClock) -> None:
    it = MasterBench(clock, cyclic(2, 200, 2, every=2.0))
    it.scada(200, 1)
    it.run_s(10.0)
    it.scada(201, 2)
    it.run_s(10.0)
    assert written(it) == [(2, 0, [1, 2])] * 5
    it.scada(200, 9)
    it.run_s(4.0)
    assert written(it)[5:] == [(2, 0, [9, 2])] * 2


def test_a_cyclic_write_carries_scadas_value_even_if_polls_come_between(clock: JumpingClock) -> None:
    """The read-back is much faster than the write: ten polls come between SCADA's write and the next cycle."""
    it = MasterBench(clock, reads(3, 300, 2, every=0.1), cyclic(3, 300, 2, every=1.0))
    it.field.registers = {(3, 0): 7, (3, 1): 8}
    it.scada(300, 1, 2)
    it.run_s(3.5)
    assert set(map(str, written(it))) == {str((3, 0, [1, 2]))}
    it.field.writes.clear()
    it.scada(300, 100)
    it.run_s(3.0)
    assert written(it)[0] == (3, 0, [100, 2])
    assert it.values(300, 2) == [100, 2]


def test_a_value_written_while_the_cyclic_request_is_on_its_way_goes_with_the_next(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(3, 300, every=0.1), cyclic(3, 300, every=1.0))
    it.scada(300, 1)

    def write_again(unit: int, pdu: bytes) -> None:
        if pdu[0] == 16 and pdu[-1] == 1:
            it.scada(300, 2)

    it.field.during = write_again
    it.run_s(0.9)
    assert it.field.registers[3, 0] == 1
    assert it.values(300) == [2]  # though the device has been read nine times
    it.run_s(1.0)
    assert written(it) == [(3, 0, [1]), (3, 0, [2])]


def test_a_cyclic_write_bridges_what_one_device_says_to_another(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(1, 100, every=0.5), cyclic(2, 100, every=0.5))
    it.field.registers[1, 0] = 7
    it.run_s(1.2)
    it.field.registers[1, 0] = 8
    it.run_s(1.2)
    assert it.field.registers[2, 0] == 8
    assert {values[0] for _, _, values in written(it)} == {7, 8}


def test_a_cyclic_write_that_fails_is_bad_and_good_again_once_it_is_answered(clock: JumpingClock) -> None:
    it = MasterBench(clock, cyclic(2, 200, every=1.0))
    it.scada(200, 5)
    it.field.refusing = {(2, 16): 4}
    it.run_s(3.0)
    assert it.qualities(200) == {Quality.BAD}
    it.field.refusing = {}
    it.run_s(2.0)
    assert it.qualities(200) == {Quality.GOOD}


def test_a_cyclic_write_whose_points_were_delivered_is_good_again_after_a_failure(clock: JumpingClock) -> None:
    it = MasterBench(clock, cyclic(2, 200, every=1.0))
    it.scada(200, 5)
    it.run_s(3.0)
    it.field.silent = {2}
    it.run_s(5.0)
    assert it.qualities(200) == {Quality.BAD}
    it.field.silent = set()
    it.run_s(100.0)
    assert it.qualities(200) == {Quality.GOOD}


# ------------------------------------------------------------------------------------------------ offline and late


def offline_bench(clock: JumpingClock, **settings: Any) -> MasterBench:
    """Unit 9 is offline, and unit 1 is not."""
    it = MasterBench(clock, reads(9, 100), writes(9, 100, **settings), reads(1, 200))
    it.field.registers[9, 0] = 7
    it.field.silent = {9}
    it.run_s(30.0)
    assert it.master.devices[9].is_offline
    return it


def test_a_command_to_an_offline_device_expires_is_counted_and_logged_and_never_sent_late(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    it = offline_bench(clock)
    while not it.master._probes.due_s() - clock.monotonic() > 15.0:  # no probe for a while
        it.master.step()
    it.field.asked.clear()
    it.scada(100, 555)
    it.run_s(14.0)
    assert it.field.count(9) == 0
    assert it.qualities(100) == {Quality.BAD}
    assert (it.master.counters.expired, it.master.polls[2].counters.expired) == (1, 1)
    assert [record.getMessage() for record in caplog.records][-1] == (
        "field/u9-f16-0: point 100 not written: not delivered in time"
    )
    it.field.silent = set()
    it.run_s(200.0)
    assert not it.master.devices[9].is_offline
    assert written(it) == []
    assert (it.values(100), it.qualities(100)) == ([7], {Quality.GOOD})


def test_a_command_to_an_offline_device_is_the_next_probe_and_brings_it_back(clock: JumpingClock) -> None:
    it = offline_bench(clock, expire=0.0)
    it.scada(100, 555)
    it.run_s(1.0)
    it.field.silent = set()
    it.field.asked.clear()
    while it.master.devices[9].is_offline:
        it.master.step()
    assert [pdu[0] for _, unit, pdu in it.field.asked if unit == 9] == [16]
    it.run_s(3.0)
    assert written(it) == [(9, 0, [555])]
    assert (it.values(100), it.qualities(100)) == ([555], {Quality.GOOD})


def test_a_setpoint_delivered_to_a_device_that_was_offline_is_no_longer_bad(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(9, 100, 2, expire=0.0), reads(1, 200))
    it.field.silent = {9}
    it.scada(100, 1)
    it.scada(101, 2)
    it.run_s(60.0)
    assert it.qualities(100, 2) == {Quality.BAD}
    it.field.silent = set()
    it.run_s(120.0)
    assert it.field.registers == {(9, 0): 1, (9, 1): 2}
    assert it.qualities(100, 2) == {Quality.GOOD}


def test_commands_of_an_offline_device_keep_no_others_command_waiting(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(9, 100, expire=0.0), writes(1, 200))
    it.field.silent = {9}
    it.scada(100, 1)
    it.run_s(30.0)
    assert it.master.devices[9].is_offline
    it.scada(200, 5)
    it.run_s(6.0)
    assert written(it) == [(1, 0, [5])]


# ------------------------------------------------------------------------------------------------ broadcast


def test_a_broadcast_write_is_sent_once_and_delivered_after_the_turnaround(clock: JumpingClock) -> None:
    it = MasterBench(clock, writes(0, 100, status_point=500), reads(1, 200, every=0.01), turnaround=0.5)
    it.run_s(0.5)
    it.scada(100, 5)
    it.field.asked.clear()
    it.steps(2)
    (broadcast_s, unit, _), (next_s, _, _) = it.field.asked[:2]
    assert unit == 0
    assert next_s - broadcast_s >= 0.5
    it.run_s(2.0)
    assert written(it) == [(0, 0, [5])]
    assert it.qualities(100) == {Quality.GOOD}
    assert it.values(500, 1, table=Table.INPUT_REGISTERS) == [1]
    assert not it.master.devices[0].is_offline


def test_a_cyclic_broadcast_is_sent_each_cycle(clock: JumpingClock) -> None:
    it = MasterBench(clock, cyclic(0, 100, every=1.0))
    it.scada(100, 5)
    it.run_s(5.0)
    assert written(it) == [(0, 0, [5])] * 5
