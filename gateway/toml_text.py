"""A TOML text as statements, each with its key path and its place.

``tomllib`` gives the values and says whether the text is TOML at all; this scanner only says where things stand, for
messages with line numbers and for edits that touch nothing else. It judges nothing and raises nothing, whatever the
text: what is no TOML yields some places or none. Time and memory grow with the length of the text, not faster.

A path is what leads to the value in the parsed document: ("master", 0, "request", 2, "count").

Source: TOML v1.0.0; specification of rtugate, section 6.
"""

from __future__ import annotations

import re
import tomllib
from bisect import bisect_left
from dataclasses import dataclass
from typing import Final, Literal

Path = tuple[str | int, ...]

DEEPEST: Final = 16  # parts of a path that are kept; a configuration needs 5, and what is deeper is no configuration

_TOKEN: Final = re.compile(
    r"""
      (?P<newline>\r?\n)
    | (?P<blank>[ \t]+|\#[^\n]*)
    | (?P<text>\"{3}(?>(?:[^"\\]++|\\.|"(?!""))*)"{3,5}
        | '{3}(?>(?:[^']++|'(?!''))*)'{3,5}
        | "(?:[^"\\\n]++|\\.)*+"
        | '[^'\n]*+')
    | (?P<bare>[^\s"'\#,=\[\]{}]++)
    | (?P<mark>.)
    """,
    re.VERBOSE | re.DOTALL,
)


@dataclass(frozen=True, slots=True)
class Statement:
    """One thing that the text says: the header of a table, a key with its value, or an item of an array.

    line:        where it starts, counted from 1.
    start, end:  its characters in the text, as a slice; a comment behind it is not part of it.
    value_start: where the value starts; for a header, its end.
    is_inline:   it stands inside another statement's value.
    """

    path: Path
    kind: Literal["table", "key", "item"]
    line: int
    start: int
    value_start: int
    end: int
    is_inline: bool


def scan(text: str) -> list[Statement]:
    """Return the statements of *text* in the order they start; paths are cut off after DEEPEST + 1 parts."""
    return _Scanner(text).scan()


class Places:
    """Where each path of a text stands; a path that does not stand there is found at what encloses it."""

    def __init__(self, statements: list[Statement]) -> None:
        self._exact: dict[Path, int] = {}
        self._implied: dict[Path, int] = {}  # tables that exist by dotted keys only
        for statement in statements:
            self._exact.setdefault(statement.path, statement.line)
            self._imply(statement)

    def _imply(self, statement: Statement) -> None:
        for length in range(len(statement.path) - 1, 0, -1):
            outer = statement.path[:length]
            if outer in self._implied:
                return
            self._implied[outer] = statement.line

    def line(self, path: Path) -> int | None:
        """The line of *path*, else of the nearest thing around it, else None."""
        for length in range(len(path), 0, -1):
            known = self._exact.get(path[:length]) or self._implied.get(path[:length])
            if known is not None:
                return known
        return None


class _Entry:
    """A key or an item whose value is not complete yet."""

    __slots__ = ("end", "kind", "path", "start", "value_start")

    def __init__(self, path: Path, kind: Literal["key", "item"], start: int, value: int) -> None:
        self.path, self.kind, self.start, self.value_start, self.end = path, kind, start, value, value


class _Open:
    """An array or an inline table whose closing bracket is still to come."""

    __slots__ = ("count", "entry", "is_array")

    def __init__(self, entry: _Entry, is_array: bool) -> None:
        self.entry, self.is_array, self.count = entry, is_array, 0


