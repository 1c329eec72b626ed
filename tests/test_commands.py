"""The way down: every last word of SCADA arrives at its device, in order, and nothing else does."""

from __future__ import annotations

import pytest

from gateway.commands import CommandQueue, Outlet
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister, Quality, Source
from tests.fakes import SCADA, JumpingClock, words
from tests.points import MENU, POLL, RETAINED, SETPOINT, holding, outlet, poll, qualities, scada, taken, values


@pytest.fixture
def queue(register: DataRegister, clock: JumpingClock) -> CommandQueue:
    return CommandQueue(register, clock, wake=lambda: None)


# ------------------------------------------------------------------------------------------------ what makes a command


@pytest.mark.parametrize("source", [SCADA, MENU], ids=lambda source: str(source.kind.value))
def test_a_write_by_the_upper_side_or_the_menu_makes_a_command(
    register: DataRegister, queue: CommandQueue, source: Source
) -> None:
    queue.add(outlet(10, 5))
    scada(register, 11, 7, 8, source=source)
    assert taken(queue) == [(11, words(7, 8))]
    assert queue.take() is None


@pytest.mark.parametrize("source", [POLL, RETAINED], ids=lambda source: str(source.kind.value))
def test_a_poll_or_a_retained_value_makes_none(register: DataRegister, queue: CommandQueue, source: Source) -> None:
    queue.add(outlet(10))
    register.write(holding(10), words(7), source)
    assert (len(queue), queue.take()) == (0, None)


def test_only_points_of_an_outlet_make_commands(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10, 2))
    queue.add(outlet(14, 2))
    scada(register, 9, *range(9, 17))
    scada(register, 30, 1)
    register.write(Span(Table.INPUT_REGISTERS, 10, 1), words(1), MENU)
    assert taken(queue) == [(10, words(10, 11)), (14, words(14, 15))]


def test_a_mask_write_makes_a_command_with_the_new_value(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10))
    poll(register, 10, 0x12)
    register.mask_write(holding(10), 0xF2, 0x25, SCADA)
    assert taken(queue) == [(10, words(0x17))]


def test_a_coil_command_carries_packed_bits(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(Outlet(Span(Table.COILS, 10, 12), SETPOINT))
    register.write(Span(Table.COILS, 8, 11), b"\xf5\x05", SCADA)
    command = queue.take()
    assert command is not None
    assert (command.span, command.data) == (Span(Table.COILS, 10, 9), bytes([0xF5 >> 2 | 0x05 << 6 & 0xFF, 0x01]))


def test_the_sender_is_woken_by_a_command_and_by_nothing_else(register: DataRegister, clock: JumpingClock) -> None:
    woken: list[bool] = []
    queue = CommandQueue(register, clock, wake=lambda: woken.append(register.lock.locked()))
    queue.add(outlet(10))
    poll(register, 10, 1)
    scada(register, 11, 1)
    assert woken == []
    scada(register, 10, 1)
    assert woken == [False]  # outside the lock


# ------------------------------------------------------------------------------------------------ the newest


def test_the_value_is_the_one_written_whatever_comes_to_the_point_later(
    register: DataRegister, queue: CommandQueue
) -> None:
    queue.add(outlet(10))
    scada(register, 10, 555)
    poll(register, 10, 1)
    assert taken(queue) == [(10, words(555))]


def test_only_the_newest_value_of_a_point_is_sent(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10))
    for value in range(50):
        scada(register, 10, value)
    assert taken(queue) == [(10, words(49))]


def test_an_older_command_goes_without_the_points_written_again_in_contiguous_runs(
    register: DataRegister, queue: CommandQueue
) -> None:
    queue.add(outlet(10, 6))
    scada(register, 10, 1, 2, 3, 4, 5, 6)
    scada(register, 12, 30)
    scada(register, 15, 60)
    assert taken(queue) == [(10, words(1, 2)), (13, words(4, 5)), (12, words(30)), (15, words(60))]


def test_commands_go_in_the_order_of_writing(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10, 9))
    for point in (13, 18, 11):
        scada(register, point, point)
    assert [start for start, _ in taken(queue)] == [13, 18, 11]


