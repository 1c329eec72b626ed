"""The .deb, made of this tree, and a later version of it."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[3]
BUILD_LIMIT_S: Final = 600.0


def built(folder: Path) -> Path:
    """Return the package, made in *folder*, with its .changes and .buildinfo beside it."""
    subprocess.run(["sh", "packaging/build.sh", str(folder)], cwd=ROOT, check=True, timeout=BUILD_LIMIT_S)
    (made,) = folder.glob("*.deb")
    return made


def another_version(package: Path, folder: Path) -> Path:
    """Return the same package with a later version."""
    content, made = folder / "content", folder / "rtugate_later_all.deb"
    subprocess.run(["dpkg-deb", "--raw-extract", str(package), str(content)], check=True)
    control = content / "DEBIAN" / "control"
    control.write_text(re.sub(r"(?m)^(Version: .*)$", r"\1+later", control.read_text()))
    subprocess.run(["dpkg-deb", "--root-owner-group", "--build", str(content), str(made)], check=True)
    shutil.rmtree(content)
    return made


def field(package: Path, name: str) -> str:
    """Return what the package says of itself."""
    command = ["dpkg-deb", "--field", str(package), name]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def depends_of(package: Path) -> tuple[str, ...]:
    """Return the names of the packages that it depends on; of alternatives the first."""
    wanted = (entry.partition("|")[0].split()[0] for entry in field(package, "Depends").split(","))
    return tuple(dict.fromkeys(name.partition(":")[0] for name in wanted))
