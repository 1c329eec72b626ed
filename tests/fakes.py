"""Fakes that tests hand in: a clock that jumps, a link on which a scripted device answers, devices with registers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from gateway.config import MasterConfig
from gateway.errors import LinkError, LinkLost
from gateway.link import Link, Waker
from gateway.master import Master
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister, Quality, Source, SourceKind


class JumpingClock:
    """A clock that stands still until it is told otherwise."""

    def __init__(self, monotonic_s: float = 1000.0, wall_s: float = 1_700_000_000.0) -> None:
        self._monotonic_s = monotonic_s
        self._wall_s = wall_s

    def monotonic(self) -> float:
        return self._monotonic_s

    def wall(self) -> float:
        return self._wall_s

    def pass_s(self, seconds: float) -> None:
        self._monotonic_s += seconds
        self._wall_s += seconds

    def jump_wall(self, seconds: float) -> None:
        self._wall_s += seconds


@dataclass
class ScriptedLink:
    """A link whose other end is a function: it is given each frame written, and says what comes back, and when.

    device: frame -> list of (seconds after the frame, bytes). Reading advances the clock, to the next arrival or by
    the whole timeout: no test ever waits.
    """

    clock: JumpingClock
    device: Callable[[bytes], list[tuple[float, bytes]]]
    character_s: float = 0.0
    written: list[tuple[float, bytes]] = field(default_factory=list)
    arriving: list[tuple[float, bytes]] = field(default_factory=list)
    closed: bool = False

    def write(self, data: bytes) -> None:
        now_s = self.clock.monotonic()
        self.written.append((now_s, data))
        self.arriving += [(now_s + after_s, answer) for after_s, answer in self.device(data)]
        self.arriving.sort(key=lambda arrival: arrival[0])

    def read(self, timeout_s: float) -> bytes:
        now_s = self.clock.monotonic()
        if self.arriving and self.arriving[0][0] <= now_s + timeout_s:
            when_s, data = self.arriving.pop(0)
            self.clock.pass_s(max(0.0, when_s - now_s))
            return data
        self.clock.pass_s(timeout_s)
        return b""

    def discard(self) -> int:
        count = sum(len(data) for _, data in self.arriving)
        self.arriving.clear()
        return count

    def close(self) -> None:
        self.closed = True


class JumpingWaker(Waker):
    """A waker whose waits pass at once on the fake clock; it has no descriptor."""

    def __init__(self, clock: JumpingClock) -> None:
        self._clock = clock
        self.is_woken = self.ended = False
        self.wakes = 0
        self.waits_s: list[float] = []

    def wake(self) -> None:
        self.is_woken = True

    def fileno(self) -> int:
        return -1

    def clear(self) -> None:
        self.wakes += self.is_woken
        self.is_woken = False

    def wait(self, timeout_s: float | None) -> bool:
        assert timeout_s is not None
        self.waits_s.append(timeout_s)
        woken, self.is_woken = self.is_woken, False
        if not woken:
            self._clock.pass_s(timeout_s)
        return woken

    def close(self) -> None:
        self.is_woken = False


def crc_rtu(data: bytes) -> bytes:
    """The CRC of *data* as on the wire, bit by bit: independent of the table in ``framing``."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return bytes([crc & 0xFF, crc >> 8])


def rtu(unit: int, pdu: bytes) -> bytes:
    """An RTU frame."""
    return bytes([unit]) + pdu + crc_rtu(bytes([unit]) + pdu)


def ascii_frame(unit: int, pdu: bytes) -> bytes:
    """An ASCII frame."""
    body = bytes([unit]) + pdu
    return f":{body.hex().upper()}{-sum(body) & 0xFF:02X}\r\n".encode()


def tcp(transaction: int, unit: int, pdu: bytes) -> bytes:
    """A Modbus TCP frame."""
    return transaction.to_bytes(2, "big") + bytes(2) + (1 + len(pdu)).to_bytes(2, "big") + bytes([unit]) + pdu


def words(*values: int) -> bytes:
    """Registers as on the wire."""
    return b"".join(value.to_bytes(2, "big") for value in values)


@dataclass
class FieldWrite:
    """One write as a device got it; values are words, or 0 and 1."""

    when_s: float
    unit: int
    address: int
    values: list[int]


