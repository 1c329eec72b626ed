"""Edits of a TOML text: it is changed only where it says something else than is wanted.

Comments, order, spelling and layout stay. A key that is no longer wanted goes, and a table, with the comments that
belong to it (see ``toml_layout``); a new key comes behind the last of its table, a new table behind the last of its
kind. Entries of an array of tables are told apart by name (see ``toml_pairs``), wherever they stand. An empty list or
table says as much as none: neither is written or taken away for its own sake. Nothing is judged here: whoever stores
the result parses it back and compares (see ``save``).

Source: TOML v1.0.0; specification of rtugate, section 6. Pure.
"""

from __future__ import annotations

import tomllib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import tomli_w

from gateway import toml_pairs
from gateway.toml_layout import Entry, Inline, Section, blank_lines_at_end, cut, cut_value, joined, with_blank_line
from gateway.toml_pairs import Title, paired, same
from gateway.toml_text import Path


def edited(text: str, wanted: Mapping[str, Any], title: Title = toml_pairs.name) -> str:
    """Return *text*, changed only where it has to be, so that it parses to *wanted*.

    text:   TOML, with paths no longer than ``toml_text.DEEPEST``.
    title:  what an entry of an array of tables is known by; None: by its place and by what it says.
    raises: tomllib.TOMLDecodeError, if *text* is no TOML.
    """
    said = tomllib.loads(text)
    return text if same(said, wanted) else _Edit(text, title).to(said, wanted)


