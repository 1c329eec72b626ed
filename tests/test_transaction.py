"""One request and its reply on a line: whatever comes back, there is never a wrong value, and never a wait for ever."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gateway.clock import SystemClock
from gateway.errors import LinkLost, RequestInvalid
from gateway.transaction import DAMAGED, NO_ERROR, TIMEOUT, Line, Response
from tests.fakes import JumpingClock, rtu, tcp, words
from tests.line_bench import (
    ANSWER,
    ASKED,
    CHARACTER_S,
    FRAMINGS,
    READ,
    SERIAL,
    UNIT,
    Framing,
    Script,
    bench,
    framed,
    reply,
    wrong_sum,
)

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
