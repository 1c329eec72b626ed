"""What systemd is told, read from a real socket such as systemd has, at a path and without one."""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.systemd import LONG_S, STATUS_CHARACTERS, STATUS_PACE_S, Systemd
from tests.fakes import JumpingClock


class Manager:
    """The socket that NOTIFY_SOCKET names, and what has come to it."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address.replace("@", "\0", 1) if address.startswith("@") else address)
        self._socket.setblocking(False)

    def heard(self) -> list[str]:
        """Every datagram since the last call."""
        messages = []
        with contextlib.suppress(BlockingIOError):
            while True:
                messages.append(self._socket.recv(4096).decode())
        return messages

    def fill(self) -> None:
        """Let its queue run full: it is too busy to read."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other, contextlib.suppress(BlockingIOError):
            other.setblocking(False)
            while True:
                other.sendto(b"X=1", self._socket.getsockname())

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    with contextlib.closing(Manager(str(tmp_path / "notify"))) as manager:
        yield manager


@pytest.fixture
def a_systemd(manager: Manager, clock: JumpingClock) -> Iterator[Callable[..., Systemd]]:
    """Makes a ``Systemd`` of an environment, by default with the manager's socket."""
    with contextlib.ExitStack() as stack:

        def make(**environ: str) -> Systemd:
            systemd = Systemd.from_environment(clock, {"NOTIFY_SOCKET": manager.address} | environ)
            stack.callback(systemd.close)
            return systemd

        yield make


Make = Callable[..., Systemd]


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [f"{record.levelname} {record.getMessage()}" for record in caplog.records]


# --- states


def test_ready_and_stopping_are_a_datagram_each(manager: Manager, a_systemd: Make) -> None:
    systemd = a_systemd()
    systemd.ready()
    systemd.stopping()
    assert manager.heard() == ["READY=1", "STOPPING=1"]


def test_an_abstract_socket_is_told_as_well(clock: JumpingClock) -> None:
    with contextlib.closing(Manager(f"@rtugate-test-{os.getpid()}")) as manager:
        systemd = Systemd.from_environment(clock, {"NOTIFY_SOCKET": manager.address})
        systemd.ready()
        systemd.close()
        assert manager.heard() == ["READY=1"]


def test_reloading_carries_the_time_in_the_same_datagram_and_ready_ends_it(
    manager: Manager, a_systemd: Make, clock: JumpingClock
) -> None:
    systemd = a_systemd()
    clock.pass_s(0.25)
    systemd.reloading()
    systemd.ready()
    assert manager.heard() == ["RELOADING=1\nMONOTONIC_USEC=1000250000", "READY=1"]


def test_the_time_of_reloading_is_the_kernels_monotonic_clock(manager: Manager) -> None:
    systemd = Systemd.from_environment(SystemClock(), {"NOTIFY_SOCKET": manager.address})
    before_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    systemd.reloading()
    after_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    systemd.close()
    (message,) = manager.heard()
    assert before_ns // 1000 - 1 <= int(message.partition("MONOTONIC_USEC=")[2]) <= after_ns // 1000


