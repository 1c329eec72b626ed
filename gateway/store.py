"""The TOML file: loaded as a configuration, with the line of everything that is said about it.

Loading changes nothing on the disk and never falls back to anything: a file that cannot be used is a ``ConfigError``
that carries every finding, whatever the bytes in it. What depends on how a value is spelled is checked here, where the
text is known. Saving is done by ``save``.

Source: specification of rtugate, section 6. Any thread; nothing is shared.
"""

from __future__ import annotations

import os
import re
import stat
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gateway import config_fields, toml_text
from gateway.config import FUNCTION_CODES, NATURAL_TABLES, TABLE_NAMES, Config, meant_by_reference
from gateway.config_checks import not_yet, validate
from gateway.config_fields import Finding, Severity
from gateway.errors import ConfigError

LARGEST_FILE_BYTES: Final = 1024 * 1024
BYTE_ORDER_MARK: Final = "\ufeff"
NAME_CHARACTERS: Final = 255  # of a file that are shown

_TOML_PLACE: Final = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_DECIMAL: Final = re.compile(r"\+?[0-9][0-9_]*")
_LONG_NUMBER: Final = re.compile(r"[0-9][0-9_]{4300}")
_PLAIN_WORDS: Final = {  # what tomllib says of the commonest slips
    "Cannot overwrite a value": "this key is given twice",
    "Invalid value": "this is no value: a text stands in quotes",
    "Expected '=' after a key in a key/value pair": "a key is followed by = and a value",
    "Expected newline or end of document after a statement": "the line goes on behind its value",
    "Illegal character '\\n'": "the quotes of this text are not closed",
}


@dataclass(frozen=True, slots=True)
class LocatedFinding:
    """A finding with its place in the file; ``str()`` makes the line that a person reads.

    line:    counted from 1; None where the file as a whole is meant.
    subject: the entry or table, as a person names it: `master "field", request "boiler"`; "" for the whole file.
    """

    file_name: str
    line: int | None
    subject: str
    message: str
    severity: Severity = "error"

    def __str__(self) -> str:
        name = config_fields.escaped(self.file_name, NAME_CHARACTERS)
        place = name if self.line is None else f"{name}:{self.line}"
        severity = "" if self.severity == "error" else self.severity
        return ": ".join(part for part in (place, severity, self.subject, self.message) if part)


@dataclass(frozen=True)
class Loaded:
    """A configuration that can be used, the text it came from, and the warnings and notes about it."""

    config: Config
    text: str
    findings: list[LocatedFinding]


def load(path: Path) -> Loaded:
    """Return the configuration in the file at *path*; raises ConfigError with every finding."""
    name = path.name or str(path)
    try:
        content = read(path)
    except OSError as error:
        raise _unusable(name, None, f"cannot be read: {error.strerror or error}") from error
    return load_text(content, name)


def read(path: Path) -> bytes:
    """Return what is in a file, up to a byte more than allowed; raises OSError, and ConfigError if it is no file.

    Nothing but a file is even opened, since a FIFO waits and a device may act on it.
    """
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):  # of a directory the system itself says what it is
        raise _unusable(path.name or str(path), None, "is not a regular file")
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # it may have become a FIFO since
    with os.fdopen(descriptor, "rb") as file:
        return file.read(LARGEST_FILE_BYTES + 1)


def load_text(text: str | bytes, file_name: str) -> Loaded:
    """Return the configuration in *text*, which messages call *file_name*; raises ConfigError with every finding."""
    if len(text) > LARGEST_FILE_BYTES:
        raise _unusable(file_name, None, "is larger than 1 MiB")
    decoded = _decode(text, file_name) if isinstance(text, bytes) else text
    statements = toml_text.scan(decoded)
    data = _parse(decoded, statements, file_name)
    config, found = validate(data)
    confused = [Finding(one.path, message) for one, message in reference_numbers(decoded, data, statements)]
    found += confused
    if config is None or confused:
        raise ConfigError(_locate(found, data, statements, file_name))
    return Loaded(config, decoded, _locate(found + not_yet(config), data, statements, file_name))


def _unusable(file_name: str, line: int | None, message: str) -> ConfigError:
    return ConfigError([LocatedFinding(file_name, line, "", message)])


def _decode(content: bytes, file_name: str) -> str:
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise _unusable(file_name, line, "this is not UTF-8: save the file in that encoding") from error


