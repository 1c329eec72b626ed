"""The traffic view on real lines: what a master, and a slave on TCP or on wires, tell of theirs."""

from __future__ import annotations

import contextlib
import socket
import threading

from gateway.config import SlaveConfig
from gateway.link import Link, SerialSettings, Waker, open_serial
from gateway.modbus.framing import Framing
from gateway.modbus.pdu import WriteRequest
from gateway.slave import SerialSlave
from gateway.traffic import Seen, Tap
from tests.fakes import JumpingClock, MasterBench, reads, tcp, words
from tests.lines import CLOCK, PATIENCE_S, Pty, a_register, pty_pair, running, serving_tcp, tcp_config
from tests.traffic import ANSWER, ANSWER_WORDS, ASKED, ENCODE, READ_WORDS, on_wires, texts


class Watching:
    """Whoever watches *tap*, and what he has seen so far."""

    def __init__(self, tap: Tap) -> None:
        self.seen: list[Seen] = []
        self._tap = tap
        tap.watch()

    def has(self, count: int) -> bool:
        self.seen += self._tap.take()
        return len(self.seen) >= count


# ------------------------------------------------------------------------------------------------ a master


def test_a_master_tells_what_it_sends_and_hears_across_lost_lines(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(17, 0, 3, address=107, every=1.0))
    it.field.registers = {(17, 107): 555, (17, 109): 100}
    it.master.traffic.watch()
    it.run_s(0.5)
    it.link.lose = "read"
    it.run_s(3.0)
    assert len(it.links) == 2
    assert set(texts(it.master.traffic.take())) == {f"> {READ_WORDS}", f"< {ANSWER_WORDS}"}


def test_a_master_on_tcp_begins_afresh_with_each_connection(clock: JumpingClock) -> None:
    it = MasterBench(clock, reads(17, 0, 3, address=107, every=3600.0), line="tcp://10.0.0.7:502")
    it.field.silent = {17}
    it.master.traffic.watch()
    it.steps(1)
    it.link.arriving = [(clock.monotonic() + 0.75, tcp(1, 17, ANSWER)[:8])]
    it.steps(1)
    assert texts(it.master.traffic.take()) == [f"> {READ_WORDS}"]
    it.master.set_enabled(False)
    it.steps(1)
    assert texts(it.master.traffic.take()) == ["< 8 bytes, cut short"]
    it.field.silent = set()
    it.master.set_enabled(True)
    it.run_s(5.0)
    assert texts(it.master.traffic.take()) == [f"> {READ_WORDS}", "< unit 17: 3 registers: 0 0 0"]


def test_a_ticket_shows_in_the_traffic(clock: JumpingClock) -> None:
    it = MasterBench(clock)
    it.master.traffic.watch()
    it.master.submit(5, WriteRequest(6, 7, 1, words(77)))
    it.run_s(0.5)
    assert texts(it.master.traffic.take()) == ["> unit 5: write register at 7: 77", "< unit 5: wrote register at 7: 77"]


# ------------------------------------------------------------------------------------------------ real slaves


def test_a_slave_on_tcp_tells_each_clients_traffic_with_its_name() -> None:
    with serving_tcp(tcp_config()) as slave, slave.client() as one, slave.client() as two:
        names = [f"127.0.0.1:{client.socket.getsockname()[1]}" for client in (one, two)]
        watching = Watching(slave.task.traffic)
        for client in (one, two):
            reply = tcp(9, 17, ANSWER)
            assert client.ask(tcp(9, 17, ASKED), len(reply)) == reply
        slave.run.wait_until(lambda: watching.has(4))
        assert [(each.client, each.sent, each.text) for each in watching.seen] == [
            (name, *what) for name in names for what in ((False, READ_WORDS), (True, ANSWER_WORDS))
        ]


def test_of_what_a_client_does_not_take_at_once_just_that_is_told_which_was_sent() -> None:
    requests = b"".join(tcp(number, 17, bytes.fromhex("03 0000 007D")) for number in range(100))
    size = 100 * (9 + 250)
    with serving_tcp(tcp_config()) as slave, contextlib.closing(socket.socket()) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        client.settimeout(PATIENCE_S)
        client.connect(("127.0.0.1", slave.port))
        slave.run.wait_until(lambda: slave.task.clients)
        served = next(iter(slave.task.clients.values()))
        served.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2048)
        watching = Watching(slave.task.traffic)
        client.sendall(requests)
        slave.run.wait_until(lambda: served.unsent and watching.has(101))
        assert len(watching.seen) < 200
        received = b""
        while len(received) < size:
            received += client.recv(size)
        slave.run.wait_until(lambda: watching.has(200))
    assert b"".join(each.raw for each in watching.seen if each.sent) == received


def test_a_client_that_leaves_in_the_middle_of_a_request_shows_it() -> None:
    with serving_tcp(tcp_config()) as slave:
        watching = Watching(slave.task.traffic)
        with slave.client() as client:
            client.send(tcp(1, 17, ASKED)[:9])
        slave.run.wait_until(lambda: watching.has(1))
        assert texts(watching.seen) == ["< 9 bytes, cut short"]


@on_wires
def test_a_slave_on_wires_tells_all_it_hears_and_what_it_answers(framing: Framing) -> None:
    with pty_pair() as pty, contextlib.closing(Waker()) as waker:
        config = SlaveConfig.model_validate(
            {"name": "plc", "line": pty.device, "framing": framing, "parity": "none", "data_bits": 8, "unit": 17}
        )
        opened, encode = threading.Event(), ENCODE[framing]

        def open_link() -> Link:
            link = open_serial(SerialSettings(config.line, parity="none", data_bits=8), waker, CLOCK)
            opened.set()
            return link

        slave = SerialSlave(config, a_register(), CLOCK, waker, open_link, wait_limit_s=0.02)
        watching = Watching(slave.traffic)
        with running(slave) as run:
            assert opened.wait(PATIENCE_S)
            asks(pty, encode(18, ASKED), b"")
            run.wait_until(lambda: slave.counters.foreign == 1)
            asks(pty, encode(17, ASKED), encode(17, ANSWER))
            run.wait_until(lambda: watching.has(3))
    assert texts(watching.seen) == [
        "< unit 18: read 3 holding registers from 107, not for us",
        f"< {READ_WORDS}",
        f"> {ANSWER_WORDS}",
    ]


def asks(pty: Pty, request: bytes, reply: bytes) -> None:
    pty.send(request)
    assert pty.receive(len(reply)) == reply
