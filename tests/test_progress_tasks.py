"""Flags of slaves, consoles and terminals, and of real ports: see ``test_progress``, which is about the master."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from gateway.clock import SystemClock
from gateway.config import MasterConfig, SlaveConfig
from gateway.errors import LinkUnavailable
from gateway.hmi.console import SerialConsole
from gateway.hmi.seat import Rank
from gateway.hmi.session import KEYS_UNSENT_MOST, UNREAD_S, Session
from gateway.hmi.terminals import Conversation, Terminals
from gateway.link import DescriptorLink, Link, RtsLink, SerialSettings, Waker, open_serial, wait_ready
from gateway.master import Master
from gateway.modbus.pdu import Span, Table
from gateway.opening import LIMIT_S
from gateway.register import DataRegister
from gateway.slave import SerialSlave
from gateway.slave_tcp import TcpSlave
from gateway.supervisor import Plan, Supervisor, Task
from tests import programs
from tests.fakes import SCADA, JumpingClock, JumpingWaker, rtu, writes
from tests.hmi.terminals import House
from tests.lines import PATIENCE_S, READ, Pty, a_register, listen, pty_pair, raw_client, tcp_config
from tests.tasks import running
from tests.test_progress import WAIT_LIMIT_S, Later, NoisyLink, hangs, is_well

SOON_S = 0.02  # a wait limit where time really passes
SHORT_S = 1.0  # a timeout where time really passes
CLOCK = SystemClock()
READ_3 = rtu(17, bytes.fromhex("03 006B 0003"))


class SpinningLink(NoisyLink):
    """A port that is said to be ready for ever, and has no bytes."""

    def read(self, timeout_s: float) -> bytes:
        return b""


def a_link(clock: JumpingClock, kind: type[NoisyLink] = NoisyLink, noise_s: list[float] | None = None) -> NoisyLink:
    link = kind(clock, lambda _frame: [], 11 / 1200)
    link.noise_s = noise_s or []
    return link


def refused() -> Link:
    raise LinkUnavailable("is not there")


# ------------------------------------------------------------------------------------------------ serial slaves


def a_serial_slave(clock: JumpingClock, open_link: Callable[[], Link], **keys: Any) -> SerialSlave:
    config = SlaveConfig.model_validate({"name": "scada", "line": "/dev/ttyS2", "unit": 17, "baudrate": 1200} | keys)
    return SerialSlave(config, a_register(), clock, JumpingWaker(clock), open_link, WAIT_LIMIT_S)


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.parametrize("every_s", [0.0, 0.001, 0.02, 0.19, 0.9, 10.0])
def test_a_serial_slave_shows_its_flag_whatever_it_hears(clock: JumpingClock, framing: str, every_s: float) -> None:
    noise_s = [1000.0 + n * every_s for n in range(2000)] if every_s else []
    link = a_link(clock, noise_s=noise_s)
    link.noise = READ_3 if every_s > 0.1 else b"\x11"
    assert is_well(a_serial_slave(clock, lambda: link, framing=framing), clock, 60.0)


@pytest.mark.parametrize("keys", [{"enabled": False}, {"character_timeout": 60.0}], ids=str)
def test_a_serial_slave_that_rests_shows_its_flag(clock: JumpingClock, keys: dict[str, Any]) -> None:
    link = a_link(clock, noise_s=[1001.0])
    assert is_well(a_serial_slave(clock, lambda: link, **keys), clock, 200.0)


def test_a_serial_slave_that_waits_for_its_port_shows_its_flag(clock: JumpingClock) -> None:
    assert is_well(a_serial_slave(clock, refused), clock, 100.0)
    slave = a_serial_slave(clock, partial(a_link, clock))
    slave._opening._start = Later()
    assert is_well(slave, clock, 3 * LIMIT_S)


def test_a_serial_slave_that_turns_without_getting_anywhere_shows_no_flag(clock: JumpingClock) -> None:
    slave = a_serial_slave(clock, partial(a_link, clock, SpinningLink))
    assert hangs(slave, clock)


class NeverQuiet(SerialSlave):
    """The end of a silence is due for ever."""

    def _due_s(self, now_s: float) -> float:
        return now_s


def test_a_serial_slave_with_something_due_that_is_never_done_shows_no_flag(clock: JumpingClock) -> None:
    config = SlaveConfig.model_validate({"name": "scada", "line": "/dev/ttyS2", "unit": 17})
    slave = NeverQuiet(config, a_register(), clock, JumpingWaker(clock), partial(a_link, clock), WAIT_LIMIT_S)
    assert hangs(slave, clock)


# ------------------------------------------------------------------------------------------------ the serial console


def a_console(clock: JumpingClock, open_link: Callable[[], Link]) -> tuple[SerialConsole, House]:
    house = House(clock)
    return SerialConsole(house.shared, clock, JumpingWaker(clock), open_link, WAIT_LIMIT_S), house


@pytest.mark.parametrize("key", [b"x", b"L", b"B", b"q", b"\x1b", b"\xff"])
@pytest.mark.parametrize("every_s", [0.0, 0.001, 0.2, 0.9, 20.0])
def test_a_console_shows_its_flag_whatever_is_typed(clock: JumpingClock, key: bytes, every_s: float) -> None:
    link = a_link(clock, noise_s=[1001.0 + n * every_s for n in range(1000)] if every_s else [])
    link.noise = key
    console, house = a_console(clock, lambda: link)
    house.configure(serial={"line": "/dev/ttyS1"}, idle_timeout=30.0)
    assert is_well(console, clock, 120.0)


def test_a_console_that_waits_for_its_port_shows_its_flag(clock: JumpingClock) -> None:
    assert is_well(a_console(clock, refused)[0], clock, 100.0)
    console, _house = a_console(clock, partial(a_link, clock))
    console._opening._start = Later()
    assert is_well(console, clock, 3 * LIMIT_S)


def test_a_console_that_turns_without_getting_anywhere_shows_no_flag(clock: JumpingClock) -> None:
    assert hangs(a_console(clock, partial(a_link, clock, SpinningLink))[0], clock)


class DueForEver(SerialConsole):
    """Its session wants to be called all the time, and does nothing then."""

    def _wait_s(self, session: Session) -> float:
        return 0.0


def test_a_console_with_something_due_that_is_never_done_shows_no_flag(clock: JumpingClock) -> None:
    house = House(clock)
    console = DueForEver(house.shared, clock, JumpingWaker(clock), partial(a_link, clock), WAIT_LIMIT_S)
    assert hangs(console, clock)


# ------------------------------------------------------------------------------------------------ TCP


@contextmanager
def ready_for_ever() -> Iterator[int]:
    """A descriptor that is ready, and nobody's."""
    reading, writing = os.pipe()
    os.write(writing, b"!")
    yield reading
    os.close(reading)
    os.close(writing)


