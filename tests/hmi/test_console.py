"""The serial console on real ptys, and on a fake link for what no pty can do: breaks and damaged characters (spec
section 5). What the session does with keys: test_session.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import shutil
import subprocess
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given

from gateway.errors import LinkLost, LinkUnavailable
from gateway.hmi.console import NOISE_MOST, MarkedBytes, Noise, SerialConsole
from gateway.link import Link, SerialSettings, Waker, open_serial
from tests.fakes import JumpingClock, JumpingWaker
from tests.hmi.terminals import CLOCK, MAIN_MENU, House, Screen
from tests.lines import PATIENCE_S, Pty, Running, cable, pty_pair, running

BREAK, DAMAGED_A = b"\xff\x00\x00", b"\xff\x00A"


# ------------------------------------------------------------------------------------------------ marked bytes


@pytest.mark.parametrize(
    ("raw", "characters", "faults"),
    [
        (b"abc", b"abc", 0),
        (BREAK, b"", 1),
        (b"a" + DAMAGED_A + b"b", b"ab", 1),
        (b"a\xff\xffb", b"a\xffb", 0),  # a real FF
        (b"a\0b\0", b"ab", 2),  # NULs
        (b"\xff\x00\xff", b"", 1),  # a damaged FF
        (b"\xff\xff" + BREAK + b"\xff\xff", b"\xff\xff", 1),
        (b"\xffa", b"a", 0),  # a mark of a kind that there is not
    ],
)
def test_breaks_nuls_and_damaged_characters_are_no_characters(raw: bytes, characters: bytes, faults: int) -> None:
    for size in (1, 2, 3, 100):
        marked = MarkedBytes()
        found = b"".join(marked.receive(raw[at : at + size]) for at in range(0, len(raw), size))
        assert (found, marked.faults) == (characters, faults)


@given(st.binary(max_size=60), st.lists(st.integers(0, 60), max_size=8))
def test_any_bytes_give_the_same_characters_however_they_are_cut(raw: bytes, cuts: list[int]) -> None:
    whole, pieces = MarkedBytes(), MarkedBytes()
    edges = [0, *sorted(cuts), len(raw)]
    parts = [pieces.receive(raw[start:end]) for start, end in pairwise(edges)]
    assert b"".join(parts) == whole.receive(raw)
    assert pieces.faults == whole.faults


# ------------------------------------------------------------------------------------------------ noise


def test_more_than_100_faults_in_a_minute_are_an_alarm_until_a_quiet_minute(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    noise = Noise(clock)
    for _ in range(NOISE_MOST):
        clock.pass_s(0.5)
        noise.count(1)
    assert noise.trouble == ""
    noise.count(1)
    assert "noise on the line" in noise.trouble
    for _ in range(10):
        clock.pass_s(59)
        noise.count(1)
    assert noise.trouble
    clock.pass_s(59.9)
    noise.count(0)
    assert noise.trouble
    clock.pass_s(0.1)
    noise.count(0)
    assert noise.trouble == ""
    assert len(caplog.records) == 2


def test_100_faults_in_each_minute_are_no_alarm(clock: JumpingClock) -> None:
    noise = Noise(clock)
    for _ in range(5):
        noise.count(NOISE_MOST)
        clock.pass_s(60.1)
    assert noise.trouble == ""


def test_a_storm_in_one_piece_is_an_alarm(clock: JumpingClock) -> None:
    noise = Noise(clock)
    noise.count(10_000_000)
    assert noise.trouble


# ------------------------------------------------------------------------------------------------ a fake link


@dataclass
class FakeLink:
    """A port on a clock that jumps; reading returns what waits, or lets the time pass."""

    clock: JumpingClock
    character_s: float = 10 / 38400
    arriving: deque[bytes] = field(default_factory=deque)
    written: list[bytes] = field(default_factory=list)
    waits_s: list[float] = field(default_factory=list)
    lost: LinkLost | None = None
    is_closed: bool = False

    def read(self, timeout_s: float) -> bytes:
        if self.lost:
            raise self.lost
        self.waits_s.append(timeout_s)
        if self.arriving:
            return self.arriving.popleft()
        self.clock.pass_s(timeout_s)
        return b""

    def write(self, data: bytes) -> None:
        if self.lost:
            raise self.lost
        self.clock.pass_s(len(data) * self.character_s)
        self.written.append(data)

    def discard(self) -> int:
        return 0

    def close(self) -> None:
        self.is_closed = True


class Desk:
    """A console task on fake links, driven step by step."""

    def __init__(self, clock: JumpingClock, **link: Any) -> None:
        self.clock = clock
        self.house = House(clock, serial={"line": "/dev/ttyS3"})
        self.waker = JumpingWaker(clock)
        self.links: list[FakeLink] = []
        self.missing: LinkUnavailable | None = None
        self.link_settings = link
        self.task = SerialConsole(self.house.shared, clock, self.waker, self._open, wait_limit_s=3.0)

    def _open(self) -> Link:
        if self.missing:
            raise self.missing
        self.links.append(FakeLink(self.clock, **self.link_settings))
        return self.links[-1]

    @property
    def link(self) -> FakeLink:
        return self.links[-1]

    def steps(self, count: int = 12) -> str:
        """Step; return what was written meanwhile."""
        before = len(self.link.written) if self.links else 0
        for _ in range(count):
            self.task.step()
        return b"".join(self.link.written[before:]).decode() if self.links else ""

    def type(self, data: bytes) -> str:
        self.link.arriving.append(data)
        return self.steps()


def test_the_console_says_that_any_key_brings_the_menu_and_it_does(clock: JumpingClock) -> None:
    desk = Desk(clock)
    assert "Press any key for the menu." in desk.steps()
    assert desk.task.ready.is_set()
    assert desk.type(b" ").endswith(MAIN_MENU)
    assert desk.type(b"d") == "['d']"


def test_noise_takes_the_menu_from_nobody_and_its_alarm_comes_and_goes(clock: JumpingClock) -> None:
    desk = Desk(clock)
    desk.steps()
    telnet = Screen(desk.house)
    telnet.run_s(31)
    for _ in range(NOISE_MOST):
        desk.type(BREAK)
    desk.type(DAMAGED_A + b"\0")
    assert telnet.session.has_menu
    assert len(desk.house.menus) == 1
    desk.link.arriving.extend([BREAK * NOISE_MOST, b"\0"])
    desk.steps(3)
    assert "noise on the line" in desk.task.trouble
    clock.pass_s(60)
    desk.steps(1)
    assert desk.task.trouble == ""


def test_a_step_waits_no_longer_than_it_may_and_not_at_all_while_something_waits_to_be_written(
    clock: JumpingClock,
) -> None:
    desk = Desk(clock)
    desk.steps(2)
    assert desk.link.waits_s == [0.0]
    desk.steps(5)
    assert max(desk.link.waits_s) == 3.0
    desk.type(b"  ")
    desk.type(b"L")
    desk.link.waits_s.clear()
    desk.steps(8)
    assert 0.9 < max(desk.link.waits_s) <= 1.0  # the live display


def test_a_key_is_heard_in_the_middle_of_a_screen(clock: JumpingClock) -> None:
    desk = Desk(clock, character_s=10 / 1200)
    desk.steps(30)
    desk.type(b"  ")
    desk.link.written.clear()
    desk.link.arriving.append(b"B")
    desk.steps(20)
    desk.link.arriving.append(b"d")
    desk.steps(1)
    assert desk.house.menu.keys[-1] == "d"
    assert max(map(len, desk.link.written)) * 10 / 1200 <= 0.1


def test_a_port_that_is_missing_is_an_alarm_and_opened_when_it_comes(
    clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    desk = Desk(clock)
    desk.missing = LinkUnavailable("/dev/ttyS3: is not there")
    desk.steps(20)
    assert desk.task.trouble == "/dev/ttyS3: is not there"
    assert desk.task.ready.is_set()
    assert max(desk.waker.waits_s) <= 3.0
    assert len([r for r in caplog.records if "is not there" in r.message]) == 1
    desk.missing = None
    clock.pass_s(30)
    assert "Press any key" in desk.steps()
    assert desk.task.trouble == ""


def test_a_port_that_is_lost_in_mid_dialogue_frees_the_seat_and_is_opened_again(clock: JumpingClock) -> None:
    desk = Desk(clock)
    desk.steps()
    desk.type(b"  z")
    menu = desk.house.menu
    desk.link.lost = LinkLost("/dev/ttyS3: is gone (unplugged?)")
    desk.steps(1)
    assert menu.is_closed
    assert desk.house.seat.holder is None
    assert desk.links[0].is_closed
    assert "unplugged" in desk.task.trouble
    desk.steps(10)
    assert len(desk.links) == 2
    assert desk.type(b" ").endswith(MAIN_MENU)


def test_half_a_mark_from_before_the_port_was_lost_spoils_nothing(clock: JumpingClock) -> None:
    desk = Desk(clock)
    desk.steps()
    desk.type(b"\xff\x00")
    desk.link.lost = LinkLost("gone")
    desk.steps(10)
    desk.type(b" ")
    assert desk.house.menu.who == "serial console"


def test_the_menu_is_never_in_maintenance(clock: JumpingClock) -> None:
    desk = Desk(clock)
    desk.task.set_enabled(False)
    assert "Press any key" in desk.steps()


# ------------------------------------------------------------------------------------------------ real ptys


@dataclass
class Console:
    """A console task that runs."""

    house: House
    run: Running
    task: SerialConsole


@contextmanager
def console(device: str, baudrate: int = 38400, **hmi: Any) -> Iterator[Console]:
    """Give a console that runs on *device*."""
    house = House(CLOCK, serial={"line": device}, **hmi)
    settings = SerialSettings(device, baudrate=baudrate, parity="none", mark_errors=True)
    with contextlib.closing(Waker()) as waker:
        task = SerialConsole(house.shared, CLOCK, waker, lambda: open_serial(settings, waker, CLOCK), 0.05)
        with running(task) as run:
            yield Console(house, run, task)


@pytest.fixture
def pty() -> Iterator[Pty]:
    with pty_pair() as made:
        yield made


def until(descriptor: int, words: str) -> str:
    """Return what comes from *descriptor*, up to *words*, which have to come."""
    got = b""
    while words.encode() not in got:
        assert select.select([descriptor], [], [], PATIENCE_S)[0], f"{words!r} has not come, but {got!r}"
        got += os.read(descriptor, 1)
    return got.decode()


def test_a_person_at_a_real_terminal_has_the_menu(pty: Pty) -> None:
    with console(pty.device) as desk:
        until(pty.wire, "Press any key for the menu.")
        pty.send(b" ")
        until(pty.wire, "> ")
        pty.send(b"d\x1b[A\x1b")
        assert until(pty.wire, r"['\x1b']").endswith(r"['d']['\x1b']")
        pty.send(b"q")
        until(pty.wire, "Press any key for the menu.")
        assert desk.house.seat.holder is None


def test_a_real_ff_and_a_nul_through_a_port_that_marks_errors(pty: Pty) -> None:
    with console(pty.device) as desk:
        pty.send(b"\0" * 5)
        desk.run.come_round()
        assert desk.house.seat.holder is None
        pty.send(b"\xff")  # a character, if one that is no key: it takes the menu
        until(pty.wire, "> ")
        pty.send(b"\xff\0d")
        until(pty.wire, "['d']")
        assert desk.house.menu.keys == ["d"]


def test_a_storm_of_bytes_ends_and_the_console_still_answers(pty: Pty) -> None:
    long_screen = b"B"  # takes a second; what comes meanwhile waits
    storm = long_screen + random.Random(5).randbytes(100_000).translate(None, b"qQXB")
    with console(pty.device, baudrate=115200) as desk:
        got = bytearray()
        rest = memoryview(storm)
        while rest:
            ready, writable, _ = select.select([pty.wire], [pty.wire], [], PATIENCE_S)
            assert ready or writable, "the console has stopped"
            if ready:
                got += os.read(pty.wire, 65536)
            if writable:
                rest = rest[os.write(pty.wire, rest[:1024]) :]
        while b"'M']['M']['M']" not in got:
            if not select.select([pty.wire], [], [], 0.05)[0]:
                pty.send(b"MMM")
            else:
                got += os.read(pty.wire, 65536)
        assert "noise on the line" in desk.task.trouble


def test_a_console_stops_in_the_middle_of_a_screen_that_nobody_reads(pty: Pty) -> None:
    with console(pty.device):
        until(pty.wire, "Press any key for the menu.")
        pty.send(b" " + b"B" * 100)
        until(pty.wire, "b" * 100)


def test_an_unplugged_port_is_an_alarm(pty: Pty) -> None:
    with console(pty.device) as desk:
        until(pty.wire, "Press any key for the menu.")
        pty.unplug()
        desk.run.wait_until(lambda: desk.task.trouble)


@pytest.mark.skipif(shutil.which("picocom") is None, reason="picocom is not installed")
def test_picocom_shows_the_menu() -> None:
    with cable() as (near, far), console(near) as desk, pty_pair() as screen:
        desk.run.come_round()
        terminal = os.open(screen.device, os.O_RDWR | os.O_NOCTTY)
        command = ["picocom", "--baud", "38400", "--noreset", "--nolock", far]
        with subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=terminal) as picocom:
            os.close(terminal)
            until(screen.wire, "Terminal ready")
            os.write(screen.wire, b"\r")
            until(screen.wire, "> ")
            os.write(screen.wire, b"d")
            until(screen.wire, "['d']")
            os.write(screen.wire, b"\x01\x18")  # Ctrl-A Ctrl-X: picocom ends
            picocom.wait(PATIENCE_S)
