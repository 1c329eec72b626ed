"""A server on a serial line, its counters, and requests and replies as a test writes them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from gateway.commands import CommandQueue, Outlet
from gateway.modbus.diagnostics import LineDiagnostics
from gateway.modbus.identification import Identity
from gateway.modbus.pdu import Span, Table
from gateway.modbus.server import Server, answer
from gateway.register import DataRegister, Sample, Source, SourceKind
from tests.fakes import SCADA, JumpingClock
from tests.modbus import wire

FIELD = Source(SourceKind.REQUEST, "field/boiler")
HOLDING = Table.HOLDING_REGISTERS

QUERY = "08 00 00 A5 37"
RESTART = "08 00 01 00 00"
RESTART_AND_CLEAR_LOG = "08 00 01 FF 00"
LISTEN_ONLY = "08 00 04 00 00"
CLEAR = "08 00 0A 00 00"
EVENT_COUNTER = "0B"
EVENT_LOG = "0C"

COUNTERS = {  # sub-function: the counter's name in the code, its name in appendix A
    0x0B: "bus_messages",  # CPT1
    0x0C: "bus_errors",  # CPT2
    0x0D: "exceptions",  # CPT3
    0x0E: "messages",  # CPT4
    0x0F: "unanswered",  # CPT5
    0x10: "naks",  # CPT6
    0x11: "busy",  # CPT7
    0x12: "overruns",  # CPT8
}
KNOWN_SUBS = [0, 1, 2, 4, *range(10, 19)]
REQUEST_OF_EACH = {
    1: "01 00 00 00 01",
    2: "02 00 00 00 01",
    3: "03 00 00 00 01",
    4: "04 00 00 00 01",
    5: "05 00 00 FF 00",
    6: "06 00 00 12 34",
    7: "07",
    8: QUERY,
    11: "0B",
    12: "0C",
    15: "0F 00 00 00 01 01 01",
    16: "10 00 00 00 01 02 12 34",
    17: "11",
    22: "16 00 00 00 00 12 34",
    23: "17 00 00 00 01 00 00 00 01 02 12 34",
    24: "18 00 00",
    43: "2B 0E 01 00",
    65: "41  # nobody knows it",
}


def a_server(register: DataRegister, line: LineDiagnostics) -> Server:
    """A server on a serial line whose 8 outputs are those of section 6.7's example."""
    identity = Identity("Acme", "GW-1", "2.11")
    return Server(register, SCADA, line=line, identity=identity, exception_status=lambda: 0b0110_1101)


def asked(server: Server, request: str, broadcast: bool = False) -> str:
    """The reply to *request*, both in hexadecimal; it was on the line like every message."""
    assert server.line is not None
    server.line.heard()
    return answer(wire(request), server, broadcast).hex(" ").upper()


def counter(server: Server, sub: int) -> int:
    """What sub-function *sub* tells; the request that asks counts itself."""
    reply = asked(server, f"08 00 {sub:02X} 00 00")
    assert reply.startswith(f"08 00 {sub:02X} ")
    return int(reply[9:].replace(" ", ""), 16)


def everything(register: DataRegister) -> list[list[Sample]]:
    """Value, quality, age and source of every point."""
    return [register.samples(Span(table, 0, register.size(table))) for table in Table]


@contextmanager
def no_room(server: Server, clock: JumpingClock) -> Iterator[Server]:
    """*server*, whose writes to holding register 0 find no room in the queue of commands meanwhile."""
    queue = CommandQueue(server.register, clock, wake=lambda: None, limit=0)
    queue.add(Outlet(Span(HOLDING, 0, 1), FIELD))
    yield server
    queue.close()
