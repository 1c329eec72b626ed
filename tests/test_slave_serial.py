"""A serial slave on a real pty (spec sections 3 and 4): the test plays everybody else on the pair of wires.

Frames are raw bytes. That something is not answered is shown by the answer to a later request coming first. A pty takes
8N1 only, and its speed is nothing but a number: at 19200 baud 3.5 characters are 1.8 ms.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.clock import Clock
from gateway.config import SlaveConfig
from gateway.errors import LinkLost
from gateway.link import Link, SerialSettings, Waker, open_serial
from gateway.modbus.pdu import Table
from gateway.slave import SerialSlave
from tests.fakes import JumpingClock
from tests.lines import (
    CLOCK,
    EXAMPLES,
    FOUND_PDU,
    PATIENCE_S,
    READ_PDU,
    Pty,
    Running,
    a_register,
    ascii_frame,
    holding,
    pty_pair,
    rtu_frame,
    running,
    values,
)

SHORT_S = 0.05  # a timeout that a test waits for
NEVER_S = 60.0  # a timeout that no test waits for
ENCODE: dict[str, Callable[[str, int], bytes]] = {"rtu": rtu_frame, "ascii": ascii_frame}
WRITE_PDU = "06 00 01 00 03"  # register 1 becomes 3
FOREIGN = 18

both_framings = pytest.mark.parametrize("framing", ["rtu", "ascii"])


class TappedLink:
    """A link that remembers what each read brought, so that a test knows when a silence was noticed; it may jam."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self.character_s = link.character_s
        self.discard, self.close = link.discard, link.close
        self.reads: list[bytes] = []
        self.is_jammed = False

    def read(self, timeout_s: float) -> bytes:
        data = self._link.read(timeout_s)
        self.reads.append(data)
        return data

    def write(self, data: bytes) -> None:
        if self.is_jammed:
            raise LinkLost("does not take data")
        self._link.write(data)


class Slave:
    """A running slave, its end of the wire, and what it serves."""

    def __init__(self, config: SlaveConfig, path: str, waker: Waker, clock: Clock) -> None:
        self.config, self.path, self.waker = config, path, waker
        self.register = a_register()
        self.attempts = 0
        self.opened = threading.Event()  # what is sent before is thrown away at opening
        self.tap: TappedLink | None = None
        self.task = SerialSlave(config, self.register, clock, waker, self._open, wait_limit_s=NEVER_S)
        self.run: Running
        self.pty: Pty

    def _open(self) -> Link:
        self.attempts += 1
        settings = SerialSettings(self.path, self.config.baudrate, self.config.parity, self.config.data_bits_used)
        self.tap = TappedLink(open_serial(settings, self.waker, CLOCK))
        self.opened.set()
        return self.tap

    @property
    def heard(self) -> bytes:
        """All that has come since the port was opened."""
        return b"".join(self.tap.reads) if self.tap else b""

    def encode(self, pdu: str, unit: int = 17) -> bytes:
        return ENCODE[self.config.framing_used](pdu, unit)

    def send(self, *frames: bytes) -> None:
        """Put *frames* on the wire in one piece."""
        self.pty.send(b"".join(frames))

    def send_and_pause(self, data: bytes) -> None:
        """Put *data* on the wire and let the silence after it be noticed, but not the character timeout."""
        tap = self.tap
        assert tap is not None
        seen = len(tap.reads)
        self.send(data)
        self.run.wait_until(lambda: b"".join(tap.reads[seen:]) == data and tap.reads[-1] == b"")

    def answers(self, request_pdu: str = READ_PDU, reply_pdu: str = FOUND_PDU, unit: int = 17) -> bool:
        """Ask, and tell whether the next that comes is the reply, and nothing comes with it."""
        self.send(self.encode(request_pdu, unit))
        reply = self.encode(reply_pdu, unit)
        return self.pty.receive(len(reply)) == reply and self.pty.is_silent()


