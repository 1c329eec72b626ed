"""A TCP slave and its clients on real sockets of this machine (spec sections 3 and 4).

Requests and replies are literal bytes. That a client gets no answer is shown by the answer to its next request, which
comes first. Pauses are made with short settings, never with sleeps.
"""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import selectors
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest

from gateway.commands import CommandQueue, Outlet
from gateway.config import SlaveConfig
from gateway.errors import LinkUnavailable
from gateway.link import Waker, listen_tcp
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister, Source, SourceKind
from gateway.slave import RECEIVE_MAX, UNSENT_MAX, TcpSlave
from tests.lines import (
    CLOCK,
    EXAMPLES,
    PATIENCE_S,
    RawClient,
    Running,
    a_register,
    ascii_frame,
    holding,
    raw_client,
    rtu_frame,
    running,
    tcp_frame,
    values,
)

# Transaction 1, protocol 0, 6 bytes, unit 17, read 3 holding registers from 107; the example of section 6.3.
READ = bytes.fromhex("0001 0000 0006 11 03 006B 0003")
FOUND = bytes.fromhex("0001 0000 0009 11 03 06 022B 0000 0064")
READ_PDU, FOUND_PDU = EXAMPLES["read holding registers, 6.3"]
SHORT_S = 0.05  # a timeout that a test waits for
TURN_S = 0.02  # how often a slave comes round here, so that a test soon learns what it has done
NEVER_S = 60.0  # the same where the slave's own deadlines, or a wake, have to end its wait
ENCODE: dict[str, Callable[[str, int], bytes]] = {"rtu": rtu_frame, "ascii": ascii_frame}


class Slave:
    """A running slave, and what it serves."""

    def __init__(self, task: TcpSlave, run: Running, register: DataRegister) -> None:
        self.task, self.run, self.register = task, run, register

    @property
    def port(self) -> int:
        """The port, once it is listened on."""
        self.task.wake()
        self.run.wait_until(lambda: self.task.port)
        assert self.task.port is not None
        return self.task.port

    @contextmanager
    def client(self, source: str = "") -> Iterator[RawClient]:
        """Give a client whom the slave has accepted."""
        before = set(self.task.clients.values())
        with raw_client(self.port, source=source) as client:
            self.run.wait_until(lambda: set(self.task.clients.values()) - before)
            yield client


def a_config(**changes: Any) -> SlaveConfig:
    return SlaveConfig.model_validate({"name": "scada", "line": "tcp://127.0.0.1:502", "unit": 17} | changes)


def listen() -> socket.socket:
    return listen_tcp("127.0.0.1", 0)


@contextmanager
def serving(
    config: SlaveConfig,
    register: DataRegister | None = None,
    opening: Callable[[], socket.socket] = listen,
    wait_limit_s: float = TURN_S,
) -> Iterator[Slave]:
    register = register or a_register()
    with contextlib.closing(Waker()) as waker:
        task = TcpSlave(config, register, CLOCK, waker, opening, wait_limit_s)
        with running(task) as run:
            yield Slave(task, run, register)


@pytest.fixture
def slave() -> Iterator[Slave]:
    with serving(a_config()) as made:
        yield made


@pytest.fixture
def client(slave: Slave) -> Iterator[RawClient]:
    with slave.client() as made:
        yield made


def pipelined(count: int) -> tuple[bytes, bytes]:
    """Return *count* reads of different lengths in one, and their replies."""
    requests, replies = b"", b""
    for number in range(count):
        quantity = 1 + number % 3
        requests += tcp_frame(number, f"03 00 6B 00 {quantity:02X}")
        replies += tcp_frame(number, f"03 {2 * quantity:02X} " + "02 2B 00 00 00 64"[: 6 * quantity])
    return requests, replies


# ------------------------------------------------------------------------------------------------ requests


def test_the_example_of_the_standard_is_answered_byte_for_byte(client: RawClient) -> None:
    assert client.ask(READ, len(FOUND)) == FOUND


@pytest.mark.parametrize(("request_pdu", "reply_pdu"), EXAMPLES.values(), ids=EXAMPLES)
def test_each_request_gets_the_reply_of_the_standard(client: RawClient, request_pdu: str, reply_pdu: str) -> None:
    reply = tcp_frame(0xFFFF, reply_pdu)
    assert client.ask(tcp_frame(0xFFFF, request_pdu) + READ, len(reply + FOUND)) == reply + FOUND


