"""Bytes of a terminal to keys, and keys to a line of text (spec section 5).

Pure: the bytes that a person's terminal sends, by whatever way they came, and no clock: whoever has one says when
nothing came for a while (``KeyDecoder.pause``), which is how the key Esc is told from the arrow keys.

Every terminal is understood that sends UTF-8 or ASCII: PuTTY, telnet, screen, picocom, the Linux console. Keys that
mean nothing here (arrows, function keys, other control characters) and bytes that are no UTF-8 are nothing.

Source: RFC 854 (CR NUL, CR LF); ECMA-48, section 5.4 (control sequences).
Threads: one session has one decoder; a line being typed has one editor.
"""

from __future__ import annotations

import codecs
import unicodedata
from collections import deque
from enum import Enum, auto
from typing import Final

ENTER, ERASE, ERASE_LINE, ESC = "\r", "\b", "\x15", "\x1b"

KEYS_MAX: Final = 4096  # kept until somebody takes them
SEQUENCE_MAX: Final = 32  # characters; no key sends more

_CONTROLS: Final = {
    "\r": ENTER,
    "\n": ENTER,
    "\b": ERASE,
    "\x7f": ERASE,  # what most terminals send for the backspace key
    "\x15": ERASE_LINE,  # Ctrl-U
    "\x03": ESC,  # Ctrl-C
}
_CSI: Final = ESC + "["
_TAKE_OFF: Final = "\b \b"


class KeyDecoder:
    """Keys out of a terminal's bytes; see the module.

    At most ``KEYS_MAX`` keys wait to be taken; what comes when they are that many is dropped. (A person does not type
    so far ahead. An escape sequence or a letter is dropped as a whole.)
    """

    def __init__(self) -> None:
        self._letters = codecs.getincrementaldecoder("utf-8")("ignore")
        self._keys: deque[str] = deque()
        self._sequence = ""  # what has come of an escape sequence
        self._after_return = False  # the last character was a CR, and ended the line already

    @property
    def has_part(self) -> bool:
        """An Esc, a part of an escape sequence or of a letter waits for the rest, or for ``pause``."""
        return bool(self._sequence or self._letters.getstate()[0])

    def receive(self, data: bytes) -> None:
        """Take what has come, in pieces of any size."""
        for character in self._letters.decode(data):
            self._take(character)

    def next_key(self) -> str | None:
        """Return the next key: a printable character, or one of the four named above; None: no more."""
        return self._keys.popleft() if self._keys else None

    def pause(self) -> None:
        """Nothing came for 50 ms: an Esc is the key Esc; a part of anything else is forgotten."""
        if self._sequence == ESC:
            self._keep(ESC)
        self._forget_part()

    def clear(self) -> None:
        """Forget the keys nobody has taken. A LF that belongs to a CR before stays a part of it."""
        self._keys.clear()
        self._forget_part()

    def _forget_part(self) -> None:
        self._sequence = ""
        self._letters.reset()

    def _take(self, character: str) -> None:
        if self._sequence and self._in_sequence(character):
            return
        is_rest_of_end = self._after_return and character == "\n"  # or a NUL, which is nothing anywhere
        self._after_return = character == "\r"
        if character == ESC:
            self._sequence = ESC
        elif character in _CONTROLS and not is_rest_of_end:
            self._keep(_CONTROLS[character])
        elif character.isprintable():
            self._keep(character)

    def _in_sequence(self, character: str) -> bool:
        """Take what belongs to the sequence; returns False for the first character that does not."""
        sequence, self._sequence = self._sequence, ""
        if sequence == ESC:
            if character in "[O":  # of CSI and SS3; what else follows Esc was typed after it
                self._sequence = ESC + character
                return True
            self._keep(ESC)
            return False
        is_inside = " " <= character <= "?" or (sequence == _CSI and character == "[")  # the Linux console: ESC [ [ A
        if is_inside and len(sequence) + 1 < SEQUENCE_MAX:
            self._sequence = sequence + character
        return is_inside or "@" <= character <= "~"

    def _keep(self, key: str) -> None:
        if len(self._keys) < KEYS_MAX:
            self._keys.append(key)


# ------------------------------------------------------------------------------------------------ a line being typed


class Outcome(Enum):
    """What a key has made of a line."""

    GOING_ON = auto()
    DONE = auto()  # Enter
    ESCAPE = auto()  # Esc
    OVERFLOW = auto()  # a character more than there is room for; it was not taken


class LineEditor:
    """One line being typed: its ``text``, and what the terminal has to be shown."""

    def __init__(self, limit: int = 8, hidden: bool = False) -> None:
        """*limit*: characters at most; *hidden*: a password, of which nothing is shown."""
        self.text = ""
        self.limit = limit
        self.hidden = hidden

    def key(self, key: str) -> tuple[str, Outcome]:
        """Take a key of ``KeyDecoder``; return what to show, with line ends as CR LF, and what came of it."""
        match key:
            case "\r":
                return "\r\n", Outcome.DONE
            case "\x1b":
                return "", Outcome.ESCAPE
            case "\b":
                return self._erase(_last_letter(self.text)), Outcome.GOING_ON
            case "\x15":
                return self._erase(len(self.text)), Outcome.GOING_ON
        if len(key) != 1 or not key.isprintable():
            return "", Outcome.GOING_ON
        if len(self.text) >= self.limit:
            return "", Outcome.OVERFLOW
        self.text += key
        return "" if self.hidden else key, Outcome.GOING_ON

    def _erase(self, count: int) -> str:
        """Take *count* characters off the end; return what does the same on the screen."""
        kept = len(self.text) - count
        erased, self.text = self.text[kept:], self.text[:kept]
        return "" if self.hidden else _TAKE_OFF * sum(map(_columns, erased))


def _last_letter(text: str) -> int:
    """Return how many characters the last letter of *text* has: its accents may come after it, each as one."""
    count = min(1, len(text))
    while count < len(text) and _columns(text[-count]) == 0:
        count += 1
    return count


def _columns(character: str) -> int:
    """Return how wide a terminal shows *character*: 0 for an accent that goes onto the one before, 2 for a wide one."""
    if unicodedata.category(character) in ("Mn", "Me"):
        return 0
    return 2 if unicodedata.east_asian_width(character) in "WF" else 1
