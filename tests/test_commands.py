"""The way down: every last word of SCADA arrives at its device, in order, and nothing else does."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

import pytest

from gateway.commands import QUEUE_LIMIT, Command, CommandQueue, Outlet
from gateway.errors import QueueFull
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister, Quality, Source, SourceKind
from tests.fakes import JumpingClock, words

POLL = Source(SourceKind.REQUEST, "field/boiler")
SETPOINT = Source(SourceKind.REQUEST, "field/setpoint")
SCADA = Source(SourceKind.CLIENT, "scada 10.0.0.5:40232")
MENU = Source(SourceKind.MENU, "console")
RETAINED = Source(SourceKind.RETAINED, "before the restart")


def holding(start: int, count: int = 1) -> Span:
    return Span(Table.HOLDING_REGISTERS, start, count)


def outlet(start: int, count: int = 1, **settings: object) -> Outlet:
    return Outlet(holding(start, count), SETPOINT, **settings)  # type: ignore[arg-type]


@pytest.fixture
def queue(register: DataRegister, clock: JumpingClock) -> CommandQueue:
    return CommandQueue(register, clock, wake=lambda: None)


def scada(register: DataRegister, start: int, *values: int, source: Source = SCADA) -> None:
    register.write(holding(start, len(values)), words(*values), source)


def poll(register: DataRegister, start: int, *values: int) -> None:
    register.write(holding(start, len(values)), words(*values), POLL)


def values(register: DataRegister, start: int, count: int = 1) -> list[int]:
    return [sample.value for sample in register.samples(holding(start, count))]


def qualities(register: DataRegister, start: int, count: int = 1) -> list[Quality]:
    return [sample.quality for sample in register.samples(holding(start, count))]


def taken(queue: CommandQueue) -> list[tuple[int, bytes | None]]:
    """Take all there is and have the device answer it; return each one's first point and data."""
    found = []
    while (command := queue.take()) is not None:
        found.append((command.span.start, command.data))
        queue.answered(command)
    return found


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


# ------------------------------------------------------------------------------------------------ a full queue


def fill(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(0, 1000))
    for i in range(QUEUE_LIMIT):
        scada(register, 2 * i, i)


def test_a_write_that_does_not_fit_is_refused_whole_and_stores_nothing(
    register: DataRegister, queue: CommandQueue
) -> None:
    fill(register, queue)
    poll(register, 900, 5)
    told: list[object] = []
    register.watch(told.append)
    with pytest.raises(QueueFull):
        scada(register, 999, 7, 7)
    with pytest.raises(QueueFull):
        register.mask_write(holding(900), 0, 7, SCADA)
    assert values(register, 900) == [5]
    assert (values(register, 999, 2), qualities(register, 999, 2), told) == ([0, 0], [Quality.NEVER] * 2, [])
    poll(register, 999, 8)
    assert values(register, 999) == [8]  # and holds nothing
    scada(register, 1500, 1)  # a point of no outlet


def test_a_write_that_one_of_two_masters_cannot_take_is_refused_for_both(
    register: DataRegister, queue: CommandQueue, clock: JumpingClock
) -> None:
    other = CommandQueue(register, clock, wake=lambda: None)
    other.add(outlet(999))
    fill(register, queue)
    with pytest.raises(QueueFull):
        scada(register, 999, 7)
    assert (len(other), values(register, 999)) == (0, [0])


def test_a_write_needs_room_in_the_queue_for_each_outlet(register: DataRegister, clock: JumpingClock) -> None:
    queue = CommandQueue(register, clock, wake=lambda: None, limit=1)
    queue.add(outlet(10))
    queue.add(outlet(10))
    with pytest.raises(QueueFull):
        scada(register, 10, 1)
    assert len(queue) == 0


def test_cyclic_outlets_need_no_room(register: DataRegister, queue: CommandQueue) -> None:
    fill(register, queue)
    queue.add(outlet(1500, 1, on_change=False))
    scada(register, 1500, 1)
    assert values(register, 1500) == [1]


