"""What of the Debian package can be seen without building it; ``tests/system/test_package.py`` builds and installs it.

The scripts are run with folders of their own in place of the system's.
"""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest

from gateway import __version__, cli, documents, save, service
from gateway.config import WatchdogConfig
from gateway.hmi.access import hash_password
from gateway.store import load_text

ROOT: Final = Path(__file__).parent.parent
PACKAGING: Final = ROOT / "packaging"
DEBIAN: Final = PACKAGING / "debian"
UNIT: Final = ROOT / "etc" / "rtugate.service"
MODULES: Final = "/usr/share/rtugate"
RUNTIME: Final = "/run/rtugate"
LINE_COLUMNS: Final = 79
CALL_LIMIT_S: Final = 60.0
PROJECT: Final[dict[str, Any]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def unit() -> dict[str, list[str]]:
    """Return the unit's keys, each with all its values."""
    keys: dict[str, list[str]] = defaultdict(list)
    for line in UNIT.read_text().splitlines():
        if "=" in line and not line.startswith("#"):
            key, value = line.split("=", 1)
            keys[key].append(value)
    return keys


def only(key: str) -> str:
    (value,) = unit()[key]
    return value


def placed(script: Path, folder: Path, *places: str) -> Path:
    """Return a copy of *script* in *folder*, for which each of *places* is below *folder* and not below /."""
    text = script.read_text()
    for place in places:
        assert place in text
        text = text.replace(place, f"{folder}{place}")
    made = folder / script.name
    made.write_text(text)
    return made


# ------------------------------------------------------------------------------------------------ one version, one list


def test_the_package_has_the_programs_version() -> None:
    newest = (DEBIAN / "changelog").read_text().splitlines()[0]
    assert newest.startswith(f"rtugate ({__version__}) trixie; ")
    assert f"\n## {__version__} " in (ROOT / "CHANGELOG.md").read_text()


def test_the_package_depends_on_what_the_program_depends_on() -> None:
    control = (DEBIAN / "control").read_text()
    for requirement in PROJECT["dependencies"]:
        name, least = requirement.partition(",")[0].split(">=")
        package = "python3-serial" if name == "pyserial" else f"python3-{name}"
        assert f" {package} (>= {least})" in control
    assert f" python3 ({PROJECT['requires-python'].replace('>=', '>= ')})" in control


def test_every_file_that_the_package_names_is_there() -> None:
    names = [line.split()[0] for kind in ("install", "docs", "examples", "manpages") for line in listed(kind)]
    assert [name for name in names if not (ROOT / name).exists()] == []
    assert (DEBIAN / "rtugate.service").resolve() == UNIT
    assert (DEBIAN / "rtugate.udev").resolve() == ROOT / "etc" / "60-rtugate.rules"


def listed(kind: str) -> list[str]:
    return (DEBIAN / f"rtugate.{kind}").read_text().splitlines()


def test_the_license_is_the_trees() -> None:
    told = re.sub(r"(?m)^ \.?", "", (DEBIAN / "copyright").read_text().rpartition("License: Expat\n")[2])
    assert (
        told.split() == (ROOT / "LICENSE").read_text().partition("\n\nPermission")[2].join(["Permission", ""]).split()
    )


def test_what_is_run_on_installing_is_executable_and_good_shell() -> None:
    for script in (DEBIAN / "rtugate.postinst", DEBIAN / "rtugate.postrm", PACKAGING / "build.sh", MOTD):
        subprocess.run(["sh", "-n", str(script)], check=True, timeout=CALL_LIMIT_S)
    for program in (DEBIAN / "rules", MOTD, LAUNCHER):
        assert program.stat().st_mode & 0o111 == 0o111


# ------------------------------------------------------------------------------------------------ the unit


def test_systemd_waits_longer_than_the_gateway_itself() -> None:
    assert int(only("WatchdogSec")) >= 1.5 * WatchdogConfig().timeout
    assert int(only("TimeoutStopSec")) > service.WORK_LIMIT_S
    assert int(only("TimeoutStartSec")) > service.WORK_LIMIT_S


def test_a_process_that_stands_still_runs_again_before_the_hardware_resets_the_machine() -> None:
    start_s = 10  # on the slowest of boards, until the new process feeds it
    again_s = int(only("WatchdogSec")) + int(only("RestartSec")) + start_s
    assert again_s < WatchdogConfig(device="/dev/watchdog").device_timeout


def test_the_service_is_started_again_whatever_happens() -> None:
    assert (only("Restart"), only("RestartSec"), only("StartLimitIntervalSec")) == ("always", "2", "0")


def test_the_service_finds_its_file_its_state_and_its_socket() -> None:
    assert only("ReadWritePaths") == str(Path(cli.CONFIG_DEFAULT).parent)
    assert f"/var/lib/{only('StateDirectory')}" == cli.STATE_DEFAULT
    assert f'"/run/{only("RuntimeDirectory")}"' in LAUNCHER.read_text()
    assert only("ExecStart") == "/usr/bin/rtugate run"


def test_the_service_has_no_right_but_low_ports() -> None:
    assert only("AmbientCapabilities") == only("CapabilityBoundingSet") == "CAP_NET_BIND_SERVICE"
    assert only("User") == only("Group") == "rtugate"
    assert "m rtugate dialout" in (DEBIAN / "rtugate.sysusers").read_text()
    assert only("ProtectSystem") == "strict"
    assert only("DevicePolicy") == "closed"
    assert only("SecureBits").split() == ["noroot", "noroot-locked"]  # the lock alone keeps it from being set


def test_the_service_reads_what_it_needs_of_proc() -> None:
    assert "ProcSubset" not in unit()  # "pid" would hide the boot's identifier, by which a power cut is known


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing: apt install systemd")
def test_systemd_gives_the_unit_one_and_a_half_or_less() -> None:
    command = ["systemd-analyze", "security", "--offline=yes", "--threshold=15", str(UNIT)]
    told = subprocess.run(command, capture_output=True, text=True, timeout=CALL_LIMIT_S, check=False)
    assert told.returncode == 0, told.stdout.splitlines()[-1:] + told.stderr.splitlines()


# ------------------------------------------------------------------------------------------------ the command

LAUNCHER: Final = PACKAGING / "rtugate"


def launched(folder: Path, *words: str, state: str | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command with this tree's modules, in an environment that has nothing of ours."""
    script = folder / "rtugate"
    text = LAUNCHER.read_text()
    for place, ours in ((MODULES, ROOT), (RUNTIME, folder / "run")):  # a gateway of this machine is left alone
        assert f'"{place}"' in text
        text = text.replace(f'"{place}"', repr(str(ours)))
    script.write_text(text)
    command = [sys.executable, "-I", str(script), *words]
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(folder / "elsewhere")}
    environment |= {} if state is None else {"STATE_DIRECTORY": state}
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=CALL_LIMIT_S, check=False)


