"""Random TOML texts of a configuration, in every legal style, with comments that can be told apart and found again.

Each comment has a tag and belongs to something: it stands directly above a header, a key or an item, or behind it on
its line, or it is free between blank lines. What it belongs to is named by a path in which an entry of a list is its
uid, so that it stays the same whatever the entry is called and wherever it stands.
"""

from __future__ import annotations

import itertools
import random
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from gateway.toml_text import Path, Statement, scan
from tests.random_configs import Item

TAG = re.compile(r"<tag\d+>")


@dataclass(frozen=True)
class Comment:
    """Where a comment stands: "above" or "behind" *owner*; a "free" one stands in *owner*, or next to it."""

    tag: str
    place: Literal["above", "behind", "free"]
    owner: Path


def identity(path: Path, data: Any) -> Path:
    """*path* in *data* with uids for entries, and with the values of the items of other lists."""
    found: Path = ()
    for part in path:
        data = data[part] if isinstance(part, int) else data.get(part, {})  # the text may have an empty one more
        item = data.uid if isinstance(data, Item) else f"item {data!r}"
        found = (*found, item if isinstance(part, int) else part)
    return found


class RandomText:
    """One text for *data*."""

    _tags = itertools.count()

    def __init__(self, data: Mapping[str, Any], rng: random.Random) -> None:
        self._data = data
        self._rng = rng
        self._lines: list[str] = []
        self.comments: list[Comment] = []
        self._blank_between = rng.randint(0, 2)
        self._indent = rng.choice(["", "", "  ", "\t"])
        self._inner_indent = rng.choice(["", "", "  "])
        self._spell()
        text = "\n".join(self._lines) + rng.choice(["\n", "\n", "", "\n\n"])
        self.text = text.replace("\n", "\r\n") if rng.random() < 0.3 else text

    # --- the whole

    def _spell(self) -> None:
        if self._rng.random() < 0.5:
            self._free(())
        above_all: list[tuple[str, Any]] = []
        blocks: list[tuple[str, Any]] = []
        for key, value in self._sampled(self._data):
            styles = {"keys": above_all, "headers": blocks}
            if value in ({}, []):
                continue
            style = self._rng.choice(["keys", "headers", "headers", "headers", "headers"])
            styles[style].append((key, value))
        for key, value in above_all:
            self._keys((key,), value, (key,))
        groups = [group for key, value in blocks for group in self._groups((key,), value)]
        for group in self._interleaved(groups):
            self._section(*group)

    def _sampled(self, table: Mapping[str, Any]) -> list[tuple[str, Any]]:
        return self._rng.sample(list(table.items()), len(table))

    def _groups(self, path: Path, value: Any) -> Iterator[list[tuple[Path, Any]]]:
        """The sections of a table or list in groups whose order does not matter; within one it does."""
        if isinstance(value, Mapping):
            inner = [(key, inside) for key, inside in value.items() if isinstance(inside, Mapping) and inside]
            inner = [one for one in inner if self._rng.random() < 0.7]
            own = {key: inside for key, inside in value.items() if key not in dict(inner)}
            if own or self._rng.random() < 0.3:
                yield [(path, own)]
            yield from ([((*path, key), inside)] for key, inside in inner)
            return
        group = []
        for i, entry in enumerate(value):
            own = dict(entry)
            requests = own.pop("request", []) if self._rng.random() < 0.8 else []
            group.append(((*path, i), own))
            group += [((*path, i, "request", j), request) for j, request in enumerate(requests)]
        yield group

    def _interleaved(self, groups: list[list[tuple[Path, Any]]]) -> Iterator[tuple[Path, Any]]:
        """All of *groups*, mostly one after the other, sometimes with others in between."""
        groups = self._rng.sample(groups, len(groups))
        while groups:
            n = 0 if self._rng.random() < 0.9 else self._rng.randrange(len(groups))
            yield groups[n].pop(0)
            if not groups[n]:
                del groups[n]

    def _section(self, path: Path, keys: Mapping[str, Any]) -> None:
        indent = self._inner_indent if len(path) > 2 else ""
        names = [self._key(part) for part in path if isinstance(part, str)]
        blank = self._rng.choice(["", "", " "])
        dot = self._rng.choice([".", ".", " . "])
        header = f"[{blank}{dot.join(names)}{blank}]"
        owner = identity(path, self._data)
        self._blank_lines(self._blank_between)
        if self._rng.random() < 0.15:
            self._free(owner)
        self._statement(indent, f"[{header}]" if isinstance(path[-1], int) else header, owner)
        for key, value in self._sampled(keys):
            self._keys((*path, key), value, (key,), indent + self._indent)

    # --- keys and values

    def _keys(self, path: Path, value: Any, spelled: Path, indent: str = "") -> None:
        """A key with its value, or a table as several dotted keys."""
        if isinstance(value, Mapping) and value and self._rng.random() < 0.7:
            for key, inside in self._sampled(value):
                self._keys((*path, key), inside, (*spelled, key), indent)
            return
        if self._rng.random() < 0.1:
            self._blank_lines(1)
        if self._rng.random() < 0.04:
            self._blank_lines(1)
            self._free(identity(path[:-1], self._data))
        equals = self._rng.choice([" = ", " = ", "=", "  =\t"])
        dot = self._rng.choice([".", ".", " . "])
        key = dot.join(self._key(part) for part in spelled)
        self._statement(indent, f"{key}{equals}{self._value(path, value, indent)}", identity(path, self._data))

    def _key(self, part: str | int) -> str:
        part = str(part)
        escaped = "".join(f"\\u{ord(c):04x}" if self._rng.random() < 0.2 else c for c in part)
        return self._rng.choice([part, part, part, part, f"'{part}'", f'"{escaped}"'])

    def _value(self, path: Path, value: Any, indent: str) -> str:
        if isinstance(value, Mapping):
            keys = [
                f"{self._key(key)} = {self._value((*path, key), inside, indent)}"
                for key, inside in self._sampled(value)
            ]
            blank = self._rng.choice(["", " "])
            return "{" + blank + self._rng.choice([",", ", "]).join(keys) + blank + "}"
        if isinstance(value, list):
            return self._list(path, value, indent)
        if isinstance(value, bool):
            return str(value).lower()
        if isinstance(value, str):
            return self._string(value)
        return self._number(path[-1], value)

    def _number(self, key: Any, value: float) -> str:
        if isinstance(value, float):
            return self._rng.choice([repr(value), f"{value:e}", f"+{value!r}"] if value >= 0 else [repr(value)])
        if key == "address" and value > 9999:  # in decimal it would look like a reference number
            return hex(value)
        spellings = [str(value)] * 4
        if value >= 0:
            spellings += [hex(value), oct(value), f"+{value}", f"{value:_}", bin(value)]
        return self._rng.choice(spellings)

    def _string(self, value: str) -> str:
        plain = value.replace("\\", "\\\\").replace('"', '\\"')
        spellings = [f'"{plain}"', f'"{plain}"', f'"""{plain}"""', f'"""\n{plain}\\\n   """']
        if not value[-1:].isspace():
            spellings.append(f'"""\\\n  {plain}"""' if value[:1] != " " else f'"{plain}"')
        if "'" not in value:
            spellings += [f"'{value}'", f"'''{value}'''", f"'''\n{value}'''"]
        return self._rng.choice(spellings if value else ['""', "''", '"""\n"""'])

    def _list(self, path: Path, value: list[Any], indent: str) -> str:
        items = [self._value((*path, i), item, indent) for i, item in enumerate(value)]
        if self._rng.random() < 0.4 or not self._may_hold_comments(path):
            blank = self._rng.choice(["", " "])
            comma = "," if items and self._rng.random() < 0.2 else ""
            return "[" + blank + self._rng.choice([",", ", "]).join(items) + comma + blank + "]"
        text = "[" + self._new_comment("free", identity(path, self._data), " ", 0.1) + "\n"
        for i, item in enumerate(items):
            owner = identity((*path, i), self._data)
            is_first = text.endswith("\n")  # on its line
            if is_first and self._rng.random() < 0.1:
                text += "\n" + indent + self._new_comment("free", identity(path, self._data), "", 1) + "\n\n"
            if is_first and self._rng.random() < 0.3:
                text += f"{indent}  {self._new_comment('above', owner, '', 1)}\n"
            comma = "," if i + 1 < len(items) or self._rng.random() < 0.5 else ""
            behind = self._new_comment("behind", owner, " ", 0.3)
            if comma and behind and self._rng.random() < 0.2:
                text += f"{indent}  {item}{behind}\n{indent}  ,\n"
            elif not comma or behind or self._rng.random() < 0.8:
                text += f"{indent}  {item}{comma}{behind}\n"
            else:
                text += f"{indent}  {item}{comma}"
        closing = self._new_comment("free", identity(path, self._data), "", 0.1 if text.endswith("\n") else 0)
        return f"{text}{indent}{closing}\n{indent}]"

    @staticmethod
    def _may_hold_comments(path: Path) -> bool:
        return path[-1] in ("allow", "functions", "retain", "request", "master", "slave", "io")

    # --- comments and blank lines

    def _statement(self, indent: str, text: str, owner: Path) -> None:
        above = 0
        while self._rng.random() < (0.25 if above == 0 else 0.4):
            self._lines.append(indent + self._new_comment("above", owner, "", 1))
            above += 1
        self._lines.append(indent + text + self._new_comment("behind", owner, self._rng.choice([" ", "", "\t "]), 0.2))

    def _new_comment(self, place: Literal["above", "behind", "free"], owner: Path, blank: str, chance: float) -> str:
        if self._rng.random() >= chance:
            return ""
        comment = Comment(f"<tag{next(self._tags)}>", place, owner)
        self.comments.append(comment)
        noise = ["", " = 1", ' """', " '''", " [x]", " \\", " }, ü", " ]", '"', " # ,"]
        return f"{blank}#{self._rng.choice(noise)} {comment.tag}{self._rng.choice(noise)}"

    def _free(self, owner: Path) -> None:
        if self._lines and self._lines[-1].strip():
            self._lines.append("")
        for _ in range(self._rng.randint(1, 3)):
            self._lines.append(self._new_comment("free", owner, "", 1))
        self._lines.append(self._rng.choice(["", "  "]))

    def _blank_lines(self, most: int) -> None:
        self._lines += [self._rng.choice(["", "", " "]) for _ in range(self._rng.randint(0, most))]


