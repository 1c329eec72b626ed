"""A TCP slave and its clients on real sockets of this machine: many, idle, foreign, deaf ones, and the port itself
(spec section 3); what they are answered: test_slave_tcp.
"""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import selectors
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest

from gateway.errors import LinkUnavailable
from gateway.link_tcp import listen_tcp
from gateway.modbus.pdu import Span, Table
from gateway.slave_tcp import RECEIVE_MAX, UNSENT_MAX
from tests.lines import (
    FOUND,
    MENU,
    PATIENCE_S,
    READ,
    RawClient,
    ServedTcp,
    holding,
    listen,
    raw_client,
    serving_tcp,
    tcp_config,
    tcp_frame,
)

SHORT_S = 0.05  # a timeout that a test waits for
NEVER_S = 60.0  # a turn that no test waits for


@pytest.fixture
def slave() -> Iterator[ServedTcp]:
    with serving_tcp(tcp_config()) as made:
        yield made


@pytest.fixture
def client(slave: ServedTcp) -> Iterator[RawClient]:
    with slave.client() as made:
        yield made


# ------------------------------------------------------------------------------------------------ many clients


def test_a_client_that_resets_in_the_middle_of_a_frame_disturbs_nobody(slave: ServedTcp, client: RawClient) -> None:
    with slave.client() as other:
        other.send(READ + READ[:5])
        assert other.receive(len(FOUND)) == FOUND
        other.reset()
        slave.run.wait_until(lambda: len(slave.task.clients) == 1)
    assert client.ask(READ, len(FOUND)) == FOUND


def test_a_client_that_closes_is_forgotten(slave: ServedTcp) -> None:
    with slave.client():
        assert len(slave.task.clients) == 1
    slave.run.wait_until(lambda: not slave.task.clients)


def test_thirty_clients_at_once_each_get_their_own_answers(slave: ServedTcp) -> None:
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(slave.client()) for _ in range(30)]
        for number, client in enumerate(clients):
            client.send(tcp_frame(number, f"06 01 {number:02X} 00 {number:02X}"))
        for number, client in enumerate(clients):
            reply = tcp_frame(number, f"06 01 {number:02X} 00 {number:02X}")
            assert client.receive(len(reply)) == reply
    assert holding(slave.register, 0x100, 30) == list(range(30))


def test_one_client_too_many_closes_the_longest_idle() -> None:
    with serving_tcp(tcp_config(max_clients=2)) as slave, slave.client() as first, slave.client() as second:
        assert first.ask(READ, len(FOUND)) == FOUND  # now the second has been idle longer
        with slave.client() as third:
            assert second.is_closed()
            assert first.ask(READ, len(FOUND)) == FOUND
            assert third.ask(READ, len(FOUND)) == FOUND


def test_a_client_from_a_network_not_allowed_is_closed_unanswered_and_counted() -> None:
    with serving_tcp(tcp_config(allow=["10.0.0.0/8", "127.0.0.2/32"])) as slave:
        with raw_client(slave.port, source="127.0.0.1") as stranger:
            stranger.send(READ)
            assert stranger.is_closed()
        slave.run.wait_until(lambda: slave.task.refused_clients == 1)
        with slave.client(source="127.0.0.2") as friend:
            assert friend.ask(READ, len(FOUND)) == FOUND
        assert slave.task.refused_clients == 1


def listen_on_both() -> socket.socket:
    """A listener for IPv6 that takes IPv4 clients, too: their addresses come as ::ffff:127.0.0.1."""
    listener = socket.create_server(("::", 0), family=socket.AF_INET6, dualstack_ipv6=True)
    listener.setblocking(False)
    return listener


def needs_ipv6() -> None:
    try:
        listen_tcp("::1", 0).close()
    except LinkUnavailable as error:
        pytest.skip(f"this machine has no IPv6: {error}")


def test_ipv6_clients_are_served_and_named_in_brackets() -> None:
    needs_ipv6()
    opening = partial(listen_tcp, "::1", 0)
    with serving_tcp(tcp_config(allow=["::1/128"]), opening=opening) as slave, raw_client(slave.port, "::1") as client:
        assert client.ask(READ, len(FOUND)) == FOUND
        assert [known.name for known in slave.task.clients.values()] == [f"[::1]:{client.socket.getsockname()[1]}"]


