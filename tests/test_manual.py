"""The manual pages are what the code says, read well at 80 columns, and hold examples that work; see ``manual``.

README.Debian, which goes on where they end, is held to the same.
"""

from __future__ import annotations

import ast
import errno
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway import __version__, cli, restart_cause, service, snapshots, stacks
from gateway.config import WatchdogConfig
from gateway.config_file import HISTORY
from gateway.documents import SCHEMA_NAME, starting_file
from gateway.errors import ConfigError
from gateway.hmi.access import hash_password
from gateway.retained import FILE_NAME as RETAINED
from gateway.store import load_text
from tests import manual
from tests.manual import FOLDER, PAGES, Unfinished, commands, keys_of, own_arguments, page, table_paths

COLUMNS = 80
all_pages = pytest.mark.parametrize("name", PAGES)
TOML = (FOLDER / "rtugate.toml.5").read_text("ascii")
COMMAND = (FOLDER / "rtugate.1").read_text("ascii")
ROOT = FOLDER.parent
README_DEBIAN = (ROOT / "packaging" / "debian" / "README.Debian").read_text("ascii")
UNIT = (ROOT / "etc" / "rtugate.service").read_text()
DEBHELPER_COMPRESSES = 4096  # bytes, and more: dh_compress(1)
CAUSES = ("FIRST", "CLEAN", "BY_MENU", "CRASH", "POWER", "HANG", "WATCHDOG", "WATCHDOG_AFTER_HANG")


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


# ------------------------------------------------------------------------------------------------ what a page lists


def below(heading: str, text: str = COMMAND) -> str:
    """What stands below a heading (.SH or .SS), up to the next one."""
    (found,) = re.findall(rf'^\.S[HS] "?{heading}"?\n(.*?)(?=^\.S[HS] |\Z)', text, re.DOTALL | re.MULTILINE)
    return str(found)


def tags(section: str) -> list[str]:
    """The tags of a section's paragraphs, as a reader sees them."""
    found = re.findall(r"^\.TP\n\.([BIR]+) (.*)$", section, re.MULTILINE)
    joined = [(" " if len(macro) == 1 else "").join(shlex.split(re.sub(r"\\f.", "", rest))) for macro, rest in found]
    return [tag.replace("\\", "") for tag in joined]


def said_by_the_program() -> str:
    """All texts in the modules, but for docstrings, a line each."""
    said = []
    for path in sorted((ROOT / "gateway").rglob("*.py")):
        tree = ast.parse(path.read_text())
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        texts = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in docstrings)
        said += [node.value for node in texts if isinstance(node.value, str)]
    return "\n".join(said)


def test_every_alarm_that_is_explained_is_said_by_the_program_or_the_system() -> None:
    said = said_by_the_program() + "".join(
        os.strerror(code).lower() for code in (errno.ECONNREFUSED, errno.ENETUNREACH)
    )
    explained = [re.sub(r" \d+$", "", one) for tag in tags(below("Alarms")) for one in tag.split(", ")]
    assert len(explained) > 15
    assert [one for one in explained if one not in said] == []


def test_every_cause_of_a_restart_is_explained_and_no_other() -> None:
    explained = [one for tag in tags(below("Why it was started last")) for one in tag.split(", ")]
    causes = {str(getattr(restart_cause, name)).format(name="NAME") for name in CAUSES}
    assert len(causes) == len(CAUSES)
    assert sorted(explained) == sorted(causes)


def test_every_file_that_the_gateway_keeps_is_named_with_its_place() -> None:
    config, state = Path(cli.CONFIG_DEFAULT), Path(cli.STATE_DEFAULT)
    names = (HISTORY, snapshots.LAST_GOOD, snapshots.UNCONFIRMED, RETAINED, restart_cause.FILE, stacks.FILE_NAME)
    places = [config, config.parent / SCHEMA_NAME, *(state / name for name in names), Path("/run/rtugate/control")]
    beside = ", ".join(f"{at}-DATE" for at in (config.with_name("rtugate.toml.rejected"), "rtugate.toml.replaced"))
    assert sorted(tag.rstrip("/") for tag in tags(below("FILES"))) == sorted([*map(str, places), beside])