def test_commands_taken_over_do_not_fill_the_queue(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(0, 1000))
    for value in range(50 * QUEUE_LIMIT):
        scada(register, value % 3, value)
        assert len(queue) <= QUEUE_LIMIT
    assert sorted(taken(queue)) == [(0, words(4998)), (1, words(4999)), (2, words(4997))]


def test_once_a_command_is_taken_there_is_room_again(register: DataRegister, queue: CommandQueue) -> None:
    fill(register, queue)
    assert queue.take() is not None
    scada(register, 999, 7)


# ------------------------------------------------------------------------------------------------ cyclic


def test_a_cyclic_request_has_no_values_until_all_points_were_written(
    register: DataRegister, queue: CommandQueue
) -> None:
    cyclic = outlet(10, 2, on_change=False)
    queue.add(cyclic)
    assert queue.cyclic_values(cyclic) is None
    scada(register, 10, 1)
    assert queue.cyclic_values(cyclic) is None
    poll(register, 11, 2)
    sent = queue.cyclic_values(cyclic)
    assert sent is not None
    assert sent[0] == words(1, 2)
    assert queue.take() is None


def test_a_cyclic_request_does_not_send_a_device_what_only_the_device_said(
    register: DataRegister, queue: CommandQueue
) -> None:
    cyclic = outlet(10, 2, on_change=False, commanded_only=True)
    queue.add(cyclic)
    scada(register, 20, 1)
    poll(register, 10, 8, 9)
    assert queue.cyclic_values(cyclic) is None
    scada(register, 10, 1)  # one point; the other goes along as the device itself has it
    sent = queue.cyclic_values(cyclic)
    assert sent is not None
    assert sent[0] == words(1, 9)


def test_a_cyclic_request_waits_for_a_point_that_its_own_device_has_not_said_yet(
    register: DataRegister, queue: CommandQueue
) -> None:
    cyclic = outlet(10, 2, on_change=False, commanded_only=True)
    queue.add(cyclic)
    scada(register, 10, 1, source=MENU)
    assert queue.cyclic_values(cyclic) is None


def test_a_cyclic_request_holds_what_was_written_until_it_is_delivered(
    register: DataRegister, queue: CommandQueue
) -> None:
    cyclic = outlet(10, 2, on_change=False)
    queue.add(cyclic)
    scada(register, 10, 1, 2)
    sent = queue.cyclic_values(cyclic)
    assert sent is not None
    scada(register, 11, 3)  # while it is on its way
    queue.delivered(cyclic, sent[1])
    poll(register, 10, 9, 9)
    assert values(register, 10, 2) == [9, 3]
    sent = queue.cyclic_values(cyclic)
    assert sent is not None
    queue.delivered(cyclic, sent[1])
    poll(register, 10, 9, 9)
    assert values(register, 10, 2) == [9, 9]


# ------------------------------------------------------------------------------------------------ the end


def test_closed_the_queue_lets_go_of_everything(register: DataRegister, queue: CommandQueue) -> None:
    queue.add(outlet(10))
    queue.add(outlet(11, 1, on_change=False))
    scada(register, 10, 1, 2)
    queue.close()
    assert len(queue) == 0
    assert qualities(register, 10, 2) == [Quality.BAD, Quality.GOOD]  # the first was to be delivered, and never is
    poll(register, 10, 9, 9)
    assert values(register, 10, 2) == [9, 9]
    scada(register, 10, 3)
    assert (len(queue), queue.take()) == (0, None)


def test_a_queue_that_closes_leaves_alone_what_another_holds(register: DataRegister, clock: JumpingClock) -> None:
    queues = [CommandQueue(register, clock, wake=lambda: None) for _ in range(2)]
    for queue in queues:
        queue.add(outlet(10))
    scada(register, 10, 1)
    queues[0].close()
    poll(register, 10, 9)
    assert values(register, 10) == [1]
    assert taken(queues[1]) == [(10, words(1))]


# ------------------------------------------------------------------------------------------------ anything at all