def a_config(**changes: Any) -> SlaveConfig:
    plain = {"name": "scada", "line": "/dev/ttyS2", "parity": "none", "data_bits": 8, "unit": 17}
    return SlaveConfig.model_validate(plain | changes)


@contextmanager
def started(config: SlaveConfig, path: str, clock: Clock = CLOCK) -> Iterator[Slave]:
    """Give a slave that runs, whether it can open *path* or not."""
    with contextlib.closing(Waker()) as waker:
        slave = Slave(config, path, waker, clock)
        with running(slave.task) as slave.run:
            yield slave


@contextmanager
def serving(clock: Clock = CLOCK, **changes: Any) -> Iterator[Slave]:
    """Give a slave that listens on a pty."""
    with pty_pair() as pty, started(a_config(**changes), pty.device, clock) as slave:
        slave.pty = pty
        assert slave.opened.wait(PATIENCE_S)
        yield slave


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


# ------------------------------------------------------------------------------------------------ own requests


def test_the_example_of_the_standard_is_answered_byte_for_byte_in_rtu() -> None:
    with serving(unit=1) as slave:
        slave.send(bytes.fromhex("01 03 00 6B 00 03 74 17"))
        assert slave.pty.receive(11) == bytes.fromhex("01 03 06 02 2B 00 00 00 64 05 7A")


def test_the_example_of_the_standard_is_answered_byte_for_byte_in_ascii() -> None:
    with serving(unit=1, framing="ascii") as slave:
        slave.send(b":0103006B00038E\r\n")
        assert slave.pty.receive(23) == b":010306022B0000006465\r\n"


@both_framings
@pytest.mark.parametrize(("request_pdu", "reply_pdu"), EXAMPLES.values(), ids=EXAMPLES)
def test_each_request_gets_the_reply_of_the_standard(framing: str, request_pdu: str, reply_pdu: str) -> None:
    with serving(framing=framing) as slave:
        assert slave.answers(request_pdu, reply_pdu)


@both_framings
def test_what_is_written_is_in_the_register(framing: str) -> None:
    with serving(framing=framing) as slave:
        assert slave.answers("10 00 01 00 02 04 00 0A 01 02", "10 00 01 00 02")
        assert slave.answers("05 00 AC FF 00", "05 00 AC FF 00")
        assert holding(slave.register, 1, 2) == [0x000A, 0x0102]
        assert values(slave.register, Table.COILS, 172) == [1]


@both_framings
def test_a_frame_of_the_greatest_length_is_answered(framing: str) -> None:
    with serving(framing=framing) as slave:
        assert slave.answers("10 00 00 00 7B F6" + 123 * "1234", "10 00 00 00 7B")
        assert slave.answers("03 00 00 00 7D", "03 FA" + 123 * "1234" + 2 * "0000")


@both_framings
def test_what_is_not_served_is_refused_with_an_exception(framing: str) -> None:
    with serving(framing=framing, writable=False, functions=[3, 6], first=107, count=3) as slave:
        assert slave.answers()
        assert slave.answers(WRITE_PDU, "86 01")
        assert slave.answers("04 00 6B 00 03", "84 01")
        assert slave.answers("03 00 6A 00 01", "83 02")


# ------------------------------------------------------------------------------------------------ a shared line


@both_framings
def test_foreign_requests_and_replies_are_skipped(framing: str) -> None:
    with serving(framing=framing) as slave:
        for pdu in (READ_PDU, FOUND_PDU, WRITE_PDU, WRITE_PDU, "10 00 01 00 02 04 00 0A 01 02", "10 00 01 00 02"):
            slave.send_and_pause(slave.encode(pdu, FOREIGN))
        assert slave.answers()
        assert (slave.task.counters.foreign, slave.task.counters.requests) == (6, 1)
        assert holding(slave.register, 1, 2) == [0, 0]


