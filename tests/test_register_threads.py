"""The data register and several threads: nothing torn, nothing lost, watchers told in order."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import Any

import pytest

from gateway.commands import CommandQueue, Outlet
from gateway.modbus.pdu import Span, pack_bits, pack_words
from gateway.register import CommandSink, DataRegister, Sample, Source, Written
from tests.fakes import SCADA, JumpingClock, words
from tests.points import MENU, POLL, coils, holding

Task = Callable[[], None]


class InterruptedClock(JumpingClock):
    """A clock that the register asks in the middle of each write: the moment for *meanwhile*, once."""

    meanwhile: Callable[[], None] | None = None

    def monotonic(self) -> float:
        self.interrupt()
        return super().monotonic()

    def interrupt(self) -> None:
        """Do *meanwhile*, once."""
        meanwhile, self.meanwhile = self.meanwhile, None
        if meanwhile is not None:
            meanwhile()


class InterruptedSink(CommandSink):
    """A sink that is asked between the reading and the writing of a mask write: another moment for *meanwhile*."""

    def __init__(self, clock: InterruptedClock) -> None:
        self._clock = clock

    def wants(self, span: Span) -> bool:
        self._clock.interrupt()
        return False


def interrupted(register: DataRegister, clock: InterruptedClock, write: Callable[[], None], other: Task) -> None:
    """Run *write*, and half-way through it *other* in another thread, which gets its chance to finish there.

    Under the lock it cannot, and goes on afterwards; without it, it certainly does.
    """
    thread = threading.Thread(target=other)
    patience_s = 0.02 if isinstance(register.lock, type(threading.Lock())) else 10.0

    def let_the_other_go_on() -> None:
        thread.start()
        thread.join(patience_s)

    clock.meanwhile = let_the_other_go_on
    write()
    assert thread.ident is not None
    thread.join()


@pytest.fixture(params=["with the lock", "without"])
def case(request: pytest.FixtureRequest) -> tuple[DataRegister, InterruptedClock, bool]:
    """A register, the clock that interrupts its writers, and whether it has its lock.

    Each test of a race also runs without the lock, to show that it would find what it looks for.
    """
    clock = InterruptedClock()
    register = DataRegister(clock)
    if request.param == "without":
        no_lock: Any = contextlib.nullcontext()
        register._lock = no_lock
    return register, clock, request.param == "with the lock"


@pytest.fixture
def quick_switching() -> Iterator[None]:
    """Threads that compute are switched every microsecond, not every 5 ms."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before_s)


def in_threads(tasks: list[Callable[[], None]]) -> None:
    """Run all *tasks* at the same time; fail if one does."""
    start = threading.Barrier(len(tasks))
    finished: list[Callable[[], None]] = []

    def run(task: Callable[[], None]) -> None:
        start.wait()
        task()
        finished.append(task)

    threads = [threading.Thread(target=run, args=(task,)) for task in tasks]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(finished) == len(tasks)


def test_two_mask_writes_at_the_same_time_lose_no_bit(case: tuple[DataRegister, InterruptedClock, bool]) -> None:
    register, clock, has_lock = case
    register.write(holding(0), words(0), POLL)
    register.add_sink(InterruptedSink(clock))
    first = partial(register.mask_write, holding(0), 0xFFFE, 0x0001, SCADA)
    interrupted(register, clock, first, partial(register.mask_write, holding(0), 0x7FFF, 0x8000, MENU))
    assert (register.read(holding(0)) == words(0x8001)) == has_lock


def test_watchers_are_told_in_the_order_of_writing_whichever_thread_wrote(
    clock: JumpingClock, quick_switching: None
) -> None:
    """Each thread flips its own bit: in order, each value told differs from the one before by exactly one bit."""
    register = DataRegister(clock)
    told: list[int] = [0]
    register.watch(lambda written: told.append(int.from_bytes(written.data, "big")))

    def flip(bit: int) -> None:
        for turn in range(200):
            register.mask_write(holding(0), 0xFFFF & ~(1 << bit), (1 - turn % 2) << bit, SCADA)

    in_threads([partial(flip, bit) for bit in range(4)])
    assert len(told) == 801
    assert {(before ^ after).bit_count() for before, after in pairwise(told)} == {1}