@dataclass
class FakeField:
    """All devices of one line, with registers and coils that keep what is written; the device of a ScriptedLink.

    Every unit exists and answers after *answer_after_s*, unless it is in *silent*, *damaging* (wrong CRC) or
    *refusing* (unit, function: exception code). *during* is called while a request is on its way, before it is
    carried out.
    """

    clock: JumpingClock
    framing: str = "rtu"
    answer_after_s: float = 0.01
    registers: dict[tuple[int, int], int] = field(default_factory=dict)  # unit, address: value
    coils: dict[tuple[int, int], int] = field(default_factory=dict)
    silent: set[int] = field(default_factory=set)
    damaging: set[int] = field(default_factory=set)
    refusing: dict[tuple[int, int], int] = field(default_factory=dict)
    during: Callable[[int, bytes], None] = lambda unit, pdu: None
    asked: list[tuple[float, int, bytes]] = field(default_factory=list)  # when, unit, PDU
    writes: list[FieldWrite] = field(default_factory=list)

    def __call__(self, frame: bytes) -> list[tuple[float, bytes]]:
        transaction = 0
        if self.framing == "tcp":
            transaction, unit, pdu = int.from_bytes(frame[:2], "big"), frame[6], frame[7:]
        else:
            assert crc_rtu(frame[:-2]) == frame[-2:]
            unit, pdu = frame[0], frame[1:-2]
        self.asked.append((self.clock.monotonic(), unit, pdu))
        self.during(unit, pdu)
        if unit in self.silent:
            return []
        reply = self.answer(unit, pdu)
        if unit == 0 and self.framing != "tcp":
            return []
        answer = tcp(transaction, unit, reply) if self.framing == "tcp" else rtu(unit, reply)
        if unit in self.damaging:
            answer = answer[:-1] + bytes([answer[-1] ^ 0xFF])
        return [(self.answer_after_s, answer)]

    def answer(self, unit: int, pdu: bytes) -> bytes:
        """Carry out *pdu*; return the PDU that answers it."""
        function, address, number = pdu[0], int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big")
        if (unit, function) in self.refusing:
            return bytes([function | 0x80, self.refusing[unit, function]])
        if function in (1, 2):
            bits = sum(self.coils.get((unit, address + i), 0) << i for i in range(number))
            data = bits.to_bytes((number + 7) // 8, "little")
            return bytes([function, len(data)]) + data
        if function in (3, 4):
            data = words(*(self.registers.get((unit, address + i), 0) for i in range(number)))
            return bytes([function, len(data)]) + data
        if function == 5:
            self._keep(self.coils, unit, address, [number >> 15])
        elif function == 6:
            self._keep(self.registers, unit, address, [number])
        elif function == 15:
            self._keep(self.coils, unit, address, [pdu[6 + i // 8] >> i % 8 & 1 for i in range(number)])
        else:
            values = [int.from_bytes(pdu[6 + 2 * i : 8 + 2 * i], "big") for i in range(number)]
            self._keep(self.registers, unit, address, values)
        return pdu[:5]

    def _keep(self, where: dict[tuple[int, int], int], unit: int, address: int, values: list[int]) -> None:
        self.writes.append(FieldWrite(self.clock.monotonic(), unit, address, values))
        where.update({(unit, address + i): value for i, value in enumerate(values)})

    def count(self, unit: int) -> int:
        """How many requests *unit* was sent."""
        return sum(asked == unit for _, asked, _ in self.asked)


SCADA = Source(SourceKind.CLIENT, "scada 10.0.0.5:40232")


class LosableLink(ScriptedLink):
    """A ScriptedLink that is lost, once, at the next read or write after *lose* is set.

    "idle": the other side has hung up, which even a read that does not wait finds out.
    """

    lose: str = ""  # "read", "write", "idle" or ""

    def _lose_at(self, what: str) -> None:
        if self.lose == what:
            self.lose = ""
            raise LinkLost("the port is gone")

    def write(self, data: bytes) -> None:
        self._lose_at("write")
        super().write(data)

    def read(self, timeout_s: float) -> bytes:
        self._lose_at("idle")
        if timeout_s > 0:
            self._lose_at("read")
        return super().read(timeout_s)


class MasterBench:
    """A master on a fake line with fake devices. *missing*: why the line cannot be opened, while it cannot."""

    def __init__(self, clock: JumpingClock, *requests: dict[str, Any], **line: Any) -> None:
        self.clock = clock
        self.register = DataRegister(clock)
        settings = {"name": "field", "line": "/dev/ttyS2", "baudrate": 19200, **line, "request": list(requests)}
        self.config = MasterConfig.model_validate(settings)
        self.field = FakeField(clock, self.config.framing_used)
        self.missing: LinkError | None = None
        self.links: list[LosableLink] = []
        self.opened_s: list[float] = []
        self.waker = JumpingWaker(clock)
        self.master = Master(self.config, self.register, clock, self.waker, self._open)

    def _open(self) -> Link:
        self.opened_s.append(self.clock.monotonic())
        if self.missing is not None:
            raise self.missing
        self.links.append(LosableLink(self.clock, self.field))
        return self.links[-1]

    @property
    def link(self) -> LosableLink:
        return self.links[-1]

    def run_s(self, seconds: float, meanwhile: Callable[[], None] = lambda: None) -> None:
        """Step for *seconds* of the fake clock; *meanwhile* before each step."""
        until_s = self.clock.monotonic() + seconds
        steps = 0
        while self.clock.monotonic() < until_s:
            meanwhile()
            self.master.step()
            steps += 1
            assert steps < 1000 + 2000 * seconds, "the master turns without waiting"

    def steps(self, count: int) -> None:
        for _ in range(count):
            self.master.step()

    def scada(self, start: int, *values: int, table: Table = Table.HOLDING_REGISTERS) -> None:
        """Write registers (or one coil a value, up to 8) as the upper side does."""
        data = bytes([sum(v << i for i, v in enumerate(values))]) if table.is_bits else words(*values)
        self.register.write(Span(table, start, len(values)), data, SCADA)

    def values(self, start: int, count: int = 1, table: Table = Table.HOLDING_REGISTERS) -> list[int]:
        return [sample.value for sample in self.register.samples(Span(table, start, count))]

    def qualities(self, start: int, count: int = 1, table: Table = Table.HOLDING_REGISTERS) -> set[Quality]:
        return {sample.quality for sample in self.register.samples(Span(table, start, count))}


def reads(unit: int, point: int, count: int = 1, **settings: Any) -> dict[str, Any]:
    """A request that reads *count* holding registers from address 0 of *unit* to *point*."""
    return {"unit": unit, "function": 3, "address": 0, "count": count, "point": point, **settings}


def writes(unit: int, point: int, count: int = 1, **settings: Any) -> dict[str, Any]:
    """A request that writes *count* holding registers from *point*, when changed, to address 0 of *unit*."""
    return {**reads(unit, point, count), "function": 16, "trigger": "change", **settings}
