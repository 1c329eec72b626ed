"""The register is given another size while others read and write: what remains keeps all that is known of it."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.commands import CommandQueue
from gateway.errors import PointsOutOfRange, RequestInvalid
from gateway.modbus.pdu import Span, Table, pack_bits, pack_words
from gateway.register import SIZE_MAX, DataRegister, Quality, Sample
from tests.fakes import SCADA, JumpingClock, words
from tests.locks import LateLock
from tests.points import MENU, POLL, holding, outlet, poll, qualities, scada, taken, values

HOLDING, INPUTS = Table.HOLDING_REGISTERS, Table.INPUT_REGISTERS
FRESH = Sample(0, Quality.NEVER, None, None)
ANY_TABLE = pytest.mark.parametrize("table", list(Table))


def a_register(clock: JumpingClock, size: int) -> DataRegister:
    return DataRegister(clock, dict.fromkeys(Table, size))


def packed(table: Table, numbers: list[int]) -> bytes:
    return pack_bits([bool(number & 1) for number in numbers]) if table.is_bits else pack_words(numbers)


def written(table: Table, number: int) -> int:
    """What is found where *number* was written."""
    return number & 1 if table.is_bits else number


@ANY_TABLE
def test_points_that_remain_keep_value_quality_age_and_source(clock: JumpingClock, table: Table) -> None:
    register = a_register(clock, 20)
    register.write(Span(table, 0, 5), packed(table, [1, 2, 3, 4, 5]), POLL)
    register.write(Span(table, 9, 1), packed(table, [9]), MENU, Quality.MANUAL)
    clock.pass_s(7.0)
    before = register.samples(Span(table, 0, 10))
    for size in (30, 10, 11, 2000, 10):
        register.resize({table: size})
        assert register.size(table) == size
        assert register.samples(Span(table, 0, 10)) == before
    assert (before[9].age_s, before[9].source, before[9].quality) == (7.0, MENU, Quality.MANUAL)


@ANY_TABLE
def test_new_points_are_zero_and_nobody_has_written_them(clock: JumpingClock, table: Table) -> None:
    register = a_register(clock, 3)
    register.write(Span(table, 0, 3), packed(table, [1, 1, 1]), SCADA)
    register.resize({table: 9})
    assert register.samples(Span(table, 3, 6)) == [FRESH] * 6
    assert register.read(Span(table, 0, 9)) == packed(table, [1, 1, 1, 0, 0, 0, 0, 0, 0])
    register.write(Span(table, 2, 7), packed(table, [0, 1, 0, 1, 0, 1, 1]), SCADA)
    assert register.read(Span(table, 0, 9)) == packed(table, [1, 1, 0, 1, 0, 1, 0, 1, 1])


@ANY_TABLE
def test_points_cut_off_are_gone_and_come_back_as_new_ones(clock: JumpingClock, table: Table) -> None:
    register = a_register(clock, 10)
    register.write(Span(table, 0, 10), packed(table, [1] * 10), SCADA)
    register.resize({table: 4})
    for span in (Span(table, 4, 1), Span(table, 0, 5), Span(table, 9, 1)):
        with pytest.raises(PointsOutOfRange, match="are not within 0 to 3"):
            register.read(span)
    register.resize({table: 10})
    assert register.samples(Span(table, 4, 6)) == [FRESH] * 6
    register.write(Span(table, 0, 10), packed(table, [1] * 10), POLL)
    assert register.known(Span(table, 4, 6)) == packed(table, [1] * 6)
    assert register.known(Span(table, 4, 6), commanded=True) is None  # nobody wanted these written anywhere
    assert register.known(Span(table, 0, 4), commanded=True) == packed(table, [1] * 4)
    register.write(Span(table, 9, 1), packed(table, [1]), SCADA)
    assert register.known(Span(table, 8, 1), commanded=True) is None
    assert register.known(Span(table, 9, 1), commanded=True) == packed(table, [1])


def test_only_the_tables_named_change(clock: JumpingClock) -> None:
    register = a_register(clock, 10)
    register.resize({HOLDING: 20, Table.COILS: 5})
    assert [register.size(table) for table in Table] == [5, 10, 20, 10]
    register.resize({})
    assert [register.size(table) for table in Table] == [5, 10, 20, 10]


@ANY_TABLE
def test_sizes_go_from_1_to_65536(clock: JumpingClock, table: Table) -> None:
    register = a_register(clock, 10)
    register.write(Span(table, 0, 1), packed(table, [1]), POLL)
    register.resize({table: SIZE_MAX})
    register.write(Span(table, SIZE_MAX - 1, 1), packed(table, [1]), POLL)
    register.resize({table: 1})
    assert register.samples(Span(table, 0, 1))[0].value == 1
    register.resize({table: SIZE_MAX})
    assert register.samples(Span(table, SIZE_MAX - 1, 1)) == [FRESH]


@pytest.mark.parametrize("size", [0, -1, SIZE_MAX + 1, 10**9])
def test_a_size_that_cannot_be_changes_no_table_at_all(clock: JumpingClock, size: int) -> None:
    register = a_register(clock, 10)
    scada(register, 9, 555)
    with pytest.raises(RequestInvalid, match=rf"{size} points in table 4 are not within 1 to 65536"):
        register.resize({HOLDING: 5, INPUTS: size})
    assert [register.size(table) for table in Table] == [10] * 4
    assert values(register, 9) == [555]


def test_what_a_request_fills_still_grows_stale(clock: JumpingClock) -> None:
    register = a_register(clock, 10)
    undo = register.claim(holding(2, 3), POLL, 3.0)
    poll(register, 2, 1, 2, 3)
    register.resize({HOLDING: 5})
    clock.pass_s(3.5)
    assert qualities(register, 2, 3) == [Quality.STALE] * 3
    assert register.read_fresh(holding(4)) is None
    undo()
    assert register.read_fresh(holding(4)) == words(3)


def test_a_command_on_its_way_survives_and_holds_its_points(clock: JumpingClock) -> None:
    register = a_register(clock, 10)
    queue = CommandQueue(register, clock, wake=lambda: None)
    queue.add(outlet(0, 4))
    scada(register, 1, 7, 8)
    register.resize({HOLDING: 2000})
    register.resize({HOLDING: 4})
    poll(register, 0, 0, 0, 0, 0)
    assert values(register, 0, 4) == [0, 7, 8, 0]
    assert taken(queue) == [(1, words(7, 8))]
    poll(register, 0, 5, 5, 5, 5)
    assert values(register, 0, 4) == [5, 5, 5, 5]


SIZES = st.integers(1, 40)
WRITES = st.tuples(st.integers(0, 39), st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=12))


@ANY_TABLE
@given(start=SIZES, steps=st.lists(SIZES | WRITES, max_size=20))
def test_any_order_of_writes_and_sizes_leaves_what_was_written_where_it_was(
    table: Table, start: int, steps: list[Any]
) -> None:
    register = a_register(JumpingClock(), start)
    expected = [0] * start
    for step in steps:
        if isinstance(step, int):
            register.resize({table: step})
            expected = (expected + [0] * step)[:step]
            continue
        first, numbers = step
        if first + len(numbers) > len(expected):
            with pytest.raises(PointsOutOfRange):
                register.write(Span(table, first, len(numbers)), packed(table, numbers), POLL)
        else:
            register.write(Span(table, first, len(numbers)), packed(table, numbers), POLL)
            expected[first : first + len(numbers)] = [written(table, number) for number in numbers]
    assert [sample.value for sample in register.samples(Span(table, 0, len(expected)))] == expected
    assert register.read(Span(table, 0, len(expected))) == packed(table, expected)


# ------------------------------------------------------------------------------------------------ threads


CALLS: dict[str, Callable[[DataRegister], object]] = {
    "read": lambda register: register.read(holding(8, 2)),
    "read_fresh": lambda register: register.read_fresh(holding(8, 2)),
    "samples": lambda register: register.samples(holding(8, 2)),
    "known": lambda register: register.known(holding(8, 2)),
    "write": lambda register: register.write(holding(8, 2), words(1, 2), SCADA),
    "mask_write": lambda register: register.mask_write(holding(9), 0, 0xFFFF, SCADA),
    "mark": lambda register: register.mark(holding(8, 2), Quality.BAD, POLL),
    "mark_unfilled": lambda register: register.mark_unfilled(holding(8, 2), Quality.BAD),
    "claim": lambda register: register.claim(holding(8, 2), POLL, 1.0),
}


@pytest.mark.parametrize("call", CALLS)
def test_who_comes_just_when_his_points_are_cut_off_is_told_so_and_does_no_harm(clock: JumpingClock, call: str) -> None:
    register = a_register(clock, 10)
    scada(register, 0, *range(10))
    lock: Any = LateLock(lambda: register.resize({HOLDING: 5}))
    register._lock = lock
    with pytest.raises(PointsOutOfRange):
        CALLS[call](register)
    register.resize({HOLDING: 10})
    assert register.samples(holding(5, 5)) == [FRESH] * 5
    assert register.read_fresh(holding(0, 10)) == words(0, 1, 2, 3, 4, 0, 0, 0, 0, 0)


@pytest.fixture
def quick_switching() -> Iterator[None]:
    """Threads that compute are switched every microsecond, not every 5 ms."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before_s)


