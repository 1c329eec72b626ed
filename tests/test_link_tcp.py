"""TCP links on real sockets: 127.0.0.1, ::1 where there is one, and peers that refuse, hang up or say nothing.

The resolver's answers are the machine's own, but for one test of a resolver that takes its time.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import resource
import select
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gateway import link_tcp as ports
from gateway.clock import SystemClock
from gateway.errors import LinkError, LinkLost, LinkUnavailable
from gateway.link import DescriptorLink, Link, Waker

CLOCK = SystemClock()
PATIENCE_S = 5.0  # for what must happen; a test that needs it has failed
POLL = bytes.fromhex("00 01 00 00 00 06 01 03 00 6B 00 03")  # transaction 1, unit 1, read 3 registers from 107
REPLY = bytes.fromhex("00 01 00 00 00 09 01 03 06 02 2B 00 00 00 64")
NOBODY = 65534


@pytest.fixture
def waker() -> Iterator[Waker]:
    with contextlib.closing(Waker()) as made:
        yield made


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with ports.listen_tcp("127.0.0.1", 0) as made:
        yield made


@pytest.fixture
def connection(listener: socket.socket, waker: Waker) -> Iterator[tuple[DescriptorLink, socket.socket]]:
    with contextlib.closing(ports.connect_tcp("127.0.0.1", port_of(listener), waker, CLOCK, PATIENCE_S)) as link:
        assert isinstance(link, DescriptorLink)
        listener.setblocking(True)
        peer, _ = listener.accept()
        with peer:
            yield link, peer


def port_of(listener: socket.socket) -> int:
    return int(listener.getsockname()[1])


def a_free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return port_of(taken)


def seconds(doing: Callable[[], object]) -> float:
    started = CLOCK.monotonic()
    doing()
    return CLOCK.monotonic() - started


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.fixture
def full_listener() -> Iterator[socket.socket]:
    """Takes no more connections: a new one gets no answer at all, as from a device that is switched off."""
    with contextlib.ExitStack() as opened:
        made = opened.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
        for _ in range(4):
            waiting = opened.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(made.getsockname())
            if not select.select([], [waiting], [], 0.2)[1]:
                break
        yield made


def test_bytes_go_before_a_wake_and_the_wake_is_not_lost(
    connection: tuple[DescriptorLink, socket.socket], waker: Waker
) -> None:
    link, peer = connection
    peer.sendall(REPLY)
    select.select([link.port], [], [], PATIENCE_S)
    waker.wake()
    assert link.read(PATIENCE_S) == REPLY
    assert seconds(lambda: link.read(PATIENCE_S)) < PATIENCE_S / 2
    assert not waker.wait(0)


def test_discard_ends_although_the_peer_never_stops(connection: tuple[DescriptorLink, socket.socket]) -> None:
    link, peer = connection
    stopped = threading.Event()

    def flood() -> None:
        with contextlib.suppress(OSError):
            while not stopped.is_set():
                peer.send(bytes(65536))

    thread = threading.Thread(target=flood)
    thread.start()
    link.read(PATIENCE_S)
    assert seconds(link.discard) < PATIENCE_S
    stopped.set()
    link.close()
    thread.join()


@pytest.mark.parametrize("number", [0, 1100])
def test_a_peer_that_does_not_read_loses_the_link_within_the_limit(
    connection: tuple[DescriptorLink, socket.socket], waker: Waker, number: int
) -> None:
    """Also with descriptors that ``select`` does not take."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if number >= hard:
        pytest.skip("no such descriptors here")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2 * number), hard))
    again = socket.socket(fileno=fcntl.fcntl(connection[0].port, fcntl.F_DUPFD_CLOEXEC, number))
    with contextlib.closing(DescriptorLink("tcp far", again, waker, CLOCK, "closed", write_grace_s=0.1)) as link:
        assert link.read(0.01) == b""
        connection[1].sendall(REPLY)
        assert link.read(PATIENCE_S) == REPLY
        with pytest.raises(LinkLost, match=r"^tcp far: does not take data$"):
            link.write(bytes(50_000_000))
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_slow_reader_gets_all_of_a_long_write(connection: tuple[DescriptorLink, socket.socket]) -> None:
    link, peer = connection
    came = bytearray()

    def read_all() -> None:
        while data := peer.recv(65536):
            came.extend(data)

    thread = threading.Thread(target=read_all)
    thread.start()
    link.write(bytes(range(250)) * 80_000)
    link.close()
    thread.join()
    assert came == bytes(range(250)) * 80_000