class Story:
    """A random life of one register, two devices and their commands, with a record of who wrote and who got what."""

    POINTS = 12

    def __init__(self, seed: int, whole: bool) -> None:
        self.rng = random.Random(seed)
        self.clock = JumpingClock()
        self.register = DataRegister(self.clock)
        self.queue = CommandQueue(self.register, self.clock, wake=lambda: None)
        self.whole = whole
        self.outlets = [outlet(0, 8, expire_s=0.0, whole=whole), outlet(5, 7, expire_s=0.0, whole=whole)]
        for each in self.outlets:
            self.queue.add(each)
        self.written: dict[int, list[int]] = {point: [] for point in range(self.POINTS)}  # by SCADA, oldest first
        self.got: dict[tuple[int, int], list[int]] = {}  # outlet, point: what the device got, oldest first
        self.polled: set[int] = set()
        self.value = 0
        self.in_flight: Command | None = None
        if whole:
            poll(self.register, 0, *[60000] * self.POINTS)
            self.polled.add(60000)

    def run(self, steps: int) -> None:
        does: Sequence[Callable[[], None]] = (self.scada, self.poll, self.take, self.answer, self.lose)
        for _ in range(steps):
            self.rng.choices(does, weights=(4, 2, 4, 4, 2))[0]()
            self.clock.pass_s(0.1)
        self.answer()
        while len(self.queue):
            self.take()
            self.answer()

    def scada(self) -> None:
        start = self.rng.randrange(self.POINTS)
        count = self.rng.randint(1, self.POINTS - start)
        new = [self.value + i + 1 for i in range(count)]
        self.value += count
        try:
            scada(self.register, start, *new)
        except QueueFull:
            return
        for i, value in enumerate(new):
            self.written[start + i].append(value)

    def poll(self) -> None:
        value = 60000 + self.rng.randrange(1000)
        self.polled.add(value)
        poll(self.register, 0, *[value] * self.POINTS)

    def take(self) -> None:
        if self.in_flight is None:
            self.in_flight = self.queue.take()
            self.deliver()

    def deliver(self) -> None:
        """The device gets the command; whether its answer comes back is another matter."""
        if self.in_flight is not None:
            assert self.in_flight.data is not None
            data, which = self.in_flight.data, self.outlets.index(self.in_flight.outlet)
            for i, point in enumerate(range(self.in_flight.span.start, self.in_flight.span.stop)):
                self.got.setdefault((which, point), []).append(int.from_bytes(data[2 * i : 2 * i + 2], "big"))

    def answer(self) -> None:
        if self.in_flight is not None:
            self.queue.answered(self.in_flight)
            self.in_flight = None

    def lose(self) -> None:
        if self.in_flight is not None:
            self.queue.put_back(self.in_flight)
            self.in_flight = None


@pytest.mark.parametrize("whole", [False, True], ids=["what was written", "whole"])
@pytest.mark.parametrize("seed", range(60))
def test_whatever_happens_each_last_value_arrives_in_order_and_nothing_nobody_wrote(seed: int, whole: bool) -> None:
    story = Story(seed, whole)
    story.run(steps=250)
    for which, each in enumerate(story.outlets):
        for point in range(each.span.start, each.span.stop):
            written, got = story.written[point], story.got.get((which, point), [])
            from_scada = [value for value in got if value not in story.polled]
            assert set(from_scada) <= set(written)  # nothing that nobody wrote
            assert from_scada == sorted(from_scada)  # SCADA counts upwards: nothing old after something newer
            if written:
                assert from_scada[-1] == written[-1]  # the last word has arrived
            if written and not whole:
                assert got == from_scada  # and a device is not sent its own values


def test_no_point_is_held_when_all_is_delivered() -> None:
    story = Story(seed=7, whole=False)
    story.run(steps=300)
    poll(story.register, 0, *[65000] * story.POINTS)
    assert values(story.register, 0, story.POINTS) == [65000] * story.POINTS
    assert all(not each.pending for each in story.outlets)
