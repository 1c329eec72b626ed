"""Why the gateway was started last, and how many bad restarts there were in a row: kept in the state directory.

One small file is written at the start of a run, with the machine's boot identifier; at its end, with how it ended; when
it hangs, with the names of what does; and when it has lasted. A run that left no end was a crash, or a hang if it left
a mark or evidence of one; if the machine has been started anew since, a reset by its watchdog, or else a power cut.

A bad restart is one that nobody asked for, after less than ten minutes of running. So the file holds the number that
the row has come to if this run ends badly now: one more than at its start, 0 once it has lasted. It grows no further
than SAFE_AFTER: what ends badly in safe mode starts in safe mode again.

What it refuses: measuring how long a run lasts, and deciding on safe mode (``running``); trusting the file: what is
damaged there, or foreign, counts as a crash.

Source: specification of rtugate, section 7. Threads: the main one; ``lasted``, ``forgiven`` and ``hung`` write in
short-lived threads, one after the other, since a slow card must neither look like a hang nor hold up the exit.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import stat
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Final

from gateway.errors import SaveError
from gateway.files import write_atomically
from gateway.hmi.station import Told
from gateway.hmi.wording import N_
from gateway.plain_text import cut, printable
from gateway.stacks import NAME_MOST, SUSPECTS_MOST, UNKNOWN, Evidence, start_of

FILE: Final = "last-run.json"
LARGEST_FILE: Final = 16384
BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
WATCHDOGS: Final = Path("/sys/class/watchdog")
CARD_RESET: Final = 0x20  # WDIOF_CARDRESET of linux/watchdog.h: this watchdog has reset the machine
SAFE_AFTER: Final = 3  # bad restarts in a row
HUNG_LIMIT_S: Final = 2.0
END_LIMIT_S: Final = 0.4

FIRST: Final = N_("first start")
CLEAN: Final = N_("clean stop")
BY_MENU: Final = N_("restart by the menu")
CRASH: Final = N_("crash")
POWER: Final = N_("power")
HANG: Final = N_("hang of {name}")
WATCHDOG: Final = N_("watchdog reset")
WATCHDOG_AFTER_HANG: Final = N_("watchdog reset after a hang of {name}")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Beginning:
    """Why this run began. *bad_in_row*: bad restarts up to now, this one included; SAFE_AFTER at most."""

    cause: Told
    bad_in_row: int


@dataclass(frozen=True)
class _Run:
    """What the file says of a run.

    boot:       the machine's boot identifier; "": not known.
    ended:      CLEAN, BY_MENU, or "": badly, or not yet.
    hung:       the names of what hung.
    bad_in_row: what the row has come to if it ended badly; 1 where that is not known.
    """

    boot: str
    ended: str = ""
    hung: tuple[str, ...] = ()
    bad_in_row: int = 1


def was_reset_by_watchdog(watchdogs: Path = WATCHDOGS) -> bool:
    """Whether a watchdog's driver says that it reset the machine before this boot; False where none says anything."""
    for path in sorted(watchdogs.glob("watchdog*/bootstatus")):
        status = (start_of(path, 32) or b"").strip()
        if status.isdigit() and int(status) & CARD_RESET:
            return True
    return False


