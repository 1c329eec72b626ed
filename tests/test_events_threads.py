"""The event queue between several threads: nothing is lost or doubled, and its block is of one piece at all times."""

from __future__ import annotations

import itertools
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

import pytest

from gateway.modbus.pdu import Span
from gateway.register import DataRegister, Quality, Source
from tests.event_bench import (
    AT_START,
    BLOCK,
    FIFO,
    HOLDING,
    NO_ENTRY,
    a_queue,
    block_of,
    changes_to,
    entries_of,
    entry,
    poll,
    taken,
)
from tests.fakes import SCADA, JumpingClock

WRITERS: Final = 4
VALUES: Final = 500  # each writer's
WIDE: Final = Span(HOLDING, 100, 3 + 7 * 17)


@pytest.fixture
def quick_switching() -> Iterator[None]:
    """Threads that compute are switched every microsecond, not every 5 ms."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before_s)


def a_writer(register: DataRegister, point: int) -> Callable[[], None]:
    """Writes *point* 0, and then VALUES values that say whose they are."""

    def write() -> None:
        for value in range(VALUES + 1):
            poll(register, point, point << 10 | value)

    return write


def while_writing(register: DataRegister, *others: Callable[[], object]) -> None:
    """Run WRITERS writers, and over and over, until they are done, each of *others*; then each once more."""
    done, errors = threading.Event(), list[BaseException]()

    def repeat(other: Callable[[], object]) -> None:
        while not done.is_set():
            other()

    def guarded(job: Callable[[], None]) -> Callable[[], None]:
        def run() -> None:
            try:
                job()
            except BaseException as error:  # noqa: BLE001 - raised again in the test's own thread
                errors.append(error)

        return run

    writers = [threading.Thread(target=guarded(a_writer(register, 10 + i))) for i in range(WRITERS)]
    watchers = [threading.Thread(target=guarded(partial(repeat, other))) for other in others]
    for thread in writers + watchers:
        thread.start()
    for thread in writers:
        thread.join()
    done.set()
    for thread in watchers:
        thread.join()
    if errors:
        raise errors[0]
    for other in others:
        other()


def assert_whole(entries: list[list[int]]) -> None:
    """Fail unless *entries* are all changes that the writers made: each once, each writer's in its order."""
    assert [found[0] for found in entries] == list(range(1, WRITERS * VALUES + 1))
    for point in range(10, 10 + WRITERS):
        values = [found[3:] for found in entries if found[2] == point]
        assert values == [[point << 10 | value, *AT_START] for value in range(1, VALUES + 1)]
    assert {found[1] for found in entries} == {3}


class InterruptedRegister(DataRegister):
    """A register with a moment for *meanwhile*, once, between the making and the writing of a block."""

    meanwhile: Callable[[], object] | None = None

    def write(self, span: Span, data: bytes, source: Source, quality: Quality = Quality.GOOD) -> None:
        if span == BLOCK and self.meanwhile is not None:
            meanwhile, self.meanwhile = self.meanwhile, None
            meanwhile()
        super().write(span, data, source, quality)


def test_a_block_that_is_old_before_it_is_written_is_written_anew(clock: JumpingClock) -> None:
    register = InterruptedRegister(clock)
    queue = a_queue(register, clock, block=BLOCK)
    changes_to(register, 1, 2, 3, 4)
    register.meanwhile = lambda: queue.read_fifo(FIFO)
    poll(register, 10, 5)  # the block that shows 1 and 2 is written after function 24 took both
    assert register.meanwhile is None
    assert block_of(register) == [0, 1, 0, *entry(5, 5), *NO_ENTRY]


@pytest.mark.usefixtures("quick_switching")
def test_one_taker_by_function_24_gets_each_writers_changes_once_and_in_order(
    register: DataRegister, clock: JumpingClock
) -> None:
    queue = a_queue(register, clock)
    found: list[list[int]] = []
    while_writing(register, lambda: found.extend(taken(queue)))
    assert_whole(found)
    assert (queue.waiting, queue.lost) == (0, 0)