def test_what_is_written_is_in_the_register_with_its_client_as_the_source(slave: Slave, client: RawClient) -> None:
    host, port = client.socket.getsockname()
    client.ask(tcp_frame(1, "10 00 01 00 02 04 00 0A 01 02"), 12)
    samples = slave.register.samples(Span(Table.HOLDING_REGISTERS, 1, 2))
    assert [sample.value for sample in samples] == [0x000A, 0x0102]
    assert {str(sample.source) for sample in samples} == {f"scada {host}:{port}"}


def test_two_hundred_requests_in_one_piece_are_answered_in_order(client: RawClient) -> None:
    requests, replies = pipelined(200)
    assert client.ask(requests, len(replies)) == replies


@pytest.mark.parametrize("size", [1, 2, 5, 6, 7, 11, 12, 13, 17, 1001])
def test_requests_cut_anywhere_are_answered_in_order(client: RawClient, size: int) -> None:
    requests, replies = pipelined(200 if size > 10 else 20)
    for start in range(0, len(requests), size):
        client.send(requests[start : start + size])
    assert client.receive(len(replies)) == replies


@pytest.mark.parametrize("unit", [0, 255, 17])
def test_a_unit_that_means_this_gateway_is_answered_and_echoed(client: RawClient, unit: int) -> None:
    reply = tcp_frame(7, FOUND_PDU, unit)
    assert client.ask(tcp_frame(7, READ_PDU, unit), len(reply)) == reply


@pytest.mark.parametrize("unit", [1, 16, 18, 254])
def test_a_foreign_unit_is_answered_with_exception_11_and_echoed(slave: Slave, client: RawClient, unit: int) -> None:
    refusal = tcp_frame(0xABCD, "86 0B", unit)
    assert client.ask(tcp_frame(0xABCD, "06 00 01 00 03", unit), len(refusal)) == refusal
    assert holding(slave.register, 1) == [0]


# ------------------------------------------------------------------------------------------------ damage


def test_a_frame_of_another_protocol_is_discarded_and_the_next_answered(slave: Slave, client: RawClient) -> None:
    other = bytes.fromhex("0001 0001 0006 11 06 0001 0003")  # protocol 1: would write register 1
    assert client.ask(other + READ, len(FOUND)) == FOUND
    assert holding(slave.register, 1) == [0]


@pytest.mark.parametrize("length", [0, 1, 255, 65535])
def test_an_impossible_length_closes_that_connection_alone(slave: Slave, client: RawClient, length: int) -> None:
    with slave.client() as other:
        client.send(READ + struct.pack(">HHH", 2, 0, length) + READ[6:] + READ)
        assert client.receive(len(FOUND)) == FOUND  # what came before is answered
        assert client.is_closed()
        assert other.ask(READ, len(FOUND)) == FOUND


def test_the_greatest_length_is_answered(client: RawClient) -> None:
    longest = tcp_frame(1, "10 00 00 00 7B F6" + 246 * "00")  # 123 registers, length 253
    over_by_one = tcp_frame(2, "10 00 00 00 7B F6" + 247 * "00")  # length 254 is allowed, its content is not
    replies = tcp_frame(1, "10 00 00 00 7B") + tcp_frame(2, "90 03")
    assert client.ask(longest + over_by_one, len(replies)) == replies


def test_a_client_that_resets_in_the_middle_of_a_frame_disturbs_nobody(slave: Slave, client: RawClient) -> None:
    with slave.client() as other:
        other.send(READ + READ[:5])
        assert other.receive(len(FOUND)) == FOUND
        other.reset()
        slave.run.wait_until(lambda: len(slave.task.clients) == 1)
    assert client.ask(READ, len(FOUND)) == FOUND


def test_a_client_that_closes_is_forgotten(slave: Slave) -> None:
    with slave.client():
        assert len(slave.task.clients) == 1
    slave.run.wait_until(lambda: not slave.task.clients)


# ------------------------------------------------------------------------------------------------ many clients


