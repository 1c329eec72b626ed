"""What is made from the code, to be read: the manual pages and ``etc/rtugate.toml``; `make manual` writes them.

That file is what an installation begins with, and what `rtugate init` writes.

``man/*.1`` and ``man/*.5`` are made from ``man/*.in``. A page's ``.in`` is its text in troff's man macros, written by
hand. A line in it that begins with @ stands for what the code knows better: the keys of a table with their types,
ranges and defaults (from the configuration's models), a command with its options (from the parser of the command
line), the functions of Modbus, the version. So the pages cannot lie about these, and a key or a command without its
place in a page is an error here. The same code gives the same pages, byte for byte. They are kept in the tree, since
Debian 12 has no pydantic that could make them.

Source: man(7), groff_man_style(7); specification of rtugate, sections 9 and 10.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any, Final

from gateway import __version__
from gateway.cli import _parser
from gateway.config import FUNCTION_CODES, SERVED_CODES
from gateway.config_checks import not_yet
from gateway.documents import schema, starting_file
from gateway.modbus.pdu import QUANTITY_LIMITS
from gateway.store import load

TESTS: Final = Path(__file__).parent
FOLDER: Final = TESTS.parent / "man"
EVERY_KEY: Final = TESTS / "data" / "full.toml"
PAGES: Final = ("rtugate.1", "rtugate.toml.5")
DEFAULT_FILE: Final = "etc/rtugate.toml"
COLUMNS: Final = 78  # of the pages' sources
SAME_AS: Final = {"slave": "master"}  # a table, and one above it on the page that has many of its keys
COMMON: Final = ("-h", "-c", "--state", "--version")  # options that belong to every command, or to none

Node = dict[str, Any]


class Unfinished(Exception):
    """A page has no place for something in the code, or asks for something that is not there."""


# ------------------------------------------------------------------------------------------------ troff


ESCAPES: Final = {
    "\\": r"\e",
    "-": r"\-",  # as it is typed, and no hyphen
    "'": r"\(aq",
    "`": r"\(ga",
    "^": r"\(ha",
    "~": r"\(ti",
}


def plain(text: str) -> str:
    """Return *text* as troff has to be given it so that it comes out as it is."""
    return "".join(ESCAPES.get(character, character) for character in text)


def bold(text: str) -> str:
    """Return *text* in bold: what is typed as it stands."""
    return rf"\fB{plain(text)}\fR"


def italic(text: str) -> str:
    """Return *text* in italics: what a person puts his own in for."""
    return rf"\fI{plain(text)}\fR"


def prose(text: str) -> list[str]:
    """Return *text* as lines of running text; `what stands so` is bold."""
    parts = [bold(part) if n % 2 else plain(part) for n, part in enumerate(text.split("`"))]
    lines = wrap("".join(parts), COLUMNS, break_on_hyphens=False, break_long_words=False)
    return [rf"\&{line}" if line.startswith(".") else line for line in lines]


def tagged(tag: str, text: str) -> list[str]:
    """Return a paragraph with *tag*, which is troff already, beside or above it."""
    return [".TP", tag, *prose(text)]


# ------------------------------------------------------------------------------------------------ the file's keys


def table_at(path: str) -> Node:
    """Return what the schema says of the table at *path*: "master.request"."""
    node = schema()
    for key in path.split("."):
        node = _inner(node["properties"][key])
    return node


def _inner(node: Node) -> Node:
    """The table itself, where *node* is a list of tables."""
    return dict(node.get("items", node))


def table_paths() -> list[str]:
    """Return the path of every table of the file."""
    return list(_tables_in(schema(), ""))


def _tables_in(node: Node, path: str) -> Iterator[str]:
    for key, inner in node["properties"].items():
        if "properties" in _inner(inner):
            here = f"{path}.{key}" if path else key
            yield here
            yield from _tables_in(_inner(inner), here)


def keys_of(path: str) -> dict[str, Node]:
    """Return the keys of the table at *path*, without the tables in it."""
    return {key: node for key, node in table_at(path)["properties"].items() if "properties" not in _inner(node)}


def table(path: str) -> list[str]:
    """Return the keys of the table at *path*; those that mean the same in another table are only named."""
    keys, required = keys_of(path), table_at(path).get("required", [])
    above = keys_of(SAME_AS[path]) if path in SAME_AS else {}
    same = [key for key, node in keys.items() if key not in required and above.get(key) == node]
    lines = []
    for key, node in keys.items():
        if key not in same:
            told = "required" if key in required else _default(node)
            head = "; ".join(part for part in (kind(node), told) if part)
            lines += tagged(f"{bold(key)} ({plain(head)})", node["description"])
    if same:
        lines += [".TP", *_joined([bold(key) for key in same]), f"as in {bold(f'[[{SAME_AS[path]}]]')}"]
    return [*_not_yet(path), *lines]


def _joined(words: Sequence[str]) -> list[str]:
    """All *words* with commas, as one input line: a tag."""
    return [", ".join(words)]


def _default(node: Node) -> str:
    return f"default {json.dumps(node['default'])}" if "default" in node else ""


TYPES: Final = {"integer": "integer", "number": "number", "boolean": "true or false", "string": "string"}


def kind(node: Node) -> str:
    """Return which kind of TOML value *node* takes."""
    if "anyOf" in node:
        return " or ".join(dict.fromkeys(name for choice in node["anyOf"] for name in kind(choice).split(" or ")))
    if "type" not in node:
        return " or ".join(sorted({"integer" if isinstance(choice, int) else "string" for choice in node["enum"]}))
    if node["type"] == "array":
        return "list of " + " or ".join(f"{name}s" for name in kind(node["items"]).split(" or "))
    return TYPES[node["type"]]


def not_yet_tables() -> set[str]:
    """Return the tables that this version accepts and does not carry out, as `rtugate check` warns."""
    config = load(EVERY_KEY).config
    wifly = config.hmi.wifly.model_copy(update={"line": "/dev/ttyS0"})
    config = config.model_copy(update={"hmi": config.hmi.model_copy(update={"wifly": wifly})})
    return {".".join(part for part in found.path if isinstance(part, str)) for found in not_yet(config)}


def _not_yet(path: str) -> list[str]:
    if path not in not_yet_tables():
        return []
    return [".PP", *prose("This version accepts this table but does not carry it out; `rtugate check` warns of it.")]


# ------------------------------------------------------------------------------------------------ functions


def functions(which: str) -> list[str]:
    """Return the functions of requests ("asked"), or those that a slave answers besides ("answered")."""
    if which == "asked":
        return _list([f"{code:>2}  {name:<26}{_limit(code)}" for name, code in FUNCTION_CODES.items()])
    return _list([f"{code:>2}  {name}" for name, code in SERVED_CODES.items() if name not in FUNCTION_CODES])


def _limit(code: int) -> str:
    limit = QUANTITY_LIMITS[code]
    return "1 point" if limit == 1 else f"1 to {limit} points"


def _list(rows: Sequence[str]) -> list[str]:
    return [".PP", ".RS", ".nf", *(plain(row) for row in rows), ".fi", ".RE"]


# ------------------------------------------------------------------------------------------------ the command line


def commands() -> dict[str, argparse.ArgumentParser]:
    """Return each command's parser, in the order in which `rtugate --help` names them."""
    return dict(_subparsers(_parser()).choices)


