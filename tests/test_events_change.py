"""The event queue is given other settings while it works: nothing that waits is lost, nothing is told twice."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator
from itertools import cycle, islice
from typing import Any, Final

import pytest

from gateway.errors import PointsOutOfRange
from gateway.events import EventQueue
from gateway.modbus.pdu import Span
from gateway.register import DataRegister
from tests.event_bench import (
    BLOCK,
    COILS,
    FIFO,
    HOLDING,
    INPUTS,
    MARKED,
    MENU,
    NO_ENTRY,
    a_queue,
    block_of,
    changes_to,
    entry,
    poll,
    taken,
)
from tests.fakes import SCADA, JumpingClock
from tests.lines import PATIENCE_S
from tests.locks import LateLock

ELSEWHERE: Final = Span(HOLDING, 200, 3 + 7 * 3)  # three entries


@pytest.fixture
def queue(register: DataRegister, clock: JumpingClock) -> EventQueue:
    """A queue with a block of two entries."""
    return a_queue(register, clock, block=BLOCK)


def change(
    queue: EventQueue,
    spans: list[Span] = MARKED,
    size: int = 10_000,
    fifo: int | None = FIFO,
    block: Span | None = BLOCK,
) -> None:
    queue.change(spans, size, fifo, block)


def test_what_waits_stays_and_the_numbers_go_on(register: DataRegister, queue: EventQueue) -> None:
    changes_to(register, 1, 2)
    change(queue, size=5)
    poll(register, 10, 3)
    assert taken(queue) == [entry(1, 1), entry(2, 2), entry(3, 3)]


def test_a_point_that_stays_marked_keeps_its_known_value(register: DataRegister, queue: EventQueue) -> None:
    changes_to(register, 1)
    change(queue, [Span(HOLDING, 10, 1), Span(COILS, 0, 2000)])
    poll(register, 10, 1)
    poll(register, 10, 2)
    assert taken(queue) == [entry(1, 1), entry(2, 2)]


def test_a_point_marked_anew_has_no_known_value(register: DataRegister, queue: EventQueue) -> None:
    poll(register, 30, 1)
    change(queue, [*MARKED, Span(HOLDING, 30, 1)])
    poll(register, 30, 2)
    assert taken(queue) == []
    poll(register, 30, 3)
    assert taken(queue) == [entry(1, 3, 30)]


def test_a_point_not_marked_any_more_is_forgotten(register: DataRegister, queue: EventQueue) -> None:
    changes_to(register, 1)
    change(queue, [Span(INPUTS, 10, 10), Span(HOLDING, 9, 1), Span(HOLDING, 11, 9)])
    poll(register, 10, 2)
    assert taken(queue) == [entry(1, 1)]
    change(queue)
    poll(register, 10, 3)  # the first that is known of it
    poll(register, 10, 4)
    assert taken(queue) == [entry(2, 4)]


def test_a_queue_that_becomes_smaller_keeps_what_waits_and_takes_more_once_there_is_room(
    register: DataRegister, queue: EventQueue
) -> None:
    changes_to(register, 1, 2, 3)
    change(queue, size=2)
    assert (queue.waiting, queue.lost) == (3, 0)
    poll(register, 10, 4)
    assert (queue.waiting, queue.lost) == (3, 1)
    assert taken(queue) == [entry(1, 1), entry(2, 2), entry(3, 3)]
    poll(register, 10, 5)
    assert taken(queue) == [entry(5, 5)]


def test_a_queue_that_becomes_larger_takes_more_at_once(register: DataRegister, clock: JumpingClock) -> None:
    queue = a_queue(register, clock, size=1)
    changes_to(register, 1)
    queue.change(MARKED, 2, FIFO, None)
    poll(register, 10, 2)
    assert (taken(queue), queue.lost) == ([entry(1, 1), entry(2, 2)], 0)


def test_function_24_finds_the_queue_at_its_new_address_alone(register: DataRegister, queue: EventQueue) -> None:
    changes_to(register, 1)
    change(queue, fifo=7)
    assert queue.read_fifo(FIFO) is None
    assert queue.read_fifo(7) == [1, 0, *entry(1, 1)]
    change(queue, fifo=None)
    assert {queue.read_fifo(address) for address in (FIFO, 7)} == {None}


def test_the_block_moves_and_shows_all_that_waits_there(register: DataRegister, queue: EventQueue) -> None:
    changes_to(register, 1, 2, 3)
    poll(register, BLOCK.start, 1, source=SCADA)
    change(queue, block=ELSEWHERE)
    assert block_of(register, ELSEWHERE) == [1, 2, 0, *entry(2, 2), *entry(3, 3), *NO_ENTRY]
    poll(register, ELSEWHERE.start, 2, source=SCADA)
    assert block_of(register, ELSEWHERE) == [2, 1, 0, *entry(3, 3), *NO_ENTRY, *NO_ENTRY]


def test_where_the_block_was_nothing_is_acknowledged_or_set_right_any_more(
    register: DataRegister, queue: EventQueue
) -> None:
    changes_to(register, 1, 2)
    change(queue, block=ELSEWHERE)
    poll(register, BLOCK.start, 2, 0xDEAD, source=SCADA)
    assert block_of(register)[:2] == [2, 0xDEAD]
    assert queue.waiting == 2


def test_a_block_that_shrinks_shows_fewer_and_one_that_grows_more(register: DataRegister, queue: EventQueue) -> None:
    changes_to(register, 1, 2, 3)
    one = Span(HOLDING, BLOCK.start, 3 + 7)
    change(queue, block=one)
    assert block_of(register, one) == [0, 3, 0, *entry(1, 1)]
    three = Span(HOLDING, BLOCK.start, 3 + 7 * 3)
    change(queue, block=three)
    assert block_of(register, three) == [0, 3, 0, *entry(1, 1), *entry(2, 2), *entry(3, 3)]


def test_a_block_taken_away_is_written_no_more_and_one_that_comes_is_shown_at_once(
    register: DataRegister, queue: EventQueue
) -> None:
    change(queue, block=None)
    register.write(BLOCK, b"\xff" * BLOCK.size, MENU)
    changes_to(register, 1)
    assert block_of(register) == [0xFFFF] * BLOCK.count
    assert queue.waiting == 1
    change(queue)
    assert block_of(register) == [0, 1, 0, *entry(1, 1), *NO_ENTRY]


def test_many_marked_points_are_sorted_out_at_once(register: DataRegister, clock: JumpingClock) -> None:
    """A thousand requests: each point looked for in each of them would hold up every line for seconds."""
    register.resize({HOLDING: 65536})
    spans = [Span(HOLDING, start, 64) for start in range(0, 64_000, 64)]
    queue = EventQueue(register, clock, spans, 10, FIFO)
    for span in spans:
        poll(register, span.start, *[1] * 64)
    looked_at = 0

    class Counted(Span):
        @property
        def stop(self) -> int:
            nonlocal looked_at
            looked_at += 1
            return self.start + self.count

    queue.change([Counted(span.table, span.start, span.count) for span in spans], 10, FIFO, None)
    assert looked_at <= 2 * len(spans)
    poll(register, 63_999, 2)
    assert taken(queue) == [entry(1, 2, 63_999)]


# ------------------------------------------------------------------------------------------------ other threads


def test_a_writer_is_spared_that_the_block_was_cut_off_under_his_feet(
    register: DataRegister, queue: EventQueue
) -> None:
    changes_to(register)
    register.resize({HOLDING: 50})  # and ``change`` has not come yet
    poll(register, 10, 1)
    change(queue, block=Span(HOLDING, 20, 3 + 7))
    assert block_of(register, Span(HOLDING, 20, 3 + 7)) == [0, 1, 0, *entry(1, 1)]


def test_a_block_beyond_the_register_is_no_secret(register: DataRegister, queue: EventQueue) -> None:
    with pytest.raises(PointsOutOfRange):
        change(queue, block=Span(HOLDING, 1990, 17))


@pytest.fixture
def quick_switching() -> Iterator[None]:
    """Threads that compute are switched every microsecond, not every 5 ms."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before_s)