def test_thirty_clients_at_once_each_get_their_own_answers(slave: Slave) -> None:
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(slave.client()) for _ in range(30)]
        for number, client in enumerate(clients):
            client.send(tcp_frame(number, f"06 01 {number:02X} 00 {number:02X}"))
        for number, client in enumerate(clients):
            reply = tcp_frame(number, f"06 01 {number:02X} 00 {number:02X}")
            assert client.receive(len(reply)) == reply
    assert holding(slave.register, 0x100, 30) == list(range(30))


def test_one_client_too_many_closes_the_longest_idle() -> None:
    with serving(a_config(max_clients=2)) as slave, slave.client() as first, slave.client() as second:
        assert first.ask(READ, len(FOUND)) == FOUND  # now the second has been idle longer
        with slave.client() as third:
            assert second.is_closed()
            assert first.ask(READ, len(FOUND)) == FOUND
            assert third.ask(READ, len(FOUND)) == FOUND


def test_a_client_from_a_network_not_allowed_is_closed_unanswered_and_counted() -> None:
    with serving(a_config(allow=["10.0.0.0/8", "127.0.0.2/32"])) as slave:
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
    with serving(a_config(allow=["::1/128"]), opening=opening) as slave, raw_client(slave.port, "::1") as client:
        assert client.ask(READ, len(FOUND)) == FOUND
        assert [known.name for known in slave.task.clients.values()] == [f"[::1]:{client.socket.getsockname()[1]}"]


@pytest.mark.parametrize(("network", "is_served"), [("127.0.0.0/8", True), ("10.0.0.0/8", False)])
def test_an_ipv4_client_on_an_ipv6_port_is_judged_by_its_ipv4_address(network: str, is_served: bool) -> None:
    needs_ipv6()
    with serving(a_config(allow=[network]), opening=listen_on_both) as slave, raw_client(slave.port) as client:
        client.send(READ)
        assert client.is_closed() is not is_served


def test_a_client_idle_for_the_timeout_is_closed() -> None:
    with serving(a_config(idle_timeout=SHORT_S), wait_limit_s=NEVER_S) as slave, slave.client() as client:
        assert client.is_closed()
        slave.run.wait_until(lambda: not slave.task.clients)


def test_a_client_that_asks_again_and_again_outlives_an_idle_one() -> None:
    with serving(a_config(idle_timeout=0.5)) as slave, slave.client() as busy, slave.client() as idle:
        idle.socket.settimeout(0.05)  # the pause between two requests of the busy one
        is_closed = False
        while not is_closed:
            assert busy.ask(READ, len(FOUND)) == FOUND
            with contextlib.suppress(TimeoutError):
                is_closed = idle.is_closed()
        assert busy.ask(READ, len(FOUND)) == FOUND


def test_an_idle_timeout_of_zero_never_closes() -> None:
    with serving(a_config(idle_timeout=0)) as slave, slave.client() as client:
        slave.run.come_round()
        slave.run.come_round()
        assert client.ask(READ, len(FOUND)) == FOUND


# ------------------------------------------------------------------------------------------------ back-pressure


def test_a_client_that_does_not_read_is_not_listened_to_until_it_does(slave: Slave, client: RawClient) -> None:
    request = tcp_frame(1, "03 00 00 00 7D")  # 125 registers: 12 bytes ask for 259
    reply = tcp_frame(1, "03 FA" + 125 * "0000")
    slave.register.write(Span(Table.HOLDING_REGISTERS, 0, 125), bytes(250), Source(SourceKind.MENU, "menu"))
    (known,) = slave.task.clients.values()
    sent = send_until_not_listened_to(client, request, lambda: not known.listening_to & selectors.EVENT_READ)
    with slave.client() as other:
        assert other.ask(READ, len(FOUND)) == tcp_frame(1, "03 06 0000 0000 0000")
    assert UNSENT_MAX <= len(known.unsent) <= UNSENT_MAX + RECEIVE_MAX // len(request) * len(reply) + len(reply)
    client.socket.settimeout(PATIENCE_S)
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


def test_a_client_that_resets_with_replies_unread_is_forgotten(slave: Slave, client: RawClient) -> None:
    (known,) = slave.task.clients.values()
    send_until_not_listened_to(
        client, tcp_frame(1, "03 00 00 00 7D"), lambda: not known.listening_to & selectors.EVENT_READ
    )
    client.reset()
    slave.run.wait_until(lambda: not slave.task.clients)


# ------------------------------------------------------------------------------------------------ states, port