def test_the_command_says_its_version(tmp_path: Path) -> None:
    assert launched(tmp_path, "--version").stdout == f"rtugate {__version__}\n"
    assert LAUNCHER.read_text().startswith("#!/usr/bin/python3 -IS\n")
    assert f"gateway {MODULES.lstrip('/')}" in listed("install")


def test_the_command_asks_the_service(tmp_path: Path) -> None:
    told = launched(tmp_path, "status")
    assert told.stderr == f"rtugate: no gateway runs here (no socket at {tmp_path}/run/control)\n"


@pytest.mark.parametrize("spelling", [["--state", "{}"], ["--state={}"], ["--st", "{}"]])
def test_with_another_state_directory_the_command_asks_the_gateway_there(tmp_path: Path, spelling: list[str]) -> None:
    told = launched(tmp_path, *(word.format(tmp_path) for word in spelling), "status")
    assert told.stderr == f"rtugate: no gateway runs here (no socket at {tmp_path}/control)\n"


def test_with_another_state_directory_in_the_environment_too(tmp_path: Path) -> None:
    told = launched(tmp_path, "status", state=str(tmp_path))
    assert told.stderr == f"rtugate: no gateway runs here (no socket at {tmp_path}/control)\n"


# ------------------------------------------------------------------------------------------------ the login message

