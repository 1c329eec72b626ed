"""What the kernel is asked for when a serial port is opened and written: each ioctl, byte by byte (spec section 2).

A pty has no RS-485, no RTS and no low-latency mode. So ``fcntl.ioctl`` of the standard library is replaced by a driver
that has them: it keeps what it is given, as Linux would, and hands everything else to the pty. Structures and numbers
are written out from the kernel's <linux/serial.h> and <asm-generic/ioctls.h>, not taken from pyserial.

Only hardware can tell whether a driver does what it has taken, and how RTS and the bits lie on the wire.
"""

from __future__ import annotations

import array
import contextlib
import errno
import fcntl
import os
import struct
import subprocess
import termios
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from gateway.errors import LinkLost, LinkSettingRefused, LinkUnavailable
from gateway.link import EchoLink, Link, RtsLink, SerialSettings, Waker, open_serial
from tests.lines import CLOCK, PATIENCE_S, Pty, pty_pair

TIOCMBIS, TIOCMBIC = 0x5416, 0x5417
TIOCGSERIAL, TIOCSSERIAL = 0x541E, 0x541F
TIOCGRS485, TIOCSRS485 = 0x542E, 0x542F
TIOCEXCL, TIOCNXCL, TIOCGEXCL = 0x540C, 0x540D, 0x80045440
RTS = bytes.fromhex("04 00 00 00")  # TIOCM_RTS
ENABLED, RTS_ON_SEND, RTS_AFTER_SEND, RX_DURING_TX, TERMINATE_BUS = 0x01, 0x02, 0x04, 0x10, 0x20
ASYNC_LOW_LATENCY = 0x2000
SERIAL_STRUCT = bytes(range(1, 17)) + struct.pack("=I", 0x10000000) + bytes(range(100, 152))  # flags at 16; 72 bytes

POLL = bytes.fromhex("01 03 00 6B 00 03 74 17")  # unit 1, read 3 holding registers from 107, CRC
REPLY = bytes.fromhex("01 03 06 02 2B 00 00 00 64 05 7A")
NOBODY = 65534


def rs485(flags: int, before_ms: int, after_ms: int) -> bytes:
    """Struct serial_rs485: flags, two delays in milliseconds, 20 bytes of addresses and padding."""
    return struct.pack("=III", flags, before_ms, after_ms) + bytes(20)


@dataclass
class Driver:
    """A driver for what a pty cannot do. *lacks*: requests it does not know."""

    rs485: bytes = rs485(0, 0, 0)
    serial: bytes = SERIAL_STRUCT
    lacks: frozenset[int] = frozenset()
    asked: list[tuple[str, bytes, float]] = field(default_factory=list)  # what, with what, when
    system = staticmethod(fcntl.ioctl)

    def ioctl(self, fd: Any, request: int, argument: Any = 0, mutate: bool = True) -> Any:
        if request in self.lacks:
            raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
        name = NAMES.get(request)
        if name is None:
            return self.system(fd, request, argument, mutate)
        given = bytes(argument) if isinstance(argument, bytes | array.array) else b""
        self.asked.append((name, given, CLOCK.monotonic()))
        if request in (TIOCEXCL, TIOCNXCL):
            return self.system(fd, request)
        if request == TIOCGRS485:
            self._show(argument, self.rs485)
        elif request == TIOCSRS485:
            self.rs485 = given
        elif request == TIOCGSERIAL:
            self._show(argument, self.serial)
        elif request == TIOCSSERIAL:
            self.serial = given[: len(self.serial)]
        return 0

    def given(self, name: str) -> list[bytes]:
        """What came with each request *name*, in order."""
        return [data for what, data, _ in self.asked if what == name]

    @staticmethod
    def _show(argument: array.array[int], held: bytes) -> None:
        view = memoryview(argument).cast("B")
        view[: len(held)] = held


NAMES = {
    TIOCMBIS: "TIOCMBIS",
    TIOCMBIC: "TIOCMBIC",
    TIOCGSERIAL: "TIOCGSERIAL",
    TIOCSSERIAL: "TIOCSSERIAL",
    TIOCGRS485: "TIOCGRS485",
    TIOCSRS485: "TIOCSRS485",
    TIOCEXCL: "TIOCEXCL",
    TIOCNXCL: "TIOCNXCL",
}


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Driver:
    made = Driver()
    monkeypatch.setattr(fcntl, "ioctl", made.ioctl)
    return made


