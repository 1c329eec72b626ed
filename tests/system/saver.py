"""A little program that changes the configuration of a station, and how it is disturbed on its way by strace.

    python -m tests.system.saver ACTION FOLDER

It takes FOLDER/etc/rtugate.toml, which says OLD, and a state directory beside it, does what ACTION stands for, and says
each word only when the call before it has returned. What went wrong for good is one line on the error output, and exit
code 1; what else there is to tell are lines that begin with "note: ".

``run`` has it in a fork of the caller, since starting a program takes ten times as long as saving. It stands still when
it has loaded the file, so strace, which takes hold of it there, sees and counts the calls of the action alone.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from gateway.config import Config
from gateway.config_file import ConfigFile
from gateway.errors import SaveError
from gateway.restart_cause import CLEAN, LastRun
from gateway.save import save
from gateway.snapshots import UNCONFIRMED
from gateway.store import load_text
from tests.fakes import JumpingClock

NAME: Final = "rtugate.toml"
LOOKS: Final = {"newfstatat", "fstat", "stat", "lstat", "statx", "getdents64", "read", "lseek", "ioctl", "fcntl"}
CONFIRM_S: Final = 600.0
LIMIT_S: Final = 60  # for a program that has nothing to wait for
BUG: Final = 70  # exit code after anything that is no SaveError
_HEAD: Final = """\
# The station at the river, as it was set up by hand
[register]
holding_registers = 4000

[[slave]]
name = "scada"
line = "tcp://127.0.0.1:5020"  # ask the control room before you touch it
unit = 1