MOTD: Final = PACKAGING / "motd" / "60-rtugate"


def message(folder: Path, text: str | None, has_program: bool = True) -> list[str]:
    """Return what somebody who logs in is told; *text*: what the file says, None: there is none."""
    for place in ("usr/bin", "etc/rtugate"):
        (folder / place).mkdir(parents=True, exist_ok=True)
    if text is not None:
        (folder / "etc/rtugate/rtugate.toml").write_text(text)
    if has_program:
        (folder / "usr/bin/rtugate").touch(0o755)
    script = placed(MOTD, folder, "/usr/bin/rtugate", "/etc/rtugate")
    told = subprocess.run(["sh", str(script)], capture_output=True, text=True, timeout=CALL_LIMIT_S, check=True)
    assert told.stderr == ""
    return told.stdout.splitlines()


def test_without_a_password_three_lines_say_how_to_get_one(tmp_path: Path) -> None:
    lines = message(tmp_path, documents.starting_file())
    assert len(lines) == 3
    assert max(map(len, MOTD.read_text().partition("'END'\n")[2].splitlines())) <= LINE_COLUMNS
    assert '"rtugate passwd"' in lines[0]


def test_what_the_message_advises_is_valid_once_there_is_a_password() -> None:
    told = MOTD.read_text()
    (found,) = re.finditer(r"(listen = \S+) below (\[\S+\])", told)
    advice, table = found.groups()
    password = f'password = "{hash_password("12345678")}"'
    text = documents.starting_file().replace("\n[hmi]\n", f"\n[hmi]\n{password}\n")
    advised = text.replace(f"\n{table}\n", f"\n{table}\n{advice}\n")
    assert load_text(advised, "rtugate.toml").config.hmi.telnet.listen == "0.0.0.0:23"


@pytest.mark.parametrize(
    "spelling",
    [
        '[hmi]\npassword = "{}"\n',
        "[hmi]\n  password='{}' # by rtugate passwd\n",
        'hmi.password = "{}"\n',
        'hmi = {{ language = "es", password = "{}" }}\n',
    ],
)
def test_with_a_password_there_is_no_message_however_it_is_spelled(tmp_path: Path, spelling: str) -> None:
    text = spelling.format(hash_password("12345678"))
    assert load_text(text, "rtugate.toml").config.hmi.password
    assert message(tmp_path, text) == []


def test_a_password_in_a_comment_is_none(tmp_path: Path) -> None:
    assert len(message(tmp_path, f'[hmi]\n#password = "{hash_password("12345678")}"\n')) == 3


def test_without_the_program_or_its_file_there_is_no_message(tmp_path: Path) -> None:
    assert message(tmp_path / "removed", documents.starting_file(), has_program=False) == []
    assert message(tmp_path / "unconfigured", None) == []


@pytest.mark.parametrize("laid", [os.mkfifo, lambda path: path.symlink_to("/dev/zero"), Path.mkdir])
def test_nobody_is_kept_from_logging_in_by_what_lies_in_the_files_place(
    tmp_path: Path, laid: Callable[[Path], object]
) -> None:
    (tmp_path / "etc/rtugate").mkdir(parents=True)
    laid(tmp_path / "etc/rtugate/rtugate.toml")
    assert message(tmp_path, None) == []


def test_no_more_of_a_file_is_read_at_a_login_than_it_may_have(tmp_path: Path) -> None:
    (tmp_path / "etc/rtugate").mkdir(parents=True)
    with (tmp_path / "etc/rtugate/rtugate.toml").open("wb") as file:
        file.truncate(2**40)
    assert len(message(tmp_path, None)) == 3


