"""A device lies in one of five replies, a million times: not one lie is ever taken for data.

Each truthful reply carries words that only this one request can have earned (``truth``); a lie carries others, or is
the truth at the wrong time. Every lie here is one that its framing can tell: a right checksum on the right unit, the
right function, the right length, in the right moment, would be no lie that anything could find on RTU and ASCII.
The clock is a fake, nobody waits.

    RTUGATE_LIES=10000 python -m pytest tests/system/test_liar.py
"""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import Final

import pytest

from gateway.errors import LinkLost
from gateway.modbus.framing import Frame, Framing, request_framer
from gateway.modbus.pdu import MaskWriteRequest, ReadRequest, ReadWriteRequest, Request, WriteRequest
from gateway.transaction import DAMAGED, NO_ERROR, TIMEOUT, Line, Response, Timing
from tests.fakes import JumpingClock, ScriptedLink

TRANSACTIONS = int(os.environ.get("RTUGATE_LIES", "1000000")) // 3  # in each framing
LYING = 5  # one reply in so many is a lie
REFUSING = 20  # one truthful reply in so many is an exception
ACCEPTED = 0.99  # of the truthful replies; the rest come while the line still talks nonsense
CHARACTER_S: Final = 1 / 2048
TIMEOUT_S: Final = 1.0
TIMES: dict[Framing, Timing] = {
    "rtu": Timing(TIMEOUT_S, 0.05, 3.5 * CHARACTER_S, 0.0, 0.1, CHARACTER_S),
    "ascii": Timing(TIMEOUT_S, 0.5, 3.5 * CHARACTER_S, 0.0, 0.1, CHARACTER_S),
    "tcp": Timing(TIMEOUT_S, 0.05, 0.0, 0.0, 0.1, 0.0),
}
Script = list[tuple[float, bytes]]  # seconds after the request, bytes


def truth(number: int, size: int) -> bytes:
    """The data that only request *number* can have earned; 0 to 12 bytes."""
    return ((number * 2654435761 % 2**32 << 64) + (number << 32) + number).to_bytes(12, "big")[:size]


def untruth(number: int, size: int) -> bytes:
    """Data that no request has earned: every bit of the truth turned over."""
    return bytes(byte ^ 0xFF for byte in truth(number, size))


@dataclass(frozen=True)
class Asked:
    """One request as the device sees it."""

    number: int
    unit: int
    request: Request
    transaction: int = 0

    @property
    def size(self) -> int:
        """Bytes of data that are asked for."""
        request = self.request
        if not isinstance(request, ReadRequest | ReadWriteRequest):
            return 0
        return (request.quantity + 7) // 8 if request.function <= 2 else 2 * request.quantity

    @property
    def refusal(self) -> bytes:
        """The exception that only this request can have earned."""
        return bytes([self.request.function | 0x80, 1 + self.number % 255])

    def reply(self, data: bytes) -> bytes:
        """A reply PDU that brings *data*; to a write: the echo."""
        request, function = self.request, bytes([self.request.function])
        match request:
            case ReadRequest() | ReadWriteRequest():
                return function + bytes([len(data)]) + data
            case MaskWriteRequest():
                return function + words(request.address, request.and_mask, request.or_mask)
            case WriteRequest(function=5):
                return function + words(request.address, 0xFF00 if request.data[0] else 0)
            case WriteRequest(function=6):
                return function + words(request.address) + request.data
            case _:
                return function + words(request.address, request.quantity)


def words(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "big") for value in values)