@pytest.mark.parametrize(("network", "is_served"), [("127.0.0.0/8", True), ("10.0.0.0/8", False)])
def test_an_ipv4_client_on_an_ipv6_port_is_judged_by_its_ipv4_address(network: str, is_served: bool) -> None:
    needs_ipv6()
    with serving_tcp(tcp_config(allow=[network]), opening=listen_on_both) as slave, raw_client(slave.port) as client:
        client.send(READ)
        assert client.is_closed() is not is_served


def test_a_client_idle_for_the_timeout_is_closed() -> None:
    with serving_tcp(tcp_config(idle_timeout=SHORT_S), wait_limit_s=NEVER_S) as slave, slave.client() as client:
        assert client.is_closed()
        slave.run.wait_until(lambda: not slave.task.clients)


def test_a_client_that_asks_again_and_again_outlives_an_idle_one() -> None:
    with serving_tcp(tcp_config(idle_timeout=0.5)) as slave, slave.client() as busy, slave.client() as idle:
        idle.socket.settimeout(0.05)  # the pause between two requests of the busy one
        is_closed = False
        while not is_closed:
            assert busy.ask(READ, len(FOUND)) == FOUND
            with contextlib.suppress(TimeoutError):
                is_closed = idle.is_closed()
        assert busy.ask(READ, len(FOUND)) == FOUND


def test_an_idle_timeout_of_zero_never_closes() -> None:
    with serving_tcp(tcp_config(idle_timeout=0)) as slave, slave.client() as client:
        slave.run.come_round()
        slave.run.come_round()
        assert client.ask(READ, len(FOUND)) == FOUND


# ------------------------------------------------------------------------------------------------ back-pressure


