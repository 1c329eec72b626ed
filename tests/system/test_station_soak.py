"""A station at 100 times its normal load, with all that can go wrong around it, for half an hour: nothing grows.

Normal load is what a usual small station has to do: 10 requests polled once a second on its lines, one SCADA that reads
every second or half second and writes a setpoint every 10 s. Here 3 lines (RTU, ASCII, TCP) are polled 1000 times a
second by 200 requests; 4 SCADA clients read 160 times a second and 3 more write each setpoint as soon as the last one
has gone through the device and back; somebody has the menu and looks on.

Beside these, lines and clients of their own go wrong, all at once and each for a while, again and again: see
``troubles``. Meanwhile nothing may go wrong on the 3 lines; in between the station has to come back to the threads,
descriptors and alarms that it had before. The watchdog's device is a FIFO that this test reads.
RTUGATE_SOAK_S is how many seconds it takes.
"""

from __future__ import annotations

import os
import random
import re
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from tests.hmi.real_station import eventually
from tests.system.busy_station import BACK_LIMIT_S, EVERY_S, KINDS, REQUESTS, TROUBLED, Place, Watchdog, beside, place
from tests.system.scada import BLOCK, READERS, READS_EACH, Seen, scada
from tests.system.troubles import Coming, Onlooker

SOAK_S = float(os.environ.get("RTUGATE_SOAK_S", "1800"))
WARM_UP_S = 80.0  # after a minute the last good configuration is written, once: what that takes stays
SAMPLE_S = min(10.0, SOAK_S / 48)
TICK_S = 0.05
TROUBLE_MOST_S = min(60.0, SOAK_S / 8)
CALM_S = 5.0  # between troubles: what must not happen has time to happen
GROWTH_KIB = 512
POLLS_LEAST = 0.9  # of what is asked for: the two processors belong to devices, SCADA and this test as well
P99_MOST_S = 0.1  # of an answer, likewise
STILL_MOST_S = 10.0  # a value that moves five times a second
FEED_MOST_S = 10.0  # of the 30 s that the watchdog's device waits
LINES_MOST = 4  # in the log, of each line in each round: when its port or its device goes, and when it returns
THAT_IS_A_FIFO = "it refuses a watchdog's requests (is it one?)"
SEED = 5

Record = Callable[[str, object], None]


# ------------------------------------------------------------------------------------------------ figures


@dataclass
class Figures:
    """One look at a process."""

    rss_kib: int
    threads: int
    descriptors: int


def look_at(pid: int) -> Figures:
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    descriptors = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return Figures(int(status["VmRSS"].split()[0]), int(status["Threads"]), descriptors)


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@dataclass
class Watch:
    """Looks at the process now and then, and at how well the machine itself keeps time."""

    pid: int
    samples: list[Figures] = field(default_factory=list)
    longest_s: float = 0.0  # that this thread was late: so long the machine had no time for anybody, perhaps

    def look(self, stop: threading.Event) -> None:
        now_s = sampled_s = time.monotonic()
        while not stop.wait(TICK_S):
            before_s, now_s = now_s, time.monotonic()
            self.longest_s = max(self.longest_s, now_s - before_s - TICK_S)
            if now_s >= sampled_s + SAMPLE_S:
                sampled_s = now_s
                self.samples.append(look_at(self.pid))


def memory_of(samples: Sequence[Figures]) -> tuple[float, float]:
    """Return the median memory of the second quarter and of the last, in KiB."""
    quarter = len(samples) // 4
    parts = samples[quarter : 2 * quarter], samples[-quarter:]
    second, last = (median(sample.rss_kib for sample in part) for part in parts)
    return second, last


