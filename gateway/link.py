"""A serial port, a TCP connection or a pty as one ``Link``, and the ``Waker`` that ends any wait on it.

What it is: the port layer (FreeMODBUS would say portserial and portevent): bytes to and from a non-blocking
descriptor; every wait is a ``select`` that ends with the bytes, the deadline or the waker.
What it refuses: framing, protocol, retries, reopening. It opens what it is told to, or says for a person why not.
Every failure is a ``LinkError``: ``LinkUnavailable`` or ``LinkSettingRefused`` at opening, ``LinkLost`` afterwards.
Source: spec sections 2 (ports, RS-485), 3 (TCP), 4 (speeds and formats), 7 (opening never hangs).
Threads: a link belongs to the thread that uses it; a waker is woken from anywhere. A name (never an address) is
looked up in a short-lived daemon thread, which may outlive its caller by the resolver's own timeout.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import math
import os
import select
import socket
import struct
import termios
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import serial
from serial.rs485 import RS485Settings

from gateway.clock import Clock
from gateway.errors import LinkError, LinkLost, LinkSettingRefused, LinkUnavailable

READ_BYTES = 8192
DISCARD_READS = 256  # a peer that never stops sending must not hold discard() for ever
ECHO_GRACE_S = 0.1
CLOSE_LIMIT_S = 1.0  # what takes longer to be sent is not waited for at closing
PIECE_S = 0.25  # of a wait in a write: each is a sign of life
SELECT_LIMIT = 1024  # FD_SETSIZE: select() knows no descriptor from here on

_PARITY_MASK = termios.PARENB | termios.PARODD
_DATA_BITS = {7: termios.CS7, 8: termios.CS8}
_PARITIES = {"none": 0, "even": termios.PARENB, "odd": _PARITY_MASK}
_STOP_BITS = {1: 0, 2: termios.CSTOPB}

_PORT_REASONS = {
    **dict.fromkeys((errno.ENOENT, errno.ENXIO, errno.ENODEV), "is not there"),
    errno.EACCES: "permission denied; add the user to group dialout",
    errno.EPERM: "not permitted: the service's unit has no DeviceAllow= for it",
    **dict.fromkeys((errno.EAGAIN, errno.EBUSY), "is used by another program"),  # EAGAIN: the lock
    **dict.fromkeys((errno.ENOTTY, errno.EISDIR), "is no serial port"),
    errno.EIO: "no serial hardware answers there",
}


def silence_s(baudrate: int, character_s: float) -> float:
    """Seconds of silence between RTU frames: 3.5 characters; 1.75 ms above 19200 baud (sections 2 and 4)."""
    return 0.00175 if baudrate > 19200 else 3.5 * character_s


def wait_ready(reading: Sequence[int], writing: Sequence[int], timeout_s: float | None) -> list[int]:
    """Return the descriptors that are ready, as soon as one is; [] after the timeout (None: no limit).

    ``select`` keeps microseconds. From descriptor 1024 on only ``poll`` is left, which rounds up to milliseconds.
    """
    timeout_s = None if timeout_s is None else max(0.0, timeout_s)
    if max((*reading, *writing), default=0) < SELECT_LIMIT:
        readable, writable, _ = select.select(reading, writing, (), timeout_s)
        return readable + writable
    poller = select.poll()
    for descriptor in (*reading, *writing):
        poller.register(descriptor, select.POLLIN if descriptor in reading else select.POLLOUT)
    return [ready for ready, _ in poller.poll(None if timeout_s is None else math.ceil(timeout_s * 1000))]


class Waker:
    """Ends a wait in another thread; remembers one wake until it is cleared.

    A wake is for one waiter, which clears it; the end is for all who wait, and stays. The lock keeps a late ``wake()``
    from writing into a descriptor that was closed and given to someone else. One thread can take it twice: a signal
    handler may interrupt a ``wake()`` with its own.
    """

    progress: Callable[[], object] = bool  # told, in the thread that waits, whenever a long write has got on by a piece

    def __init__(self) -> None:
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._end_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._lock = threading.RLock()
        self._waiters = 0  # in other threads, that need the descriptor of the end
        self._is_closing = False
        self.ended = False  # True: every wait ends at once, for good
        self.wakes = 0  # that have come and were cleared

    def end(self) -> None:
        """End the present wait and all that follow: the thread that waits is to stop. From any thread."""
        self.ended = True
        with self._lock:
            if self._end_fd >= 0:
                os.eventfd_write(self._end_fd, 1)
        self.wake()

    def wake(self) -> None:
        """End the present wait, or the next one; from any thread; does nothing once closed."""
        with self._lock, contextlib.suppress(BlockingIOError):
            if self._fd >= 0:
                os.eventfd_write(self._fd, 1)

    def fileno(self) -> int:
        """The descriptor that is readable while a wake is unread; -1 once closed."""
        return self._fd

    def clear(self) -> None:
        """Forget all wakes so far, but not an ``end``."""
        if self.ended:
            return
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._fd)
            self.wakes += 1

    def wait(self, timeout_s: float | None) -> bool:
        """True when woken, which is then cleared; False after *timeout_s* (None: no limit)."""
        woken = bool(wait_ready((self._fd,), (), timeout_s))
        if woken:
            self.clear()
        return woken

    def rest(self, timeout_s: float) -> bool:
        """``wait``, for a task that has nothing else to do; False if there was nothing to wait for either."""
        return self.wait(timeout_s) or timeout_s > 0.0

    def wait_for(self, reading: Sequence[int], writing: Sequence[int], timeout_s: float) -> list[int]:
        """``wait_ready`` that no wake ends, only the end: then []. For a thread that works for the one that waits."""
        with self._lock:
            if self.ended or self._is_closing:
                return []
            self._waiters += 1
        try:
            return [fd for fd in wait_ready((*reading, self._end_fd), writing, timeout_s) if fd != self._end_fd]
        finally:
            with self._lock:
                self._waiters -= 1
                self._close_end()

    def close(self) -> None:
        """Give the descriptors back; calling again does nothing."""
        with self._lock:
            self._is_closing = True
            if self._fd >= 0:
                os.close(self._fd)
                self._fd = -1
            self._close_end()

    def _close_end(self) -> None:
        """Nobody may wait on a number that was given to someone else meanwhile."""
        if self._is_closing and not self._waiters and self._end_fd >= 0:
            os.close(self._end_fd)
            self._end_fd = -1


class Link(Protocol):
    """Bytes to and from the other side; used by one thread alone."""

    character_s: float  # time of one character on the wire; 0.0 on TCP

    def read(self, timeout_s: float) -> bytes:
        """Return what has come as soon as anything has; b"" after *timeout_s* or when woken; LinkLost.

        The b"" that a wake causes clears it, and may come early: look at the clock. 0 never waits.
        """

    def write(self, data: bytes) -> None:
        """Hand over all of *data*, or raise LinkLost; a wake does not cut it short."""

    def discard(self) -> int:
        """Throw away what has come and was not read; return how many bytes. Never raises."""

    def close(self) -> None:
        """Close the link; calling again does nothing."""


@dataclass(eq=False)
class DescriptorLink:
    """A non-blocking descriptor as a ``Link``: serial ports, ptys, TCP connections, accepted ones as well."""

    name: str  # as errors call it: "/dev/ttyUSB0", "tcp 192.168.1.20:502"
    port: serial.Serial | socket.socket
    waker: Waker
    clock: Clock
    hangup: str  # what an end of file means to a person
    character_s: float = 0.0
    write_grace_s: float = 1.0  # beyond the time of the characters themselves

    def __post_init__(self) -> None:
        self._fd = self.port.fileno()

    def read(self, timeout_s: float) -> bytes:
        """Bytes go before a wake, which then ends the next read."""
        if self._fd < 0:
            raise LinkLost(f"{self.name}: is closed")
        ready = wait_ready((self._fd, self.waker.fileno()), (), timeout_s)
        if self._fd in ready:
            return self._take()
        if ready and timeout_s > 0:  # a look that does not wait leaves a wake to the wait it is meant for
            self.waker.clear()
        return b""

    def write(self, data: bytes) -> None:
        """Waits for room at most the time of the characters and ``write_grace_s``."""
        deadline = self.clock.monotonic() + len(data) * self.character_s + self.write_grace_s
        rest = memoryview(data)
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                remaining_s = deadline - self.clock.monotonic()
                if not self._pause(remaining_s, (self._fd,)):
                    raise LinkLost(f"{self.name}: does not take data") from None
            except OSError as error:
                raise self._lost(error) from error

    def _pause(self, seconds: float, writing: Sequence[int] = ()) -> bool:
        """Wait for one of *writing*, in pieces, each of which is progress; False when the time is over."""
        until_s = self.clock.monotonic() + seconds
        while (left_s := until_s - self.clock.monotonic()) > 0:
            if wait_ready((), writing, min(left_s, PIECE_S)):
                return True
            self.waker.progress()
        return False

    def discard(self) -> int:
        """A link found lost here shows at the next read or write."""
        count = 0
        with contextlib.suppress(LinkLost):
            for data in itertools.islice(iter(self._take, b""), DISCARD_READS):
                count += len(data)
        return count

    def close(self) -> None:
        """Also after a loss: it gives the descriptor back."""
        self._fd = -1
        self.port.close()

    def _take(self) -> bytes:
        """What is there now, b"" if nothing; an end of file is a loss (VMIN is 1: so it is on serial ports)."""
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._lost(error) from error
        if not data:
            raise LinkLost(f"{self.name}: {self.hangup}")
        return data

    def _lost(self, error: BaseException) -> LinkLost:
        return LinkLost(f"{self.name}: {plain_reason(error, {})}")


@dataclass(eq=False, kw_only=True)
class RtsLink(DescriptorLink):
    """A serial link whose RS-485 driver is switched by RTS: on to send, off to listen (section 2)."""

    switch: Callable[[bool], None]  # sets RTS; OSError when the port is gone
    before_s: float
    after_s: float

    def write(self, data: bytes) -> None:
        """Returns once the last bit has left, by the kernel's word and by the time it takes, and RTS is off again."""
        try:
            self.switch(True)
            try:
                self._pause(self.before_s)
                ends_at = self.clock.monotonic() + len(data) * self.character_s
                super().write(data)
                self._pause(ends_at - self.clock.monotonic())  # what is left for the driver is short
                with contextlib.suppress(termios.error):  # a signal; or a lost port, which shows below
                    termios.tcdrain(self._fd)
                self._pause(ends_at - self.clock.monotonic() + self.after_s)
            finally:
                self.switch(False)
        except OSError as error:
            raise self._lost(error) from error


