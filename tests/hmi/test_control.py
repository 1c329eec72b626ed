"""A real control socket: stale, living, strange; its commands, and the menu behind it (spec sections 5 and 9)."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import socket
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.errors import GatewayError, LinkUnavailable
from gateway.hmi.control import AlreadyRunning, ControlDoor, open_control
from gateway.hmi.terminals import SESSIONS_MOST, Terminals
from gateway.link import Waker
from tests.fakes import JumpingClock
from tests.hmi.terminals import CHEAP_HASH, CLOCK, MAIN_MENU, Client, House, unix_client
from tests.lines import Running, running


class Controlled:
    """A control socket's task that runs."""

    def __init__(self, path: Path, house: House, task: Terminals, run: Running) -> None:
        self.path, self.house, self.task, self.run = path, house, task, run

    @contextmanager
    def client(self) -> Iterator[Client]:
        with unix_client(self.path) as client:
            yield client

    def asked(self, line: bytes) -> str:
        """Send *line*; return all that is answered until the gateway closes."""
        with self.client() as client:
            client.send(line)
            return client.read_all()


def refuse(_argument: str) -> str:
    raise GatewayError("the file has 2 errors")


def fail(_argument: str) -> str:
    raise ZeroDivisionError("a bug in a command")


COMMANDS: dict[str, Callable[[str], str]] = {
    "status": lambda argument: f"all is well {argument}",
    "large": lambda _argument: "x" * 1_000_000 + "\n",
    "reload": refuse,
    "bug": fail,
}


@contextmanager
def controlled(path: Path, house: House | None = None, wait_limit_s: float = 0.05) -> Iterator[Controlled]:
    house = house or House(CLOCK, password=CHEAP_HASH)
    with contextlib.closing(Waker()) as waker:
        door = ControlDoor(house.shared, COMMANDS)
        task = Terminals("control socket", CLOCK, waker, lambda: open_control(path), door, wait_limit_s)
        with running(task) as run:
            run.wait_until(task.ready.is_set)
            yield Controlled(path, house, task, run)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "control"


@pytest.fixture
def control(path: Path) -> Iterator[Controlled]:
    with controlled(path) as made:
        yield made


# ------------------------------------------------------------------------------------------------ the socket


def test_the_socket_is_for_the_group_alone_whatever_the_umask_and_is_removed_on_stop(path: Path) -> None:
    before = os.umask(0o000)
    try:
        with controlled(path) as control:
            assert stat.S_IMODE(path.stat().st_mode) == 0o660
            assert control.task.port is None
    finally:
        os.umask(before)
    assert not path.exists()
    assert list(path.parent.iterdir()) == []


def test_a_stale_socket_is_replaced(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with controlled(path) as control:
        assert control.asked(b"status\n") == "all is well \n"


def test_a_living_socket_means_that_rtugate_runs_already(control: Controlled) -> None:
    with pytest.raises(AlreadyRunning, match="runs already"):
        open_control(control.path)
    assert control.asked(b"status\n") == "all is well \n"


def test_a_living_socket_whose_queue_is_full_is_living_all_the_same(path: Path) -> None:
    with contextlib.ExitStack() as stack:
        busy = stack.enter_context(socket.socket(socket.AF_UNIX))
        busy.bind(str(path))
        busy.listen(0)
        code = 0
        while code == 0:
            waiting = stack.enter_context(socket.socket(socket.AF_UNIX))
            waiting.setblocking(False)
            code = waiting.connect_ex(str(path))
        with pytest.raises(AlreadyRunning, match="runs already"):
            open_control(path)


def test_two_that_start_at_once_do_not_take_each_others_socket_for_a_stale_one(path: Path) -> None:
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        with pytest.raises(AlreadyRunning, match="at this moment"):
            open_control(path)
    finally:
        os.close(folder)
    open_control(path).close()


def test_a_file_that_is_no_socket_stays_as_it_is(path: Path) -> None:
    path.write_text("precious")
    with pytest.raises(LinkUnavailable, match="no socket"):
        open_control(path)
    assert path.read_text() == "precious"


def test_what_cannot_be_made_is_told_and_an_alarm(tmp_path: Path) -> None:
    with pytest.raises(LinkUnavailable, match="no such file or directory"):
        open_control(tmp_path / "missing" / "control")
    with pytest.raises(LinkUnavailable, match="too long"):
        open_control(tmp_path / ("x" * 120))
    with controlled(tmp_path / "missing" / "control") as control:
        assert "no such file" in control.task.trouble


def test_a_socket_that_cannot_be_asked_is_not_removed(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.bind(str(path))
        with pytest.raises(LinkUnavailable, match="wrong type"):
            open_control(path)
        assert path.exists()


# ------------------------------------------------------------------------------------------------ commands


def test_a_command_is_answered_and_closed(control: Controlled) -> None:
    assert control.asked(b"status --json\r\n") == "all is well --json\n"


def test_a_client_that_has_closed_its_half_is_answered_all_the_same(control: Controlled) -> None:
    with control.client() as client:
        client.send(b"status\n")
        client.socket.shutdown(socket.SHUT_WR)
        assert client.read_all() == "all is well \n"


def test_a_long_answer_comes_whole(control: Controlled) -> None:
    assert len(control.asked(b"large\n")) == 1_000_001


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"dance\n", "error: there is no command dance\n"),
        (b"\n", "error: there is no command without a name\n"),
        (b"\xff\x1b[2J\n", "error: there is no command \ufffd\\x1b[2J\n"),
        (b"reload\n", "error: the file has 2 errors\n"),
        (b"bug\n", "error: it failed; the log says why\n"),
        (b"x" * 201, "error: a command has 200 bytes at most\n"),
        (b"menu\n", "error: menu COLUMNS ROWS [NAME]\n"),
        (b"menu 80 x maria\n", "error: menu COLUMNS ROWS [NAME]\n"),
        (b"menu 80 -1 maria\n", "error: menu COLUMNS ROWS [NAME]\n"),
        (b"menu 80 24000000000 maria\n", "error: menu COLUMNS ROWS [NAME]\n"),
        ("menu 80 \u0664\u00b2 maria\n".encode(), "error: menu COLUMNS ROWS [NAME]\n"),
    ],
)
def test_what_is_no_good_command_is_told_so(control: Controlled, line: bytes, answer: str) -> None:
    assert control.asked(line) == answer