@contextmanager
def a_tcp_slave(opening: Callable[[], socket.socket] = listen, **keys: Any) -> Iterator[TcpSlave]:
    with closing(Waker()) as waker:
        slave = TcpSlave(tcp_config(**keys), a_register(), CLOCK, waker, opening, SOON_S)
        with closing(slave):
            yield slave


def is_well_for(slave: TcpSlave | Terminals, steps: int, meanwhile: Callable[[], object] = bool) -> bool:
    """Whether each of so many steps comes to something; *meanwhile* before each."""
    for _ in range(steps):
        meanwhile()
        if not slave.step():
            return False
    return True


def test_a_tcp_slave_that_waits_shows_its_flag() -> None:
    with a_tcp_slave() as slave:
        assert is_well_for(slave, 10)
        with raw_client(slave.port):
            assert is_well_for(slave, 10)
        slave.set_enabled(False)
        assert is_well_for(slave, 10)
    with a_tcp_slave(listen_nowhere) as slave:
        assert is_well_for(slave, 10)


def listen_nowhere() -> socket.socket:
    raise LinkUnavailable("is not an address of this machine")


def test_a_tcp_slave_whose_clients_read_nothing_or_slowly_shows_its_flag() -> None:
    with a_tcp_slave() as slave:
        slave.step()
        with raw_client(slave.port) as slow, raw_client(slave.port) as deaf:
            for client in (slow, deaf):
                client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                client.socket.setblocking(False)

            def ask_and_read_a_little() -> None:
                for client in (slow, deaf):
                    with suppress(BlockingIOError):
                        client.send(READ * 200)
                with suppress(BlockingIOError):
                    slow.socket.recv(100)

            assert is_well_for(slave, 300, ask_and_read_a_little)


