"""A save that is refused, killed or cut off at any system call leaves the old file or the new one, whole.

The saver (``tests.system.saver``) runs once undisturbed under strace, which lists its calls to do with files. Then it
runs again for each of them: the call fails; or the saver is killed just before it; or the disk loses its power just
after it. That disk is an ext4 file system in a file, shut down by ioctl while the saver stands still: what was not
flushed is lost, and each call from then on fails. It is mounted anew, which replays its journal.

Not covered: a disk that calls a flush done which is not, or that tears a block. Whoever is not root, or lacks strace or
mkfs.ext4, sees tests fail: apt-get install strace e2fsprogs.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import signal
import stat
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Final

import pytest

from gateway import files
from gateway.config import factory
from gateway.errors import SaveError
from gateway.restart_cause import CLEAN, CRASH, FILE, FIRST, LastRun
from gateway.snapshots import LAST_GOOD, UNCONFIRMED
from gateway.store import load
from tests.system.saver import (
    ACTIONS,
    BUG,
    CONFIRM_S,
    LIMIT_S,
    NAMES,
    NEXT,
    OLD,
    Call,
    Run,
    a_config,
    a_text,
    calls_of,
    file_in,
    name_of,
    nothing,
    path_in,
    prepare,
    run,
)

Record = Callable[[str, object], None]

ERRORS: Final = {
    "EIO": "the disk reports an input/output error",
    "ENOSPC": "no space left on the device",
    "EROFS": "the file system is read-only",
    "EDQUOT": "the disk quota is used up",
}
NEXT_START: Final = {  # what a start may find, by the last word that was said; nothing else is ever right
    "write": {"": {"old", "new"}, "saved": {"new"}},
    "save": {"": {"old", "new"}, "saved": {"new"}},
    "confirm": {"": {"old"}, "waiting": {"old", "new"}, "saved": {"new"}},
    "revert": {"": {"old"}, "waiting": {"old"}, "reverted": {"old"}},
    "run": {word: {"old"} for word in ("ended", "begun", "")},
    "start": {word: {"old"} for word in ("runs old", "", "runs new", "runs something else")},
}
NEXT_CAUSE: Final = {"": {FIRST, CRASH}, "begun": {CRASH, CLEAN}, "ended": {CLEAN}}  # why the next run begins
LAST_WORD: Final = {
    "write": "saved",
    "save": "saved",
    "confirm": "saved",
    "revert": "reverted",
    "start": "runs old",
    "run": "ended",
}
FLAGS: Final = {"its journal flushed": 1, "nothing flushed": 2}  # EXT4_GOING_FLAGS_LOGFLUSH, _NOLOGFLUSH
EXT4_IOC_SHUTDOWN: Final = 0x8004587D  # _IOR('X', 125, __u32) of linux/fs/ext4/ext4.h
BLOCK_BYTES: Final = 1024  # of a disk so small
DISK_BYTES: Final = 16 * 1024 * 1024
MATTERS: Final = {  # an error here has to be told, unless there always is one
    *("mkdir", "mkdirat", "write", "fchown", "fchmod", "fsync"),
    *("rename", "renameat", "renameat2", "unlink", "unlinkat"),
}
ROOT: Final = Path(__file__).parents[2]

every_action = pytest.mark.parametrize("action", ACTIONS)


# ------------------------------------------------------------------------------------------------ where it saves


def undisturbed(action: str, place: Path, first: Callable[[], None] = nothing) -> list[Call]:
    """Return the calls of a saver that nobody disturbs, which ends well."""
    with fresh(action, place) as folder:
        ended = run(action, folder, first=first)
    assert (ended.code, ended.last) == (0, LAST_WORD[action]), ended
    return calls_of(ended.trace)


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Path]:
    """A folder in memory, where a flush takes no time."""
    with mounted("tmpfs", tmp_path, "-t", "tmpfs"):
        yield tmp_path


@contextmanager
def mounted(what: str | Path, place: Path, *options: str) -> Iterator[None]:
    assert os.geteuid() == 0, "only root may mount a file system"
    subprocess.run(["mount", *options, str(what), str(place)], check=True, timeout=LIMIT_S)
    try:
        yield
    finally:
        subprocess.run(["umount", str(place)], check=True, timeout=LIMIT_S)


@contextmanager
def fresh(action: str, place: Path) -> Iterator[Path]:
    """Give a folder that is what *action* begins with."""
    folder = place / "station"
    prepare(folder, action)
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


# ------------------------------------------------------------------------------------------------ what is right


def file_is(folder: Path) -> str:
    """Return which of the files it is, whole."""
    text = path_in(folder).read_text()
    assert text in NAMES, f"the file is neither the old one nor the new one: {text!r}"
    return NAMES[text]


def files_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()}


def temporary_in(folder: Path) -> set[str]:
    return {path for path in files_in(folder) if Path(path).name.startswith(".")}


def check_what_is_left(action: str, folder: Path, ended: Run) -> None:
    """What the saver left can be started from, and the next save, which nothing disturbs, clears up."""
    assert ended.code != BUG, ended.lines
    found = file_is(folder)
    assert ended.last != "saved" or found == "new", "it was said to be saved, and is not"
    file = file_in(folder)
    runs = name_of(file.start())
    assert runs in NEXT_START[action][ended.last], (runs, ended)
    assert runs == file_is(folder)
    if action == "run":
        check_cause(folder / "state", ended)
    file.save(a_config(NEXT), confirm_s=CONFIRM_S)
    file.confirm()
    assert file_is(folder) == "next"
    kept = {path for path in files_in(folder) if re.fullmatch(r"state/history/000[1-3]\.toml", path)}
    assert {(folder / path).read_text() for path in kept} <= set(NAMES)
    assert kept
    assert files_in(folder) - kept == {"etc/rtugate.toml"}


def check_cause(state: Path, ended: Run) -> None:
    """The next run knows how the one before it ended; where that could not be kept, it was said."""
    cause = LastRun(state).begin().cause.text
    assert cause in NEXT_CAUSE[ended.last] or "cannot be kept" in "".join(ended.lines), (cause, ended)
    assert cause in {FIRST, CRASH, CLEAN}
    (state / FILE).unlink()


def check_told(call: Call, folder: Path, ended: Run, error: str) -> None:
    """A saver whose *call* failed with *error* has said so, if it matters, and left no temporary file."""
    assert temporary_in(folder) == set()
    matters = call.name in MATTERS and " = -1 E" not in call.shown
    assert not matters or ERRORS[error] in "".join(ended.lines), "the error went unsaid"
    if ended.code == 0:
        assert ended.last != "runs new" or "nobody confirmed" in "".join(ended.lines), "what nobody confirmed runs"
        return
    assert ended.code == 1, ended
    assert len(ended.problems) == 1, ended
    problem = ended.problems[0]
    assert re.match(rf"(rtugate|unconfirmed)\.toml\b.*: {ERRORS[error]}", problem), problem
    if not ended.words:
        assert file_is(folder) == ("new" if "rtugate.toml has its new content" in problem else "old"), ended


def complain(found: list[str]) -> None:
    assert not found, "\n".join(found)


def complaints(calls: Iterable[Call], check: Callable[[Call], None]) -> list[str]:
    """Return each call at which *check* finds something wrong, with what it is."""
    found = []
    for call in calls:
        try:
            check(call)
        except (AssertionError, OSError, ValueError, SaveError) as error:
            found.append(f"{call.name} {call.nth}: {call.shown}\n    {type(error).__name__}: {error}")
    return found


# ------------------------------------------------------------------------------------------------ refused and killed


def refused_at_each_call(
    action: str, error: str, place: Path, calls: Iterable[Call], first: Callable[[], None] = nothing
) -> list[str]:
    def check(call: Call) -> None:
        with fresh(action, place) as folder:
            ended = run(action, folder, f"{call.name}:error={error}:when={call.nth}", first=first)
            assert "(INJECTED)" in ended.trace
            check_told(call, folder, ended, error)
            check_what_is_left(action, folder, ended)

    return complaints(calls, check)


def killed_at_each_call(
    action: str, place: Path, calls: Iterable[Call], first: Callable[[], None] = nothing
) -> list[str]:
    def check(call: Call) -> None:
        with fresh(action, place) as folder:
            ended = run(action, folder, f"{call.name}:signal=SIGKILL:when={call.nth}", first=first)
            assert ended.code == -signal.SIGKILL
            check_what_is_left(action, folder, ended)

    return complaints(calls, check)


@every_action
def test_undisturbed_a_program_of_its_own_does_what_its_fork_does(action: str, place: Path) -> None:
    with fresh(action, place) as folder:
        command = [sys.executable, "-m", "tests.system.saver", action, str(folder)]
        ended = subprocess.run(command, capture_output=True, text=True, check=True, timeout=LIMIT_S, cwd=ROOT)
        assert ended.stdout.splitlines()[-1] == LAST_WORD[action]
        assert file_is(folder) == ("new" if LAST_WORD[action] == "saved" else "old")
    with fresh(action, place) as folder:
        assert run(action, folder).words == ended.stdout.splitlines()


@pytest.mark.parametrize("error", ERRORS)
@every_action
def test_whichever_call_fails_the_file_is_whole_and_what_is_said_is_true(
    action: str, error: str, place: Path, record_property: Record
) -> None:
    calls = [call for call in undisturbed(action, place) if not call.is_word and (error == "EIO" or not call.is_look)]
    assert {"openat", "write", "fsync", "close"} <= {call.name for call in calls}
    complain(refused_at_each_call(action, error, place, calls))
    record_property(f"{action}: calls that failed with {error}", len(calls))


@every_action
def test_killed_before_any_call_the_file_is_whole_and_what_was_said_is_true(
    action: str, place: Path, record_property: Record
) -> None:
    calls = undisturbed(action, place)
    complain(killed_at_each_call(action, place, calls))
    record_property(f"{action}: calls killed at", len(calls))


# ------------------------------------------------------------------------------------------------ the power cut


def make_disk(image: Path, place: Path, action: str) -> None:
    """Make *image* an ext4 disk that is what *action* begins with."""
    assert shutil.which("mkfs.ext4"), "mkfs.ext4 is missing: apt-get install e2fsprogs"
    with image.open("wb") as file:
        file.truncate(DISK_BYTES)
    subprocess.run(["mkfs.ext4", "-q", "-m", "0", str(image)], check=True, timeout=LIMIT_S)
    with disk_at(image, place):
        prepare(place, action)


def disk_at(image: Path, place: Path) -> AbstractContextManager[None]:
    """Mount a disk that writes nothing of its own accord."""
    return mounted(image, place, "-o", "loop,commit=300,noauto_da_alloc")


def cut_power(place: Path, flags: int) -> bytes:
    folder = os.open(place, os.O_RDONLY)
    try:
        return fcntl.ioctl(folder, EXT4_IOC_SHUTDOWN, struct.pack("I", flags))
    finally:
        os.close(folder)


def cut_off_after_each_call(
    action: str, flags: int, place: Path, calls: Iterable[Call], first: Callable[[], None] = nothing
) -> list[str]:
    folder, image, made = place / "station", place / "image", place / "made"
    folder.mkdir()
    make_disk(made, folder, action)

    def check(call: Call) -> None:
        shutil.copyfile(made, image)
        fault = f"{call.name}:signal=SIGSTOP:when={call.nth}"
        cut: list[bytes] = []
        with disk_at(image, folder):
            ended = run(action, folder, fault, lambda: cut.append(cut_power(folder, flags)), first)
        assert cut
        assert ended.code in (0, 1), ended
        with disk_at(image, folder):
            check_what_is_left(action, folder, ended)

    return complaints(calls, check)


@pytest.mark.parametrize("flags", FLAGS)
@every_action
def test_power_lost_after_any_call_leaves_the_file_whole_and_what_was_said_true(
    action: str, flags: str, place: Path, record_property: Record
) -> None:
    calls = undisturbed(action, place)
    complain(cut_off_after_each_call(action, FLAGS[flags], place, calls))
    record_property(f"{action}, {flags}: power cuts, mounts", f"{len(calls)}, {2 * len(calls) + 1}")


def test_a_disk_that_is_really_full_keeps_the_old_file_and_says_so(place: Path, record_property: Record) -> None:
    """From no room at all, block by block, until the save finds enough for itself and its history."""
    folder, image = place / "station", place / "image"
    folder.mkdir()
    make_disk(image, folder, "save")
    ends: list[str] = []
    with disk_at(image, folder):
        while ends[-3:] != 3 * ["saved"]:
            ended = run_on_full_disk(folder, room=len(ends) * BLOCK_BYTES)
            assert temporary_in(folder) == set()
            assert file_is(folder) == ("new" if ended.last == "saved" else "old"), ended
            assert ended.last == "saved" or ended.problems == [f"rtugate.toml is not saved: {ERRORS['ENOSPC']}"]
            ends.append(ended.last or "refused")
    assert ends[0] == "refused"
    record_property("free blocks, from 0 on, and what came of them", ", ".join(ends))


def run_on_full_disk(folder: Path, room: int) -> Run:
    """Let a saver save where *room* bytes are left."""
    shutil.rmtree(folder / "state", ignore_errors=True)
    path_in(folder).write_text(OLD)
    ballast = folder / "ballast"
    with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:  # until there is no room
        while True:
            file.write(bytes(BLOCK_BYTES))
    os.truncate(ballast, ballast.stat().st_size - room)
    os.sync()
    try:
        return run("save", folder)
    finally:
        ballast.unlink()


# ------------------------------------------------------------------------------------------------ the proof


def writes_in_place() -> None:
    def write(path: Path, content: bytes, mode_for_new: int = 0) -> None:
        path.write_bytes(content)

    files.write_atomically = write


def flushes_no(kind: Callable[[int], bool]) -> Callable[[], None]:
    """Return what makes a saver flush no file of that *kind*."""
    real = os.fsync

    def fsync(fd: int) -> None:
        if not kind(os.fstat(fd).st_mode):
            real(fd)

    return lambda: setattr(os, "fsync", fsync)


def believes_a_failed_flush() -> None:
    real = os.fsync

    def fsync(fd: int) -> None:
        with contextlib.suppress(OSError):
            real(fd)

    setattr(os, "fsync", fsync)  # noqa: B010  (os.fsync takes more kinds of files than this)


def test_a_careless_saver_is_found_out(place: Path) -> None:
    """One that writes in place, flushes no content, flushes no folder, or overhears an error: each is complained of."""
    calls = undisturbed("write", place, writes_in_place)
    found = killed_at_each_call("write", place, calls, writes_in_place)
    assert any("neither the old" in one for one in found), found
    for kind, flags, complaint in ((stat.S_ISREG, 1, "neither the old"), (stat.S_ISDIR, 2, "was said to be saved")):
        calls = undisturbed("write", place, flushes_no(kind))
        found = cut_off_after_each_call("write", flags, place, calls, flushes_no(kind))
        assert any(complaint in one for one in found), found
    calls = [call for call in undisturbed("write", place) if call.name == "fsync"]
    found = refused_at_each_call("write", "EIO", place, calls, believes_a_failed_flush)
    assert len(found) == len(calls) == 2


# ------------------------------------------------------------------------------------------------ damaged snapshots


SMALL: Final = a_text(1.0, requests=1)


def damaged(content: bytes) -> Iterator[bytes]:
    """Return *content* with each of its bits flipped, and cut off at each byte."""
    for at in range(len(content)):
        for bit in range(8):
            yield content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :]
        yield content[:at]


def test_a_damaged_last_good_configuration_never_runs(place: Path, record_property: Record) -> None:
    path_in(place).parent.mkdir()
    path_in(place).write_text(SMALL)
    file_in(place).keep_good(a_config(SMALL))
    path_in(place).write_text("this is no TOML")
    assert file_in(place).start() == a_config(SMALL)
    kept = place / "state" / LAST_GOOD
    ways = list(damaged(kept.read_bytes()))
    for content in ways:
        kept.write_bytes(content)
        assert file_in(place).start() == factory(), content
    record_property("damaged in so many ways", len(ways))


def test_a_damaged_note_of_a_save_that_waits_undoes_nothing_and_is_told(place: Path, record_property: Record) -> None:
    path_in(place).parent.mkdir()
    path_in(place).write_text(SMALL)
    file = file_in(place)
    file.start()
    file.save(factory(), confirm_s=CONFIRM_S)
    saved = path_in(place).read_text()
    kept = place / "state" / UNCONFIRMED
    ways = list(damaged(kept.read_bytes()))
    for content in ways:
        kept.write_bytes(content)
        file = file_in(place)
        assert file.start() == factory()
        assert ["unconfirmed.toml is damaged" in alarm.words(str) for alarm in file.alarms] == [True], content
        assert path_in(place).read_text() == saved
    record_property("damaged in so many ways", len(ways))


# ------------------------------------------------------------------------------------------------ how long it takes


def median_s(work: Callable[[int], object]) -> float:
    """Return how long *work* takes in the middle of five times; it is told which time it is."""
    took = []
    for number in range(5):
        began = time.perf_counter()
        work(number)
        took.append(time.perf_counter() - began)
    return statistics.median(took)


def test_1000_requests_load_in_1_s_and_are_saved_in_2_s(tmp_path: Path, record_property: Record) -> None:
    path_in(tmp_path).parent.mkdir()
    path_in(tmp_path).write_text(a_text(1.0, requests=1000))
    loading_s = median_s(lambda _: load(path_in(tmp_path)))
    file = file_in(tmp_path)
    file.start()
    old, one = (f"every = {every}  # seconds\npoint = 1500\n" for every in (1.0, 9.0))
    ones = [a_config(a_text(1.0, requests=1000).replace(old, one.replace("9", str(number)))) for number in range(2, 7)]
    each = [a_config(a_text(2.0 + number, requests=1000)) for number in range(5)]
    saving_one_s = median_s(lambda number: file.save(ones[number]))
    saving_each_s = median_s(lambda number: file.save(each[number]))
    assert path_in(tmp_path).read_text() == a_text(6.0, requests=1000)
    assert loading_s < 1.0
    assert max(saving_one_s, saving_each_s) < 2.0
    record_property("1000 requests, bytes", path_in(tmp_path).stat().st_size)
    record_property("loaded", f"{loading_s:.2f} s")
    record_property("saved with one changed, with each changed", f"{saving_one_s:.2f} s, {saving_each_s:.2f} s")
