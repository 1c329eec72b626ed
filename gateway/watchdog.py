"""The hardware watchdog: a device that resets the machine unless it is fed in time.

What it is: Linux's watchdog interface. Opening the device starts it; its timeout is set and read back; each ``feed``
keeps it alive; the magic character V, just before closing, stops it. A device that refuses the ioctls (an old driver,
a FIFO) is fed by writing and counts by its own timeout. One that cannot be used is ``trouble``, which is lived without:
it is tried again later and later, and talked about once per change.
What it refuses: to decide when to feed, and when a stop is a clean one. It creates no file and waits for nothing.
Source: spec section 7; Linux, Documentation/watchdog/watchdog-api.rst and drivers/watchdog/watchdog_dev.c.
Threads: the main one; ``trouble`` may be read from any.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import stat
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from gateway.clock import Clock
from gateway.config_fields import escaped
from gateway.errors import LinkError, LinkLost, LinkUnavailable
from gateway.link import plain_reason

FIRST_S: Final = 1.0  # until a device is tried again; then twice as long each time
MOST_S: Final = 60.0
LEAST_TIMEOUT_S: Final = 5  # below this, a feeding once a second may come too late on a busy board
PATH_CHARACTERS: Final = 255  # that are shown
SYSFS: Final = Path("/sys/class/watchdog")

# linux/watchdog.h: flags of GET_SUPPORT and GET_BOOT_STATUS
CARD_RESET: Final = 0x0020  # the watchdog reset the machine
MAGIC_CLOSE: Final = 0x0100
ALARM_ONLY: Final = 0x0400
KEEP_ALIVE_PING: Final = 0x8000

SUPPORT: Final = struct.Struct("=II32s")  # struct watchdog_info: options, firmware's version, identity
NUMBER: Final = struct.Struct("=i")
MAGIC: Final = b"V"
PLAIN: Final = b"\0"  # keeps it alive as any byte does, and is not the magic one

_ODD_MACHINES: Final = ("alpha", "mips", "parisc", "ppc", "sparc")  # whose asm/ioctl.h has directions of its own


def reading(number: int, size: int, machine: str) -> int:
    """Return the request that asks for *size* bytes, as _IOR('W', ...) makes it on *machine* (see uname)."""
    direction = 0x4000_0000 if machine.startswith(_ODD_MACHINES) else 0x8000_0000
    return direction | size << 16 | ord("W") << 8 | number


_MACHINE: Final = os.uname().machine
GET_SUPPORT: Final = reading(0, SUPPORT.size, _MACHINE)
GET_BOOT_STATUS: Final = reading(2, NUMBER.size, _MACHINE)
KEEP_ALIVE: Final = reading(5, NUMBER.size, _MACHINE)
SET_TIMEOUT: Final = 0xC000_0000 | reading(6, NUMBER.size, _MACHINE)  # both directions: the same everywhere
GET_TIMEOUT: Final = reading(7, NUMBER.size, _MACHINE)

_OPENING: Final = {
    **dict.fromkeys((errno.ENOENT, errno.ENOTDIR), "is not there (is its driver loaded?)"),
    **dict.fromkeys((errno.ENXIO, errno.ENODEV), "nobody is behind it (no driver, no reader)"),
    errno.EACCES: "permission denied; it is root's until a udev rule gives it to a group that this program's user has",
    errno.EPERM: "not permitted: the service's unit has no DeviceAllow= for it",
    errno.EBUSY: "another program has it (systemd, if its RuntimeWatchdogSec is set)",
    errno.EISDIR: "is a folder and no watchdog",
}
_FEEDING: Final = {
    **dict.fromkeys((errno.ENODEV, errno.ENXIO), "is gone (unplugged?)"),
    errno.EPIPE: "its reader is gone",
    errno.EAGAIN: "takes nothing any more (its reader does not read)",
}

log = logging.getLogger(__name__)

ABOUT: Final = {"about": "watchdog"}  # one cause, for the log


class DeviceCalls(Protocol):
    """What is asked of the system; every call may raise OSError, and none may wait."""

    def open(self, path: Path) -> int:
        """Return a descriptor for writing to what is at *path*, which is never created."""

    def mode(self, fd: int) -> int:
        """Return the kind of what was opened, as in stat(2)."""

    def ioctl(self, fd: int, request: int, argument: bytes) -> bytes:
        """Return *argument* as the driver leaves it."""

    def write(self, fd: int, data: bytes) -> int:
        """Return how many bytes were taken."""

    def close(self, fd: int) -> None:
        """Give the descriptor back."""


class SystemCalls:
    """The real ones."""

    def open(self, path: Path) -> int:
        """Open; a FIFO without a reader is no wait. No child inherits it, as nothing that Python opens."""
        return os.open(path, os.O_WRONLY | os.O_NONBLOCK)

    def mode(self, fd: int) -> int:
        """By fstat(2)."""
        return os.fstat(fd).st_mode

    def ioctl(self, fd: int, request: int, argument: bytes) -> bytes:
        """By ioctl(2)."""
        return fcntl.ioctl(fd, request, argument)

    def write(self, fd: int, data: bytes) -> int:
        """By write(2)."""
        return os.write(fd, data)

    def close(self, fd: int) -> None:
        """By close(2)."""
        os.close(fd)


@dataclass(frozen=True)
class _Nature:
    """What a device is like; asked when it is opened."""

    identity: str  # "" if it does not say
    options: int | None  # None if it does not say: it refuses ioctls
    timeout_s: int | None  # that it counts by; None if it does not say
    refusal: str  # why it did not take the timeout asked for; "" if it did
    is_nowayout: bool

    def in_words(self, asked_s: int) -> str:
        after = "a time of its own" if self.timeout_s is None else f"{self.timeout_s} s"
        head = f"{self.identity or 'opened'}, resets the machine when not fed for {after}"
        return "; ".join([head, *self.remarks(asked_s)])

    def remarks(self, asked_s: int) -> list[str]:
        """Return what a person should know before it happens."""
        if self.options is None and self.refusal:
            return ["it refuses a watchdog's requests (is it one?)"]
        remarks = [f"it refuses {asked_s} s ({self.refusal})"] if self.refusal else []
        if self.is_nowayout:
            remarks.append("it ignores V (nowayout): a clean stop of the program also resets the machine")
        elif self.options is not None and not self.options & MAGIC_CLOSE:
            remarks.append("it ignores V and stops whenever the program ends: a crash does not reset the machine")
        if (self.options or 0) & ALARM_ONLY:
            remarks.append("it raises an alarm of its own instead of resetting the machine")
        return remarks

    def shortfall(self, asked_s: int) -> str:
        if self.timeout_s is None or self.timeout_s >= asked_s:
            return ""
        what_for = (
            "being fed once a second may be too late"
            if self.timeout_s < LEAST_TIMEOUT_S
            else "a restart of the program may take longer"
        )
        return f"waits for {self.timeout_s} s only, not {asked_s} s: {what_for}"


class WatchdogDevice:
    """The device at a path, from the first ``feed`` until it is closed, for good."""

    def __init__(
        self, path: Path, timeout_s: int, clock: Clock, calls: DeviceCalls | None = None, classes: Path = SYSFS
    ) -> None:
        """*timeout_s*: whole seconds that it shall wait to be fed. Nothing is opened yet."""
        self.trouble = ""  # why it does not guard the machine as it should, for people; "" while it does
        self.reset_machine = False  # after opening: it was this watchdog that reset the machine last
        self._path = path
        self._name = escaped(str(path), PATH_CHARACTERS)
        self._timeout_s = timeout_s
        self._clock = clock
        self._calls = calls or SystemCalls()
        self._classes = classes
        self._fd = -1
        self._is_over = False
        self._pings = False  # it is fed by ioctl, else by writing
        self.counts_s = float(timeout_s)  # how long it really waits to be fed, as far as it says so
        self._resets_at_s = float("-inf")  # when it will reset the machine, if it is not fed again
        self._opened_at_s = self._due_s = clock.monotonic()
        self._after_s = FIRST_S

    def feed(self) -> None:
        """Keep it alive; open it before, if it is not open and due. Never raises; does nothing once closed."""
        if self._is_over or self._clock.monotonic() < self._due_s:
            return
        try:
            nature = self._open() if self._fd < 0 else None
            self._keep_alive()
        except LinkError as error:
            self._failed(str(error))
            return
        now_s = self._clock.monotonic()
        if nature:
            self._opened_at_s = now_s
            self._tell(nature)
        elif now_s - self._opened_at_s >= MOST_S:
            self._after_s = FIRST_S
        self._resets_at_s = now_s + self.counts_s

    def close(self, clean: bool) -> None:
        """Stop it, if *clean*, else leave it counting; never opened again. Never raises; again does nothing."""
        if self._is_over:
            return
        self._is_over = True
        try:
            if clean:
                self._stop()
        except LinkError as error:
            log.error("watchdog: %s; not stopped, it may reset the machine", error)
        self._release()

    def _open(self) -> _Nature:
        """Open and start it, and set its timeout; raises LinkUnavailable."""
        try:
            self._fd = self._calls.open(self._path)
            mode = self._calls.mode(self._fd)
        except OSError as error:
            raise LinkUnavailable(f"{self._name}: {plain_reason(error, _OPENING)}") from error
        except ValueError as error:
            raise LinkUnavailable(f"{self._name}: is a path that no file can have") from error
        if not (stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)):  # feeding a file would fill the disk
            raise LinkUnavailable(f"{self._name}: is a file or a disk and no watchdog")
        nature = self._examine(stat.S_ISCHR(mode))
        self._pings = bool((nature.options or 0) & KEEP_ALIVE_PING)
        self.counts_s = float(nature.timeout_s or self._timeout_s)
        self._resets_at_s = self._clock.monotonic() + self.counts_s  # it counts, whether feeding it works or not
        return nature

    def _examine(self, is_device: bool) -> _Nature:
        """Set the timeout first: it is counting; what a driver refuses is part of its nature."""
        timeout_s, refusal = self._set_timeout()
        options, identity = None, b""
        with contextlib.suppress(OSError):
            options, _, identity = SUPPORT.unpack(self._calls.ioctl(self._fd, GET_SUPPORT, bytes(SUPPORT.size)))
        self.reset_machine = bool((self._number(GET_BOOT_STATUS) or 0) & CARD_RESET)
        name = escaped(identity.partition(b"\0")[0].decode("latin-1"))
        return _Nature(name, options, timeout_s, refusal, is_device and self._is_nowayout())

    def _set_timeout(self) -> tuple[int | None, str]:
        """Return the timeout that it has now, as far as it says so, and why it is not the one asked for."""
        taken, refusal = None, ""
        try:
            (taken,) = NUMBER.unpack(self._calls.ioctl(self._fd, SET_TIMEOUT, NUMBER.pack(self._timeout_s)))
        except OSError as error:
            refusal = plain_reason(error, {})
        timeout_s = self._number(GET_TIMEOUT) or taken or 0
        return (timeout_s if timeout_s > 0 else None), refusal

    def _number(self, request: int) -> int | None:
        try:
            (number,) = NUMBER.unpack(self._calls.ioctl(self._fd, request, bytes(NUMBER.size)))
        except OSError:
            return None
        return int(number)

    def _is_nowayout(self) -> bool:
        """Whether it says that nothing stops it once it is started; "watchdog" is the old name of the first one."""
        try:
            name = self._path.resolve().name
            text = (self._classes / ("watchdog0" if name == "watchdog" else name) / "nowayout").read_text()
        except (OSError, ValueError):  # a kernel that does not show it
            return False
        return text.strip() == "1"

    def _keep_alive(self) -> None:
        """Raises LinkLost."""
        try:
            if self._pings:
                self._calls.ioctl(self._fd, KEEP_ALIVE, bytes(NUMBER.size))
            else:
                self._calls.write(self._fd, PLAIN)
        except OSError as error:
            raise LinkLost(f"{self._name}: {plain_reason(error, _FEEDING)}") from error

    def _tell(self, nature: _Nature) -> None:
        """Say what was opened and now is fed."""
        words, shortfall = nature.in_words(self._timeout_s), nature.shortfall(self._timeout_s)
        is_plain = not (self.trouble or shortfall or nature.remarks(self._timeout_s))
        level = logging.INFO if is_plain else logging.WARNING  # also when it is over what was told as an error
        self.trouble = f"{self._name}: {shortfall}" if shortfall else ""
        told = f"{self._name}: {words}" + (f"; {shortfall}" if shortfall else "")
        log.log(level, "watchdog: %s", told, extra=ABOUT)

    def _failed(self, reason: str) -> None:
        """Say so once, and wait longer each time; but while it counts, it is tried four times before it is too late."""
        self._release()
        level = logging.ERROR if reason != self.trouble else logging.DEBUG
        log.log(level, "watchdog: %s; trying again", reason, extra=ABOUT)
        self.trouble = reason
        now_s = self._clock.monotonic()
        most_s = self.counts_s / 4 if now_s < self._resets_at_s else MOST_S
        self._due_s = now_s + min(self._after_s, most_s)
        self._after_s = min(MOST_S, 2 * self._after_s)

    def _stop(self) -> None:
        """Write the magic character; one that was lost while it counts is looked for once more. Raises LinkError."""
        if self._fd < 0 and self._clock.monotonic() < self._resets_at_s:
            self._open()
        if self._fd < 0:
            return
        try:
            self._calls.write(self._fd, MAGIC)
        except OSError as error:
            raise LinkLost(f"{self._name}: {plain_reason(error, _FEEDING)}") from error

    def _release(self) -> None:
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with contextlib.suppress(OSError):  # it is gone, and the descriptor with it
                self._calls.close(fd)
