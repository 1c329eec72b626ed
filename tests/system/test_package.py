"""The Debian package in Debian 13: built, installed, run, upgraded, removed, purged, and what each of that leaves.

The system is a folder (``tests/system/package``), made by debootstrap; Debian's own packages come from its mirror.
What needs systemd is tried on a virtual board.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from tests.system.package.debian13 import HERE, Debian, Entry, bare, demand_programs

ROOT: Final = HERE.parents[2]
BUILD_LIMIT_S: Final = 600.0
TESTS_LIMIT_S: Final = 3600.0
FILE: Final = "/etc/rtugate/rtugate.toml"
SCHEMA: Final = "/etc/rtugate/rtugate.schema.json"
MOTD: Final = "/etc/update-motd.d/60-rtugate"
STATES: Final = "/var/lib/systemd/deb-systemd-helper-enabled"
ENABLED: Final = (  # deb-systemd-helper's, which go with the purge
    "/etc/systemd/system/multi-user.target.wants/rtugate.service",
    f"{STATES}/multi-user.target.wants/rtugate.service",
    f"{STATES}/rtugate.service.dsh-also",
)
TEST_TOOLS: Final = ("python3-pytest", "python3-hypothesis", "python3-babel", "python3-jsonschema")
TEST_PROGRAMS: Final = ("mbpoll", "telnet", "picocom", "tmux", "strace", "bash-completion", "man-db", "mandoc")
SCRYPT: Final = f"scrypt$16384$8$5${'ab' * 16}${'cd' * 32}"

WHAT_USERS_LEAVE: Final = r"/etc/(passwd|group|g?shadow|subuid|subgid)-?|/etc/\.pwd\.lock"  # a user is never removed
WHAT_APT_KEEPS: Final = r"/var/lib/(dpkg|apt)/.*|/var/log/.*|/var/cache/.*"
WHAT_OTHERS_CACHE: Final = r"/etc/ld\.so\.cache|.*/__pycache__(/.*)?|/root/.*"  # and what the tests bring
UNINTERESTING: Final = re.compile("|".join((WHAT_USERS_LEAVE, WHAT_APT_KEEPS, WHAT_OTHERS_CACHE)))

Figure = Callable[[str, object], None]


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The .deb, built here."""
    demand_programs()
    folder = tmp_path_factory.mktemp("built")
    subprocess.run(["sh", "packaging/build.sh", str(folder)], cwd=ROOT, check=True, timeout=BUILD_LIMIT_S)
    (made,) = folder.glob("*.deb")
    return made


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory, package: Path) -> Debian:
    """Debian 13 with all that the package depends on; it is to be copied."""
    system = bare().copy(tmp_path_factory.mktemp("ready") / "root")
    depends = subprocess.run(
        ["dpkg-deb", "--field", str(package), "Depends"], capture_output=True, text=True, check=True
    )
    system.apt("update")
    system.apt("satisfy", depends.stdout.strip())
    return system


@pytest.fixture
def system(ready: Debian, tmp_path: Path) -> Iterator[Debian]:
    """A copy for one test."""
    yield ready.copy(tmp_path / "root")
    shutil.rmtree(tmp_path / "root")


@pytest.fixture
def installed(system: Debian, package: Path) -> Debian:
    system.apt("install", system.bring(package))
    return system


def differences(before: dict[str, Entry], after: dict[str, Entry]) -> list[str]:
    """Return the paths that came, went or changed, and are of interest."""
    paths = sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
    return [path for path in paths if not UNINTERESTING.fullmatch(path)]


def another_version(package: Path, folder: Path) -> Path:
    """Return the same package with a later version."""
    content, made = folder / "content", folder / "rtugate_later_all.deb"
    subprocess.run(["dpkg-deb", "--raw-extract", str(package), str(content)], check=True)
    control = content / "DEBIAN" / "control"
    control.write_text(re.sub(r"(?m)^(Version: .*)$", r"\1+later", control.read_text()))
    subprocess.run(["dpkg-deb", "--root-owner-group", "--build", str(content), str(made)], check=True)
    shutil.rmtree(content)
    return made


# ------------------------------------------------------------------------------------------------ building


def test_lintian_has_nothing_to_say(package: Path) -> None:
    command = ["lintian", "--allow-root", "--pedantic", "--no-cfg", str(package.with_name(changes_of(package)))]
    told = subprocess.run(command, capture_output=True, text=True, timeout=BUILD_LIMIT_S, check=False)
    assert (told.returncode, told.stdout) == (0, ""), told.stdout + told.stderr


def changes_of(package: Path) -> str:
    (made,) = package.parent.glob("*.changes")
    return made.name


