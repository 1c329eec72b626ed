"""Telnet on real sockets: the program `telnet`, clients that refuse, read nothing, reset or storm, and the port itself
(spec section 5). What a session does with keys: test_session; the telnet filter: test_telnet.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import random
import select
import shutil
import socket
import struct
import subprocess
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from gateway.errors import LinkUnavailable
from gateway.hmi.background import Background
from gateway.hmi.terminals import (
    CONNECTIONS_MOST,
    LINGER_S,
    NEWCOMERS_MOST,
    SESSIONS_MOST,
    LastWords,
    TelnetDoor,
    TelnetSession,
    Terminals,
    Welcome,
)
from gateway.link import Waker
from gateway.link_tcp import is_allowed, listen_tcp
from tests.fakes import JumpingClock
from tests.hmi.terminals import CHEAP_HASH, CLOCK, MAIN_MENU, PASSWORD, Client, House, tcp_client
from tests.lines import PATIENCE_S, Pty, Running, pty_pair, running

IAC, WILL, WONT, DO, DONT, SB, SE = 255, 251, 252, 253, 254, 250, 240
ECHO, SUPPRESS_GO_AHEAD, NAWS = 1, 3, 31
ASKED = bytes([IAC, WILL, ECHO, IAC, WILL, SUPPRESS_GO_AHEAD, IAC, DO, SUPPRESS_GO_AHEAD, IAC, DO, NAWS])
AGREED = bytes([IAC, DO, ECHO, IAC, DO, SUPPRESS_GO_AHEAD, IAC, WILL, SUPPRESS_GO_AHEAD, IAC, WILL, NAWS])
REFUSED = bytes([IAC, DONT, ECHO, IAC, DONT, SUPPRESS_GO_AHEAD, IAC, WONT, SUPPRESS_GO_AHEAD, IAC, WONT, NAWS])


def listen() -> socket.socket:
    return listen_tcp("127.0.0.1", 0)


class Served:
    """A telnet task that runs, and the house behind it."""

    def __init__(self, house: House, task: Terminals, run: Running) -> None:
        self.house, self.task, self.run = house, task, run

    @contextmanager
    def client(self, source: str = "127.0.0.1") -> Iterator[Client]:
        self.run.wait_until(lambda: self.task.port)
        with tcp_client(self.task.port, source) as client:
            yield client

    @contextmanager
    def at_the_menu(self) -> Iterator[Client]:
        with self.client() as client:
            client.read_until(MAIN_MENU)
            yield client


@contextmanager
def serving(
    opening: Callable[[], socket.socket] = listen,
    wait_limit_s: float = 0.05,
    welcome: Welcome | None = None,
    **hmi: Any,
) -> Iterator[Served]:
    house = House(CLOCK, Background("passwords"), **hmi)
    with contextlib.closing(Waker()) as waker:
        task = Terminals("telnet", CLOCK, waker, opening, welcome or TelnetDoor(house.shared), wait_limit_s)
        with running(task) as run:
            yield Served(house, task, run)


@pytest.fixture
def served() -> Iterator[Served]:
    with serving() as made:
        yield made


# ------------------------------------------------------------------------------------------------ at the menu


def test_a_client_is_asked_for_character_mode_and_has_the_menu(served: Served) -> None:
    with served.client() as client:
        assert client.read_until(MAIN_MENU).encode("utf-8", "replace")
        client.send(AGREED + bytes([IAC, SB, NAWS, 0, 100, 0, 40, IAC, SE]) + b"d")
        client.read_until("['d']")
        menu = served.house.menu
        assert (menu.echoes, menu.ends_keys_with_enter, menu.columns, menu.rows) == (True, False, 100, 40)
        assert menu.who == "127.0.0.1 (telnet)"


def test_the_negotiation_is_the_first_that_is_sent(served: Served) -> None:
    with served.client() as client:
        assert client.socket.recv(len(ASKED), socket.MSG_WAITALL) == ASKED


def test_a_client_that_refuses_everything_ends_its_keys_with_enter_and_is_not_echoed(served: Served) -> None:
    with served.at_the_menu() as client:
        client.send(REFUSED + b"d\r\n")
        client.read_until(r"['\r']")
        assert served.house.menu.ends_keys_with_enter
        assert not served.house.menu.echoes


def test_a_live_display_goes_on_by_itself(served: Served) -> None:
    with served.at_the_menu() as client:
        client.send(b"L")
        client.read_until("tick\r\n")
        client.read_until("tick\r\n")


def test_a_job_that_is_done_in_another_thread_shows_at_once(served: Served) -> None:
    with serving(wait_limit_s=60.0) as patient, patient.at_the_menu() as client:
        patient.house.menu.says_at_tick = "done\n"
        patient.house.menu.wake()
        client.read_until("done\r\n")


def test_two_people_one_menu_and_the_second_has_it_after_the_first(served: Served) -> None:
    with served.at_the_menu() as first, served.client() as second:
        second.read_until("127.0.0.1 (telnet) has the menu.\r\n")
        first.send(b"q")
        assert first.read_all().endswith("['q']")
        second.read_until(MAIN_MENU)


# ------------------------------------------------------------------------------------------------ passwords


def test_a_real_login_with_a_wrong_password_and_then_the_right_one() -> None:
    with serving(password=CHEAP_HASH) as served, served.client() as client:
        client.read_until("Password: ")
        client.send(b"wrong password\r\n")
        client.read_until("Wrong password.\r\nPassword: ")
        client.send(PASSWORD.encode() + b"\r\0")
        assert PASSWORD not in client.read_until(MAIN_MENU)


# ------------------------------------------------------------------------------------------------ who may come in


def test_who_is_in_no_allowed_network_is_closed_without_a_word_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    telnet = {"allow": ["10.0.0.0/8", "127.0.0.2/32"]}
    with serving(telnet=telnet) as served:
        with served.client() as client:
            assert client.read_all() == ""
        assert "127.0.0.1 is not in the allowed networks" in caplog.text
        with served.client("127.0.0.2") as client:
            client.read_until(MAIN_MENU)


@pytest.mark.parametrize(
    ("host", "networks", "verdict"),
    [
        ("10.1.2.3", [], True),
        ("10.1.2.3", ["10.0.0.0/8"], True),
        ("11.1.2.3", ["10.0.0.0/8"], False),
        ("::ffff:10.1.2.3", ["10.0.0.0/8"], True),
        ("fe80::1%eth0", ["fe80::/10"], True),
        ("fe80::1%eth0", ["10.0.0.0/8"], False),
    ],
)
def test_addresses_of_every_kind_are_looked_up_in_the_networks(host: str, networks: list[str], verdict: bool) -> None:
    assert is_allowed(host, networks) is verdict


def test_one_session_more_than_there_may_be_is_told_so_and_closed(served: Served) -> None:
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(served.client()) for _ in range(SESSIONS_MOST)]
        for client in clients[1:]:
            client.read_until("has the menu")
        clients[0].read_until(MAIN_MENU)
        with served.client() as late:
            late.send(AGREED)
            assert late.read_all() == "There are 8 sessions already: try again later.\r\n"
        clients[-1].socket.close()
        served.run.wait_until(lambda: len(served.task.connections) < SESSIONS_MOST)
        with served.client() as later:
            later.read_until("has the menu")


def test_a_flood_of_connections_is_bounded(served: Served) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(3 * CONNECTIONS_MOST):
            stack.enter_context(served.client())
        served.run.come_round()
        assert len(served.task.connections) <= CONNECTIONS_MOST
    served.run.wait_until(lambda: not served.task.connections)
    with served.client() as client:
        client.read_until(MAIN_MENU)


# -------------------------------------------------------------------------------------- clients that misbehave


def test_a_reset_in_the_middle_of_a_dialogue_frees_the_seat(served: Served) -> None:
    with served.client() as client, served.client() as second:
        client.read_until(MAIN_MENU)
        client.send(b"z1")
        client.read_until("['1']")
        client.reset()
        second.read_until(MAIN_MENU)
    assert served.house.menus[0].is_closed


def test_a_client_that_closes_frees_the_seat(served: Served) -> None:
    with served.at_the_menu():
        pass
    with served.client() as second:
        second.read_until(MAIN_MENU)


def test_a_client_that_reads_nothing_disturbs_nobody_and_what_waits_for_it_is_bounded(served: Served) -> None:
    with served.at_the_menu() as deaf, served.client() as other:
        other.read_until("has the menu")
        deaf.socket.setblocking(False)
        for _ in range(200):
            with contextlib.suppress(BlockingIOError):
                deaf.socket.send(b"B" * 4096)
            served.run.come_round()
        connections = list(served.task.connections.values())
        assert max(len(c.conversation.output) for c in connections) < 10_000
        ticks = served.house.menu.ticks
        served.house.menu.wake()
        served.run.come_round()
        assert served.house.menu.ticks == ticks  # no refresh for who does not read
        other.send(bytes([IAC, 246]))
        other.read_until("[rtugate is here]")


def test_a_storm_of_bytes_from_one_client_ends_and_the_others_are_served(served: Served) -> None:
    storm = random.Random(3).randbytes(300_000).replace(b"q", b"").replace(b"Q", b"").replace(b"X", b"")
    with served.at_the_menu() as wild, served.client() as other:
        other.read_until("has the menu")
        wild.socket.setblocking(False)
        rest = memoryview(storm)
        while rest:
            readable, writable, _ = select.select([wild.socket], [wild.socket], [], PATIENCE_S)
            assert readable or writable
            if readable:
                assert wild.socket.recv(65536)
            if writable:
                rest = rest[wild.socket.send(rest[:8192]) :]
        other.send(bytes([IAC, 246]))
        other.read_until("[rtugate is here]")


def test_a_flood_is_read_no_faster_than_leaves_the_processor_to_modbus(served: Served) -> None:
    with served.at_the_menu() as client:
        started_s = CLOCK.monotonic()
        client.send(bytes(20 * 1024) + bytes([IAC, 246]))
        client.read_until("[rtugate is here]")
        assert CLOCK.monotonic() - started_s > 0.3


def test_newcomers_are_let_in_no_faster_than_leaves_the_processor_to_modbus(served: Served) -> None:
    started_s = CLOCK.monotonic()
    for _ in range(NEWCOMERS_MOST + 1):
        with served.client() as client:
            client.socket.recv(1)
            client.reset()
    assert CLOCK.monotonic() - started_s > 0.4


def test_an_option_storm_gets_bounded_answers(served: Served) -> None:
    with served.at_the_menu() as client:
        client.send(bytes([IAC, DO, 42, IAC, WILL, 43, IAC, 246]) * 5000 + b"d")
        got = client.read_until("['d']")
        assert len(got) < 60_000


# ------------------------------------------------------------------------------------------------ the end


def test_the_last_words_are_read_even_by_a_client_that_was_still_sending(served: Served) -> None:
    with served.at_the_menu() as client:
        client.send(b"q" + b"d" * 3000)
        assert client.read_all() == "['q']"


def test_a_client_that_never_closes_is_closed_after_its_last_words(served: Served) -> None:
    with served.at_the_menu() as client:
        started_s = CLOCK.monotonic()
        client.send(b"q")
        assert client.read_all() == "['q']"
        served.run.wait_until(lambda: not served.task.connections)
        assert CLOCK.monotonic() - started_s > LINGER_S * 0.9


def test_an_idle_session_is_told_and_closed() -> None:
    with serving(wait_limit_s=60.0, idle_timeout=1.0) as served, served.at_the_menu() as client:
        assert "Too long without a key" in client.read_all()


def test_stopping_says_goodbye_to_everybody() -> None:
    with serving() as served, served.client() as client, served.client() as second:
        client.read_until(MAIN_MENU)
        second.read_until("has the menu")
        served.run.stop()
        assert client.read_all() == "\r\nThe menu is closed: rtugate stops, or is configured anew.\r\n"
        assert "rtugate stops" in second.read_all()
        assert served.house.menu.is_closed
        assert served.house.seat.holder is None


def test_a_bug_in_the_menu_ends_the_task_and_frees_the_seat() -> None:
    with contextlib.ExitStack() as stack:
        stack.enter_context(pytest.raises(ZeroDivisionError))
        served = stack.enter_context(serving())
        client = stack.enter_context(served.at_the_menu())
        client.send(b"X")
        client.read_all()
    assert served.house.seat.holder is None
    assert served.house.menu.is_closed


# ------------------------------------------------------------------------------------------------ the port


def test_a_port_in_use_is_an_alarm_and_listened_on_when_it_is_free(caplog: pytest.LogCaptureFixture) -> None:
    with listen() as taken:
        port = taken.getsockname()[1]
        with serving(lambda: listen_tcp("127.0.0.1", port)) as served:
            served.run.wait_until(lambda: served.task.trouble)
            assert "in use" in served.task.trouble
            assert served.task.ready.is_set()
            taken.close()
            served.run.wait_until(lambda: served.task.port == port)
            assert served.task.trouble == ""
    assert len([r for r in caplog.records if "in use" in r.message]) == 1


def test_while_no_descriptor_is_left_the_sessions_go_on(caplog: pytest.LogCaptureFixture) -> None:
    class Exhausted:
        """A listening socket of a program without descriptors, until it has some."""

        def __init__(self) -> None:
            self.real = listen()
            self.is_out = False

        def accept(self) -> tuple[socket.socket, Any]:
            if self.is_out:
                raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
            return self.real.accept()

        def __getattr__(self, name: str) -> Any:
            return getattr(self.real, name)

    made = Exhausted()
    with serving(lambda: made) as served, served.at_the_menu() as client:  # type: ignore[arg-type, return-value]  # like a socket
        made.is_out = True
        with served.client() as late:
            served.run.wait_until(lambda: "could not be accepted" in caplog.text)
            client.send(b"d")
            client.read_until("['d']")
            made.is_out = False
            late.read_until("has the menu")


def test_a_client_that_is_gone_before_it_is_welcomed_is_forgotten(served: Served) -> None:
    def welcome(accepted: socket.socket, wake: Callable[[], None]) -> LastWords:
        raise OSError(errno.ENOTCONN, "not connected")

    with serving(welcome=welcome) as strange, strange.client() as client:
        assert client.read_all() == ""
        assert not strange.task.connections


def test_a_step_waits_no_longer_than_it_may(clock: JumpingClock) -> None:
    def missing() -> socket.socket:
        raise LinkUnavailable("tcp 127.0.0.1:23: permission denied")

    house = House(clock)
    with contextlib.closing(Waker()) as waker:
        task = Terminals("telnet", clock, waker, missing, TelnetDoor(house.shared), wait_limit_s=0.02)
        for _ in range(10):
            started_s = CLOCK.monotonic()
            task.step()
            assert CLOCK.monotonic() - started_s < 1.0
            clock.pass_s(5.0)
        assert "permission denied" in task.trouble
        task.set_enabled(False)
        task.close()


# ------------------------------------------------------------------------------------------------ the real program


def terminal_size(descriptor: int, rows: int, columns: int) -> None:
    fcntl.ioctl(descriptor, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))


class Person:
    """Somebody at a terminal in which a program runs."""

    def __init__(self, pty: Pty) -> None:
        self.pty = pty
        self._got = b""

    def type(self, text: bytes) -> None:
        os.write(self.pty.wire, text)

    def sees(self, words: str) -> str:
        """Wait for *words*; return all up to them."""
        while words.encode() not in self._got:
            ready = select.select([self.pty.wire], [], [], PATIENCE_S)[0]
            assert ready, f"{words!r} has not come, but {self._got!r}"
            self._got += os.read(self.pty.wire, 4096)
        text, _, self._got = self._got.partition(words.encode())
        return text.decode() + words


@contextmanager
def telnet_program(port: int | None) -> Iterator[tuple[Person, subprocess.Popen[bytes]]]:
    """Run Debian's telnet in a pty of its own, 100 x 40."""
    with pty_pair() as pty:
        terminal_size(pty.wire, 40, 100)
        terminal = os.open(pty.device, os.O_RDWR | os.O_NOCTTY)
        command = ["telnet", "127.0.0.1", str(port)]
        with subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=terminal) as program:
            os.close(terminal)
            try:
                yield Person(pty), program
            finally:
                program.kill()


