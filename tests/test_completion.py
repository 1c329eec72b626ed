"""Bash completion, in a real bash: what is typed, and what readline makes of it.

Alt-* puts every completion into the line; then the line is made the arguments of a function that tells them to us. So
nothing is read from the screen, and readline's own rules (file names, quoting) are part of what is tested.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.history import History
from tests.manual import commands, own_arguments

ROOT = Path(__file__).parent.parent
SCRIPT = ROOT / "packaging" / "completion" / "rtugate"
ANSWER_LIMIT_S = 20.0
ALL, START_OF_LINE, TAB, ENTER = "\x1b*", "\x01", "\t", "\r"
FORGET_LINE = "\x15"
COMMON = {"-c", "--state", "-h", "--help"}
TAKE_FILES = [name for name, parser in commands().items() if any(a.dest == "file" for a in own_arguments(parser))]
SET_UP = """\
set enable-bracketed-paste off
set bell-style none
set completion-query-items 0
"""

pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="not installed: bash")


class Shell:
    """An interactive bash that has the completion, in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._terminal, terminal = pty.openpty()
        self._told, tells = os.pipe()
        (folder / "inputrc").write_text(SET_UP)
        environment = {
            "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
            "INPUTRC": str(folder / "inputrc"),
            "HOME": str(folder),
            "TERM": "dumb",
            "PYTHONPATH": str(ROOT),
            "LC_ALL": "C.UTF-8",
        }
        self._process = subprocess.Popen(
            ["bash", "--norc", "--noprofile", "-i"],
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            env=environment,
            cwd=folder,
            pass_fds=[tells],
            start_new_session=True,
        )
        os.close(terminal)
        os.close(tells)
        self._type(
            f"unset HISTFILE; tell() {{ printf '%s\\n' \"$@\" . >&{tells}; }}; . {shlex.quote(str(SCRIPT))}{ENTER}"
        )

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._terminal)
        os.close(self._told)

    def offers(self, line: str) -> list[str]:
        """Return what may stand at the end of *line*; the word that is begun there itself where nothing may."""
        begun = line[line.rindex(" ") + 1 :]
        words = self.words(line + ALL)
        told = words[len(shlex.split(line.removesuffix(begun))) :]
        return [] if told == [begun] else told

    def words(self, keys: str) -> list[str]:
        """Type *keys*; return the words of the line that comes of it."""
        self._type(f"{keys}{START_OF_LINE}tell {ENTER}")
        told = "\n"
        while not told.endswith("\n.\n"):
            ready, _, _ = select.select([self._told, self._terminal], [], [], ANSWER_LIMIT_S)
            assert ready, f"bash says nothing after {keys!r}: {told!r}"
            if self._terminal in ready:  # what it shows is not looked at, but must not fill the terminal
                os.read(self._terminal, 65536)
            if self._told in ready:
                told += os.read(self._told, 65536).decode()
        return told.splitlines()[1:-1]

    def _type(self, keys: str) -> None:
        os.write(self._terminal, keys.encode())


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "rtugate"
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m gateway "$@"\n')
    program.chmod(0o755)
    with contextlib.closing(Shell(tmp_path)) as opened:
        yield opened


def saved(state: Path, count: int) -> None:
    for n in range(count):
        assert History(state / "history").keep(f"# version {n}\n") is None


def test_every_command_is_offered_and_nothing_else(shell: Shell) -> None:
    (shell.folder / "a-file").touch()
    assert shell.offers("rtugate ") == list(commands())


@pytest.mark.parametrize("name", commands())
def test_every_option_of_a_command_is_offered_behind_it(shell: Shell, name: str) -> None:
    own = {option for action in own_arguments(commands()[name]) for option in action.option_strings}
    assert set(shell.offers(f"rtugate {name} -")) == COMMON | own


def test_options_stand_before_the_command_too(shell: Shell) -> None:
    assert set(shell.offers("rtugate -")) == COMMON | {"--version"}
    assert shell.offers("rtugate -c some.toml --state some roll") == ["rollback"]


def test_a_word_that_is_clear_is_completed_by_tab(shell: Shell) -> None:
    assert shell.words(f"rtugate hi{TAB}") == ["rtugate", "history"]
    assert shell.words(f"rtugate status --j{TAB}") == ["rtugate", "status", "--json"]


@pytest.mark.parametrize("name", TAKE_FILES)
def test_a_command_that_takes_a_file_is_offered_files_once(shell: Shell, name: str) -> None:
    (shell.folder / "station one.toml").touch()
    assert shell.words(f"rtugate {name} stat{TAB}") == ["rtugate", name, "station one.toml"]
    assert shell.offers(f"rtugate {name} other.toml stat") == []


@pytest.mark.parametrize("name", sorted(set(commands()) - set(TAKE_FILES) - {"rollback"}))
def test_a_command_that_takes_no_file_is_offered_none(shell: Shell, name: str) -> None:
    (shell.folder / "station.toml").touch()
    assert shell.offers(f"rtugate {name} stat") == []


def test_c_takes_a_file_and_state_a_directory(shell: Shell) -> None:
    (shell.folder / "station.toml").touch()
    (shell.folder / "station.state").mkdir()
    assert shell.offers("rtugate check -c stat") == ["station.state", "station.toml"]
    assert shell.offers("rtugate --state stat") == ["station.state"]
    assert shell.words(f"rtugate --state=stat{TAB}")[1] == "--state=station.state/"


def test_the_values_of_the_demos_options_are_offered_or_left_alone(shell: Shell) -> None:
    (shell.folder / "meter.toml").touch()
    silent = next(action for action in own_arguments(commands()["demo"]) if action.dest == "silent")
    assert shell.offers("rtugate demo --silent ") == list(silent.choices or ())
    assert shell.offers("rtugate demo --seconds me") == []
    assert shell.offers("rtugate demo --port me") == []
    assert shell.offers("rtugate demo --seconds 10 --si") == ["--silent"]


def test_rollback_is_offered_the_saved_versions_newest_first(shell: Shell) -> None:
    saved(shell.folder / "my state", 11)
    numbers = [str(number) for number in range(11, 1, -1)]
    assert shell.offers(r"rtugate --state my\ state rollback ") == numbers
    assert shell.offers(r"rtugate rollback --state ~/my\ state ") == numbers
    assert shell.words(rf"rtugate --state=my\ state rollback 11{TAB}")[-1] == "11"
    assert shell.words(rf"rtugate --state=my\ state rollback 9{TAB}")[-1] == "9"


def test_rollback_is_offered_one_number_and_nothing_where_nothing_was_saved(shell: Shell) -> None:
    (shell.folder / "2.toml").touch()
    assert shell.offers("rtugate --state nothing rollback 2") == []
    saved(shell.folder / "state", 3)
    assert shell.offers("rtugate --state state rollback 3 2") == []


def test_nothing_is_carried_out_by_asking(shell: Shell) -> None:
    for value in ("$(touch${IFS}made)", "`touch${IFS}made`", "';touch${IFS}made;'"):
        assert shell.words(f"rtugate --state {value} rollback {TAB}{FORGET_LINE}") == []
    assert not (shell.folder / "made").exists()
