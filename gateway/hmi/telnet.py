"""Telnet commands out of a byte stream, and what is to be answered (spec section 5).

Pure: what a client sent goes in, its text comes out, and what it has to be told; no sockets, no clock. The server asks
for character mode (it echoes, nobody goes ahead) and for the size of the window, and refuses every other option.

It never loops: each option is in one of three states, and only a change of state is answered (RFC 1143; its states for
a server that changes its mind are not needed here). No bytes, however cut, make it raise, keep more than
``SUBNEGOTIATION_MAX`` bytes of anything unfinished, or answer more than ``REPLIES_MAX`` bytes between two looks.

Whoever reads the socket sets SO_OOBINLINE: clients send half of the data mark behind an interrupt as urgent data (RFC
854, "The TELNET Synch signal"), and without it that half is missing from the stream.

Source: RFC 854, 855 (commands, options), 857 (echo), 858 (suppress go ahead), 1073 (window size), 1143.
Threads: one session has one filter.
"""

from __future__ import annotations

from enum import Enum, auto
from typing import Final

# Commands, RFC 854, after an IAC
SE: Final = 240  # the subnegotiation ends
BRK, IP, AYT, EC, EL = 243, 244, 246, 247, 248  # break, interrupt, are you there, erase character, erase line
SB, WILL, WONT, DO, DONT, IAC = 250, 251, 252, 253, 254, 255

ECHO, SUPPRESS_GO_AHEAD, NAWS = 1, 3, 31  # options

COLUMNS, ROWS = 80, 24  # of a terminal that does not say
COLUMNS_MIN, COLUMNS_MAX, ROWS_MIN, ROWS_MAX = 40, 500, 10, 200
SUBNEGOTIATION_MAX: Final = 256  # bytes kept; we understand one of 5
REFUSALS_MAX: Final = 240  # bytes of replies that refusals may fill; far more options than there are clients' wishes
REPLIES_MAX: Final = 300

_ASKED: Final = ((WILL, ECHO), (WILL, SUPPRESS_GO_AHEAD), (DO, SUPPRESS_GO_AHEAD), (DO, NAWS))
_OURS: Final = {DO: WILL, DONT: WILL, WILL: DO, WONT: DO}  # the client's word, and which of ours it is about
_AGREEMENTS: Final = {DO: WILL, DONT: WONT, WILL: DO, WONT: DONT}
_REFUSALS: Final = {DO: WONT, WILL: DONT}
_KEYS: Final = {  # what a command is as a key; the NUL parts Esc from a "[" behind it, which would make it an arrow key
    IAC: b"\xff", IP: b"\x1b\0", BRK: b"\x1b\0", EC: b"\b", EL: b"\x15",
}  # fmt: skip
_HERE: Final = b"\r\n[rtugate is here]\r\n"

# What the next byte is. Numbers: with an Enum a storm of commands takes three times as long on Python 3.11.
_TEXT: Final = 0
_COMMAND: Final = 1  # behind an IAC
_OPTION: Final = 2  # behind WILL, WONT, DO, DONT
_SUBNEGOTIATION: Final = 3
_SUBNEGOTIATION_COMMAND: Final = 4  # behind an IAC in it


class _Option(Enum):
    """How an option of ours stands (RFC 1143, section 7: WANTYES, YES, NO)."""

    ASKED = auto()
    ON = auto()
    OFF = auto()