@dataclass
class Liar:
    """The device: the truth four times, then a lie or the truth told wrong, by *rng*; see the methods."""

    framing: Framing
    rng: random.Random
    asked: Asked | None = None
    kind: str = ""
    is_idle: Callable[[], bool] = lambda: True  # nothing said earlier is still on its way

    def __post_init__(self) -> None:
        self._encode = request_framer(self.framing).encode
        serial: list[Callable[[Asked], Script]] = [self.echo_of_the_request, self.twice_with_a_pause]
        self._lies: list[Callable[[Asked], Script]] = [
            self.other_unit, self.other_function, self.short, self.cut_off, self.wrong_byte_count, self.long,
            self.bytes_after_the_end, self.damaged, self.late, self.half_of_it_late, self.twice, self.garbage_first,
            self.endless, self.others_without_end, self.another_address, self.exception_of_another_function,
            self.exception_0,
            *(serial if self.framing != "tcp" else [self.other_transaction, self.other_protocol]),
        ]  # fmt: skip
        # A connection brings no late reply in the middle of another.
        self._alone = [self.cut_off, self.half_of_it_late] if self.framing == "tcp" else []

    def __call__(self, frame: bytes) -> Script:
        """Answer what was asked; the frame itself says only its transaction."""
        assert self.asked is not None
        if self.framing == "tcp":
            transaction = int.from_bytes(frame[:2], "big")
            self.asked = Asked(self.asked.number, self.asked.unit, self.asked.request, transaction)
        if self.rng.randrange(LYING):
            if not self.rng.randrange(REFUSING):
                self.kind = "refused"
                return self.after(self.frame(self.asked, self.asked.refusal))
            self.kind = "truth"
            return self.after(self.true_frame(self.asked))
        lie = self.rng.choice(self._lies)
        if lie in self._alone and not self.is_idle():
            lie = self.other_unit
        self.kind = lie.__name__
        return lie(self.asked)

    # -------------------------------------------------------------------------------------------- frames

    def frame(self, asked: Asked, pdu: bytes, unit: int | None = None, transaction: int | None = None) -> bytes:
        return self._encode(
            Frame(asked.unit if unit is None else unit, pdu, asked.transaction if transaction is None else transaction)
        )

    def true_frame(self, asked: Asked) -> bytes:
        return self.frame(asked, asked.reply(truth(asked.number, asked.size)))

    def lie(self, asked: Asked, size: int | None = None) -> bytes:
        return asked.reply(untruth(asked.number, asked.size if size is None else size))

    def after(self, *pieces: bytes, pause_s: float = 0.0, first_s: float | None = None) -> Script:
        """The pieces one after the other, the first soon."""
        at_s = self.rng.uniform(0.02, 0.3) if first_s is None else first_s
        return [(at_s + place * pause_s, piece) for place, piece in enumerate(pieces)]

    # -------------------------------------------------------------------------------------------- lies

    def other_unit(self, asked: Asked) -> Script:
        return self.after(self.frame(asked, self.lie(asked), unit=asked.unit ^ self.rng.randint(1, 255)))

    def other_function(self, asked: Asked) -> Script:
        function = asked.request.function ^ self.rng.choice([1, 2, 3, 4, 7, 0x40])
        return self.after(self.frame(asked, bytes([function]) + self.lie(asked)[1:]))

    def short(self, asked: Asked) -> Script:
        pdu = self.lie(asked, asked.size - 2) if asked.size > 2 else self.lie(asked)[:-1]
        return self.after(self.frame(asked, pdu))

    def long(self, asked: Asked) -> Script:
        pdu = self.lie(asked, asked.size + 2) if asked.size else self.lie(asked) + b"\x00"
        return self.after(self.frame(asked, pdu))

    def wrong_byte_count(self, asked: Asked) -> Script:
        """All the bytes that were asked for, and a count that says otherwise; to a write, which has none: too short."""
        pdu = self.lie(asked)
        if not asked.size:
            return self.short(asked)
        return self.after(self.frame(asked, bytes([pdu[0], pdu[1] ^ self.rng.randint(1, 255)]) + pdu[2:]))

    def cut_off(self, asked: Asked) -> Script:
        frame = self.frame(asked, self.lie(asked))
        return self.after(frame[: self.rng.randrange(1, len(frame))])

    def bytes_after_the_end(self, asked: Asked) -> Script:
        return self.after(self.true_frame(asked) + self.rng.randbytes(self.rng.randint(1, 9)))

    def damaged(self, asked: Asked) -> Script:
        """One byte of the frame changed; on TCP, where the network sees to that, one of the header's."""
        frame = bytearray(self.frame(asked, self.lie(asked)))
        place = self.rng.choice([0, 1, 2, 3, 6]) if self.framing == "tcp" else self.rng.randrange(len(frame) - 2)
        frame[place] = (frame[place] ^ self.rng.randint(1, 255)) if self.framing != "ascii" else changed(frame[place])
        return self.after(bytes(frame))

    def late(self, asked: Asked) -> Script:
        """The truth, when nobody waits for it any more; on TCP even when others are asked for already."""
        limit = 1.95 if self.framing != "tcp" else 20.0
        return self.after(self.true_frame(asked), first_s=self.rng.uniform(1.15, limit) * TIMEOUT_S)

    def half_of_it_late(self, asked: Asked) -> Script:
        frame = self.true_frame(asked)
        place = self.rng.randrange(1, len(frame))
        return self.after(frame[:place], frame[place:], pause_s=self.rng.uniform(0.06, 0.9) * TIMEOUT_S)

    def twice(self, asked: Asked) -> Script:
        frame = self.true_frame(asked)
        return self.after(frame + frame)

    def twice_with_a_pause(self, asked: Asked) -> Script:
        """Within the silence that has to prove the first to be whole; on TCP any time later is told from the next."""
        return self.after(*2 * [self.true_frame(asked)], pause_s=self.rng.uniform(0.1, 0.9) * 3.5 * CHARACTER_S)

    def garbage_first(self, asked: Asked) -> Script:
        return self.after(self.rng.randbytes(self.rng.randint(1, 40)) + self.true_frame(asked))

    def endless(self, asked: Asked) -> Script:
        """Damaged lies, one after the other, until long after the timeout."""
        frame = bytearray(self.frame(asked, self.lie(asked)))
        frame[-3] ^= 1 if self.framing != "tcp" else 0
        frame[0] ^= self.framing == "tcp"
        return self.after(*20 * [bytes(frame)], pause_s=0.15)

    def others_without_end(self, asked: Asked) -> Script:
        frame = self.frame(asked, self.lie(asked), unit=asked.unit ^ 1)
        return self.after(*40 * [frame], pause_s=0.04)

    def another_address(self, asked: Asked) -> Script:
        """A write's echo with another address; of a read: what another function would say of it."""
        pdu = self.lie(asked)
        if asked.size:
            return self.exception_of_another_function(asked)
        return self.after(self.frame(asked, pdu[:2] + bytes([pdu[2] ^ self.rng.randint(1, 255)]) + pdu[3:]))

    def exception_of_another_function(self, asked: Asked) -> Script:
        function = asked.request.function ^ self.rng.choice([1, 2, 4, 7]) | 0x80
        return self.after(self.frame(asked, bytes([function, self.rng.randint(1, 11)])))

    def exception_0(self, asked: Asked) -> Script:
        return self.after(self.frame(asked, bytes([asked.request.function | 0x80, 0])))

    def echo_of_the_request(self, asked: Asked) -> Script:
        """What a read looks like on an RS-485 adapter that hears itself; a write's echo would be the truth."""
        if not isinstance(asked.request, ReadRequest):
            return self.short(asked)
        return self.after(self.frame(asked, bytes([asked.request.function]) + words(0x0500, asked.request.quantity)))

    def other_transaction(self, asked: Asked) -> Script:
        other = (asked.transaction + self.rng.choice([-1, 1, 255, 256, 32768])) & 0xFFFF
        return self.after(self.frame(asked, self.lie(asked), transaction=other))

    def other_protocol(self, asked: Asked) -> Script:
        frame = self.frame(asked, self.lie(asked))
        return self.after(frame[:2] + self.rng.choice([b"\0\1", b"\1\0", b"\xff\xff"]) + frame[4:])


