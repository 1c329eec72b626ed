"""An event queue on a fake clock, and its entries as a test writes and reads them."""

from __future__ import annotations

from typing import Final

from gateway.events import EventQueue
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister, Source, SourceKind
from tests.fakes import JumpingClock, words

POLL = Source(SourceKind.REQUEST, "field/boiler")
MENU = Source(SourceKind.MENU, "console")
HOLDING, INPUTS = Table.HOLDING_REGISTERS, Table.INPUT_REGISTERS
COILS, DISCRETE = Table.COILS, Table.DISCRETE_INPUTS

WALL_S: Final = 1_700_000_000.0  # where the fake clock starts
#                 1 700 000 000 000 ms are 0x018B CFE5 6800
AT_START: Final = [0x018B, 0xCFE5, 0x6800]

FIFO: Final = 1246  # 0x04DE, the example of section 6.18
MARKED: Final = [Span(HOLDING, 10, 10), Span(INPUTS, 10, 10), Span(COILS, 10, 10), Span(DISCRETE, 10, 10)]
BLOCK: Final = Span(HOLDING, 100, 3 + 7 * 2)  # two entries
HEAD, ENTRY = 3, 7


def a_queue(
    register: DataRegister, clock: JumpingClock, size: int = 10_000, block: Span | None = None, fifo: int | None = FIFO
) -> EventQueue:
    return EventQueue(register, clock, MARKED, size, fifo, block)


def poll(register: DataRegister, start: int, *values: int, table: Table = HOLDING, source: Source = POLL) -> None:
    """Write as a master does; one value a point, up to 8 bits or any registers."""
    data = bytes([sum(value << i for i, value in enumerate(values))]) if table.is_bits else words(*values)
    register.write(Span(table, start, len(values)), data, source)


def changes_to(register: DataRegister, *values: int) -> None:
    """Holding register 10 is 0 at first, and then each of *values*."""
    for value in (0, *values):
        poll(register, 10, value)


def taken(queue: EventQueue) -> list[list[int]]:
    """All entries, taken out by function 24, which has to say rightly how many waited."""
    entries: list[list[int]] = []
    while (found := queue.read_fifo(FIFO)) is not None and len(found) > 2:
        assert len(found) == 2 + ENTRY * min(4, found[0])
        assert found[-ENTRY:] not in entries[-1:], "what was taken is still there"
        entries += entries_of(found[2:])
    return entries


def entries_of(registers: list[int]) -> list[list[int]]:
    assert len(registers) % ENTRY == 0
    return [registers[start : start + ENTRY] for start in range(0, len(registers), ENTRY)]


def registers_of(data: bytes) -> list[int]:
    return [high << 8 | low for high, low in zip(data[::2], data[1::2], strict=True)]


def block_of(register: DataRegister, block: Span = BLOCK) -> list[int]:
    """The block as SCADA reads it."""
    return registers_of(register.read(block))


def entry(sequence: int, value: int, point: int = 10) -> list[int]:
    """A change of a holding register at the clock's start."""
    return [sequence, 3, point, value, *AT_START]


NO_ENTRY: Final = [0] * ENTRY
