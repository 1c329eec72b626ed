"""Where things stand in a TOML text; ``tomllib`` is the judge of what stands there."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from gateway.toml_text import DEEPEST, Path, Places, scan

TRICKY = '''# a comment with = and [brackets] and "quotes
top = 1 # behind
[register."x.y"]
dotted . "two words" = "a # b" # not in the value
'single'.q = 'C:\\path'
[[master]]
name = "f"
request = [ # a comment, with a ]
  {unit = 1, allow = [1, [2, 3]], inner = {deep = true, far.off = 0}},
  {unit = 2},
]
[[master]]
[[ master . request ]]
when = 1979-05-27 07:32:00 # a space inside a value
text = """
[no.header]
x = 1 \\""" """"
raw = \'\'\'
unit = 9\'\'\'\'\'
empty = {}
none = [ ]
[[master.request]]
"q\\u0041" = +1e6
[master.request.sub]
a = """"""
'''


def value_at(path: Path, data: Any) -> Any:
    for part in path:
        data = data[part]
    return data


def leaves(data: Any, path: Path = ()) -> Iterator[Path]:
    parts = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    if not isinstance(data, dict | list):
        yield path
    for part, inner in parts:
        yield from leaves(inner, (*path, part))


def assert_all_values_are_where_the_scan_says(text: str) -> None:
    data = tomllib.loads(text)
    statements = scan(text)
    for statement in statements:
        if statement.kind == "table":
            assert text[statement.start] == "["
            assert text[statement.end - 1] == "]"
            value_at(statement.path, data)
        else:
            written = f"value = {text[statement.value_start : statement.end]}"
            assert tomllib.loads(written)["value"] == value_at(statement.path, data)
        assert statement.line == text.count("\n", 0, statement.start) + 1
    assert set(leaves(data)) <= {statement.path for statement in statements}


@pytest.mark.parametrize(
    ("path", "line"),
    [
        (("top",), 2),
        (("register", "x.y"), 3),
        (("register", "x.y", "dotted", "two words"), 4),
        (("register", "x.y", "single", "q"), 5),
        (("master", 0), 6),
        (("master", 0, "request", 0, "inner", "far", "off"), 9),
        (("master", 0, "request", 0, "allow", 1, 1), 9),
        (("master", 0, "request", 1, "unit"), 10),
        (("master", 1), 12),
        (("master", 1, "request", 0), 13),
        (("master", 1, "request", 0, "text"), 15),
        (("master", 1, "request", 0, "raw"), 18),
        (("master", 1, "request", 1, "qA"), 23),
        (("master", 1, "request", 1, "sub"), 24),
    ],
)
def test_each_path_has_the_line_where_it_stands(path: Path, line: int) -> None:
    assert Places(scan(TRICKY)).line(path) == line


@pytest.mark.parametrize(
    ("path", "line"),
    [
        (("master", 1, "request", 1, "unit"), 22),  # a missing key: the header of its table
        (("master", 0, "request", 1, "count"), 10),  # ... or the inline table
        (("register", "x.y", "dotted"), 4),  # a table that exists by dotted keys only
        (("register",), 3),
        (("slave", 0), None),
        ((), None),
    ],
)
def test_what_does_not_stand_there_is_found_at_what_encloses_it(path: Path, line: int | None) -> None:
    assert Places(scan(TRICKY)).line(path) == line


@pytest.mark.parametrize("text", [TRICKY, TRICKY.replace("\n", "\r\n")], ids=["LF", "CRLF"])
def test_every_value_is_where_the_scan_says(text: str) -> None:
    assert_all_values_are_where_the_scan_says(text)


def test_statements_come_in_order_and_say_what_they_are() -> None:
    found = [(one.path, one.kind, one.is_inline) for one in scan("[t]\na = [1, {b = 2}]\n")]
    assert found == [
        (("t",), "table", False),
        (("t", "a"), "key", False),
        (("t", "a", 0), "item", True),
        (("t", "a", 1), "item", True),
        (("t", "a", 1, "b"), "key", True),
    ]


def test_a_statement_ends_before_its_comment() -> None:
    text = "[t] # table\na = 'x' # key\n"
    assert [text[one.start : one.end] for one in scan(text)] == ["[t]", "a = 'x'"]


values = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63) | st.text() | st.datetimes() | st.dates(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@given(st.dictionaries(st.text(max_size=8), values, max_size=6), st.booleans())
def test_any_document_is_scanned_as_tomllib_reads_it(document: dict[str, Any], multiline: bool) -> None:
    assert_all_values_are_where_the_scan_says(tomli_w.dumps(document, multiline_strings=multiline))


@given(st.text() | st.text(alphabet="a1.=,[]{}\"'\\# \r\n"))
def test_no_text_whatever_makes_the_scan_fail(text: str) -> None:
    for statement in scan(text):
        assert 0 <= statement.start <= statement.value_start <= statement.end <= len(text)


@pytest.mark.parametrize("opening", ["a.", "[", "a=[", "a={b=", "[a."])
def test_what_is_absurdly_deep_is_cut_off(opening: str) -> None:
    assert all(len(statement.path) <= DEEPEST + 1 for statement in scan(opening * 5000 + "a=1"))


def test_a_bad_escape_in_a_key_leaves_the_key_as_written() -> None:
    assert [one.path for one in scan('"\\q" = 1')] == [("\\q",)]


@pytest.mark.parametrize("opening", ["", "x = [", "x = {"])
@pytest.mark.parametrize(
    "piece",
    ["a.", "a=[", "a={b=", '"\\', '"""\\', "'''", "[[a]]\n", "a=1\n", "1,", "{},", "# x", "\r", '""', "[a.b.c.d]\n"],
)
def test_time_grows_with_the_length_and_not_faster(opening: str, piece: str) -> None:
    text = opening + piece * (200_000 // len(piece))
    started = time.process_time()
    scan(text)
    assert time.process_time() - started < 5.0  # a quadratic scan takes many minutes