def test_a_watcher_at_work_keeps_no_thread_from_writing_and_is_told_in_order(register: DataRegister) -> None:
    told: list[bytes] = []
    other = threading.Thread(target=lambda: register.write(holding(0), words(2), POLL))

    def let_the_other_write(written: Written) -> None:
        if written.data == words(1):
            other.start()
            other.join(timeout=5.0)
            assert not other.is_alive()
        told.append(written.data)  # the second only after the first was dealt with, though another thread wrote it

    register.watch(let_the_other_write)
    register.write(holding(0), words(1), POLL)
    assert told == [words(1), words(2)]


BLOCKS = {
    "a 32-bit value": (holding(10, 2), [bytes.fromhex("0000 FFFF"), bytes.fromhex("FFFF 0000")]),
    "a block of registers": (holding(3, 60), [b"\x55" * 120, b"\xaa" * 120]),
    "a block of coils": (coils(5, 80), [b"\x55" * 10, b"\xaa" * 10]),
}


def is_whole(samples: list[Sample], span: Span, owner: dict[bytes, Source]) -> bool:
    """True if all values are of one block, and all sources its own."""
    values = [sample.value for sample in samples]
    seen = pack_bits([bool(value) for value in values]) if span.table.is_bits else pack_words(values)
    return {sample.source for sample in samples} == {owner.get(seen)}


@pytest.mark.parametrize("block", BLOCKS)
def test_a_block_half_written_is_seen_by_nobody(case: tuple[DataRegister, InterruptedClock, bool], block: str) -> None:
    register, clock, has_lock = case
    span, (old, new) = BLOCKS[block]
    seen: list[Sample] = []
    register.write(span, old, SCADA)
    interrupted(register, clock, partial(register.write, span, new, MENU), lambda: seen.extend(register.samples(span)))
    assert is_whole(seen, span, {old: SCADA, new: MENU}) == has_lock


def test_a_poll_around_a_held_point_is_still_one_step(case: tuple[DataRegister, InterruptedClock, bool]) -> None:
    """The point in the middle is held by a command: the poll is written in two parts, but nobody sees just one."""
    register, clock, has_lock = case
    queue = CommandQueue(register, JumpingClock(), wake=lambda: None)
    queue.add(Outlet(holding(11), POLL))
    register.write(holding(10, 3), words(1, 1, 1), POLL)
    register.write(holding(11), words(7), SCADA)
    seen: list[bytes] = []
    poll = partial(register.write, holding(10, 3), words(2, 2, 2), POLL)
    interrupted(register, clock, poll, lambda: seen.append(register.read(holding(10, 3))))
    assert seen == [words(2, 7, 2) if has_lock else words(2, 7, 1)]


@pytest.mark.parametrize("block", BLOCKS)
def test_two_threads_that_write_and_two_that_read_never_see_a_torn_block(
    register: DataRegister, quick_switching: None, block: str
) -> None:
    span, blocks = BLOCKS[block]
    owner = {blocks[0]: SCADA, blocks[1]: MENU}
    torn: list[bytes] = []
    done = threading.Event()
    register.write(span, blocks[0], SCADA)

    def write(block: bytes) -> None:
        for _ in range(500):
            register.write(span, block, owner[block])
        done.set()

    def read() -> None:
        while not done.is_set():
            data = register.read(span)
            if data not in owner or not is_whole(register.samples(span), span, owner):
                torn.append(data)

    in_threads([partial(write, blocks[0]), partial(write, blocks[1]), read, read])
    assert torn == []