@pytest.fixture
def pty() -> Iterator[Pty]:
    with pty_pair() as made:
        yield made


@contextlib.contextmanager
def opened(pty: Pty, **settings: Any) -> Iterator[Link]:
    with contextlib.closing(Waker()) as waker:
        link = open_serial(SerialSettings(pty.device, parity="none", **settings), waker, CLOCK)
        with contextlib.closing(link):
            yield link


# ------------------------------------------------------------------------------------------------ kernel mode


def test_the_kernel_is_given_the_rs485_structure_and_nothing_else(driver: Driver, pty: Pty) -> None:
    with opened(pty, rs485="kernel", rts_before_s=0.003, rts_after_s=0.002):
        pass
    assert driver.given("TIOCSRS485") == [
        bytes.fromhex(
            "03 00 00 00"  # SER_RS485_ENABLED, SER_RS485_RTS_ON_SEND; SER_RS485_RTS_AFTER_SEND is cleared
            "03 00 00 00"  # milliseconds before the first bit
            "02 00 00 00"  # milliseconds after the last
            "00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00"
        )
    ]


def test_the_other_polarity_and_listening_to_ourselves_are_switched_off_and_the_rest_is_kept(
    driver: Driver, pty: Pty
) -> None:
    driver.rs485 = rs485(RTS_AFTER_SEND | RX_DURING_TX | TERMINATE_BUS, 70, 80)  # a predecessor's
    with opened(pty, rs485="kernel"):
        assert driver.rs485 == rs485(ENABLED | RTS_ON_SEND | TERMINATE_BUS, 0, 0)


@pytest.mark.parametrize(
    ("delay_s", "delay_ms"),
    [
        (0.0, 0),
        (0.0000001, 1),
        (0.0005, 1),
        (0.001, 1),
        (0.0011, 2),
        (0.029, 29),  # 29.000000000000004 ms in binary
        (0.1, 100),
        (0.57, 570),  # 569.9999999999999 ms in binary
        (1.001, 1001),  # 1000.9999999999999
        (2.007, 2007),
    ],
)
def test_delays_are_whole_milliseconds_rounded_up(driver: Driver, pty: Pty, delay_s: float, delay_ms: int) -> None:
    with opened(pty, rs485="kernel", rts_before_s=delay_s, rts_after_s=delay_s):
        assert driver.rs485 == rs485(ENABLED | RTS_ON_SEND, delay_ms, delay_ms)


def test_rts_lets_go_of_the_pair_before_the_kernel_takes_over(driver: Driver, pty: Pty) -> None:
    with opened(pty, rs485="kernel") as link:
        switched = [(name, data) for name, data, _ in driver.asked if name in ("TIOCMBIS", "TIOCMBIC", "TIOCSRS485")]
        assert ("TIOCMBIS", RTS) not in switched
        assert switched.index(("TIOCMBIC", RTS)) < [name for name, _ in switched].index("TIOCSRS485")
        del driver.asked[:]
        link.write(POLL)
        assert pty.receive(len(POLL)) == POLL
    assert [name for name, _, _ in driver.asked] == ["TIOCNXCL"]  # the direction is the kernel's affair


@pytest.mark.parametrize("missing", [TIOCGRS485, TIOCSRS485])
def test_a_driver_without_kernel_mode_is_refused_in_clear_words(driver: Driver, pty: Pty, missing: int) -> None:
    driver.lacks = frozenset({missing})
    with pytest.raises(LinkSettingRefused) as told, opened(pty, rs485="kernel"):
        pass
    advice = 'use rs485 = "rts" or an adapter that switches by itself'
    assert str(told.value) == f"{pty.device} has no kernel RS-485 mode; {advice}"


@pytest.mark.parametrize("mode", ["none", "rts"])
def test_no_other_mode_touches_the_kernels(driver: Driver, pty: Pty, mode: str) -> None:
    with opened(pty, rs485=mode):
        assert not driver.given("TIOCSRS485")


# ------------------------------------------------------------------------------------------------ RTS