needs_telnet = pytest.mark.skipif(shutil.which("telnet") is None, reason="the program telnet is not installed")


@needs_telnet
def test_the_program_telnet_gives_each_key_at_once_and_leaves_the_echo_to_us() -> None:
    with serving(password=CHEAP_HASH) as served:
        served.run.wait_until(lambda: served.task.port)
        with telnet_program(served.task.port) as (person, program):
            person.sees("Password: ")
            person.type(PASSWORD.encode() + b"\r")
            assert PASSWORD not in person.sees("> ")
            person.type(b"d")
            assert person.sees("['d']") == "['d']"
            person.type(b"\x1b[A\r")
            person.sees(r"['\r']")
            menu = served.house.menu
            assert menu.keys == ["d", "\r"]
            assert (menu.echoes, menu.rows, menu.columns) == (True, 40, 100)
            person.type(b"\xc3\xa9\x7f")
            person.sees(r"['\x08']")
            assert menu.keys[2] == "\u00e9"
            person.type(b"q")
            person.sees("Connection closed by foreign host.")
            program.wait(PATIENCE_S)


@needs_telnet
def test_the_program_telnet_in_line_mode_still_has_the_menu(served: Served) -> None:
    served.run.wait_until(lambda: served.task.port)
    with telnet_program(served.task.port) as (person, _program):
        person.sees("> ")
        person.type(b"\x1d")  # Ctrl-]: to telnet itself
        person.sees("telnet> ")
        person.type(b"mode line\n")  # the terminal is as raw as it was given
        (connection,) = served.task.connections.values()
        session = connection.conversation
        assert isinstance(session, TelnetSession)
        served.run.wait_until(lambda: session.ends_keys_with_enter)
        person.type(b"d\n")
        person.sees(r"['\r']")
        assert served.house.menu.keys == ["d", "\r"]
        assert served.house.menu.ends_keys_with_enter


def test_a_storm_of_refused_connections_is_logged_once_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    with serving(telnet={"allow": ["10.0.0.0/8"]}) as served:
        for _ in range(5):
            with served.client() as client:
                assert client.read_all() == ""
    assert caplog.text.count("is not in the allowed networks") == 1
