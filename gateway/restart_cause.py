"""Why the gateway was started last: kept in the state directory, for the menu and the log (spec section 7).

One small file is written twice in a run: at the start, with the machine's boot identifier, and at the end, with how it
ended. A run that left no end was a crash, or, if the machine has been started anew since, a power cut.

Threads: the main one.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Final

from gateway.errors import SaveError
from gateway.files import write_atomically
from gateway.hmi.wording import N_

FILE: Final = "last-run.json"
BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
FIRST: Final = N_("first start")
CLEAN: Final = N_("clean stop")
BY_MENU: Final = N_("restart by the menu")
CRASH: Final = N_("crash")
POWER: Final = N_("power")

log = logging.getLogger(__name__)


class LastRun:
    """How the run before this one ended, and how this one does."""

    def __init__(self, state: Path, boot_id: Path = BOOT_ID) -> None:
        self._path = state / FILE
        self._boot = _text(boot_id)

    def begin(self) -> str:
        """Say that a run begins; return why, in words."""
        cause = self._cause()
        self._write("")
        return cause

    def end(self, how: str) -> None:
        """Say that it ends, and *how*."""
        self._write(how)

    def _cause(self) -> str:
        try:
            content = self._path.read_text(encoding="utf-8", errors="replace")
        except OSError:  # there is none, or none that may be read
            return FIRST
        try:
            before = json.loads(content)
            ended, boot = str(before["ended"]), str(before["boot"])
        except (ValueError, KeyError, TypeError):
            return CRASH  # it was being written, or was damaged
        if ended:
            return ended
        return CRASH if boot == self._boot else POWER

    def _write(self, ended: str) -> None:
        try:
            write_atomically(self._path, json.dumps({"boot": self._boot, "ended": ended}).encode())
        except SaveError as error:
            log.warning("why the gateway was started cannot be kept: %s", error)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
