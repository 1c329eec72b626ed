"""Requests and replies in words, for a field engineer who watches a line or has sent a command.

Pure: bytes in, a line of plain ASCII out, at most ``WIDTH`` characters. It judges nothing and never raises, whatever
the bytes: what has not the length that its function implies is said to be so. What a value means is not known here:
bits are shown as 1 and 0, the first point first; registers as unsigned numbers; addresses as in the PDU, from 0 on.

Source: application protocol V1.1b3, sections 6 and 7; exception 7 stands in its older versions only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from gateway.modbus.pdu import COIL_OFF, COIL_ON, EXCEPTION_BIT, REPLY_SHAPES, REQUEST_SHAPES, pdu_length, word_at
from gateway.plain_text import cut

WIDTH: Final = 60

_EXCEPTIONS: Final = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge",
    6: "server device busy",
    7: "negative acknowledge",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
_READ: Final = {1: "coil", 2: "discrete input", 3: "holding register", 4: "input register"}
_ASK: Final = {7: "read exception status", 11: "read event counter", 12: "read event log", 17: "report server ID"}
_IDENTIFY: Final = 14  # MEI type of function 43, section 6.21


def exception_name(code: int) -> str:
    """Return what exception *code* is called (section 7)."""
    return _EXCEPTIONS.get(code, "not in the standard")


def describe_request(pdu: bytes) -> str:
    """Return what *pdu*, function code and body of a request, asks for."""
    words = _REQUESTS.get(pdu[0]) if pdu else None
    is_whole = len(pdu) == pdu_length(REQUEST_SHAPES, pdu)
    return cut(words(pdu), WIDTH) if words and is_whole else _unknown(pdu, _REQUESTS)


def describe_reply(pdu: bytes) -> str:
    """Return what *pdu*, function code and body of a reply, says."""
    if len(pdu) == 2 and pdu[0] & EXCEPTION_BIT:
        return f"exception {pdu[1]} {exception_name(pdu[1])}"
    words = _REPLIES.get(pdu[0]) if pdu else None
    is_whole = len(pdu) == pdu_length(REPLY_SHAPES, pdu)
    return cut(words(pdu), WIDTH) if words and is_whole else _unknown(pdu, _REPLIES)


def _unknown(pdu: bytes, known: dict[int, Callable[[bytes], str]]) -> str:
    if not pdu:
        return "nothing"
    length = _many(len(pdu) - 1, "byte")
    return f"function {pdu[0]}, wrong length: {length}" if pdu[0] in known else f"function {pdu[0]}, {length}"


# ------------------------------------------------------------------------------------------------ parts


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}" + "s" * (count != 1)


def _points(count: int, noun: str, start: int) -> str:
    return f"{_many(count, noun)} {'at' if count == 1 else 'from'} {start}"


def _word(pdu: bytes, index: int) -> int:
    """Word *index* of all after the function code."""
    return word_at(pdu[1:], index)


def _registers(data: bytes) -> str:
    return " ".join(str(word_at(data, index)) for index in range(len(data) // 2))


def _bits(data: bytes, count: int) -> str:
    return "".join(f"{byte:08b}"[::-1] for byte in data)[:count]


def _on_or_off(value: int) -> str:
    return {COIL_ON: "on", COIL_OFF: "off"}.get(value, f"0x{value:04X}, neither on nor off")


def _text(data: bytes) -> str:
    return "".join(chr(byte) if 32 <= byte < 127 else "." for byte in data)


# ------------------------------------------------------------------------------------------------ requests


def _ask_read(pdu: bytes) -> str:
    return f"read {_points(_word(pdu, 1), _READ[pdu[0]], _word(pdu, 0))}"


def _ask_write_coils(pdu: bytes) -> str:
    return f"write {_points(_word(pdu, 1), 'coil', _word(pdu, 0))}: {_bits(pdu[6:], _word(pdu, 1))}"


def _ask_write_registers(pdu: bytes) -> str:
    return f"write {_points(_word(pdu, 1), 'register', _word(pdu, 0))}: {_registers(pdu[6:])}"


def _ask_read_write(pdu: bytes) -> str:
    read, written = _points(_word(pdu, 1), "register", _word(pdu, 0)), f"{_word(pdu, 3)} from {_word(pdu, 2)}"
    return f"read {read}, write {written}: {_registers(pdu[10:])}"


def _ask_identity(pdu: bytes) -> str:
    if pdu[1] != _IDENTIFY:
        return f"function 43, type {pdu[1]}"
    return f"read device identification, code {pdu[2]} from object {pdu[3]}"


_REQUESTS: Final[dict[int, Callable[[bytes], str]]] = {
    **dict.fromkeys(_READ, _ask_read),
    **dict.fromkeys(_ASK, lambda pdu: _ASK[pdu[0]]),
    5: lambda pdu: f"write coil at {_word(pdu, 0)}: {_on_or_off(_word(pdu, 1))}",
    6: lambda pdu: f"write register at {_word(pdu, 0)}: {_word(pdu, 1)}",
    8: lambda pdu: f"diagnostics {_word(pdu, 0)}: 0x{_word(pdu, 1):04X}",
    15: _ask_write_coils,
    16: _ask_write_registers,
    20: lambda pdu: f"read file records, {_many(pdu[1], 'byte')}",
    21: lambda pdu: f"write file records, {_many(pdu[1], 'byte')}",
    22: lambda pdu: f"mask register at {_word(pdu, 0)}: and 0x{_word(pdu, 1):04X}, or 0x{_word(pdu, 2):04X}",
    23: _ask_read_write,
    24: lambda pdu: f"read FIFO queue at {_word(pdu, 0)}",
    43: _ask_identity,
}

# ------------------------------------------------------------------------------------------------ replies


def _say_bits(pdu: bytes) -> str:
    count = 8 * (len(pdu) - 2)  # the last of them may be padding: only the request knows
    return f"{_many(count, 'bit')}: {_bits(pdu[2:], count)}"


def _say_registers(pdu: bytes) -> str:
    if len(pdu) % 2:
        return f"{_many(len(pdu) - 2, 'byte')}, no whole registers"
    return f"{_many(len(pdu) // 2 - 1, 'register')}: {_registers(pdu[2:])}"


def _say_event_log(pdu: bytes) -> str:
    if len(pdu) < 8:
        return "event log without counters"
    log = pdu[2:]
    counters = f"{_many(word_at(log, 1), 'event')}, {_many(word_at(log, 2), 'message')}"
    return f"event log: {counters}, log {log[6:].hex(' ').upper() or 'empty'}"


def _say_queue(pdu: bytes) -> str:
    if len(pdu) < 5:
        return "queue without a count"
    return f"{_word(pdu, 1)} in the queue: {_registers(pdu[5:])}"


def _say_identity(pdu: bytes) -> str:
    """Whole by ``pdu_length``, so that each object is as long as it says."""
    if pdu[1] != _IDENTIFY:
        return f"function 43, type {pdu[1]}"
    texts, at = [], 7
    while at < len(pdu):
        texts.append(_text(pdu[at + 2 : at + 2 + pdu[at + 1]]))
        at += 2 + pdu[at + 1]
    return f"identification: {', '.join(texts)}"


_REPLIES: Final[dict[int, Callable[[bytes], str]]] = {
    **dict.fromkeys((1, 2), _say_bits),
    **dict.fromkeys((3, 4, 23), _say_registers),
    5: lambda pdu: f"wrote coil at {_word(pdu, 0)}: {_on_or_off(_word(pdu, 1))}",
    6: lambda pdu: f"wrote register at {_word(pdu, 0)}: {_word(pdu, 1)}",
    7: lambda pdu: f"exception status {_bits(pdu[1:], 8)}",
    8: lambda pdu: f"diagnostics {_word(pdu, 0)}: 0x{_word(pdu, 1):04X}",
    11: lambda pdu: f"{_many(_word(pdu, 1), 'event')}, status 0x{_word(pdu, 0):04X}",
    12: _say_event_log,
    15: lambda pdu: f"wrote {_points(_word(pdu, 1), 'coil', _word(pdu, 0))}",
    16: lambda pdu: f"wrote {_points(_word(pdu, 1), 'register', _word(pdu, 0))}",
    17: lambda pdu: f"server ID: {_text(pdu[2:])}",
    20: lambda pdu: f"file records, {_many(pdu[1], 'byte')}",
    21: lambda pdu: f"wrote file records, {_many(pdu[1], 'byte')}",
    22: lambda pdu: f"masked register at {_word(pdu, 0)}: and 0x{_word(pdu, 1):04X}, or 0x{_word(pdu, 2):04X}",
    24: _say_queue,
    43: _say_identity,
}
