"""The Debian package in Debian 13: built, installed, run, upgraded, removed, purged, and what each of that leaves.

The system is a folder (``tests/system/package``), made by debootstrap; Debian's own packages come from its mirror.
What needs systemd is tried on a virtual board.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from tests.system.package.deb import BUILD_LIMIT_S, ROOT, another_version, built, field
from tests.system.package.debian13 import HERE, Debian, Entry, bare, demand_programs

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
TEST_PROGRAMS: Final = ("make", "mbpoll", "telnet", "picocom", "tmux", "strace", "bash-completion", "man-db", "mandoc")
SCRYPT: Final = f"scrypt$16384$8$5${'ab' * 16}${'cd' * 32}"

EXECUTABLE: Final = (
    "/usr/bin/rtugate",
    "/etc/update-motd.d/60-rtugate",
    "/usr/share/python3/runtime.d/rtugate.rtupdate",
)
BESIDE_THE_MODULES: Final = (
    "/usr/lib/systemd/system/rtugate.service",
    "/usr/lib/sysusers.d/rtugate.conf",
    "/usr/lib/udev/rules.d/60-rtugate.rules",
    "/usr/share/bash-completion/completions/rtugate",
    "/usr/share/doc/rtugate/README.Debian.gz",
    "/usr/share/doc/rtugate/README.md.gz",
    "/usr/share/doc/rtugate/changelog.gz",
    "/usr/share/doc/rtugate/copyright",
    "/usr/share/doc/rtugate/examples/70-rs485.rules",
    "/usr/share/doc/rtugate/examples/rtugate.toml",
    "/usr/share/man/man1/rtugate.1.gz",
    "/usr/share/man/man5/rtugate.toml.5.gz",
)
NOT_OURS: Final = shutil.ignore_patterns(".*", "dist", "build", "__pycache__", "*.egg-info")
POSTINST: Final = "/var/lib/dpkg/info/rtugate.postinst"

WHAT_USERS_LEAVE: Final = r"/etc/(passwd|group|g?shadow|subuid|subgid)-?|/etc/\.pwd\.lock"  # a user is never removed
WHAT_APT_KEEPS: Final = r"/var/lib/(dpkg|apt)/.*|/var/log/.*|/var/cache/.*"
WHAT_OTHERS_CACHE: Final = r"/etc/ld\.so\.cache|.*/__pycache__(/.*)?|/root/.*"  # and what the tests bring
UNINTERESTING: Final = re.compile("|".join((WHAT_USERS_LEAVE, WHAT_APT_KEEPS, WHAT_OTHERS_CACHE)))

Figure = Callable[[str, object], None]


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The .deb, built here."""
    demand_programs()
    return built(tmp_path_factory.mktemp("built"))


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory, package: Path) -> Debian:
    """Debian 13 with all that the package depends on; it is to be copied."""
    system = bare().copy(tmp_path_factory.mktemp("ready") / "root")
    system.apt("update")
    system.apt("satisfy", field(package, "Depends"))
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


# ------------------------------------------------------------------------------------------------ building


def test_lintian_has_nothing_to_say(package: Path) -> None:
    command = ["lintian", "--allow-root", "--pedantic", "--no-cfg", str(package.with_name(changes_of(package)))]
    told = subprocess.run(command, capture_output=True, text=True, timeout=BUILD_LIMIT_S, check=False)
    assert (told.returncode, told.stdout) == (0, ""), told.stdout + told.stderr


def test_what_is_installed_is_what_belongs_there(package: Path) -> None:
    rows = [row.split() for row in contents(package)]
    files = {row[-1].removeprefix("."): row[0] for row in rows if row[0].startswith("-")}
    assert {row[1] for row in rows} == {"root/root"}
    assert {row[0] for row in rows if row[0].startswith("d")} == {"drwxr-xr-x"}
    assert {mode for name, mode in files.items() if name not in EXECUTABLE} == {"-rw-r--r--"}
    assert {mode for name, mode in files.items() if name in EXECUTABLE} == {"-rwxr-xr-x"}
    modules = sorted(
        name.removeprefix("/usr/share/rtugate/") for name in files if name.startswith("/usr/share/rtugate/")
    )
    ours = [path for kind in ("*.py", "*.mo") for path in (ROOT / "gateway").rglob(kind)]
    assert modules == sorted(str(path.relative_to(ROOT)) for path in ours)
    assert {name for name in files if not name.startswith("/usr/share/rtugate/")} == {*BESIDE_THE_MODULES, *EXECUTABLE}