class EchoLink:
    """A serial link that hears itself: what was written comes back first and is taken away (section 2).

    What comes back is held until it is the whole echo, then dropped. If it differs, or has not come within its time
    and 0.1 s, ``echo_errors`` counts one and everything held is passed on: nothing is lost without a comparison.
    """

    def __init__(self, link: Link, clock: Clock) -> None:
        self.character_s = link.character_s
        self.close = link.close
        self.echo_errors = 0
        self._link, self._clock = link, clock
        self._expected = self._held = b""
        self._due_at = 0.0

    def read(self, timeout_s: float) -> bytes:
        """An echo that stays out ends the wait early, with b"" or what is held."""
        deadline = self._clock.monotonic() + timeout_s
        while True:
            until = min(deadline, self._due_at) if self._expected else deadline
            data = self._link.read(until - self._clock.monotonic())
            passed = self._without_echo(data)
            if passed or not data:
                return passed

    def write(self, data: bytes) -> None:
        """The echo of an earlier write may still be unread."""
        self._expected += data
        self._link.write(data)
        self._due_at = self._clock.monotonic() + len(data) * self.character_s + ECHO_GRACE_S

    def discard(self) -> int:
        """Echoes still awaited are awaited no longer."""
        count = len(self._held) + self._link.discard()
        self._expected = self._held = b""
        return count

    def _without_echo(self, data: bytes) -> bytes:
        """What of *data* (b"": nothing came in time) and of the held bytes is for the reader."""
        if not self._expected:
            return data
        self._held += data
        whole = self._held.startswith(self._expected)
        late = not data and self._clock.monotonic() >= self._due_at
        if not (whole or late) and self._expected.startswith(self._held):
            return b""
        self.echo_errors += not whole
        passed = self._held[len(self._expected) :] if whole else self._held
        self._expected = self._held = b""
        return passed