@both_framings
def test_an_own_request_after_others_talk_in_the_same_burst_is_answered_once(framing: str) -> None:
    with serving(framing=framing) as slave:
        slave.send(slave.encode(READ_PDU, FOREIGN), slave.encode(FOUND_PDU, FOREIGN), slave.encode(READ_PDU))
        reply = slave.encode(FOUND_PDU)
        assert slave.pty.receive(len(reply)) == reply
        assert slave.answers(WRITE_PDU, WRITE_PDU)  # so nothing more had come
        assert slave.task.counters.foreign == 2


@both_framings
@pytest.mark.parametrize("unit", [255, 16, 18])
def test_no_other_unit_is_answered(framing: str, unit: int) -> None:
    with serving(framing=framing) as slave:
        slave.send_and_pause(slave.encode(WRITE_PDU, unit))
        assert slave.answers()
        assert holding(slave.register, 1) == [0]


@both_framings
@pytest.mark.parametrize("follower_pdu", [READ_PDU, FOUND_PDU])
def test_an_own_request_that_others_talk_follows_in_the_same_burst_is_too_late(framing: str, follower_pdu: str) -> None:
    with serving(framing=framing) as slave:
        slave.send(slave.encode(WRITE_PDU), slave.encode(follower_pdu, FOREIGN))
        slave.run.wait_until(lambda: slave.task.counters.unanswered == 1)
        assert slave.pty.is_silent()
        assert slave.answers()  # the next that comes is this one's reply
        assert holding(slave.register, 1) == [0]


def test_a_wake_does_not_cut_the_silence_short(clock: JumpingClock) -> None:
    with serving(clock) as slave:
        request = slave.encode(WRITE_PDU)
        slave.send(request)
        slave.run.wait_until(lambda: slave.heard == request)
        slave.run.come_round()
        slave.run.come_round()
        slave.send(slave.encode(READ_PDU, FOREIGN))  # for the slave no time has passed: one burst
        slave.run.wait_until(lambda: len(slave.heard) > len(request))
        clock.pass_s(0.1)
        slave.run.wait_until(lambda: slave.task.counters.unanswered == 1)
        assert slave.task.counters.requests == 0
        assert slave.pty.is_silent()


@both_framings
@pytest.mark.parametrize("count", [1, 3, 4])
def test_an_own_request_that_a_part_of_a_frame_follows_is_too_late(framing: str, count: int) -> None:
    with serving(framing=framing, character_timeout=SHORT_S) as slave:
        slave.send(slave.encode(WRITE_PDU), slave.encode(READ_PDU, FOREIGN)[:count])
        slave.run.wait_until(lambda: slave.task.counters.damaged == 1)  # the part was thrown away
        assert slave.task.counters.unanswered == 1
        assert slave.answers()
        assert holding(slave.register, 1) == [0]


@both_framings
def test_of_two_own_requests_in_one_burst_only_the_last_is_answered_and_executed(framing: str) -> None:
    with serving(framing=framing) as slave:
        slave.send(slave.encode(WRITE_PDU), slave.encode("06 00 02 00 04"))
        reply = slave.encode("06 00 02 00 04")
        assert slave.pty.receive(len(reply)) == reply
        assert slave.answers()
        assert holding(slave.register, 1, 2) == [0, 4]


@both_framings
def test_a_broadcast_is_executed_and_not_answered(framing: str) -> None:
    with serving(framing=framing) as slave:
        slave.send_and_pause(slave.encode(WRITE_PDU, 0))
        slave.send_and_pause(slave.encode(READ_PDU, 0))  # makes no sense, and no noise
        assert slave.answers()
        assert holding(slave.register, 1) == [3]
        assert slave.task.counters.broadcasts == 2


@both_framings
def test_a_broadcast_is_executed_wherever_it_stands_in_a_burst(framing: str) -> None:
    with serving(framing=framing) as slave:
        others = slave.encode(READ_PDU, FOREIGN)
        slave.send(others, slave.encode(WRITE_PDU, 0), others, slave.encode("06 00 02 00 04", 0), others)
        assert slave.answers("03 00 01 00 02", "03 04 00 03 00 04")


