"""Flags mark progress: they stay down where a task turns without getting anywhere, and never while it is well.

The second is the more dangerous fault: a flag that stays down for longer than ``watchdog.timeout``, which is 1 s at
least, ends the process and may reset the machine. So tasks run here as by the wiring for that least timeout, and what
is measured is the longest time without a flag: on a clock that jumps, of which each turn of a task takes some. This is
about the master; ``test_progress_tasks`` about the others.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from typing import Any

import pytest

from gateway import master as master_module
from gateway.errors import LinkUnavailable
from gateway.link import Link
from gateway.master import Master
from gateway.modbus.pdu import ReadRequest
from gateway.opening import LIMIT_S
from gateway.polls import OFFLINE_AFTER
from gateway.schedule import Schedule
from gateway.transaction import Line, Response
from tests.fakes import FakeField, JumpingClock, LosableLink, MasterBench, reads, writes
from tests.lines import Runnable

LEAST_TIMEOUT_S = 1.0  # of the configuration
WAIT_LIMIT_S = LEAST_TIMEOUT_S / 3  # as the wiring has it
TURN_S = 0.0001  # that each turn of a task takes
WRITE_ALL = {**writes(0, 0, 123), "trigger": "cycle"}  # a broadcast that nearly fills a frame


class Watch(threading.Event):
    """A stop that comes after some time on a clock that jumps; meanwhile: how long the flag has been down at most."""

    def __init__(self, clock: JumpingClock, for_s: float) -> None:
        super().__init__()
        self.longest_s = 0.0
        self._clock = clock
        self._raised_s = clock.monotonic()
        self._until_s = self._raised_s + for_s

    def is_set(self) -> bool:
        self._clock.pass_s(TURN_S)
        self._measure()
        return self._clock.monotonic() >= self._until_s

    def alive(self) -> None:
        self._measure()
        self._raised_s = self._clock.monotonic()

    def _measure(self) -> None:
        self.longest_s = max(self.longest_s, self._clock.monotonic() - self._raised_s)


def longest_s(task: Runnable, clock: JumpingClock, for_s: float) -> float:
    """Have *task* work for so long; return the longest time without its flag."""
    watch = Watch(clock, for_s)
    task.run(watch, watch.alive)
    return watch.longest_s


def is_well(task: Runnable, clock: JumpingClock, for_s: float) -> bool:
    return longest_s(task, clock, for_s) <= WAIT_LIMIT_S + 0.1


def hangs(task: Runnable, clock: JumpingClock) -> bool:
    """Whether its flag stays down from some moment on."""
    return longest_s(task, clock, 5 * LEAST_TIMEOUT_S) > 4 * LEAST_TIMEOUT_S


class Later:
    """What opens lines in another thread that takes its time: never, until it is told to go on."""

    def __init__(self) -> None:
        self.is_slow = True
        self.waiting: list[Callable[[], None]] = []

    def __call__(self, work: Callable[[], None]) -> None:
        if self.is_slow:
            self.waiting.append(work)
        else:
            work()


class NoisyLink(LosableLink):
    """A link on which something is heard at given moments, whoever has the word."""

    noise_s: list[float]
    noise: bytes = b"\x11"

    def read(self, timeout_s: float) -> bytes:
        now_s = self.clock.monotonic()
        while self.noise_s and self.noise_s[0] < now_s - 1.0:  # nobody listened
            self.noise_s.pop(0)
        next_s = self.noise_s[0] if self.noise_s else now_s + timeout_s + 1.0
        is_first = not self.arriving or next_s < self.arriving[0][0]
        if next_s > now_s + timeout_s or not is_first:
            return super().read(timeout_s)
        self.clock.pass_s(max(0.0, self.noise_s.pop(0) - now_s))
        return self.noise


class Bench(MasterBench):
    """A master as the wiring makes it for the least timeout. *device*: what is at the other end instead of devices."""

    def __init__(
        self,
        clock: JumpingClock,
        *requests: dict[str, Any],
        late_s: dict[str, float] | None = None,
        start: Callable[[Callable[[], None]], object] = lambda work: work(),
        **line: Any,
    ) -> None:
        super().__init__(clock, *requests, **line)
        self.master.close()
        self.device: Callable[[bytes], list[tuple[float, bytes]]] = self.field
        self.noise_s: list[float] = []
        opener = self._open_noisy
        self.master = Master(self.config, self.register, clock, self.waker, opener, WAIT_LIMIT_S, late_s, start)

    def _open_noisy(self) -> Link:
        if self.missing is not None:
            raise self.missing
        link = NoisyLink(self.clock, self.device, 0.0 if self.config.is_tcp else 11 / self.config.baudrate)
        link.noise_s = self.noise_s
        self.links.append(link)
        return link

    def babbles(self, from_s: float, to_s: float, every_s: float) -> None:
        """Something is heard on the line all the time, *from_s* until *to_s* from now."""
        now_s = self.clock.monotonic()
        self.noise_s += [now_s + from_s + n * every_s for n in range(int((to_s - from_s) / every_s))]

    def is_well(self, for_s: float) -> bool:
        return is_well(self.master, self.clock, for_s)


# ------------------------------------------------------------------------------------------------ a master that is well


@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize(
    "line",
    [
        {},
        {"enabled": False},
        {"response_timeout": 60.0},
        {"delay": 60.0},
        {"delay": 60.0, "response_timeout": 60.0, "retries": 3},
        {"retries": 100, "response_timeout": 0.1},
        {"baudrate": 1200},
        {"line": "tcp://10.0.0.9", "response_timeout": 60.0},
        {"line": "tcp://10.0.0.9", "delay": 60.0},
    ],
    ids=str,
)
def test_a_master_that_polls_or_waits_shows_its_flag(clock: JumpingClock, line: dict[str, Any], silent: bool) -> None:
    it = Bench(clock, reads(1, 0), reads(2, 10, 125, every=7.0), **line)
    it.field.silent = {1} if silent else set()
    assert it.is_well(1000.0)
    assert it.field.asked or not it.config.enabled


def test_a_master_without_requests_shows_its_flag(clock: JumpingClock) -> None:
    assert Bench(clock).is_well(100.0)


@pytest.mark.parametrize("baudrate", [1200, 19200])
def test_a_long_rest_after_a_broadcast_is_no_hang(clock: JumpingClock, baudrate: int) -> None:
    it = Bench(clock, WRITE_ALL, reads(1, 200), turnaround=60.0, baudrate=baudrate)
    it.scada(0, *range(123))
    assert it.is_well(500.0)
    assert it.field.writes


def test_a_request_with_a_longer_timeout_than_its_line_is_no_hang(clock: JumpingClock) -> None:
    it = Bench(clock, reads(1, 0, response_timeout=60.0), response_timeout=0.1)
    it.field.silent = {1}
    assert it.is_well(500.0)


def test_the_wait_for_a_line_that_cannot_be_opened_is_no_hang(clock: JumpingClock) -> None:
    it = Bench(clock, reads(1, 0))
    it.missing = LinkUnavailable("is not there")
    assert it.is_well(300.0)


def test_a_port_that_takes_59_seconds_to_open_or_never_opens_is_no_hang(clock: JumpingClock) -> None:
    it, later = Bench(clock, reads(1, 0)), Later()
    it.master._opening._start = later
    assert is_well(it.master, clock, LIMIT_S - 1.0)
    assert it.master.trouble == ""
    assert is_well(it.master, clock, 5 * LIMIT_S)


@pytest.mark.parametrize("is_offline", [False, True])
def test_a_connection_that_rested_and_is_slow_to_open_again_is_no_hang(clock: JumpingClock, is_offline: bool) -> None:
    """Meanwhile other polls become due, and probes: they have to wait for it."""
    later = Later()
    it = Bench(clock, reads(1, 0), reads(2, 1, every=1.7), line="tcp://plc.example", start=later)
    later.is_slow = False
    it.field.silent = {1} if is_offline else set()
    it.run_s(60.0)
    assert it.master.devices[1].is_offline is is_offline
    later.is_slow = True
    it.link.lose = "idle"  # the device has closed it
    assert it.is_well(LIMIT_S - 5.0)
    assert len(later.waiting) == 1


def test_probes_of_offline_devices_are_no_hang(clock: JumpingClock) -> None:
    requests = [reads(unit, 10 * unit, every=0.1) for unit in range(1, 20)]
    it = Bench(clock, *requests, response_timeout=60.0)
    it.field.silent = set(range(1, 20))
    assert it.is_well(60.0 * 2 * 19 * (OFFLINE_AFTER + 1))
    assert all(device.is_offline for device in it.master.devices.values())


def test_commands_for_devices_that_do_not_answer_are_no_hang(clock: JumpingClock) -> None:
    it = Bench(clock, reads(1, 0), writes(2, 100, 50), response_timeout=30.0)
    it.field.silent = {2}
    it.scada(100, *range(50))
    it.master.submit(2, ReadRequest(3, 0, 1))
    assert it.is_well(500.0)


def test_a_port_handed_over_with_a_late_reply_to_come_for_two_minutes_is_no_hang(clock: JumpingClock) -> None:
    it = Bench(clock, reads(1, 0), late_s={"/dev/ttyS2": clock.monotonic() + 120.0})
    assert it.is_well(118.0)
    assert it.field.asked == []


# ------------------------------------------------------------------------------------------------ noise


@pytest.mark.parametrize("delay_s", [0.0, 5.0])
@pytest.mark.parametrize("timeout_s", [0.5, 2.5, 20.0])
@pytest.mark.parametrize("is_at_once", [False, True])
def test_a_line_that_babbles_is_no_hang(
    clock: JumpingClock, is_at_once: bool, timeout_s: float, delay_s: float
) -> None:
    """Its first poll is damaged, or goes well; in either case polls fail later on, and say so."""
    it = Bench(clock, reads(1, 0), response_timeout=timeout_s, delay=delay_s, baudrate=1200)
    it.babbles(0.001 if is_at_once else 0.05, 10 * timeout_s + 10 * delay_s + 20.0, 0.02)
    assert it.is_well(12 * timeout_s + 12 * delay_s + 20.0)
    assert it.master.counters.damaged > 0


def test_a_line_that_babbles_while_another_master_is_listened_for_is_no_hang(clock: JumpingClock) -> None:
    it = Bench(clock, reads(1, 0), late_s={"/dev/ttyS2": clock.monotonic() + 30.0}, baudrate=1200)
    it.babbles(0.0, 100.0, 0.02)
    assert it.is_well(120.0)


def test_the_silence_after_a_late_reply_is_no_hang(clock: JumpingClock) -> None:
    """It came at the last moment, of a request with a longer timeout than its line."""
    it = Bench(clock, reads(1, 0, response_timeout=20.0), response_timeout=1.0, delay=5.0)
    it.device = lambda frame: [(39.9, b"\x55")]
    assert it.is_well(300.0)


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
def test_a_device_that_trickles_on_behind_a_long_write_at_1200_baud_is_no_hang(
    clock: JumpingClock, framing: str
) -> None:
    line: dict[str, Any] = {"framing": framing, "baudrate": 1200, "response_timeout": 0.1, "turnaround": 0.0}
    it = Bench(clock, {**WRITE_ALL, "unit": 1}, **line)
    it.scada(0, *range(123))
    character_s = 11 / 1200

    def trickle(frame: bytes) -> list[tuple[float, bytes]]:
        began_s = len(frame) * character_s + 0.09
        return [(began_s, b":")] + [(began_s + 0.04 * n, b"1") for n in range(1, 120)]

    it.device = trickle
    assert it.is_well(60.0)


@pytest.mark.parametrize("seed", range(60))
def test_whatever_a_line_says_and_when_no_healthy_master_hangs(clock: JumpingClock, seed: int) -> None:
    rng = random.Random(seed)
    framing = rng.choice(["rtu", "ascii", "tcp"])
    where: dict[str, Any] = (
        {"line": "tcp://10.0.0.9"} if framing == "tcp" else {"framing": framing, "baudrate": rng.choice([1200, 19200])}
    )
    it = Bench(
        clock,
        reads(1, 0, every=0.5, response_timeout=rng.choice([0.0, 0.5, 30.0])),
        reads(2, 10, 100, every=2.0),
        {**WRITE_ALL, "point": 200, "every": 3.0},
        late_s={"/dev/ttyS2": clock.monotonic() + rng.choice([0.0, 120.0])},
        response_timeout=rng.choice([0.1, 1.0, 2.5, 20.0]),
        delay=rng.choice([0.0, 0.0, 3.0, 20.0]),
        turnaround=rng.choice([0.1, 5.0]),
        retries=rng.choice([0, 3]),
        **where,
    )
    it.scada(200, *range(123))
    it.device = a_wild_device(rng, it.field, framing)
    at_s = 0.0
    while at_s < 300.0:
        rest_s = rng.expovariate(0.1)
        if rng.random() < 0.5:
            it.babbles(at_s, at_s + rest_s, max(rng.choice([0.0015, 0.02, 0.15, 1.0, 2.9]), rest_s / 200))
        at_s += rest_s
    assert it.is_well(300.0)


def a_wild_device(rng: random.Random, field: FakeField, framing: str) -> Callable[[bytes], list[tuple[float, bytes]]]:
    """Devices that answer, are silent, late, damaged or cut off, as it happens."""

    def answer(frame: bytes) -> list[tuple[float, bytes]]:
        replies = field(frame) if framing == "rtu" else [(0.01, b":11")]
        return {
            "well": replies,
            "silent": [],
            "late": [(rng.choice([1.9, 4.9, 39.0]), data) for _, data in replies],
            "cut off": [(at_s, data[:3]) for at_s, data in replies],
            "damaged": [(at_s, data[:-1] + b"\0") for at_s, data in replies],
        }[rng.choice(["well", "well", "silent", "late", "cut off", "damaged"])]

    return answer


# ------------------------------------------------------------------------------------------------ a master that is not


class NeverPicked(Schedule):
    """Something is due for ever, and is nobody's turn."""

    def pick(self, now_s: float, among: int = -1) -> int | None:
        return None

    def next_due_s(self) -> float | None:
        return 1.0