@dataclass(frozen=True)
class SerialSettings:
    """A serial port as it should be; words and numbers as in the configuration."""

    device: str
    baudrate: int = 19200
    parity: str = "even"  # "none", "even", "odd"
    data_bits: int = 8  # 7, 8
    stop_bits: int = 1  # 1, 2
    rs485: str = "none"  # "none", "kernel", "rts"
    rts_before_s: float = 0.0
    rts_after_s: float = 0.0
    discard_echo: bool = False
    mark_errors: bool = False  # a damaged character X comes as FF 00 X, a break as FF 00 00, a real FF as FF FF

    @property
    def character_s(self) -> float:
        """Seconds that one character takes: start bit, data, parity, stop bits."""
        return (1 + self.data_bits + (self.parity != "none") + self.stop_bits) / self.baudrate


class _ExclusivePort(serial.Serial):
    """A port for this program alone: by pyserial's lock, and by the kernel for programs that ask for no lock.

    Root opens it all the same. The kernel's word lasts until the last holder has closed the port, and so beyond us.
    """

    character_s = 0.0  # on the wire

    def open(self) -> None:
        super().open()
        self._tell_kernel(termios.TIOCEXCL)

    def close(self) -> None:
        self._tell_kernel(termios.TIOCNXCL)
        self._drop_unsent()
        super().close()

    def _drop_unsent(self) -> None:
        """The kernel would wait for it to be sent, up to half a minute; a stop may not (section 7)."""
        with contextlib.suppress(OSError, termios.error):  # a port that is gone
            (unsent,) = struct.unpack("i", fcntl.ioctl(self.fileno(), termios.TIOCOUTQ, bytes(4)))
            if unsent * self.character_s > CLOSE_LIMIT_S:
                termios.tcflush(self.fileno(), termios.TCOFLUSH)

    def _tell_kernel(self, request: int) -> None:
        with contextlib.suppress(OSError):  # a driver without it, or a port that is gone
            fcntl.ioctl(self.fileno(), request)


