"""Replies to functions 7, 8, 11, 12, 17, 24 and 43, as a command of the master takes them: by what they repeat."""

from __future__ import annotations

import pytest

from gateway.errors import DeviceRefused, ReplyMismatch
from gateway.modbus.pdu import PlainRequest, decode_reply
from tests.modbus import wire

ECHO = PlainRequest(8, wire("00 00 A5 37"))  # the example of section 6.8.1
QUEUE = PlainRequest(24, wire("04 DE"))  # the example of section 6.18
IDENTITY = PlainRequest(43, wire("0E 01 00"))

ANSWERS: dict[str, tuple[PlainRequest, str]] = {
    "exception status, 6.7": (PlainRequest(7), "07 6D"),
    "return query data, 6.8.1": (ECHO, "08 00 00 A5 37"),
    "diagnostic register, 6.8.1": (PlainRequest(8, wire("00 02 00 00")), "08 00 02 12 34  # its value, no echo"),
    "bus message count, 6.8.1": (PlainRequest(8, wire("00 0B 00 00")), "08 00 0B FF FF"),
    "event counter, 6.9": (PlainRequest(11), "0B FF FF 01 08"),
    "event log, 6.10": (PlainRequest(12), "0C 08 00 00 01 08 01 21 20 00"),
    "server ID, 6.13": (PlainRequest(17), "11 03 01 FF 41"),
    "two in the queue, 6.18": (QUEUE, "18 00 06 00 02 01 B8 12 84"),
    "an empty queue": (QUEUE, "18 00 02 00 00"),
    "31 in the queue": (QUEUE, "18 00 40 00 1F" + 31 * " 00 01"),
    "identification, 6.21": (IDENTITY, "2B 0E 01 01 00 00 01 00 03 41 42 43"),
}


@pytest.mark.parametrize(("request_", "reply"), ANSWERS.values(), ids=ANSWERS)
def test_a_true_reply_brings_all_after_the_function_code(request_: PlainRequest, reply: str) -> None:
    assert decode_reply(request_, wire(reply)) == wire(reply)[1:]


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        (ECHO, "08 00 00 A5 36  # one bit of the data changed"),
        (ECHO, "08 00 00 37 A5"),
        (ECHO, "08 00 01 A5 37  # another sub-function"),
        (ECHO, "08 00 00 A5"),
        (ECHO, "08 00 00 A5 37 00"),
        (PlainRequest(8, wire("00 02 00 00")), "08 00 03 12 34"),
        (IDENTITY, "2B 0D 01 01 00 00 01 00 03 41 42 43  # another MEI type"),
        (IDENTITY, "2B 0E 02 01 00 00 01 00 03 41 42 43  # another code"),
        (IDENTITY, "2B 0E 01 01 00 00 01 00 04 41 42 43  # an object cut short"),
        (QUEUE, "18 00 06 00 03 01 B8 12 84  # three registers, and bytes for two"),
        (QUEUE, "18 00 06 00 01 01 B8 12 84"),
        (QUEUE, "18 01 06 00 02 01 B8 12 84  # 262 bytes follow, it says"),
        (QUEUE, "18 00 06 80 02 01 B8 12 84  # 32770 registers, it says"),
        (QUEUE, "18 00 05 00 02 01 B8 12  # half a register"),
        (QUEUE, "18 00 01 00"),
        (QUEUE, "18 00 00"),
        (QUEUE, "18 00 42 00 20" + 32 * " 00 01" + "  # a queue gives 31 at most"),
    ],
    ids=lambda value: value if isinstance(value, str) else str(value.function),
)
def test_a_reply_that_does_not_agree_with_its_request_or_with_itself_is_a_mismatch(
    request_: PlainRequest, reply: str
) -> None:
    with pytest.raises(ReplyMismatch):
        decode_reply(request_, wire(reply))


def test_an_exception_is_one_for_these_too() -> None:
    with pytest.raises(DeviceRefused):
        decode_reply(QUEUE, wire("98 02"))
