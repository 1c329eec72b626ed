"""What systemd is told: ready, reloading, stopping, a status worth reading, and that the gateway is alive.

What it is: the sd_notify protocol, each message one datagram to the socket that NOTIFY_SOCKET names, and the service
watchdog that WATCHDOG_USEC asks for. Without NOTIFY_SOCKET every call does nothing. What cannot be sent now (systemd is
busy, or makes itself anew) is kept and sent by a later call; the log hears of it once per change.
What it refuses: to wait, to raise, to decide whether the gateway is alive. Addresses of virtual machines (vsock:) are
not supported. The environment stays as it is, for a program that executes itself.
Source: spec section 7; sd_notify(3), sd_watchdog_enabled(3).
Threads: the main one.
"""

from __future__ import annotations

import errno
import logging
import os
import socket
from collections import deque
from collections.abc import Mapping
from typing import Final

from gateway.clock import Clock
from gateway.config_fields import escaped
from gateway.link import plain_reason
from gateway.plain_text import cut, printable

STATUS_PACE_S: Final = 5.0  # at least, between two statuses
STATUS_CHARACTERS: Final = 200
RETRY_S: Final = 1.0  # at most, until what could not be sent is tried again
LONG_S: Final = 3600.0
STATES_KEPT: Final = 8  # unsent, newest; more only pile up while nobody listens
LONGEST_PATH: Final = 107  # bytes; unix(7)

_FOREVER_USEC: Final = 2**64 - 1
_REASONS: Final = {
    errno.EAGAIN: "its queue is full",
    errno.ECONNREFUSED: "nobody listens",
    errno.ENOENT: "its socket is not there",
}

log = logging.getLogger(__name__)


class Systemd:
    """The service manager, as far as it listens."""

    def __init__(self, address: bytes, watchdog_s: float | None, clock: Clock) -> None:
        """*address* as in bind(2), b"": nobody listens; *watchdog_s* without WATCHDOG=1 end us, None: never."""
        self._address = address
        self._watchdog_s = watchdog_s if address else None
        self._clock = clock
        self._socket: socket.socket | None = None
        self._trouble = ""
        self._states: deque[str] = deque(maxlen=STATES_KEPT)
        self._status = self._told_status = ""
        self._status_due_s = self._feed_due_s = clock.monotonic()
        self._retry_s = min(RETRY_S, (watchdog_s or LONG_S) / 12)

    @classmethod
    def from_environment(cls, clock: Clock, environ: Mapping[str, str] = os.environ) -> Systemd:
        """What cannot be used of *environ* is logged and ignored."""
        address = _address(environ.get("NOTIFY_SOCKET", ""))
        return cls(address, _watchdog_s(environ) if address else None, clock)  # unheard, it is not worth a warning

    def ready(self) -> None:
        """Everything runs: after the start, and after reloading."""
        self._tell("READY=1")

    def reloading(self) -> None:
        """The configuration is being loaded anew; ``ready`` ends it."""
        self._tell(f"RELOADING=1\nMONOTONIC_USEC={int(self._clock.monotonic() * 1_000_000)}")

    def stopping(self) -> None:
        """The program ends. Not before it executes itself: systemd would wait for its end, and bring it about."""
        self._tell("STOPPING=1")

    def status(self, text: str) -> None:
        """Show *text*, one line, to whoever asks systemd; sent when it is another one, and at a pace of its own."""
        if self._address:
            self._status = cut(printable(text), STATUS_CHARACTERS)
            self._send_what_waits()

    def feed(self) -> float:
        """Say that all is well, if it is time to, and send what could not be sent before.

        returns: seconds until it wants to be called again; called then, it feeds each third of the watchdog's time.
        """
        self._send_what_waits()
        now_s = self._clock.monotonic()
        if self._watchdog_s and now_s >= self._feed_due_s and self._sends("WATCHDOG=1"):
            self._feed_due_s = now_s + self._watchdog_s / 3
        due_s = [now_s + LONG_S]
        due_s += [self._feed_due_s] if self._watchdog_s else []
        due_s += [self._status_due_s] if self._status != self._told_status else []
        due_s += [now_s] if self._states else []
        return min(due_s) - now_s if min(due_s) > now_s else self._retry_s

    def close(self) -> None:
        """Tell nothing any more; again does nothing."""
        self._address, self._watchdog_s = b"", None
        self._states.clear()
        self._status = self._told_status
        if self._socket:
            self._socket.close()
            self._socket = None

    def _tell(self, state: str) -> None:
        """Send *state*, and a status that waits with it: it may be the last."""
        if self._address:
            self._states.append(state)
            self._status_due_s = self._clock.monotonic()
            self._send_what_waits()

    def _send_what_waits(self) -> None:
        while self._states and self._sends(self._states[0]):
            self._states.popleft()
        now_s = self._clock.monotonic()
        is_due = self._status != self._told_status and now_s >= self._status_due_s
        if is_due and self._sends(f"STATUS={self._status}"):
            self._told_status, self._status_due_s = self._status, now_s + STATUS_PACE_S

    def _sends(self, message: str) -> bool:
        """Return whether *message* is sent now."""
        try:
            if not self._socket:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.sendto(message.encode(), socket.MSG_DONTWAIT, self._address)
        except OSError as error:
            self._found(plain_reason(error, _REASONS))
            return False
        self._found("")
        return True

    def _found(self, trouble: str) -> None:
        """Say whether systemd can be told anything, when that has changed."""
        if trouble == self._trouble:
            return
        if trouble:
            log.warning("systemd: cannot be told anything: %s; trying again", trouble, extra={"about": "systemd"})
        else:
            log.info("systemd: can be told again", extra={"about": "systemd"})
        self._trouble = trouble


def _address(text: str) -> bytes:
    """Return where to send to, as bind(2) has it; b"": nowhere."""
    raw = os.fsencode(text)
    if not raw:
        return b""
    if text.startswith("vsock"):
        log.warning("systemd: NOTIFY_SOCKET=%s: only sockets of this machine are supported", escaped(text))
        return b""
    is_abstract = text.startswith("@")
    if not text.startswith(("/", "@")) or not 1 < len(raw) <= LONGEST_PATH + is_abstract:
        log.warning("systemd: NOTIFY_SOCKET=%s: is no socket's address", escaped(text))
        return b""
    return b"\0" + raw[1:] if is_abstract else raw


def _watchdog_s(environ: Mapping[str, str]) -> float | None:
    """Return after how many seconds without WATCHDOG=1 systemd ends this very process; None: never."""
    text = environ.get("WATCHDOG_USEC", "")
    if not text:
        return None
    usec = _number(text)
    if not 0 < usec < _FOREVER_USEC:
        log.warning("systemd: WATCHDOG_USEC=%s: is no number of microseconds", escaped(text))
        return None
    for_whom = environ.get("WATCHDOG_PID", "")
    if for_whom and not _number(for_whom):  # food nobody asked for does no harm, and a lack of it would end us
        log.warning("systemd: WATCHDOG_PID=%s: is no process's number", escaped(for_whom))
    elif for_whom and _number(for_whom) != os.getpid():
        return None
    return usec / 1_000_000


def _number(text: str) -> int:
    """Return the number that *text* is, at most 20 digits and nothing else; 0 if it is none."""
    return int(text) if len(text) <= 20 and text.isascii() and text.isdigit() else 0