def test_in_maintenance_nobody_is_answered_and_afterwards_everybody_again(slave: Slave, client: RawClient) -> None:
    port = slave.port
    slave.task.set_enabled(False)
    assert client.is_closed()
    slave.run.wait_until(lambda: slave.task.port is None)
    with pytest.raises(ConnectionRefusedError):
        RawClient(port)
    slave.task.set_enabled(True)
    with slave.client() as again:
        assert again.ask(READ, len(FOUND)) == FOUND


def test_the_port_may_be_asked_for_while_it_comes_and_goes(slave: Slave) -> None:
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
    with serving(a_config(enabled=False)) as slave:
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

        with serving(a_config(), opening=opening, wait_limit_s=NEVER_S) as slave:
            assert tried.acquire(timeout=PATIENCE_S)
            assert tried.acquire(timeout=PATIENCE_S)  # 0.5 s later, by itself
            slave.run.come_round()
            assert slave.task.trouble == f"tcp 127.0.0.1:{port}: address already in use"
            taken.close()
            assert tried.acquire(timeout=PATIENCE_S)  # another 1 s later
            with slave.client() as client:
                assert client.ask(READ, len(FOUND)) == FOUND
            assert slave.task.trouble == ""
    told = [record.getMessage() for record in caplog.records if record.name == "gateway.backoff"]
    assert told == [
        f"scada: tcp 127.0.0.1:{port}: address already in use; trying again",
        "scada: the line works again",
    ]


def test_stopping_closes_every_client_and_the_port() -> None:
    with contextlib.ExitStack() as stack:
        with serving(a_config(), wait_limit_s=NEVER_S) as slave:
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

    with serving(a_config(), opening=opening) as slave, slave.client() as client:
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


def test_without_a_descriptor_left_the_longest_idle_client_makes_room(slave: Slave, client: RawClient) -> None:
    with socket.socket() as late:
        late.settimeout(PATIENCE_S)
        port = slave.port
        with no_descriptor_left():
            late.connect(("127.0.0.1", port))
            assert client.is_closed()
            late.sendall(READ)
            assert late.recv(len(FOUND)) == FOUND


