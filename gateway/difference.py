"""What differs between two texts of the configuration, as lines for a person.

Secrets are never shown, also where a text is damaged; nor is a blank line, which says nothing. A text that is no TOML
is compared as well, only that then nothing is said about where its lines belong.

Source: specification of rtugate, sections 5 and 6. Pure.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterator
from typing import Any, Final

from gateway import store, toml_text
from gateway.config_fields import SECRETS, escaped

LINE_CHARACTERS: Final = 1000  # of a line that are shown
HIDDEN: Final = "***"

_SECRET: Final = re.compile(rf"""\b({"|".join(sorted(SECRETS))})\b(["']?\s*=\s*)(?!\*\*\*)\S.*""")
_OPEN_SECRET: Final = re.compile(rf"""\b({"|".join(sorted(SECRETS))})\b["']?\s*=\s*("{{3}}|'{{3}})""")


def difference(old_text: str, new_text: str) -> list[str]:
    """Return what has to leave *old_text* ("- count = 3") and what comes ("+ count = 4") to make *new_text* of it.

    In front of such lines stands what they belong to: `master "field", request "boiler"` or `[hmi.serial]`. Control
    characters are escaped.
    """
    old, new = _Text(old_text), _Text(new_text)
    said: list[str] = []
    about = ""
    for mark, text, n in _changed(old, new):
        if not text.shown[n].strip():
            continue
        if text.subjects[n] != about:
            about = text.subjects[n]
            said += [about] if about else []
        said.append(f"{mark} {escaped(text.shown[n].expandtabs(4), LINE_CHARACTERS)}")
    return said


class _Text:
    """The lines of a text: as they are compared, as they are shown, and what each belongs to."""

    def __init__(self, text: str) -> None:
        statements = toml_text.scan(text)
        self.lines = _lines(text)
        try:
            data = tomllib.loads(text)
        except (ValueError, RecursionError):  # no TOML: nobody knows where a value ends
            self.subjects = [""] * len(self.lines)
            self.shown = _without_rest(self.lines)
        else:
            self.subjects = _subjects(data, statements, self.lines)
            self.shown = [_hidden(line) for line in _lines(_without_secrets(text, statements))]


def _lines(text: str) -> list[str]:
    return [line.removesuffix("\r") for line in text.split("\n")]


def _hidden(line: str) -> str:
    """*line* without a secret that it may still hold, in a comment."""
    return _SECRET.sub(rf"\1\2{HIDDEN}", line)


def _without_rest(lines: list[str]) -> list[str]:
    """*lines* without all that stands behind the name of a secret, and below it if it may go on there."""
    opening = next((n for n, line in enumerate(lines) if _OPEN_SECRET.search(line)), len(lines))
    return [_hidden(line) if n <= opening else HIDDEN for n, line in enumerate(lines)]


def _without_secrets(text: str, statements: list[toml_text.Statement]) -> str:
    """*text* with as many lines, whose secrets are hidden."""
    pieces, at = [], 0
    for one in statements:
        if one.path and one.path[-1] in SECRETS and one.kind == "key" and one.start >= at:
            lines_inside = text.count("\n", one.value_start, one.end)
            pieces += [text[at : one.value_start], HIDDEN, "\n" * lines_inside]
            at = one.end
    return "".join([*pieces, text[at:]])


def _subjects(data: dict[str, Any], statements: list[toml_text.Statement], lines: list[str]) -> list[str]:
    """What each line belongs to: comments to what stands directly below them, else to what stands above."""
    first_on_line: dict[int, toml_text.Statement] = {}
    for one in statements:
        first_on_line.setdefault(one.line - 1, one)
    subjects: list[str | None] = [_subject(first_on_line.get(n), data) for n in range(len(lines))]
    for n in range(len(lines) - 2, -1, -1):
        if subjects[n] is None and lines[n].lstrip().startswith("#"):
            subjects[n] = subjects[n + 1]
    found, about = [], ""
    for subject in subjects:
        about = about if subject is None else subject
        found.append(about)
    return found


def _subject(statement: toml_text.Statement | None, data: dict[str, Any]) -> str | None:
    if statement is None:
        return None
    path = (*statement.path, "") if statement.kind == "table" else statement.path
    return store.subject(path, data)


def _changed(old: _Text, new: _Text) -> Iterator[tuple[str, _Text, int]]:
    """Each line that leaves ("-") or comes ("+"), with its text and its number there, from 0."""
    start = 0
    while start < min(len(old.lines), len(new.lines)) and old.lines[start] == new.lines[start]:
        start += 1
    matcher = difflib.SequenceMatcher(None, old.lines[start:], new.lines[start:])
    for tag, old_start, old_end, new_start, new_end in matcher.get_opcodes():
        if tag != "equal":
            yield from (("-", old, start + n) for n in range(old_start, old_end))
            yield from (("+", new, start + n) for n in range(new_start, new_end))
