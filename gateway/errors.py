"""Every exception that rtugate raises on purpose, as one tree.

    GatewayError
    ├── ConfigError             the configuration cannot be used; carries every finding
    ├── SaveError               a file is not written; says why, and what to do
    │   └── FileChanged         it says something else than when it was read
    ├── HistoryError            a kept version cannot be read
    ├── RequestInvalid          a request that must not be sent or stored: caller's mistake
    │   ├── PointsOutOfRange    points that the register does not have
    │   └── PointUnknown        part of a point is to be sent whose value nobody knows
    ├── RequestRefused          a request that came to us is answered with an exception code
    ├── QueueFull               a command queue has no room: the write is refused whole
    ├── DeviceRefused           the device answered with an exception code
    ├── ReplyMismatch           the reply does not answer the request that was sent
    └── LinkError               the line itself
        ├── LinkUnavailable     port missing, connection refused, address in use
        ├── LinkSettingRefused  the port is there but cannot do what is asked of it
        └── LinkLost            it was open and is gone

Anything else that is raised is a bug: it ends its task, and the supervisor sees it.
"""

from __future__ import annotations

from collections.abc import Sequence


class GatewayError(Exception):
    """The root: whoever catches this catches everything deliberate and no bug."""


class ConfigError(GatewayError):
    """The configuration cannot be used; every *finding* is a line for a person (see ``store``)."""

    def __init__(self, findings: Sequence[object]) -> None:
        super().__init__("\n".join(str(finding) for finding in findings))
        self.findings = tuple(findings)


class SaveError(GatewayError):
    """A file could not be written; the text says which, why and what helps, for a person."""


class FileChanged(SaveError):
    """The file says something else than it did when it was read: reload it, write over it, or leave it."""


class HistoryError(GatewayError):
    """A version that was kept cannot be listed or read; the text says which and why."""


class RequestInvalid(GatewayError, ValueError):
    """A request outside the limits of the protocol or of the register; nothing was sent."""


class PointsOutOfRange(RequestInvalid):
    """Points that the register's table does not have."""


class PointUnknown(RequestInvalid):
    """Part of a point is to be changed and sent to a device, and nobody knows the rest of its value."""


class RequestRefused(GatewayError):
    """A request to us that earns exception *code* (application protocol V1.1b3, section 7)."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


class QueueFull(GatewayError):
    """No room for one more command; nothing was stored and nothing will be sent."""


class DeviceRefused(GatewayError):
    """The device answered with exception *code* (application protocol V1.1b3, section 7)."""

    def __init__(self, code: int) -> None:
        super().__init__(f"the device answered with exception {code}")
        self.code = code


class ReplyMismatch(GatewayError):
    """A whole, undamaged reply that answers another question than the one asked."""


class LinkError(GatewayError):
    """A line that cannot be used; the text says which and why, for a person."""


class LinkUnavailable(LinkError):
    """The port is missing or busy, the connection was refused, the address is in use."""


class LinkSettingRefused(LinkError):
    """The port exists but cannot do what is asked: parity on a pty, a speed, RS-485."""


class LinkLost(LinkError):
    """The port or connection was open and is gone: unplugged, closed by the other side."""
