"""What a virtual board boots from: Debian 13, made by debootstrap (``base.sh``), once for each list of packages.

It stays in the folder $RTUGATE_BOARD_CACHE, else ~/.cache/rtugate-board, under a name made of all that it depends on;
older ones there may be deleted at any time. A board writes to a layer of its own above it, never to the base itself.

Debian comes from $RTUGATE_BOARD_MIRROR, else from where this machine's apt gets its own, else from deb.debian.org; its
signatures are checked against this machine's keys, with no way around that.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).parent
CACHE: Final = "RTUGATE_BOARD_CACHE"
MIRROR: Final = "RTUGATE_BOARD_MIRROR"
DEBIAN: Final = "http://deb.debian.org/debian"
RECIPE: Final = ("base.sh", "init.sh", "agent.sh", "agent.service")
BARE: Final = ("systemd-sysv", "udev", "kmod", "busybox-static", "linux-image-cloud-amd64", "procps")
PROGRAMS: Final = {
    "qemu-system-x86_64": "qemu-system-x86",
    "qemu-img": "qemu-utils",
    "debootstrap": "debootstrap",
    "mke2fs": "e2fsprogs",
    "gpgv": "gpgv",
    "xz": "xz-utils",
    "setpriv": "util-linux",
}
BUILD_LIMIT_S: Final = 1800.0
CALL_LIMIT_S: Final = 60.0
TOLD_LINES: Final = 15  # of a build that failed


@dataclass(frozen=True)
class Base:
    """A folder with kernel, initrd and root.ext4."""

    folder: Path

    @property
    def kernel(self) -> Path:
        return self.folder / "kernel"

    @property
    def initrd(self) -> Path:
        return self.folder / "initrd"

    @property
    def root(self) -> Path:
        return self.folder / "root.ext4"


def base(packages: Sequence[str] = ()) -> Base:
    """Return what a board with *packages* beyond the bare system boots from, made now if nobody has made it yet."""
    demand(PROGRAMS, "only root can make the board's disks: their files belong to many users")
    made = cache() / _name(packages)
    with _alone(cache()):
        if not made.exists():
            _build(made, [*BARE, *packages])
    return Base(made)


def demand(programs: Mapping[str, str], rights: str) -> None:
    """Fail unless *programs* are here, each with the package that brings it, and we are root; *rights*: why that."""
    missing = sorted({package for program, package in programs.items() if shutil.which(program) is None})
    assert not missing, f"missing: apt-get install {' '.join(missing)}"
    assert os.geteuid() == 0, rights


def cache() -> Path:
    """Return the folder of all that was made."""
    return Path(os.environ.get(CACHE) or Path.home() / ".cache" / "rtugate-board")


def _name(packages: Sequence[str]) -> str:
    found = hashlib.sha256(" ".join([*BARE, *packages]).encode())
    for name in RECIPE:
        found.update((HERE / name).read_bytes())
    return found.hexdigest()[:16]


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Two runs at once build one after the other."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _build(made: Path, packages: Sequence[str]) -> None:
    """Make the folder *made*, whole or not at all."""
    with tempfile.TemporaryDirectory(dir=made.parent, prefix="unfinished-") as scratch:
        folder = Path(scratch) / "base"
        folder.mkdir()
        command = ["sh", str(HERE / "base.sh"), str(folder), mirror(), ",".join(packages)]
        built = subprocess.run(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=_environment(),
            timeout=BUILD_LIMIT_S,
            check=False,
        )
        told = "\n".join(built.stdout.splitlines()[-TOLD_LINES:])
        assert built.returncode == 0, f"Debian 13 from {command[3]} cannot be set up:\n{told}{_advice(built.stdout)}"
        folder.rename(made)


def _environment() -> dict[str, str]:
    """Return what the build finds: Debian through apt's own proxy, if it has one, and messages in English."""
    proxy = _told_by("apt-config", "shell", "proxy", "Acquire::http::Proxy").partition("=")[2].strip().strip("'")
    known = os.environ | {"LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}
    return known | {"http_proxy": proxy} if proxy and proxy != "DIRECT" else known


def _advice(told: str) -> str:
    is_key = re.search(r"unknown key|public key|NO_PUBKEY|signature", told, re.IGNORECASE)
    return "\nDebian 13's keys: apt-get install debian-archive-keyring, 2023.3+deb12u1 or newer" if is_key else ""


def mirror() -> str:
    """Return where this machine gets Debian from."""
    if MIRROR in os.environ:
        return os.environ[MIRROR]
    places = _told_by("apt-get", "indextargets", "--format", "$(REPO_URI)", "Created-By: Packages").splitlines()
    return next((place for place in places if re.fullmatch(r"https?://.*/debian/?", place)), DEBIAN)


def _told_by(*command: str) -> str:
    """What a program says; nothing where it is not there: this may be a machine without apt."""
    if shutil.which(command[0]) is None:
        return ""
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=CALL_LIMIT_S, check=True).stdout


# ------------------------------------------------------------------------------------------------ a board's own disks


def layer(above: Base, path: Path) -> None:
    """Make at *path* the disk of one board: what it writes stays there, and the base is as it was."""
    options = ["-f", "qcow2", "-F", "raw", "-b", str(above.root)]
    subprocess.run(["qemu-img", "create", "-q", *options, str(path)], check=True, timeout=CALL_LIMIT_S)


def disk_of(folder: Path, path: Path) -> None:
    """Make at *path* a disk that holds what is in *folder*; on the board it all belongs to root."""
    size = sum(file.stat().st_size + 4096 for file in folder.rglob("*")) // 1024 * 5 // 4 + 4096  # KiB, with room
    options = ["-q", "-t", "ext4", "-O", "^has_journal", "-E", "root_owner=0:0", "-d", str(folder)]
    subprocess.run(["mke2fs", *options, str(path), f"{size}k"], check=True, timeout=CALL_LIMIT_S)