def _parse(text: str, statements: list[toml_text.Statement], file_name: str) -> dict[str, Any]:
    if text.startswith(BYTE_ORDER_MARK):
        raise _unusable(file_name, 1, "the file starts with a byte order mark: save it as UTF-8 without one")
    deep = next((one for one in statements if len(one.path) > toml_text.DEEPEST), None)
    if deep is not None:  # before tomllib, which takes the square of the depth
        raise _unusable(file_name, deep.line, f"nested more than {toml_text.DEEPEST} deep")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        line, message = _in_plain_words(str(error), text)
        raise _unusable(file_name, line, message) from error
    except RecursionError as error:
        raise _unusable(file_name, None, "nested too deep") from error
    except ValueError as error:  # Python's own limit on the digits of a number
        long = _LONG_NUMBER.search(text)
        at = text.count("\n", 0, long.start()) + 1 if long else None
        raise _unusable(file_name, at, "a number of thousands of digits") from error


def _in_plain_words(text: str, document: str) -> tuple[int, str]:
    """Line and message of what tomllib says in one text: "Invalid value (at line 3, column 5)"."""
    place = _TOML_PLACE.search(text)
    said = text[: place.start()] if place else text
    if said.startswith("Cannot declare"):
        said = "this table is given twice"
    words = _PLAIN_WORDS.get(said, said)
    if place is None or place[1] is None:
        return document.rstrip("\n").count("\n") + 1, f"not TOML: {words}, at the end of the file"
    return int(place[1]), f"not TOML: {words} (column {place[2]})"


def reference_numbers(
    text: str, data: Mapping[str, Any], statements: list[toml_text.Statement]
) -> Iterator[tuple[toml_text.Statement, str]]:
    """Addresses that are spelled like a handbook's 40108, and what is said of each.

    Who really means that PDU address can spell it 0x9CAC.
    """
    for statement in statements:
        path = statement.path
        if len(path) != 5 or path[::2] != ("master", "request", "address"):
            continue
        if _DECIMAL.fullmatch(text, statement.value_start, statement.end):
            request = data["master"][path[1]]["request"][path[3]]
            found = _confused(request["address"], request.get("function"))
            if found:
                yield statement, found


def _confused(number: int, function: object) -> str | None:
    """What is said of the address *number* if it is likely to be a reference number of *function*'s table."""
    code = FUNCTION_CODES.get(function.replace("_", "-")) if isinstance(function, str) else function
    table = NATURAL_TABLES.get(code) if type(code) is int else None
    meant = None if table is None else meant_by_reference(table, number)
    if table is None or meant is None:
        return None
    point = TABLE_NAMES[table].removesuffix("s").replace("-", " ")
    return (
        f"address {number} looks like a reference number: for {point} {number} type address = {meant}; "
        f"if PDU address {number} is really meant, type 0x{number:04X}"
    )


def _locate(
    found: Iterable[Finding], data: Mapping[str, Any], statements: list[toml_text.Statement], file_name: str
) -> list[LocatedFinding]:
    places = toml_text.Places(statements)
    located = [
        LocatedFinding(file_name, places.line(one.path), subject(one.path, data), one.message, one.severity)
        for one in found
    ]
    return sorted(located, key=lambda finding: finding.line or 0)


def subject(path: config_fields.Path, data: Mapping[str, Any]) -> str:
    """What *path* lies in, as a person names it: `master "field", request "boiler"`, `[hmi.serial]` or nothing."""
    if len(path) > 1 and isinstance(path[1], int):
        entries = [_entry_name(path[:2], data)]
        if len(path) > 3 and isinstance(path[3], int) and path[2] == "request":
            entries.append(_entry_name(path[:4], data))
        return ", ".join(entries)
    tables = ".".join(config_fields.escaped(str(part)) for part in path[:-1])
    return f"[{tables}]" if tables else ""


def _entry_name(path: config_fields.Path, data: Mapping[str, Any]) -> str:
    """`request "boiler"`, or `request 3` where there is no sound name."""
    entry: Any = data
    for part in path:
        entry = entry[part]
    name = entry.get("name") if isinstance(entry, Mapping) else None
    kind, index = path[-2:]
    is_sound = isinstance(name, str) and config_fields.is_name(name)
    return f'{kind} "{name}"' if is_sound else f"{kind} {int(index) + 1}"


def shown(path: Path) -> str:
    """Return how a file is named to people."""
    return config_fields.escaped(str(path), NAME_CHARACTERS)
