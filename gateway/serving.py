"""What the serial and the TCP slave share: what they serve, and how they count what they hear.

It waits for nothing and opens nothing. Source: spec section 3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gateway.config import SlaveConfig
from gateway.modbus.diagnostics import LineDiagnostics
from gateway.modbus.framing import Frame, Framer
from gateway.modbus.identification import Identity
from gateway.modbus.server import Server
from gateway.register import DataRegister, Source, SourceKind


@dataclass(frozen=True)
class Station:
    """What a slave serves beside the register: who the station is, how it fares, its event queue (see ``Server``)."""

    identity: Identity = field(default_factory=Identity)
    exception_status: Callable[[], int] = lambda: 0
    read_fifo: Callable[[int], list[int] | None] = lambda address: None  # noqa: ARG005 - there is no queue


STATION_ALONE: Final = Station()


def server_of(config: SlaveConfig, register: DataRegister, station: Station) -> Server:
    """Return what the slave of *config* serves; each TCP client gets a copy with its own source."""
    return Server(
        register,
        Source(SourceKind.CLIENT, config.name),
        config.writable,
        config.stale,
        config.function_codes,
        config.first,
        config.count,
        identity=station.identity,
        line=None if config.framing_used == "tcp" else LineDiagnostics(),
        exception_status=station.exception_status,
        read_fifo=station.read_fifo,
    )


def count_traffic(server: Server, frames: list[Frame], damaged: int) -> None:
    """Tell the serial line's counters of *frames* for whomever, and of *damaged* ones."""
    if server.line is not None:
        for _ in frames:
            server.line.heard()
        for _ in range(damaged):
            server.line.heard_damaged()


def frames_in(framer: Framer) -> list[Frame]:
    """Return all whole frames that *framer* holds."""
    frames = []
    while (frame := framer.next_frame()) is not None:
        frames.append(frame)
    return frames
