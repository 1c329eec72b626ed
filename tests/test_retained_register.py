"""Retained values: what is kept of a register, and what a register makes of it after a restart."""

from __future__ import annotations

import pytest

from gateway.commands import CommandQueue
from gateway.errors import PointUnknown
from gateway.events import EventQueue
from gateway.modbus.pdu import Span, Table
from gateway.register import RESTORED, DataRegister, Kept, Quality, Sample, Written
from gateway.retained import kept, without_ages
from tests.fakes import SCADA, JumpingClock, words
from tests.points import MENU, POLL, SETPOINT, coils, holding, outlet, poll, qualities, scada, taken, values

HOLDING = Table.HOLDING_REGISTERS


def restored(register: DataRegister, *blocks: Kept) -> DataRegister:
    register.restore(blocks)
    return register


def samples(register: DataRegister, start: int, count: int = 1) -> list[Sample]:
    return register.samples(holding(start, count))


# ------------------------------------------------------------------------------------------------ out of a register


def test_what_is_kept_is_what_somebody_wrote(register: DataRegister, clock: JumpingClock) -> None:
    poll(register, 10, 1, 2, 3)
    clock.pass_s(4.0)
    scada(register, 12, 9)
    register.write(holding(20), words(0), MENU, Quality.MANUAL)
    register.mark(holding(30, 5), Quality.BAD, POLL)  # a failed poll makes nothing known
    clock.pass_s(1.0)
    assert kept(register, HOLDING, (), clock.monotonic()) == [
        Kept(holding(10, 2), words(1, 2), 5.0, False),
        Kept(holding(12), words(9), 1.0, True),
        Kept(holding(20), words(0), 1.0, True),
    ]
    assert kept(register, Table.COILS, (), clock.monotonic()) == []


def test_bits_are_kept_one_by_one(register: DataRegister, clock: JumpingClock) -> None:
    register.write(coils(1990, 10), b"\x4d\x03", SCADA)
    assert kept(register, Table.COILS, (), clock.monotonic()) == [Kept(coils(1990, 10), b"1011001011", 0.0, True)]


def test_points_left_out_are_not_kept(register: DataRegister, clock: JumpingClock) -> None:
    scada(register, 0, 1, 2, 3, 4)
    blocks = kept(register, HOLDING, frozenset({1, 2, 70000}), clock.monotonic())
    assert [block.span for block in blocks] == [holding(0), holding(3)]
    assert values(register, 0, 4) == [1, 2, 3, 4]
    assert qualities(register, 0, 4) == [Quality.GOOD] * 4  # the register itself has not changed


def test_a_zero_that_stands_for_a_failed_poll_is_not_kept(register: DataRegister, clock: JumpingClock) -> None:
    scada(register, 0, 7, 8)
    register.write(holding(1), words(0), POLL, Quality.BAD)
    assert [block.span for block in kept(register, HOLDING, (), clock.monotonic())] == [holding(0)]


def test_values_are_alike_however_their_ages_cut_them(register: DataRegister, clock: JumpingClock) -> None:
    scada(register, 0, 1, 2, 3)
    poll(register, 5, 6)
    before = kept(register, HOLDING, (), clock.monotonic())
    clock.pass_s(1.0)
    scada(register, 1, 2)
    poll(register, 5, 6)
    after = kept(register, HOLDING, (), clock.monotonic())
    assert len(after) == len(before) + 2
    assert without_ages(after) == without_ages(before)


@pytest.mark.parametrize(
    "others",
    [
        [Kept(holding(0, 2), words(1, 3), 0.0, True)],
        [Kept(holding(0, 2), words(1, 2), 0.0, False)],
        [Kept(holding(0, 1), words(1), 0.0, True), Kept(holding(1, 1), words(2), 0.0, False)],
        [Kept(holding(1, 2), words(1, 2), 0.0, True)],
        [Kept(holding(0, 1), words(1), 0.0, True), Kept(holding(2, 1), words(2), 0.0, True)],
        [Kept(Span(Table.INPUT_REGISTERS, 0, 2), words(1, 2), 0.0, True)],
        [Kept(holding(0, 1), words(1), 0.0, True), Kept(Span(Table.INPUT_REGISTERS, 1, 1), words(2), 0.0, True)],
        [],
    ],
    ids=["value", "command", "half a command", "point", "a gap", "table", "half in another table", "nothing"],
)
def test_other_values_are_not_alike(others: list[Kept]) -> None:
    assert without_ages(others) != without_ages([Kept(holding(0, 2), words(1, 2), 0.0, True)])