def test_a_tcp_slave_that_turns_without_getting_anywhere_shows_no_flag() -> None:
    with ready_for_ever() as descriptor, a_tcp_slave() as slave:
        slave.step()
        slave._selector.register(descriptor, 1)
        assert [slave.step() for _ in range(5)] == [False] * 5


def test_one_step_of_a_tcp_slave_is_not_the_longer_the_more_its_clients_ask_at_once() -> None:
    """What they all ask has to be answered on a small board, too, before the flag is due."""
    with a_tcp_slave() as slave:
        slave.step()
        with raw_client(slave.port) as client:
            slave.step()
            client.send(READ * 1300)
            slave.step()
            assert 0 < slave.counters.requests <= 200


# ------------------------------------------------------------------------------------------------ terminals


@contextmanager
def a_terminals(clock: JumpingClock, welcome: Callable[[], Conversation]) -> Iterator[Terminals]:
    with closing(Waker()) as waker:
        terminals = Terminals("menu", clock, waker, listen, lambda _accepted, _wake: welcome(), SOON_S)
        with closing(terminals):
            yield terminals


def a_session(house: House) -> Session:
    session = Session(house.shared, "maria", Rank.LOCAL, "maria", lambda: None)
    session.start()
    return session


def test_terminals_that_wait_show_their_flag(clock: JumpingClock) -> None:
    with a_terminals(clock, partial(a_session, House(clock))) as terminals:
        assert is_well_for(terminals, 10)
        with raw_client(terminals.port):
            assert is_well_for(terminals, 10, lambda: clock.pass_s(0.1))


def test_terminals_that_turn_without_getting_anywhere_show_no_flag(clock: JumpingClock) -> None:
    with ready_for_ever() as descriptor, a_terminals(clock, partial(a_session, House(clock))) as terminals:
        terminals.step()
        terminals._selector.register(descriptor, 1)
        assert [terminals.step() for _ in range(5)] == [False] * 5


class Pressing:
    """A conversation that wants to be called all the time, and does nothing then."""

    is_over = False
    output = bytearray()

    def receive(self, data: bytes) -> None: ...

    def end_input(self) -> None: ...

    def turn(self) -> None: ...

    def sent(self, count: int) -> None: ...

    def due_s(self) -> float | None:
        return 0.0

    def stop(self) -> None: ...

    def hang_up(self) -> None: ...


def test_terminals_with_something_due_that_is_never_done_show_no_flag(clock: JumpingClock) -> None:
    with a_terminals(clock, Pressing) as terminals:
        terminals.step()
        with raw_client(terminals.port):
            terminals.step()
            assert [terminals.step() for _ in range(5)] == [False] * 5


@pytest.mark.parametrize("has_ended", [False, True])
def test_who_types_ahead_and_reads_nothing_holds_up_nobody(clock: JumpingClock, has_ended: bool) -> None:
    """As `rtugate menu < keys` in a terminal that is stopped: he is given up in the end."""
    with a_terminals(clock, partial(a_session, House(clock))) as terminals:
        terminals.step()
        with raw_client(terminals.port) as client:
            client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.send(b"B" * 500)  # each shows 3000 characters
            if has_ended:
                client.socket.shutdown(socket.SHUT_WR)
            for _ in range(100):
                clock.pass_s(0.05)
                terminals.step()
            (connection,) = terminals.connections.values()
            assert len(connection.conversation.output) >= KEYS_UNSENT_MOST
            clock.pass_s(10.0)
            terminals.step()
            assert is_well_for(terminals, 5)
            clock.pass_s(UNREAD_S)
            terminals.step()
            assert connection.conversation.is_over


# ------------------------------------------------------------------------------------------------ real ports


class Wired:
    """A task of a real port under a supervisor with a short timeout."""

    def __init__(self, make: Callable[[Waker], Task]) -> None:
        self.hung: list[str] = []
        self.task: Task | None = None
        self.supervisor = Supervisor([Plan("field", partial(self._make, make))], CLOCK, SHORT_S)
        self.supervisor.hung = self.hung.extend
        self.has_trouble = threading.Event()
        self.supervisor.chores.append(self._look)

    def _make(self, make: Callable[[Waker], Task], waker: Waker) -> Task:
        self.task = make(waker)
        return self.task

    def _look(self) -> float:
        if getattr(self.task, "trouble", ""):
            self.has_trouble.set()
        return SOON_S


