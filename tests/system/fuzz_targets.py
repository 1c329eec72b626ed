"""What is fuzzed: every framing in both directions, what a slave answers, how a master reads a reply, and telnet.

An input is what one read of a line brings, or one PDU. Several make a stream, in one ``Ear``, because what came before
matters; ``take`` and ``finish`` assert what must hold whatever comes. Where a checksum would hide everything behind it
from the fuzzer, ``seal`` puts the right one on.

Two ways to feed them, each in a process of its own, with a JSON object of figures as its last line:

    guided   atheris chooses the inputs by the branches they reach; slow
    fast     seeded mutations of valid frames, in a tight loop: what a run found, the same arguments find again

    python -m tests.system.fuzz_targets TARGET INPUTS [SEED]     runs the fast way; ``test_fuzz`` tells how to guide
"""

from __future__ import annotations

import gc
import json
import os
import random
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol

from gateway.commands import CommandQueue, Outlet
from gateway.errors import DeviceRefused, ReplyMismatch
from gateway.events import EventQueue
from gateway.modbus.diagnostics import LineDiagnostics
from gateway.modbus.framing import Frame, Framer, Framing, reply_framer, request_framer
from gateway.modbus.identification import Identity
from gateway.modbus.pdu import (
    AnyRequest,
    MaskWriteRequest,
    PlainRequest,
    ReadRequest,
    ReadWriteRequest,
    Span,
    Table,
    WriteRequest,
    decode_reply,
    encode_request,
)
from gateway.modbus.server import Server, answer
from gateway.register import DataRegister, Quality, Source, SourceKind
from tests.fakes import JumpingClock
from tests.system.fuzz_telnet import TELNET_BODIES, TelnetEar

SLOW_S = 0.010  # no input takes longer
TRIES = 9  # a machine that does something else makes an input slow once, but not so often again
READ_MAX = 8192  # bytes that one read of a line brings at most
STREAM = 32  # inputs that one ear hears, in the fast way
STEPS_MAX = 16  # the same, in one guided input
WARM_UP = 0.25  # the share of a run after which memory must not grow any more
HELD_MAX = {"rtu request": 4096, "rtu reply": 256, "ascii": 513, "tcp": 260}  # bytes; the frames' own limits
UNIT, FUNCTION = 1, 3  # whose reply a master's ear waits for
SEALED = 0x80  # bit of a guided step: its bytes get a right checksum

Step = tuple[int, bytes]  # how, 0 to 255, and what is taken


class Ear(Protocol):
    """What takes the inputs of one stream."""

    def take(self, how: int, data: bytes) -> None:
        """Take one input; *how*, 0 to 255, chooses among what may happen beside it. Asserts what must hold."""
        ...

    def finish(self) -> None:
        """Assert what must hold after any stream."""
        ...


@dataclass(frozen=True)
class Target:
    """*begin* gives a fresh ear; *bodies* are valid messages; *seal* makes of one what the ear takes."""

    begin: Callable[[], Ear]
    bodies: Sequence[bytes]
    seal: Callable[[bytes], bytes]


# ------------------------------------------------------------------------------------------------ framers


class FramerEar:
    """A framer; what it gives must have stood on the line, in this order, each byte used once."""

    def __init__(self, framer: Framer, held_max: int, last: Frame) -> None:
        """*last*: what must be heard after any stream."""
        self._framer, self._held_max, self._last = framer, held_max, last
        self._line = bytearray()  # all that came since the last reset
        self._framer.expect(last.unit, last.pdu[0])

    def take(self, how: int, data: bytes) -> None:
        self._framer.receive_data(data)
        self._line += data
        self._drain()
        if how & 3:
            self._framer.silence()
            self._drain()
        if how & 28 == 28:
            self._start_anew()
        assert self._framer.pending <= self._held_max

    def finish(self) -> None:
        self._start_anew()
        if not self._framer.broken:
            data = self._framer.encode(self._last)
            self._framer.receive_data(data)
            self._line += data
            heard = self._drain()
            self._framer.silence()
            assert heard + self._drain() == [self._last]
            assert self._framer.pending == 0

    def _start_anew(self) -> None:
        self._framer.reset()
        self._framer.expect(self._last.unit, self._last.pdu[0])
        self._line.clear()

    def _drain(self) -> list[Frame]:
        frames = []
        while (frame := self._framer.next_frame()) is not None:
            frames.append(frame)
            encoded = self._framer.encode(frame)
            place = self._line.find(encoded)
            if place < 0:  # ASCII allows small letters
                place = self._line.upper().find(encoded)
            assert place >= 0, f"{encoded.hex()} never was on the line"
            del self._line[: place + len(encoded)]
        return frames


