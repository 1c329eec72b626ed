"""`rtugate menu` in real terminals (ptys) and pipes, against a real control socket (spec section 9)."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.hmi import client
from gateway.hmi.client import run_menu
from tests.hmi.terminals import CLOCK, House
from tests.hmi.test_control import Controlled, controlled
from tests.hmi.test_terminals import Person, terminal_size
from tests.lines import PATIENCE_S, Pty, pty_pair

PROGRAM = "import sys; from pathlib import Path; from gateway.hmi.client import run_menu; "
PROGRAM += "sys.exit(run_menu(Path(sys.argv[1]), 0, 1))"


@pytest.fixture
def control(tmp_path: Path) -> Iterator[Controlled]:
    with controlled(tmp_path / "control", House(CLOCK)) as made:
        yield made


class InTerminal:
    """The client in a process of its own, in a terminal as a shell leaves it."""

    def __init__(self, pty: Pty, path: Path) -> None:
        self.person = Person(pty)
        self.terminal = os.open(pty.device, os.O_RDWR | os.O_NOCTTY)
        cooked = termios.tcgetattr(self.terminal)
        cooked[0] |= termios.ICRNL
        cooked[1] |= termios.OPOST | termios.ONLCR
        cooked[3] |= termios.ICANON | termios.ECHO | termios.ISIG
        termios.tcsetattr(self.terminal, termios.TCSANOW, cooked)
        self.before = termios.tcgetattr(self.terminal)
        terminal_size(self.terminal, 50, 120)
        self.program = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(path)],
            stdin=self.terminal,
            stdout=self.terminal,
            stderr=subprocess.PIPE,
            text=True,
        )

    def is_raw(self) -> bool:
        return not termios.tcgetattr(self.terminal)[3] & termios.ICANON

    def end(self) -> tuple[int, str]:
        """Return exit code and complaints; the terminal has to be what it was."""
        _, complaints = self.program.communicate(timeout=PATIENCE_S)
        assert termios.tcgetattr(self.terminal) == self.before
        return self.program.returncode, complaints


@contextmanager
def in_terminal(path: Path) -> Iterator[InTerminal]:
    with pty_pair() as pty:
        made = InTerminal(pty, path)
        try:
            yield made
        finally:
            made.program.kill()
            made.program.communicate()
            os.close(made.terminal)


def test_a_person_in_a_terminal_has_the_menu_and_leaves_by_q(control: Controlled) -> None:
    with in_terminal(control.path) as here:
        here.person.sees("MAIN MENU\r\n> ")
        assert here.is_raw()
        here.person.type(b"d\r\x03")
        here.person.sees(r"['d']['\r']['\x1b']")  # no echo of the terminal's own, Ctrl-C is a key
        menu = control.house.menu
        assert (menu.columns, menu.rows) == (120, 50)
        here.person.type(b"q")
        assert here.end() == (0, "")


def test_ctrl_bracket_leaves_whatever_the_menu_does_and_frees_the_seat(control: Controlled) -> None:
    with in_terminal(control.path) as here:
        here.person.sees("> ")
        here.person.type(b"z1\x1d")
        assert here.end() == (0, "")
    control.run.wait_until(lambda: control.house.seat.holder is None)
    assert control.house.menu.is_closed


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_ends_it_and_the_terminal_is_what_it_was(control: Controlled, number: signal.Signals) -> None:
    with in_terminal(control.path) as here:
        here.person.sees("> ")
        here.program.send_signal(number)
        assert here.end() == (1, "rtugate: ended by a signal\n")


def test_a_gateway_that_stops_says_so_and_the_terminal_is_what_it_was(tmp_path: Path) -> None:
    with controlled(tmp_path / "control", House(CLOCK)) as control, in_terminal(control.path) as here:
        here.person.sees("> ")
        control.run.stop()
        here.person.sees("rtugate stops")
        assert here.end() == (0, "")


def test_a_terminal_that_is_gone_ends_it(control: Controlled) -> None:
    with in_terminal(control.path) as here:
        here.person.sees("> ")
        here.person.pty.unplug()
        here.program.communicate(timeout=PATIENCE_S)
    control.run.wait_until(lambda: control.house.seat.holder is None)


# ------------------------------------------------------------------------------------------------ pipes


def piped(path: Path, typed: bytes) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-c", PROGRAM, str(path)]
    return subprocess.run(command, input=typed, capture_output=True, timeout=PATIENCE_S, check=False)


def test_a_pipe_is_carried_out_to_its_end(control: Controlled) -> None:
    done = piped(control.path, b"d1\n")
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.endswith(rb"['d']['1']['\r']")
    assert (control.house.menu.columns, control.house.menu.rows) == (80, 24)


def test_an_empty_pipe_leaves_at_once(control: Controlled) -> None:
    assert piped(control.path, b"").returncode == 0


def test_what_stands_behind_ctrl_bracket_is_not_sent(control: Controlled) -> None:
    assert piped(control.path, b"\x1dd").returncode == 0
    assert all("d" not in menu.keys for menu in control.house.menus)


def test_without_a_gateway_it_says_so(tmp_path: Path) -> None:
    path = tmp_path / "control"
    done = piped(path, b"")
    assert done.returncode == 1
    assert done.stderr.decode() == f"rtugate: no gateway runs here (no socket at {path})\n"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    assert b"no gateway runs here" in piped(path, b"").stderr


def test_other_troubles_are_told_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert client._why_not(tmp_path, PermissionError(13, "")).endswith("only root and the service's group may use it")
    assert run_menu(tmp_path / ("x" * 200), 0, 1) == 1
    assert "too long" in capsys.readouterr().err


def test_a_user_without_a_name_has_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 4_000_000_000)
    assert client._hello(-1) == b"menu 80 24 user 4000000000\n"


# ------------------------------------------------------------------------------------------------ a strange gateway


@contextmanager
def strange_gateway(path: Path, says: bytes) -> Iterator[threading.Thread]:
    """Give a socket behind which somebody says *says* and then goes with a reset."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                assert connection.recv(1) == b"m"  # the rest of its words stays unread: that makes the end a reset
                connection.sendall(says)

        thread = threading.Thread(target=serve)
        thread.start()
        yield thread
        thread.join(PATIENCE_S)