@pytest.mark.usefixtures("quick_switching")
def test_readers_and_writers_see_the_old_size_or_the_new_but_nothing_between(clock: JumpingClock) -> None:
    register = a_register(clock, 100)
    whole = holding(0, 100)
    scada(register, 0, *[0x5555] * 50)
    done, errors = threading.Event(), list[BaseException]()
    seen: set[str] = set()

    def use() -> None:
        while not done.is_set():
            try:
                assert len(register.read(whole)) == 200
                assert len(register.samples(whole)) == 100
                register.write(holding(50, 50), words(*[0xAAAA] * 50), SCADA)
                seen.add("whole")
            except PointsOutOfRange:
                seen.add("cut")
            except BaseException as error:  # noqa: BLE001 - raised again in the test's own thread
                errors.append(error)
                return

    threads = [threading.Thread(target=use) for _ in range(2)]
    for thread in threads:
        thread.start()
    for _ in range(1000):
        register.resize({HOLDING: 50})
        register.resize({HOLDING: 100})
    while not (errors or len(seen) == 2):
        register.resize({HOLDING: 50})
        register.resize({HOLDING: 100})
    done.set()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    assert values(register, 0, 50) == [0x5555] * 50
    register.resize({HOLDING: 200})
    assert register.samples(holding(100, 100)) == [FRESH] * 100