def test_a_command_put_back_goes_first_unless_a_later_write_replaces_it(
    register: DataRegister, queue: CommandQueue
) -> None:
    queue.add(outlet(10, 2))
    scada(register, 10, 1)
    scada(register, 11, 2)
    first = queue.take()
    assert first is not None
    queue.put_back(first)
    assert queue.take() == first
    scada(register, 10, 3)
    queue.put_back(first)
    assert taken(queue) == [(11, words(2)), (10, words(3))]


def test_commands_of_devices_not_to_be_bothered_keep_their_place(register: DataRegister, queue: CommandQueue) -> None:
    one, other = outlet(10), outlet(20)
    queue.add(one)
    queue.add(other)
    scada(register, 10, 1)
    scada(register, 20, 2)
    command = queue.take(skip={one})
    assert command is not None
    assert command.outlet is other
    assert queue.take(skip={one}) is None
    assert taken(queue) == [(10, words(1))]


# ------------------------------------------------------------------------------------------------ whole


def test_a_whole_request_carries_all_its_points_as_they_were_at_the_write(
    register: DataRegister, queue: CommandQueue
) -> None:
    queue.add(outlet(10, 3, whole=True))
    poll(register, 10, 1, 2, 3)
    scada(register, 11, 20)
    poll(register, 10, 7, 7, 7)
    assert taken(queue) == [(10, words(1, 20, 3))]


def test_a_whole_request_waits_until_all_its_points_are_known(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10, 3, whole=True))
    queue.add(outlet(20))
    scada(register, 10, 1)
    assert queue.take() is None
    scada(register, 20, 5)
    assert taken(queue) == [(20, words(5))]  # it keeps nobody waiting
    poll(register, 11, 2)
    assert queue.take() is None
    poll(register, 10, 9, 9, 3)
    assert taken(queue) == [(10, words(1, 9, 3))]


def test_a_whole_request_completed_by_several_writes_is_sent_once(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10, 3, whole=True))
    for point in (10, 11, 12):
        scada(register, point, point)
    assert taken(queue) == [(10, words(10, 11, 12))]
    scada(register, 10, 1)
    scada(register, 12, 3)
    assert taken(queue) == [(10, words(1, 11, 3))]


def test_a_whole_command_in_flight_holds_what_a_later_one_has_taken_over(
    register: DataRegister, queue: CommandQueue
) -> None:
    queue.add(outlet(10, 2, whole=True))
    poll(register, 10, 0, 0)
    scada(register, 10, 1)
    in_flight = queue.take()
    assert in_flight is not None
    scada(register, 11, 2)
    queue.answered(in_flight)
    poll(register, 10, 0, 0)
    assert values(register, 10, 2) == [1, 2]
    assert taken(queue) == [(10, words(1, 2))]


# ------------------------------------------------------------------------------------------------ held points


def test_polls_leave_out_a_point_until_the_device_has_answered(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(11))
    poll(register, 10, 1, 1, 1)
    scada(register, 11, 555)
    poll(register, 10, 2, 2, 2)
    assert values(register, 10, 3) == [2, 555, 2]
    command = queue.take()
    assert command is not None
    poll(register, 10, 3, 3, 3)
    assert values(register, 10, 3) == [3, 555, 3]
    queue.answered(command)
    poll(register, 10, 4, 4, 4)
    assert values(register, 10, 3) == [4, 4, 4]


def test_a_point_written_again_in_flight_stays_held_for_the_newer_value(
    register: DataRegister, queue: CommandQueue
) -> None:
    queue.add(outlet(10, 2))
    scada(register, 10, 1, 1)
    first = queue.take()
    assert first is not None
    scada(register, 10, 2)
    queue.answered(first)
    poll(register, 10, 9, 9)
    assert values(register, 10, 2) == [2, 9]
    assert taken(queue) == [(10, words(2))]


def test_the_upper_side_and_the_menu_write_held_points_at_once(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10))
    scada(register, 10, 1)
    scada(register, 10, 2, source=MENU)
    assert values(register, 10) == [2]


