"""What tests of the traffic view say on a line, and the words that should come of it."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gateway.modbus.framing import Framing
from gateway.traffic import Seen
from tests.fakes import ascii_frame, rtu, tcp

ASKED = bytes.fromhex("03 006B 0003")  # the example of specification 6.3
ANSWER = bytes.fromhex("03 06 022B 0000 0064")
READ_WORDS = "unit 17: read 3 holding registers from 107"
ANSWER_WORDS = "unit 17: 3 registers: 555 0 100"
WRITE = bytes.fromhex("06 0001 0003")  # its reply is the same
ENCODE: dict[Framing, Callable[[int, bytes], bytes]] = {
    "rtu": rtu,
    "ascii": ascii_frame,
    "tcp": lambda unit, pdu: tcp(1, unit, pdu),
}

on_wires = pytest.mark.parametrize("framing", ["rtu", "ascii"])


def texts(seen: list[Seen]) -> list[str]:
    return [("> " if one.sent else "< ") + one.text for one in seen]
