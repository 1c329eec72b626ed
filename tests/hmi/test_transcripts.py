"""Every screen as a person sees it: plain-text transcripts, played and compared (see ``transcript``).

``UPDATE_TRANSCRIPTS=1 pytest tests/hmi/test_transcripts.py`` writes them anew, and fails: read what has changed.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gateway.hmi.screens.main import KEYS
from tests.hmi.transcript import FOLDER, Terminal, keys, lines, parse, played

FILES = sorted(FOLDER.glob("*.txt"))
TYPED_FREELY = "Port or address: "  # what a person types may go beyond the terminal's width


@pytest.mark.parametrize("path", FILES, ids=[path.stem for path in FILES])
def test_a_person_sees_what_the_transcript_says(path: Path) -> None:
    expected = path.read_text()
    shown = played(expected)[0].text()
    if os.environ.get("UPDATE_TRANSCRIPTS") and shown != expected:
        path.write_text(shown)
        pytest.fail(f"{path.name} was written anew: read it")
    assert shown == expected


@pytest.mark.parametrize("path", FILES, ids=[path.stem for path in FILES])
def test_every_screen_fits_the_terminal(path: Path) -> None:
    player = played(path.read_text())[1]
    menu = player.desk.menu
    shown = [line for line in player.terminal.lines if not line.startswith(TYPED_FREELY)]
    assert max(len(line) for line in shown) < menu.columns
    assert all(line.isascii() and line.isprintable() for line in shown)
    assert player.most_at_once <= max(menu.rows, 24)


def test_every_key_of_the_main_menu_has_its_transcript() -> None:
    shown = [line for path in FILES for line in path.read_text().splitlines()]
    for key in KEYS:
        assert f"rtugate> {key}" in shown, key


# ------------------------------------------------------------------------------------------------ the tool itself

SMALL = "# nothing\nstation: boiler\n\n# ask\n>> k 12<Enter>\n"


def test_a_transcript_that_says_something_else_is_noticed() -> None:
    transcript = played(SMALL)[0]
    shown = transcript.text()
    assert "scada answers to unit 12." in shown
    assert played(shown)[0].text() == shown
    wrong = shown.replace("unit 12.", "unit 13.")
    assert wrong != shown
    assert played(wrong)[0].text() == shown


def test_remarks_stay_where_they_are() -> None:
    transcript = parse(">> m\nrtugate> m\n\n\n# why\n-- wait 1 s\n[3 blank lines]\nrtugate>   \n\n")
    assert [block.text() for block in transcript.blocks] == [
        ">> m\nrtugate> m",
        "# why\n-- wait 1 s\n[3 blank lines]\nrtugate>",
    ]


def test_what_nobody_knows_of_is_no_transcript() -> None:
    for wrong in ("-- pigs fly", "terminal: 3 wheels", "weather: fine"):
        with pytest.raises(AssertionError, match=wrong.split(": ")[-1].split()[-1]):
            played(f"station: boiler\n{wrong}\n\n>>\n")


def test_keys_are_told_from_what_they_stand_for() -> None:
    assert keys("d 3 107<Enter> a<Space>b <Esc>< x") == ["d", "3", "107", "\r", "a", " ", "b", "\x1b", "<", "x"]
    assert lines("d<Enter> 1 2<Enter> x") == ["d\r", "12\r", "x"]


def test_a_terminal_erases() -> None:
    terminal = Terminal()
    terminal.show("ab\b \bc\nd\b\b")
    assert [line.rstrip() for line in terminal.lines] == ["ac", "d"]