def test_a_closed_connection_is_lost(connection: tuple[DescriptorLink, socket.socket]) -> None:
    link, peer = connection
    peer.sendall(REPLY)
    peer.close()
    assert link.read(PATIENCE_S) == REPLY
    with pytest.raises(LinkLost, match=r"^tcp 127\.0\.0\.1:\d+: closed by the other side$"):
        link.read(PATIENCE_S)
    link.write(POLL)  # answered by RST
    reset = select.poll()
    reset.register(link.port, 0)  # errors and hang-ups alone
    assert reset.poll(1000 * PATIENCE_S)
    with pytest.raises(LinkLost, match=r": (broken pipe|connection reset by peer)$"):
        link.write(POLL)


def test_a_reset_connection_is_lost(connection: tuple[DescriptorLink, socket.socket]) -> None:
    link, peer = connection
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # on, 0 s: close() sends RST
    peer.close()
    with pytest.raises(LinkLost, match=r": connection reset by peer$"):
        link.read(PATIENCE_S)


def test_no_descriptor_stays_open_after_connecting_listening_or_failing(
    listener: socket.socket, full_listener: socket.socket, waker: Waker
) -> None:
    refused, taken, full = a_free_port(), port_of(listener), port_of(full_listener)
    attempts: list[Callable[[], Link | socket.socket]] = [
        lambda: ports.connect_tcp("127.0.0.1", taken, waker, CLOCK, PATIENCE_S),
        lambda: ports.connect_tcp("127.0.0.1", refused, waker, CLOCK, PATIENCE_S),
        lambda: ports.connect_tcp("127.0.0.1", full, waker, CLOCK, 0.001),
        lambda: ports.connect_tcp("a..b", 502, waker, CLOCK, PATIENCE_S),
        lambda: ports.listen_tcp("127.0.0.1", taken),
        lambda: ports.listen_tcp("127.0.0.1", 0),
    ]
    before = open_descriptors()
    for attempt in attempts * 40:
        with contextlib.suppress(LinkError):
            attempt().close()
    assert open_descriptors() == before


# --- connecting


def test_a_refused_connection_says_so(waker: Waker) -> None:
    port = a_free_port()
    with pytest.raises(LinkUnavailable) as told:
        ports.connect_tcp("127.0.0.1", port, waker, CLOCK, PATIENCE_S)
    assert str(told.value) == f"tcp 127.0.0.1:{port}: connection refused"


def test_a_device_that_does_not_answer_is_given_up_in_time(full_listener: socket.socket, waker: Waker) -> None:
    started = CLOCK.monotonic()
    with pytest.raises(LinkUnavailable, match=r"^tcp 127\.0\.0\.1:\d+: no answer within 0\.2 s$"):
        ports.connect_tcp("127.0.0.1", port_of(full_listener), waker, CLOCK, 0.2)
    assert 0.2 <= CLOCK.monotonic() - started < 1.5


def test_a_wake_does_not_end_connecting(full_listener: socket.socket, waker: Waker) -> None:
    """SCADA writes all the time; a device that takes a moment to accept is still connected to."""
    waker.wake()
    started = CLOCK.monotonic()
    with pytest.raises(LinkUnavailable, match=r"^tcp 127\.0\.0\.1:\d+: no answer within 0\.2 s$"):
        ports.connect_tcp("127.0.0.1", port_of(full_listener), waker, CLOCK, 0.2)
    assert 0.2 <= CLOCK.monotonic() - started < 1.5


def test_the_wakers_end_ends_connecting_and_is_not_forgotten(full_listener: socket.socket, waker: Waker) -> None:
    thread = threading.Thread(target=waker.end)
    thread.start()
    with pytest.raises(LinkUnavailable, match=r"^tcp 127\.0\.0\.1:\d+: interrupted$"):
        ports.connect_tcp("127.0.0.1", port_of(full_listener), waker, CLOCK, PATIENCE_S)
    thread.join()
    assert waker.wait(0)
    assert waker.wait(0)


@pytest.mark.parametrize("host", ["no-such-device.invalid", "a..b", "a" * 300, "nul\0l", "1.2.3.4.5"])
def test_a_name_that_nobody_knows_is_unavailable(host: str, waker: Waker) -> None:
    with pytest.raises(LinkUnavailable) as told:
        ports.connect_tcp(host, 502, waker, CLOCK, 60.0)
    assert str(told.value).startswith(f"tcp {host}:502: name is not known")


def test_every_address_of_a_name_is_tried(listener: socket.socket, waker: Waker) -> None:
    """localhost is ::1 first on most machines, and nobody listens there."""
    ports.connect_tcp("localhost", port_of(listener), waker, CLOCK, PATIENCE_S).close()