def test_two_builds_make_the_same_bytes_whatever_lies_about(package: Path, tmp_path: Path) -> None:
    tree = tmp_path / "an other tree"
    shutil.copytree(ROOT, tree, symlinks=True, ignore=NOT_OURS)
    for junk in ("gateway/.hidden", "gateway/notes.txt", "gateway/hmi/menu.py~", ".venv/x", "dist/y", "gateway/z/.a"):
        (tree / junk).parent.mkdir(exist_ok=True)
        (tree / junk).touch()
    (tree / "gone").symlink_to("/nowhere")
    subprocess.run(["find", str(tree), "-exec", "touch", "-hd", "2020-01-01", "{}", "+"], check=True)
    command = ["sh", "-c", 'umask 077; cd "$1" && make deb', "sh", str(tree)]
    environment = os.environ | {"TZ": "Asia/Kolkata", "LC_ALL": "de_DE.UTF-8", "DEB_BUILD_OPTIONS": "nocheck"}
    subprocess.run(command, env=environment, check=True, timeout=BUILD_LIMIT_S)
    assert (tree / "dist" / package.name).read_bytes() == package.read_bytes()


def test_a_tree_that_cannot_be_read_whole_makes_no_package(tmp_path: Path) -> None:
    tree = tmp_path / "tree"
    shutil.copytree(ROOT, tree, symlinks=True, ignore=NOT_OURS)
    for folder in (tmp_path, *tmp_path.parents):  # the way there is not to be what stops it
        if folder.stat().st_uid == os.geteuid() and folder != Path("/"):
            folder.chmod(folder.stat().st_mode | 0o011)
    (tree / "gateway" / "clock.py").chmod(0o600)
    made = tmp_path / "made"
    made.mkdir(mode=0o777)
    made.chmod(0o777)
    command = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "sh", "packaging/build.sh", str(made)]
    told = subprocess.run(command, cwd=tree, capture_output=True, text=True, timeout=BUILD_LIMIT_S, check=False)
    assert told.returncode != 0
    assert "clock.py: Cannot open: Permission denied" in told.stderr
    assert list(made.iterdir()) == []


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
    shutil.copytree(ROOT, system.root / folder.lstrip("/"), symlinks=True, ignore=NOT_OURS, dirs_exist_ok=True)


def test_on_debian_13_the_build_runs_the_tests_and_fails_with_them(system: Debian) -> None:
    tools = ("build-essential", "debhelper", "dh-python", *TEST_TOOLS)
    system.apt("install", "--no-install-recommends", *tools)
    copy_tree(system, "/root/rtugate")
    tests = system.root / "root/rtugate/tests"
    shutil.rmtree(tests)
    tests.mkdir()
    (tests / "test_one.py").write_text("def test_one() -> None:\n    assert True\n")
    assert "1 passed" in system.shell("sh /root/rtugate/packaging/build.sh /root/built")
    (tests / "test_one.py").write_text("def test_one() -> None:\n    assert False\n")
    told = system.shell("! sh /root/rtugate/packaging/build.sh /root/not-built; ls /root/not-built | wc --lines")
    assert "1 failed" in told
    assert told.endswith("\n0\n")
    system.shell("DEB_BUILD_OPTIONS=nocheck sh /root/rtugate/packaging/build.sh /root/built-unchecked")


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


def test_a_file_that_was_brought_before_is_used_and_can_be_saved(system: Debian, package: Path) -> None:
    system.shell(f"mkdir /etc/rtugate; printf '[log]\\n' >{FILE}; chmod 0600 {FILE}")
    system.apt("install", system.bring(package))
    after = system.tree()
    assert after["/etc/rtugate"] == Entry(0o42770, "rtugate:rtugate", "")
    assert (after[FILE].mode, after[FILE].owner) == (0o100640, "rtugate:rtugate")
    assert (system.root / FILE.lstrip("/")).read_text() == "[log]\n"
    assert after[SCHEMA].owner == "rtugate:rtugate"


@pytest.mark.parametrize(
    "beforehand",
    [
        f"mkdir /etc/rtugate; printf '[broken' >{FILE}",
        f"mkdir /etc/rtugate; ln -s /data/not-there-yet {FILE}",
        "mkdir -p /data/rtugate; ln -s /data/rtugate /etc/rtugate",
        "useradd --create-home --home-dir /home/plant --uid 4711 --user-group rtugate",
        "groupadd --gid 4711 rtugate",
        "umask 077; export LANG=de_DE.UTF-8 STATE_DIRECTORY=/x RUNTIME_DIRECTORY=/y",
    ],
    ids=["a broken file", "a dangling link", "a folder elsewhere", "a user", "a group", "an environment"],
)
def test_whatever_was_there_it_can_be_installed_and_purged(system: Debian, package: Path, beforehand: str) -> None:
    told = system.shell(f"{beforehand}; dpkg --install {system.bring(package)}")
    assert "not saved" not in told
    is_link = (system.root / "etc/rtugate").is_symlink()
    folder = system.root / ("data/rtugate" if is_link else "etc/rtugate")
    assert (folder.stat().st_mode & 0o7777, folder.stat().st_gid) == (0o2770, group_id(system))
    system.apt("purge", "rtugate")