class TelnetFilter:
    """One telnet client's stream; see the module. ``columns`` and ``rows`` are its window's."""

    def __init__(self) -> None:
        self.columns = COLUMNS
        self.rows = ROWS
        self._options = dict.fromkeys(_ASKED, _Option.ASKED)
        self._reading: int = _TEXT
        self._verb = 0
        self._subnegotiation = bytearray()
        self._replies = bytearray()

    def start(self) -> bytes:
        """Return what the server sends first."""
        return b"".join(bytes((IAC, verb, option)) for verb, option in _ASKED)

    @property
    def echoes(self) -> bool:
        """The client has agreed that we echo."""
        return self._options[WILL, ECHO] is _Option.ON

    @property
    def refuses_characters(self) -> bool:
        """The client has said that it echoes, or sends whole lines: it edits them itself."""
        return _Option.OFF in (self._options[WILL, ECHO], self._options[WILL, SUPPRESS_GO_AHEAD])

    @property
    def pending(self) -> int:
        """Bytes held of a subnegotiation that is not complete yet."""
        return len(self._subnegotiation)

    def receive(self, data: bytes) -> bytes:
        """Take what has come, in pieces of any size; return the text in it.

        Commands that are keys come as such: interrupt and break as Esc and NUL, the erasing ones as backspace and
        Ctrl-U. Line ends are left as they are.
        """
        text = bytearray()
        at = 0
        while at < len(data):
            if self._reading in (_TEXT, _SUBNEGOTIATION):
                at = self._run(data, at, text)
            else:
                text += self._byte(data[at])
                at += 1
        return bytes(text)

    def replies(self) -> bytes:
        """Return what has to be sent because of what was received, once; at most ``REPLIES_MAX`` bytes."""
        replies = bytes(self._replies)
        self._replies.clear()
        return replies

    @staticmethod
    def quoted(text: bytes) -> bytes:
        """Return *text* as telnet carries it: an 0xFF in it is no command."""
        return text.replace(b"\xff", b"\xff\xff")

    # -------------------------------------------------------------------------------------------- commands

    def _run(self, data: bytes, at: int, text: bytearray) -> int:
        """Take everything up to the next IAC, and it; return where to go on."""
        found = data.find(IAC, at)
        stop = found if found >= 0 else len(data)
        if self._reading == _TEXT:
            text += data[at:stop]
            behind = _COMMAND
        else:
            self._hold(data[at:stop])
            behind = _SUBNEGOTIATION_COMMAND
        if found >= 0:
            self._reading = behind
        return stop + 1

    def _byte(self, byte: int) -> bytes:
        """Take a byte behind an IAC; return it as text, if it is any."""
        if self._reading == _COMMAND:
            return self._command(byte)
        if self._reading == _OPTION:
            self._reading = _TEXT
            self._negotiate(self._verb, byte)
            return b""
        if byte == IAC:
            self._reading = _SUBNEGOTIATION
            self._hold(b"\xff")
            return b""
        if byte == SE and len(self._subnegotiation) == 5 and self._subnegotiation[0] == NAWS:
            self._resize(self._subnegotiation)
        self._subnegotiation.clear()
        return self._command(byte)  # SE does nothing; anything else says that SE is missing

    def _command(self, byte: int) -> bytes:
        self._reading = _TEXT
        if byte in _OURS:
            self._reading, self._verb = _OPTION, byte
        elif byte == SB:
            self._reading = _SUBNEGOTIATION
        elif byte == AYT:
            self._reply(_HERE, REFUSALS_MAX)
        return _KEYS.get(byte, b"")

    def _hold(self, data: bytes) -> None:
        self._subnegotiation += data[: SUBNEGOTIATION_MAX - len(self._subnegotiation)]

    def _resize(self, told: bytearray) -> None:
        """RFC 1073: the option, then width and height, two bytes each; 0: the client does not say."""
        columns = int.from_bytes(told[1:3], "big") or COLUMNS
        rows = int.from_bytes(told[3:5], "big") or ROWS
        self.columns = min(max(columns, COLUMNS_MIN), COLUMNS_MAX)
        self.rows = min(max(rows, ROWS_MIN), ROWS_MAX)

    # -------------------------------------------------------------------------------------------- options

    def _negotiate(self, verb: int, option: int) -> None:
        """The client says *verb* of *option*. A change that finds no room for its answer does not take place."""
        ours = (_OURS[verb], option)
        after = _Option.ON if verb in _REFUSALS else _Option.OFF
        match self._options.get(ours):
            case None:
                if verb in _REFUSALS:  # that something is not done needs no answer
                    self._reply(bytes((IAC, _REFUSALS[verb], option)), REFUSALS_MAX)
            case _Option.ASKED:
                self._options[ours] = after
            case before:
                if before is not after and self._reply(bytes((IAC, _AGREEMENTS[verb], option)), REPLIES_MAX):
                    self._options[ours] = after

    def _reply(self, data: bytes, most: int) -> bool:
        """Say *data* unless replies would then be more than *most* bytes; returns whether."""
        is_room = len(self._replies) + len(data) <= most
        if is_room:
            self._replies += data
        return is_room