# ------------------------------------------------------------------------------------------------ into a register


def test_a_restored_point_is_stale_with_its_age_until_somebody_writes_it(
    register: DataRegister, clock: JumpingClock
) -> None:
    restored(register, Kept(holding(5, 2), words(7, 8), 3600.0, True))
    clock.pass_s(1.0)
    assert samples(register, 5, 3) == [
        Sample(7, Quality.STALE, 3601.0, RESTORED),
        Sample(8, Quality.STALE, 3601.0, RESTORED),
        Sample(0, Quality.NEVER, None, None),
    ]
    poll(register, 5, 7)
    assert samples(register, 5, 2) == [Sample(7, Quality.GOOD, 0.0, POLL), Sample(8, Quality.STALE, 3601.0, RESTORED)]


def test_an_age_beyond_the_start_of_the_machine_is_an_age_like_any_other() -> None:
    clock = JumpingClock(monotonic_s=1.0)
    for age_s in (1.0, 2.0, 3.0, 1e9):  # last written before the machine was switched on
        register = restored(DataRegister(clock), Kept(holding(5), words(7), age_s, True))
        assert samples(register, 5) == [Sample(7, Quality.STALE, age_s, RESTORED)]
        assert register.known(holding(5), commanded=True) == words(7)


def test_an_age_that_nobody_knows_stays_unknown_and_the_value_is_old(
    register: DataRegister, clock: JumpingClock
) -> None:
    register.claim(holding(5), POLL, stale_after_s=1e9)
    restored(register, Kept(holding(5), words(7), None, True))
    clock.pass_s(100.0)
    assert samples(register, 5) == [Sample(7, Quality.STALE, None, RESTORED)]
    assert register.known(holding(5)) == words(7)
    assert register.read_fresh(holding(5)) is None
    assert kept(register, HOLDING, (), clock.monotonic()) == [Kept(holding(5), words(7), None, True)]


def test_every_table_comes_back(clock: JumpingClock) -> None:
    register, again = DataRegister(clock), DataRegister(clock)
    blocks = {
        Span(Table.COILS, 3, 11): b"\x55\x05",
        Span(Table.DISCRETE_INPUTS, 1999, 1): b"\x01",
        Span(HOLDING, 0, 3): words(1, 0, 65535),
        Span(Table.INPUT_REGISTERS, 7, 2): words(4, 5),
    }
    for span, data in blocks.items():
        register.write(span, data, SCADA)
    for table in Table:
        again.restore(kept(register, table, (), clock.monotonic()))
    assert {span: again.known(span, commanded=True) for span in blocks} == blocks
    assert [kept(again, t, (), clock.monotonic()) for t in Table] == [
        kept(register, t, (), clock.monotonic()) for t in Table
    ]


def test_of_a_smaller_table_the_points_that_remain_are_kept(clock: JumpingClock) -> None:
    register = DataRegister(clock, {HOLDING: 4, Table.COILS: 2})
    restored(
        register,
        Kept(holding(0, 2), words(1, 2), 1.0, True),
        Kept(holding(2, 4), words(3, 4, 5, 6), 1.0, True),
        Kept(holding(9, 2), words(8, 9), 1.0, True),
        Kept(coils(1, 3), b"110", 1.0, True),
    )
    assert values(register, 0, 4) == [1, 2, 3, 4]
    assert register.read(coils(0, 2)) == b"\x02"


def test_of_a_larger_table_the_new_points_were_never_written(clock: JumpingClock) -> None:
    register = restored(DataRegister(clock, {HOLDING: 65536}), Kept(holding(1998, 2), words(1, 2), 1.0, True))
    assert qualities(register, 1998, 4) == [Quality.STALE, Quality.STALE, Quality.NEVER, Quality.NEVER]


def test_what_was_written_since_the_start_is_newer_than_what_is_retained(register: DataRegister) -> None:
    scada(register, 6, 66)
    restored(register, Kept(holding(5, 3), words(1, 2, 3), 1.0, True))
    assert values(register, 5, 3) == [1, 66, 3]
    assert qualities(register, 5, 3) == [Quality.STALE, Quality.GOOD, Quality.STALE]