@pytest.fixture
def slow_resolver(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A C library that takes its time for names, and knows no numbers."""
    answered, ended = threading.Event(), threading.Event()

    def ask(*args: object, flags: int = 0, **keywords: object) -> list[object]:
        if not flags & socket.AI_NUMERICHOST:
            answered.wait()
            ended.set()
        raise socket.gaierror(socket.EAI_NONAME, "not known")

    monkeypatch.setattr(socket, "getaddrinfo", ask)
    yield
    answered.set()
    assert ended.wait(PATIENCE_S)
    for thread in threading.enumerate():
        if thread.name == "resolver":
            thread.join()


def test_a_slow_resolver_is_given_up_in_time(slow_resolver: None, waker: Waker) -> None:
    with pytest.raises(LinkUnavailable, match=r"^tcp plc\.example:502: no name server answers within 0\.05 s$"):
        ports.connect_tcp("plc.example", 502, waker, CLOCK, PATIENCE_S, name_limit_s=0.05)


def test_a_wake_does_not_end_waiting_for_a_slow_resolver(slow_resolver: None, waker: Waker) -> None:
    waker.wake()
    with pytest.raises(LinkUnavailable, match="no name server answers"):
        ports.connect_tcp("plc.example", 502, waker, CLOCK, PATIENCE_S, name_limit_s=0.05)


def test_the_wakers_end_ends_waiting_for_a_slow_resolver(slow_resolver: None, waker: Waker) -> None:
    waker.end()
    with pytest.raises(LinkUnavailable, match=r"^tcp plc\.example:502: interrupted$"):
        ports.connect_tcp("plc.example", 502, waker, CLOCK, 60.0)


def test_a_connection_is_prompt_and_notices_a_dead_peer(connection: tuple[DescriptorLink, socket.socket]) -> None:
    link, _ = connection
    assert link.character_s == 0.0
    assert isinstance(link.port, socket.socket)
    assert link.port.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
    options = (socket.TCP_NODELAY, socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
    assert [link.port.getsockopt(socket.IPPROTO_TCP, each) for each in options] == [1, 30, 10, 3]
    assert link.port.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 30_000


# --- listening


def test_ipv6_works_and_is_spelled_in_brackets(waker: Waker) -> None:
    try:
        listener = ports.listen_tcp("::1", 0)
    except LinkUnavailable as none:
        pytest.skip(str(none))
    port = port_of(listener)
    with listener:
        ports.connect_tcp("::1", port, waker, CLOCK, PATIENCE_S).close()
    with pytest.raises(LinkUnavailable, match=r"^tcp \[::1\]:\d+: connection refused$"):
        ports.connect_tcp("::1", port, waker, CLOCK, PATIENCE_S)


def test_listening_never_blocks(listener: socket.socket) -> None:
    with pytest.raises(BlockingIOError):
        listener.accept()


def test_a_port_can_be_listened_on_again_at_once(waker: Waker) -> None:
    """A connection that we closed first keeps the port in TIME_WAIT."""
    with ports.listen_tcp("127.0.0.1", 0) as first:
        port = port_of(first)
        with contextlib.closing(ports.connect_tcp("127.0.0.1", port, waker, CLOCK, PATIENCE_S)):
            first.setblocking(True)
            first.accept()[0].close()
    ports.listen_tcp("127.0.0.1", port).close()


def test_an_address_in_use_or_not_ours_is_unavailable(listener: socket.socket) -> None:
    port = port_of(listener)
    with pytest.raises(LinkUnavailable, match=rf"^tcp 127\.0\.0\.1:{port}: address already in use$"):
        ports.listen_tcp("127.0.0.1", port)
    with pytest.raises(LinkUnavailable, match=r"^tcp 192\.0\.2\.1:0: this machine does not have this address$"):
        ports.listen_tcp("192.0.2.1", 0)


def test_a_port_below_1024_says_what_it_needs() -> None:
    first_free = int(Path("/proc/sys/net/ipv4/ip_unprivileged_port_start").read_text())
    if first_free <= 1:
        pytest.skip("every port is free for all here")
    root = os.geteuid() == 0
    if root:
        os.seteuid(NOBODY)
    try:
        with pytest.raises(LinkUnavailable, match=r"^tcp 127\.0\.0\.1:1: permission denied \(ports below 1024 need"):
            ports.listen_tcp("127.0.0.1", 1)
    finally:
        if root:
            os.seteuid(0)