def rendered(value: Any, newline: str = "") -> str:
    """Return *value* as it stands behind an equals sign; a list of tables on lines of its own, if given a *newline*."""
    if isinstance(value, Mapping):
        inside = ", ".join(f"{key_text(key)} = {rendered(inner)}" for key, inner in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if newline and _are_tables(value):
        return newline.join(["[", *(f"    {rendered(entry)}," for entry in value), "]"])
    if isinstance(value, list):
        return f"[{', '.join(rendered(item) for item in value)}]"
    return tomli_w.dumps({"x": value}).removeprefix("x = ").removesuffix("\n")


def key_text(*parts: str) -> str:
    """Return *parts* as a key or in a header, quoted where they have to be."""
    return ".".join(tomli_w.dumps({part: 0}).removesuffix(" = 0\n") for part in parts)


@dataclass(slots=True, eq=False)
class _Table:
    """A table that the text has, in whatever way it is written.

    path:   in the text.
    body:   where its own keys stand, or would; None if there are only headers of tables in it.
    prefix: what its keys start with there: ("serial",) for [hmi] with serial.line = "/dev/ttyS1".
    """

    path: Path
    body: Section | Inline | None = None
    prefix: Path = ()
    says: dict[str, Entry | _Table | list[_Table]] = field(default_factory=dict)


class _Edit:
    """One text on its way to what it shall say."""

    def __init__(self, text: str, title: Title) -> None:
        self._text = text
        self._title = title
        first = text.find("\n")
        self._newline = "\r\n" if text[first - 1 : first] == "\r" else "\n"
        self._sections = cut(text)

    def to(self, said: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
        root = _Table(())
        for section in self._sections:
            table = _table_at(root, section.path)
            table.body, table.prefix = section, ()
            _read(table, section)
        self._merge(root, said, wanted)
        return joined(self._sections, self._newline)

    # --- what is there

    def _merge(self, table: _Table, said: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
        new = {key: value for key, value in wanted.items() if key not in table.says}
        for key, node in table.says.items():
            want = wanted.get(key)
            if same(said[key], want):
                continue
            if isinstance(node, list) and isinstance(want, list) and _are_tables(want):
                self._merge_array(node, said[key], want)
            elif isinstance(node, _Table) and isinstance(want, Mapping):
                self._merge(node, said[key], want)
            elif isinstance(node, Entry) and want is not None:
                node.value = self._value(node, said[key], want)
            else:
                self._remove(node, (*table.path, key))
                new[key] = want
        for key, value in new.items():
            if not same(value, None):
                self._add(table, key, value)

    def _merge_array(self, tables: list[_Table], said: list[Any], wanted: list[Any]) -> None:
        """Edit [[tables]]: those that are gone leave, the others are edited and put in order, then new ones come."""
        pairs = paired(said, wanted, self._title)
        for i in set(range(len(tables))).difference(pairs):
            self._remove(tables[i], tables[i].path)
        for pair, want in zip(pairs, wanted, strict=True):
            if pair is not None:
                self._merge(tables[pair], said[pair], want)
        order = [i for i in pairs if i is not None]
        if order != sorted(order):
            self._reorder([tables[i].path for i in order])
        self._add_entries(tables, pairs, wanted)

    def _value(self, entry: Entry, said: Any, want: Any) -> str:
        """The text of a value that says *said* and shall say *want*."""
        if isinstance(said, Mapping) and isinstance(want, Mapping):
            return self._inline_table(entry, said, want)
        if isinstance(said, list) and isinstance(want, list) and (said or "#" in entry.value):
            return self._inline_array(entry, said, want)
        return rendered(want, self._newline)

    def _inline_table(self, entry: Entry, said: Mapping[str, Any], want: Mapping[str, Any]) -> str:
        body = cut_value(self._text, entry)
        table = _Table((), body)
        _read(table, body)
        self._merge(table, said, want)
        return body.text(self._newline)

    def _inline_array(self, array: Entry, said: list[Any], wanted: list[Any]) -> str:
        body = cut_value(self._text, array)
        items, pairs = body.entries, paired(said, wanted, self._title)
        left_behind = _gone_behind(items, pairs)
        body.entries = list(left_behind[-1])
        before, first = None, next((items[i] for i in pairs if i is not None), None)
        for i, want in zip(pairs, wanted, strict=True):
            if i is None:
                item = Entry((), "", "", rendered(want), "")
                body.fit_in(item, before, first, self._newline)
                body.entries.append(item)
            else:
                item = items[i]
                if not same(said[i], want):
                    item.value = self._value(item, said[i], want)
                body.entries += [item, *left_behind[i]]
            before = item
        return body.text(self._newline)

    # --- what leaves, what changes places

    def _remove(self, node: Entry | _Table | list[_Table], path: Path) -> None:
        """Take away all that is said at *path*, wherever it stands."""
        if isinstance(node, Entry):
            node.is_gone = True
        elif isinstance(node, list):
            for table in node:
                self._remove(table, path)
        else:
            if isinstance(node.body, Section) and not node.prefix:
                node.body.gone_with = path
            for inner in node.says.values():
                self._remove(inner, path)

    def _reorder(self, paths: list[Path]) -> None:
        """Bring the tables at *paths*, with all in them, into this order; free comments stay where they are."""
        groups: dict[Path, list[Section]] = {path: [] for path in paths}
        for section in self._sections:
            groups.get(section.path[: len(paths[0])], []).append(section)
        before = sorted(groups.values(), key=lambda group: self._sections.index(group[0]))
        tails = [group[-1].tail for group in before]
        at = self._sections.index(before[0][0])
        moved = [section for group in groups.values() for section in group]
        left = [section for section in self._sections[at:] if section.path[: len(paths[0])] not in groups]
        self._sections[at:] = moved + left
        for group, tail in zip(groups.values(), tails, strict=True):
            group[-1].tail = tail

    # --- what comes

    def _add(self, table: _Table, key: str, value: Any) -> None:
        """Say *value*, which is not empty, at a new *key* of *table*."""
        path = (*table.path, key)
        has_headers = table.body is None or (isinstance(table.body, Section) and not table.prefix)
        if has_headers and isinstance(value, Mapping):
            self._insert_below(table.path, list(self._new_sections(path, value)))
        elif has_headers and _are_tables(value):
            entries = [self._new_sections((*path, i), entry) for i, entry in enumerate(value)]
            self._insert_below(table.path, [section for sections in entries for section in sections])
        elif isinstance(value, Mapping) and isinstance(table.body, Section):
            self._merge(_Table(path, table.body, (*table.prefix, key)), {}, value)
        else:
            self._add_key(table, key, value)

    def _add_key(self, table: _Table, key: str, value: Any) -> None:
        body = table.body or self._new_body(table)
        new = Entry((*table.prefix, key), "", f"{key_text(*map(str, table.prefix), key)} = ", "", "")
        at = _behind_its_like(body.entries, table.prefix)
        if isinstance(body, Inline):
            new.value = rendered(value)
            before = [entry for entry in body.entries[:at] if not entry.is_gone]
            behind = [entry for entry in body.entries[at:] if not entry.is_gone]
            body.fit_in(new, before[-1] if before else None, behind[0] if behind else None, self._newline)
            body.entries.insert(at, new)
            return
        new.value, new.rest = rendered(value, self._newline), self._newline
        if body.is_bare:
            is_all = len(self._sections) == 1
            new.before, body.rest, body.tail = self._head_of_file(body), "", "" if is_all else self._newline
        else:
            new.before = body.entries[at - 1].indent if at else body.indents[1]
        body.entries.insert(at, new)

    def _add_entries(self, tables: list[_Table], pairs: list[int | None], wanted: list[Any]) -> None:
        """Put each new entry behind the one that it follows, or in front of the first."""
        new: list[Section] = []
        previous: _Table | None = None
        for n, (i, want) in enumerate(zip([*pairs, -1], [*wanted, None], strict=True)):
            if i is None:
                path = (*tables[0].path[:-1], len(tables) + n)
                sibling = (previous or tables[0]).body
                new += self._new_sections(path, want, sibling.indents if isinstance(sibling, Section) else ("", ""))
                continue
            if new and previous:
                self._insert_below(previous.path, new)
            elif new:
                self._insert_above(tables[0].path[:-1] if i < 0 else tables[i].path, new)
            previous, new = tables[i], []

    def _new_sections(
        self, path: Path, value: Mapping[str, Any], indents: tuple[str, str] = ("", "")
    ) -> Iterator[Section]:
        """The header and the keys of a new table, and those of all tables in it."""
        inner = {key: inside for key, inside in value.items() if isinstance(inside, Mapping) or _are_tables(inside)}
        plain = {key: inside for key, inside in value.items() if key not in inner and not same(inside, None)}
        is_entry = isinstance(path[-1], int)
        if plain or is_entry or not inner:
            section = Section(path, indents[0] + _header(path) + self._newline, tail=self._newline)
            for key, inside in plain.items():
                text = rendered(inside, self._newline)
                section.entries.append(Entry((key,), indents[1], f"{key_text(key)} = ", text, self._newline))
            yield section
        for key, inside in inner.items():
            if isinstance(inside, Mapping):
                yield from self._new_sections((*path, key), inside, indents)
            for i, entry in enumerate(inside if isinstance(inside, list) else ()):
                yield from self._new_sections((*path, key, i), entry, indents)

    def _new_body(self, table: _Table) -> Section:
        """A header for a table that has none, in front of the tables in it."""
        table.body = Section(table.path, _header(table.path) + self._newline)
        self._insert_above(table.path, [table.body])
        return table.body

    def _head_of_file(self, bare: Section) -> str:
        return with_blank_line(bare.rest + bare.tail, self._newline)

    def _insert_below(self, path: Path, new: list[Section]) -> None:
        """Insert behind all that is in *path*, with blank lines in front as there are elsewhere."""
        inside = [n for n, section in enumerate(self._sections) if _is_in(section, path)]
        at = next((n for n in reversed(inside) if self._sections[n].gone_with is None), inside[-1])
        last, is_end = self._sections[at], at + 1 == len(self._sections)
        if last.is_bare:
            last.rest, last.tail = "", self._head_of_file(last)
            new[-1].tail = "" if is_end else self._newline
        else:
            gap = self._gap_above(at)
            new[-1].tail = last.tail or ("" if is_end else gap)
            last.tail = gap
        self._sections[at + 1 : at + 1] = new

    def _gap_above(self, at: int) -> str:
        """The blank lines above a section."""
        earlier = self._sections[at - 1] if at else None
        if earlier is None or (earlier.is_bare and not earlier.tail):
            return self._newline
        return blank_lines_at_end(earlier.tail) or (self._newline if self._sections[at].rest else "")

    def _insert_above(self, path: Path, new: list[Section]) -> None:
        """Insert in front of all that is in *path*."""
        at = next(n for n, section in enumerate(self._sections) if _is_in(section, path))
        new[-1].tail = self._newline
        self._sections[at:at] = new


def _read(table: _Table, body: Section | Inline) -> None:
    """Note in *table* what *body* says, and where."""
    for entry in body.entries:
        inner = table
        for n, part in enumerate(entry.key[:-1], 1):
            prefix = entry.key[:n]
            node = inner.says.setdefault(str(part), _Table((*table.path, *prefix), body, prefix))
            assert isinstance(node, _Table)  # noqa: S101  (tomllib has refused everything else)
            if node.body is None:
                node.body, node.prefix = body, prefix
            inner = node
        inner.says[str(entry.key[-1])] = entry


def _table_at(root: _Table, path: Path) -> _Table:
    """The table at *path*, which may be new."""
    table = root
    for n, part in enumerate(path):
        if isinstance(part, int):
            continue
        index = path[n + 1] if n + 1 < len(path) else None
        node = table.says.setdefault(part, [] if isinstance(index, int) else _Table(path[: n + 1]))
        if isinstance(node, list) and isinstance(index, int):
            if index == len(node):
                node.append(_Table(path[: n + 2]))
            node = node[index]
        assert isinstance(node, _Table)  # noqa: S101  (tomllib has refused everything else)
        table = node
    return table


def _gone_behind(items: list[Entry], pairs: list[int | None]) -> defaultdict[int, list[Entry]]:
    """Mark the *items* that are in no pair as gone, and return them by the one they stand behind; -1: by none."""
    found: defaultdict[int, list[Entry]] = defaultdict(list)
    kept, last = set(pairs), -1
    for i, item in enumerate(items):
        if i in kept:
            last = i
        else:
            item.is_gone = True
            found[last].append(item)
    return found


def _behind_its_like(entries: list[Entry], prefix: Path) -> int:
    """Where a new key that starts with *prefix* comes: behind the last that starts like it."""
    for length in range(len(prefix), 0, -1):
        alike = [n for n, entry in enumerate(entries, 1) if entry.key[:length] == prefix[:length]]
        if alike:
            return alike[-1]
    return len(entries)


def _is_in(section: Section, path: Path) -> bool:
    return section.path[: len(path)] == path


def _header(path: Path) -> str:
    text = key_text(*(part for part in path if isinstance(part, str)))
    return f"[[{text}]]" if isinstance(path[-1], int) else f"[{text}]"


def _are_tables(value: object) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(entry, Mapping) for entry in value)
