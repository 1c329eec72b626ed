"""TCP connections and listening sockets, as links like any other (section 4; `link.py` has the rest of the port layer).

Name look-ups run in a thread of their own, so that a slow resolver holds up nobody. No OSError leaves this file.

Threads: none of its own but the resolver's; whoever calls waits, and a waker's end ends the wait.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import ipaddress
import os
import socket
import threading
from collections.abc import Sequence

from gateway.clock import Clock
from gateway.errors import LinkUnavailable
from gateway.link import DescriptorLink, Link, Waker, plain_reason

_TCP_OPTIONS = {socket.TCP_NODELAY: 1, socket.TCP_USER_TIMEOUT: 30_000}  # ms
_TCP_OPTIONS |= {socket.TCP_KEEPIDLE: 30, socket.TCP_KEEPINTVL: 10, socket.TCP_KEEPCNT: 3}  # s, s, probes
_LISTEN_REASONS = {
    errno.EACCES: "permission denied (ports below 1024 need CAP_NET_BIND_SERVICE, which the service has)",
    errno.EADDRNOTAVAIL: "this machine does not have this address",
}

NAME_LIMIT_S = 60.0  # for the look-up of a name (section 7)

_Address = tuple[socket.AddressFamily, socket.SocketKind, int, str, tuple[str | int | bytes, ...]]


def set_tcp_options(connection: socket.socket) -> None:
    """Make a connection, ours or accepted, non-blocking, prompt, and sure to notice a dead peer in a minute."""
    connection.setblocking(False)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _TCP_OPTIONS.items():
        connection.setsockopt(socket.IPPROTO_TCP, option, value)


def is_allowed(host: str, networks: Sequence[str]) -> bool:
    """Whether *host*, in digits, is in one of *networks*; in any case if there are none."""
    address = ipaddress.ip_address(host.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped:
        address = address.ipv4_mapped
    return not networks or any(address in ipaddress.ip_network(network) for network in networks)


def connect_tcp(
    host: str, port: int, waker: Waker, clock: Clock, timeout_s: float, name_limit_s: float = NAME_LIMIT_S
) -> Link:
    """Connect to a device; every address of a name gets its share of *timeout_s*.

    A wake does not stop it, only the waker's end. The name itself is looked up within *name_limit_s*.
    raises: LinkUnavailable: refused, no answer in time, name not known, or ended by the waker.
    """
    name = _tcp_name(host, port)
    addresses = _addresses(name, host, port, waker, name_limit_s)
    deadline = clock.monotonic() + timeout_s
    reasons, reason = {errno.ETIMEDOUT: f"no answer within {timeout_s:g} s"}, ""
    for tried, address in enumerate(addresses):
        share_s = (deadline - clock.monotonic()) / (len(addresses) - tried)
        try:
            connection = _connect(name, address, waker, share_s)
        except OSError as error:
            reason = plain_reason(error, reasons)
        else:
            return DescriptorLink(name, connection, waker, clock, "closed by the other side")
    raise LinkUnavailable(f"{name}: {reason}")


def _connect(name: str, address: _Address, waker: Waker, timeout_s: float) -> socket.socket:
    """One attempt; OSError says why it failed, ETIMEDOUT that nobody answered."""
    family, *_, where = address
    connection = socket.socket(family, socket.SOCK_STREAM)
    try:
        set_tcp_options(connection)
        code = connection.connect_ex(where)
        if code == errno.EINPROGRESS:
            ready = _wait_unless_ended(name, waker, (), (connection.fileno(),), timeout_s)
            code = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) if ready else errno.ETIMEDOUT
        if code:
            raise OSError(code, os.strerror(code))
    except BaseException:
        connection.close()
        raise
    return connection


def _wait_unless_ended(
    name: str, waker: Waker, reading: Sequence[int], writing: Sequence[int], timeout_s: float
) -> list[int]:
    """``wait_ready`` that a wake does not end, only the waker's end."""
    ready = waker.wait_for(reading, writing, max(0.0, timeout_s))
    if waker.ended:
        raise LinkUnavailable(f"{name}: interrupted")
    return ready


def listen_tcp(host: str, port: int, waker: Waker | None = None) -> socket.socket:
    """Return a non-blocking listening socket; port 0 lets the system choose one; "::" is IPv6 alone,
    so that clients' addresses stay plain for lists of networks.

    raises: LinkUnavailable: in use, no permission, not an address of this machine.
    """
    name = _tcp_name(host, port)
    with contextlib.closing(Waker()) as never_ended:
        family, *_, where = _addresses(name, host, port, waker or never_ended, NAME_LIMIT_S)[0]
    try:
        listener = socket.create_server(where, family=family, backlog=128)  # SO_REUSEADDR, IPV6_V6ONLY
    except OSError as error:
        raise LinkUnavailable(f"{name}: {plain_reason(error, _LISTEN_REASONS)}") from error
    listener.setblocking(False)
    return listener


def _tcp_name(host: str, port: int) -> str:
    return f"tcp [{host}]:{port}" if ":" in host else f"tcp {host}:{port}"


def _addresses(name: str, host: str, port: int, waker: Waker, limit_s: float) -> Sequence[_Address]:
    """All addresses of *host*: at once if it is written in digits, else from the resolver.

    The resolver is asked in a thread of its own, so that it delays neither the timeout nor a stop. That thread owns
    one end of a pipe and says "done" by closing it: it never touches a descriptor of ours.
    """
    resolve = functools.partial(socket.getaddrinfo, host, port, type=socket.SOCK_STREAM)
    with contextlib.suppress(OSError, ValueError):  # ValueError: it cannot even be a name
        return resolve(flags=socket.AI_NUMERICHOST)
    found: list[_Address] = []
    done, asking = os.pipe()

    def ask() -> None:
        try:
            with contextlib.suppress(OSError, ValueError):
                found.extend(resolve())
        finally:
            os.close(asking)

    threading.Thread(target=ask, name="resolver", daemon=True).start()
    try:
        ready = _wait_unless_ended(name, waker, (done,), (), limit_s)
    finally:
        os.close(done)
    if not ready:
        raise LinkUnavailable(f"{name}: no name server answers within {limit_s:g} s")
    if not found:
        raise LinkUnavailable(f"{name}: name is not known, or its name server does not answer")
    return found