class _Scanner:
    def __init__(self, text: str) -> None:
        self._text = text
        self._newlines = [found.start() for found in re.finditer("\n", text)]
        self._found: list[Statement] = []
        self._table: Path = ()
        self._last_index: dict[Path, int] = {}  # of each [[array of tables]]
        self._open: list[_Open] = []
        self._entry: _Entry | None = None
        self._start_statement()

    def scan(self) -> list[Statement]:
        """Go once through the text."""
        for token in _TOKEN.finditer(self._text):
            kind = token.lastgroup
            if kind == "newline":
                self._newline()
            elif kind == "mark":
                if not self._mark(token.group(), token.start()):
                    break
            elif kind != "blank":
                self._word(token.group(), token.start(), token.end(), is_text=kind == "text")
        while self._open:  # only in a text that is no TOML, or too deep
            self._finish()
            self._entry = self._open.pop().entry
        self._finish()
        return sorted(self._found, key=lambda statement: statement.start)

    def _start_statement(self) -> None:
        self._in_key = True
        self._parts: list[str] = []
        self._key_start: int | None = None
        self._brackets = 0  # of a header: 1 or 2
        self._closed = 0

    def _newline(self) -> None:
        if not self._open:
            self._finish()
            self._start_statement()

    def _word(self, word: str, start: int, end: int, is_text: bool) -> None:
        if not self._in_key:
            entry = self._value_at(start)
            if entry is not None:
                entry.end = end
            return
        if self._key_start is None:
            self._key_start = start
        if len(self._parts) <= DEEPEST:
            parts = [_unquote(word)] if is_text else [part for part in word.split(".") if part]
            self._parts += parts[: DEEPEST + 1]

    def _mark(self, mark: str, start: int) -> bool:
        """Take one character of punctuation; return False when nothing sensible can follow."""
        if mark in "\"'":  # a quote that is never closed
            return False
        if mark in "[{" and not self._at_header(mark):
            return self._open_bracket(mark, start)
        if mark == "[":
            self._key_start = start if self._key_start is None else self._key_start
            self._brackets += 1
        elif mark == "=" and self._in_key:
            self._equals(start)
        elif mark == ",":
            self._comma()
        elif mark in "]}":
            self._close_bracket(mark, start + 1)
        return True

    def _at_header(self, mark: str) -> bool:
        return mark == "[" and self._in_key and not self._open

    def _equals(self, at: int) -> None:
        outer = self._open[-1].entry.path if self._open else self._table
        start = at if self._key_start is None else self._key_start
        self._entry = _Entry((*outer, *self._parts)[: DEEPEST + 1], "key", start, -1)
        self._in_key = False

    def _value_at(self, start: int) -> _Entry | None:
        """The entry that a value starting at *start* belongs to; in an array it may be a new item."""
        if self._entry is None and self._open and self._open[-1].is_array:
            array = self._open[-1]
            path = (*array.entry.path, array.count)[: DEEPEST + 1]
            self._entry = _Entry(path, "item", start, start)
            array.count += 1
        if self._entry is not None and self._entry.value_start < 0:
            self._entry.value_start = start
        return self._entry

    def _open_bracket(self, mark: str, start: int) -> bool:
        entry = None if self._in_key else self._value_at(start)
        if entry is None or len(self._open) > DEEPEST:
            return False
        entry.end = start + 1
        self._open.append(_Open(entry, is_array=mark == "["))
        self._entry = None
        self._next()
        return True

    def _close_bracket(self, mark: str, end: int) -> None:
        if self._open:
            self._finish()
            self._entry = self._open.pop().entry
            self._entry.end = end
            self._in_key = False
        elif mark == "]" and self._brackets:
            self._closed += 1
            if self._closed == self._brackets:
                self._header(end)

    def _comma(self) -> None:
        if self._open:
            self._finish()
            self._next()

    def _next(self) -> None:
        """Expect the next item of the innermost array, or the next key of the innermost inline table."""
        self._start_statement()
        self._in_key = not self._open[-1].is_array

    def _header(self, end: int) -> None:
        path: Path = ()
        for part in self._parts[:-1]:
            path = (*path, part)
            if path in self._last_index:
                path = (*path, self._last_index[path])
        path = (*path, *self._parts[-1:])
        if self._brackets > 1:
            self._last_index[path] = self._last_index.get(path, -1) + 1
            path = (*path, self._last_index[path])
        self._table = path[: DEEPEST + 1]
        start = end if self._key_start is None else self._key_start
        self._add(self._table, "table", start, end, end)

    def _finish(self) -> None:
        entry, self._entry = self._entry, None
        if entry is not None and entry.value_start >= 0:
            self._add(entry.path, entry.kind, entry.start, entry.value_start, entry.end)

    def _add(self, path: Path, kind: Literal["table", "key", "item"], start: int, value: int, end: int) -> None:
        line = bisect_left(self._newlines, start) + 1
        self._found.append(Statement(path, kind, line, start, value, end, bool(self._open)))


def _unquote(text: str) -> str:
    """The key that a quoted *text* stands for."""
    if text[0] == "'" or "\\" not in text:
        return text[1:-1]
    try:
        return str(tomllib.loads(f"key = {text}")["key"])
    except tomllib.TOMLDecodeError:
        return text[1:-1]