[[master]]
name = "field"
line = "/dev/ttyS2"
"""
_REQUEST: Final = """
[[master.request]]
name = "pump-{number}"
unit = {unit}
function = "read-holding-registers"
address = 107
count = 3
every = {every}  # seconds
point = {point}
"""


def a_text(every: float, requests: int = 12) -> str:
    """Return a file of some disk blocks, in which each request comes *every* so many seconds."""
    entries = (_REQUEST.format(number=n, unit=n % 247 + 1, every=every, point=3 * n) for n in range(requests))
    return _HEAD + "".join(entries)


def a_config(text: str) -> Config:
    return load_text(text, NAME).config


OLD, NEW, NEXT = a_text(1.0), a_text(2.5), a_text(7.75)
NAMES: Final = {OLD: "old", NEW: "new", NEXT: "next"}


def name_of(config: Config) -> str:
    return next((name for text, name in NAMES.items() if a_config(text) == config), "something else")


def path_in(folder: Path) -> Path:
    return folder / "etc" / NAME


def file_in(folder: Path) -> ConfigFile:
    return ConfigFile(path_in(folder), folder / "state", JumpingClock())


def prepare(folder: Path, action: str) -> None:
    """Make *folder* what *action* begins with."""
    path_in(folder).parent.mkdir(parents=True)
    path_in(folder).write_text(OLD)
    if action == "run":
        (folder / "state").mkdir()
    if action == "start":
        file = file_in(folder)
        file.start()
        file.save(a_config(NEW), confirm_s=CONFIRM_S)
        assert (folder / "state" / UNCONFIRMED).exists()


# ------------------------------------------------------------------------------------------------ what it does


def write(file: ConfigFile) -> Iterator[str]:
    """The file alone, as `rtugate passwd` and `rtugate rollback` write it."""
    save(file.path, NEW, OLD)
    yield "saved"


def save_by_menu(file: ConfigFile) -> Iterator[str]:
    note(*file.save(a_config(NEW)))
    yield "saved"


def confirm(file: ConfigFile) -> Iterator[str]:
    note(*file.save(a_config(NEW), confirm_s=CONFIRM_S))
    yield "waiting"
    note(*file.confirm())
    yield "saved"


def revert(file: ConfigFile) -> Iterator[str]:
    note(*file.save(a_config(NEW), confirm_s=CONFIRM_S))
    yield "waiting"
    assert file.revert() == a_config(OLD)
    yield "reverted"


def start(file: ConfigFile) -> Iterator[str]:
    """A start after a save that nobody confirmed."""
    config = file.start()
    yield f"runs {name_of(config)}"


def begin_and_end(file: ConfigFile) -> Iterator[str]:
    """A run of the gateway, as the state directory keeps it."""
    last_run = LastRun(file.path.parent.parent / "state")
    last_run.begin()
    yield "begun"
    last_run.end(CLEAN)
    yield "ended"


ACTIONS: Final[dict[str, Callable[[ConfigFile], Iterator[str]]]] = {
    "write": write,
    "save": save_by_menu,
    "confirm": confirm,
    "revert": revert,
    "start": start,
    "run": begin_and_end,
}


def note(*remarks: str) -> None:
    for remark in remarks:
        os.write(2, f"note: {remark}\n".encode())


def act(action: str, folder: Path, ready: Callable[[], None] = lambda: None) -> int:
    """Load the file, call *ready*, then do *action*; return the exit code."""
    file = file_in(folder)
    if action != "start":
        file.start()
    ready()
    try:
        for word in ACTIONS[action](file):
            os.write(1, f"{word}\n".encode())
    except SaveError as error:
        os.write(2, f"{error}\n".encode())
        return 1
    note(*(alarm.words(str) for alarm in file.alarms))
    return 0


# ------------------------------------------------------------------------------------------------ under strace


@dataclass(frozen=True)
class Call:
    """A system call: its name, which one of that name it is (from 1), and how strace shows it."""

    name: str
    nth: int
    shown: str

    @property
    def is_word(self) -> bool:
        return self.shown.startswith(("write(1,", "write(2,"))

    @property
    def is_look(self) -> bool:
        """It only looks: a disk that is full or not to be written to does not keep it from that."""
        return self.name in LOOKS


@dataclass(frozen=True)
class Run:
    """How a saver ended.

    code:  its exit code, or minus the signal that ended it.
    words: what it said; *lines*: what stood on its error output; *trace*: what strace saw.
    """

    code: int
    words: list[str]
    lines: list[str]
    trace: str = field(repr=False)

    @property
    def problems(self) -> list[str]:
        """What went wrong for good."""
        return [line for line in self.lines if not line.startswith("note: ")]

    @property
    def last(self) -> str:
        return self.words[-1] if self.words else ""


def nothing() -> None:
    pass


def run(
    action: str,
    folder: Path,
    fault: str = "",
    at_stop: Callable[[], None] = nothing,
    first: Callable[[], None] = nothing,
) -> Run:
    """Let a saver do *action* in *folder*, which has to be alone in its own.

    fault:   what strace injects, as its manual has it.
    at_stop: called when that has stopped the saver, which then goes on.
    first:   what the saver does before all else.
    """
    assert shutil.which("strace"), "strace is missing: apt-get install strace"
    said = folder.parent / "said"
    said.mkdir(exist_ok=True)
    child = forked(action, folder, said, first)
    command = ["strace", "-p", str(child), "-o", str(said / "trace"), "-e", "trace=%file,%desc"]
    with subprocess.Popen([*command, *(["-e", f"inject={fault}"] if fault else [])], stderr=subprocess.PIPE) as strace:
        try:
            assert strace.stderr is not None
            assert b"attached" in (told := strace.stderr.readline()), told
            code = _ended(child, at_stop)
        except BaseException:
            os.kill(child, signal.SIGKILL)
            raise
    out, err, trace = ((said / name).read_text() for name in ("out", "err", "trace"))
    return Run(code, out.splitlines(), err.splitlines(), trace)


def _ended(child: int, at_stop: Callable[[], None]) -> int:
    os.kill(child, signal.SIGCONT)
    status = os.waitpid(child, os.WUNTRACED)[1]
    if os.WIFSTOPPED(status):
        at_stop()
        os.kill(child, signal.SIGCONT)
        status = os.waitpid(child, 0)[1]
    return os.waitstatus_to_exitcode(status)


def calls_of(trace: str) -> list[Call]:
    """Return the calls that strace saw, without those for memory: how many these are is a matter of chance."""
    count: Counter[str] = Counter()
    calls = []
    for match in re.finditer(r"^((\w+)\(.*)$", trace, re.MULTILINE):
        count[match[2]] += 1
        calls.append(Call(match[2], count[match[2]], match[1]))
    return [call for call in calls if call.name not in ("mmap", "munmap")]


def forked(action: str, folder: Path, said: Path, first: Callable[[], None]) -> int:
    """Return the process number of a child, which has loaded the file and stands still until SIGCONT.

    said:  a folder for what it says: "out" and "err".
    first: what the child does before all else.
    """
    child = os.fork()
    if child == 0:
        code = BUG
        signal.alarm(LIMIT_S)
        try:
            for number, name in enumerate(("out", "err"), 1):
                os.dup2(os.open(said / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
            logging.basicConfig(force=True, level=logging.WARNING, format="note: %(message)s", stream=os.fdopen(2, "w"))
            first()
            code = act(action, folder, ready=lambda: os.kill(os.getpid(), signal.SIGSTOP))
        except BaseException:  # noqa: BLE001  (the test shows it, whatever it is)
            os.write(2, traceback.format_exc().encode())
        finally:
            os._exit(code)
    assert os.WIFSTOPPED(os.waitpid(child, os.WUNTRACED)[1]), (said / "err").read_text()
    return child


if __name__ == "__main__":
    sys.exit(act(sys.argv[1], Path(sys.argv[2])))
