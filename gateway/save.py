"""The configuration on its way to its file: its text, which is the old one edited, and the file written for good.

A text is only handed out when it loads as exactly the configuration that is meant. Nothing here asks a person or
decides for him: a file that somebody else has changed is an error, and what to do then is the menu's to ask.

Source: specification of rtugate, section 6. Any thread; nothing is shared.
"""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal

import tomli_w

from gateway import files, store, toml_text
from gateway.config import FUNCTION_CODES, Config
from gateway.config_fields import escaped
from gateway.errors import ConfigError, FileChanged, SaveError
from gateway.toml_edit import edited
from gateway.toml_pairs import same

TITLE_KEYS: Final = ("unit", "function", "address")


@dataclass(frozen=True)
class Rendered:
    """A text that says what a configuration says.

    is_whole: it is not the old text edited but a new one, without its comments: the person is told *reason*, and the
              old file is kept (see ``keep_beside``).
    """

    text: str
    is_whole: bool = False
    reason: str = ""


def data_of(config: Config) -> dict[str, Any]:
    """Return what a file has to say for *config*: the keys that were given, with plain TOML values."""
    return config.model_dump(by_alias=True, exclude_unset=True, exclude_none=True)


def text_for(loaded_text: str, config: Config, file_name: str) -> Rendered:
    """Return *loaded_text* edited so that it loads as *config*; where that fails, which it must not, a new text.

    raises: SaveError, if *config* cannot be written so that it loads again: more than 1 MiB, or not valid.
    """
    wanted = data_of(config)
    try:
        return Rendered(_verified(edited(loaded_text, wanted, _title), config, file_name))
    except Exception as error:  # noqa: BLE001  (a fault in editing must not keep anybody from saving)
        reason = f"{type(error).__name__}: {error}"
    try:
        return Rendered(_verified(tomli_w.dumps(wanted), config, file_name), is_whole=True, reason=reason)
    except ConfigError as error:
        raise SaveError(f"{escaped(file_name)} is not saved: what is to be written would not load: {error}") from error


def loaded_with(text: str, path: tuple[str, ...], value: object, file_name: str) -> store.Loaded:
    """Return *text* with *value* at the key of *path*, and all that loading it says.

    raises: ConfigError, if the new text cannot be used; what was wrong with the old one does not matter.
    """
    data = tomllib.loads(text) if _is_toml(text) else {}
    table = data
    for part in path[:-1]:
        inner = table.setdefault(part, {})
        table = inner if isinstance(inner, dict) else {}
    table[path[-1]] = value
    return store.load_text(edited(text, data, _title) if _is_toml(text) else text, file_name)


def _is_toml(text: str) -> bool:
    try:
        tomllib.loads(text)
    except (ValueError, RecursionError):  # loading it says what is wrong
        return False
    return True


def _verified(text: str, config: Config, file_name: str) -> str:
    """*text*, with addresses spelled so that they load, and found to say what *config* says."""
    text = _without_confusion(text)
    loaded = store.load_text(text, file_name).config
    if loaded != config or not same(data_of(loaded), data_of(config)):
        raise SaveError(f"{escaped(file_name)} is not saved: what was to be written says something else")
    return text


def _title(entry: Mapping[str, Any]) -> Hashable:
    """What an entry is known by: its name, or what it asks (see ``RequestConfig.title``)."""
    unit, function, address = (entry.get(key) for key in TITLE_KEYS)
    if entry.get("name") is not None or unit is None:
        return repr(entry["name"]) if "name" in entry else None
    code = FUNCTION_CODES.get(function.replace("_", "-")) if isinstance(function, str) else function
    return repr(f"u{unit}-f{code}-{address}")


def _without_confusion(text: str) -> str:
    """*text* with addresses that look like reference numbers in hexadecimal, as whoever really means them writes."""
    data, statements = tomllib.loads(text), toml_text.scan(text)
    pieces, at = [], 0
    for statement, _ in store.reference_numbers(text, data, statements):
        pieces += [text[at : statement.value_start], f"0x{int(text[statement.value_start : statement.end], 0):04X}"]
        at = statement.end
    return "".join([*pieces, text[at:]])


def save(path: Path, text: str, expected: str | None) -> None:
    """Write *text* to the file at *path*; on return it is on the disk.

    expected: what the file said when it was loaded; None: write over whatever is there. A file that is gone is made.
    raises:   FileChanged, if it says anything else now (but *text*); SaveError, if it cannot be written.
    """
    name = escaped(path.name, files.NAME_CHARACTERS)
    try:
        current = store.read(path)
    except FileNotFoundError:
        current = None
    except OSError as error:
        raise SaveError(f"{name} is not saved: {files.in_words(error, path)}") from error
    except ConfigError as error:
        raise SaveError(f"{name} is not saved: it is not a regular file") from error
    if expected is not None and current not in (None, expected.encode(), text.encode()):
        raise FileChanged(f"{name} is not saved: somebody has changed it since it was read")
    files.write_atomically(path, text.encode())


def keep_beside(path: Path, word: Literal["rejected", "replaced"], when_s: float) -> Path:
    """Copy the file at *path* to "NAME.WORD-DATE" beside it, and return where; raises SaveError.

    when_s: the wall time, in seconds since 1970.
    """
    name = f"{path.name}.{word}-{datetime.fromtimestamp(when_s, UTC):%Y%m%d-%H%M%S}"
    names = (name if n == 1 else f"{name}-{n}" for n in itertools.count(1))
    kept = next(one for one in map(path.with_name, names) if not one.exists())
    try:
        content, mode = path.read_bytes(), path.stat().st_mode & 0o777
    except OSError as error:
        shown = escaped(path.name, files.NAME_CHARACTERS)
        raise SaveError(f"{shown} is not kept: {files.in_words(error, path)}") from error
    files.write_atomically(kept, content, mode)
    return kept