def _subparsers(parser: argparse.ArgumentParser) -> Any:
    return next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))


def own_arguments(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """Return what *parser* takes beside what is common to all commands."""
    return [action for action in parser._actions if not set(COMMON) & set(action.option_strings)]


def command(name: str) -> list[str]:
    """Return a command with its arguments, what it does in a line, and its options."""
    parser = commands()[name]
    told = next(choice.help for choice in _subparsers(_parser())._choices_actions if choice.dest == name)
    own = own_arguments(parser)
    lines = tagged(" ".join([bold(name), *map(_synopsis, own)]), f"{told[0].upper()}{told[1:]}.")
    options = [line for action in own if action.option_strings for line in _option(action)]
    return [*lines, ".RS", *options, ".RE"] if options else lines


def options() -> list[str]:
    """Return the options that are common to all commands."""
    return [line for action in _parser()._actions if action.option_strings for line in _option(action)]


def _option(action: argparse.Action) -> list[str]:
    help_text = (action.help or "") % {"default": action.default}
    return tagged(_with_value(", ".join(map(bold, action.option_strings)), action), f"{help_text}.")


def _synopsis(action: argparse.Action) -> str:
    if not action.option_strings:
        return f"[{_value(action)}]" if action.nargs == "?" else _value(action)
    return f"[{_with_value(bold(action.option_strings[0]), action)}]"


def _with_value(flags: str, action: argparse.Action) -> str:
    return flags if action.nargs == 0 else f"{flags} {_value(action)}"


def _value(action: argparse.Action) -> str:
    if action.choices:
        return "|".join(bold(choice) for choice in action.choices)
    return italic(str(action.metavar))


# ------------------------------------------------------------------------------------------------ the pages


DIRECTIVES: Final[dict[str, Callable[..., list[str]]]] = {
    "@table": table,
    "@functions": functions,
    "@command": command,
    "@options": options,
}


def page(name: str, folder: Path = FOLDER) -> str:
    """Return the page *name* as it is to be; raises Unfinished."""
    source = (folder / f"{name}.in").read_text("ascii")
    asked = re.findall(r"^(@\S+)(?: (\S+))?$", source, re.MULTILINE)
    _demand_all(name, [argument for word, argument in asked if word in ("@table", "@command")])
    lines = [rf".\" Made by `make manual` from man/{name}.in and the code: change those."]
    for line in source.splitlines():
        if line.startswith("@"):
            lines += _asked(name, *line.split())
        else:
            lines.append(line.replace("@VERSION@", __version__))
    return "\n".join(lines) + "\n"


def _asked(name: str, word: str, *arguments: str) -> list[str]:
    if word not in DIRECTIVES:
        raise Unfinished(f"{name}.in: there is no {word}")
    return DIRECTIVES[word](*arguments)


def _demand_all(name: str, shown: Sequence[str]) -> None:
    known = commands() if name.endswith(".1") else table_paths()
    missing, unknown = sorted(set(known) - set(shown)), sorted(set(shown) - set(known))
    if missing or unknown or len(shown) > len(set(shown)):
        raise Unfinished(f"{name}.in: missing {missing}, unknown {unknown}, shown {list(shown)}")


def update(top: Path = FOLDER.parent) -> list[str]:
    """Write everything below *top* anew; return the paths of what has changed."""
    folder = top / FOLDER.name
    made = {folder / name: page(name, folder) for name in PAGES} | {top / DEFAULT_FILE: starting_file()}
    changed = [path for path, text in made.items() if not path.exists() or path.read_text("ascii") != text]
    for path in changed:
        path.write_text(made[path], "ascii")
    return [str(path) for path in changed]


if __name__ == "__main__":
    print("\n".join(update()) or "everything is up to date")