@pytest.mark.parametrize("environ", [{}, {"NOTIFY_SOCKET": ""}, {"WATCHDOG_USEC": "3000000"}])
def test_without_systemd_every_call_does_nothing(
    clock: JumpingClock, environ: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    systemd = Systemd.from_environment(clock, environ)
    systemd.ready()
    systemd.reloading()
    systemd.status("all is well")
    systemd.stopping()
    assert systemd.feed() == LONG_S
    systemd.close()
    assert lines(caplog) == []


def test_the_programs_own_environment_is_read_and_left_as_it_is(
    manager: Manager, clock: JumpingClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", manager.address)
    systemd = Systemd.from_environment(clock)
    systemd.ready()
    systemd.close()
    assert (manager.heard(), os.environ["NOTIFY_SOCKET"]) == (["READY=1"], manager.address)


def test_closed_it_tells_nothing_any_more(manager: Manager, a_systemd: Make) -> None:
    systemd = a_systemd(WATCHDOG_USEC="3000000")
    systemd.ready()
    systemd.close()
    systemd.close()
    systemd.status("all is well")
    systemd.stopping()
    assert (systemd.feed(), manager.heard()) == (LONG_S, ["READY=1"])


def test_no_child_inherits_the_socket(manager: Manager, a_systemd: Make) -> None:
    a_systemd().ready()
    code = "import os; print(sum(os.readlink(f'/proc/self/fd/{n}').startswith('socket') for n in range(3, 100)"
    code += " if os.path.exists(f'/proc/self/fd/{n}')))"
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        close_fds=False,
        stdin=subprocess.DEVNULL,
    )
    assert result.stdout == "0\n"


# --- the watchdog


@pytest.mark.parametrize("tick_s", [0.01, 0.3, 1.0, 7.0])
@pytest.mark.parametrize("watchdog_s", [3, 25, 180])
def test_it_is_fed_between_a_quarter_and_a_half_of_its_time(
    manager: Manager, a_systemd: Make, clock: JumpingClock, watchdog_s: int, tick_s: float
) -> None:
    systemd = a_systemd(WATCHDOG_USEC=str(watchdog_s * 1_000_000), WATCHDOG_PID=str(os.getpid()))
    fed_at_s: list[float] = []
    while clock.monotonic() < 1000.0 + 8 * watchdog_s:
        wait_s = systemd.feed()
        fed_at_s += [clock.monotonic() for _ in manager.heard()]
        clock.pass_s(min(tick_s, wait_s))
    assert fed_at_s[0] == 1000.0
    assert len(fed_at_s) >= 16
    gaps = [(after - before) / watchdog_s for before, after in itertools.pairwise(fed_at_s)]
    assert min(gaps) >= 0.25
    assert max(gaps) <= 0.5


def test_feeding_says_when_it_wants_to_be_called_again(a_systemd: Make, clock: JumpingClock) -> None:
    systemd = a_systemd(WATCHDOG_USEC="30000000")
    assert systemd.feed() == 10.0
    clock.pass_s(4.0)
    assert systemd.feed() == 6.0


def test_too_late_a_call_feeds_at_once(manager: Manager, a_systemd: Make, clock: JumpingClock) -> None:
    systemd = a_systemd(WATCHDOG_USEC="30000000")
    systemd.feed()
    clock.pass_s(29.0)
    assert systemd.feed() == 10.0
    assert manager.heard() == ["WATCHDOG=1", "WATCHDOG=1"]


def test_no_watchdog_asked_for_is_never_fed(manager: Manager, a_systemd: Make, clock: JumpingClock) -> None:
    systemd = a_systemd()
    for _ in range(100):
        assert systemd.feed() == LONG_S
        clock.pass_s(1000.0)
    assert manager.heard() == []


def test_a_watchdog_of_another_process_is_not_ours(
    manager: Manager, a_systemd: Make, caplog: pytest.LogCaptureFixture
) -> None:
    systemd = a_systemd(WATCHDOG_USEC="3000000", WATCHDOG_PID=str(os.getppid()))
    assert (systemd.feed(), manager.heard(), lines(caplog)) == (LONG_S, [], [])


@pytest.mark.parametrize(
    "text", ["abc", "-3000000", "3.5", "0", "inf", " 3000000", "3_000_000", "٣٠٠٠", "18446744073709551615", "9" * 5000]
)
def test_a_watchdog_time_that_is_none_is_logged_and_ignored(
    manager: Manager, a_systemd: Make, caplog: pytest.LogCaptureFixture, text: str
) -> None:
    systemd = a_systemd(WATCHDOG_USEC=text)
    systemd.ready()
    assert (systemd.feed(), manager.heard()) == (LONG_S, ["READY=1"])
    (line,) = lines(caplog)
    assert line.startswith("WARNING systemd: WATCHDOG_USEC=")
    assert len(line) < 200


def test_a_process_number_that_is_none_is_logged_and_the_watchdog_fed(
    manager: Manager, a_systemd: Make, caplog: pytest.LogCaptureFixture
) -> None:
    systemd = a_systemd(WATCHDOG_USEC="3000000", WATCHDOG_PID="me")
    assert (systemd.feed(), manager.heard()) == (1.0, ["WATCHDOG=1"])
    assert lines(caplog) == ["WARNING systemd: WATCHDOG_PID=me: is no process's number"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("nonsense", "is no socket's address"),
        ("relative/path", "is no socket's address"),
        ("/", "is no socket's address"),
        ("@", "is no socket's address"),
        ("/" + "x" * 107, "is no socket's address"),
        ("@" + "x" * 108, "is no socket's address"),
        ("vsock:2:1234", "only sockets of this machine are supported"),
        ("vsock-stream:2:1234", "only sockets of this machine are supported"),
    ],
)
def test_an_address_that_is_none_is_logged_and_ignored(
    a_systemd: Make, caplog: pytest.LogCaptureFixture, text: str, reason: str
) -> None:
    systemd = a_systemd(NOTIFY_SOCKET=text, WATCHDOG_USEC="3000000")
    systemd.ready()
    systemd.status("all is well")
    assert systemd.feed() == LONG_S
    (line,) = lines(caplog)
    assert line.startswith("WARNING systemd: NOTIFY_SOCKET=" + text[:20])
    assert line.endswith(reason)


@pytest.mark.parametrize("address", ["/nowhere/" + "x" * 98, "@" + "x" * 107])
def test_an_address_as_long_as_may_be_is_used(a_systemd: Make, caplog: pytest.LogCaptureFixture, address: str) -> None:
    a_systemd(NOTIFY_SOCKET=address).ready()
    (line,) = lines(caplog)
    assert line.startswith("WARNING systemd: cannot be told anything: ")
    assert line.endswith(("its socket is not there; trying again", "nobody listens; trying again"))