def test_without_a_descriptor_and_without_clients_it_waits_for_one(
    slave: Slave, caplog: pytest.LogCaptureFixture
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


# ------------------------------------------------------------------------------------------------ what is served


def test_without_writable_every_write_is_refused_with_exception_1() -> None:
    writes = [(request, reply) for name, (request, reply) in EXAMPLES.items() if "write" in name]
    with serving(a_config(writable=False)) as slave, slave.client() as client:
        for request, reply in writes:
            refusal = tcp_frame(3, f"{int(reply[:2], 16) | 0x80:02X} 01")
            assert client.ask(tcp_frame(3, request), len(refusal)) == refusal
        assert client.ask(READ, len(FOUND)) == FOUND
        assert len(writes) == 6
        assert holding(slave.register, 0, 20) == [0, 0, 0, 0, 0x12, 0, 0, 0, 0x0A, *[0] * 11]
        assert values(slave.register, Table.COILS, 172) == [0]


def test_functions_narrow_what_is_answered() -> None:
    with serving(a_config(functions=["read-holding-registers", 6])) as slave, slave.client() as client:
        assert client.ask(READ, len(FOUND)) == FOUND
        assert client.ask(tcp_frame(1, "06 00 01 00 03"), 12) == tcp_frame(1, "06 00 01 00 03")
        assert client.ask(tcp_frame(1, "01 00 13 00 13"), 9) == tcp_frame(1, "81 01")
        assert client.ask(tcp_frame(1, "10 00 01 00 01 02 00 09"), 9) == tcp_frame(1, "90 01")
        assert holding(slave.register, 1) == [3]


@pytest.mark.parametrize(
    ("address", "quantity", "is_served"),
    [(107, 3, True), (106, 1, False), (106, 2, False), (109, 2, False), (110, 1, False), (109, 1, True)],
)
def test_first_and_count_narrow_the_points_served(address: int, quantity: int, is_served: bool) -> None:
    with serving(a_config(first=107, count=3)) as slave, slave.client() as client:
        client.send(tcp_frame(1, f"03 {address:04X} {quantity:04X}"))
        assert client.receive(9)[7:] == (bytes([3, 2 * quantity]) if is_served else b"\x83\x02")


def test_stale_points_are_refused_with_exception_11_where_that_is_configured() -> None:
    register = a_register()
    register.claim(Span(Table.HOLDING_REGISTERS, 0, 2), Source(SourceKind.REQUEST, "field/boiler"), 10.0)
    with serving(a_config(stale="exception"), register) as slave, slave.client() as client:
        refusal = tcp_frame(1, "83 0B")
        assert client.ask(tcp_frame(1, "03 00 01 00 02"), 9) == refusal
        assert client.ask(READ, len(FOUND)) == FOUND  # nobody fills these


def test_a_write_that_meets_a_full_command_queue_is_refused_with_exception_6_and_stores_nothing(
    slave: Slave, client: RawClient
) -> None:
    span = Span(Table.HOLDING_REGISTERS, 1, 2)
    queue = CommandQueue(slave.register, CLOCK, wake=lambda: None, limit=1)
    queue.add(Outlet(span, Source(SourceKind.REQUEST, "field/setpoint")))
    assert client.ask(tcp_frame(1, "06 00 01 00 03"), 12) == tcp_frame(1, "06 00 01 00 03")  # fills the queue
    assert client.ask(tcp_frame(2, "06 00 02 00 04"), 9) == tcp_frame(2, "86 06")
    assert client.ask(tcp_frame(3, "10 00 02 00 02 04 0005 0006"), 9) == tcp_frame(3, "90 06")
    assert holding(slave.register, 1, 3) == [3, 0, 0]
    assert client.ask(tcp_frame(4, "06 00 03 00 07"), 12) == tcp_frame(4, "06 00 03 00 07")  # concerns no device
    queue.close()


def test_requests_are_counted_for_the_slave_and_for_each_client(slave: Slave, client: RawClient) -> None:
    client.ask(READ + tcp_frame(2, "03 FF FF 00 02") + tcp_frame(3, READ_PDU, unit=9) + READ, 2 * len(FOUND) + 18)
    with slave.client() as other:
        other.ask(bytes.fromhex("0001 0001 0002 11 03") + READ, len(FOUND))
        counted = {known.name: known.server.counters for known in slave.task.clients.values()}
        mine = counted["{}:{}".format(*client.socket.getsockname())]
        theirs = counted["{}:{}".format(*other.socket.getsockname())]
    total = slave.task.counters
    assert (mine.requests, mine.good, mine.exceptions, mine.foreign, mine.damaged) == (3, 2, {2: 1}, 1, 0)
    assert (theirs.requests, theirs.good, theirs.exceptions, theirs.foreign, theirs.damaged) == (1, 1, {}, 0, 1)
    assert (total.requests, total.good, total.exceptions, total.foreign, total.damaged) == (4, 3, {2: 1}, 1, 1)


# ------------------------------------------------------------------------------------------------ RTU, ASCII over TCP


@pytest.mark.parametrize("framing", ENCODE)
@pytest.mark.parametrize(("request_pdu", "reply_pdu"), EXAMPLES.values(), ids=EXAMPLES)
def test_serial_frames_over_tcp_get_the_replies_of_the_standard(framing: str, request_pdu: str, reply_pdu: str) -> None:
    reply = ENCODE[framing](reply_pdu, 17)
    with serving(a_config(framing=framing)) as slave, slave.client() as client:
        assert client.ask(ENCODE[framing](request_pdu, 17), len(reply)) == reply


def test_the_examples_of_rtu_and_ascii_over_tcp_are_answered_byte_for_byte() -> None:
    with serving(a_config(framing="rtu", unit=1)) as slave, slave.client() as client:
        reply = bytes.fromhex("01 03 06 02 2B 00 00 00 64 05 7A")
        assert client.ask(bytes.fromhex("01 03 00 6B 00 03 74 17"), len(reply)) == reply
    with serving(a_config(framing="ascii", unit=1)) as slave, slave.client() as client:
        answer = b":010306022B0000006465\r\n"
        assert client.ask(b":0103006B00038E\r\n", len(answer)) == answer


@pytest.mark.parametrize("framing", ENCODE)
def test_serial_frames_over_tcp_know_one_unit_and_broadcasts(framing: str) -> None:
    encode = ENCODE[framing]
    with serving(a_config(framing=framing)) as slave, slave.client() as client:
        reply = encode(FOUND_PDU, 17)
        for unit in (18, 255):
            client.send(encode("06 00 01 00 03", unit))  # a foreign request
            client.send(encode("06 00 01 00 03", unit))  # and its reply
        client.send(encode("06 00 02 00 04", 0))
        assert client.ask(encode(READ_PDU, 17), len(reply)) == reply
        (known,) = slave.task.clients.values()
        for counters in (known.server.counters, slave.task.counters):
            assert (counters.foreign, counters.broadcasts) == (4, 1)
        assert holding(slave.register, 1, 2) == [0, 4]


@pytest.mark.parametrize("framing", ENCODE)
def test_serial_frames_over_tcp_may_come_in_pieces(framing: str) -> None:
    request, reply = ENCODE[framing](READ_PDU, 17), ENCODE[framing](FOUND_PDU, 17)
    with serving(a_config(framing=framing, character_timeout=PATIENCE_S)) as slave, slave.client() as client:
        (known,) = slave.task.clients.values()
        for cut in range(1, len(request)):
            client.send(request[:cut])
            slave.run.wait_until(lambda cut=cut: known.framer.pending == cut)  # type: ignore[misc]
            client.send(request[cut:])
            assert client.receive(len(reply)) == reply


@pytest.mark.parametrize("framing", ENCODE)
def test_a_part_of_a_serial_frame_over_tcp_is_forgotten_and_counted_after_the_character_timeout(framing: str) -> None:
    request, reply = ENCODE[framing](READ_PDU, 17), ENCODE[framing](FOUND_PDU, 17)
    config = a_config(framing=framing, character_timeout=SHORT_S)
    with serving(config, wait_limit_s=NEVER_S) as slave, slave.client() as client:
        client.send(request[:4])
        slave.run.wait_until(lambda: slave.task.counters.damaged)
        (known,) = slave.task.clients.values()
        assert (known.framer.pending, known.server.counters.damaged) == (0, 1)
        assert client.ask(request, len(reply)) == reply
        assert (slave.task.counters.damaged, slave.task.counters.requests) == (1, 1)


def test_a_part_of_a_tcp_frame_is_never_forgotten() -> None:
    with serving(a_config(character_timeout=1e-6)) as slave, slave.client() as client:
        client.send(READ[:4])
        (known,) = slave.task.clients.values()
        slave.run.wait_until(lambda: known.framer.pending == 4)
        slave.run.come_round()
        slave.run.come_round()
        assert client.ask(READ[4:], len(FOUND)) == FOUND


@pytest.mark.parametrize(
    ("framing", "damaged"),
    [("rtu", rtu_frame("06 00 01 00 03")[:-1] + b"\x00"), ("ascii", b":110600010003E4\r\n")],
)
def test_a_damaged_serial_frame_over_tcp_gets_no_answer(framing: str, damaged: bytes) -> None:
    request, reply = ENCODE[framing](READ_PDU, 17), ENCODE[framing](FOUND_PDU, 17)
    with serving(a_config(framing=framing)) as slave, slave.client() as client:
        client.send(damaged)
        slave.run.wait_until(lambda: slave.task.counters.damaged == 1)
        assert client.ask(request, len(reply)) == reply
        assert holding(slave.register, 1) == [0]


# ------------------------------------------------------------------------------------------------ several threads


def test_a_32_bit_value_written_by_one_client_never_tears_for_another() -> None:
    register = a_register()
    torn: list[bytes] = []
    seen: set[bytes] = set()
    done = threading.Event()

    def read_on(port: int) -> None:
        with raw_client(port) as reader:
            while not done.is_set():
                pair = reader.ask(tcp_frame(1, "03 00 0A 00 02"), 13)[9:]
                seen.add(pair)
                if pair[:2] != pair[2:]:
                    torn.append(pair)

    with serving(a_config(), register) as one, serving(a_config(name="plc"), register) as two, one.client() as writer:
        readers = [threading.Thread(target=read_on, args=(slave.port,)) for slave in (one, two, two)]
        for reader in readers:
            reader.start()
        for number in range(2000):
            word = f"{number:04X}"
            assert len(writer.ask(tcp_frame(number, f"10 00 0A 00 02 04 {word} {word}"), 12)) == 12
        done.set()
        for reader in readers:
            reader.join()
    assert not torn
    assert len(seen) > 100  # the readers did look in between