def open_serial(settings: SerialSettings, waker: Waker, clock: Clock) -> Link:
    """Open the port for this program alone, set it up, and forget what had come before.

    raises: LinkUnavailable (missing, no permission, busy), LinkSettingRefused (it cannot do what is asked).
    """
    port = _ExclusivePort(timeout=0, exclusive=True)  # opens with O_NONBLOCK: no wait for a carrier
    try:
        port.port = settings.device
        port.rts = settings.rs485 == "none"  # the kernel raises RTS at opening: drive an RS-485 pair no longer
        port.open()
        _set_rs485(port, settings)
        _set_format(port.fileno(), settings)
        with contextlib.suppress(ValueError, OSError, NotImplementedError):
            port.set_low_latency_mode(True)
        termios.tcflush(port.fileno(), termios.TCIOFLUSH)
    except LinkError:
        port.close()
        raise
    except (OSError, termios.error, ValueError) as error:  # all that pyserial lets out
        port.close()
        raise LinkUnavailable(f"{settings.device}: {plain_reason(error, _PORT_REASONS)}") from error
    port.character_s = settings.character_s
    shared = (settings.device, port, waker, clock, "is gone (unplugged?)", settings.character_s)
    link = DescriptorLink(*shared)
    if settings.rs485 == "rts":
        before_s, after_s = settings.rts_before_s, settings.rts_after_s
        link = RtsLink(*shared, switch=lambda on: setattr(port, "rts", on), before_s=before_s, after_s=after_s)
    return EchoLink(link, clock) if settings.discard_echo else link