def changed(character: int) -> int:
    """Another hexadecimal digit, or none for what is none."""
    digits = b"0123456789ABCDEF"
    return digits[digits.index(character) - 1] if character in digits else ord("?")


# ------------------------------------------------------------------------------------------------ the master's side


def some_request(rng: random.Random, number: int) -> Request:
    """A request; what a write writes, and where, is as new as *number*."""
    address = number & 0x7FFF
    match rng.randrange(10):
        case 0 | 1 | 2:
            return ReadRequest(3, 100, 4)
        case 3:
            return ReadRequest(4, 100, 4)
        case 4:
            return ReadRequest(1, 100, 64)
        case 5:
            return WriteRequest(5, address, 1, bytes([number & 1]))
        case 6:
            return WriteRequest(6, address, 1, truth(number, 2))
        case 7:
            return WriteRequest(16, address, 2, truth(number, 4))
        case 8:
            return MaskWriteRequest(address, number >> 16, number & 0xFFFF)
        case _:
            return ReadWriteRequest(100, 4, address, 1, truth(number, 2))


@dataclass
class Account:
    """What came of the transactions, by kind of reply."""

    told: Counter[str] = field(default_factory=Counter)
    accepted: Counter[str] = field(default_factory=Counter)
    damaged: Counter[str] = field(default_factory=Counter)
    lost: int = 0  # connections