def test_debian_13_builds_the_same_and_its_lintian_has_nothing_to_say_either(
    system: Debian, package: Path, record_property: Figure
) -> None:
    system.apt("install", "--no-install-recommends", "build-essential", "debhelper", "dh-python", "lintian")
    copy_tree(system, "/root/rtugate")
    system.shell("cd /root/rtugate && DEB_BUILD_OPTIONS=nocheck sh packaging/build.sh /root/built")
    (there,) = (system.root / "root" / "built").glob("*.deb")
    assert there.name == package.name
    assert contents(there) == contents(package)
    told = system.run("sh", "-c", "lintian --allow-root --pedantic --no-cfg /root/built/*.changes")
    record_property("lintian of Debian 13", system.run("lintian", "--version").strip())
    assert told == ""


def contents(package: Path) -> list[str]:
    """Return mode, owner, size and name of each file in it; the sizes of what is compressed may differ."""
    listed = subprocess.run(["dpkg-deb", "--contents", str(package)], capture_output=True, text=True, check=True).stdout
    rows = [line.split() for line in listed.splitlines()]
    return sorted(" ".join((row[0], row[1], "" if row[5].endswith(".gz") else row[2], *row[5:])) for row in rows)


def copy_tree(system: Debian, folder: str) -> None:
    """Put what belongs to this tree into *folder* there, without what git ignores."""
    left_out = shutil.ignore_patterns(".*", "dist", "build", "__pycache__", "*.egg-info")
    shutil.copytree(ROOT, system.root / folder.lstrip("/"), symlinks=True, ignore=left_out, dirs_exist_ok=True)


# ------------------------------------------------------------------------------------------------ installing


def test_a_bare_debian_13_installs_it_with_nothing_but_debians_packages(
    package: Path, tmp_path: Path, record_property: Figure
) -> None:
    system = bare().copy(tmp_path / "root")
    system.apt("update")
    before = packages_of(system)
    system.apt("install", system.bring(package))
    came = packages_of(system) - before
    record_property("packages that came along", len(came) - 1)
    version = (ROOT / "gateway" / "__init__.py").read_text().split('"')[-2]
    assert system.run("rtugate", "--version") == f"rtugate {version}\n"
    assert system.run("rtugate", "check").startswith(f"{FILE}: valid\n")
    shutil.rmtree(system.root)


def packages_of(system: Debian) -> set[str]:
    return set(system.run("dpkg-query", "--show", "--showformat=${Package}\\n").split())


def test_installing_adds_what_the_package_says_and_what_it_made(system: Debian, package: Path) -> None:
    before = system.tree()
    system.apt("install", system.bring(package))
    after = system.tree()
    listed = set(system.run("dpkg", "--listfiles", "rtugate").splitlines())
    changed = [path for path in differences(before, after) if path not in listed]
    assert changed == sorted(("/etc/rtugate", SCHEMA, FILE, f"{STATES}/multi-user.target.wants", *ENABLED))
    assert after["/etc/rtugate"] == Entry(0o42770, "rtugate:rtugate", "")
    assert (after[FILE].mode, after[FILE].owner) == (0o100640, "rtugate:rtugate")
    assert system.run("id", "--groups", "--name", "rtugate").split() == ["rtugate", "dialout"]


def test_what_debian_13_can_check_without_running_it_is_right(installed: Debian, record_property: Figure) -> None:
    told = installed.run("systemd-analyze", "security", "--offline=yes", "--threshold=15", "rtugate.service")
    record_property("systemd-analyze security", told.strip().splitlines()[-1])
    installed.run("systemd-analyze", "verify", "--man=no", "/usr/lib/systemd/system/rtugate.service")
    installed.run("udevadm", "verify", "--no-style", "/usr/lib/udev/rules.d/60-rtugate.rules")
    example = (installed.root / "usr/share/doc/rtugate/examples/70-rs485.rules").read_text()
    (installed.root / "root/70-example.rules").write_text(re.sub(r"(?m)^#(?=[A-Z])", "", example))
    installed.run("udevadm", "verify", "--no-style", "/root/70-example.rules")


def test_the_service_runs_as_its_user_on_ports_502_and_23(installed: Debian, record_property: Figure) -> None:
    told = installed.run("python3", installed.bring(HERE / "talk.py"), is_alone=True, limit_s=120.0)
    for name, value in json.loads(told.splitlines()[-1]).items():
        record_property(name, value)


def test_the_login_message_has_three_lines_until_a_password_is_set(installed: Debian) -> None:
    def message() -> list[str]:
        told = installed.run("run-parts", "--lsbsysinit", "/etc/update-motd.d").splitlines()
        return told[1:] if told and told[0].startswith("Linux ") else told

    assert len(message()) == 3
    path = installed.root / FILE.lstrip("/")
    path.write_text(path.read_text().replace('#password = ""', f'password = "{SCRYPT}"'))
    assert installed.run("rtugate", "check").startswith(f"{FILE}: valid\n")
    assert message() == []


# ------------------------------------------------------------------------------------------------ upgrading, going away