# ------------------------------------------------------------------------------------------------ purge


def test_purge_knows_every_file_that_the_gateway_makes_beside_its_own(tmp_path: Path) -> None:
    folder, state = tmp_path / "etc/rtugate", tmp_path / "var/lib/rtugate"
    folder.mkdir(parents=True)
    (state / "history").mkdir(parents=True)
    path = folder / "rtugate.toml"
    assert cli.main(["init", str(path)]) == 0
    save.keep_beside(path, "rejected", 0.0)
    save.keep_beside(path, "rejected", 0.0)
    save.keep_beside(path, "replaced", 0.0)
    for name in (path.name, documents.SCHEMA_NAME):
        (folder / f".{name}.0123456789ab").touch()  # what a power cut leaves of a save
    for ending in ("~", ".bak"):  # editors'; dpkg does the same with conffiles
        path.with_name(path.name + ending).touch()
    purge(tmp_path)
    assert not folder.exists()
    assert not state.exists()


def test_purge_leaves_what_is_not_ours(tmp_path: Path) -> None:
    folder = tmp_path / "etc/rtugate"
    folder.mkdir(parents=True)
    for name in ("rtugate.toml", "rtugate.toml.of-2025", "notes.txt"):
        (folder / name).touch()
    purge(tmp_path)
    purge(tmp_path)
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", "rtugate.toml.of-2025"]


def test_purge_empties_folders_that_are_links_and_leaves_these(tmp_path: Path) -> None:
    for place, name in (("etc/rtugate", "rtugate.toml"), ("var/lib/rtugate", "last-good.toml")):
        elsewhere = tmp_path / "data" / place
        elsewhere.mkdir(parents=True)
        (elsewhere / name).touch()
        (tmp_path / place).parent.mkdir(parents=True)
        (tmp_path / place).symlink_to(elsewhere)
    purge(tmp_path)
    assert [path for path in (tmp_path / "data").rglob("*") if path.is_file()] == []
    assert (tmp_path / "etc/rtugate").is_symlink()
    assert (tmp_path / "var/lib/rtugate").is_symlink()


