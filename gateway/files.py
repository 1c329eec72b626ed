"""A file replaced as a whole and for good: after a power cut there is the old content or the new, never a mixture.

The new content goes into a temporary file in the same folder, which is flushed to the disk and takes the old one's
name; then the folder is flushed. A failed flush is never tried again on the same file: the system may have forgotten
what it could not write, and would call the second one a success. Whatever fails, the old file stays as it is and no
temporary file is left; what a power cut left behind goes with the next write. What a file means is not known here.

Source: specification of rtugate, section 6; fsync(2), rename(2). Any thread, and several programs at once.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import pwd
import re
import secrets
import shlex
import stat
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final

from gateway.config_fields import escaped
from gateway.errors import SaveError

MODE_FOR_NEW: Final = 0o640  # it may hold secrets
NAME_CHARACTERS: Final = 255  # of a path that are shown

_WORDS: Final = {
    errno.ENOSPC: "no space left on the device",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "larger than files may be here",
    errno.EROFS: "the file system is read-only",
    errno.EIO: "the disk reports an input/output error",
    errno.ENOENT: "its folder does not exist",
    errno.ENOTDIR: "its folder is no folder",
}


def read_start(path: Path, most: int) -> bytes | None:
    """Return the regular file at *path*, or its first *most* bytes; None if it is something else. Raises OSError."""
    if not stat.S_ISREG(path.stat().st_mode):  # a FIFO waits, and a device may act on being opened
        return None
    with path.open("rb") as file:
        return file.read(most)


@contextlib.contextmanager
def as_owner_of(folder: Path) -> Iterator[None]:
    """Where root works in the *folder* of another user, do it with that user's rights. Main thread alone.

    Whoever may write in a folder may lay links there: root must neither show, keep nor replace what these lead to.
    """
    try:
        status = folder.stat()
    except OSError:  # whoever needs the folder says what is wrong with it
        yield
        return
    if os.geteuid() != 0 or status.st_uid == 0:
        yield
        return
    with contextlib.ExitStack() as back:
        steps = (
            (partial(os.setgroups, []), partial(os.setgroups, os.getgroups())),
            (partial(os.setegid, status.st_gid), partial(os.setegid, os.getegid())),
            (partial(os.seteuid, status.st_uid), partial(os.seteuid, 0)),
        )
        for become, come_back in steps:
            try:
                become()
            except OSError as error:  # a root without its rights, as in some containers
                name = escaped(str(folder), NAME_CHARACTERS)
                raise SaveError(
                    f"{name} is another user's, and cannot be worked in as that one: {error.strerror}"
                ) from error
            back.callback(come_back)
        yield


def write_atomically(path: Path, content: bytes, mode_for_new: int = MODE_FOR_NEW) -> None:
    """Replace the file at *path*, or the one that a link there leads to, with *content*; on return it is on the disk.

    Its mode and group are kept, its owner where permitted; a new file gets *mode_for_new*.
    raises: SaveError, in words for a person; the file is then the old one, unless the words say otherwise.
    """
    name = escaped(path.name, NAME_CHARACTERS)
    target = path
    try:
        target = _real(path)
        folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            _replace(target, content, mode_for_new)
            _flush_folder(folder, name)
        finally:
            _close(folder)
    except OSError as error:
        raise SaveError(f"{name} is not saved: {in_words(error, target)}") from error


def _real(path: Path) -> Path:
    """Return where links lead to; a link that cannot be looked at is no reason to replace the link itself."""
    try:
        return Path(os.path.realpath(path, strict=True))
    except FileNotFoundError:  # a new file
        return Path(os.path.realpath(path))


def _replace(target: Path, content: bytes, mode_for_new: int) -> None:
    old = _status(target)
    _remove_left_overs(target)
    temporary = target.with_name(f".{_short(target)}.{secrets.token_hex(6)}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    try:
        _lock(descriptor)
        _write(descriptor, content)
        _give_to_owner_of(
            target.parent.stat() if old is None else old, descriptor
        )  # also what root makes for the service
        os.fchmod(descriptor, mode_for_new if old is None else old.st_mode & 0o777)  # the unit forbids the other bits
        os.fsync(descriptor)
        temporary.rename(target)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    finally:
        _close(descriptor)


def _close(descriptor: int) -> None:
    with contextlib.suppress(OSError):  # what is on the disk, the flush before it has said
        os.close(descriptor)


def _status(target: Path) -> os.stat_result | None:
    """What the file is now; None if there is none."""
    try:
        old = target.stat()
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(old.st_mode):
        raise SaveError(f"{escaped(target.name, NAME_CHARACTERS)} is not saved: it is not a regular file")
    return old


def _short(target: Path) -> str:
    """So much of a name that a temporary file's is not too long."""
    return os.fsdecode(os.fsencode(target.name)[:200])