def framer_target(framing: Framing, is_reply: bool, bodies: Sequence[bytes]) -> Target:
    held_max = HELD_MAX.get(f"{framing} {'reply' if is_reply else 'request'}") or HELD_MAX[framing]
    last = Frame(UNIT, bytes([FUNCTION, 2, 0, 7]) if is_reply else bytes([FUNCTION, 0, 7, 0, 1]))
    encode = request_framer(framing).encode

    def begin() -> Ear:
        return FramerEar(reply_framer(framing) if is_reply else request_framer(framing), held_max, last)

    return Target(begin, bodies, lambda body: encode(Frame(body[0], body[1:])) if body else b"")


# ------------------------------------------------------------------------------------------------ what a slave answers


CLIENT = Source(SourceKind.CLIENT, "a client")
REQUEST = Source(SourceKind.REQUEST, "field/boiler")
EVENTS_MAX = 8
COMMANDS_MAX = 5
FIFO_POINT, BLOCK = 900, Span(Table.HOLDING_REGISTERS, 500, 3 + 7 * 10)
WRITTEN = (Table.COILS, Table.HOLDING_REGISTERS)
READING = {1, 2, 3, 4, 24, 43}  # of no use to everybody at once
REFUSALS = {1, 2, 3, 4, 6, 11}


class AnswerEar:
    """Two slaves with all there is to switch on, on one register with events, commands and points that grow old."""

    def __init__(self) -> None:
        self._clock = JumpingClock()
        self._register = DataRegister(self._clock, dict.fromkeys(Table, 2000))
        watched = [Span(Table.COILS, 0, 2000), Span(Table.HOLDING_REGISTERS, 0, 100)]
        self._events = EventQueue(self._register, self._clock, watched, EVENTS_MAX, FIFO_POINT, BLOCK)
        self._queue = CommandQueue(self._register, self._clock, lambda: None, limit=COMMANDS_MAX)
        for table in WRITTEN:
            self._queue.add(Outlet(Span(table, 20, 50), REQUEST))
        polled = Span(Table.HOLDING_REGISTERS, 80, 10)
        self._register.claim(polled, REQUEST, 1.0)
        self._register.write(polled, bytes(polled.size), REQUEST, Quality.GOOD)
        self.line = LineDiagnostics()
        identity, fifo = Identity("a maker", "a product " * 20, "1.0"), self._events.read_fifo
        serial = Server(
            self._register, CLIENT, stale="exception", line=self.line, identity=identity, read_fifo=fifo,
            exception_status=lambda: 0x55,
        )  # fmt: skip
        network = Server(self._register, CLIENT, first=5, count=600, identity=identity, read_fifo=fifo)
        self._servers = [serial, serial, serial, network]

    def take(self, how: int, data: bytes) -> None:
        if not data:
            return  # no framing has an empty PDU
        server = self._servers[how & 3]
        self._clock.pass_s(0.05)
        before = self._values()
        is_broadcast = server.line is not None and how & 28 == 28
        reply = answer(data[:253], server, is_broadcast)
        if reply:
            self._judge(data, reply)
        else:
            is_unseen = is_broadcast and data[0] in READING
            assert is_unseen or (server.line and (self.line.listen_only or data[:3] == b"\x08\x00\x01"))
        if not reply or reply[0] & 0x80:
            assert self._values() == before, "a request that was not carried out changed something"
        assert len(self.line.log) <= 64
        assert self._events.waiting <= EVENTS_MAX
        assert len(self._queue) <= COMMANDS_MAX + 1  # a command taken over stays until its room is needed

    def finish(self) -> None:
        server = self._servers[-1]  # no message makes a slave on the network deaf
        assert answer(b"\x03\x00\x64\x00\x01", server)[:2] == b"\x03\x02"

    @staticmethod
    def _judge(request: bytes, reply: bytes) -> None:
        if reply[0] & 0x80:
            assert reply[0] == request[0] | 0x80
            assert reply[1] in REFUSALS
            assert len(reply) == 2
            return
        assert reply[0] == request[0]
        assert len(reply) <= 253
        if reply[0] in (1, 2, 3, 4, 12, 17, 23):
            assert reply[1] == len(reply) - 2
        elif reply[0] in (5, 6, 15, 16, 22):
            assert reply == request[: 7 if reply[0] == 22 else 5]

    def _values(self) -> list[bytes]:
        with self._register.lock:
            return [bytes(self._register.points_locked(table).values) for table in WRITTEN]