def test_purge_follows_no_link_that_lies_in_the_folders(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    (victim / "inner").mkdir(parents=True)
    for place in ("etc/rtugate", "var/lib/rtugate"):
        (tmp_path / place).mkdir(parents=True)
    for link in ("etc/rtugate/rtugate.toml", "etc/rtugate/.rtugate.toml.0123456789ab", "var/lib/rtugate/history"):
        (tmp_path / link).symlink_to(victim)
    purge(tmp_path)
    assert (victim / "inner").is_dir()
    assert not (tmp_path / "etc/rtugate").exists()


def test_purge_does_not_fail_for_folders_in_the_folder(tmp_path: Path) -> None:
    for name in ("mine", "rtugate.toml.rejected-20260101-000000"):
        (tmp_path / "etc/rtugate" / name).mkdir(parents=True)
    purge(tmp_path)
    assert [path.name for path in (tmp_path / "etc/rtugate").iterdir()] == ["mine"]


def test_purge_copes_with_more_files_than_one_command_takes(tmp_path: Path) -> None:
    folder = tmp_path / "etc/rtugate"
    folder.mkdir(parents=True)
    for number in range(20_000):
        (folder / f".rtugate.toml.{number:0200}").touch()
    purge(tmp_path)
    assert not folder.exists()


def purge(folder: Path) -> None:
    script = placed(DEBIAN / "rtugate.postrm", folder, "/etc/rtugate", "/var/lib/rtugate")
    subprocess.run(["sh", str(script), "purge"], check=True, timeout=CALL_LIMIT_S)
    script.unlink()


def test_remove_is_no_purge(tmp_path: Path) -> None:
    (tmp_path / "etc/rtugate").mkdir(parents=True)
    (tmp_path / "etc/rtugate/rtugate.toml").touch()
    script = placed(DEBIAN / "rtugate.postrm", tmp_path, "/etc/rtugate", "/var/lib/rtugate")
    subprocess.run(["sh", str(script), "remove"], check=True, timeout=CALL_LIMIT_S)
    assert (tmp_path / "etc/rtugate/rtugate.toml").exists()


# ------------------------------------------------------------------------------------------------ can the tests run?


def lacks(*dependencies: str, tools: tuple[str, ...] = ()) -> list[str]:
    """Return what a build finds missing here for a program with these *dependencies*."""
    found = runpy.run_path(str(PACKAGING / "can_test.py"))["lacks"](
        {"dependencies": list(dependencies), "optional-dependencies": {"test": list(tools)}}
    )
    return list(found)


def test_a_build_runs_the_tests_where_everything_is_new_enough() -> None:
    assert lacks("pydantic>=2.10,<3", "pymodbus>=3.8.6,<4") == []


def test_a_build_runs_no_tests_with_versions_that_are_too_old() -> None:
    (words,) = lacks("pydantic>=99.10,<100")
    assert re.fullmatch(r"pydantic is 2[.\d]+, not 99\.10", words)


def test_versions_are_compared_as_numbers() -> None:
    assert lacks("pydantic>=2.9") == []


def test_a_build_runs_no_tests_without_their_tools_whose_versions_do_not_matter() -> None:
    assert lacks(tools=("pytest>=999", "no-such-tool>=1")) == ["no-such-tool is missing"]


PASSES: Final = "def test_one() -> None:\n    assert True\n"
FAILS: Final = PASSES.replace("True", "False")


def needing(dependency: str) -> str:
    return f'[project]\ndependencies = ["{dependency}"]\noptional-dependencies.test = []\n'


def as_built(folder: Path, test: str, project: str) -> subprocess.CompletedProcess[str]:
    """Run what a build runs of its tests, in *folder*, with one *test* and this pyproject.toml."""
    (folder / "packaging").mkdir()
    shutil.copy(PACKAGING / "can_test.py", folder / "packaging")
    (folder / "pyproject.toml").write_text(project)
    (folder / "test_one.py").write_text(test)
    command = ["make", f"--file={DEBIAN / 'rules'}", f"PYTHON={sys.executable}", "override_dh_auto_test"]
    environment = {"PATH": "/usr/bin:/bin"}  # nothing of a make or a build that these tests may be part of
    return subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env=environment, timeout=CALL_LIMIT_S, check=False
    )


def test_a_test_that_fails_fails_the_build(tmp_path: Path) -> None:
    told = as_built(tmp_path, FAILS, needing("pytest>=1"))
    assert told.returncode != 0
    assert "1 failed" in told.stdout


def test_a_build_tells_of_tests_that_passed(tmp_path: Path) -> None:
    told = as_built(tmp_path, PASSES, needing("pytest>=1"))
    assert (told.returncode, "1 passed" in told.stdout) == (0, True)


def test_a_build_without_what_the_tests_need_says_so_and_goes_on(tmp_path: Path) -> None:
    told = as_built(tmp_path, FAILS, needing("no-such-package>=1"))
    assert (told.returncode, "\nthe tests are not run: no-such-package is missing\n" in told.stdout) == (0, True)


def test_a_build_that_cannot_find_out_what_the_tests_need_fails(tmp_path: Path) -> None:
    assert as_built(tmp_path, PASSES, "[project]\n").returncode != 0


# ------------------------------------------------------------------------------------------------ udev


def test_the_example_of_names_for_adapters_changes_nothing_until_somebody_edits_it() -> None:
    lines = (PACKAGING / "examples" / "70-rs485.rules").read_text().splitlines()
    assert [line for line in lines if line and not line.startswith("#")] == []
    assert sum(line.startswith(("#SUBSYSTEM", "#ACTION")) for line in lines) == 5