def test_a_command_may_come_in_pieces(control: Controlled) -> None:
    with control.client() as client:
        for byte in b"status\n":
            client.send(bytes([byte]))
            control.run.come_round()
        assert client.read_all() == "all is well \n"


def test_a_client_that_says_nothing_is_closed_after_5_s(path: Path, clock: JumpingClock) -> None:
    house = House(clock)
    with controlled(path, house) as control, control.client() as client:
        control.run.wait_until(lambda: control.task.connections)
        client.send(b"stat")
        clock.pass_s(4.9)
        control.run.come_round()
        assert client.has_nothing()
        clock.pass_s(0.2)
        assert client.read_all() == "error: no command\n"


def test_a_client_that_leaves_without_a_command_is_forgotten(control: Controlled) -> None:
    with control.client() as client:
        client.send(b"stat")
    control.run.wait_until(lambda: not control.task.connections)


def test_a_slow_command_holds_up_no_menu_and_may_outlive_its_client(path: Path) -> None:
    go, done = threading.Event(), threading.Event()

    def slow(_argument: str) -> str:
        go.wait(5)
        done.set()
        return "at last"

    house = House(CLOCK)
    with contextlib.closing(Waker()) as waker:
        door = ControlDoor(house.shared, {"slow": slow})
        task = Terminals("control socket", CLOCK, waker, lambda: open_control(path), door, 0.05)
        with running(task) as run:
            run.wait_until(task.ready.is_set)
            with unix_client(path) as asking, unix_client(path) as person:
                asking.send(b"slow\n")
                person.send(b"menu 80 24 maria\n")
                person.read_until(MAIN_MENU)
                asking.reset()
                go.set()
                assert done.wait(5)
                person.send(b"d")
                person.read_until("['d']")


def test_a_clients_last_words_after_its_command_are_nobodys(control: Controlled) -> None:
    with control.client() as client:
        client.send(b"dance\nand more")
        client.send(b" and more")
        assert client.read_all() == "error: there is no command dance\n"


# ------------------------------------------------------------------------------------------------ the menu


def test_the_menu_is_there_without_a_password_and_what_follows_the_command_is_not_lost(control: Controlled) -> None:
    with control.client() as client:
        client.send(b"menu 132 50 maria\n")
        client.read_until(MAIN_MENU)
        client.send(b"d")
        client.read_until("['d']")
        menu = control.house.menu
        assert (menu.who, menu.columns, menu.rows, menu.echoes) == ("maria (rtugate menu)", 132, 50, True)


def test_keys_sent_with_the_command_reach_a_menu_that_is_free(control: Controlled) -> None:
    with control.client() as client:
        client.send(b"menu 80 24\ndq")
        assert client.read_all() == f"\r\n{MAIN_MENU}['d']['q']"
    assert control.house.menu.who == "somebody (rtugate menu)"


def test_absurd_sizes_are_made_sensible_ones_and_names_are_escaped(
    control: Controlled, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with control.client() as client:
        client.send(b"menu 1 9999 ma\x1b[2Jria\x07" + b"x" * 80 + b"\n")
        client.read_until(MAIN_MENU)
        assert (control.house.menu.columns, control.house.menu.rows) == (40, 200)
        assert control.house.menu.who.startswith("ma\\x1b[2Jria\\x07xxx")
        assert "\x1b" not in caplog.text
        assert len(control.house.menu.who) < 60


def test_a_pipe_that_ends_is_carried_out_first(control: Controlled) -> None:
    with control.client() as client:
        client.send(b"menu 80 24 maria\n" + b"d" * 100)
        client.socket.shutdown(socket.SHUT_WR)
        assert client.read_all().endswith("['d']" * 100)


def test_one_menu_more_than_there_may_be_is_told_so_but_commands_still_work(control: Controlled) -> None:
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(control.client()) for _ in range(SESSIONS_MOST)]
        for client in clients:
            client.send(b"menu 80 24 maria\n")
        clients[0].read_until(MAIN_MENU)
        for client in clients[1:]:
            client.read_until("has the menu")
        assert control.asked(b"menu 80 24 late\n") == "There are 8 sessions already: try again later.\r\n"
        assert control.asked(b"status\n") == "all is well \n"


def test_a_client_that_is_gone_frees_the_seat(control: Controlled) -> None:
    with control.client() as first, control.client() as second:
        first.send(b"menu 80 24 a\n")
        first.read_until(MAIN_MENU)
        second.send(b"menu 80 24 b\n")
        second.read_until("has the menu")
        first.socket.close()
        second.read_until(MAIN_MENU)


def test_stopping_ends_menus_and_unfinished_commands(path: Path) -> None:
    with controlled(path) as control, control.client() as client, control.client() as silent:
        client.send(b"menu 80 24 maria\n")
        client.read_until(MAIN_MENU)
        control.run.stop()
        assert "The menu is closed: rtugate stops" in client.read_all()
        assert silent.read_all() == "error: rtugate stops\n"
