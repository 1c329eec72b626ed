"""Saving the configuration: the file says what the configuration says, comments and all; and what a person is shown."""

from __future__ import annotations

import resource
import stat
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway import save as save_module
from gateway.config import Config, HmiConfig
from gateway.difference import difference
from gateway.errors import FileChanged, HistoryError, SaveError
from gateway.history import KEPT, History
from gateway.save import data_of, keep_beside, save, text_for
from gateway.store import load_text
from tests.random_edits import live, sound

FULL = (Path(__file__).parent / "data" / "full.toml").read_text(encoding="utf-8")

FILE = """\
# The cellar.
[[master]]
name = "field"
line = "/dev/ttyS2"

# Hot water.
[[master.request]]
unit = 17
function = "read_holding_registers"  # the handbook's name
address = 107
count = 3
every = 1
point = 0

[hmi.wifly]
ssid = "cellar"
passphrase = "old secret"
"""


def changed(text: str, **keys: Any) -> Config:
    """The configuration in *text* with *keys* of its first request changed; None takes one away."""
    data = tomllib.loads(text)
    request = data["master"][0]["request"][0]
    request |= keys
    for key in [key for key, value in request.items() if value is None]:
        del request[key]
    return sound(data)


# --- random edits


@pytest.mark.parametrize("first_seed", range(0, 100, 10))
def test_1000_random_edits_lose_move_and_double_no_comment(first_seed: int) -> None:
    for seed in range(first_seed, first_seed + 10):
        live(seed, saves=10)


# --- what is written


def test_what_was_not_given_is_not_written() -> None:
    config = load_text(FILE, "x.toml").config
    assert data_of(config) == tomllib.loads(FILE)
    assert data_of(Config.model_validate({"hmi": {}})) == {"hmi": {}}
    assert data_of(Config()) == {}


def test_a_key_that_was_taken_away_is_not_written() -> None:
    config = load_text(FILE, "x.toml").config
    request = config.master[0].request[0].model_copy(update={"name": None, "count": 2})
    master = config.master[0].model_copy(update={"request": [request]})
    rendered = text_for(FILE, config.model_copy(update={"master": [master]}), "x.toml")
    assert (rendered.text, rendered.is_whole) == (FILE.replace("count = 3", "count = 2"), False)


def test_what_the_menu_sets_is_written_and_nothing_else() -> None:
    config = load_text(FULL, "full.toml").config
    assert text_for(FULL, config, "full.toml").text == FULL
    language = HmiConfig.model_validate(data_of(config)["hmi"] | {"language": "pt"})
    rendered = text_for(FULL, config.model_copy(update={"hmi": language}), "full.toml")
    assert rendered.text == FULL.replace('language = "en"', 'language = "pt"')


def test_a_request_without_a_name_keeps_its_comments_when_it_gets_one_or_moves() -> None:
    assert text_for(FILE, changed(FILE, name="boiler"), "x").text == FILE.replace(
        "point = 0\n", 'point = 0\nname = "boiler"\n'
    )
    assert text_for(FILE, changed(FILE, address=108), "x").text == FILE.replace("107", "108")


def test_requests_without_names_are_told_apart_by_what_they_ask() -> None:
    data = tomllib.loads(FILE)
    first = data["master"][0]["request"][0]
    data["master"][0]["request"] = [first | {"address": 9, "point": 9}, first | {"function": 3, "count": 1}]
    text = text_for(FILE, sound(data), "x").text
    assert text.index("address = 9") < text.index("# Hot water.") < text.index("address = 107")


@pytest.mark.parametrize(
    ("keys", "spelled"),
    [
        ({"address": 40108}, "address = 0x9CAC"),
        ({"function": 4, "address": 30001}, "address = 0x7531"),
        ({"function": 4, "address": 40108}, "address = 40108"),  # no input register's number
    ],
)
def test_an_address_that_looks_like_a_reference_number_is_written_so_that_it_loads(
    keys: dict[str, Any], spelled: str
) -> None:
    config = changed(FILE, **keys)
    rendered = text_for(FILE, config, "x.toml")
    assert spelled in rendered.text
    assert load_text(rendered.text, "x.toml").config == config


def test_an_old_address_that_now_looks_like_a_reference_number_is_respelled() -> None:
    old = FILE.replace('"read_holding_registers"', "4").replace("107", "40108")
    assert "address = 0x9CAC\n" in text_for(old, changed(old, function=3), "x.toml").text


def test_a_file_that_is_not_there_yet_is_written_from_nothing() -> None:
    rendered = text_for("", load_text(FILE, "x").config, "x.toml")
    assert not rendered.is_whole
    assert tomllib.loads(rendered.text) == tomllib.loads(FILE)


FORGETFUL = FILE.replace("count = 3", "count = 2").replace("107", "0x9CAC")  # no `enabled = true`