# ------------------------------------------------------------------------------------------------ how a reply is read


def all_requests(rng: random.Random, count: int) -> list[AnyRequest]:
    """*count* requests of every kind in turn, most of them small."""
    found: list[AnyRequest] = []
    for number in range(count):
        quantity = rng.choice([1, 2, 3, 7, 8, 9]) if number % 50 else 120
        address = rng.choice([0, 1, 20, 80, 99, 500, 900, 65400])
        words = rng.randbytes(2 * quantity)
        bits = rng.randbytes((quantity + 7) // 8)
        sub = rng.choice([0, 1, 2, 4, 10, 11, 12, 13, 14, 15, 16, 17, 18]).to_bytes(2, "big")
        identify = bytes([14, rng.randint(1, 4), rng.choice([0, 0, 1, 4])])
        kinds: list[AnyRequest] = [
            *(ReadRequest(function, address, quantity) for function in (1, 2, 3, 4)),
            WriteRequest(5, address, 1, rng.choice([b"\0", b"\1"])),
            WriteRequest(6, address, 1, words[:2]),
            WriteRequest(15, address, quantity, bits),
            WriteRequest(16, address, quantity, words),
            MaskWriteRequest(address, rng.randrange(65536), rng.randrange(65536)),
            ReadWriteRequest(address, 2, rng.choice([0, 30, 90]), quantity, words),
            *(PlainRequest(function) for function in (7, 11, 12, 17)),
            PlainRequest(8, sub + rng.choice([b"\0\0", b"\xff\0"])),
            PlainRequest(24, rng.choice([b"\x03\x84", b"\0\0"])),
            PlainRequest(43, identify),
        ]
        found.append(kinds[number % len(kinds)])
    return found


SEEDS = random.Random(6)
REQUESTS = all_requests(SEEDS, 256)


def true_reply(request: AnyRequest, rng: random.Random) -> bytes:
    """A reply that answers *request*."""
    function = bytes([request.function])
    match request:
        case ReadRequest() | ReadWriteRequest():
            size = (request.quantity + 7) // 8 if request.function <= 2 else 2 * request.quantity
            return function + bytes([size]) + rng.randbytes(size)
        case PlainRequest(function=12) | PlainRequest(function=17):
            return function + b"\x08" + rng.randbytes(8)
        case PlainRequest(function=24):
            return function + b"\x00\x06\x00\x02" + rng.randbytes(4)
        case PlainRequest(function=43):
            return function + request.body[:2] + b"\x82\x00\x00\x02\x00\x03abc\x01\x01d"
        case PlainRequest(function=7):
            return function + b"\x55"
        case PlainRequest(function=11):
            return function + b"\x00\x00\x00\x05"
        case _:
            return encode_request(request)[: 7 if request.function == 22 else 5]


ALIKE = {asked.function: [other for other in REQUESTS if other.function == asked.function] for asked in REQUESTS}


def brought(request: AnyRequest, data: bytes) -> bytes | int | None:
    """Return the data that *data* brings, the exception it tells, or None if it answers another question."""
    try:
        return decode_reply(request, data)
    except DeviceRefused as refused:
        return refused.code
    except ReplyMismatch:
        return None


class ReplyEar:
    """What a master makes of a PDU as the answer to a request, mostly one of its function."""

    def take(self, how: int, data: bytes) -> None:
        alike = ALIKE.get(data[0] & 0x7F) if data and how & 3 else None
        request = alike[how % len(alike)] if alike else REQUESTS[how]
        match brought(request, data):
            case None:
                pass
            case int(code):
                assert code
                assert data == bytes([request.function | 0x80, code])
            case found if isinstance(request, ReadRequest | ReadWriteRequest):
                size = (request.quantity + 7) // 8 if request.function <= 2 else 2 * request.quantity
                assert data[:2] == bytes([request.function, size])
                assert len(found) == size == len(data) - 2
            case found:
                assert data[0] == request.function
                assert found == (data[1:] if isinstance(request, PlainRequest) else b"")

    def finish(self) -> None:
        """Nothing is kept from one reply to the next."""


# ------------------------------------------------------------------------------------------------ the targets


def requests_of_units() -> list[bytes]:
    """Requests of every kind, the largest there are, and the acknowledgements that empty the event queue."""
    largest: list[AnyRequest] = [
        WriteRequest(15, 0, 1968, SEEDS.randbytes(246)),
        WriteRequest(16, 20, 123, SEEDS.randbytes(246)),
        ReadWriteRequest(0, 125, 20, 121, SEEDS.randbytes(242)),
        ReadRequest(1, 0, 2000),
    ]
    taken = [WriteRequest(6, BLOCK.start, 1, bytes([0, sequence])) for sequence in range(1, EVENTS_MAX + 1)]
    asked = enumerate([*REQUESTS, *largest, *taken])
    return [bytes([number % 5 and UNIT]) + encode_request(request) for number, request in asked]


def replies_of_units() -> list[bytes]:
    """Half of them from the awaited unit to its function."""
    awaited = [ReadRequest(FUNCTION, 0, quantity) for quantity in (1, 2, 3, 5, 120)]
    asked = [request for pair in zip(REQUESTS, awaited * len(REQUESTS), strict=False) for request in pair]
    replies = [true_reply(request, SEEDS) for request in asked] + [b"\x83\x02", b"\x83\x0b"]
    return [bytes([1 + (number % 7 == 0)]) + reply for number, reply in enumerate(replies)]


HEARD, SAID = requests_of_units(), replies_of_units()
TARGETS: dict[str, Target] = {
    "rtu_slave": framer_target("rtu", False, HEARD + SAID[:64]),  # it hears what others say on its wires
    "rtu_master": framer_target("rtu", True, SAID + HEARD[:64]),
    "ascii_slave": framer_target("ascii", False, HEARD),
    "ascii_master": framer_target("ascii", True, SAID),
    "tcp": framer_target("tcp", False, HEARD + SAID),  # both directions: one class, and nothing that tells them apart
    "answer": Target(AnswerEar, [body[1:] for body in HEARD], bytes),
    "reply": Target(ReplyEar, [body[1:] for body in SAID], bytes),
    "telnet": Target(TelnetEar, TELNET_BODIES, bytes),
}


# ------------------------------------------------------------------------------------------------ how they are fed


@dataclass
class Figures:
    """What came of a run; memory after warm-up and at the end: the process in KiB, and Python's blocks of memory."""

    inputs: int = 0
    slowest_ms: float = 0.0
    seconds: float = 0.0
    rss_kib: list[int] = field(default_factory=list)
    blocks: list[int] = field(default_factory=list)
    repeats: int = 0  # how often a stream that seemed slower than all before was measured again

    def look_at_memory(self) -> None:
        """Note what is held now; what only waits for the garbage collector is not held."""
        gc.collect()
        status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
        self.rss_kib.append(int(status["VmRSS"].split()[0]))
        self.blocks.append(sys.getallocatedblocks())

    def print(self) -> None:
        print(json.dumps({**vars(self), "slowest_ms": round(self.slowest_ms, 3), "seconds": round(self.seconds, 1)}))


def longest_s(target: Target, stream: Sequence[Step]) -> float:
    """Feed a fresh ear; return how long the slowest input took."""
    ear, longest = target.begin(), 0.0
    for how, data in stream:
        began_s = perf_counter()
        ear.take(how, data)
        longest = max(longest, perf_counter() - began_s)
    ear.finish()
    return longest


def feed(target: Target, stream: Sequence[Step], figures: Figures) -> None:
    """Feed *stream* to a fresh ear, again where it was slow; AssertionError with the stream if anything is wrong."""
    try:
        took_s = longest_s(target, stream)
        for _ in range(TRIES):
            if 1000 * took_s <= figures.slowest_ms:
                break
            took_s = min(took_s, longest_s(target, stream))  # or was it the machine that did something else?
            figures.repeats += 1
        assert took_s <= SLOW_S, f"an input took {1000 * took_s:.1f} ms"
    except Exception as error:  # whatever it is, it is what was looked for
        shown = [f"({how}, bytes.fromhex({data.hex()!r}))" for how, data in stream]
        raise AssertionError(f"{type(error).__name__}: {error}, from\n[{', '.join(shown)}]") from error
    figures.slowest_ms = max(figures.slowest_ms, 1000 * took_s)


def mutations(target: Target, rng: random.Random, count: int) -> Iterator[Step]:
    """*count* inputs: valid ones, and ones with something wrong, most of them short."""
    bodies, seal = target.bodies, target.seal
    wires = [seal(body) for body in bodies]
    one = [bytes([value]) for value in range(256)]
    for which, kind, how, value, place in struct.iter_unpack("<HBBBB", rng.randbytes(6 * count)):
        body, wire = bodies[which % len(bodies)], wires[which % len(wires)]
        at = place % len(wire)
        match kind & 7:
            case 0 | 1:
                yield how, wire
            case 2:
                yield how, wire[:at] + one[value] + wire[at + 1 :]
            case 3:  # a byte changed, and the checksum right
                at = place % len(body)
                yield how, seal(body[:at] + one[value] + body[at + 1 :])
            case 4:  # cut short; once in a while the end of it instead, so that pieces meet
                yield how, wire[at:] if value & 1 else wire[:at]
            case 5:
                yield how, wire + wires[(which + value) % len(wires)]
            case 6:  # noise before it
                yield how, struct.pack("<HB", which, value)[: 1 + place % 3] + wire
            case _ if value == 0 and place < 64:  # as much as a read brings, of the same message or few bytes
                yield how, ((wire if place & 8 else wire[: 1 + place % 7]) * READ_MAX)[: READ_MAX >> which % 5]
            case _:
                yield how, struct.pack("<HHBB", which, which ^ 0x0103, value, place)[: 1 + place % 6]


def run_fast(name: str, inputs: int, seed: int) -> Figures:
    """Feed *inputs* seeded mutations to the target *name*."""
    target, rng, figures = TARGETS[name], random.Random(f"{name} {seed}"), Figures()
    began_s, bulk = perf_counter(), 1024 * STREAM
    while figures.inputs < inputs:
        steps = mutations(target, rng, bulk)
        for _ in range(bulk // STREAM):
            feed(target, [next(steps) for _ in range(STREAM)], figures)
        figures.inputs += bulk
        gc.collect()  # ears are circles of references
        if not figures.rss_kib and figures.inputs >= WARM_UP * inputs:
            figures.look_at_memory()
    figures.look_at_memory()
    figures.seconds = perf_counter() - began_s
    return figures


def steps_in(data: bytes, seal: Callable[[bytes], bytes]) -> list[Step]:
    """Return the stream that a guided input describes: how, size, bytes; how, size, bytes; ..."""
    steps: list[Step] = []
    while len(data) >= 2 and len(steps) < STEPS_MAX:
        how, chunk = data[0], data[2 : 2 + data[1]]
        steps.append((how & ~SEALED, seal(chunk[:254]) if how & SEALED and len(chunk) > 1 else chunk))
        data = data[2 + data[1] :]
    return steps


def write_corpus(target: Target, where: Path) -> None:
    """Write what atheris begins with: one sealed message a file."""
    for number, body in enumerate(target.bodies):
        (where / f"{number:04}").write_bytes(bytes([SEALED | number % SEALED, len(body)]) + body)


def run_guided(atheris: Any, name: str, seconds: float, corpus: str) -> None:
    """Let *atheris* feed the target *name*; print figures and end the process after *seconds*."""
    target, figures, began_s = TARGETS[name], Figures(), perf_counter()
    write_corpus(target, Path(corpus))

    def one_input(data: bytes) -> None:
        feed(target, steps_in(data, target.seal), figures)
        figures.inputs += 1
        figures.seconds = perf_counter() - began_s
        if not figures.rss_kib and figures.seconds >= WARM_UP * seconds:
            figures.look_at_memory()
        if figures.seconds >= seconds:
            figures.look_at_memory()
            figures.print()
            sys.stdout.flush()
            os._exit(0)  # atheris has no other end without a finding

    atheris.Setup([name, "-max_len=1024", "-verbosity=0", f"-artifact_prefix={corpus}-", corpus], one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    run_fast(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 1).print()