@dataclass
class Witness:
    """What happens to one descriptor, in order, with the time: RTS, writes, and the drain."""

    driver: Driver
    happened: list[tuple[str, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.write, self.drain, self.ioctl = os.write, termios.tcdrain, self.driver.ioctl

    def attach(self, monkeypatch: pytest.MonkeyPatch, fd: int) -> None:
        def write(where: int, data: Any) -> int:
            if where == fd:
                self.happened.append((f"{len(data)} bytes", CLOCK.monotonic()))
            return self.write(where, data)

        def drain(where: int) -> None:
            self.drain(where)
            self.happened.append(("drained", CLOCK.monotonic()))

        def ioctl(where: Any, request: int, argument: Any = 0, mutate: bool = True) -> Any:
            if argument == RTS:
                self.happened.append((NAMES[request], CLOCK.monotonic()))
            return self.ioctl(where, request, argument, mutate)

        monkeypatch.setattr(os, "write", write)
        monkeypatch.setattr(termios, "tcdrain", drain)
        monkeypatch.setattr(fcntl, "ioctl", ioctl)

    def between(self, first: str, last: str) -> float:
        """Seconds from *first* to *last*."""
        times = dict(self.happened)
        return times[last] - times[first]


def test_rts_is_on_from_the_delay_before_until_the_delay_after(
    driver: Driver, pty: Pty, monkeypatch: pytest.MonkeyPatch
) -> None:
    baud, before_s, after_s = 2400, 0.0125, 0.0175
    with opened(pty, rs485="rts", baudrate=baud, rts_before_s=before_s, rts_after_s=after_s) as link:
        assert isinstance(link, RtsLink)
        assert RTS not in driver.given("TIOCMBIS")  # never on until there is something to send
        assert driver.given("TIOCMBIC")[-1] == RTS
        witness = Witness(driver)
        witness.attach(monkeypatch, link.port.fileno())
        link.write(POLL)
    assert [what for what, _ in witness.happened] == ["TIOCMBIS", "8 bytes", "drained", "TIOCMBIC"]
    assert witness.between("TIOCMBIS", "8 bytes") >= before_s
    assert witness.between("8 bytes", "TIOCMBIC") >= len(POLL) * 10 / baud + after_s
    assert pty.receive(len(POLL)) == POLL


def test_rts_delays_below_a_millisecond_are_kept(driver: Driver, pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(pty, rs485="rts", baudrate=230400, rts_before_s=0.0004, rts_after_s=0.0003) as link:
        assert isinstance(link, RtsLink)
        witness = Witness(driver)
        witness.attach(monkeypatch, link.port.fileno())
        link.write(POLL)
    assert witness.between("TIOCMBIS", "8 bytes") >= 0.0004
    assert witness.between("8 bytes", "TIOCMBIC") >= len(POLL) * 10 / 230400 + 0.0003


def test_rts_goes_off_when_nothing_could_be_written(driver: Driver, pty: Pty) -> None:
    with opened(pty, rs485="rts") as link:
        assert isinstance(link, RtsLink)
        link.write_grace_s = -1000.0  # the time to write is over before it begins
        with pytest.raises(LinkLost, match="does not take data"):
            link.write(bytes(1_000_000))
        assert [name for name, data, _ in driver.asked if data == RTS][-2:] == ["TIOCMBIS", "TIOCMBIC"]


def test_a_port_without_rts_is_refused_in_clear_words(driver: Driver, pty: Pty) -> None:
    driver.lacks = frozenset({TIOCMBIC, TIOCMBIS})
    with pytest.raises(LinkSettingRefused) as told, opened(pty, rs485="rts"):
        pass
    advice = 'use rs485 = "kernel" or an adapter that switches by itself'
    assert str(told.value) == f"{pty.device} has no RTS line; {advice}"


@pytest.mark.parametrize("mode", ["none", "kernel", "rts"])
def test_an_adapter_that_hears_itself_is_understood_in_every_mode(driver: Driver, pty: Pty, mode: str) -> None:
    with opened(pty, rs485=mode, discard_echo=True) as link:
        assert isinstance(link, EchoLink)
        for _ in range(3):
            link.write(POLL)
            echo = pty.receive(len(POLL))
            pty.send(echo[:3])
            pty.send(echo[3:] + REPLY)
            heard = b""
            while len(heard) < len(REPLY) and (more := link.read(PATIENCE_S)):
                heard += more
            assert heard == REPLY
        assert link.echo_errors == 0


# ------------------------------------------------------------------------------------------------ low latency


def test_low_latency_is_asked_for_and_nothing_else_of_the_port_changes(driver: Driver, pty: Pty) -> None:
    with opened(pty):
        pass
    flags = struct.pack("=I", 0x10000000 | ASYNC_LOW_LATENCY)
    assert [data[: len(SERIAL_STRUCT)] for data in driver.given("TIOCSSERIAL")] == [
        SERIAL_STRUCT[:16] + flags + SERIAL_STRUCT[20:]
    ]


@pytest.mark.parametrize("missing", [TIOCGSERIAL, TIOCSSERIAL])
def test_a_driver_without_low_latency_is_used_as_it_is(driver: Driver, pty: Pty, missing: int) -> None:
    driver.lacks = frozenset({missing})
    with opened(pty) as link:
        link.write(POLL)
        assert pty.receive(len(POLL)) == POLL


# ------------------------------------------------------------------------------------------------ for us alone


@pytest.fixture
def second(pty: Pty) -> Iterator[int]:
    """Another program's descriptor, opened before the port was ours."""
    device = os.open(pty.device, os.O_RDWR | os.O_NOCTTY)
    yield device
    os.close(device)


def is_exclusive(device: int) -> bool:
    """What the kernel itself says."""
    told = array.array("i", [0])
    fcntl.ioctl(device, TIOCGEXCL, told)
    return bool(told[0])


def open_as_nobody(path: str) -> str:
    """Open *path* as a user without rights, with no lock asked for; return the error, "" if it opened."""
    Path(path).chmod(0o666)
    who: dict[str, Any] = {"user": NOBODY, "group": NOBODY, "extra_groups": []} if os.geteuid() == 0 else {}
    opens = ["/bin/sh", "-c", ': <> "$0"', path]
    done = subprocess.run(opens, capture_output=True, text=True, env={"LC_ALL": "C"}, check=False, **who)
    return str(done.stderr)


@contextlib.contextmanager
def without_root() -> Iterator[None]:
    """As another user for a moment, if we are root."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


def test_nobody_else_opens_a_port_in_use_not_even_without_asking_for_the_lock(pty: Pty) -> None:
    assert open_as_nobody(pty.device) == ""
    with opened(pty):
        assert "busy" in open_as_nobody(pty.device).lower()
    assert open_as_nobody(pty.device) == ""


def test_a_port_that_another_program_keeps_to_itself_is_told_as_busy(pty: Pty, second: int) -> None:
    """As screen and picocom do: no lock, but TIOCEXCL."""
    Path(pty.device).chmod(0o666)
    fcntl.ioctl(second, TIOCEXCL)
    with without_root(), pytest.raises(LinkUnavailable) as told, opened(pty):
        pass
    assert str(told.value) == f"{pty.device}: is used by another program"
    fcntl.ioctl(second, TIOCNXCL)
    with opened(pty):
        pass


def test_the_port_is_locked_while_it_is_used_for_programs_that_ask(pty: Pty, second: int) -> None:
    with opened(pty), pytest.raises(BlockingIOError):
        fcntl.flock(second, fcntl.LOCK_EX | fcntl.LOCK_NB)
    fcntl.flock(second, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_the_port_is_ours_from_opening_until_just_before_closing(driver: Driver, pty: Pty, second: int) -> None:
    with opened(pty) as link:
        link.write(POLL)
        assert is_exclusive(second)
        link.close()
        link.close()
    names = [name for name, _, _ in driver.asked if name in ("TIOCEXCL", "TIOCNXCL")]
    assert names == ["TIOCEXCL", "TIOCNXCL"]
    assert not is_exclusive(second)


def test_a_port_refused_after_opening_is_given_back_to_everybody(pty: Pty, second: int) -> None:
    with pytest.raises(LinkSettingRefused), opened(pty, rs485="kernel"):
        pass
    assert not is_exclusive(second)
    assert open_as_nobody(pty.device) == ""


def test_a_second_gateway_is_refused_and_takes_nothing_from_the_first(pty: Pty, second: int) -> None:
    """Also as root, whom TIOCEXCL does not stop: the lock does."""
    with opened(pty):
        for _ in range(2):
            with pytest.raises(LinkUnavailable, match="is used by another program"), opened(pty):
                pass
        assert is_exclusive(second)


def test_a_driver_that_knows_no_exclusive_use_is_used_all_the_same(driver: Driver, pty: Pty) -> None:
    driver.lacks = frozenset({TIOCEXCL, TIOCNXCL})
    with opened(pty) as link:
        link.write(POLL)
        assert pty.receive(len(POLL)) == POLL


def test_an_unplugged_port_is_closed_without_complaint(pty: Pty) -> None:
    with opened(pty):
        pty.unplug()
