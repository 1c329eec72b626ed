"""Prints what is in the file system, as JSON: path to [mode, "owner:group", hash of a file or target of a link].

Other file systems that are mounted here are passed over. Runs in the system that is looked at.
"""

from __future__ import annotations

import grp
import hashlib
import json
import pwd
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

TOP: Final = Path("/")


def entries(folder: Path, device: int) -> Iterator[tuple[str, tuple[int, str, str]]]:
    for path in folder.iterdir():
        status = path.lstat()
        if status.st_dev == device:
            owner = f"{pwd.getpwuid(status.st_uid).pw_name}:{grp.getgrgid(status.st_gid).gr_name}"
            yield str(path), (status.st_mode, owner, _content(path, status.st_mode))
            if stat.S_ISDIR(status.st_mode):
                yield from entries(path, device)


def _content(path: Path, mode: int) -> str:
    if stat.S_ISLNK(mode):
        return str(path.readlink())
    return hashlib.sha256(path.read_bytes()).hexdigest() if stat.S_ISREG(mode) else ""


if __name__ == "__main__":
    print(json.dumps(dict(entries(TOP, TOP.lstat().st_dev))))
