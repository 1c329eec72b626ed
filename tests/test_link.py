"""Serial links and wake-ups on real ptys and with real threads (spec sections 2, 4, 7); TCP: test_link_tcp.py.

A pty's master end plays the wire: what it writes has come, what it reads was sent. What only hardware can do
(kernel RS-485, parity, a real RTS line) is not tested here; that a pty's refusal of it is told, is.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import stat
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest
import serial

from gateway import link as ports
from gateway.clock import SystemClock
from gateway.errors import LinkError, LinkLost, LinkSettingRefused, LinkUnavailable
from gateway.link import DescriptorLink, EchoLink, RtsLink, SerialSettings, Waker

CLOCK = SystemClock()
PATIENCE_S = 5.0  # for what must happen; a test that needs it has failed
POLL = bytes.fromhex("01 03 00 6B 00 03 74 17")  # unit 1, read 3 holding registers from 107, CRC
REPLY = bytes.fromhex("01 03 06 02 2B 00 00 00 64 05 7A")  # the example of the application protocol, section 6.3
NOBODY = 65534


class Pty:
    """The two ends of a pty; ``wire`` is the far one."""

    def __init__(self) -> None:
        self.wire, self.near = os.openpty()
        tty.setraw(self.near)
        self.device = os.ttyname(self.near)

    def settings(self, **changes: object) -> SerialSettings:
        plain: dict[str, object] = {"parity": "none"}
        return SerialSettings(self.device, **(plain | changes))  # type: ignore[arg-type]

    def sent(self, count: int) -> bytes:
        """The next *count* bytes that the link put on the wire."""
        data = b""
        while len(data) < count and select.select([self.wire], [], [], PATIENCE_S)[0]:
            data += os.read(self.wire, count - len(data))
        return data

    def unplug(self) -> None:
        for descriptor in (self.wire, self.near):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        self.wire = self.near = -1


@pytest.fixture
def pty() -> Iterator[Pty]:
    pair = Pty()
    yield pair
    pair.unplug()


@pytest.fixture
def waker() -> Iterator[Waker]:
    with contextlib.closing(Waker()) as made:
        yield made


@pytest.fixture
def line(pty: Pty, waker: Waker) -> Iterator[DescriptorLink]:
    with contextlib.closing(ports.open_serial(pty.settings(), waker, CLOCK)) as link:
        assert isinstance(link, DescriptorLink)
        yield link


def seconds(doing: Callable[[], object]) -> float:
    started = CLOCK.monotonic()
    doing()
    return CLOCK.monotonic() - started


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


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


# --- the waker


def test_a_wake_is_remembered_until_it_is_cleared(waker: Waker) -> None:
    assert not waker.wait(0)
    waker.wake()
    waker.wake()
    assert waker.wait(0)
    assert not waker.wait(0)
    waker.wake()
    waker.clear()
    waker.clear()
    assert not waker.wait(0.01)


def test_a_wake_from_another_thread_ends_a_wait_without_limit(waker: Waker) -> None:
    thread = threading.Thread(target=waker.wake)
    thread.start()
    assert waker.wait(None)
    thread.join()


def test_a_look_that_does_not_wait_leaves_a_wake_to_the_next_wait(line: DescriptorLink, waker: Waker) -> None:
    waker.wake()
    assert line.read(0) == b""
    assert seconds(lambda: line.read(PATIENCE_S)) < PATIENCE_S / 2
    assert not waker.wait(0)


def test_an_ended_waker_ends_every_wait_for_good_whatever_is_cleared(pty: Pty, waker: Waker) -> None:
    with contextlib.closing(ports.open_serial(pty.settings(), waker, CLOCK)) as line:
        threading.Thread(target=waker.end).start()
        assert waker.wait(PATIENCE_S)
        waker.clear()
        assert seconds(lambda: line.read(PATIENCE_S)) < PATIENCE_S / 2
        assert waker.wait(PATIENCE_S)
        assert waker.ended


def test_a_signal_handler_may_wake(waker: Waker) -> None:
    def handler(number: int, frame: FrameType | None) -> None:
        waker.wake()

    before = signal.signal(signal.SIGUSR1, handler)
    try:
        signal.raise_signal(signal.SIGUSR1)
        assert waker.wait(PATIENCE_S)
    finally:
        signal.signal(signal.SIGUSR1, before)


def test_a_wake_after_closing_touches_nobody_elses_descriptor() -> None:
    waker = Waker()
    number = waker.fileno()
    waker.close()
    waker.close()
    reader, writer = os.pipe()
    try:
        assert number in (reader, writer)  # the number has a new owner
        waker.wake()
        assert waker.fileno() == -1
        assert not select.select([reader], [], [], 0)[0]
    finally:
        os.close(reader)
        os.close(writer)


# --- reading and writing


def test_read_returns_at_once_what_has_come(pty: Pty, line: DescriptorLink) -> None:
    os.write(pty.wire, REPLY)
    started = CLOCK.monotonic()
    assert line.read(PATIENCE_S) == REPLY
    assert CLOCK.monotonic() - started < PATIENCE_S / 2


def test_every_byte_passes_a_serial_link_unchanged(pty: Pty, line: DescriptorLink) -> None:
    every = bytes(range(256))  # XON, XOFF, Ctrl-C, CR, NL, 0xFF among them
    os.write(pty.wire, every)
    came = b""
    while len(came) < len(every) and (more := line.read(PATIENCE_S)):
        came += more
    assert came == every
    line.write(every)
    assert pty.sent(len(every)) == every


def test_read_keeps_its_timeout(line: DescriptorLink) -> None:
    assert line.read(0) == b""
    assert line.read(-1.0) == b""
    assert 0.05 <= seconds(lambda: line.read(0.05)) < 1.0


def test_a_wake_ends_a_read_and_is_cleared_by_it(line: DescriptorLink, waker: Waker) -> None:
    thread = threading.Thread(target=waker.wake)
    thread.start()
    assert line.read(PATIENCE_S) == b""
    thread.join()
    assert not waker.wait(0)


def test_discard_counts_what_it_throws_away(pty: Pty, line: DescriptorLink) -> None:
    assert line.discard() == 0
    os.write(pty.wire, REPLY)
    select.select([line.port], [], [], PATIENCE_S)
    assert line.discard() == len(REPLY)
    assert line.read(0) == b""


def test_a_write_to_a_port_that_takes_nothing_gives_up_after_a_second(line: DescriptorLink) -> None:
    """Nobody reads at the other end of the pty; the kernel takes some, then nothing more."""
    data = bytes(100_000)
    limit_s = len(data) * line.character_s
    line.character_s = 0.0  # the time of the characters themselves is not what this is about
    started = CLOCK.monotonic()
    with pytest.raises(LinkLost, match="does not take data"):
        line.write(data)
    assert 0.9 <= CLOCK.monotonic() - started < 1.0 + limit_s


def test_the_limit_of_a_write_ends_even_if_time_jumps(pty: Pty, line: DescriptorLink) -> None:
    line.write_grace_s = -1000.0
    with pytest.raises(LinkLost, match="does not take data"):
        line.write(bytes(1_000_000))


def test_with_errors_marked_a_real_ff_is_not_taken_for_a_mark(pty: Pty, waker: Waker) -> None:
    with contextlib.closing(ports.open_serial(pty.settings(mark_errors=True), waker, CLOCK)) as link:
        os.write(pty.wire, b"a\xffb\0")
        assert link.read(PATIENCE_S) == b"a\xff\xffb\0"  # termios(3), PARMRK
        flags = termios.tcgetattr(pty.near)[0]
        assert flags == termios.INPCK | termios.PARMRK
    with contextlib.closing(ports.open_serial(pty.settings(), waker, CLOCK)) as link:
        os.write(pty.wire, b"a\xffb\0")
        assert link.read(PATIENCE_S) == b"a\xffb\0"


# --- losing the link


def test_an_unplugged_port_is_lost_for_reading_and_writing(pty: Pty, line: DescriptorLink) -> None:
    pty.unplug()
    with pytest.raises(LinkLost, match=r"/dev/pts/\d+: (is gone \(unplugged\?\)|input/output error)$"):
        line.read(PATIENCE_S)
    with pytest.raises(LinkLost, match=r"/dev/pts/\d+: input/output error$"):
        line.write(POLL)
    assert line.discard() == 0


def test_a_port_unplugged_during_a_read_ends_it(pty: Pty, line: DescriptorLink) -> None:
    thread = threading.Thread(target=pty.unplug)
    thread.start()
    with pytest.raises(LinkLost):
        line.read(PATIENCE_S)
    thread.join()


def test_a_link_that_we_closed_says_so(line: DescriptorLink) -> None:
    line.close()
    line.close()
    with pytest.raises(LinkLost, match="is closed"):
        line.read(0)
    with pytest.raises(LinkLost):
        line.write(POLL)
    assert line.discard() == 0


# --- opening serial ports


def test_the_silence_between_frames_is_fixed_above_19200_baud() -> None:
    slow, fast = SerialSettings("x", baudrate=9600), SerialSettings("x", baudrate=38400, parity="none", stop_bits=2)
    assert ports.silence_s(9600, slow.character_s) == pytest.approx(3.5 * 11 / 9600)
    assert ports.silence_s(19200, SerialSettings("x").character_s) == pytest.approx(0.002005, abs=1e-6)
    assert ports.silence_s(38400, fast.character_s) == 0.00175
    assert SerialSettings("x", data_bits=7, parity="odd").character_s == pytest.approx(10 / 19200)


def test_what_came_before_opening_is_forgotten(pty: Pty, waker: Waker) -> None:
    os.write(pty.wire, REPLY)
    select.select([pty.near], [], [], PATIENCE_S)
    with contextlib.closing(ports.open_serial(pty.settings(baudrate=230400), waker, CLOCK)) as link:
        assert link.read(0.02) == b""
        assert link.character_s == pytest.approx(10 / 230400)


def test_a_port_is_opened_once(pty: Pty, line: DescriptorLink, waker: Waker) -> None:
    with pytest.raises(LinkUnavailable, match=r"^/dev/pts/\d+: is used by another program$"):
        ports.open_serial(pty.settings(), waker, CLOCK)
    line.close()
    ports.open_serial(pty.settings(), waker, CLOCK).close()


@pytest.mark.parametrize(
    ("changes", "refused"),
    [
        ({"parity": "even"}, "even parity; a pty takes 8N1 only"),
        ({"parity": "odd", "stop_bits": 2}, "odd parity; a pty takes 8N1 only"),
        ({"data_bits": 7, "parity": "even"}, "7 data bits and even parity; a pty takes 8N1 only"),
        ({"baudrate": 12345}, "12345 baud"),
        ({"baudrate": 10**12}, "1000000000000 baud"),
        ({"baudrate": 0}, "0 baud"),
        ({"baudrate": -5}, "-5 baud"),
        ({"parity": "mark"}, "mark parity"),
        ({"stop_bits": 3, "data_bits": 9}, "9 data bits and 3 stop bits"),
        ({"rs485": "kernel"}, 'no kernel RS-485 mode; use rs485 = "rts" or an adapter that switches by itself'),
        ({"rs485": "rts"}, 'no RTS line; use rs485 = "kernel" or an adapter that switches by itself'),
    ],
)
def test_what_a_pty_cannot_do_is_said_by_name_every_time(
    pty: Pty, waker: Waker, changes: dict[str, object], refused: str
) -> None:
    """The second time the C library itself complains, since then nothing at all changes."""
    for _ in range(2):
        with pytest.raises(LinkSettingRefused) as told:
            ports.open_serial(pty.settings(**changes), waker, CLOCK)
        assert str(told.value).startswith(f"{pty.device} ")
        assert refused in str(told.value)


def test_a_refused_port_can_be_opened_as_it_is(pty: Pty, waker: Waker) -> None:
    with pytest.raises(LinkSettingRefused):
        ports.open_serial(SerialSettings(pty.device), waker, CLOCK)
    ports.open_serial(pty.settings(stop_bits=2), waker, CLOCK).close()


@pytest.mark.parametrize(
    ("device", "reason"),
    [
        ("/dev/ttyNothing0", "is not there"),
        ("", "is not there"),
        ("/dev/null", "is no serial port"),
        ("/dev", "is no serial port"),
        ("/dev/" + "x" * 300, "file name too long"),
    ],
)
def test_what_is_no_port_is_unavailable(device: str, reason: str, waker: Waker) -> None:
    with pytest.raises(LinkUnavailable) as told:
        ports.open_serial(SerialSettings(device), waker, CLOCK)
    assert str(told.value) == f"{device}: {reason}"


def test_a_path_that_cannot_be_one_is_unavailable(waker: Waker) -> None:
    with pytest.raises(LinkUnavailable, match=r"^/dev/tty\0S0: .*embedded null (byte|character in path)$"):
        ports.open_serial(SerialSettings("/dev/tty\0S0"), waker, CLOCK)  # Python 3.13 words it anew


def test_a_port_without_permission_names_the_group(pty: Pty, waker: Waker) -> None:
    Path(pty.device).chmod(0)
    with without_root(), pytest.raises(LinkUnavailable, match=r"denied; add the user to group dialout$"):
        ports.open_serial(pty.settings(), waker, CLOCK)
    Path(pty.device).chmod(stat.S_IRUSR | stat.S_IWUSR)


def test_no_descriptor_stays_open_after_opening_or_failing(pty: Pty, waker: Waker) -> None:
    settings = [
        SerialSettings("/dev/null"),
        SerialSettings(pty.device),
        pty.settings(rs485="kernel"),
        pty.settings(rs485="rts"),
        pty.settings(),
    ]
    before = open_descriptors()
    for each in settings * 50:
        with contextlib.suppress(LinkError):
            ports.open_serial(each, waker, CLOCK).close()
    assert open_descriptors() == before


# --- RS-485


def test_rts_is_on_from_before_the_first_bit_until_after_the_last(pty: Pty, line: DescriptorLink) -> None:
    switched: list[tuple[bool, float]] = []
    link = RtsLink(
        line.name,
        line.port,
        line.waker,
        CLOCK,
        line.hangup,
        0.005,  # a character: 8 of them take 40 ms
        switch=lambda on: switched.append((on, CLOCK.monotonic())),
        before_s=0.02,
        after_s=0.01,
    )
    link.write(POLL)
    assert pty.sent(len(POLL)) == POLL
    (first, began), (last, ended) = switched
    assert (first, last) == (True, False)
    assert 0.07 <= ended - began < 1.0


def test_a_port_lost_while_rts_is_switched_is_a_lost_link(pty: Pty, line: DescriptorLink) -> None:
    assert isinstance(line.port, serial.Serial)

    def switch(on: bool) -> None:
        line.port.rts = on  # type: ignore[union-attr]

    link = RtsLink(line.name, line.port, line.waker, CLOCK, line.hangup, switch=switch, before_s=0.0, after_s=0.0)
    pty.unplug()
    with pytest.raises(LinkLost, match=r"/dev/pts/\d+: "):
        link.write(POLL)


@pytest.fixture
def echoing(pty: Pty, waker: Waker) -> Iterator[EchoLink]:
    with contextlib.closing(ports.open_serial(pty.settings(discard_echo=True), waker, CLOCK)) as link:
        assert isinstance(link, EchoLink)
        yield link


def test_an_echo_is_taken_away_and_the_reply_is_left(pty: Pty, echoing: EchoLink) -> None:
    echoing.write(POLL)
    os.write(pty.wire, pty.sent(len(POLL)) + REPLY)
    assert echoing.read(PATIENCE_S) == REPLY
    assert echoing.echo_errors == 0


def test_an_echo_in_pieces_does_not_end_a_read(pty: Pty, echoing: EchoLink) -> None:
    echoing.write(POLL)
    for piece in (POLL[:3], POLL[3:5]):
        os.write(pty.wire, piece)
        assert echoing.read(0.01) == b""
    os.write(pty.wire, POLL[5:] + REPLY)
    assert echoing.read(PATIENCE_S) == REPLY
    assert echoing.echo_errors == 0


def test_the_echoes_of_two_writes_are_both_taken_away(pty: Pty, echoing: EchoLink) -> None:
    echoing.write(POLL)
    echoing.write(REPLY)
    os.write(pty.wire, POLL + REPLY + b"\x01")
    assert echoing.read(PATIENCE_S) == b"\x01"
    assert echoing.echo_errors == 0


def test_another_echo_is_counted_and_all_of_it_passed_on(pty: Pty, echoing: EchoLink) -> None:
    """Without any echo a reply starts like its request, 01 03: those bytes must not be lost."""
    echoing.write(POLL)
    os.write(pty.wire, REPLY)
    assert echoing.read(PATIENCE_S) == REPLY
    assert echoing.echo_errors == 1
    os.write(pty.wire, REPLY)
    assert echoing.read(PATIENCE_S) == REPLY
    assert echoing.echo_errors == 1


@pytest.mark.parametrize("part", [b"", POLL[:5]])
def test_an_echo_that_stays_out_is_counted_when_its_time_is_over(pty: Pty, echoing: EchoLink, part: bytes) -> None:
    echoing.write(POLL)
    os.write(pty.wire, part)
    started = CLOCK.monotonic()
    assert echoing.read(PATIENCE_S) == part
    assert 0.1 <= CLOCK.monotonic() - started < PATIENCE_S
    assert echoing.echo_errors == 1


def test_a_discard_forgets_the_echo_as_well(pty: Pty, echoing: EchoLink) -> None:
    echoing.write(POLL)
    os.write(pty.wire, POLL[:5])
    assert echoing.read(0.05) == b""
    assert echoing.discard() == 5
    os.write(pty.wire, REPLY)
    assert echoing.read(PATIENCE_S) == REPLY
    assert echoing.echo_errors == 0