@pytest.mark.parametrize(
    ("says", "is_shown"),
    [
        (b"hello", "hello"),
        ("> no\b \b\r\nSí, ≥ 5 °C".encode(), "> no\b \b\r\nSí, ≥ 5 °C"),
        ("\x1b]0;evil\x07\x9b31m".encode() + b"\xff", "\\x1b]0;evil\\x07\\x9b31m\ufffd"),  # who has broken into it
    ],
)
def test_a_gateway_that_breaks_down_is_told_and_moves_no_cursor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], says: bytes, is_shown: str
) -> None:
    silent, keyboard = os.pipe()
    shown, screen = os.pipe()
    with strange_gateway(tmp_path / "control", says):
        assert run_menu(tmp_path / "control", silent, screen) == 1
    assert os.read(shown, 100).decode() == is_shown
    assert "the gateway is gone" in capsys.readouterr().err
    for end in (silent, keyboard, shown, screen):
        os.close(end)


def test_an_output_that_nobody_reads_any_more_ends_it(control: Controlled, capsys: pytest.CaptureFixture[str]) -> None:
    silent, keyboard = os.pipe()
    shown, screen = os.pipe()
    os.close(shown)
    assert run_menu(control.path, silent, screen) == 1
    assert "its output goes nowhere" in capsys.readouterr().err
    for end in (silent, keyboard, screen):
        os.close(end)


def test_a_signal_ends_it_while_its_output_is_stopped(control: Controlled, capsys: pytest.CaptureFixture[str]) -> None:
    silent, keyboard = os.pipe()
    shown, screen = os.pipe()
    os.set_blocking(screen, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(screen, bytes(4096))
    before, waiting = signal.getsignal(signal.SIGTERM), threading.Event()

    def tell() -> None:
        while signal.getsignal(signal.SIGTERM) is before:  # it would end the tests
            waiting.wait(0.01)
        os.kill(os.getpid(), signal.SIGTERM)

    teller = threading.Thread(target=tell)
    teller.start()
    assert run_menu(control.path, silent, screen) == 1
    teller.join()
    assert "ended by a signal" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) is before
    for end in (silent, keyboard, shown, screen):
        os.close(end)
