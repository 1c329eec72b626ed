"""Debian 13 in a folder: made by debootstrap once, copied for each test, entered by chroot.

What it is: ``Debian``, a folder with a system in it, whose programs run there with mounts, processes and, if wanted, a
network of their own. All that ends with the program that was run; nothing is left mounted.
It comes from where the virtual boards' Debian comes from, and the first one is kept beside theirs (``image``).
What it refuses: to be run by anybody but root.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.system.board.image import cache, demand, mirror

HERE: Final = Path(__file__).parent
PACKAGES: Final = ("systemd-sysv", "udev", "kmod", "login", "libpam-modules", "ca-certificates")
PROGRAMS: Final = {
    "debootstrap": "debootstrap",
    "dpkg-buildpackage": "build-essential",
    "dh": "debhelper",
    "dh_python3": "dh-python",
    "lintian": "lintian",
    "unshare": "util-linux",
    "ip": "iproute2",
}
LIMIT_S: Final = 1800.0
TOLD_LINES: Final = 40  # of a program that failed
ENVIRONMENT: Final = {
    "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
    "HOME": "/root",
    "LC_ALL": "C.UTF-8",
    "DEBIAN_FRONTEND": "noninteractive",
    "TERM": "dumb",
}

ENTER: Final = """
root=$1; shift
mount -t proc proc "$root/proc"
mount -t devpts -o newinstance,ptmxmode=0666,mode=0620,gid=5 devpts "$root/dev/pts"
mount -t tmpfs tmpfs "$root/dev/shm"
[ -z "$ALONE" ] || ip link set lo up
exec chroot "$root" "$@"
"""


def demand_programs() -> None:
    demand(PROGRAMS, "only root can make a system whose files belong to many users")


@dataclass(frozen=True)
class Entry:
    """What is at a path: ``what`` it says, the hash of a file or the target of a link."""

    mode: int
    owner: str
    what: str


@dataclass(frozen=True)
class Debian:
    """A system in the folder *root*."""

    root: Path

    def run(self, *command: str, limit_s: float = LIMIT_S, is_alone: bool = False) -> str:
        """Return what *command* prints; *is_alone*: in a network of its own. An exit code but 0 is an error."""
        done = self.tried(*command, limit_s=limit_s, is_alone=is_alone)
        told = "\n".join(done.stdout.splitlines()[-TOLD_LINES:])
        assert done.returncode == 0, f"{' '.join(command)[:200]} ended with {done.returncode}:\n{told}"
        return done.stdout

    def tried(self, *command: str, limit_s: float, is_alone: bool) -> subprocess.CompletedProcess[str]:
        """Return how *command* ended; its stderr is part of its stdout."""
        own = ["--net"] if is_alone else []
        namespaces = ["unshare", "--mount", "--pid", "--fork", "--kill-child", *own]
        return subprocess.run(
            [*namespaces, "sh", "-euc", ENTER, "sh", str(self.root), *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=_proxies() | ENVIRONMENT | {"ALONE": "yes" if is_alone else ""},
            timeout=limit_s,
            check=False,
        )

    def shell(self, script: str) -> str:
        return self.run("sh", "-euc", script)

    def apt(self, *words: str) -> str:
        return self.run("apt-get", "--quiet", "--yes", "-o", "Dpkg::Use-Pty=0", *words)

    def copy(self, folder: Path) -> Debian:
        """Return a second one like it, in *folder*."""
        subprocess.run(["cp", "-a", "--reflink=auto", str(self.root), str(folder)], check=True, timeout=LIMIT_S)
        return Debian(folder)

    def bring(self, path: Path) -> str:
        """Put a file of this machine into root's home there; return where it is."""
        shutil.copy(path, self.root / "root")
        return f"/root/{path.name}"

    def tree(self) -> dict[str, Entry]:
        """Return all there is, by path."""
        found: dict[str, list[Any]] = json.loads(self.run("python3", "-I", "-B", self.bring(HERE / "tree.py")))
        return {path: Entry(*entry) for path, entry in found.items()}


def _proxies() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name.lower().endswith("_proxy")}


def bare() -> Debian:
    """Return Debian 13 without anything that rtugate needs, made now if nobody has made it yet. It is to be copied."""
    demand_programs()
    folder = cache()
    folder.mkdir(parents=True, exist_ok=True)
    made = folder / f"debian13-{_name(PACKAGES)}"
    with (folder / "debian13.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # two runs at once build one after the other
        if not made.exists():
            _build(made)
    return Debian(made)


def _name(packages: Sequence[str]) -> str:
    return hashlib.sha256(" ".join(packages).encode()).hexdigest()[:16]


def _build(made: Path) -> None:
    """Make the folder *made*, whole or not at all."""
    with tempfile.TemporaryDirectory(dir=made.parent, prefix="unfinished-") as scratch:
        folder = Path(scratch) / "root"
        words = ["--force-check-gpg", "--variant=minbase", f"--include={','.join((*PACKAGES, 'python3'))}"]
        built = subprocess.run(
            ["debootstrap", *words, "trixie", str(folder), mirror()],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=os.environ | ENVIRONMENT,
            timeout=LIMIT_S,
            check=False,
        )
        told = "\n".join(built.stdout.splitlines()[-TOLD_LINES:])
        assert built.returncode == 0, f"Debian 13 from {mirror()} cannot be set up:\n{told}"
        folder.rename(made)
