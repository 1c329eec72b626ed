"""Points of a register as a poll, the upper side or a person writes them, and what a command queue makes of that."""

from __future__ import annotations

from gateway.commands import CommandQueue, Outlet
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister, Quality, Source, SourceKind
from tests.fakes import SCADA, words

POLL = Source(SourceKind.REQUEST, "field/boiler")
SETPOINT = Source(SourceKind.REQUEST, "field/setpoint")
MENU = Source(SourceKind.MENU, "console")
RETAINED = Source(SourceKind.RETAINED, "before the restart")


def holding(start: int, count: int = 1) -> Span:
    return Span(Table.HOLDING_REGISTERS, start, count)


def coils(start: int, count: int = 1) -> Span:
    return Span(Table.COILS, start, count)


def outlet(start: int, count: int = 1, **settings: object) -> Outlet:
    return Outlet(holding(start, count), SETPOINT, **settings)  # type: ignore[arg-type]


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