def test_a_point_that_two_masters_deliver_is_held_until_both_have(register: DataRegister, clock: JumpingClock) -> None:
    queues = [CommandQueue(register, clock, wake=lambda: None) for _ in range(2)]
    queues[0].add(outlet(10, 2))
    queues[1].add(outlet(11, 2))
    scada(register, 10, 1, 1, 1)
    assert taken(queues[0]) == [(10, words(1, 1))]
    poll(register, 10, 9, 9, 9)
    assert values(register, 10, 3) == [9, 1, 1]
    assert taken(queues[1]) == [(11, words(1, 1))]
    poll(register, 10, 9, 9, 9)
    assert values(register, 10, 3) == [9, 9, 9]


def test_two_outlets_of_one_master_over_one_point_are_both_sent(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10, 2))
    queue.add(outlet(11, 2))
    scada(register, 11, 5)
    assert taken(queue) == [(11, words(5)), (11, words(5))]
    poll(register, 11, 9)
    assert values(register, 11) == [9]


def test_a_delivered_point_that_had_become_bad_meanwhile_is_good(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10, 2))
    scada(register, 10, 1)
    register.write(holding(11), words(2), MENU, Quality.MANUAL)
    register.mark(holding(10), Quality.BAD, SETPOINT)  # its device went offline
    taken(queue)
    assert qualities(register, 10, 2) == [Quality.GOOD, Quality.MANUAL]


# ------------------------------------------------------------------------------------------------ giving up


def test_a_dropped_command_leaves_bad_points_that_polls_may_fill(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10, 2))
    scada(register, 10, 1, 2)
    command = queue.take()
    assert command is not None
    scada(register, 11, 3)
    queue.drop(command)
    assert qualities(register, 10, 2) == [Quality.BAD, Quality.GOOD]
    poll(register, 10, 8, 8)
    assert values(register, 10, 2) == [8, 3]


@pytest.mark.parametrize(("after_s", "is_dropped"), [(9.75, False), (10.0, True), (3600.0, True)])
def test_a_command_is_dropped_once_it_has_waited_its_time(
    register: DataRegister, queue: CommandQueue, clock: JumpingClock, after_s: float, is_dropped: bool
) -> None:
    queue.add(outlet(10, 1, expire_s=10.0))
    scada(register, 10, 1)
    assert queue.next_expiry_s() == clock.monotonic() + 10.0
    clock.pass_s(after_s)
    assert len(queue.expire()) == is_dropped
    assert qualities(register, 10) == [Quality.BAD if is_dropped else Quality.GOOD]
    assert taken(queue) == ([] if is_dropped else [(10, words(1))])
    assert queue.next_expiry_s() is None
    poll(register, 10, 7)
    assert values(register, 10) == [7]


def test_expire_0_keeps_a_command_for_ever(register: DataRegister, queue: CommandQueue, clock: JumpingClock) -> None:
    queue.add(outlet(10, 1, expire_s=0.0))
    scada(register, 10, 1)
    clock.pass_s(1e9)
    assert (queue.expire(), queue.next_expiry_s()) == ([], None)
    assert taken(queue) == [(10, words(1))]


def test_a_command_put_back_does_not_become_young_again(
    register: DataRegister, queue: CommandQueue, clock: JumpingClock
) -> None:
    queue.add(outlet(10))
    scada(register, 10, 1)
    clock.pass_s(9.0)
    command = queue.take()
    assert command is not None
    queue.put_back(command)
    clock.pass_s(1.0)
    assert queue.expire() == [command]


def test_a_command_taken_over_expires_without_a_word(
    register: DataRegister, queue: CommandQueue, clock: JumpingClock
) -> None:
    queue.add(outlet(10))
    scada(register, 10, 1)
    clock.pass_s(9.0)
    scada(register, 10, 2)
    clock.pass_s(1.0)
    assert queue.expire() == []
    assert qualities(register, 10) == [Quality.GOOD]
    assert taken(queue) == [(10, words(2))]


def test_without_commands_nothing_expires(queue: CommandQueue) -> None:
    assert (queue.expire(), queue.next_expiry_s()) == ([], None)