@pytest.mark.parametrize("fault", ["raises", "writes something else", "writes no TOML", "forgets what is a default"])
def test_a_fault_in_editing_leads_to_a_whole_new_text(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = {"writes something else": FILE, "writes no TOML": "x", "forgets what is a default": FORGETFUL}

    def faulty(*_: object) -> str:
        return texts[fault]  # KeyError, if it "raises"

    monkeypatch.setattr(save_module, "edited", faulty)
    config = changed(FILE, count=2, enabled=True, address=40108)
    rendered = text_for(FILE, config, "x.toml")
    assert rendered.is_whole
    assert rendered.reason
    assert load_text(rendered.text, "x.toml").config == config
    assert "enabled = true" in rendered.text
    assert "0x9CAC" in rendered.text


def test_a_damaged_text_is_replaced_by_a_whole_new_one() -> None:
    config = load_text(FILE, "x").config
    assert text_for("[[[", config, "x.toml").is_whole


def test_a_configuration_that_would_not_load_is_not_written() -> None:
    config = load_text(FILE, "x").config
    twice = config.model_copy(update={"master": [config.master[0], config.master[0]]})
    with pytest.raises(SaveError, match=r"x\.toml is not saved: what is to be written would not load: .*already"):
        text_for(FILE, twice, "x.toml")


def test_a_configuration_that_is_too_large_to_load_again_is_not_written() -> None:
    networks = [f"10.{n // 256}.{n % 256}.128/25" for n in range(60_000)]
    slave = {"name": "scada", "line": "tcp://127.0.0.1:502", "unit": 1, "allow": networks}
    with pytest.raises(SaveError, match="is larger than 1 MiB"):
        text_for("", sound({"slave": [slave]}), "x.toml")


def test_a_thousand_requests_are_saved_in_less_than_two_seconds(tmp_path: Path) -> None:
    text = '[register]\nholding_registers = 65536\n\n[[master]]\nname = "m"\nline = "/dev/ttyS1"\n'
    for i in range(1000):
        text += f'\n# {i}\n[[master.request]]\nname = "r{i}"\nunit = 1\nfunction = 3\naddress = {i}\ncount = 1\n'
        text += f"point = {i}  # here\n"
    data = tomllib.loads(text)
    requests = data["master"][0]["request"]
    data["master"][0]["request"] = [one | {"every": 9.0} for one in requests[10:]]
    config = sound(data)
    path = tmp_path / "x.toml"
    started = time.process_time()
    rendered = text_for(text, config, "x.toml")
    save(path, rendered.text, None)
    assert time.process_time() - started < 2.0
    assert not rendered.is_whole
    assert rendered.text.count("# here") == 990


@pytest.mark.parametrize(
    "piece", ["# x\n", "\n", "a = 1\n", "[[x]]\n", "x = [1, 2]\n", "x = [\n # a\n 1,\n]\n", "[[x]]\n\n", "  \t"]
)
def test_no_file_takes_long_however_it_is_made(piece: str) -> None:
    text = "".join(piece.replace("a =", f"a{i} =").replace("x =", f"x{i} =") for i in range(200_000 // len(piece)))
    started = time.process_time()
    text_for(text, load_text(FILE, "x").config, "x.toml")
    assert time.process_time() - started < 10.0  # with the square of its length it takes minutes


# --- the file


def test_a_save_is_on_the_disk_and_the_file_keeps_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("old é")
    path.chmod(0o604)
    save(path, "new é", "old é")
    assert path.read_text() == "new é"
    assert stat.S_IMODE(path.stat().st_mode) == 0o604


def test_a_file_that_somebody_changed_is_left_alone_unless_it_is_written_over(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("by hand")
    with pytest.raises(FileChanged, match=r"x\.toml is not saved: somebody has changed it since it was read"):
        save(path, "new", "old")
    assert path.read_text() == "by hand"
    save(path, "new", None)
    assert path.read_text() == "new"


def test_a_file_that_says_already_what_is_to_be_saved_is_no_conflict(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("new")
    save(path, "new", "old")
    assert path.read_text() == "new"


def test_a_file_that_is_gone_is_made_anew_for_its_group_only(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    save(path, "new", "old")
    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


@pytest.mark.parametrize("expected", [None, "old"])
def test_what_is_no_file_is_not_replaced(tmp_path: Path, expected: str | None) -> None:
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(SaveError, match=r"folder\.toml is not saved"):
        save(tmp_path / "folder.toml", "new", expected)
    with pytest.raises(SaveError, match="null is not saved: it is not a regular file"):
        save(Path("/dev/null"), "new", expected)


def test_a_file_is_kept_beside_with_its_mode_and_its_date(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(b"\xff")
    path.chmod(0o600)
    kept = keep_beside(path, "rejected", when_s=1_700_000_000.5)
    assert kept == tmp_path / "x.toml.rejected-20231114-221320"
    assert kept.read_bytes() == b"\xff"
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    assert keep_beside(path, "rejected", when_s=1_700_000_000.5).name == "x.toml.rejected-20231114-221320-2"
    with pytest.raises(SaveError, match=r"y\.toml is not kept: "):
        keep_beside(tmp_path / "y.toml", "replaced", when_s=0.0)


# --- the history


def test_the_last_ten_versions_are_kept_the_newest_first(tmp_path: Path) -> None:
    history = History(tmp_path / "state" / "history")
    assert history.versions() == []
    for n in range(1, 13):
        assert history.keep(f"version {n}") is None
    assert [version.number for version in history.versions()] == list(range(12, 2, -1))
    assert len(history.versions()) == KEPT
    assert history.text(12) == "version 12"
    newest = history.versions()[0]
    assert newest.size == 10
    assert newest.when == pytest.approx(time.time(), abs=60)
    assert stat.S_IMODE((tmp_path / "state" / "history" / "0012.toml").stat().st_mode) == 0o640


def test_a_version_that_is_the_same_as_the_newest_is_not_kept_again(tmp_path: Path) -> None:
    history = History(tmp_path)
    for text in ("a", "a", "b", "a"):
        assert history.keep(text) is None
    assert [(one.number, history.text(one.number)) for one in history.versions()] == [(3, "a"), (2, "b"), (1, "a")]


def test_other_files_in_the_history_are_left_alone(tmp_path: Path) -> None:
    for name in ("notes.txt", "00001.toml", "1.toml", ".0001.toml.swp"):
        (tmp_path / name).touch()
    history = History(tmp_path)
    for n in range(12):
        history.keep(str(n))
    assert len(history.versions()) == KEPT
    assert len(list(tmp_path.iterdir())) == KEPT + 4


def test_a_version_that_is_not_there_or_damaged_says_so(tmp_path: Path) -> None:
    history = History(tmp_path)
    with pytest.raises(HistoryError, match="there is no version 7"):
        history.text(7)
    (tmp_path / "0007.toml").write_bytes(b"\xff")
    with pytest.raises(HistoryError, match="version 7 is damaged"):
        history.text(7)
    (tmp_path / "0008.toml").mkdir()
    with pytest.raises(HistoryError, match="version 8 cannot be read: Is a directory"):
        history.text(8)


def test_a_history_that_cannot_be_written_is_a_warning(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    said = History(tmp_path / "file").keep("x")
    assert said == "this version is not kept in the history: File exists"
    history = History(tmp_path / "folder")
    assert history.keep("x") is None
    (tmp_path / "folder" / "0002.toml").mkdir()
    assert history.keep("y") == "this version is not kept in the history: Is a directory"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1, limits[1]))
    try:
        said = History(tmp_path / "other").keep("xyz")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert said == ("this version is not kept in the history: 0001.toml is not saved: larger than files may be here")
    with pytest.raises(HistoryError, match="the history cannot be read"):
        History(tmp_path / "file").versions()


# --- what a person is shown


def test_a_difference_says_what_leaves_and_what_comes_and_where() -> None:
    new = FILE.replace("count = 3", "count = 4").replace("every = 1", "every\t= 2 # \u200b")
    new += '\n\n# Loud.\n[log]\nlevel = "debug"\n'
    assert difference(FILE, new) == [
        'master "field", request 1',
        "- count = 3",
        "- every = 1",
        "+ count = 4",
        "+ every   = 2 # \\u200b",
        "[log]",
        "+ # Loud.",
        "+ [log]",
        '+ level = "debug"',
    ]


def test_a_text_that_is_no_toml_is_compared_as_well() -> None:
    assert difference(FILE, FILE + "\x1b[2J = \r") == ["+ \\x1b[2J = "]


def test_a_difference_in_blank_lines_and_line_ends_only_is_none() -> None:
    assert difference(FILE, FILE.replace("\n", "\r\n") + "\r\n\r\n") == []
    assert difference("", "") == []


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ('passphrase = "secret" # mine', "passphrase = *** # mine"),
        ("'pass\\u0070hrase' = 'secret'", "'pass\\u0070hrase' = 'secret'"),  # a literal key: some other one
        ('"pass\\u0070hrase" = "secret"', '"pass\\u0070hrase" = ***'),
        ('x = {a = 1, password = "secret", b = 2}', "x = {a = 1, password = ***, b = 2}"),
        ('# password = "secret"', "# password = ***"),
        ('password = "secret', "password = ***"),  # never closed
        ("password_required = true", "password_required = true"),
        ("password = 7", "password = ***"),
    ],
)
def test_secrets_are_never_shown(line: str, shown: str) -> None:
    assert difference("", line) in ([f"+ {shown}"], ["[hmi]", f"+ {shown}"])
    assert difference(f"[x]\n{line}", "[x]")[-1] == f"- {shown}"


def test_a_secret_of_several_lines_is_not_shown_either() -> None:
    text = '[hmi.wifly]\npassphrase = """\nsecret\nsecret"""\nretries = 5\n'
    assert difference("", text) == ["[hmi.wifly]", "+ [hmi.wifly]", "+ passphrase = ***", "+ retries = 5"]
    unclosed = difference("", 'passphrase = """secret\nsecret')
    assert unclosed == ["+ passphrase = ***", "+ ***"]


def test_a_new_secret_is_seen_without_being_shown() -> None:
    assert difference(FILE, FILE.replace("old secret", "new secret")) == [
        "[hmi.wifly]",
        "- passphrase = ***",
        "+ passphrase = ***",
    ]


@given(st.text(), st.text())
def test_any_two_texts_can_be_compared(old: str, new: str) -> None:
    for line in difference(old, new):
        assert line.isprintable()