# --- the status


def test_a_status_is_sent_when_it_is_another_one(manager: Manager, a_systemd: Make, clock: JumpingClock) -> None:
    systemd = a_systemd()
    for text in ("field: 10 polls", "field: 10 polls", "field: offline", "field: offline"):
        systemd.status(text)
        clock.pass_s(STATUS_PACE_S)
    assert manager.heard() == ["STATUS=field: 10 polls", "STATUS=field: offline"]


def test_statuses_keep_a_pace_and_the_newest_wins(manager: Manager, a_systemd: Make, clock: JumpingClock) -> None:
    systemd = a_systemd()
    systemd.status("first")
    for number in range(40):
        clock.pass_s(0.1)
        systemd.status(f"number {number}")
    wait_s = systemd.feed()
    assert wait_s == pytest.approx(1.0)
    clock.pass_s(wait_s)
    assert systemd.feed() == LONG_S
    assert manager.heard() == ["STATUS=first", "STATUS=number 39"]


def test_a_status_that_was_taken_back_in_time_is_never_sent(manager: Manager, a_systemd: Make) -> None:
    systemd = a_systemd()
    for text in ("calm", "storm", "calm"):
        systemd.status(text)
    assert (systemd.feed(), manager.heard()) == (LONG_S, ["STATUS=calm"])


def test_a_change_of_state_takes_the_newest_status_along(manager: Manager, a_systemd: Make) -> None:
    systemd = a_systemd()
    systemd.status("runs")
    systemd.status("says good-bye")
    systemd.stopping()
    assert manager.heard() == ["STATUS=runs", "STOPPING=1", "STATUS=says good-bye"]


def test_a_status_is_one_line_without_control_characters_and_of_bounded_length(
    manager: Manager, a_systemd: Make
) -> None:
    systemd = a_systemd()
    systemd.status("a\nREADY=1\x1b[2J\udcff" + "ü" * 5000)
    (message,) = manager.heard()
    assert message.startswith("STATUS=a\\nREADY=1\\x1b[2J\\udcffüü")
    assert len(message) == len("STATUS=") + STATUS_CHARACTERS
    assert len(message.encode()) < 4096


# --- a manager that does not listen


def test_what_a_full_queue_did_not_take_is_sent_in_order_when_it_does(
    manager: Manager, a_systemd: Make, clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    systemd = a_systemd(WATCHDOG_USEC="30000000")
    systemd.feed()
    clock.pass_s(10.0)
    manager.fill()
    systemd.reloading()
    systemd.ready()
    systemd.status("runs")
    assert systemd.feed() == 1.0  # it does not wait 10 s with the watchdog that it could not feed
    manager.heard()
    assert systemd.feed() == 10.0
    assert manager.heard() == ["RELOADING=1\nMONOTONIC_USEC=1010000000", "READY=1", "STATUS=runs", "WATCHDOG=1"]
    assert lines(caplog) == [
        "WARNING systemd: cannot be told anything: its queue is full; trying again",
        "INFO systemd: can be told again",
    ]


def test_a_short_watchdog_is_tried_again_soon_enough(manager: Manager, a_systemd: Make) -> None:
    systemd = a_systemd(WATCHDOG_USEC="1200000")
    manager.fill()
    assert systemd.feed() == pytest.approx(0.1)


def test_a_status_that_could_not_be_sent_is_sent_later(manager: Manager, a_systemd: Make) -> None:
    systemd = a_systemd()
    manager.fill()
    systemd.status("runs")
    assert systemd.feed() == 1.0
    manager.heard()
    assert (systemd.feed(), manager.heard()) == (LONG_S, ["STATUS=runs"])


def test_nobody_there_is_logged_once_and_lived_with_until_systemd_is_back(
    clock: JumpingClock, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    address = str(tmp_path / "notify")
    systemd = Systemd.from_environment(clock, {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "3000000"})
    for _ in range(100):
        systemd.ready()
        systemd.feed()
        clock.pass_s(1.0)
    assert lines(caplog) == ["WARNING systemd: cannot be told anything: its socket is not there; trying again"]
    with contextlib.closing(Manager(address)) as manager:
        systemd.feed()
        assert set(manager.heard()) == {"READY=1", "WATCHDOG=1"}
    caplog.clear()
    systemd.status("runs")
    systemd.close()
    assert lines(caplog) == ["WARNING systemd: cannot be told anything: nobody listens; trying again"]


def test_states_that_nobody_takes_do_not_pile_up(clock: JumpingClock, tmp_path: Path) -> None:
    address = str(tmp_path / "notify")
    systemd = Systemd.from_environment(clock, {"NOTIFY_SOCKET": address})
    for _ in range(1000):
        systemd.reloading()
        systemd.ready()
    with contextlib.closing(Manager(address)) as manager:
        systemd.feed()
        heard = manager.heard()
    systemd.close()
    assert (len(heard), heard[-1]) == (8, "READY=1")