def test_a_master_whose_poll_is_due_and_never_carried_out_shows_no_flag(clock: JumpingClock) -> None:
    it = Bench(clock, reads(1, 0))
    it.steps(1)
    it.master._schedule = NeverPicked([1.0])
    assert hangs(it.master, clock)


class LineThatNeverEnds(Line):
    """A request is sent, and nothing ever becomes of it."""

    def advance(self, wait_s: float) -> Response | None:
        if self._asked is None:
            return super().advance(wait_s)
        return None


class LineSpoiledForEver(Line):
    """Late replies are listened for, for ever."""

    def advance(self, wait_s: float) -> Response | None:
        response = super().advance(wait_s)
        if response is not None:
            self._time_passes = lambda: None  # type: ignore[method-assign] # the fault
        return response


@pytest.mark.parametrize("kind", [LineThatNeverEnds, LineSpoiledForEver])
def test_a_master_whose_request_or_whose_listening_never_ends_shows_no_flag(
    clock: JumpingClock, monkeypatch: pytest.MonkeyPatch, kind: type[Line]
) -> None:
    monkeypatch.setattr(master_module, "Line", kind)
    it = Bench(clock, reads(1, 0))
    it.field.silent = {1}
    assert longest_s(it.master, clock, 20.0) > 12.0