@pytest.mark.usefixtures("quick_switching")
def test_two_takers_share_the_changes_without_losing_or_doubling_one(
    register: DataRegister, clock: JumpingClock
) -> None:
    queue = a_queue(register, clock, block=WIDE)
    found: list[list[int]] = []
    other_found: list[list[int]] = []
    while_writing(register, lambda: found.extend(taken(queue)), lambda: other_found.extend(taken(queue)))
    assert_whole(sorted(found + other_found))
    assert found == sorted(found)
    assert block_of(register, WIDE) == [0] * WIDE.count


class BlockReader:
    """SCADA without function 24: reads the block, keeps what is new, writes back the last number."""

    def __init__(self, register: DataRegister) -> None:
        self._register = register
        self.entries: list[list[int]] = []

    def take(self) -> int:
        """Take what the block shows; return how many changes waited."""
        known = len(self.entries)
        waiting = self.read()
        if len(self.entries) > known:
            poll(self._register, WIDE.start, self.entries[-1][0], source=SCADA)
        return waiting

    def read(self) -> int:
        """Keep what is new in the block, and return how many changes wait."""
        waiting, shown = whole_block(self._register)
        last = self.entries[-1][0] if self.entries else 0
        self.entries += [each for each in shown if each[0] > last]
        return waiting


def whole_block(register: DataRegister) -> tuple[int, list[list[int]]]:
    """How many changes the block says to wait, and those it shows; fail unless the block is of one piece."""
    _, waiting, lost, *rest = block_of(register, WIDE)
    entries = entries_of(rest)
    count = min(waiting, 17)
    assert entries[count:] == [NO_ENTRY] * (17 - count)
    for number, table, point, value, *time in entries[:count]:
        assert (table, time, value >> 10) == (3, AT_START, point), f"change {number} is torn"
    numbers = [each[0] for each in entries[:count]]
    assert numbers == list(range(numbers[0], numbers[0] + count)) if numbers else count == 0
    assert lost == 0
    return waiting, entries[:count]


@pytest.mark.usefixtures("quick_switching")
def test_scada_at_the_block_gets_each_change_once_and_never_half_of_one(
    register: DataRegister, clock: JumpingClock
) -> None:
    queue = a_queue(register, clock, block=WIDE, fifo=None)
    scada = BlockReader(register)
    while_writing(register, scada.take)
    for _ in range(WRITERS * VALUES):  # nobody writes any more: each turn takes 17
        if not scada.take():
            break
    assert_whole(scada.entries)
    assert (queue.waiting, queue.lost) == (0, 0)


@pytest.mark.usefixtures("quick_switching")
def test_the_block_is_of_one_piece_at_all_times_while_function_24_empties_the_queue(
    register: DataRegister, clock: JumpingClock
) -> None:
    queue = a_queue(register, clock, block=WIDE)
    found: list[list[int]] = []
    seen: set[int] = set()
    while_writing(register, lambda: found.extend(taken(queue)), lambda: seen.add(whole_block(register)[0]))
    assert_whole(found)
    assert block_of(register, WIDE) == [0] * WIDE.count
    assert len(seen) > 1, "the block was never seen while anything waited"


@pytest.mark.usefixtures("quick_switching")
def test_what_is_lost_in_a_race_is_counted_to_the_last_one(register: DataRegister, clock: JumpingClock) -> None:
    queue = a_queue(register, clock, size=3)
    found: list[list[int]] = []
    while_writing(register, lambda: found.extend(taken(queue)))
    numbers = [each[0] for each in found]
    assert numbers == sorted(set(numbers))
    assert len(numbers) + queue.lost == WRITERS * VALUES
    #  every gap in the numbers is as wide as what was lost there
    gaps = sum(after - before - 1 for before, after in itertools.pairwise([0, *numbers, WRITERS * VALUES + 1]))
    assert gaps == queue.lost