def test_a_client_that_does_not_read_is_not_listened_to_until_it_does(slave: ServedTcp, client: RawClient) -> None:
    request = tcp_frame(1, "03 00 00 00 7D")  # 125 registers: 12 bytes ask for 259
    reply = tcp_frame(1, "03 FA" + 125 * "0000")
    slave.register.write(Span(Table.HOLDING_REGISTERS, 0, 125), bytes(250), MENU)
    (known,) = slave.task.clients.values()
    sent = send_until_not_listened_to(client, request, lambda: not known.listening_to & selectors.EVENT_READ)
    with slave.client() as other:
        assert other.ask(READ, len(FOUND)) == tcp_frame(1, "03 06 0000 0000 0000")
    assert UNSENT_MAX <= len(known.unsent) <= UNSENT_MAX + RECEIVE_MAX // len(request) * len(reply) + len(reply)
    client.socket.settimeout(12 * PATIENCE_S)  # the kernel holds some 300,000 requests: they are all answered first
    sender = threading.Thread(target=client.send, args=(request[sent % len(request) :] + READ,))
    sender.start()
    for number in range(sent // len(request) + 1):
        assert client.receive(len(reply)) == reply, f"reply {number}"
    sender.join()
    assert client.receive(len(FOUND)) == tcp_frame(1, "03 06 0000 0000 0000")
    slave.run.wait_until(lambda: known.listening_to == selectors.EVENT_READ and not known.unsent)


def send_until_not_listened_to(client: RawClient, request: bytes, is_deaf: Callable[[], bool]) -> int:
    """Send *request* again and again until the slave listens no more and nothing fits; return how many bytes went."""
    client.socket.setblocking(False)
    block, sent = request * 1000, 0
    while True:
        try:
            sent += client.socket.send(block[sent % len(request) :])
        except BlockingIOError:
            if is_deaf():
                return sent
            with selectors.DefaultSelector() as selector:
                selector.register(client.socket, selectors.EVENT_WRITE)
                selector.select(0.05)


def test_a_client_that_resets_with_replies_unread_is_forgotten(slave: ServedTcp, client: RawClient) -> None:
    (known,) = slave.task.clients.values()
    send_until_not_listened_to(
        client, tcp_frame(1, "03 00 00 00 7D"), lambda: not known.listening_to & selectors.EVENT_READ
    )
    client.reset()
    slave.run.wait_until(lambda: not slave.task.clients)


# ------------------------------------------------------------------------------------------------ states, port


def test_in_maintenance_nobody_is_answered_and_afterwards_everybody_again(slave: ServedTcp, client: RawClient) -> None:
    port = slave.port
    slave.task.set_enabled(False)
    assert client.is_closed()
    slave.run.wait_until(lambda: slave.task.port is None)
    with pytest.raises(ConnectionRefusedError):
        RawClient(port)
    slave.task.set_enabled(True)
    with slave.client() as again:
        assert again.ask(READ, len(FOUND)) == FOUND


def test_the_port_may_be_asked_for_while_it_comes_and_goes(slave: ServedTcp) -> None:
    enough = threading.Event()

    def toggle() -> None:
        for number in range(200):
            slave.task.set_enabled(bool(number % 2))
            slave.run.come_round()
        enough.set()

    toggler = threading.Thread(target=toggle)
    toggler.start()
    while not enough.is_set():
        assert slave.task.port is None or slave.task.port > 0
    toggler.join()


def test_a_slave_configured_off_starts_in_maintenance() -> None:
    with serving_tcp(tcp_config(enabled=False)) as slave:
        slave.run.come_round()
        slave.run.come_round()
        assert slave.task.port is None


def test_a_port_in_use_is_told_once_and_served_when_it_is_free(caplog: pytest.LogCaptureFixture) -> None:
    with contextlib.closing(listen()) as taken:
        port = taken.getsockname()[1]
        tried = threading.Semaphore(0)

        def opening() -> socket.socket:
            try:
                return listen_tcp("127.0.0.1", port)
            finally:
                tried.release()

        with serving_tcp(tcp_config(), opening=opening, wait_limit_s=NEVER_S) as slave:
            assert tried.acquire(timeout=PATIENCE_S)
            assert tried.acquire(timeout=PATIENCE_S)  # 0.5 s later, by itself
            slave.run.come_round()
            assert slave.task.trouble == f"tcp 127.0.0.1:{port}: address already in use"
            taken.close()
            assert tried.acquire(timeout=PATIENCE_S)  # another 1 s later
            with slave.client() as client:
                assert client.ask(READ, len(FOUND)) == FOUND
            assert slave.task.trouble == ""
    told = [record.getMessage() for record in caplog.records if record.name == "gateway.opening"]
    assert told == [
        f"scada: tcp 127.0.0.1:{port}: address already in use; trying again",
        "scada: the line works again",
    ]


def test_stopping_closes_every_client_and_the_port() -> None:
    with contextlib.ExitStack() as stack:
        with serving_tcp(tcp_config(), wait_limit_s=NEVER_S) as slave:
            port = slave.port
            clients = [stack.enter_context(slave.client()) for _ in range(3)]
            clients[0].send(READ[:5])  # one of them is in the middle of a frame
        assert all(client.is_closed() for client in clients)
        with pytest.raises(ConnectionRefusedError):
            RawClient(port)


class HastyListener(socket.socket):
    """A listener whose first clients were gone before they could be accepted."""

    failures: list[OSError]

    def accept(self) -> tuple[socket.socket, Any]:
        if self.failures:
            raise self.failures.pop(0)
        return super().accept()


def test_clients_gone_before_they_are_accepted_do_not_matter() -> None:
    def opening() -> socket.socket:
        listener = HastyListener(fileno=listen().detach())
        listener.failures = [BlockingIOError(), ConnectionAbortedError()]
        return listener

    with serving_tcp(tcp_config(), opening=opening) as slave, slave.client() as client:
        assert client.ask(READ, len(FOUND)) == FOUND


@contextmanager
def no_descriptor_left() -> Iterator[None]:
    """Let this process open nothing more."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    lowest_free = os.dup(0)
    os.close(lowest_free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest_free, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_without_a_descriptor_left_the_longest_idle_client_makes_room(slave: ServedTcp, client: RawClient) -> None:
    with socket.socket() as late:
        late.settimeout(PATIENCE_S)
        port = slave.port
        with no_descriptor_left():
            late.connect(("127.0.0.1", port))
            assert client.is_closed()
            late.sendall(READ)
            assert late.recv(len(FOUND)) == FOUND


def test_without_a_descriptor_and_without_clients_it_waits_for_one(
    slave: ServedTcp, caplog: pytest.LogCaptureFixture
) -> None:
    def complaints() -> list[str]:
        return [record.getMessage() for record in caplog.records if os.strerror(errno.EMFILE) in record.getMessage()]

    with socket.socket() as late:
        late.settimeout(PATIENCE_S)
        port = slave.port
        with no_descriptor_left():
            late.connect(("127.0.0.1", port))
            slave.run.wait_until(complaints)
        slave.task.wake()
        late.sendall(READ)
        assert late.recv(len(FOUND)) == FOUND
