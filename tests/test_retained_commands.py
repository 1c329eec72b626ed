"""What was a command before a restart: held for a cyclic request until it has been delivered, and never a new one."""

from __future__ import annotations

from gateway.commands import CommandQueue
from gateway.register import DataRegister, Kept, Quality
from tests.fakes import JumpingClock, words
from tests.points import holding, outlet, poll, qualities, scada, taken, values


def test_a_restored_setpoint_is_held_against_polls_until_a_cyclic_request_has_delivered_it(
    register: DataRegister, clock: JumpingClock
) -> None:
    register.restore([Kept(holding(0), words(66), 5.0, True), Kept(holding(1), words(67), 5.0, False)])
    queue, cyclic = CommandQueue(register, clock, lambda: None), outlet(0, 2, on_change=False)
    queue.add(cyclic)
    poll(register, 0, 50, 51)
    assert values(register, 0, 2) == [66, 51]
    assert queue.cyclic_values(cyclic) == (words(66, 51), 0)
    queue.delivered(cyclic, 0)
    assert qualities(register, 0) == [Quality.STALE]  # delivered, and not yet read back
    poll(register, 0, 66, 51)
    assert qualities(register, 0, 2) == [Quality.GOOD, Quality.GOOD]


def test_a_restored_setpoint_that_the_device_refuses_is_let_go(register: DataRegister, clock: JumpingClock) -> None:
    register.restore([Kept(holding(0), words(66), 5.0, True)])
    queue, cyclic = CommandQueue(register, clock, lambda: None), outlet(0, on_change=False)
    queue.add(cyclic)
    queue.refused(cyclic, 0)
    poll(register, 0, 50)
    assert values(register, 0) == [50]


def test_what_somebody_writes_over_a_restored_setpoint_takes_its_place(
    register: DataRegister, clock: JumpingClock
) -> None:
    register.restore([Kept(holding(0), words(66), 5.0, True)])
    queue, cyclic = CommandQueue(register, clock, lambda: None), outlet(0, on_change=False)
    queue.add(cyclic)
    _, number = queue.cyclic_values(cyclic) or (b"", -1)
    scada(register, 0, 70)
    queue.delivered(cyclic, number)  # of the older value
    poll(register, 0, 50)
    assert values(register, 0) == [70]
    assert taken(queue) == []


def test_a_restored_setpoint_whose_device_was_away_is_as_old_as_before(
    register: DataRegister, clock: JumpingClock
) -> None:
    register.restore([Kept(holding(0), words(66), 5.0, True)])
    scada(register, 1, 70)
    queue, change = CommandQueue(register, clock, lambda: None), outlet(0, 3)
    queue.add(change)
    register.mark_unfilled(holding(0, 3), Quality.BAD)
    queue.restore(change)
    assert qualities(register, 0, 3) == [Quality.STALE, Quality.GOOD, Quality.NEVER]
