"""A Line on a scripted link: what it is asked, what comes back, and when."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import pytest

from gateway.modbus.pdu import ReadRequest
from gateway.transaction import Line, Response, Timing
from tests.fakes import JumpingClock, ScriptedLink, ascii_frame, rtu, tcp

Framing = Literal["rtu", "ascii", "tcp"]
Script = list[tuple[float, bytes]]

CHARACTER_S = 1 / 1024  # every time here is a sum of powers of two: compared to the last bit
SILENCE_S = 3.5 * CHARACTER_S
RTU_TIMES = Timing(2.5, 0.25, SILENCE_S, 0.0, 0.125, CHARACTER_S)
ASCII_TIMES = Timing(2.5, 1.0, SILENCE_S, 0.0, 0.125, CHARACTER_S)
TCP_TIMES = Timing(2.5, 0.25, 0.0, 0.0, 0.125, 0.0)
TIMES: dict[Framing, Timing] = {"rtu": RTU_TIMES, "ascii": ASCII_TIMES, "tcp": TCP_TIMES}

ASKED = bytes.fromhex("03 006B 0003")  # the example of specification 6.3: holding 108 to 110
ANSWER = bytes.fromhex("03 06 022B 0000 0064")  # 555, 0, 100
READ = ReadRequest(3, 0x6B, 3)
UNIT = 0x11


@dataclass
class Bench:
    """A line with a scripted device: each request is answered by the next script of *answers*, then by silence."""

    framing: Framing
    clock: JumpingClock
    answers: list[Callable[[int], Script] | Script]
    timing: Timing
    traffic: list[tuple[bool, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.link = ScriptedLink(self.clock, self._device, self.timing.character_s)
        self.line = Line(self.link, self.framing, self.timing, self.clock, self._note)

    def _note(self, sent: bool, data: bytes) -> None:
        self.traffic.append((sent, data))

    def _device(self, frame: bytes) -> Script:
        script = self.answers.pop(0) if self.answers else []
        after_s = len(frame) * self.timing.character_s
        transaction = int.from_bytes(frame[:2], "big")
        return [(after_s + at_s, data) for at_s, data in (script(transaction) if callable(script) else script)]

    def result(self, limit_s: float = 60.0) -> Response:
        """Wait for what becomes of the request."""
        until_s = self.clock.monotonic() + limit_s
        while self.clock.monotonic() < until_s:
            if (response := self.line.advance(1.0)) is not None:
                return response
        raise AssertionError(f"nothing has become of the request in {limit_s} s")

    def ask(self, unit: int = UNIT) -> Response:
        """Read the three registers."""
        assert self.line.send(unit, READ)
        return self.result()

    @property
    def sent_s(self) -> list[float]:
        return [when_s for when_s, _ in self.link.written]


def bench(
    clock: JumpingClock, framing: Framing, *answers: Callable[[int], Script] | Script, timing: Timing | None = None
) -> Bench:
    return Bench(framing, clock, list(answers), timing or TIMES[framing])


def framed(framing: Framing, unit: int, pdu: bytes, transaction: int) -> bytes:
    if framing == "tcp":
        return tcp(transaction, unit, pdu)
    return rtu(unit, pdu) if framing == "rtu" else ascii_frame(unit, pdu)


def reply(framing: Framing, pdu: bytes = ANSWER, unit: int = UNIT, at_s: float = 0.5) -> Callable[[int], Script]:
    return lambda transaction: [(at_s, framed(framing, unit, pdu, transaction))]


FRAMINGS = pytest.mark.parametrize("framing", ["rtu", "ascii", "tcp"])
SERIAL = pytest.mark.parametrize("framing", ["rtu", "ascii"])


def wrong_sum(frame: bytes, framing: Framing) -> bytes:
    if framing == "ascii":
        return frame[:-3] + (b"0" if frame[-3:-2] != b"0" else b"1") + frame[-2:]
    return frame[:-1] + bytes([frame[-1] ^ 0x01])