def _set_rs485(port: serial.Serial, settings: SerialSettings) -> None:
    """Ask for the direction switching; comes before the format, which pyserial sets once more here."""
    try:
        if settings.rs485 == "kernel":
            before_s, after_s = _kernel_delay_s(settings.rts_before_s), _kernel_delay_s(settings.rts_after_s)
            port.rs485_mode = RS485Settings(delay_before_tx=before_s, delay_before_rx=after_s)
        elif settings.rs485 == "rts":
            port.rts = False  # pyserial forgave a port without RTS at opening; here it shows
    except (OSError, ValueError) as error:
        what, other = ("RTS line", "kernel") if settings.rs485 == "rts" else ("kernel RS-485 mode", "rts")
        advice = f'use rs485 = "{other}" or an adapter that switches by itself'
        raise LinkSettingRefused(f"{settings.device} has no {what}; {advice}") from error


def _kernel_delay_s(delay_s: float) -> float:
    """*delay_s* in whole ms, rounded up; and half a ms more, which pyserial cuts off, but never a whole one."""
    return (math.ceil(round(delay_s * 1000, 6)) + 0.5) / 1000


def _set_format(fd: int, settings: SerialSettings) -> None:
    """Set speed and format, raw, and read them back: a driver keeps what it cannot change and says nothing.

    The C library complains (EINVAL) only if nothing at all could be changed; reading back covers that, too.
    """
    speed = getattr(termios, f"B{settings.baudrate}", 0)  # 0 also for B0, which would hang up
    size, parity = _DATA_BITS.get(settings.data_bits), _PARITIES.get(settings.parity)
    stop = _STOP_BITS.get(settings.stop_bits)
    wanted = termios.tcgetattr(fd)
    wanted[0] = wanted[1] = wanted[3] = 0  # raw: no flow control, no translation, no echo
    wanted[0] |= termios.INPCK | termios.PARMRK if settings.mark_errors else 0
    wanted[2] &= ~(termios.CSIZE | termios.CSTOPB | _PARITY_MASK)
    wanted[2] |= (size or termios.CS8) | (parity or 0) | (stop or 0)
    wanted[4] = wanted[5] = speed or wanted[5]
    wanted[6][termios.VMIN] = 1  # with 0, nothing to read would look like an end of file
    with contextlib.suppress(termios.error):
        termios.tcsetattr(fd, termios.TCSANOW, wanted)
    _, _, flags, _, _, got_speed, _ = termios.tcgetattr(fd)
    taken = {
        f"{settings.baudrate} baud": got_speed == speed != 0,
        f"{settings.data_bits} data bits": flags & termios.CSIZE == size,
        f"{settings.parity} parity": flags & _PARITY_MASK == parity,
        f"{settings.stop_bits} stop bits": flags & termios.CSTOPB == stop,
    }
    refused = " and ".join(what for what, done in taken.items() if not done)
    if refused:
        hint = "; a pty takes 8N1 only" if str(Path(settings.device).resolve()).startswith("/dev/pts/") else ""
        raise LinkSettingRefused(f"{settings.device} cannot do {refused}{hint}")


def _code(error: BaseException | None) -> int:
    """The errno in an OSError, a termios.error, or a pyserial error that only quotes one; 0 if there is none."""
    if isinstance(error, termios.error):
        return int(error.args[0])
    return error.errno or _code(error.__context__) if isinstance(error, OSError) else 0


def plain_reason(error: BaseException, reasons: Mapping[int, str]) -> str:
    """The reason alone, without number and path: from *reasons*, else as the system words it."""
    code = _code(error)
    return reasons.get(code) or (os.strerror(code).lower() if code else str(error))