def test_a_restored_point_that_a_request_fills_is_not_passed_off_as_fresh(register: DataRegister) -> None:
    register.claim(holding(0, 2), POLL, stale_after_s=1e9)
    restored(register, Kept(holding(0, 4), words(1, 2, 3, 4), 0.0, True))
    assert register.read_fresh(holding(0, 2)) is None
    assert register.read_fresh(holding(1, 3)) is None
    assert register.read_fresh(holding(2, 2)) == words(3, 4)  # no request fills these: always served
    poll(register, 0, 5)
    assert register.read_fresh(holding(0)) == words(5)
    assert register.read_fresh(holding(0, 2)) is None
    poll(register, 1, 6)
    assert register.read_fresh(holding(0, 4)) == words(5, 6, 3, 4)


def test_a_restored_value_counts_as_written_and_as_a_command_only_if_it_was_one(register: DataRegister) -> None:
    restored(register, Kept(holding(0), words(1), 1.0, True), Kept(holding(1), words(2), 1.0, False))
    assert register.known(holding(0, 2)) == words(1, 2)
    assert register.known(holding(0), commanded=True) == words(1)
    assert register.known(holding(1), commanded=True) is None  # only ever read from a device: none of ours to send


def test_a_restored_value_makes_no_command(register: DataRegister, clock: JumpingClock) -> None:
    woken: list[int] = []
    queue = CommandQueue(register, clock, lambda: woken.append(1))
    queue.add(outlet(0, 2))
    restored(register, Kept(holding(0, 2), words(1, 2), 1.0, True))
    assert (len(queue), woken, taken(queue)) == (0, [], [])


def test_a_whole_command_takes_its_other_values_from_what_was_restored(
    register: DataRegister, clock: JumpingClock
) -> None:
    queue = CommandQueue(register, clock, lambda: None)
    queue.add(outlet(0, 3, whole=True))
    restored(register, Kept(holding(0, 3), words(1, 2, 3), 1.0, True))
    scada(register, 1, 22)
    assert taken(queue) == [(0, words(1, 22, 3))]


def test_a_cyclic_request_sends_what_was_restored(register: DataRegister, clock: JumpingClock) -> None:
    queue = CommandQueue(register, clock, lambda: None)
    cyclic = outlet(0, 2, on_change=False, commanded_only=True)
    queue.add(cyclic)
    restored(register, Kept(holding(0), words(1), 1.0, True))
    assert queue.cyclic_values(cyclic) is None  # nobody knows the second
    restored(register, Kept(holding(1), words(2), 1.0, True))
    assert queue.cyclic_values(cyclic) == (words(1, 2), 0)


def test_a_mask_write_changes_a_restored_value(register: DataRegister, clock: JumpingClock) -> None:
    queue = CommandQueue(register, clock, lambda: None)
    queue.add(outlet(0, 2))
    restored(register, Kept(holding(0), words(0x0012), 1.0, False))
    register.mask_write(holding(0), 0x00F2, 0x0025, SCADA)
    assert taken(queue) == [(0, words(0x0017))]
    with pytest.raises(PointUnknown):
        register.mask_write(holding(1), 0x00F2, 0x0025, SCADA)


def test_watchers_are_told_of_what_came_back(register: DataRegister) -> None:
    told: list[Written] = []
    register.watch(told.append)
    scada(register, 1, 9)
    told.clear()
    restored(register, Kept(holding(0, 3), words(1, 2, 3), 1.0, True), Kept(coils(8, 3), b"110", 1.0, True))
    assert told == [
        Written(holding(0), words(1), RESTORED, Quality.STALE),
        Written(holding(2), words(3), RESTORED, Quality.STALE),
        Written(coils(8, 3), b"\x03", RESTORED, Quality.STALE),
    ]


def test_what_differs_from_before_the_restart_is_a_change(register: DataRegister, clock: JumpingClock) -> None:
    events = EventQueue(register, clock, [holding(0, 2)], 10)
    restored(register, Kept(holding(0, 2), words(1, 2), 1.0, False))
    assert events.waiting == 0
    poll(register, 0, 1, 5)
    assert events.waiting == 1


def test_the_event_block_is_not_what_it_was_before_the_restart(register: DataRegister, clock: JumpingClock) -> None:
    block = holding(100, 10)
    events = EventQueue(register, clock, [holding(0)], 10, block=block)
    restored(register, Kept(holding(99, 12), words(*range(1, 13)), 1.0, True))
    assert values(register, 99, 12) == [1] + [0] * 10 + [12]
    assert events.waiting == 0


def test_a_failed_poll_makes_a_restored_point_bad_and_keeps_its_value(register: DataRegister) -> None:
    restored(register, Kept(holding(0), words(7), 5.0, False))
    register.mark(holding(0), Quality.BAD, SETPOINT)
    assert samples(register, 0) == [Sample(7, Quality.BAD, 5.0, RESTORED)]