def test_an_upgrade_keeps_file_and_state_and_renews_what_editors_know(
    installed: Debian, package: Path, tmp_path: Path
) -> None:
    installed.shell(
        f"""
        printf '# mine\\n' >>{FILE}
        printf old >{SCHEMA}
        install -d -m 0750 -o rtugate -g rtugate /var/lib/rtugate
        printf kept >/var/lib/rtugate/last-good.toml
        """
    )
    before = installed.tree()
    installed.apt("install", installed.bring(another_version(package, tmp_path)))
    after = installed.tree()
    assert differences(before, after) == [SCHEMA]
    assert "made by `rtugate schema`" in (installed.root / SCHEMA.lstrip("/")).read_text()
    assert installed.run("dpkg-query", "--show", "--showformat=${Version}", "rtugate").endswith("+later")


def test_remove_keeps_what_belongs_to_the_station_and_the_next_install_finds_it(
    installed: Debian, package: Path
) -> None:
    installed.shell(f"printf '# mine\\n' >>{FILE}")
    before = installed.tree()
    installed.apt("remove", "rtugate")
    after = installed.tree()
    left = [path for path in after if "rtugate" in path and not UNINTERESTING.fullmatch(path)]
    assert sorted(left) == sorted(("/etc/rtugate", SCHEMA, FILE, MOTD, *ENABLED))
    assert installed.run("sh", MOTD) == ""
    installed.apt("install", installed.bring(package))
    assert differences(before, installed.tree()) == []


def test_purge_leaves_the_system_as_it_was_but_for_the_user(system: Debian, package: Path) -> None:
    before = system.tree()
    system.apt("install", system.bring(package))
    system.shell(
        f"""
        install -d -m 0750 -o rtugate -g rtugate /var/lib/rtugate
        setpriv --reuid=rtugate --regid=rtugate --init-groups sh -euc '
            touch {FILE}.rejected-20260101-000000 {FILE}.replaced-20260101-000000-2
            touch /etc/rtugate/.rtugate.toml.0123456789ab
            mkdir /var/lib/rtugate/history
            touch /var/lib/rtugate/history/1
        '
        """
    )
    system.apt("purge", "rtugate")
    assert differences(before, system.tree()) == []
    assert [path for path in system.tree() if "rtugate" in path and not path.startswith("/root/")] == []
    assert "rtugate" in (system.root / "etc/passwd").read_text()


def test_purge_leaves_what_somebody_else_put_beside_the_file(installed: Debian) -> None:
    installed.shell("echo mine >/etc/rtugate/notes.txt; cp /etc/hostname /etc/rtugate/rtugate.toml.my-copy")
    installed.apt("purge", "rtugate")
    assert sorted(path.name for path in (installed.root / "etc/rtugate").iterdir()) == [
        "notes.txt",
        "rtugate.toml.my-copy",
    ]


def test_every_script_may_be_run_again(installed: Debian) -> None:
    before = installed.tree()
    for _ in range(2):
        installed.run("/var/lib/dpkg/info/rtugate.postinst", "configure", "")
    assert differences(before, installed.tree()) == []
    postrm = installed.bring(installed.root / "var/lib/dpkg/info/rtugate.postrm")
    installed.apt("purge", "rtugate")
    for _ in range(2):
        installed.run(postrm, "purge")


def test_a_link_laid_by_the_group_is_not_followed_by_root(installed: Debian) -> None:
    installed.shell(
        f"""
        rm {FILE} {SCHEMA}
        ln -s /root/victim {SCHEMA}
        ln -s /root/victim {SCHEMA}.new
        /var/lib/dpkg/info/rtugate.postinst configure '' || true
        rm -f {FILE}
        """
    )
    assert not (installed.root / "root" / "victim").exists()


# ------------------------------------------------------------------------------------------------ the tests, there


def test_the_ordinary_tests_pass_on_debian_13s_own_python_and_packages(
    installed: Debian, record_property: Figure
) -> None:
    installed.apt("install", "--no-install-recommends", *TEST_TOOLS, *TEST_PROGRAMS)
    copy_tree(installed, "/usr/share/rtugate")  # beside the installed modules: these come out as they were
    command = (
        "cd /usr/share/rtugate && python3 -m pytest -q -p no:cacheprovider --allowed-skips tests/allowed_skips.txt"
    )
    told = installed.run("sh", "-euc", command, limit_s=TESTS_LIMIT_S)
    record_property("pytest", told.strip().splitlines()[-1])
    versions: dict[str, Any] = json.loads(installed.run("python3", "-c", VERSIONS))
    for name, version in versions.items():
        record_property(name, version)


VERSIONS: Final = """
import json, platform
from importlib.metadata import version
names = ("pyserial", "pydantic", "pymodbus", "tomli-w", "pytest", "hypothesis")
print(json.dumps({"Python": platform.python_version()} | {name: version(name) for name in names}))
"""
