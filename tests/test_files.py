"""Writing a file for good: real files, real permissions, and every system call failing once."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import resource
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gateway.errors import SaveError
from gateway.files import in_words, remove_durably, write_atomically

NOBODY = 65534
OLD, NEW = b"old\n", b"new\n" * 100_000
LEFT_OVER = ".x.toml.0123456789ab"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "x.toml"
    path.write_bytes(OLD)
    path.chmod(0o640)
    return path


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that any user can reach; pytest's own are for one user only."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


@contextlib.contextmanager
def as_a_user() -> Iterator[str]:
    """Act as a user who is not root; yields his name."""
    if os.geteuid() != 0:
        yield subprocess.check_output(["id", "-un"], text=True).strip()
        return
    os.setegid(NOBODY)
    os.seteuid(NOBODY)
    try:
        yield subprocess.check_output(["id", "-un", str(NOBODY)], text=True).strip()
    finally:
        os.seteuid(0)
        os.setegid(0)


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


# --- what is written


def test_a_file_is_replaced_and_keeps_its_mode(path: Path) -> None:
    path.chmod(0o604)
    before = path.stat().st_ino
    write_atomically(path, NEW)
    assert path.read_bytes() == NEW
    assert mode_of(path) == 0o604
    assert path.stat().st_ino != before  # whoever reads the old one goes on reading it
    assert list(path.parent.iterdir()) == [path]


def test_a_new_file_is_not_for_everybody(tmp_path: Path) -> None:
    mask = os.umask(0)
    try:
        write_atomically(tmp_path / "a", NEW)
        write_atomically(tmp_path / "b", b"", 0o600)
    finally:
        os.umask(mask)
    assert (mode_of(tmp_path / "a"), mode_of(tmp_path / "b")) == (0o640, 0o600)


def test_a_relative_path_is_a_path(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(path.parent)
    write_atomically(Path("x.toml"), NEW)
    assert path.read_bytes() == NEW


def test_a_link_stays_and_the_file_behind_it_is_replaced(path: Path, tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    link, dangling = tmp_path / "etc" / "link.toml", tmp_path / "etc" / "dangling.toml"
    link.symlink_to("../x.toml")
    dangling.symlink_to("../y.toml")
    write_atomically(link, NEW)
    write_atomically(dangling, NEW)
    assert link.is_symlink()
    assert path.read_bytes() == (tmp_path / "y.toml").read_bytes() == NEW
    assert sorted((tmp_path / "etc").iterdir()) == [dangling, link]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give files away")
def test_owner_and_group_are_kept(path: Path) -> None:
    os.chown(path, 12, 34)
    write_atomically(path, NEW)
    assert (path.stat().st_uid, path.stat().st_gid, mode_of(path)) == (12, 34, 0o640)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a file of another user")
def test_the_group_is_kept_by_whoever_may_not_keep_the_owner(open_folder: Path) -> None:
    path = open_folder / "x.toml"
    path.write_bytes(OLD)
    os.chown(path, 0, NOBODY)
    open_folder.chmod(0o777)
    with as_a_user():
        write_atomically(path, NEW)
    assert (path.stat().st_uid, path.stat().st_gid) == (NOBODY, NOBODY)
    assert path.read_bytes() == NEW


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a file of another group")
def test_whoever_may_keep_neither_owner_nor_group_still_saves(open_folder: Path) -> None:
    path = open_folder / "x.toml"
    path.write_bytes(OLD)
    open_folder.chmod(0o777)
    with as_a_user():
        write_atomically(path, NEW)
    assert path.read_bytes() == NEW


# --- what is left behind


def test_what_a_power_cut_left_behind_goes_with_the_next_write(path: Path) -> None:
    (path.parent / LEFT_OVER).touch()
    write_atomically(path, NEW)
    assert list(path.parent.iterdir()) == [path]


def test_files_of_others_are_left_alone(path: Path) -> None:
    others = [
        ".x.toml.swp",
        ".x.toml.0123456789abc",
        ".y.toml.0123456789ab",
        "x.toml.0123456789ab",
        ".xztoml.0123456789ab",
    ]
    for name in others:
        (path.parent / name).touch()
    write_atomically(path, NEW)
    assert sorted(one.name for one in path.parent.iterdir()) == sorted([*others, "x.toml"])


def test_a_temporary_file_that_another_program_is_writing_is_left_alone(path: Path) -> None:
    with (path.parent / LEFT_OVER).open("wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        write_atomically(path, NEW)
        assert (path.parent / LEFT_OVER).exists()
    write_atomically(path, NEW)
    assert not (path.parent / LEFT_OVER).exists()


def test_a_left_over_that_is_no_file_stops_nobody(path: Path) -> None:
    (path.parent / LEFT_OVER).mkdir()
    os.mkfifo(path.parent / ".x.toml.ffffffffffff")
    write_atomically(path, NEW)
    assert path.read_bytes() == NEW


def test_a_name_as_long_as_names_can_be_is_no_problem(tmp_path: Path) -> None:
    path = tmp_path / ("é" * 127)
    write_atomically(path, NEW)
    write_atomically(path, OLD)
    assert path.read_bytes() == OLD
    assert list(tmp_path.iterdir()) == [path]


# --- every call fails once


class Failing:
    """Counts calls of functions of ``os`` and ``fcntl``; the n-th one does what it is told instead."""

    NAMES = ("open", "write", "fchown", "fchmod", "fsync", "rename", "stat", "scandir", "listdir", "close")

    def __init__(self, monkeypatch: pytest.MonkeyPatch, at: int, instead: Callable[[str], Any]) -> None:
        self.calls: list[str] = []
        self._at, self._instead = at, instead
        for name in self.NAMES:
            monkeypatch.setattr(os, name, self._wrapped(name, getattr(os, name)))

    def _wrapped(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **keys: Any) -> Any:
            self.calls.append(name)
            if len(self.calls) == self._at + 1:
                if name == "close":  # the descriptor is gone all the same
                    real(*arguments, **keys)
                return self._instead(name)
            return real(*arguments, **keys)

        return call


def the_calls(path: Path) -> list[str]:
    with pytest.MonkeyPatch.context() as patch:
        counting = Failing(patch, -1, str)
        write_atomically(path, NEW)
        return counting.calls


def fail_with(number: int) -> Callable[[str], Any]:
    def fail(_: str) -> None:
        raise OSError(number, os.strerror(number))

    return fail


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EIO, errno.EACCES, errno.EINTR])
def test_whichever_call_fails_there_is_the_old_file_or_the_new_one_and_no_other(path: Path, number: int) -> None:
    calls = the_calls(path)
    assert {"write", "fsync", "rename", "fchmod", "fchown"} <= set(calls)
    for at in range(len(calls)):
        path.write_bytes(OLD)
        (path.parent / LEFT_OVER).touch()
        with pytest.MonkeyPatch.context() as patch:
            failing = Failing(patch, at, fail_with(number))
            with contextlib.suppress(SaveError):
                write_atomically(path, NEW)
                assert path.read_bytes() == NEW  # what failed was of no importance
            failed = failing.calls[at]
            assert failing.calls.count("fsync") <= 2
            if failed == "fsync":
                assert failing.calls[at:].count("fsync") == 1, "a failed flush is never tried again"
        assert path.read_bytes() in (OLD, NEW)
        if "rename" not in failing.calls[: at + 1] or failed == "rename":
            assert path.read_bytes() in ((OLD,) if failed in ("write", "fsync", "rename", "fchmod") else (OLD, NEW))
        assert {one.name for one in path.parent.iterdir()} <= {path.name, LEFT_OVER}


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.ENOSPC, "no space left on the device"),
        (errno.EDQUOT, "the disk quota is used up"),
        (errno.EROFS, "the file system is read-only"),
        (errno.EIO, "the disk reports an input/output error"),
        (errno.ENOMEM, "Cannot allocate memory"),
    ],
)
def test_a_person_is_told_what_is_wrong(path: Path, number: int, said: str) -> None:
    at = the_calls(path).index("write")
    with pytest.MonkeyPatch.context() as patch:
        Failing(patch, at, fail_with(number))
        with pytest.raises(SaveError, match=f"^x.toml is not saved: {said}$"):
            write_atomically(path, NEW)


def test_a_folder_that_cannot_be_flushed_is_no_success(path: Path) -> None:
    calls = the_calls(path)
    with pytest.MonkeyPatch.context() as patch:
        Failing(patch, len(calls) - 1 - calls[::-1].index("fsync"), fail_with(errno.EIO))
        with pytest.raises(SaveError, match=r"x\.toml has its new content, but may lose it in a power cut: the disk"):
            write_atomically(path, NEW)
    assert path.read_bytes() == NEW


def test_a_write_that_takes_only_a_part_goes_on_with_the_rest(path: Path) -> None:
    real = os.write
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "write", lambda descriptor, data: real(descriptor, bytes(data)[:4097]))
        write_atomically(path, NEW)
    assert path.read_bytes() == NEW


def test_killed_at_any_moment_there_is_the_old_file_or_the_new_one(path: Path) -> None:
    for at in range(len(the_calls(path))):
        path.write_bytes(OLD)
        child = os.fork()
        if child == 0:  # pragma: no cover - it does not live to report
            Failing(pytest.MonkeyPatch(), at, lambda _: os._exit(7))
            write_atomically(path, NEW)
            os._exit(0)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        assert path.read_bytes() in (OLD, NEW)
        write_atomically(path, NEW)
        assert list(path.parent.iterdir()) == [path]


# --- real failures


def test_a_file_larger_than_allowed_leaves_the_old_one(path: Path) -> None:
    old_limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, old_limit[1]))
    try:
        with pytest.raises(SaveError, match=r"x\.toml is not saved: larger than files may be here"):
            write_atomically(path, NEW)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old_limit)
    assert path.read_bytes() == OLD
    assert list(path.parent.iterdir()) == [path]


def test_a_folder_that_is_not_there_is_named_as_the_reason(path: Path) -> None:
    with pytest.raises(SaveError, match="its folder does not exist"):
        write_atomically(path.parent / "no" / "x.toml", NEW)
    with pytest.raises(SaveError, match="its folder is no folder"):
        write_atomically(path / "x.toml", NEW)
    loop = path.parent / "loop"
    loop.symlink_to("loop")
    with pytest.raises(SaveError, match="Too many levels of symbolic links"):
        write_atomically(loop, NEW)


def test_what_is_no_file_is_not_replaced(path: Path) -> None:
    with pytest.raises(SaveError, match="it is not a regular file"):
        write_atomically(path.parent, NEW)
    with pytest.raises(SaveError, match="null is not saved: it is not a regular file"):
        write_atomically(Path("/dev/null"), NEW)


@pytest.mark.parametrize(
    ("owner", "mode", "command"),
    [
        ("user", 0o555, "chmod u+rwx {folder}"),
        pytest.param(
            "root",
            0o755,
            "chown {user} {folder}",
            marks=pytest.mark.skipif(os.geteuid() != 0, reason="only root can make another user's folder"),
        ),
    ],
)
def test_without_permission_a_person_is_told_what_to_type(
    open_folder: Path, owner: str, mode: int, command: str
) -> None:
    folder = open_folder / "it's here"
    folder.mkdir()
    path = folder / "x.toml"
    path.write_bytes(OLD)
    if owner == "user" and os.geteuid() == 0:
        os.chown(folder, NOBODY, NOBODY)
    folder.chmod(mode)
    with as_a_user() as user, pytest.raises(SaveError) as caught:
        write_atomically(path, NEW)
    quoted = f"'{folder}'".replace("it's", "it'\"'\"'s")
    typed = command.format(user=user, folder=quoted)
    assert str(caught.value) == f"x.toml is not saved: permission denied; what helps, typed as root: {typed}"
    folder.chmod(0o755)
    assert path.read_bytes() == OLD
    assert list(folder.iterdir()) == [path]


def test_the_command_is_for_whatever_is_in_the_way(open_folder: Path) -> None:
    outer, denied = open_folder / "outer", PermissionError(errno.EACCES, "")
    (outer / "inner").mkdir(parents=True)
    path = outer / "inner" / "x.toml"
    path.write_bytes(OLD)
    path.chmod(0)
    if os.geteuid() == 0:
        for one in (outer, outer / "inner", path):
            os.chown(one, NOBODY, NOBODY)
    with as_a_user():
        assert in_words(denied, path).endswith(f"chmod u+rw {path}")
        outer.chmod(0)
        assert in_words(denied, path).endswith(f"chmod u+x {outer}")
        outer.chmod(0o555)
        assert in_words(denied, outer / "new" / "x").endswith(f"chmod u+rwx {outer}")
        outer.chmod(0o755)
        path.chmod(0o600)
        assert in_words(denied, path).endswith(f"lsattr -d {path} (is it immutable?)")
        assert in_words(denied, outer / "new" / "x") == "permission denied"
        assert in_words(denied, outer / "y") == "permission denied"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make another user's folder")
def test_a_folder_on_the_way_is_opened_for_passing_only(open_folder: Path) -> None:
    open_folder.chmod(0o700)
    with as_a_user():
        said = in_words(PermissionError(errno.EACCES, ""), open_folder / "x" / "y")
    assert said.endswith(f"chmod o+x {open_folder}")


def test_a_user_without_a_name_is_told_his_number(open_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 4_000_000)
    monkeypatch.setattr(os, "access", lambda *_, **__: False)
    said = in_words(PermissionError(errno.EPERM, ""), Path("/x"))
    assert said.endswith("chown 4000000 /")


def test_flushes_come_in_the_order_that_survives_a_power_cut(path: Path) -> None:
    calls = the_calls(path)
    kept = [call for call in calls if call in ("write", "fsync", "rename")]
    assert kept == ["write", "fsync", "rename", "fsync"]


@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
@pytest.mark.parametrize(
    ("fault", "content"),
    [
        ("fsync:error=EIO:when=1", "old"),
        ("fsync:error=EIO:when=2", "new"),
        ("rename,renameat,renameat2:error=EROFS", "old"),
        ("write:error=ENOSPC:when=1", "old"),
        ("fchmod:error=EIO", "old"),
    ],
)
def test_a_kernel_that_refuses_is_believed(path: Path, fault: str, content: str) -> None:
    program = (
        "import sys; from pathlib import Path; from gateway.errors import SaveError; "
        "from gateway.files import write_atomically\n"
        "try: write_atomically(Path(sys.argv[1]), b'new')\n"
        "except SaveError as error: sys.exit(5)"
    )
    path.write_text("old")
    command = ["strace", "-f", "-o", "/dev/null", "-e", f"inject={fault}"]
    done = subprocess.run([*command, sys.executable, "-c", program, str(path)], capture_output=True, check=False)
    if b"Operation not permitted" in done.stderr:
        pytest.skip("this system does not let strace in")
    assert done.returncode == 5
    assert path.read_text() == content
    assert list(path.parent.iterdir()) == [path]


# --- removing


def test_a_file_is_removed_for_good_and_one_that_is_not_there_is_no_error(path: Path) -> None:
    remove_durably(path)
    assert list(path.parent.iterdir()) == []
    remove_durably(path)
    remove_durably(path / "no folder" / "x.toml")


def test_a_file_that_cannot_be_removed_says_why(path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        Failing(patch, 1, fail_with(errno.EIO))  # opens the folder, then flushes it
        with pytest.raises(SaveError, match=r"^x\.toml cannot be removed: the disk reports an input/output error$"):
            remove_durably(path)