def _write(descriptor: int, content: bytes) -> None:
    left = memoryview(content)
    while left:
        left = left[os.write(descriptor, left) :]


def _give_to_owner_of(old: os.stat_result, descriptor: int) -> None:
    for owner in (old.st_uid, -1):  # who may not give files away may still keep the group
        with contextlib.suppress(PermissionError):
            os.fchown(descriptor, owner, old.st_gid)
            return


def _flush_folder(descriptor: int, name: str) -> None:
    try:
        os.fsync(descriptor)
    except OSError as error:
        text = f"{name} has its new content, but may lose it in a power cut: {in_words(error, Path(name))}; save again"
        raise SaveError(text) from error


def _lock(descriptor: int) -> None:
    """Mark a temporary file as one that is being written; a power cut takes the mark away."""
    with contextlib.suppress(OSError):  # a file system without locks: it is a courtesy
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _remove_left_overs(target: Path) -> None:
    """Remove temporary files that nobody is writing; one that cannot be removed harms nobody."""
    pattern = re.compile(re.escape(f".{_short(target)}.") + "[0-9a-f]{12}")
    with contextlib.suppress(OSError):
        for path in target.parent.iterdir():
            if pattern.fullmatch(path.name):
                _remove_unless_locked(path)


def _remove_unless_locked(path: Path) -> None:
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()
        finally:
            os.close(descriptor)


def in_words(error: OSError, path: Path) -> str:
    """What *error*, met at the file *path*, means to a person, and which command helps."""
    if error.errno in (errno.EACCES, errno.EPERM):
        command = _remedy(Path(os.path.realpath(path)))  # nobody is to hand over unseen what a link leads to
        return "permission denied" + (f"; what helps, typed as root: {escaped(command, 1000)}" if command else "")
    return _WORDS.get(error.errno or 0) or str(error.strerror or error)


def _remedy(path: Path) -> str | None:
    """The command that lets this program read and replace the file at *path*, if it can be known."""
    try:
        for folder in reversed(path.parents):
            if folder != path.parent and not os.access(folder, os.X_OK, effective_ids=True):
                return _command(folder, "x")
            is_last = folder == path.parent or not (folder / path.relative_to(folder).parts[0]).exists()
            if is_last and not os.access(folder, os.R_OK | os.W_OK | os.X_OK, effective_ids=True):
                return _command(folder, "rwx")
            if is_last and folder != path.parent:
                return None
        return _command(path, "rw")
    except OSError:
        return None


def _command(path: Path, rights: str) -> str:
    """The command that gives this program *rights* at *path*, which it lacks."""
    status, quoted, user_id = path.stat(), shlex.quote(str(path)), os.geteuid()
    mine = sum({"r": stat.S_IRUSR, "w": stat.S_IWUSR, "x": stat.S_IXUSR}[right] for right in rights)
    if status.st_uid == user_id and (user_id == 0 or status.st_mode & mine == mine):
        return f"lsattr -d {quoted} (is it immutable?)"
    if status.st_uid == user_id:
        return f"chmod u+{rights} {quoted}"
    return f"chmod o+x {quoted}" if rights == "x" else f"chown {_user_name(user_id)} {quoted}"


def _user_name(user_id: int) -> str:
    try:
        return pwd.getpwuid(user_id).pw_name
    except KeyError:
        return str(user_id)


def remove_durably(path: Path) -> None:
    """Remove the file at *path*, if there is one, so that a power cut does not bring it back; raises SaveError."""
    try:
        path.lstat()  # a read-only file system refuses to remove what is not there
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            path.unlink()
            os.fsync(folder)
        finally:
            _close(folder)
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise SaveError(f"{escaped(path.name, NAME_CHARACTERS)} cannot be removed: {in_words(error, path)}") from error
