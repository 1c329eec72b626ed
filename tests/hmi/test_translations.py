"""The menu in Spanish and Portuguese: complete catalogues that fit the code, and screens that fit the terminal.

Each transcript of the menu is played again in each language; see ``catalogues`` for the files.
"""

from __future__ import annotations

import ast
import dataclasses
import re
import string
import tomllib
import unicodedata
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Final

import pytest
from babel.messages.catalog import Message

from gateway.config import FUNCTION_CODES
from gateway.hmi.seat import Rank
from gateway.hmi.terminals import too_many
from gateway.hmi.texts import FOLDER, translation, translation_in
from gateway.hmi.wording import Translate, without_accents
from tests.fakes import JumpingClock
from tests.hmi import catalogues, desk
from tests.hmi.catalogues import LANGUAGES, messages, po, po_path, template
from tests.hmi.desk import STATIONS, Desk, DeskStation
from tests.hmi.terminals import CHEAP_HASH, House, PatientBackground, Screen
from tests.hmi.transcript import FOLDER as TRANSCRIPTS
from tests.hmi.transcript import Transcript, parse, played

ROOT: Final = FOLDER.parents[2]
COLUMNS, ROWS = 80, 24
SAME: Final = {  # texts that are the same in a language, and why
    "hex": "the usual short form, 4 columns wide",
    "bits": "the usual word in all three",
    "manual": "the same word in all three",
    "{name}: {trouble}": "nothing but names",
}
ROOM: Final = {  # columns that a screen has for a text
    **dict.fromkeys(("point", "value", "age"), 5),
    **dict.fromkeys(("quality", "never", "good", "bad", "stale", "manual"), 7),
    **dict.fromkeys(("never answered", "offline", "maintenance"), 14),
    **dict.fromkeys(("master", "slave"), 7),
    **dict.fromkeys(("on", "off", "trouble"), 8),
    "signed": 6,
    "hex": 4,
    "bits": 16,
}
WORD: Final = re.compile("[A-Za-z][a-z]+")
BOILER: Final = (STATIONS / "boiler.toml").read_text()
FILES: Final = sorted(TRANSCRIPTS.glob("*.txt"))
all_languages = pytest.mark.parametrize("language", LANGUAGES)
all_transcripts = pytest.mark.parametrize("path", FILES, ids=[path.stem for path in FILES])


def of_each(language: str) -> list[Message]:
    """The texts and their translations; both are str, none has a plural."""
    found = messages(po(language))
    assert len(found) > 200
    return found


# ------------------------------------------------------------------------------------------------ the catalogues


@all_languages
def test_each_text_of_the_code_is_in_the_catalogue_and_no_other(language: str) -> None:
    assert {message.id for message in of_each(language)} == {message.id for message in messages(template())}


@all_languages
def test_no_text_is_untranslated_fuzzy_or_left_over(language: str) -> None:
    assert [message.id for message in of_each(language) if not message.string or message.fuzzy] == []
    assert "#~" not in po_path(language).read_text("utf-8")


@all_languages
def test_no_text_is_the_same_in_another_language_without_a_reason(language: str) -> None:
    assert {message.id for message in of_each(language) if message.string == message.id} <= set(SAME)


def test_each_reason_for_a_text_to_stay_the_same_is_needed() -> None:
    same = {message.id for language in LANGUAGES for message in of_each(language) if message.string == message.id}
    assert same == set(SAME)


def placeholders(text: str) -> list[tuple[str, str, str]]:
    parts = string.Formatter().parse(text)
    return sorted((name, spec or "", conversion or "") for _text, name, spec, conversion in parts if name is not None)


@all_languages
def test_placeholders_are_those_of_the_text(language: str) -> None:
    wrong = [m.id for m in of_each(language) if placeholders(str(m.string)) != placeholders(str(m.id))]
    assert wrong == []


def edges(text: str) -> tuple[str, str, int]:
    """What joins a text to what stands before and behind it."""
    start = re.match(r"\s*[;,.*>]*\s*", text)
    return (start[0] if start else "", text[len(text.rstrip()) :], text.count("\n"))


@all_languages
def test_spaces_at_the_edges_and_line_breaks_are_those_of_the_text(language: str) -> None:
    assert [m.id for m in of_each(language) if edges(str(m.string)) != edges(str(m.id))] == []


@all_languages
def test_a_text_that_ends_a_sentence_ends_one_in_each_language(language: str) -> None:
    ends = {m.id: (str(m.id)[-1:], str(m.string)[-1:]) for m in of_each(language) if " " in str(m.id)}
    assert [text for text, (ours, theirs) in ends.items() if (ours in ".?:") != (theirs in ".?:")] == []


