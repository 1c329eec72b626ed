"""What is fuzzed of telnet: the filter, the keys and the line editor, one behind the other as in a session."""

from __future__ import annotations

import re
from typing import Final

from gateway.hmi.keys import ENTER, ERASE, ERASE_LINE, ESC, KEYS_MAX, KeyDecoder, LineEditor, Outcome
from gateway.hmi.telnet import REPLIES_MAX, SUBNEGOTIATION_MAX, TelnetFilter

KEYS = {ENTER, ERASE, ERASE_LINE, ESC}
LIMIT = 8  # characters of a line
ANSWERS = re.compile(rb"(?:\xff[\xfb-\xfe].|\r\n\[rtugate is here\]\r\n)*", re.DOTALL)

TELNET_BODIES: Final = [  # what clients send
    bytes.fromhex(
        "FF FD 03 FF FB 18 FF FB 1F FF FB 20 FF FB 21 FF FB 22 FF FB 27 FF FD 05"
    ),  # Debian's telnet, at first
    bytes.fromhex("FF FD 01 FF FD 03 FF FB 03 FF FB 1F FF FA 1F 00 50 00 18 FF F0"),  # and its answers
    bytes.fromhex("FF FB 1F FF FB 20 FF FB 18 FF FB 27 FF FD 01 FF FB 03 FF FD 03"),  # PuTTY
    bytes.fromhex("FF FE 01 FF FE 03 FF FC 03 FF FC 1F"),  # one that refuses everything
    bytes.fromhex("FF FB 01 FF FB 03 FF FD 03 FF FD 1F"),  # what we say, sent back
    bytes.fromhex("FF FA 1F 00 FF FF 00 32 FF F0"),  # a window 255 columns wide
    bytes.fromhex("FF FA 18 00 78 74 65 72 6D FF F0"),  # the terminal's type
    bytes.fromhex("FF FA 22 03 01 03 00 03 62 03 04 02 0F 05 02 14 FF FF F0 FF F0"),  # LINEMODE
    bytes.fromhex("FF F6 FF F1 FF F9 FF EF"),  # are you there, and commands that mean nothing
    bytes.fromhex("FF F4 FF F2"),  # Ctrl-C: interrupt and data mark
    bytes.fromhex("FF F3 5B 41 FF F7 FF F8 FF F5"),
    b"\xff\xfa\x1f" + b"\xff\xff" * 120,
    b"m\r\0d\r\n3\r107\r\0\r\n",
    b"R\r\0N\r\x0017\r\x003\r\x00107\r\x001\x082\x7f4\x15\r\x00",
    b"\x1b[A\x1b[B\x1bOP\x1b[[A\x1b[1;5C\x1b[24~",
    b"\x1b\x1b[\x1bO\x1bm\x03\x1b\r",
    b"\x1b[" + b"1;" * 30,
    "contraseña ü € \U0001f525 漢 e\u0301\r\n".encode(),
    b"123456789",
    b"\xed\xa0\x80\xc3\xf0\x9f\xe2\x82\xff\xff",
]


class TelnetEar:
    """A telnet session without its socket and its menu."""

    def __init__(self) -> None:
        self._telnet, self._decoder = TelnetFilter(), KeyDecoder()
        self._editor = LineEditor(LIMIT)

    def take(self, how: int, data: bytes) -> None:
        text = self._telnet.receive(data)
        assert len(text) <= len(data) + 1  # an interrupt is two bytes of text, and its IAC may have come before
        assert self._telnet.pending <= SUBNEGOTIATION_MAX
        assert 40 <= self._telnet.columns <= 500
        assert 10 <= self._telnet.rows <= 200
        self._decoder.receive(text)
        if how & 1:
            self._judge_replies()
        if how & 6 == 6:
            self._pause()
        if how & 8:
            self._type()
        if how & 112 == 112:
            self._decoder.clear()
            assert self._decoder.next_key() is None

    def finish(self) -> None:
        """Whatever was unfinished: after the end of a subnegotiation and a pause, text is text and keys are keys."""
        self._decoder.receive(self._telnet.receive(b"\xff\xf0\xff\xf0"))  # the first may be an option's number
        self._pause()
        self._type()
        self._decoder.receive(self._telnet.receive(b"ok\r"))
        assert [self._decoder.next_key() for _ in range(4)] == ["o", "k", ENTER, None]
        self._judge_replies()
        assert self._telnet.replies() == b""

    def _pause(self) -> None:
        self._decoder.pause()
        assert not self._decoder.has_part

    def _judge_replies(self) -> None:
        replies = self._telnet.replies()
        assert len(replies) <= REPLIES_MAX
        assert ANSWERS.fullmatch(replies)

    def _type(self) -> None:
        count = 0
        while (key := self._decoder.next_key()) is not None:
            count += 1
            assert len(key) == 1
            assert key in KEYS or key.isprintable()
            self._edit(key)
        assert count <= KEYS_MAX

    def _edit(self, key: str) -> None:
        was = self._editor.text
        echo, outcome = self._editor.key(key)
        assert len(self._editor.text) <= LIMIT
        if outcome is Outcome.GOING_ON:
            assert self._editor.text == was + key or was.startswith(self._editor.text)
            assert echo in ("", key) or echo == "\b \b" * (len(echo) // 3)
        else:
            assert self._editor.text == was
            assert echo == ("\r\n" if outcome is Outcome.DONE else "")
            self._editor = LineEditor(LIMIT)
