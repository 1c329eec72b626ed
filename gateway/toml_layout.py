"""A TOML text cut into sections and entries, each with the blank lines and comments that belong to it.

Put together again it is the same text, to the character; an entry that is marked as gone leaves, with what belongs to
it, and nothing else. What belongs to an entry: the comment lines directly above it, what stands behind it on its line,
and, of a section, the comment lines directly below its last key. A comment with a blank line below it is free: it
stays whatever goes. Nothing here knows what a text says or should say (see ``toml_edit``).

Source: TOML v1.0.0; specification of rtugate, section 6. Pure.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from gateway.toml_text import Path, Statement, scan

BLANK: Final = " \t\r\n"
_LINE_END: Final = re.compile(r"(?:[ \t]*(?:#[^\n]*)?\r?\n)?")  # nothing but a comment to the end of the line
_COMMA: Final = re.compile(r"(?:\s++|#[^\n]*+\n)*,")  # no *+ around it: Python 3.11.2 gets that wrong (gh-106052)


@dataclass(slots=True, eq=False)
class Entry:
    """A key with its value, or an item of an array, with the text around it.

    key:       its parts, from the table or array it stands in: ("serial", "line"); (2,) for an item.
    before:    the blank lines, comments and blanks in front of it.
    spelled:   the key as it is written, with its equals sign; "" for an item.
    gap, rest: what stands behind the value: up to the comma, and from there to the end of the line.
    source:    where its value stands in the text, and what stands inside; None if it is new.
    """

    key: Path
    before: str
    spelled: str
    value: str
    rest: str
    gap: str = ""
    source: tuple[Statement, list[Statement]] | None = None
    is_gone: bool = False

    def text(self, comma: str = "") -> str:
        """Return all of it."""
        return f"{self.before}{self.spelled}{self.value}{self.gap}{comma}{self.rest}"

    @property
    def indent(self) -> str:
        return self.before.rpartition("\n")[2]


@dataclass(slots=True, eq=False)
class Section:
    """A header with the keys below it; the first one has none, and holds what stands above all headers.

    header:    its line, with the comments directly above; "" for the first section.
    rest:      the comment lines directly below its last key.
    tail:      everything from the first blank line on.
    following: the path of the section that came next in the text; () if none did.
    gone_with: what was deleted and took this along; None if it is still there.
    """

    path: Path
    header: str
    entries: list[Entry] = field(default_factory=list)
    rest: str = ""
    tail: str = ""
    following: Path = ()
    gone_with: Path | None = None

    def text(self, newline: str) -> str:
        """Return all of it."""
        lines = _Lines(newline)
        lines.add(self.header)
        for entry in self.entries:
            if entry.is_gone:
                lines.add_left_over(parted(entry.before)[0])
            else:
                lines.add(entry.text())
        lines.add(self.rest)
        lines.add(self.tail)
        return lines.text()

    @property
    def ends_gone(self) -> bool:
        """Whether it is gone, or its end."""
        has_end = bool(self.rest + self.tail) or not self.entries
        return self.gone_with is not None or (not has_end and self.entries[-1].is_gone)

    @property
    def is_bare(self) -> bool:
        """Whether it is the first section and holds no key: what it has are comments on the whole file."""
        return not self.path and not self.entries

    @property
    def indents(self) -> tuple[str, str]:
        """The indentation of its header and of its keys."""
        header = self.header.rstrip("\r\n").rpartition("\n")[2]
        indent = header[: len(header) - len(header.lstrip(" \t"))]
        return indent, self.entries[0].indent if self.entries else indent


@dataclass(slots=True, eq=False)
class Inline:
    """An array or an inline table.

    opening: its bracket, with the rest of the line if no item follows on it.
    closing: what stands in front of its other bracket, and that.
    """

    opening: str
    entries: list[Entry]
    closing: str
    ends_with_comma: bool

    def text(self, newline: str) -> str:
        """Return all of it, with the commas that it needs."""
        text = self.opening
        last = next((entry for entry in reversed(self.entries) if not entry.is_gone), None)
        for entry in self.entries:
            comma = "," if entry is not last or self.ends_with_comma else ""
            free = parted(entry.before)[0]
            if not entry.is_gone:
                text = self._followed(text, entry.before, newline) + entry.text(comma).removeprefix(entry.before)
            elif not free.isspace():
                text = self._followed(text, free, newline)
        return self._followed(text, self.closing, newline)

    @staticmethod
    def _followed(text: str, between: str, newline: str) -> str:
        """*text* and *between*, whose comments must not come to stand behind something on its line."""
        return text + (newline if "#" in between and not text.endswith("\n") else "") + between

    def fit_in(self, new: Entry, before: Entry | None, behind: Entry | None, newline: str) -> None:
        """Lay out a *new* entry as its neighbours are, on a line of its own if they are; None: there is no such."""
        neighbour = before or behind
        if neighbour is None:
            new.before, new.rest = ("    ", newline) if self.opening.endswith("\n") else (self.closing[:-1], "")
        elif neighbour.rest.endswith("\n"):
            new.before, new.rest = neighbour.indent, newline
        else:
            new.before, new.rest = (" " if before else neighbour.indent), ""
            if before is None:
                neighbour.before = neighbour.before or " "


class _Lines:
    """Lines put together, with no two runs of blank lines where something left."""

    def __init__(self, newline: str) -> None:
        self._newline = newline
        self._pieces: list[str] = []
        self._is_after_gap = False

    def add(self, piece: str) -> None:
        """Add lines that were there, or new ones."""
        if not piece:
            return
        if self._is_after_gap and (not self._pieces or _ends_blank(self._pieces[-1])):
            piece = piece[_lines_end(piece, "") :]
        self._is_after_gap = False
        if self._pieces and not self._pieces[-1].endswith("\n"):
            piece = self._newline + piece
        if piece:
            self._pieces.append(piece)

    def add_left_over(self, piece: str) -> None:
        """Add what remains of something that left: free comments and blank lines."""
        self._is_after_gap = True
        self.add(piece)
        self._is_after_gap = True

    def text(self) -> str:
        """Return them."""
        return "".join(self._pieces)


def joined(sections: list[Section], newline: str) -> str:
    """Return the text that *sections* make up."""
    lines = _Lines(newline)
    for section in sections:
        if section.gone_with is None:
            lines.add(section.text(newline))
        elif section.following[: len(section.gone_with)] != section.gone_with:  # else it stood inside of what is gone
            lines.add_left_over(section.tail)
    text = lines.text()
    if not sections[-1].ends_gone:
        return text
    kept = text.rstrip(BLANK)
    return kept + newline if kept else ""


def cut(text: str) -> list[Section]:
    """Return the sections of *text*, which is TOML."""
    section = Section((), "")
    found, at = [section], 0
    for statement, inner in _outermost(scan(text)):
        between, at = text[at : statement.start], text.find("\n", statement.end) + 1 or len(text)
        if statement.kind == "table":
            free, attached = parted(between)
            section.rest, section.tail = _below(free)
            section.following = statement.path
            section = Section(statement.path, attached + text[statement.start : at])
            found.append(section)
        else:
            section.entries.append(_entry(text, statement, inner, section.path, between, rest=text[statement.end : at]))
    section.rest, section.tail = _below(text[at:])
    return found


def cut_value(text: str, entry: Entry) -> Inline:
    """Return the array or inline table that is the value of *entry* in *text*."""
    assert entry.source is not None  # noqa: S101  (only what the text holds can be cut)
    whole, inside = entry.source
    at = _end(_LINE_END, text, whole.value_start + 1, whole.end)
    inline = Inline(text[whole.value_start : at], [], "", ends_with_comma=False)
    for statement, inner in _outermost(inside):
        between = text[at : statement.start]
        comma = _COMMA.match(text, statement.end, whole.end)
        behind = comma.end() if comma else statement.end
        at = _end(_LINE_END, text, behind, whole.end)
        found = _entry(text, statement, inner, whole.path, between, text[behind:at])
        found.gap = text[statement.end : behind - 1] if comma else ""
        inline.entries.append(found)
        inline.ends_with_comma = comma is not None
    inline.closing = text[at : whole.end]
    return inline


def parted(between: str) -> tuple[str, str]:
    """Return what stands in front of a statement in two parts: what is free, and what belongs to the statement."""
    start = between.rfind("\n") + 1
    while start:
        line = between.rfind("\n", 0, start - 1) + 1
        if not between[line:start].lstrip(BLANK).startswith("#"):
            break
        start = line
    return between[:start], between[start:]


def blank_lines_at_end(text: str) -> str:
    """Return the blank lines that *text* ends with."""
    kept = text.rstrip(BLANK)
    return text[len(kept) :].partition("\n")[2] if kept else text


def with_blank_line(text: str, newline: str) -> str:
    """Return *text* with a blank line at its end, if there is any text."""
    if not text or _ends_blank(text):
        return text
    return text + newline * (1 if text.endswith("\n") else 2)


def _entry(text: str, statement: Statement, inner: list[Statement], outer: Path, before: str, rest: str) -> Entry:
    return Entry(
        key=statement.path[len(outer) :],
        before=before,
        spelled=text[statement.start : statement.value_start],
        value=text[statement.value_start : statement.end],
        rest=rest,
        source=(statement, inner),
    )


def _outermost(statements: list[Statement]) -> Iterator[tuple[Statement, list[Statement]]]:
    """Each statement that lies in no other one, with those that lie in it."""
    at = 0
    while at < len(statements):
        outer, start = statements[at], at + 1
        at = start
        while at < len(statements) and statements[at].start < outer.end:
            at += 1
        yield outer, statements[start:at]


def _below(text: str) -> tuple[str, str]:
    """What stands below the last key of a section: the lines directly below, and the rest."""
    end = _lines_end(text, "#")
    return text[:end], text[end:]


def _lines_end(text: str, first: str) -> int:
    """Where the lines at the start of *text* end that are comments (*first* "#") or blank ("")."""
    at = 0
    while at < len(text):
        end = text.find("\n", at) + 1 or len(text)
        if text[at:end].strip(BLANK)[:1] != first:
            break
        at = end
    return at


def _ends_blank(piece: str) -> bool:
    line = piece.rfind("\n", 0, -1) + 1
    return piece.endswith("\n") and not piece[line:].strip(BLANK)


def _end(pattern: re.Pattern[str], text: str, start: int = 0, end: int | None = None) -> int:
    """Where a match of *pattern*, which may be empty, ends."""
    found = pattern.match(text, start, len(text) if end is None else end)
    return found.end() if found else start