@all_languages
def test_keys_that_a_text_names_are_the_same_in_each_language(language: str) -> None:
    def keys(text: object) -> list[str]:
        return sorted(re.findall(r"\b(?:[B-DF-HJ-NP-Z]|Esc|Enter)\b", str(text).replace(" (L ", " (vea L ")))

    assert [m.id for m in of_each(language) if keys(m.string) != keys(m.id)] == []


@all_languages
def test_a_text_fits_where_a_screen_has_little_room_for_it(language: str) -> None:
    known = {message.id: str(message.string) for message in of_each(language)}
    assert [text for text, room in ROOM.items() if len(known[text]) > room] == []


@all_languages
def test_letters_are_those_that_a_terminal_shows_one_by_one(language: str) -> None:
    for message in of_each(language):
        text = str(message.string)
        assert unicodedata.is_normalized("NFC", text)
        assert all(unicodedata.category(c)[0] in "LPNSZ" and unicodedata.east_asian_width(c) in "Na A N" for c in text)
        assert str(message.id).isascii()


@all_languages
def test_a_text_without_accents_keeps_each_letter_and_reads_well(language: str) -> None:
    for message in of_each(language):
        text = str(message.string)
        plain = without_accents(text)
        assert len(plain) == len(text.lstrip("¿")), text
        assert "?" not in plain or text.count("?") == plain.count("?")


# ------------------------------------------------------------------------------------------------ the files


def test_the_files_are_what_make_translations_writes(tmp_path: Path) -> None:
    for path in files(FOLDER):
        copy = tmp_path / path.relative_to(FOLDER)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
    assert catalogues.update(tmp_path) == []
    assert contents(tmp_path) == contents(FOLDER)


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files(folder)}


def test_a_new_text_waits_for_a_person_and_one_that_is_gone_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = [("this menu", "a.py")]
    monkeypatch.setattr(catalogues, "texts_of_the_code", lambda: iter(texts))
    assert len(catalogues.update(tmp_path)) == 2
    known = po("es", tmp_path)
    known["this menu"].string = "este menú"
    po_path("es", tmp_path).write_bytes(catalogues.po_bytes(known))

    assert catalogues.update(tmp_path) == ["rtugate.po (pt): 'this menu' has to be translated"]
    assert translation_in(tmp_path, "es")("this menu") == "este menú"

    texts[:] = [("this menus", "a.py"), ("quite another", "b.py")]
    assert len(catalogues.update(tmp_path)) == 4
    assert po("es", tmp_path)["this menus"].fuzzy
    assert translation_in(tmp_path, "es")("this menus") == "this menus"
    assert [message.id for message in messages(po("es", tmp_path))] == ["this menus", "quite another"]


def test_the_mo_of_each_language_says_what_its_po_says() -> None:
    for language in LANGUAGES:
        translate = translation(language)
        assert [m.id for m in of_each(language) if translate(str(m.id)) != m.string] == []


def test_the_package_carries_every_module_and_every_catalogue() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    packages = {path.parent.relative_to(ROOT).as_posix().replace("/", ".") for path in catalogues.modules()}
    assert packages == set(setuptools["packages"])
    carried = setuptools["package-data"]["gateway.hmi"]
    catalogue_names = [path.relative_to(FOLDER.parent).as_posix() for path in files(FOLDER) if path.suffix == ".mo"]
    assert len(catalogue_names) == len(LANGUAGES)
    assert all(any(fnmatch(name, pattern) for pattern in carried) for name in catalogue_names)


# ------------------------------------------------------------------------------------------------ the code


@pytest.mark.parametrize("path", catalogues.modules(), ids=lambda path: path.stem)
def test_no_text_is_put_together_before_it_is_translated(path: Path) -> None:
    wrong = (ast.JoinedStr, ast.BinOp)
    found = [ast.unparse(node) for node in catalogues.marked(path.read_text("utf-8")) if isinstance(node, wrong)]
    assert [text for text in found if text] == []


def test_texts_in_braces_and_in_calls_are_found() -> None:
    source = 'f"{_(\'point\'):>5}"; ui.translate("Master"); N_("later"); _(name); other("no text"); _("a" "b")'
    found = [node.value for node in catalogues.marked(source) if isinstance(node, ast.Constant)]
    assert found == ["point", "Master", "later", "ab"]


# ------------------------------------------------------------------------------------------------ reading them


def test_english_is_the_texts_themselves() -> None:
    assert translation("en")("this menu") == "this menu"


@all_languages
def test_no_text_stays_none(language: str) -> None:
    assert translation(language)("") == ""
    assert translation(language, True)("") == ""


def test_a_text_that_no_catalogue_knows_stays_english() -> None:
    assert translation("es")("/dev/ttyS9 is not there") == "/dev/ttyS9 is not there"


