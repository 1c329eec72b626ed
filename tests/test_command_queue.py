"""A command queue as a whole: full, closing, cyclic requests beside it, and a random life with all of it."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

import pytest

from gateway.commands import QUEUE_LIMIT, Command, CommandQueue
from gateway.errors import QueueFull
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister, Quality
from tests.fakes import SCADA, JumpingClock, words
from tests.points import MENU, POLL, SETPOINT, holding, outlet, poll, qualities, scada, taken, values


@pytest.fixture
def queue(register: DataRegister, clock: JumpingClock) -> CommandQueue:
    return CommandQueue(register, clock, wake=lambda: None)


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


def test_a_full_queue_takes_a_new_value_for_points_that_wait_already(
    register: DataRegister, queue: CommandQueue
) -> None:
    fill(register, queue)
    for value in range(300):
        scada(register, 2 * (value % QUEUE_LIMIT), 1000 + value)
    with pytest.raises(QueueFull):
        scada(register, 1, 7)
    scada(register, 0, 7, 7)  # its one command replaces the one that waits
    assert len(queue) <= QUEUE_LIMIT + 1  # what is replaced goes with the next write
    register.write(Span(Table.COILS, 0, 100), bytes(13), SCADA)
    assert sorted(taken(queue))[:2] == [(0, words(7, 7)), (2, words(1201))]


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


def test_a_cyclic_request_that_is_refused_lets_go_of_what_it_carried(
    register: DataRegister, queue: CommandQueue
) -> None:
    cyclic = outlet(10, 2, on_change=False)
    queue.add(cyclic)
    scada(register, 10, 1, 2)
    sent = queue.cyclic_values(cyclic)
    assert sent is not None
    scada(register, 11, 3)  # while it is on its way
    queue.refused(cyclic, sent[1])
    assert qualities(register, 10, 2) == [Quality.BAD, Quality.GOOD]
    poll(register, 10, 9, 9)
    assert values(register, 10, 2) == [9, 3]


# ------------------------------------------------------------------------------------------------ offline and back


def test_what_a_device_took_is_good_again_and_what_was_given_up_is_not(
    register: DataRegister, queue: CommandQueue
) -> None:
    each = outlet(10, 4)
    queue.add(each)
    register.claim(holding(13), SETPOINT, stale_after_s=9.0)
    scada(register, 10, 1, 2, 3, 4)
    taken(queue)
    scada(register, 11, 5)
    given_up = queue.take()
    assert given_up is not None
    queue.drop(given_up)
    scada(register, 12, 6)
    register.mark(holding(10, 4), Quality.BAD, SETPOINT)  # offline
    queue.restore(each)
    assert qualities(register, 10, 4) == [
        Quality.GOOD,  # delivered
        Quality.BAD,  # given up
        Quality.BAD,  # still to be delivered
        Quality.BAD,  # a request reads it: its affair
    ]
    taken(queue)
    assert qualities(register, 12) == [Quality.GOOD]


def test_a_point_that_nobody_wrote_is_never_again_when_its_device_is_back(
    register: DataRegister, queue: CommandQueue
) -> None:
    each = outlet(10, 2)
    queue.add(each)
    register.mark(holding(10, 2), Quality.BAD, SETPOINT)
    queue.restore(each)
    assert qualities(register, 10, 2) == [Quality.NEVER, Quality.NEVER]


def test_a_delivered_command_says_nothing_of_points_that_a_request_fills(
    register: DataRegister, queue: CommandQueue
) -> None:
    queue.add(outlet(10, 2))
    register.claim(holding(11), POLL, stale_after_s=9.0)
    scada(register, 10, 1, 2)
    register.mark(holding(10, 2), Quality.BAD, POLL)
    taken(queue)
    assert qualities(register, 10, 2) == [Quality.GOOD, Quality.BAD]


def test_the_outlets_that_wait_are_those_with_commands(register: DataRegister, queue: CommandQueue) -> None:
    one, other = outlet(10), outlet(20)
    queue.add(one)
    queue.add(other)
    assert queue.waiting() == set()
    scada(register, 20, 1)
    assert queue.waiting() == {other}


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
