"""The event queue: what becomes a change, and how SCADA empties it in two ways (threads: ``test_events_threads``)."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import pytest

from gateway.events import EventQueue
from gateway.modbus.diagnostics import LineDiagnostics
from gateway.modbus.pdu import Span, Table
from gateway.modbus.server import Server, answer
from gateway.register import DataRegister, Quality
from tests import peers
from tests.event_bench import (
    AT_START,
    BLOCK,
    COILS,
    DISCRETE,
    FIFO,
    HOLDING,
    INPUTS,
    MENU,
    NO_ENTRY,
    POLL,
    WALL_S,
    a_queue,
    block_of,
    changes_to,
    entry,
    poll,
    registers_of,
    taken,
)
from tests.fakes import SCADA, JumpingClock, words
from tests.lines import UNIT, serving_tcp, tcp_config
from tests.modbus import wire


@pytest.fixture
def queue(register: DataRegister, clock: JumpingClock) -> EventQueue:
    return a_queue(register, clock)


@pytest.fixture
def shown(register: DataRegister, clock: JumpingClock) -> EventQueue:
    """A queue with a block of two entries."""
    return a_queue(register, clock, block=BLOCK)


# ------------------------------------------------------------------------------------------------ what is a change


def test_the_first_value_of_a_point_is_no_change(register: DataRegister, queue: EventQueue) -> None:
    poll(register, 10, 555, 0)
    assert (queue.waiting, taken(queue)) == (0, [])


def test_the_same_value_again_is_no_change(register: DataRegister, queue: EventQueue) -> None:
    poll(register, 10, 555)
    poll(register, 10, 555)
    poll(register, 10, 555, source=SCADA)
    assert taken(queue) == []


def test_a_change_has_its_number_table_point_value_and_time_in_ms(
    register: DataRegister, queue: EventQueue, clock: JumpingClock
) -> None:
    poll(register, 11, 0x1234)
    clock.pass_s(1.25)
    poll(register, 11, 0xABCD)
    clock.jump_wall(65.536)  # 0x1 0000 ms
    poll(register, 11, 0)
    assert taken(queue) == [
        [1, 3, 11, 0xABCD, 0x018B, 0xCFE5, 0x6800 + 1250],
        [2, 3, 11, 0, 0x018B, 0xCFE6, 0x6800 + 1250],
    ]


def test_the_time_is_the_wall_clocks_even_where_it_goes_back(
    register: DataRegister, queue: EventQueue, clock: JumpingClock
) -> None:
    poll(register, 10, 1)
    clock.jump_wall(-WALL_S)  # a board without a clock
    poll(register, 10, 2)
    assert taken(queue) == [[1, 3, 10, 2, 0, 0, 0]]


@pytest.mark.parametrize("table", [HOLDING, INPUTS])
def test_registers_change_one_by_one_in_ascending_order(
    register: DataRegister, queue: EventQueue, table: Table
) -> None:
    poll(register, 10, 1, 2, 3, 4, table=table)
    poll(register, 10, 1, 0xFFFF, 3, 5, table=table)
    assert taken(queue) == [[1, int(table), 11, 0xFFFF, *AT_START], [2, int(table), 13, 5, *AT_START]]


@pytest.mark.parametrize("table", [COILS, DISCRETE])
def test_bits_change_one_by_one_in_ascending_order(register: DataRegister, queue: EventQueue, table: Table) -> None:
    poll(register, 11, 0, 1, 0, 1, table=table)
    poll(register, 10, 0, 0, 0, 1, 1, 1, table=table)  # 10 and 15 are new
    assert taken(queue) == [[1, int(table), 12, 0, *AT_START], [2, int(table), 13, 1, *AT_START]]


def test_bits_beyond_the_first_byte_are_told_apart(register: DataRegister, queue: EventQueue) -> None:
    register.write(Span(COILS, 0, 24), bytes(3), POLL)
    register.write(Span(COILS, 0, 24), wire("FF 83 10  # coils 0 to 7; 8, 9, 15; 20"), POLL)
    assert taken(queue) == [[1, 1, 15, 1, *AT_START]]


def test_only_marked_points_are_watched(register: DataRegister, queue: EventQueue) -> None:
    for value in (1, 2):
        poll(register, 8, *[value] * 14)  # 8 to 21; 10 to 19 are marked
    assert [change[2] for change in taken(queue)] == list(range(10, 20))


def test_a_point_marked_twice_changes_once(register: DataRegister, clock: JumpingClock) -> None:
    queue = EventQueue(register, clock, [Span(HOLDING, 10, 2), Span(HOLDING, 11, 2)], 10, FIFO)
    poll(register, 10, 0, 0, 0)
    poll(register, 10, 1, 2, 3)
    assert taken(queue) == [entry(1, 1, 10), entry(2, 2, 11), entry(3, 3, 12)]


def test_whoever_writes_a_marked_point_changes_it(register: DataRegister, queue: EventQueue) -> None:
    poll(register, 10, 1)
    poll(register, 10, 2, source=SCADA)
    poll(register, 10, 3, source=MENU)
    poll(register, 10, 3)
    assert taken(queue) == [entry(1, 2), entry(2, 3)]


def test_a_quality_alone_is_no_change(register: DataRegister, queue: EventQueue) -> None:
    poll(register, 10, 1)
    register.mark(Span(HOLDING, 10, 1), Quality.BAD, POLL)
    poll(register, 10, 1)
    assert taken(queue) == []


def test_the_tables_are_apart(register: DataRegister, queue: EventQueue) -> None:
    poll(register, 10, 1)
    poll(register, 10, 2, table=INPUTS)
    poll(register, 10, 1, table=COILS)
    poll(register, 10, 0, table=DISCRETE)
    assert taken(queue) == []


# ------------------------------------------------------------------------------------------------ numbers, overflow


def test_after_65535_comes_1(register: DataRegister, clock: JumpingClock) -> None:
    queue = a_queue(register, clock, size=10)
    for value in range(6554):  # 6553 times 10 changes
        taken(queue)
        register.write(Span(HOLDING, 10, 10), words(value) * 10, POLL)
    assert taken(queue)[-1][:4] == [65530, 3, 19, 6553]
    register.write(Span(HOLDING, 10, 10), words(0) * 10, POLL)
    assert [change[0] for change in taken(queue)] == [65531, 65532, 65533, 65534, 65535, 1, 2, 3, 4, 5]


def test_a_full_queue_keeps_the_old_counts_the_new_and_leaves_a_gap(
    register: DataRegister, clock: JumpingClock
) -> None:
    queue = a_queue(register, clock, size=2)
    changes_to(register, 1, 2, 3, 4)
    assert (queue.waiting, queue.lost) == (2, 2)
    assert queue.read_fifo(FIFO) == [2, 2, *entry(1, 1), *entry(2, 2)]
    poll(register, 10, 5)
    assert queue.read_fifo(FIFO) == [1, 2, *entry(5, 5)]  # 3 and 4 are missing


def test_a_change_that_was_lost_is_not_told_by_the_next_poll(register: DataRegister, clock: JumpingClock) -> None:
    queue = a_queue(register, clock, size=1)
    changes_to(register, 1, 2)
    assert taken(queue) == [entry(1, 1)]
    poll(register, 10, 2)
    assert (taken(queue), queue.lost) == ([], 1)


def test_counts_above_65535_are_told_as_65535(register: DataRegister, clock: JumpingClock) -> None:
    queue = a_queue(register, clock, size=66_000, block=BLOCK)
    marked = Span(HOLDING, 10, 10)
    for value in range(13_202):  # 13201 times 10 changes
        register.write(marked, words(value) * 10, POLL)
    assert (queue.waiting, queue.lost) == (66_000, 66_010)
    assert block_of(register)[:3] == [0, 65535, 65535]
    found = queue.read_fifo(FIFO)
    assert found is not None
    assert found[:2] == [65535, 65535]


# ------------------------------------------------------------------------------------------------ function 24


@pytest.fixture
def server(register: DataRegister, queue: EventQueue) -> Server:
    return Server(register, SCADA, read_fifo=queue.read_fifo)


def asked(server: Server, request: str) -> str:
    return answer(wire(request), server).hex(" ").upper()


def test_function_24_of_an_empty_queue_tells_two_zeros(server: Server) -> None:
    reply = """
        18
        00 06        # byte count: of all that follows
        00 02        # 2 registers in the queue
        00 00 00 00  # none wait, none were lost
    """
    assert asked(server, "18 04 DE") == wire(reply).hex(" ").upper()


def test_function_24_takes_the_oldest_four_out(server: Server, register: DataRegister) -> None:
    changes_to(register, 1, 2, 3, 4, 5)
    reply = """
        18
        00 3E                                     # byte count: 62, as large as section 6.18 allows but for 2
        00 1E                                     # 30 registers
        00 05 00 00                               # 5 wait, none was lost
        00 01 00 03 00 0A 00 01 01 8B CF E5 68 00
        00 02 00 03 00 0A 00 02 01 8B CF E5 68 00
        00 03 00 03 00 0A 00 03 01 8B CF E5 68 00
        00 04 00 03 00 0A 00 04 01 8B CF E5 68 00
    """
    assert asked(server, "18 04 DE") == wire(reply).hex(" ").upper()
    rest = """
        18 00 14 00 09
        00 01 00 00                               # 1 waits
        00 05 00 03 00 0A 00 05 01 8B CF E5 68 00
    """
    assert asked(server, "18 04 DE") == wire(rest).hex(" ").upper()
    assert asked(server, "18 04 DE") == "18 00 06 00 02 00 00 00 00"


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("18 04 DD", "98 02"),
        ("18 04 DF", "98 02"),
        ("18 00 00", "98 02"),
        ("18 FF FF", "98 02"),
        ("18", "98 03"),
        ("18 04", "98 03"),
        ("18 04 DE 00", "98 03"),
        ("18 FF FF 00  # the length before the address", "98 03"),
    ],
)
def test_a_refused_function_24_takes_nothing(
    server: Server, register: DataRegister, queue: EventQueue, request_: str, reply: str
) -> None:
    changes_to(register, 1, 2)
    assert asked(server, request_) == reply
    assert queue.waiting == 2


def test_a_queue_of_more_than_31_registers_is_refused_with_exception_3(register: DataRegister) -> None:
    held: list[int] = []
    server = Server(register, SCADA, read_fifo=lambda address: held)
    held[:] = range(31)
    assert asked(server, "18 00 00")[:14] == "18 00 40 00 1F"
    held[:] = range(32)
    assert asked(server, "18 00 00") == "98 03"


def test_the_example_of_section_6_18_is_answered_as_printed(register: DataRegister) -> None:
    server = Server(register, SCADA, read_fifo=lambda address: [0x01B8, 0x1284] if address == 0x04DE else None)
    assert asked(server, "18 04 DE") == "18 00 06 00 02 01 B8 12 84"
    assert asked(server, "18 DE 04") == "98 02"


@pytest.mark.parametrize("fifo", [0, 65535])
def test_the_address_may_be_any(register: DataRegister, clock: JumpingClock, fifo: int) -> None:
    queue = a_queue(register, clock, fifo=fifo)
    assert [address for address in range(65536) if queue.read_fifo(address) is not None] == [fifo]


def test_without_an_address_function_24_finds_no_queue(register: DataRegister, clock: JumpingClock) -> None:
    queue = a_queue(register, clock, fifo=None)
    assert {queue.read_fifo(address) is None for address in range(65536)} == {True}


def test_function_24_can_be_closed(server: Server) -> None:
    closed = Server(server.register, SCADA, read_fifo=server.read_fifo, functions=frozenset({3, 16}))
    assert asked(closed, "18 04 DE") == "98 01"


def test_a_serial_line_answers_function_24_too(server: Server) -> None:
    on_line = Server(server.register, SCADA, read_fifo=server.read_fifo, line=LineDiagnostics())
    assert asked(on_line, "18 04 DE") == "18 00 06 00 02 00 00 00 00"


def test_pymodbus_reads_the_queue_over_tcp(register: DataRegister, queue: EventQueue) -> None:
    changes_to(register, 1, 2, 3, 4, 5)
    with serving_tcp(tcp_config(), register) as served:
        served.task.server.read_fifo = queue.read_fifo
        with peers.client_tcp(served.port) as client:
            first: Any = client.read_fifo_queue(address=FIFO, **peers.unit_kwargs(UNIT))
            other: Any = client.read_fifo_queue(address=FIFO + 1, **peers.unit_kwargs(UNIT))
    expected = [5, 0, *entry(1, 1), *entry(2, 2), *entry(3, 3), *entry(4, 4)]
    if version("pymodbus") == "3.8.6":
        expected = expected[:-4]  # it takes the byte count's own bytes off the number of registers
    assert first.values == expected
    assert (other.isError(), other.exception_code) == (True, 2)


# ------------------------------------------------------------------------------------------------ the block


def test_a_new_block_is_all_zeros_and_written_once(register: DataRegister, clock: JumpingClock) -> None:
    register.write(BLOCK, b"\xff" * BLOCK.size, MENU)
    a_queue(register, clock, block=BLOCK)
    assert block_of(register) == [0] * 17
    assert {sample.quality for sample in register.samples(BLOCK)} == {Quality.GOOD}


def test_the_block_shows_how_many_wait_and_the_oldest_of_them(register: DataRegister, shown: EventQueue) -> None:
    changes_to(register)
    assert block_of(register) == [0, 0, 0, *NO_ENTRY, *NO_ENTRY]
    poll(register, 10, 1)
    assert block_of(register) == [0, 1, 0, *entry(1, 1), *NO_ENTRY]
    poll(register, 10, 2)
    poll(register, 10, 3)
    assert block_of(register) == [0, 3, 0, *entry(1, 1), *entry(2, 2)]


def test_the_block_shows_what_was_lost(register: DataRegister, clock: JumpingClock) -> None:
    a_queue(register, clock, size=1, block=BLOCK)
    changes_to(register, 1, 2, 3)
    assert block_of(register) == [0, 1, 2, *entry(1, 1), *NO_ENTRY]


def test_the_points_beside_the_block_are_left_alone(register: DataRegister, shown: EventQueue) -> None:
    poll(register, BLOCK.start - 1, 0xFFFF, source=MENU)
    poll(register, BLOCK.stop, 0xFFFF, source=MENU)
    changes_to(register, 1, 2, 3)
    assert [sample.value for sample in register.samples(Span(HOLDING, 99, 1))] == [0xFFFF]
    assert [sample.value for sample in register.samples(Span(HOLDING, 117, 1))] == [0xFFFF]


def test_what_scada_wrote_back_is_gone_and_the_next_move_up(register: DataRegister, shown: EventQueue) -> None:
    changes_to(register, 1, 2, 3, 4)
    poll(register, 100, 2, source=SCADA)
    assert block_of(register) == [2, 2, 0, *entry(3, 3), *entry(4, 4)]
    poll(register, 100, 4, source=SCADA)
    assert block_of(register) == [4, 0, 0, *NO_ENTRY, *NO_ENTRY]
    assert shown.waiting == 0


def test_scada_may_take_only_some(register: DataRegister, shown: EventQueue) -> None:
    changes_to(register, 1, 2, 3)
    poll(register, 100, 1, source=SCADA)
    assert block_of(register) == [1, 2, 0, *entry(2, 2), *entry(3, 3)]


def test_scada_may_take_more_than_the_block_shows(register: DataRegister, shown: EventQueue) -> None:
    changes_to(register, 1, 2, 3, 4)
    poll(register, 100, 3, source=SCADA)
    assert block_of(register) == [3, 1, 0, *entry(4, 4), *NO_ENTRY]


@pytest.mark.parametrize("unknown", [0, 1, 5, 0xFFFF])
def test_a_number_that_does_not_wait_takes_nothing(register: DataRegister, shown: EventQueue, unknown: int) -> None:
    changes_to(register, 1, 2, 3)
    poll(register, 100, 1, source=SCADA)
    poll(register, 100, unknown, source=SCADA)
    assert block_of(register) == [unknown, 2, 0, *entry(2, 2), *entry(3, 3)]


def test_the_number_of_a_change_that_was_lost_takes_nothing(register: DataRegister, clock: JumpingClock) -> None:
    a_queue(register, clock, size=2, block=BLOCK)
    changes_to(register, 1, 2, 3)
    poll(register, 100, 3, source=SCADA)
    assert block_of(register) == [3, 2, 1, *entry(1, 1), *entry(2, 2)]


def test_room_made_by_scada_is_used_and_what_was_lost_stays_counted(
    register: DataRegister, clock: JumpingClock
) -> None:
    a_queue(register, clock, size=1, block=BLOCK)
    changes_to(register, 1, 2)
    poll(register, 100, 1, source=SCADA)
    poll(register, 10, 3)
    assert block_of(register) == [1, 1, 1, *entry(3, 3), *NO_ENTRY]


def test_scada_takes_over_modbus_with_functions_3_and_6(register: DataRegister, shown: EventQueue) -> None:
    server = Server(register, SCADA)
    changes_to(register, 1)
    assert asked(server, "03 00 64 00 0A") == (
        "03 14 00 00 00 01 00 00"  # acknowledged 0, 1 waits, 0 lost
        " 00 01 00 03 00 0A 00 01 01 8B CF E5 68 00"
    )
    assert asked(server, "06 00 64 00 01") == "06 00 64 00 01"
    assert asked(server, "03 00 64 00 0A") == "03 14 00 01" + " 00" * 18


@pytest.mark.parametrize("request_", ["10 00 64 00 01 02 00 01", "16 00 64 00 00 00 01"])
def test_scada_may_write_back_with_functions_16_and_22(
    register: DataRegister, shown: EventQueue, request_: str
) -> None:
    changes_to(register, 1)
    assert asked(Server(register, SCADA), request_)[0] in "1"
    assert shown.waiting == 0


def test_a_person_at_the_menu_acknowledges_as_scada_does(register: DataRegister, shown: EventQueue) -> None:
    changes_to(register, 1, 2)
    poll(register, 100, 1, source=MENU)
    assert block_of(register) == [1, 1, 0, *entry(2, 2), *NO_ENTRY]


@pytest.mark.parametrize("place", range(1, 17))
def test_what_is_written_to_the_rest_of_the_block_is_set_right(
    register: DataRegister, shown: EventQueue, place: int
) -> None:
    changes_to(register, 1, 2, 3)
    poll(register, 100, 1, source=SCADA)
    before = block_of(register)
    poll(register, 100 + place, 0xDEAD, source=SCADA)
    assert block_of(register) == before == [1, 2, 0, *entry(2, 2), *entry(3, 3)]


def test_a_write_over_the_whole_block_and_more_acknowledges_and_is_set_right(
    register: DataRegister, shown: EventQueue
) -> None:
    changes_to(register, 1, 2, 3)
    register.write(Span(HOLDING, 98, 21), words(7, 8, 2, *range(900, 916), 9, 10), SCADA)
    assert registers_of(register.read(Span(HOLDING, 98, 21))) == [
        *(7, 8),
        *(2, 1, 0, *entry(3, 3), *NO_ENTRY),
        *(9, 10),
    ]


def test_a_write_that_ends_before_the_block_or_in_another_table_acknowledges_nothing(
    register: DataRegister, shown: EventQueue
) -> None:
    changes_to(register, 1, 2)
    poll(register, 98, 1, 1, source=SCADA)
    poll(register, 117, 1, source=SCADA)
    poll(register, 100, 1, table=INPUTS, source=SCADA)
    assert block_of(register) == [0, 2, 0, *entry(1, 1), *entry(2, 2)]


def test_both_ways_take_from_one_queue(register: DataRegister, shown: EventQueue) -> None:
    changes_to(register, 1, 2, 3, 4, 5, 6, 7)
    poll(register, 100, 1, source=SCADA)
    assert shown.read_fifo(FIFO) == [6, 0, *entry(2, 2), *entry(3, 3), *entry(4, 4), *entry(5, 5)]
    assert block_of(register) == [1, 2, 0, *entry(6, 6), *entry(7, 7)]


def test_the_block_is_written_only_when_it_changes(register: DataRegister, clock: JumpingClock) -> None:
    a_queue(register, clock, size=1, block=BLOCK)
    changes_to(register, 1, 2)  # one change is lost already
    written: list[Span] = []
    register.watch(lambda told: written.append(told.span))
    poll(register, 10, 2)
    poll(register, 30, 2)
    poll(register, 10, 3)
    assert written == [Span(HOLDING, 10, 1), Span(HOLDING, 30, 1), Span(HOLDING, 10, 1), BLOCK]


def test_without_a_block_nothing_is_written(register: DataRegister, queue: EventQueue) -> None:
    written: list[Span] = []
    register.watch(lambda told: written.append(told.span))
    changes_to(register, 1)
    taken(queue)
    queue.acknowledge(1)
    assert written == [Span(HOLDING, 10, 1)] * 2