def p99(times_s: Sequence[float]) -> float:
    return sorted(times_s)[len(times_s) * 99 // 100]


def in_ms(times_s: Sequence[float]) -> str:
    found = median(times_s), p99(times_s), max(times_s)
    return "median {:.1f}, p99 {:.1f}, longest {:.1f} ms".format(*(1000 * time_s for time_s in found))


# ------------------------------------------------------------------------------------------------ troubles


class Soak:
    """The station while it soaks: rounds of troubles, and what it was before them."""

    def __init__(self, here: Place) -> None:
        self.here = here
        self.pid = here.station.process.pid
        self.back_s: list[float] = []  # how long the station took to be well after each round
        self._chance = random.Random(SEED)
        self.well = self._state()  # alarms, threads, descriptors
        self._began_s, self._began_cpu_s = time.monotonic(), cpu_s(self.pid)
        self._began = here.steady_masters()

    def run(self) -> None:
        """One round after the other until the time is over."""
        while time.monotonic() < self._began_s + SOAK_S:
            self._go_wrong()
            over_s = time.monotonic()
            self.here.is_polled_again()
            eventually(self._state, lambda now: now == self.well, BACK_LIMIT_S)
            self.back_s.append(time.monotonic() - over_s)
            time.sleep(CALM_S)  # there is no event: time is to pass without trouble
            assert self.here.station.process.poll() is None

    def _state(self) -> tuple[list[str], int, int]:
        alarms = self.here.alarms()
        now = look_at(self.pid)
        return alarms, now.threads, now.descriptors

    def _go_wrong(self) -> None:
        """All troubles, each from a moment and for a time of its own."""
        acts: list[tuple[float, Callable[[], None]]] = []
        for trouble in self.here.troubles.values():
            begin_s = self._chance.uniform(0.0, TROUBLE_MOST_S / 4)
            end_s = self._chance.uniform(TROUBLE_MOST_S / 2, TROUBLE_MOST_S)
            acts += [(begin_s, trouble.begin), (end_s, trouble.end)]
        acts.append((TROUBLE_MOST_S / 2, self._is_told))
        began_s = time.monotonic()
        for at_s, act in sorted(acts, key=lambda timed: timed[0]):
            time.sleep(max(0.0, began_s + at_s - time.monotonic()))  # there is no event
            act()

    def _is_told(self) -> None:
        """Each line that has trouble is an alarm, and nothing else is."""

        def alarms() -> set[str]:
            return {alarm.partition(":")[0] for alarm in self.here.alarms() if alarm not in self.well[0]}

        eventually(alarms, lambda names: names == set(TROUBLED))

    def polls_a_second(self) -> float:
        """Return how often devices of the steady lines have answered; any failure there is an error."""
        now = self.here.steady_masters()
        for line in now:
            failed = {what: line[what] for what in ("timeouts", "damaged", "exceptions", "expired")}
            assert not any(failed.values()), f"{line['name']}: {failed}"
        good = sum(line["good"] for line in now) - sum(line["good"] for line in self._began)
        return float(good / (time.monotonic() - self._began_s))

    def cpu_share(self) -> float:
        return (cpu_s(self.pid) - self._began_cpu_s) / (time.monotonic() - self._began_s)


# ------------------------------------------------------------------------------------------------ the soak


def test_half_an_hour_at_100_times_normal_load_with_every_trouble_grows_by_nothing(
    tmp_path: Path, record_property: Record
) -> None:
    with ExitStack() as stack:
        here = stack.enter_context(place(tmp_path))
        onlooker = Onlooker(here.ports.telnet, SOAK_S / 60)
        onlooker.begin()
        stack.callback(onlooker.end)
        with scada(here.ports.scada, BLOCK * REQUESTS, len(KINDS)) as crowd:
            time.sleep(WARM_UP_S)  # there is no event: the last good configuration is written meanwhile
            soak = Soak(here)
            watch = Watch(soak.pid)
            with beside(watch.look):
                soak.run()
            polls, cpu = soak.polls_a_second(), soak.cpu_share()
        onlooker.end()
        here.station.process.send_signal(signal.SIGTERM)
        assert here.station.process.wait(timeout=2.0) == 0
    record_property("from start to first answer", f"{here.first_answer_s:.2f} s")
    record_property("polls answered, processor", f"{polls:.0f} a second, {100 * cpu:.0f} % of one core")
    record_property("longest that this test itself was late", f"{1000 * watch.longest_s:.0f} ms")
    people_and_clients_came(here, onlooker, record_property)
    threads_and_descriptors_came_back(soak, watch.samples, record_property)
    the_watchdog_was_fed(here.watchdog, record_property)
    the_field_was_polled(polls)
    scada_was_served(crowd.seen, record_property)
    memory_is_flat(watch.samples, record_property)
    the_log_is_short(here.station.said, len(soak.back_s), record_property)


def people_and_clients_came(here: Place, onlooker: Onlooker, record: Record) -> None:
    visits = {name: trouble.visits for name, trouble in here.troubles.items() if isinstance(trouble, Coming)}
    record("visits", ", ".join(f"{name} {count}" for name, count in visits.items()))
    record("somebody at the menu was shown", f"{onlooker.bytes // 1024} KiB")
    assert all(visits.values())
    assert onlooker.bytes


def threads_and_descriptors_came_back(soak: Soak, samples: Sequence[Figures], record: Record) -> None:
    _alarms, threads, descriptors = soak.well
    most = max(sample.threads for sample in samples), max(sample.descriptors for sample in samples)
    record(
        "threads, descriptors after each round", f"{threads}, {descriptors}; within one {most[0]}, {most[1]} at most"
    )
    record("rounds of troubles, well again after", f"{len(soak.back_s)}, {max(soak.back_s):.0f} s at most")


def the_field_was_polled(polls: float) -> None:
    assert polls >= POLLS_LEAST * REQUESTS / EVERY_S


def scada_was_served(seen: Seen, record: Record) -> None:
    """No error, no torn block, nothing old, and every setpoint went through the device and back."""
    record("SCADA reads, errors", f"{len(seen.late_s)}, {len(seen.errors)}")
    record("SCADA answers", in_ms(seen.late_s))
    record("setpoints through the device and back", f"{len(seen.back_s)}, {in_ms(seen.back_s)}")
    record("longest that a moving value stood still", f"{seen.still_s:.1f} s")
    assert seen.errors == []
    assert p99(seen.late_s) <= P99_MOST_S
    assert len(seen.late_s) >= 0.9 * READERS * READS_EACH * SOAK_S
    assert len(seen.back_s) >= SOAK_S  # 10 times what is normal, at the least
    assert seen.still_s <= STILL_MOST_S


def memory_is_flat(samples: Sequence[Figures], record: Record) -> None:
    second, last = memory_of(samples)
    record("memory in the second quarter, in the last", f"{second:.0f} KiB, {last:.0f} KiB")
    assert last <= second + GROWTH_KIB


def the_log_is_short(said: str, rounds: int, record: Record) -> None:
    """Nothing is complained of but what went wrong, and of that a line when it begins and one when it is over."""
    complaints = [line for line in said.splitlines() if "WARNING" in line or "ERROR" in line]
    record("logged: bytes, warnings and errors", f"{len(said)}, {len(complaints)}")
    about = re.compile(rf"(WARNING|ERROR) ({'|'.join(TROUBLED)})(/[^:]*)?: ")
    assert [line for line in complaints if not about.match(line) and THAT_IS_A_FIFO not in line] == []
    assert len(complaints) <= LINES_MOST * len(TROUBLED) * (rounds + 1)
    assert "Traceback" not in said


def the_watchdog_was_fed(watchdog: Watchdog, record: Record) -> None:
    record("watchdog fed, longest without", f"{watchdog.count} times, {watchdog.longest_s:.1f} s")
    assert watchdog.count > SOAK_S / FEED_MOST_S
    assert watchdog.longest_s <= FEED_MOST_S
    assert watchdog.last == b"V"