def test_a_language_without_accents() -> None:
    assert translation("es")("Password: ") == "Contraseña: "
    assert translation("es", True)("Password: ") == "Contrasena: "
    assert translation("es", True)("Leave without saving?") == "Salir sin guardar?"


@pytest.mark.parametrize("content", [None, b"", b"no catalogue", b"\xde\x12\x04\x95" + b"\xff" * 40])
def test_a_language_that_cannot_be_read_is_logged_and_english(
    content: bytes | None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = po_path("es", tmp_path).with_suffix(".mo")
    path.parent.mkdir(parents=True)
    if content is not None:
        path.write_bytes(content)
    translate = translation_in(tmp_path, "es")
    assert translate("this menu") == "this menu"
    assert [record.message for record in caplog.records if "'es' cannot be read" in record.message]


# ------------------------------------------------------------------------------------------------ on the screen


@cache
def shown(path: Path, language: str, columns: int = COLUMNS, is_ascii: bool = False) -> list[str]:
    """All lines that the terminal shows while the transcript at *path* is played in *language*."""
    return played(widened(path.read_text(), columns), language, is_ascii)[1].terminal.lines


def widened(text: str, columns: int) -> str:
    """The transcript for a terminal that is wider than usual; one that is for a small terminal stays as it is."""
    if columns == COLUMNS or "\nterminal: " in text:
        return text
    return re.sub(r"^(station: .*)$", rf"\1\nterminal: {columns} columns", text, count=1, flags=re.MULTILINE)


def typed(path: Path) -> set[str]:
    """The words that somebody types, or that come from elsewhere: they are as long as they are."""
    return {word for block in transcript_of(path).blocks for word in block.cause.replace("<Enter>", " ").split()}


def transcript_of(path: Path) -> Transcript:
    return parse(path.read_text())


@all_languages
@all_transcripts
def test_every_screen_fits_80_columns(path: Path, language: str) -> None:
    long = {word for word in typed(path) if len(word) > 40}
    wide = [line for line in shown(path, language) if len(line) >= COLUMNS]
    assert [line for line in wide if not any(word in line for word in long)] == []


def joined(lines: list[str]) -> str:
    return "".join("".join(lines).split())


@all_languages
@all_transcripts
def test_nothing_is_cut_off_that_is_whole_in_english(path: Path, language: str) -> None:
    english, theirs = shown(path, "en", 500), shown(path, language, 500)
    everything = joined(shown(path, language))
    cut = [
        line
        for ours, line in zip(english, theirs, strict=True)
        if len(ours) < COLUMNS <= len(line) and joined([line]) not in everything
    ]
    assert cut == []


@all_languages
@all_transcripts
def test_a_screen_takes_at_most_a_line_more_than_in_english_and_fits_24(path: Path, language: str) -> None:
    text = path.read_text()
    blocks, ours = played(text, language)[0].blocks, played(text)[0].blocks
    assert len(blocks) == len(ours)
    for block, english in zip(blocks, ours, strict=True):
        if block.cause.count("<") + len(block.cause.split()) <= 2:  # one key
            assert len(block.shown) <= max(ROWS, len(english.shown) + 1), block.text()


def test_the_main_menu_stands_in_two_straight_columns() -> None:
    for language in ("en", *LANGUAGES):
        menu = [line for line in shown(FILES[0], language)[:ROWS] if re.match(r"  [A-Z]  ", line)]
        assert "".join(line[2] + line[40] for line in menu) == "MNDWZUCIRTVLBPAFSXK?EQ", language
        assert all(line[39] == " " and line[41:43] == "  " for line in menu), language


@all_languages
@all_transcripts
def test_a_terminal_of_ascii_gets_ascii_and_the_same_words(path: Path, language: str) -> None:
    plain = shown(path, language, 500, True)
    assert all(line.isascii() for line in plain)
    assert plain == [without_accents(line) for line in shown(path, language, 500)]


@all_languages
def test_yes_is_the_language_s_own_letter_or_y_and_no_is_n(language: str) -> None:
    for key, has_deleted in (("s", True), ("y", True), ("n", False)):
        station = DeskStation(BOILER)
        person = Desk(station, language)
        assert "(s/n): " in person.type("nb1")
        person.type(key)
        assert (station.config.master == []) is has_deleted


@all_languages
def test_a_word_that_stands_for_a_choice_is_taken_in_the_language_and_in_english(language: str) -> None:
    for word in ("any", "todas"):
        station = DeskStation(BOILER.replace("unit = 1\n", 'unit = 1\nallow = ["10.0.0.0/8"]\n'))
        Desk(station, language).type("nm2\r\r\r\r\r" + word + "\r")
        assert station.config.slave[0].allow == []


# ------------------------------------------------------------------------------------------------ nothing is forgotten


def veiled(text: str) -> str:
    """A language in which each letter is ø: what can still be read on the screen was never given to it."""
    parts = []
    for literal, name, spec, _conversion in string.Formatter().parse(text):
        parts.append(re.sub("[A-Za-z]", "ø", literal))
        parts.append("" if name is None else f"{{{name}:{spec}}}" if spec else f"{{{name}}}")
    return "".join(parts)


CONFIG_WORDS: Final = {"rtugate", "rtu", "ascii", "tcp", *"-".join(FUNCTION_CODES).split("-")}
ENGLISH: Final = {  # what is the same in every language, and why
    r"\d\d-\d\d \d\d:\d\d:\d\d (INFO|WARNING|ERROR) .*": "the log: it is looked up, and sent to others",
    r"\d\d:\d\d:\d\d\.\d{3} [<>] .*": "frames: the words of the standard",
    r"\b(line|point|name) .* (is|are) .*": "findings of the configuration checks, as `rtugate check` words them",
    r"[-+] .*": "lines of the file",
    r"the polls need .*": "a finding, too",
    r"what came was no undamaged reply": "the line's own words, as in the log",
    r"\bmenu$": "who wrote a point, as the register keeps it",
    r"\bnan\b": "a float that is none",
}


@all_transcripts
def test_no_word_of_a_screen_escapes_translation(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(desk, "translation", lambda _language: veiled)
    text = path.read_text()
    transcript, player = played(widened(text, 500))
    station = next(line for line in transcript.head if line.startswith("station: ")).removeprefix("station: ")
    causes = " ".join(block.cause for block in transcript.blocks)
    elsewhere = " ".join([(STATIONS / f"{station}.toml").read_text(), *transcript.head, causes])
    known = tuple(CONFIG_WORDS.union(WORD.findall(elsewhere)))
    english = re.compile("|".join(ENGLISH))
    words = {word: line for line in player.terminal.lines for word in WORD.findall(english.sub("", line))}
    ends = [word for word in words if not any(one.endswith(word) for one in known)]  # a start may answer another prompt
    assert [words[word] for word in ends] == []


def a_house(clock: JumpingClock, translate: Translate, **hmi: object) -> House:
    """A house whose terminals speak another language."""
    house = House(clock, PatientBackground(), serial={"line": "/dev/ttyS3"}, **hmi)
    house.shared = dataclasses.replace(house.shared, translation=lambda: translate)
    return house


def evening(clock: JumpingClock, translate: Translate) -> str:
    """Return all that terminals show when people come, wait, lose the menu, forget their password and fall asleep."""
    house = a_house(clock, translate)
    console, first = Screen(house, Rank.SERIAL), Screen(house)
    second = Screen(house, address="10.0.0.6")
    seen = console.shown() + first.shown() + second.shown()
    clock.pass_s(29)
    seen += second.shown() + first.run_s(2) + second.shown() + console.type("\r\r") + first.shown() + second.shown()
    seen += console.run_s(31) + first.shown() + second.shown() + console.shown()
    local = Screen(house, Rank.LOCAL)
    seen += local.shown() + first.shown() + local.run_s(301)
    house = a_house(clock, translate, password=CHEAP_HASH)
    stranger = Screen(house)
    for password in ("wrong", "wrong again", "x" * 70, "wrong", "wrong", "wrong"):
        seen += stranger.type(password + "\r")
        house.passwords.work()  # type: ignore[attr-defined] # it is patient, see a_house
        seen += stranger.run_s(9)
    return seen + Screen(house, address="10.0.0.7").run_s(61) + too_many(house.shared)


def test_no_word_of_a_session_escapes_translation(clock: JumpingClock) -> None:
    seen = evening(clock, veiled)
    for name in ("MAIN MENU", "(telnet)", "maria (rtugate menu)", "serial console", "rtugate", r"['\r']"):
        seen = seen.replace(name, "")
    assert WORD.findall(seen) == []
    assert seen.count("ø") > 500


@all_languages
def test_a_session_speaks_the_language_and_fits_80_columns(language: str, clock: JumpingClock) -> None:
    seen = evening(clock, translation(language))
    assert {"es": "Contraseña: ", "pt": "Senha: "}[language] in seen
    assert [line for line in seen.split("\r\n") if len(line) >= COLUMNS and not line.startswith("MAIN MENU")] == []
    assert evening(clock, translation(language, True)).isascii()


def test_a_text_that_is_not_marked_would_be_seen() -> None:
    assert WORD.findall(veiled("{name} is in {state:<14} now")) == ["name", "state"]
    assert WORD.findall(veiled("{name} is in {state:<14} now").format(name="field", state="idle")) == ["field", "idle"]
