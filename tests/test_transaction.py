"""One request and its reply on a line: whatever comes back, there is never a wrong value, and never a wait for ever."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import Literal

import pytest

from gateway.clock import SystemClock
from gateway.errors import LinkLost, RequestInvalid
from gateway.modbus.pdu import MaskWriteRequest, ReadRequest, WriteRequest
from gateway.transaction import DAMAGED, NEXT, NO_ERROR, TIMEOUT, Event, Line, Response, State, Timing
from tests.fakes import JumpingClock, ScriptedLink, ascii_frame, rtu, tcp, words

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


# ------------------------------------------------------------------------------------------------ what is asked


CALLS: dict[str, tuple[Callable[[Line], bool], str]] = {
    "read coils": (lambda line: line.read_coils(UNIT, 0x13, 0x13), "01 0013 0013"),
    "read discrete inputs": (lambda line: line.read_discrete_inputs(UNIT, 0xC4, 0x16), "02 00C4 0016"),
    "read holding registers": (lambda line: line.read_holding_registers(UNIT, 0x6B, 3), "03 006B 0003"),
    "read input registers": (lambda line: line.read_input_registers(UNIT, 8, 1), "04 0008 0001"),
    "write single coil on": (lambda line: line.write_single_coil(UNIT, 0xAC, True), "05 00AC FF00"),
    "write single coil off": (lambda line: line.write_single_coil(UNIT, 0xAC, False), "05 00AC 0000"),
    "write single register": (lambda line: line.write_single_register(UNIT, 1, 3), "06 0001 0003"),
    "write multiple coils": (
        lambda line: line.write_multiple_coils(UNIT, 0x13, [True, False, True, True, False, False, True, True, True]),
        "0F 0013 0009 02 CD01",
    ),
    "write multiple registers": (
        lambda line: line.write_multiple_registers(UNIT, 1, [0x0A, 0x102]),
        "10 0001 0002 04 000A 0102",
    ),
}


@FRAMINGS
@pytest.mark.parametrize("call", CALLS)
def test_each_call_puts_its_request_on_the_wire(clock: JumpingClock, framing: Framing, call: str) -> None:
    ask, pdu = CALLS[call]
    it = bench(clock, framing)
    assert ask(it.line) is True
    assert it.link.written == [(1000.0, framed(framing, UNIT, bytes.fromhex(pdu), 1))]
    assert it.traffic == [(True, it.link.written[0][1])]


@FRAMINGS
def test_the_reply_to_a_read_gives_its_values(clock: JumpingClock, framing: Framing) -> None:
    response = bench(clock, framing, reply(framing)).ask()
    assert (response.unit, response.function, response.error_code, response.has_error()) == (UNIT, 3, NO_ERROR, False)
    assert [response.register(i) for i in range(3)] == [555, 0, 100]
    assert (response.reply_s, response.reason) == (0.5, "")


@FRAMINGS
def test_the_reply_to_a_write_has_no_values(clock: JumpingClock, framing: Framing) -> None:
    it = bench(clock, framing, reply(framing, bytes.fromhex("06 0001 0003")))
    assert it.line.write_single_register(UNIT, 1, 3)
    response = it.result()
    assert (response.has_error(), response.data) == (False, b"")


@FRAMINGS
@pytest.mark.parametrize("code", [1, 2, 3, 4, 11, 255])
def test_an_exception_of_the_device_is_an_error_with_its_code(clock: JumpingClock, framing: Framing, code: int) -> None:
    response = bench(clock, framing, reply(framing, bytes([0x83, code]))).ask()
    assert (response.has_error(), response.error_code, response.data) == (True, code, b"")
    assert response.reason == f"the device answered with exception {code}"


def test_a_response_counts_registers_and_bits_from_0_and_knows_its_end() -> None:
    registers = Response(UNIT, 3, NO_ERROR, words(555, 0, 100))
    assert [registers.register(i) for i in range(3)] == [555, 0, 100]
    bits = Response(UNIT, 1, NO_ERROR, b"\xcd\x01")
    assert [i for i in range(16) if bits.is_coil_set(i)] == [0, 2, 3, 6, 7, 8]
    assert [i for i in range(16) if bits.is_discrete_input_set(i)] == [0, 2, 3, 6, 7, 8]
    for index in (-1, 3, 1000):
        with pytest.raises(IndexError):
            registers.register(index)
    for index in (-1, 16):
        with pytest.raises(IndexError):
            bits.is_coil_set(index)
        with pytest.raises(IndexError):
            bits.is_discrete_input_set(index)


def test_a_response_with_an_error_has_no_values() -> None:
    response = Response(UNIT, 3, TIMEOUT)
    with pytest.raises(IndexError):
        response.register(0)
    with pytest.raises(IndexError):
        response.is_coil_set(0)


INVALID: dict[str, Callable[[Line], bool]] = {
    "no coils": lambda line: line.read_coils(UNIT, 0, 0),
    "2001 coils": lambda line: line.read_coils(UNIT, 0, 2001),
    "126 registers": lambda line: line.read_holding_registers(UNIT, 0, 126),
    "beyond 65535": lambda line: line.read_input_registers(UNIT, 65535, 2),
    "address 65536": lambda line: line.read_discrete_inputs(UNIT, 65536, 1),
    "value 65536": lambda line: line.write_single_register(UNIT, 0, 65536),
    "value -1": lambda line: line.write_multiple_registers(UNIT, 0, [5, -1]),
    "124 values": lambda line: line.write_multiple_registers(UNIT, 0, [1] * 124),
    "no values": lambda line: line.write_multiple_coils(UNIT, 0, []),
    "unit 256": lambda line: line.read_coils(256, 0, 1),
    "unit -1": lambda line: line.read_coils(-1, 0, 1),
    "broadcast read": lambda line: line.read_coils(0, 0, 1),
}


@pytest.mark.parametrize("call", INVALID)
def test_an_invalid_request_is_refused_and_nothing_is_sent(clock: JumpingClock, call: str) -> None:
    it = bench(clock, "rtu", reply("rtu"))
    with pytest.raises(RequestInvalid):
        INVALID[call](it.line)
    assert it.link.written == []
    assert it.ask().data == words(555, 0, 100)  # and the line is free


# ------------------------------------------------------------------------------------------------ one at a time


@FRAMINGS
def test_while_a_request_is_pending_another_is_not_taken(clock: JumpingClock, framing: Framing) -> None:
    it = bench(clock, framing, reply(framing))
    assert it.line.is_free
    assert it.line.send(UNIT, READ) is True
    assert not it.line.is_free
    assert it.line.read_coils(UNIT, 0, 1) is False
    assert it.result().data == words(555, 0, 100)
    assert len(it.link.written) == 1
    assert it.line.is_free


def test_a_program_that_looks_but_never_waits_gets_its_answer(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", reply("rtu", at_s=0.5))
    assert it.line.available() is None
    it.line.read_holding_registers(UNIT, 0x6B, 3)
    looks = 0
    while (response := it.line.available()) is None:
        before_s = clock.monotonic()
        it.line.available()
        assert clock.monotonic() == before_s
        clock.pass_s(1 / 64)
        looks += 1
    assert response.data == words(555, 0, 100)
    assert looks > 10
    assert it.line.available() is None  # once


@FRAMINGS
def test_an_answer_that_came_in_time_counts_however_late_it_is_looked_for(
    clock: JumpingClock, framing: Framing
) -> None:
    it = bench(clock, framing, reply(framing))
    it.line.send(UNIT, READ)
    clock.pass_s(3600.0)
    it.line.available()
    clock.pass_s(1.0)
    response = it.line.available() if framing != "tcp" else Response(UNIT, 3, NO_ERROR, words(555, 0, 100))
    assert response is not None
    assert response.data == words(555, 0, 100)


@SERIAL
def test_a_late_answer_that_nobody_looked_for_does_not_answer_the_next_request(
    clock: JumpingClock, framing: Framing
) -> None:
    old = ANSWER.replace(b"\x02\x2b", b"\x09\x09")
    it = bench(clock, framing, reply(framing, old, at_s=4.0), reply(framing))
    assert it.ask().error_code == TIMEOUT
    clock.pass_s(3600.0)  # the late answer now lies in the port's buffer
    it.line.send(UNIT, READ)
    assert it.result().data == words(555, 0, 100)


def test_a_link_that_is_lost_says_so(clock: JumpingClock) -> None:
    it = bench(clock, "tcp", [(0.5, b"\x00\x01\x00\x00\xff\xff\x11\x03")])  # length 65535
    it.line.send(UNIT, READ)
    with pytest.raises(LinkLost):
        it.result()


def test_nonsense_on_an_idle_tcp_connection_is_a_lost_link(clock: JumpingClock) -> None:
    it = bench(clock, "tcp", reply("tcp"))
    it.ask()
    it.link.arriving.append((clock.monotonic() + 1.0, b"\x00\x01\x00\x00\xff\xff\x11\x03"))
    with pytest.raises(LinkLost):
        it.line.advance(5.0)


def test_without_a_clock_a_line_uses_the_machines_own() -> None:
    class Silence:
        def read(self, timeout_s: float) -> bytes:
            return b""

        def write(self, data: bytes) -> None:
            self.written = data

    link = Silence()
    line = Line(link, "rtu")
    assert line.read_coils(UNIT, 0x13, 0x13)
    assert link.written == rtu(UNIT, bytes.fromhex("01 0013 0013"))
    assert line.available() is None
    assert isinstance(line._clock, SystemClock)


# ------------------------------------------------------------------------------------------------ what comes instead


def wrong_sum(frame: bytes, framing: Framing) -> bytes:
    if framing == "ascii":
        return frame[:-3] + (b"0" if frame[-3:-2] != b"0" else b"1") + frame[-2:]
    return frame[:-1] + bytes([frame[-1] ^ 0x01])


def wrong_answers(framing: Framing, transaction: int) -> dict[str, Script]:
    """What a bad line or a bad device sends instead of ANSWER; nothing of it may be taken for an answer."""

    def frame(pdu: bytes, unit: int = UNIT) -> bytes:
        return framed(framing, unit, pdu, transaction)

    good = frame(ANSWER)
    found: dict[str, Script] = {
        "nothing": [],
        "another unit": [(0.5, frame(ANSWER, unit=0x12))],
        "another function": [(0.5, frame(b"\x04" + ANSWER[1:]))],
        "an exception to another function": [(0.5, frame(bytes([0x84, 2])))],
        "fewer registers": [(0.5, frame(bytes.fromhex("03 04 022B 0000")))],
        "more registers": [(0.5, frame(bytes.fromhex("03 08 022B 0000 0064 0001")))],
        "no registers": [(0.5, frame(bytes.fromhex("03 00")))],
        "an odd byte count": [(0.5, frame(bytes.fromhex("03 05 022B 0000 00")))],
        "half of it": [(0.5, good[: len(good) // 2])],
        "all but its last byte": [(0.5, good[:-1])],
        "one byte": [(0.5, good[:1])],
        "unit and function only": [(0.5, good[:2])],
        "noise": [(0.5, bytes.fromhex("FF 00 55 AA 11 03 06"))] if framing == "rtu" else [(0.5, b"\x20\x55\xaa")],
    }
    if framing != "tcp":
        found["a wrong checksum"] = [(0.5, wrong_sum(good, framing))]
        found["its own request"] = [(0.5, frame(ASKED))]
    if framing == "rtu":
        found["more bytes right after it"] = [(0.5, good + b"\x00")]
        found["the same twice at once"] = [(0.5, good + good)]
        found["more bytes within 3.5 characters"] = [(0.5, good), (0.5 + 3 * CHARACTER_S, b"\x00")]
        found["a pause in the middle"] = [(0.5, good[:5]), (0.875, good[5:])]
    if framing == "ascii":
        found["no colon"] = [(0.5, good[1:])]
        found["a letter that is no digit"] = [(0.5, good[:4] + b"G" + good[5:])]
        found["a pause of more than a second"] = [(0.5, good[:6]), (1.75, good[6:])]
    if framing == "tcp":
        found["an older transaction"] = [(0.5, tcp(transaction - 1, UNIT, ANSWER))]
        found["another protocol"] = [(0.5, good[:2] + b"\x00\x01" + good[4:])]
    return found


WRONG: list[tuple[Framing, str]] = [
    (framing, name) for framing in ("rtu", "ascii", "tcp") for name in wrong_answers(framing, 1)
]


@pytest.mark.parametrize(("framing", "name"), WRONG, ids=["-".join(case) for case in WRONG])
def test_a_wrong_answer_is_an_error_in_time_and_the_next_request_gets_its_own(
    clock: JumpingClock, framing: Framing, name: str
) -> None:
    it = bench(clock, framing, lambda transaction: wrong_answers(framing, transaction)[name], reply(framing))
    began_s = clock.monotonic()
    response = it.ask()
    assert response.error_code in (TIMEOUT, DAMAGED)
    assert response.data == b""
    assert response.reason
    times = it.timing
    assert clock.monotonic() - began_s <= times.response_timeout_s + times.character_timeout_s + 300 * CHARACTER_S
    assert it.ask().data == words(555, 0, 100)


@FRAMINGS
@pytest.mark.parametrize("name", ["nothing", "another unit", "another function"])
def test_silence_and_others_frames_are_a_timeout(clock: JumpingClock, framing: Framing, name: str) -> None:
    """ASCII and TCP frames say whole and undamaged that they are about another function: that is damage."""
    it = bench(clock, framing, lambda transaction: wrong_answers(framing, transaction)[name])
    expected = DAMAGED if name == "another function" and framing != "rtu" else TIMEOUT
    assert it.ask().error_code == expected


@SERIAL
@pytest.mark.parametrize("name", ["a wrong checksum", "fewer registers"])
def test_a_damaged_reply_is_damage(clock: JumpingClock, framing: Framing, name: str) -> None:
    it = bench(clock, framing, lambda transaction: wrong_answers(framing, transaction)[name])
    assert it.ask().error_code == DAMAGED


@SERIAL
def test_bytes_before_the_reply_are_dropped(clock: JumpingClock, framing: Framing) -> None:
    good = framed(framing, UNIT, ANSWER, 0)
    noise = b"\x00\xff\x55" if framing == "rtu" else b"\x00\xff\r\n0"
    assert bench(clock, framing, [(0.5, noise + good)]).ask().data == words(555, 0, 100)
    assert bench(clock, framing, [(0.5, noise), (0.625, good)]).ask().data == words(555, 0, 100)


@FRAMINGS
def test_a_reply_in_single_bytes_is_a_reply(clock: JumpingClock, framing: Framing) -> None:
    def bytewise(transaction: int) -> Script:
        good = framed(framing, UNIT, ANSWER, transaction)
        return [(0.5 + i * CHARACTER_S, good[i : i + 1]) for i in range(len(good))]

    assert bench(clock, framing, bytewise).ask().data == words(555, 0, 100)


def test_a_reply_after_another_units_frame_is_taken_and_the_timer_was_not_restarted(clock: JumpingClock) -> None:
    other, good = rtu(0x12, ANSWER), rtu(UNIT, ANSWER)
    assert bench(clock, "rtu", [(2.0, other), (2.25, good)]).ask().data == words(555, 0, 100)
    it = bench(clock, "rtu", [(2.0, other), (2.75, good)])
    sent_s = clock.monotonic() + 8 * CHARACTER_S
    assert it.ask().error_code == TIMEOUT
    assert clock.monotonic() == sent_s + 2.5


@SERIAL
def test_a_reply_begun_in_time_may_end_after_the_timeout(clock: JumpingClock, framing: Framing) -> None:
    good = framed(framing, UNIT, ANSWER, 0)
    it = bench(clock, framing, [(2.4375, good[:5]), (2.5625, good[5:])])
    assert it.ask().data == words(555, 0, 100)


@pytest.mark.parametrize("babble", [b"\x00", b"\x11", b"\x11\x03", b"\x11\x03\xfa", b":", b":11", b"\r\n", b"\xff"])
@FRAMINGS
def test_a_device_that_never_ends_is_an_error_in_bounded_time(
    clock: JumpingClock, framing: Framing, babble: bytes
) -> None:
    """It talks without a pause, from before the reply is due until long after the last chance of the next request."""
    script = [(i * 3 * CHARACTER_S, babble) for i in range(6000)]
    it = bench(clock, framing, script if framing != "tcp" else [(0.5, b"\x00\x01\x00\x00\x00\xfe\x11\x03")])
    began_s = clock.monotonic()
    assert it.ask().error_code in (TIMEOUT, DAMAGED)
    assert clock.monotonic() - began_s < 2.5 + 1.0 + 256 * CHARACTER_S + 0.1
    if framing == "tcp":
        return
    asked_s = clock.monotonic()
    assert it.ask().error_code in (TIMEOUT, DAMAGED)
    assert clock.monotonic() - asked_s <= 2 * 2.5 + 0.1
    assert len(it.link.written) == 1  # nobody talks into a line that is never silent
    it.link.arriving.clear()
    it.answers = [reply(framing)]
    assert it.ask().data == words(555, 0, 100)


# ------------------------------------------------------------------------------------------------ spoiled


@SERIAL
def test_after_a_timeout_the_line_listens_for_one_reply_time_before_it_sends(
    clock: JumpingClock, framing: Framing
) -> None:
    it = bench(clock, framing, [], reply(framing))
    assert it.ask().error_code == TIMEOUT
    sent_bytes = len(it.link.written[0][1])
    gave_up_s = 1000.0 + sent_bytes * CHARACTER_S + 2.5
    assert clock.monotonic() == gave_up_s
    assert it.line.state is State.SPOILED
    assert not it.line.is_free
    assert it.ask().data == words(555, 0, 100)
    assert it.sent_s == [1000.0, gave_up_s + 2.5]


def test_after_damage_the_line_listens_for_one_reply_time_too(clock: JumpingClock) -> None:
    good = rtu(UNIT, ANSWER)
    it = bench(clock, "rtu", [(0.5, wrong_sum(good, "rtu"))], reply("rtu"))
    assert it.ask().error_code == DAMAGED
    damaged_s = 1000.0 + 8 * CHARACTER_S + 0.5 + 0.25  # the rest of a reply might still have come: character timeout
    assert clock.monotonic() == damaged_s
    it.ask()
    assert it.sent_s[1] == damaged_s + 2.5


@SERIAL
def test_a_late_reply_is_thrown_away_and_its_silence_kept(clock: JumpingClock, framing: Framing) -> None:
    late = framed(framing, UNIT, bytes.fromhex("03 06 0001 0002 0003"), 0)
    it = bench(clock, framing, [(4.9990234375, late)], reply(framing))  # one character before listening ends
    assert it.ask().error_code == TIMEOUT
    assert it.ask().data == words(555, 0, 100)
    sent_bytes = len(it.link.written[0][1])
    heard_s = 1000.0 + sent_bytes * CHARACTER_S + 4.9990234375
    assert it.sent_s[1] == heard_s + SILENCE_S


def test_a_spoiled_line_becomes_free_by_itself(clock: JumpingClock) -> None:
    it = bench(clock, "rtu")
    it.ask()
    gave_up_s = clock.monotonic()
    while not it.line.is_free:
        assert it.line.advance(1.0) is None
    assert clock.monotonic() == gave_up_s + 2.5


def test_a_request_with_its_own_timeout_waits_and_listens_for_that_long(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", [], reply("rtu"))
    it.line.send(UNIT, READ, timeout_s=0.5)
    assert it.result().error_code == TIMEOUT
    assert clock.monotonic() == 1000.0 + 8 * CHARACTER_S + 0.5
    it.ask()
    assert it.sent_s[1] == 1000.0 + 8 * CHARACTER_S + 1.0


def test_tcp_sends_on_at_once_and_the_late_answer_is_known_by_its_transaction(clock: JumpingClock) -> None:
    old = ANSWER.replace(b"\x02\x2b", b"\x09\x09")
    it = bench(clock, "tcp", reply("tcp", old, at_s=2.75), reply("tcp", at_s=0.5))
    assert it.ask().error_code == TIMEOUT
    assert it.line.is_free
    assert it.ask().data == words(555, 0, 100)
    assert it.sent_s == [1000.0, 1002.5]
    assert [frame[:2] for _, frame in it.link.written] == [b"\x00\x01", b"\x00\x02"]


def test_a_late_answer_on_an_idle_tcp_connection_keeps_the_frames_in_step(clock: JumpingClock) -> None:
    whole = tcp(1, UNIT, ANSWER)
    it = bench(clock, "tcp", [(3.0, whole[:5]), (3.5, whole[5:] + whole[:3]), (4.0, whole[3:])], reply("tcp"))
    assert it.ask().error_code == TIMEOUT
    for _ in range(5):
        assert it.line.advance(0.5) is None
    assert it.ask().data == words(555, 0, 100)


def test_transaction_identifiers_go_round_after_65535(clock: JumpingClock) -> None:
    it = bench(clock, "tcp", *[reply("tcp", at_s=0.0)] * 65537)
    seen = [it.ask().error_code for _ in range(65537)]
    assert set(seen) == {NO_ERROR}
    assert [frame[:2] for _, frame in it.link.written[65534:]] == [b"\xff\xff", b"\x00\x00", b"\x00\x01"]


def test_any_late_answer_never_lands_in_another_request(clock: JumpingClock) -> None:
    """Reply k says k; replies come at any time up to just before the end of the listening."""
    for late_s in [i / 16 for i in range(1, 80)]:
        say: list[Callable[[int], Script] | Script] = [
            [(late_s if k % 2 == 0 else 0.25, rtu(UNIT, b"\x03\x06" + words(k, k, k)))] for k in range(6)
        ]
        it = bench(clock, "rtu", *say)
        for k in range(6):
            response = it.ask()
            assert response.has_error() or response.register(0) == k


# ------------------------------------------------------------------------------------------------ silence


def test_between_reply_and_next_request_there_are_three_and_a_half_characters(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", reply("rtu"), reply("rtu"))
    it.ask()
    it.ask()
    assert it.sent_s[1] == 1000.0 + 8 * CHARACTER_S + 0.5 + SILENCE_S


def test_the_delay_of_the_line_is_kept_too(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", reply("rtu"), reply("rtu"), timing=Timing(2.5, 0.25, SILENCE_S, 0.25, 0.125, CHARACTER_S))
    it.ask()
    it.ask()
    assert it.sent_s == [1000.0, 1000.0 + 8 * CHARACTER_S + 0.5 + SILENCE_S + 0.25]


def test_stray_bytes_on_an_idle_line_begin_the_silence_anew(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", reply("rtu"))
    it.link.arriving = [(1000.5, b"\x00"), (1000.5 + 2 * CHARACTER_S, b"\x00")]
    assert it.line.advance(0.5) is None
    it.line.send(UNIT, READ)
    assert it.link.written == []
    assert it.line.state is State.HELD_BACK
    assert it.result().data == words(555, 0, 100)
    assert it.sent_s == [1000.5 + 2 * CHARACTER_S + SILENCE_S]


def test_a_line_silent_long_enough_sends_at_once(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", reply("rtu"), reply("rtu"))
    it.ask()
    clock.pass_s(1.0)
    asked_s = clock.monotonic()
    it.ask()
    assert it.sent_s[1] == asked_s


def test_a_line_that_is_never_silent_is_damaged_and_nothing_is_sent_into_it(clock: JumpingClock) -> None:
    it = bench(clock, "rtu")
    it.link.arriving = [(1000.0 + i * CHARACTER_S, b"\x00") for i in range(8192)]
    it.line.advance(0.0)
    response = it.ask()
    assert (response.error_code, response.reason) == (DAMAGED, "the line is never silent")
    assert clock.monotonic() == 1002.5
    assert it.link.written == []
    assert it.line.is_free


# ------------------------------------------------------------------------------------------------ broadcast


@SERIAL
def test_a_broadcast_is_over_after_the_turnaround_whatever_is_said_meanwhile(
    clock: JumpingClock, framing: Framing
) -> None:
    it = bench(clock, framing, [(0.0625, framed(framing, 0, b"\x06\x00\x01\x00\x03", 0))])
    assert it.line.write_single_register(0, 1, 3)
    assert it.line.state is State.TURNAROUND
    response = it.result()
    sent_bytes = len(it.link.written[0][1])
    assert clock.monotonic() == 1000.0 + sent_bytes * CHARACTER_S + 0.125
    assert (response.unit, response.error_code) == (0, NO_ERROR)
    assert it.line.is_free


def test_a_broadcast_only_writes(clock: JumpingClock) -> None:
    it = bench(clock, "rtu")
    with pytest.raises(RequestInvalid):
        it.line.send(0, READ)
    with pytest.raises(RequestInvalid):
        it.line.send(0, MaskWriteRequest(1, 2, 3))
    assert it.line.send(0, WriteRequest(16, 1, 2, words(1, 2)))


def test_on_tcp_unit_0_is_a_device_that_answers(clock: JumpingClock) -> None:
    it = bench(clock, "tcp", reply("tcp", unit=0))
    assert it.ask(unit=0).data == words(555, 0, 100)


# ------------------------------------------------------------------------------------------------ the table


def test_every_step_of_a_lines_life_is_taken_and_no_other(clock: JumpingClock, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: set[tuple[State, Event]] = set()
    inner = Line._pass

    def note(line: Line, event: Event) -> None:
        taken.add((line.state, event))
        inner(line, event)

    monkeypatch.setattr(Line, "_pass", note)
    good = rtu(UNIT, ANSWER)
    it = bench(
        clock, "rtu", reply("rtu"), [], [(0.5, wrong_sum(good, "rtu"))], [(0.5, good), (0.5 + CHARACTER_S, b"x")]
    )
    for _ in range(4):
        it.ask()
    it.line.write_single_register(0, 1, 3)
    it.result()
    it.link.arriving = [(clock.monotonic() + i * CHARACTER_S, b"\x00") for i in range(8192)]
    it.line.advance(0.0)
    it.ask()
    assert taken == {(state, event) for state, events in NEXT.items() for event in events}


def test_what_the_table_does_not_foresee_is_a_bug_that_shows(clock: JumpingClock) -> None:
    for state, event in product(State, Event):
        line = bench(clock, "rtu").line
        line.state = state
        if event in NEXT[state]:
            line._pass(event)
            assert line.state is NEXT[state][event]
        else:
            with pytest.raises(KeyError):
                line._pass(event)