def a_writing_master(device: str, waker: Waker, open_link: Callable[[], Link]) -> Master:
    """A master whose first request is as long as a frame can be."""
    request = {**writes(0, 0, 123), "trigger": "cycle", "every": 60.0}
    config = {"name": "field", "line": device, "baudrate": 1200, "parity": "none", "request": [request]}
    register = DataRegister(CLOCK)
    master = Master(MasterConfig.model_validate(config), register, CLOCK, waker, open_link, SHORT_S / 3)
    register.write(Span(Table.HOLDING_REGISTERS, 0, 123), bytes(246), SCADA)
    return master


def opened(pty: Pty, waker: Waker, baudrate: int = 1200) -> DescriptorLink:
    link = open_serial(SerialSettings(pty.device, baudrate, "none"), waker, CLOCK)
    assert isinstance(link, DescriptorLink)
    return link


def full(pty: Pty, waker: Waker) -> DescriptorLink:
    """A port that takes no more bytes, as of an adapter whose other side does not listen."""
    link = opened(pty, waker, 9600)
    is_full = False
    while not is_full:
        try:
            os.write(link.port.fileno(), b"x")
        except BlockingIOError:  # what it has taken goes on a little later, and makes room
            is_full = not wait_ready((), (link.port.fileno(),), SOON_S)
    return link


def by_rts(pty: Pty, waker: Waker) -> Link:
    plain = opened(pty, waker)
    shared = (plain.name, plain.port, waker, CLOCK, plain.hangup, plain.character_s)
    return RtsLink(*shared, switch=lambda on: None, before_s=0.7, after_s=0.7)


def test_a_long_frame_at_1200_baud_whose_direction_we_switch_is_no_hang() -> None:
    """The write waits until its last bit has left: 0.7 s before, 2.1 s for 255 characters, and 0.7 s after them."""
    with pty_pair() as pty:
        it = Wired(lambda waker: a_writing_master(pty.device, waker, partial(by_rts, pty, waker)))
        with running(it.supervisor) as run:
            assert len(pty.receive(255)) == 255
            assert it.task is not None
            assert isinstance(it.task, Master)
            run.look()
            while it.task.counters.good == 0:
                run.look()
        assert it.hung == []


def test_a_port_that_takes_no_bytes_is_trouble_and_no_hang() -> None:
    with pty_pair() as pty:
        it = Wired(lambda waker: a_writing_master(pty.device, waker, partial(full, pty, waker)))
        with running(it.supervisor):
            assert it.has_trouble.wait(2 * PATIENCE_S)
        assert it.hung == []


def test_a_console_whose_port_takes_no_bytes_is_trouble_and_no_hang() -> None:
    house = House(CLOCK)
    with pty_pair() as pty:
        it = Wired(lambda waker: SerialConsole(house.shared, CLOCK, waker, partial(full, pty, waker), SHORT_S / 3))
        with running(it.supervisor):
            assert it.has_trouble.wait(PATIENCE_S)
        assert it.hung == []


def test_with_the_least_timeout_a_gateway_that_has_nothing_to_do_goes_on(tmp_path: Path) -> None:
    with programs.program(tmp_path, '[watchdog]\ntimeout = 1\n[hmi.telnet]\nlisten = "127.0.0.1:0"\n') as gateway:
        gateway.started()
        with pytest.raises(subprocess.TimeoutExpired):
            gateway.run.wait(3.0)
        gateway.run.terminate()
        assert gateway.run.wait(programs.SOON_S) == 0
        assert "CRITICAL" not in gateway.said


def test_a_timeout_shortened_by_a_reload_to_the_least_is_no_hang(tmp_path: Path) -> None:
    with programs.program(tmp_path, '[hmi.telnet]\nlisten = ""\n') as gateway:
        gateway.started()
        gateway.reload('[watchdog]\ntimeout = 1\n[hmi.telnet]\nlisten = ""\n')
        gateway.wait_for("reloaded")
        with pytest.raises(subprocess.TimeoutExpired):
            gateway.run.wait(3.0)
        gateway.run.terminate()
        assert gateway.run.wait(programs.SOON_S) == 0
        assert "CRITICAL" not in gateway.said
