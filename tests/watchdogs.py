"""A watchdog device without hardware, which behaves as the core of Linux's watchdog drivers does.

Source: Linux, drivers/watchdog/watchdog_dev.c (open, ioctl, write, release); its numbers are written down here once
more, from linux/watchdog.h as a C compiler shows them on this kind of machine.
"""

from __future__ import annotations

import errno
import math
import os
import stat
import struct
from dataclasses import dataclass, field
from pathlib import Path

from tests.fakes import JumpingClock

GET_SUPPORT, GET_BOOT_STATUS, KEEP_ALIVE = 0x80285700, 0x80045702, 0x80045705
SET_TIMEOUT, GET_TIMEOUT = 0xC0045706, 0x80045707
CARD_RESET, TAKES_TIMEOUT, MAGIC_CLOSE, ALARM_ONLY, PING = 0x20, 0x80, 0x100, 0x400, 0x8000
USUAL = TAKES_TIMEOUT | MAGIC_CLOSE | PING
FIRST_FD = 1000


@dataclass
class KernelWatchdog:
    """One device and its driver; ``DeviceCalls`` for what is under test, the rest for the test."""

    clock: JumpingClock
    identity: bytes = b"i6300ESB timer"
    options: int = USUAL
    own_timeout_s: int = 60  # before any is set
    least_s: int = 1
    most_s: int = 3600
    step_s: int = 1  # what the hardware counts in
    knows_timeout: bool = True
    boot_status: int = 0
    nowayout: bool = False
    has_ioctls: bool = True
    kind: int = stat.S_IFCHR
    open_error: int = 0  # errno of every open, write and ioctl: the device is not there, or not ours
    feed_error: int = 0
    stop_error: int = 0  # errno of writing V
    opens: list[float] = field(default_factory=list)  # when each attempt was made
    written: bytes = b""
    pings: int = 0
    requests: list[int] = field(default_factory=list)
    open_fds: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.timeout_s = self.own_timeout_s
        self.resets_at_s = math.inf
        self._may_stop = False
        self._last_fd = FIRST_FD

    @property
    def is_counting(self) -> bool:
        return self.resets_at_s < math.inf

    @property
    def has_reset_machine(self) -> bool:
        return self.clock.monotonic() >= self.resets_at_s

    def open(self, path: Path) -> int:
        self.opens.append(self.clock.monotonic())
        if self.open_error:
            raise OSError(self.open_error, os.strerror(self.open_error))
        if self.open_fds:
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
        self._last_fd += 1
        self.open_fds.add(self._last_fd)
        if not self.is_counting:  # one that counts already is not fed by being opened
            self._ping()
        return self._last_fd

    def mode(self, fd: int) -> int:
        assert fd in self.open_fds
        return self.kind | 0o600

    def ioctl(self, fd: int, request: int, argument: bytes) -> bytes:
        assert fd in self.open_fds
        self.requests.append(request)
        if not self.has_ioctls:
            raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
        if request == GET_SUPPORT:
            return struct.pack("=II32s", self.options, 0, self.identity)
        if request == GET_BOOT_STATUS:
            return struct.pack("=i", self.boot_status)
        if request == KEEP_ALIVE:
            return self._keep_alive()
        assert request in (SET_TIMEOUT, GET_TIMEOUT), f"unknown request {request:#x}"
        if request == SET_TIMEOUT:
            self._set_timeout(*struct.unpack("=i", argument))
        if not self.knows_timeout:
            raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))
        return struct.pack("=i", self.timeout_s)

    def write(self, fd: int, data: bytes) -> int:
        assert fd in self.open_fds
        error = self.stop_error if data == b"V" and self.stop_error else self.feed_error
        if error:
            raise OSError(error, os.strerror(error))
        self.written += data
        self._may_stop = b"V" in data
        self._ping()
        return len(data)

    def close(self, fd: int) -> None:
        self.open_fds.remove(fd)
        wants_stop, self._may_stop = self._may_stop or not self.options & MAGIC_CLOSE, False
        if wants_stop and not self.nowayout:
            self.resets_at_s = math.inf
        elif not self.feed_error:
            self._ping()
        if self.feed_error == errno.ENODEV:  # the kernel says so, and the descriptor is gone all the same
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    def pass_fed(self, seconds: int, feed: object) -> None:
        """Let *seconds* pass, with a feeding at the end of each."""
        assert callable(feed)
        for _ in range(seconds):
            self.clock.pass_s(1.0)
            assert not self.has_reset_machine, f"reset at {self.clock.monotonic()}"
            feed()

    def _keep_alive(self) -> bytes:
        error = self.feed_error or (0 if self.options & PING else errno.EOPNOTSUPP)
        if error:
            raise OSError(error, os.strerror(error))
        self._ping()
        return bytes(4)

    def _set_timeout(self, timeout_s: int) -> None:
        if not self.options & TAKES_TIMEOUT:
            raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))
        if not self.least_s <= timeout_s <= self.most_s:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        self.timeout_s = -(-timeout_s // self.step_s) * self.step_s
        if self.feed_error:
            raise OSError(self.feed_error, os.strerror(self.feed_error))
        self._ping()

    def _ping(self) -> None:
        self.pings += 1
        self.resets_at_s = self.clock.monotonic() + self.timeout_s