def test_every_signal_and_every_variable_that_is_heeded_is_named() -> None:
    signals = {name for tag in tags(below("SIGNALS")) for name in tag.split(", ")}
    assert signals == {number.name for number in service.SIGNALS}
    read = "".join(path.read_text() for path in (ROOT / "gateway").rglob("*.py"))
    variables = set(re.findall(r'environ\.get\("([A-Z_]+)"', read))
    assert variables == {name for tag in tags(below("ENVIRONMENT")) for name in tag.split(", ")}


def test_readme_debian_is_named_everywhere_as_it_is_installed() -> None:
    assert len(README_DEBIAN) > DEBHELPER_COMPRESSES
    paths = re.findall(r"/usr/share/doc/[^\s`]+", COMMAND + TOML + UNIT + (ROOT / "README.md").read_text())
    assert paths == 3 * ["/usr/share/doc/rtugate/README.Debian.gz"]


# ------------------------------------------------------------------------------------------------ README.Debian


def blocks() -> list[str]:
    """What stands indented in README.Debian, without its margin; an empty line ends a block."""
    found = re.findall(r"(?:^ {4,}\S.*\n)+", README_DEBIAN, re.MULTILINE)
    return [re.sub(r"(?m)^ {4,6}(?! )", "", block) for block in found]


def in_the_file() -> list[str]:
    """The blocks that are tables of rtugate.toml; those of systemd begin with a capital letter."""
    return [block for block in blocks() if re.match(r"\[[a-z]", block)]


def test_what_readme_debian_puts_into_the_file_can_be_used() -> None:
    tables = in_the_file()
    assert len(tables) == 2
    password = f'[hmi]\npassword = "{hash_password("12345678")}"\n'
    line = next(block for block in blocks() if block.startswith('line = "/dev/serial/by-id'))
    master = f'[[master]]\nname = "field"\n{line}'
    assert load_text("\n".join([password, *tables, master]), "rtugate.toml").findings == []


def test_telnet_is_opened_by_changing_the_line_that_readme_debian_names() -> None:
    (new,) = (block for block in blocks() if block.startswith("listen"))
    text, count = re.subn(r"(?m)^#listen .*\n", new, starting_file())
    assert count == 1
    text = re.sub(r"(?m)^#password = .*$", f'password = "{hash_password("12345678")}"', text, count=1)
    assert load_text(text, "rtugate.toml").config.hmi.telnet.listen == "0.0.0.0:23"


def test_the_commands_in_readme_debian_are_commands() -> None:
    typed = "\n".join(blocks()) + "\n".join(re.findall(r"`([^`]+)`", README_DEBIAN))
    used = set(re.findall(r"(?m)(?:^|sudo )rtugate\s([a-z]+)", typed))
    assert len(used) > 5
    assert used <= set(commands())


def test_readme_debian_fits_80_columns_and_has_the_sections_that_it_lists() -> None:
    lines = README_DEBIAN.splitlines()
    assert [line for line in lines if len(line) > COLUMNS] == []
    listed = dict(re.findall(r"(\d)\. (\S.*?)(?:  |$)", README_DEBIAN.partition("\n\n\n")[0], re.MULTILINE))
    assert dict(re.findall(r"(?m)^(\d)\. (.*)\n-+$", README_DEBIAN)) == listed
    assert len(listed) > 5


def test_the_time_that_systemd_waits_is_told_as_it_is() -> None:
    (watchdog_s,) = re.findall(r"(?m)^WatchdogSec=(\d+)$", UNIT)
    told, example = re.findall(r"WatchdogSec=(\d+)", README_DEBIAN)
    assert (told, example) == (watchdog_s, "30")
    assert f"({watchdog_s} s in the service of the Debian package)" in TOML
    assert f"higher than {WatchdogConfig().timeout:.0f}" in README_DEBIAN
    assert f"higher than {WatchdogConfig().timeout:.0f}" in TOML


def test_what_readme_debian_says_the_service_does_not_see_is_what_the_unit_hides() -> None:
    (hidden,) = re.findall(r"(?m)^InaccessiblePaths=(.*)$", UNIT)
    (told,) = re.findall(r"may be a link, but not into (.*?), which", README_DEBIAN, re.DOTALL)
    paths = re.split(r",\s+|\s+or\s+", told)
    assert "\nProtectHome=yes\n" in UNIT  # /home, /root and /run/user
    assert sorted(paths) == sorted(["/home", "/root", *hidden.replace("-/", "/").split()])