class Bench:
    """A line to the liar, opened again when it is lost."""

    def __init__(self, framing: Framing, seed: str) -> None:
        self.framing, self.rng, self.clock = framing, random.Random(seed), JumpingClock()
        self.liar = Liar(framing, random.Random(seed + " liar"))
        self.account = Account()
        self._open()

    def _open(self) -> None:
        link = self.link = ScriptedLink(self.clock, self.liar, TIMES[self.framing].character_s)
        self.liar.is_idle = lambda: not link.arriving
        self.line = Line(self.link, self.framing, TIMES[self.framing], self.clock)

    def transact(self, number: int) -> None:
        """One request, and the judgement of what is said to have answered it."""
        unit, request = self.rng.choice([1, 2, 17]), some_request(self.rng, number)
        asked = self.liar.asked = Asked(number, unit, request)
        self.liar.kind = "never asked"
        try:
            response = self._response(unit, request)
        except LinkLost:
            self.account.lost += 1
            self.account.told[self.liar.kind] += 1
            self._open()
            return
        self.link.written.clear()
        self._judge(asked, response)

    def _response(self, unit: int, request: Request) -> Response:
        assert self.line.send(unit, request)
        for _ in range(10_000):
            if (response := self.line.advance(10.0)) is not None:
                return response
        raise AssertionError("the line never says what became of the request")

    def _judge(self, asked: Asked, response: Response) -> None:
        kind, account = self.liar.kind, self.account
        account.told[kind] += 1
        if response.error_code == NO_ERROR:
            assert response.data == truth(asked.number, asked.size), f"{asked}: {kind} was taken for the truth"
            fair = TRUE_IN_A_WAY | WHOLE_ON_TCP if self.framing == "tcp" else TRUE_IN_A_WAY
            assert kind in fair, f"{asked}: {kind} was accepted"
            account.accepted[kind] += 1
        elif kind == "refused" and response.error_code == asked.refusal[1]:
            account.accepted[kind] += 1
        else:
            assert response.error_code in (DAMAGED, TIMEOUT), f"{asked}: {kind} was taken for an exception"
            assert response.data == b""
            account.damaged[kind] += response.error_code == DAMAGED


TRUE_IN_A_WAY = {"truth", "half_of_it_late", "late", "garbage_first"}  # no lies, if what they bring is the truth
WHOLE_ON_TCP = {"bytes_after_the_end", "twice"}  # a header says where a frame ends; elsewhere only silence proves it


@pytest.mark.parametrize("framing", ["rtu", "ascii", "tcp"])
def test_not_one_lie_is_taken_for_data(framing: Framing, record_property: Callable[[str, object], None]) -> None:
    bench, began_s = Bench(framing, f"{framing} 6"), perf_counter()
    for number in range(TRANSACTIONS):
        bench.transact(number)
    account = bench.account
    told = account.told["truth"] + account.told["refused"]
    share = (account.accepted["truth"] + account.accepted["refused"]) / told
    lies = sum(account.told.values()) - told
    record_property(f"{framing}, transactions", f"{TRANSACTIONS:,} in {perf_counter() - began_s:.0f} s")
    record_property(f"{framing}, truthful replies accepted", f"{share:.2%} of {told:,}")
    record_property(f"{framing}, lies", f"{lies:,}, of them found damaged {sum(account.damaged.values()):,}")
    record_property(f"{framing}, connections lost", account.lost)
    for kind, count in sorted(account.told.items()):
        print(f"{framing} {kind}: {count:,}, accepted {account.accepted[kind]:,}, damaged {account.damaged[kind]:,}")
    assert lies > TRANSACTIONS / LYING * 0.9
    assert share >= ACCEPTED