# ------------------------------------------------------------------------------------------------ pauses and damage


@both_framings
def test_a_frame_with_a_pause_anywhere_is_answered_once(framing: str) -> None:
    with serving(framing=framing, character_timeout=NEVER_S) as slave:
        request = slave.encode(READ_PDU)
        reply = slave.encode(FOUND_PDU)
        for cut in range(1, len(request)):
            slave.send_and_pause(request[:cut])
            slave.send(request[cut:])
            assert slave.pty.receive(len(reply)) == reply, f"after {cut} bytes"
        assert slave.answers()
        assert slave.task.counters.requests == len(request)


@both_framings
def test_a_part_before_a_longer_pause_is_forgotten_and_the_whole_request_after_it_answered_once(framing: str) -> None:
    with serving(framing=framing, character_timeout=SHORT_S) as slave:
        slave.send(slave.encode(WRITE_PDU)[:5])
        slave.run.wait_until(lambda: slave.task.counters.damaged == 1)
        assert slave.answers()
        assert slave.answers()
        assert (slave.task.counters.damaged, slave.task.counters.requests) == (1, 2)


@both_framings
def test_the_second_half_after_a_longer_pause_is_no_request(framing: str) -> None:
    with serving(framing=framing, character_timeout=SHORT_S) as slave:
        request = slave.encode(WRITE_PDU)
        slave.send(request[:5])
        slave.run.wait_until(lambda: slave.task.counters.damaged == 1)
        slave.send_and_pause(request[5:])
        slave.task.wake()  # a wake in the middle of it all changes nothing
        assert slave.answers()
        assert holding(slave.register, 1) == [0]


@both_framings
def test_a_request_that_comes_byte_by_byte_is_answered(framing: str) -> None:
    with serving(framing=framing) as slave:
        for byte in slave.encode(READ_PDU):
            slave.send(bytes([byte]))
        reply = slave.encode(FOUND_PDU)
        assert slave.pty.receive(len(reply)) == reply
        assert slave.answers()


DAMAGED = {
    "rtu": rtu_frame(WRITE_PDU)[:-1] + b"\x00",  # CRC
    "ascii": b":110600010003E4\r\n",  # LRC; E5 would be right
}


@both_framings
def test_a_damaged_frame_gets_no_answer_and_the_next_is_understood(framing: str) -> None:
    with serving(framing=framing) as slave:
        slave.send_and_pause(DAMAGED[framing])
        assert slave.task.counters.damaged == 1
        assert slave.answers()
        assert holding(slave.register, 1) == [0]
        assert slave.task.counters.requests == 1


@both_framings
def test_noise_right_before_an_own_request_does_not_hide_it(framing: str) -> None:
    with serving(framing=framing) as slave:
        slave.send(b"\xff\x00\x55", slave.encode(READ_PDU))
        reply = slave.encode(FOUND_PDU)
        assert slave.pty.receive(len(reply)) == reply


def test_counters_tell_good_requests_from_exceptions() -> None:
    with serving() as slave:
        assert slave.answers()
        assert slave.answers("03 FF FF 00 02", "83 02")
        counters = slave.task.counters
        assert (counters.requests, counters.good, counters.exceptions) == (2, 1, {2: 1})


# ------------------------------------------------------------------------------------------------ states, port


def test_in_maintenance_everything_is_ignored_and_afterwards_all_is_answered() -> None:
    with serving() as slave:
        slave.opened.clear()
        slave.task.set_enabled(False)
        slave.run.come_round()
        slave.send(slave.encode(WRITE_PDU))
        slave.task.set_enabled(True)
        assert slave.opened.wait(PATIENCE_S)
        assert slave.answers()
        assert holding(slave.register, 1) == [0]


