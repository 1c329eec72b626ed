"""Configuration files for tests of what becomes of them: their texts, a station's folder, a power cut."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.config import Config, RequestConfig
from gateway.config_file import ConfigFile
from gateway.store import load_text
from tests.fakes import JumpingClock

GOOD = """\
# the boiler house
[[master]]
name = "field"
line = "tcp://127.0.0.1:1"        # nobody is there
enabled = false

[[master.request]]
unit = 17
function = 3
address = 107
count = 3
every = 1.0                       # seconds
point = 0

[hmi.telnet]
listen = ""
"""
EDITED = GOOD.replace("count = 3", "count = 5").replace("the boiler house", "the boiler house, edited")
BAD = GOOD.replace("count = 3", "count = 126")


def config_of(text: str) -> Config:
    return load_text(text, "rtugate.toml").config


def counting(config: Config, count: int) -> Config:
    """*config* as the menu changes it: its request reads *count* registers."""
    master = config.master[0]
    keys = master.request[0].model_dump(exclude_unset=True, by_alias=True) | {"count": count}
    request = [RequestConfig.model_validate(keys)]
    return config.model_copy(update={"master": [master.model_copy(update={"request": request})]})


def text_counting(count: int) -> str:
    """What a save of ``counting`` writes into the file ``GOOD``."""
    return GOOD.replace("count = 3", f"count = {count}")


class Place:
    """A file and a state directory in a folder, and the gateway's view of them at each start."""

    def __init__(self, folder: Path, clock: JumpingClock, text: str | bytes = GOOD) -> None:
        self.path, self.state, self.clock = folder / "rtugate.toml", folder / "state", clock
        self.path.write_bytes(text.encode() if isinstance(text, str) else text)

    @property
    def text(self) -> str:
        return self.path.read_text()

    def file(self) -> ConfigFile:
        """The file as a program sees it that is about to start."""
        return ConfigFile(self.path, self.state, self.clock)

    def started(self) -> ConfigFile:
        file = self.file()
        file.start()
        return file

    def history(self) -> list[str]:
        """What is kept in the history, the newest last."""
        return [path.read_text() for path in sorted((self.state / "history").glob("*.toml"))]

    def names(self) -> list[str]:
        """Everything in the folder and in the state directory but the history."""
        found = [*self.path.parent.iterdir(), *(self.state.iterdir() if self.state.is_dir() else [])]
        return sorted(path.name for path in found if path.name not in ("state", "history", "rtugate.toml"))


def save(file: ConfigFile, count: int, confirm_s: float | None = None, overwrite: bool = False) -> list[str]:
    """Save what the file says with another count of registers."""
    return file.save(counting(file.saved or config_of(GOOD), count), overwrite, confirm_s)


def told(file: ConfigFile) -> list[str]:
    """The alarms of *file* in English."""
    return [alarm.words(lambda text: text) for alarm in file.alarms]


class PowerCut(BaseException):
    """The machine is off: nothing that was to follow happens."""


CALLS = ("open", "write", "fchown", "fchmod", "fsync", "rename", "unlink", "mkdir")


@contextmanager
def power_cut(monkeypatch: pytest.MonkeyPatch, at: int) -> Iterator[list[str]]:
    """Cut the power before the call number *at*, from 0, of those that write; gives the names of the calls made."""
    made: list[str] = []

    def dying(name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **keys: Any) -> Any:
            if len(made) >= at:
                raise PowerCut
            made.append(name)
            return real(*arguments, **keys)

        return call

    with monkeypatch.context() as patch, contextlib.suppress(PowerCut):
        for name in CALLS:
            patch.setattr(os, name, dying(name, getattr(os, name)))
        yield made


def raising(number: int) -> Callable[..., None]:
    """A system call that always fails with the error *number*."""

    def call(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    return call


@contextmanager
def disk_full(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No byte can be written meanwhile."""
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", raising(errno.ENOSPC))
        yield