def misplaced(text: str, data: Mapping[str, Any], comments: list[Comment]) -> list[str]:
    """What is wrong with *comments*, all of which have to be in *text*, each at its place."""
    statements = scan(text)
    where = {one.start: identity(one.path, data) for one in statements}
    found = {match.group(): match.start() for match in TAG.finditer(text)}
    wrong = []
    for comment in comments:
        if comment.tag not in found:
            wrong.append(f"lost: {comment}")
        elif comment.owner not in _beside(text, comment, found[comment.tag], statements, where):
            wrong.append(f"moved: {comment}")
    return wrong


def _beside(
    text: str, comment: Comment, at: int, statements: list[Statement], where: dict[int, Path]
) -> list[Path | None]:
    """What *comment* belongs to by the place *at* which it stands."""
    if comment.place == "free":
        return [comment.owner]  # it may stand anywhere
    return [_below(text, at, where)] if comment.place == "above" else [*_before(text, at, statements, where)]


def doubled(text: str) -> list[str]:
    tags = TAG.findall(text)
    return [tag for tag in set(tags) if tags.count(tag) > 1]


def _below(text: str, at: int, where: dict[int, Path]) -> Path | None:
    """What stands directly below the comment at *at*."""
    lines = text[at:].split("\n")[1:]
    start = at + len(text[at:].split("\n")[0]) + 1
    for line in lines:
        if not line.lstrip(" \t").startswith("#"):
            start += len(line) - len(line.lstrip(" \t"))
            return where.get(start)
        start += len(line) + 1
    return None


def _before(text: str, at: int, statements: list[Statement], where: dict[int, Path]) -> list[Path]:
    """What ends on the line of the comment at *at*, in front of it."""
    line = text.rfind("\n", 0, at)
    return [where[one.start] for one in statements if line < one.end <= at]