def group_id(system: Debian) -> int:
    return int(system.run("getent", "group", "rtugate").split(":")[2])


def test_an_override_of_the_folders_rights_counts(system: Debian, package: Path) -> None:
    system.shell("dpkg-statoverride --add '#4711' root 2750 /etc/rtugate")
    system.shell(f"mkdir /etc/rtugate; printf '[log]\\n' >{FILE}; dpkg --install {system.bring(package)}")
    status = (system.root / "etc/rtugate").stat()
    assert (status.st_uid, status.st_gid, status.st_mode & 0o7777) == (4711, 0, 0o2750)


def test_where_the_file_cannot_be_made_it_says_why_and_a_second_try_succeeds(system: Debian, package: Path) -> None:
    told = system.shell(
        f"""
        mkdir /etc/rtugate
        mount -t tmpfs -o size=8k,mode=0755 none /etc/rtugate
        ! dpkg --install {system.bring(package)}
        umount /etc/rtugate
        dpkg --configure --pending
        """
    )
    assert "is not saved: no space left on the device" in told
    assert system.run("rtugate", "check").startswith(f"{FILE}: valid\n")


def test_what_pip_has_brought_is_not_used(installed: Debian) -> None:
    (python,) = (installed.root / "usr/local/lib").glob("python3*")
    modules = python / "dist-packages"
    modules.mkdir(exist_ok=True)
    for name in ("pydantic", "serial", "sitecustomize"):
        (modules / f"{name}.py").write_text("raise SystemExit('pip was here')\n")
    command = installed.root / "usr/local/bin/rtugate"
    command.write_text("#!/bin/sh\nexit 9\n")
    command.chmod(0o755)
    told = installed.shell(
        f"/usr/bin/rtugate check; rm {FILE}; mv /usr/local/lib/python3*/dist-packages /root; {POSTINST} configure ''"
    )
    assert told.startswith(f"{FILE}: valid\n")
    assert (installed.root / FILE.lstrip("/")).exists()


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


@pytest.mark.parametrize("owner", ["root", "4711"])
def test_an_upgrade_does_not_fail_for_what_only_editors_need(installed: Debian, package: Path, owner: str) -> None:
    told = installed.shell(f"chown {owner}:{owner} /etc/rtugate {SCHEMA}; dpkg --install {installed.bring(package)}")
    assert f"{SCHEMA} is not renewed" in told
    assert sorted(path.name for path in (installed.root / "etc/rtugate").iterdir()) == [
        "rtugate.schema.json",
        "rtugate.toml",
    ]


def test_purge_copes_with_mounts_links_and_folders(installed: Debian) -> None:
    told = installed.shell(
        """
        mkdir /data /data/rtugate /var/lib/rtugate /etc/rtugate/mine
        touch /data/rtugate/last-good.toml
        mount --bind /etc/rtugate /etc/rtugate
        mount --bind /data/rtugate /var/lib/rtugate
        dpkg --purge rtugate
        """
    )
    assert "error" not in told
    assert [path.name for path in (installed.root / "etc/rtugate").iterdir()] == ["mine"]
    assert list((installed.root / "data/rtugate").iterdir()) == []


def test_every_script_may_be_run_again(installed: Debian) -> None:
    before = installed.tree()
    for _ in range(2):
        installed.run(POSTINST, "configure", "")
    assert differences(before, installed.tree()) == []
    postrm = installed.bring(installed.root / "var/lib/dpkg/info/rtugate.postrm")
    installed.apt("purge", "rtugate")
    for _ in range(2):
        installed.run(postrm, "purge")


def test_a_link_laid_by_the_group_is_not_followed_by_root(installed: Debian) -> None:
    installed.shell(
        f"""
        mkfifo --mode=0666 {SCHEMA}.new
        timeout 20 {POSTINST} configure 0.1 || exit 1 # it is not waited for
        rm {FILE} {SCHEMA}
        ln -s /root/victim {SCHEMA}
        ln -s /root/victim {SCHEMA}.new
        {POSTINST} configure '' || true
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
