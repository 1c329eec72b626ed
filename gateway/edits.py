"""Commands that change the configuration file, and then ask the gateway that runs, if one does, to load it anew.

Source: specification of rtugate, sections 6 and 9. Threads: the main one.
"""

from __future__ import annotations

import getpass
import io
import socket
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Final

from gateway import documents
from gateway.clock import SystemClock
from gateway.config import Config
from gateway.config_file import HISTORY
from gateway.errors import ConfigError, GatewayError, SaveError
from gateway.files import in_words, write_atomically
from gateway.history import History
from gateway.hmi.access import hash_password, password_problem
from gateway.save import keep_beside, loaded_with, save, text_for
from gateway.store import Loaded, load, load_text, read, shown

PASSWORD: Final = ("hmi", "password")
READABLE: Final = 0o644  # mode of a file without secrets
NO_HASH_YET: Final = "scrypt$"  # what passes for one until there is one
ANSWER_LIMIT_S: Final = 65.0
ANSWER_MOST: Final = 64 * 1024 * 1024  # characters: whoever is in the gateway's place does not get all memory
ABSENT: Final = (FileNotFoundError, NotADirectoryError, ConnectionRefusedError)


class Refused(GatewayError):
    """The command cannot be carried out; the text says why."""


def set_password(path: Path, control_path: Path) -> list[str]:
    """Ask for a password, write its hash into the file; return what to tell. Raises GatewayError."""
    loaded = _loaded_but_for_password(path)  # before a person types anything
    hmi = loaded.config.hmi.model_copy(update={"password": hash_password(_asked_password())})
    return [*_write(path, loaded.text, loaded.config.model_copy(update={"hmi": hmi})), *ask_reload(control_path)]


def _loaded_but_for_password(path: Path) -> Loaded:
    """Return what the file says, even if it is refused for the password that it lacks."""
    try:
        return load(path)
    except ConfigError:
        content = _present_content(path) or b""
        text = content.decode(errors="replace")
        return replace(loaded_with(text, PASSWORD, NO_HASH_YET, path.name), text=text)


def history(state: Path) -> list[str]:
    """Return a line for each version that was saved, newest first. Raises GatewayError."""
    versions = History(state / HISTORY).versions()
    return [f"{one.number:>4}  {_date(one.when)}  {one.size} bytes" for one in versions] or [
        "nothing has been saved yet"
    ]


def _date(wall_s: float) -> str:
    return datetime.fromtimestamp(wall_s).strftime("%Y-%m-%d %H:%M:%S")  # the station's own time


def rollback(path: Path, state: Path, control_path: Path, number: int) -> list[str]:
    """Write version *number* of the history into the file; return what to tell. Raises GatewayError.

    What the file said before becomes the newest version, so that this can be undone the same way.
    """
    kept = History(state / HISTORY)
    text = kept.text(number)
    load_text(text, f"version {number}")
    before = _present_content(path)
    if before == text.encode():
        return [f"{path}: is version {number} already"]
    expected, remark = (None, None) if before is None else _keep_present(path, before, kept)
    save(path, text, expected)
    remarks = [remark, kept.keep(text)]
    told = [f"{path}: is version {number} again", *(remark for remark in remarks if remark)]
    return [*told, *ask_reload(control_path)]


def _present_content(path: Path) -> bytes | None:
    """Return what the file says, whether it can be used or not; None where there is none."""
    try:
        return read(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise Refused(f"{path}: cannot be read: {in_words(error, path)}") from error


def _keep_present(path: Path, content: bytes, history: History) -> tuple[str | None, str | None]:
    """Keep what the file says in *history*, or beside it if it cannot be used.

    returns: what it says, None if it cannot be used; what there is to tell, if anything.
    """
    try:
        text = load_text(content, path.name).text
    except ConfigError:
        kept = keep_beside(path, "rejected", SystemClock().wall())
        return None, f"what was there cannot be used and is kept as {kept.name}"
    return text, history.keep(text)


def start_file(path: Path, text: bytes, schema_text: bytes, is_forced: bool) -> list[str]:
    """Write a file to start from, and its schema beside it; return what to tell. Raises GatewayError."""
    before, schema = _content_if_any(path), path.with_name(documents.SCHEMA_NAME)
    if path == schema:
        raise SaveError(f"rtugate: {shown(path)}: the schema is called so: take another name")
    if before is not None and not is_forced:
        raise SaveError(
            f"rtugate: {shown(path)}: this file exists: --force keeps it under another name and writes a new one"
        )
    kept = None if before in (None, text) else keep_beside(path, "replaced", SystemClock().wall())
    write_atomically(schema, schema_text, READABLE)
    write_atomically(path, text)
    return [
        f"{shown(path)}: written" + (f"; what was there is now {shown(Path(kept.name))}" if kept else ""),
        f"{shown(schema)}: written; editors (VS Code with Even Better TOML) explain and check each key by it",
        "edit the file, then `rtugate check` says what is wrong with it",
    ]


def _content_if_any(path: Path) -> bytes | None:
    """What the file at *path* says, None where there is none. Raises GatewayError, also for what is no file."""
    try:
        return read(path)
    except FileNotFoundError as error:
        if not path.parent.is_dir():
            raise SaveError(f"rtugate: {shown(path)}: its folder does not exist") from error
        return None
    except OSError as error:
        raise SaveError(f"rtugate: {shown(path)}: {in_words(error, path)}") from error


def _asked_password() -> str:
    """Ask twice at a terminal; take the first line of anything else."""
    stdin = sys.stdin or io.StringIO()  # None: closed from the start
    try:
        if stdin.isatty():
            first = getpass.getpass("New password: ")
            again = getpass.getpass("The same again: ")
        else:
            first = again = stdin.readline().rstrip("\n")
    except (EOFError, KeyboardInterrupt, UnicodeDecodeError) as error:
        raise Refused("no password was given: it stays as it was") from error
    problem = password_problem(first)
    if problem:
        raise Refused(problem)
    if first != again:
        raise Refused("these two differ: the password stays as it was")
    return first


def _write(path: Path, text: str, config: Config) -> list[str]:
    rendered, told = text_for(text, config, path.name), [f"{path}: saved"]
    if rendered.is_whole:
        kept = keep_beside(path, "replaced", SystemClock().wall())
        told.append(f"it is written anew, without its comments; the old file is kept as {kept.name}")
    save(path, rendered.text, text)
    return told


def ask_reload(control_path: Path) -> list[str]:
    """Ask the gateway that runs to load its file anew; return what it says, for a person. Raises Refused."""
    try:
        answer = ask_gateway(control_path, "reload")
    except Refused as error:
        raise Refused(f"saved, but the gateway cannot be asked to take it: {error}") from error
    if answer is None:
        return ["no gateway runs here: the change counts from its next start"]
    if not answer:
        raise Refused("saved, but the gateway ended before it answered: the change counts from its next start")
    if answer.startswith("error:"):
        raise Refused(f"saved, but the gateway that runs did not take it: {answer.removeprefix('error:').strip()}")
    return [answer]


def ask_gateway(control_path: Path, line: str) -> str | None:
    """Send *line* to the control socket; return the answer, or None where no gateway runs. Raises Refused."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(ANSWER_LIMIT_S)
        try:
            connection.connect(str(control_path))
            connection.sendall(f"{line}\n".encode())
            with connection.makefile("r", encoding="utf-8", errors="replace") as answer:
                return answer.read(ANSWER_MOST).strip()
        except ABSENT:
            return None
        except OSError as error:
            raise Refused(f"{control_path}: {error.strerror or error}") from error
