"""The manual pages are what the code says, read well at 80 columns, and hold examples that work; see ``manual``."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway import __version__
from gateway.documents import starting_file
from gateway.errors import ConfigError
from gateway.store import load_text
from tests import manual
from tests.manual import FOLDER, PAGES, Unfinished, commands, keys_of, own_arguments, page, table_paths

COLUMNS = 80
all_pages = pytest.mark.parametrize("name", PAGES)
TOML = (FOLDER / "rtugate.toml.5").read_text("ascii")
COMMAND = (FOLDER / "rtugate.1").read_text("ascii")


def needs(program: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(shutil.which(program) is None, reason=f"not installed: {program}")


def said_by(*command: str) -> str:
    """What a program says, of both kinds."""
    found = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    return found.stdout


def rendered(name: str) -> list[str]:
    """The page as a terminal of 80 columns shows it, without bold and underline."""
    text = said_by("mandoc", "-T", "ascii", "-O", f"width={COLUMNS - 2}", str(FOLDER / name))
    return re.sub(".\b", "", text).splitlines()


def examples(text: str) -> list[str]:
    """What stands between .EX and .EE, as a reader sees it."""
    found = re.findall(r"^\.EX\n(.*?)^\.EE$", text, re.DOTALL | re.MULTILINE)
    return [example.replace(r"\-", "-") for example in found]


# ------------------------------------------------------------------------------------------------ made from the code


@all_pages
def test_the_pages_are_up_to_date_with_the_code(name: str) -> None:
    assert (FOLDER / name).read_text("ascii") == page(name), "run `make manual`"


def test_the_default_file_is_what_an_installation_begins_with() -> None:
    assert (FOLDER.parent / manual.DEFAULT_FILE).read_text("ascii") == starting_file(), "run `make manual`"


@all_pages
def test_the_version_is_the_programs(name: str) -> None:
    assert f'"rtugate {__version__}"' in (FOLDER / name).read_text("ascii")


@needs("mandoc")
@pytest.mark.parametrize("path", table_paths())
def test_every_key_of_a_table_is_explained_below_its_heading(path: str) -> None:
    lines = rendered("rtugate.toml.5")
    heads = [n for n, line in enumerate(lines) if re.fullmatch(rf"   \[?\[{path}\]\]?", line)]
    assert len(heads) == 1
    ends = (n for n, line in enumerate(lines) if n > heads[0] and re.match(r" {0,3}\S", line))
    below = "\n".join(lines[heads[0] : next(ends)])
    for key, node in keys_of(path).items():
        assert re.search(rf"^ {{7}}(\S+, )*{key}(,| \(|$)", below, re.MULTILINE), key
        is_as_above = "as in [[master]]" in below and f"{key} (" not in below
        told = node["description"].replace("`", "")
        assert is_as_above or told in re.sub(r"\s+", " ", below), key


@needs("mandoc")
@pytest.mark.parametrize("name", commands())
def test_every_command_is_explained_with_all_its_options(name: str) -> None:
    lines = rendered("rtugate.1")
    head = next(line for line in lines if re.match(rf" {{7}}{name}( |$)", line))
    for action in own_arguments(commands()[name]):
        assert all(option in head for option in action.option_strings)
        assert action.option_strings or str(action.metavar) in head


def test_what_is_accepted_and_not_carried_out_is_named_as_such_and_nothing_else() -> None:
    says_so = "This version accepts this table but does not carry it out"
    sections = TOML.split("\n.SS ")
    assert {one.partition("\n")[0].strip("[]") for one in sections if says_so in one} == {"io", "hmi.wifly"}


@pytest.mark.parametrize(
    ("path", "key", "line"),
    [
        ("register", "coils", r"\fBcoils\fR (integer; default 2000)"),
        ("master", "line", r"\fBline\fR (string; required)"),
        ("master", "data_bits", r"\fBdata_bits\fR (integer)"),
        ("master", "parity", r'\fBparity\fR (string; default "even")'),
        ("master.request", "function", r"\fBfunction\fR (integer or string; required)"),
        ("master.request", "every", r"\fBevery\fR (number; default 1.0)"),
        ("master.request", "status_point", r"\fBstatus_point\fR (integer; default \-1)"),
        ("slave", "functions", r"\fBfunctions\fR (list of integers or strings; default [])"),
        ("slave", "writable", r"\fBwritable\fR (true or false; default true)"),
    ],
)
def test_a_keys_head_says_its_type_and_its_default(path: str, key: str, line: str) -> None:
    assert line in manual.table(path)
    assert key in keys_of(path)


def test_a_key_that_means_the_same_as_in_the_table_above_is_only_named() -> None:
    told = manual.table("slave")
    assert told[-1] == r"as in \fB[[master]]\fR"
    assert r"\fBbaudrate\fR" in told[-2]
    assert not any(line.startswith(r"\fBbaudrate\fR (") for line in told)
    assert any(line.startswith(r"\fBline\fR (") for line in told)  # what is required is said where it is


# ------------------------------------------------------------------------------------------------ what a page must have


def folder_with(tmp_path: Path, name: str, change: Callable[[str], str]) -> Path:
    source = (FOLDER / f"{name}.in").read_text("ascii")
    (tmp_path / f"{name}.in").write_text(change(source))
    return tmp_path


@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        ("rtugate.toml.5", "@table log\n", "", r"missing \['log'\]"),
        ("rtugate.toml.5", "@table log\n", "@table logs\n", r"unknown \['logs'\]"),
        ("rtugate.toml.5", "@table log\n", "@table log\n@table log\n", "shown"),
        ("rtugate.1", "@command history\n", "", r"missing \['history'\]"),
        ("rtugate.1", "@command history\n", "@command histories\n", r"unknown \['histories'\]"),
        ("rtugate.1", "@options\n", "@choices\n", "there is no @choices"),
    ],
)
def test_a_page_without_a_table_or_command_of_the_code_is_refused(
    tmp_path: Path, name: str, old: str, new: str, told: str
) -> None:
    folder = folder_with(tmp_path, name, lambda source: source.replace(old, new))
    with pytest.raises(Unfinished, match=told):
        page(name, folder)


def test_what_says_what_it_should_is_not_written_again(tmp_path: Path) -> None:
    for folder in ("man", "etc"):
        (tmp_path / folder).mkdir()
    for name in PAGES:
        shutil.copy(FOLDER / f"{name}.in", tmp_path / "man")
    written = [str(tmp_path / path) for path in (*(f"man/{name}" for name in PAGES), manual.DEFAULT_FILE)]
    assert manual.update(tmp_path) == written
    assert manual.update(tmp_path) == []


# ------------------------------------------------------------------------------------------------ troff


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a-b", r"a\-b"),
        ("it's", r"it\(aqs"),
        (r"a\b", r"a\eb"),
        (".start", r"\&.start"),
        ("'start", r"\(aqstart"),
        ("by `rtugate passwd` only", r"by \fBrtugate passwd\fR only"),
        ("~ and ^", r"\(ti and \(ha"),
    ],
)
def test_what_troff_would_take_for_its_own_is_escaped(text: str, line: str) -> None:
    assert manual.prose(text) == [line]


def test_no_line_of_a_long_text_looks_like_a_request_of_troff() -> None:
    lines = manual.prose(" ".join([".x"] * 200))
    assert len(lines) > 5
    assert not any(line.startswith((".", "'")) for line in lines)


# ------------------------------------------------------------------------------------------------ how a page reads


@needs("mandoc")
@all_pages
def test_mandoc_finds_nothing_to_complain_of(name: str) -> None:
    assert said_by("mandoc", "-T", "lint", str(FOLDER / name)) == ""


@needs("groff")
@all_pages
def test_groff_warns_of_nothing(name: str) -> None:
    assert said_by("groff", "-ww", "-z", "-mandoc", "-Tutf8", str(FOLDER / name)) == ""


@needs("mandoc")
@all_pages
def test_a_page_fits_80_columns(name: str) -> None:
    lines = rendered(name)
    assert len(lines) > 100
    assert [line for line in lines if len(line) > COLUMNS] == []


def test_the_examples_of_a_file_can_be_used() -> None:
    boiler, console, telnet = examples(TOML)
    assert load_text(boiler + console, "rtugate.toml").findings == []
    hashed = '[hmi]\npassword = "scrypt$16384$8$5$00$00"\n'
    assert load_text(boiler + console + hashed + telnet, "rtugate.toml").findings == []


def test_the_commands_in_the_examples_are_commands() -> None:
    used = [word for example in examples(COMMAND) for word in re.findall(r"\brtugate ([a-z]+)", example)]
    assert len(used) > 5
    assert set(used) <= set(commands())


def test_a_mistake_is_told_as_the_page_shows_it() -> None:
    shown = next(example for example in examples(COMMAND) if "retries" in example).rstrip("\n")
    text = "\n" * 27 + '[[master]]\nname = "field"\nline = "/dev/ttyS2"\nretries = 101\n'
    with pytest.raises(ConfigError) as refused:
        load_text(text, "rtugate.toml")
    assert [str(one) for one in refused.value.findings] == [shown]