def test_in_maintenance_the_port_is_free_for_others() -> None:
    with serving() as slave, contextlib.closing(Waker()) as waker:
        slave.task.set_enabled(False)
        slave.run.come_round()
        slave.run.come_round()  # the turn in which it let go is over
        open_serial(SerialSettings(slave.path, parity="none"), waker, CLOCK).close()


def test_a_slave_configured_off_opens_nothing() -> None:
    with pty_pair() as pty, started(a_config(enabled=False), pty.device) as slave:
        slave.run.come_round()
        slave.run.come_round()
        assert slave.attempts == 0


def test_a_port_that_vanishes_and_comes_back_elsewhere_is_served_again_and_told_once_per_change(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "usb-adapter"
    with pty_pair() as first, pty_pair() as second:
        path.symlink_to(first.device)
        with started(a_config(framing="ascii", character_timeout=NEVER_S), str(path)) as slave:
            assert slave.opened.wait(PATIENCE_S)
            slave.pty = first
            assert slave.answers()
            slave.send_and_pause(slave.encode(WRITE_PDU)[:5])  # it vanishes in the middle of a frame
            slave.opened.clear()
            path.unlink()
            first.unplug()
            slave.run.wait_until(lambda: slave.attempts >= 3)  # after 0.5 s, and again after 1 s
            slave.run.come_round()
            assert slave.task.trouble == f"{path}: is not there"
            path.symlink_to(second.device)
            assert slave.opened.wait(PATIENCE_S)
            slave.pty = second
            slave.send_and_pause(slave.encode(WRITE_PDU)[5:])  # the first half is forgotten
            assert slave.answers("03 00 01 00 01", "03 02 00 00")
            assert slave.task.trouble == ""
    lost, *others = messages(caplog)
    gone = ("is gone (unplugged?)", "input/output error")  # which of the two depends on when the kernel is asked
    assert lost in [f"scada: {path}: {how}; trying again" for how in gone]
    assert others == ["scada: the line works again"]


def test_a_port_that_cannot_do_what_is_asked_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    with pty_pair() as pty, started(a_config(parity="even"), pty.device) as slave:
        slave.run.wait_until(lambda: slave.attempts == 2)
        slave.run.come_round()
        assert slave.task.trouble == f"{pty.device} cannot do even parity; a pty takes 8N1 only"
    assert messages(caplog) == [f"scada: {pty.device} cannot do even parity; a pty takes 8N1 only; trying again"]


def test_a_line_that_takes_no_data_is_given_up_and_opened_again() -> None:
    with serving() as slave:
        assert slave.tap is not None
        slave.opened.clear()
        slave.tap.is_jammed = True
        slave.send(slave.encode(READ_PDU))
        slave.run.wait_until(lambda: slave.task.trouble)
        assert slave.task.trouble == "does not take data"
        assert slave.opened.wait(PATIENCE_S)
        assert slave.answers()
        assert slave.task.trouble == ""


# ------------------------------------------------------------------------------------------------ stopping


def test_it_stops_while_idle() -> None:
    with serving() as slave:
        assert slave.answers()


@both_framings
def test_it_stops_in_the_middle_of_a_frame(framing: str) -> None:
    with serving(framing=framing, character_timeout=NEVER_S) as slave:
        slave.send_and_pause(slave.encode(READ_PDU)[:5])


def test_it_stops_in_maintenance() -> None:
    with started(a_config(enabled=False), "/nowhere") as slave:
        slave.run.come_round()
        slave.run.come_round()


def test_it_stops_while_its_port_is_missing(tmp_path: Path) -> None:
    with started(a_config(), str(tmp_path / "missing")) as slave:
        slave.run.wait_until(lambda: slave.attempts == 2)


def test_after_stopping_the_port_is_free_for_others() -> None:
    with pty_pair() as pty, contextlib.closing(Waker()) as waker:
        with started(a_config(), pty.device) as slave:
            assert slave.opened.wait(PATIENCE_S)
        open_serial(SerialSettings(pty.device, parity="none"), waker, CLOCK).close()