def test_a_block_that_moves_just_when_it_is_shown_is_shown_where_it_is_now(
    register: DataRegister, queue: EventQueue
) -> None:
    changes_to(register)
    lock: Any = LateLock(lambda: None, lambda: change(queue, block=ELSEWHERE))  # first the change is noted, then shown
    queue._lock = lock
    poll(register, 10, 1)
    assert block_of(register, ELSEWHERE) == [0, 1, 0, *entry(1, 1), *NO_ENTRY, *NO_ENTRY]


def test_a_block_that_is_taken_away_just_when_it_is_shown_does_no_harm(
    register: DataRegister, queue: EventQueue
) -> None:
    changes_to(register)
    lock: Any = LateLock(lambda: None, lambda: change(queue, block=None))
    queue._lock = lock
    poll(register, 10, 1)
    assert queue.waiting == 1


def test_a_point_that_is_not_marked_any_more_just_when_it_changes_is_forgotten(
    register: DataRegister, queue: EventQueue
) -> None:
    changes_to(register)
    lock: Any = LateLock(lambda: change(queue, []))
    queue._lock = lock
    poll(register, 10, 1)
    change(queue)
    poll(register, 10, 2)
    assert taken(queue) == []


ROUNDS: Final = 100


@pytest.mark.usefixtures("quick_switching")
def test_writers_notice_nothing_of_changes_and_no_event_of_a_point_that_stays_is_lost(
    register: DataRegister, queue: EventQueue
) -> None:
    """In each round two threads write a point each, ten times; meanwhile the block comes, goes and moves, spans too."""
    errors: list[BaseException] = []
    others = cycle([(BLOCK, [Span(HOLDING, 50, 5)]), (None, []), (ELSEWHERE, [Span(COILS, 0, 9)])])
    round_begins = threading.Barrier(3)

    def write(point: int) -> None:
        try:
            poll(register, point, 0)
            for value in range(10 * ROUNDS):
                if value % 10 == 0:
                    round_begins.wait(PATIENCE_S)
                poll(register, point, value + 1)
                poll(register, 50, value)
                poll(register, BLOCK.start + 1, value, source=SCADA)
        except BaseException as error:  # noqa: BLE001 - raised again in the test's own thread
            errors.append(error)
            round_begins.abort()

    threads = [threading.Thread(target=write, args=(point,)) for point in (10, 11)]
    for thread in threads:
        thread.start()
    with contextlib.suppress(threading.BrokenBarrierError):
        for _ in range(ROUNDS):
            round_begins.wait(PATIENCE_S)
            for block, spans in islice(others, 4):
                change(queue, [*spans, *MARKED], block=block)
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    change(queue, block=None)
    found = [(point, value) for _, _, point, value, *_ in taken(queue)]
    for own in (10, 11):
        assert [value for point, value in found if point == own] == list(range(1, 10 * ROUNDS + 1))