class LastRun:
    """How the run before this one ended, and how this one does."""

    def __init__(
        self, state: Path, boot_id: Path = BOOT_ID, was_reset: Callable[[], bool] = was_reset_by_watchdog
    ) -> None:
        self._path = state / FILE
        self._run = _Run(boot=(start_of(boot_id, 64) or b"").decode("utf-8", "replace").strip())
        self._was_reset = was_reset
        self._cause = Told(FIRST)
        self._writer: threading.Thread | None = None
        self._is_warned = False

    def begin(self, evidence: Evidence | None = None) -> Beginning:
        """Say that a run begins; return why. *evidence*: what the run before has left of its stacks."""
        for line in evidence.lines if evidence is not None else ():
            log.error("the run before: %s", line, extra={"is_unlimited": True})
        before = self._before(evidence)
        self._cause = self._cause_of(before)
        bad_in_row = before.bad_in_row if before is not None and not before.ended else 0
        self._run = replace(self._run, bad_in_row=_one_more(bad_in_row))
        self._write(self._run)
        return Beginning(self._cause, bad_in_row)

    def reset_by_watchdog(self) -> Told:
        """The watchdog's device says, once it is open, that it has reset the machine; return why this run began."""
        if self._cause == Told(POWER):
            self._cause = Told(WATCHDOG)
        return self._cause

    def lasted(self) -> None:
        """Ten minutes have passed outside safe mode: the row is over, and a bad end begins none. Waits for nothing."""
        self._write_later(replace(self._run, bad_in_row=0))

    def forgiven(self, row: int = 0) -> None:
        """Safe mode is over. *row*: bad restarts that count all the same. Waits for nothing."""
        self._write_later(replace(self._run, bad_in_row=_one_more(row)))

    def hung(self, names: Sequence[str], meanwhile: Callable[[], None] = lambda: None) -> None:
        """The tasks of these *names* hang, and the process is about to be ended: within HUNG_LIMIT_S. Never raises.

        meanwhile: done while the mark is being written; what blocks there does not keep it from the disk.
        """
        run = replace(self._run, hung=_safe(names) or (UNKNOWN,))
        self._write_within(HUNG_LIMIT_S, run, meanwhile)

    def end(self, how: str) -> None:
        """Say that it ends, and *how*; within END_LIMIT_S, whatever the disk does."""
        if not self._write_within(END_LIMIT_S, replace(self._run, ended=how)):
            self._warn("the disk does not answer")

    def _before(self, evidence: Evidence | None) -> _Run | None:
        """Return how the run before this one ended, as its file and the *evidence* have it; None if there was none."""
        content = start_of(self._path, LARGEST_FILE)
        if content is None and evidence is None:
            return None
        before = _decoded(content or b"") or _Run(boot=self._run.boot)  # damaged, it tells of a crash
        if evidence is not None and evidence.is_hang and not before.hung:
            return replace(before, hung=_safe(evidence.names))
        return before

    def _cause_of(self, before: _Run | None) -> Told:
        if before is None:
            return Told(FIRST)
        if before.ended:
            return Told(before.ended)
        name = {"name": ", ".join(before.hung)}
        if "" in (before.boot, self._run.boot) or before.boot == self._run.boot:
            return Told(HANG, name) if before.hung else Told(CRASH)
        if before.hung:
            return Told(WATCHDOG_AFTER_HANG, name)
        return Told(WATCHDOG) if self._was_reset() else Told(POWER)

    def _write_within(self, limit_s: float, run: _Run, meanwhile: Callable[[], None] = lambda: None) -> bool:
        """Write *run*; False if that is not done when the time is over."""
        try:
            writer = self._write_later(run)
        except RuntimeError:  # there may be no more threads; a disk that hangs as well is the backstop's
            self._write(run)
            meanwhile()
            return True
        meanwhile()
        writer.join(limit_s)
        return not writer.is_alive()

    def _write_later(self, run: _Run) -> threading.Thread:
        """Write *run* in a thread of its own, after any other that is still being written."""
        before, self._run = self._writer, run

        def work() -> None:
            if before is not None:
                before.join()
            self._write(run)

        writer = threading.Thread(target=work, name="last run", daemon=True)
        writer.start()
        self._writer = writer
        return writer

    def _write(self, run: _Run) -> None:
        content = json.dumps(asdict(run)).encode()
        try:
            write_atomically(self._path, content)
        except SaveError as error:
            self._warn(str(error))
            self._write_in_place(content)

    def _write_in_place(self, content: bytes) -> None:
        """Where the disk is full, the room of the old file is left; what it says would be told of this run."""
        with contextlib.suppress(OSError):
            fd = os.open(self._path, os.O_WRONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                if stat.S_ISREG(os.fstat(fd).st_mode):
                    os.pwrite(fd, content, 0)
                    os.ftruncate(fd, len(content))
            finally:
                os.close(fd)

    def _warn(self, why: str) -> None:
        """Once in a run: every later write would fail as well."""
        if not self._is_warned:
            self._is_warned = True
            log.warning("why the gateway was started cannot be kept: %s", why)


def _decoded(content: bytes) -> _Run | None:
    """Return what *content* says of a run, each part only if it makes sense; None if nothing does."""
    try:
        found = json.loads(content)
    except (ValueError, RecursionError):
        return None
    if not isinstance(found, dict) or not isinstance(found.get("boot"), str):
        return None
    ended, hung, bad_in_row = (found.get(key) for key in ("ended", "hung", "bad_in_row"))
    return _Run(
        boot=found["boot"],
        ended=ended if ended in (CLEAN, BY_MENU) else "",
        hung=_safe(name for name in hung if isinstance(name, str)) if isinstance(hung, list) else (),
        bad_in_row=bad_in_row if type(bad_in_row) is int and 0 <= bad_in_row <= SAFE_AFTER else 1,
    )


def _one_more(bad_in_row: int) -> int:
    return max(0, min(bad_in_row + 1, SAFE_AFTER))


def _safe(names: Iterable[str]) -> tuple[str, ...]:
    """Return so many *names*, so much of each, that they can be shown and kept."""
    return tuple(cut(printable(name), NAME_MOST) for name in islice(names, SUSPECTS_MOST))
