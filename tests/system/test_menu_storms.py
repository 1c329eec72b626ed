"""Storms at the menu: Modbus goes on at its speed, memory stays flat, and the menu is there when they are over.

Rounds with and without a storm alternate; each measures a SCADA that asks 100 times a second, one that asks as fast as
it is answered, and how often the device is polled. The storms (``storm``) and the fast SCADA are processes of their
own.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import pytest

from gateway.hmi.access import hash_password
from gateway.modbus.pdu import Table
from gateway.simulator import Device, Simulator
from tests.hmi.real_station import Hands, RealStation, eventually, real_station
from tests.peers import free_port
from tests.system.test_station_soak import Figures, look_at

ROUNDS = 3
STORM_S, WARM_UP_S, QUIET_S = 20.0, 10.0, 8.0
ASKED_EVERY_S, POLLED_EVERY_S = 0.01, 0.02
GROWTH_KIB = 1024
LEAST = 0.7  # of what it is without a storm: polls, and whatever SCADA asks at a steady pace
FAST_LEAST = 0.5  # of the requests that are answered with all there is: the storm's own processor time is missing there
STORM = ["random", "options", "subnegotiations", "endless", "keys", "deaf", "resets"]  # and one person: 8 in all
ALL_ALONE = ["keys", "random", "deaf", "mute", "dribbles", "dribbles", "resets", "resets"]
PASSWORD = "open sesame"  # noqa: S105 - opens nothing but these tests
REQUEST = bytes.fromhex("0001 0000 0006 01 03 0000 000A")  # 10 holding registers of unit 1
STATION = """\
[log]
level = "debug"                 # "has come" tells that a storm has begun

[hmi]
password = "{password}"

[hmi.telnet]
listen = "127.0.0.1:{telnet}"

[[master]]
name = "field"
line = "{field}"
parity = "none"
stop_bits = 2
baudrate = 115200

[[master.request]]
name = "boiler"
unit = 17
function = 3
address = 107
count = 10
every = {every}
point = 0

[[slave]]
name = "scada"
line = "tcp://127.0.0.1:{scada}"
unit = 1
"""


@dataclass
class Speed:
    """What one round has measured."""

    requests: float  # a second, as fast as they are answered
    polls: float  # a second
    seconds: float  # of the steady requests
    late_s: list[float]  # each steady request: how long its answer took

    def fast(self) -> float:
        return self.requests

    def steady(self) -> float:
        return len(self.late_s) / self.seconds

    def polled(self) -> float:
        return self.polls

    def text(self) -> str:
        times_ms = sorted(1000 * late_s for late_s in self.late_s)
        p99_ms = times_ms[len(times_ms) * 99 // 100]
        return (
            f"fast {self.requests:.0f}/s, steady {self.steady():.0f}/s, polls {self.polls:.1f}/s;"
            f" steady answers after {median(times_ms):.2f} ms, p99 {p99_ms:.1f} ms, longest {times_ms[-1]:.1f} ms"
        )


@dataclass
class Plant:
    """A station that runs, its device, and its ports."""

    station: RealStation
    device: Device
    telnet: int
    scada: int

    def figures(self) -> Figures:
        return look_at(self.station.process.pid)

    def measured(self, seconds: float) -> Speed:
        """Measure for so long; a request that is not answered, or wrongly, is an error."""
        polls, began_s = self.device.served, time.monotonic()
        late_s = self._ask_steadily(seconds / 2)
        command = [sys.executable, "-m", "bench.client", str(self.scada), str(seconds / 2), "10"]
        requests = float(subprocess.run(command, check=True, capture_output=True, timeout=seconds + 20).stdout)
        polled = (self.device.served - polls) / (time.monotonic() - began_s)
        return Speed(requests, polled, seconds / 2, late_s)

    def _ask_steadily(self, seconds: float) -> list[float]:
        until_s, late_s = time.monotonic() + seconds, []
        with socket.create_connection(("127.0.0.1", self.scada), 5.0) as scada:
            scada.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while (asked_s := time.monotonic()) < until_s:
                scada.sendall(REQUEST)
                assert len(scada.recv(512)) == 29
                late_s.append(time.monotonic() - asked_s)
                time.sleep(ASKED_EVERY_S)  # the pace of this SCADA
        return late_s


@pytest.fixture
def device() -> Device:
    boiler = Device("boiler", 17)
    boiler.set(Table.HOLDING_REGISTERS, 107, list(range(642, 652)))
    return boiler


@contextmanager
def plant(folder: Path, device: Device, password: str = "") -> Iterator[Plant]:
    telnet, scada = free_port(), free_port()
    with Simulator() as simulator:
        field = simulator.add_serial([device])
        text = STATION.format(password=password, telnet=telnet, scada=scada, field=field, every=POLLED_EVERY_S)
        with real_station(folder, text) as station:
            station.wait_for("scada: listening")
            eventually(lambda: device.served)
            yield Plant(station, device, telnet, scada)


@contextmanager
def storm(plant: Plant, kinds: list[str], seconds: float) -> Iterator[list[str]]:
    """Let these clients loose for so long; what they did is in the list afterwards."""
    command = [sys.executable, "-m", "tests.system.storm", str(plant.telnet), str(seconds), *kinds]
    done: list[str] = []
    came = plant.station.said.count("has come")
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        eventually(lambda: plant.station.said.count("has come"), lambda count: count > came)
        yield done
        done.append(process.communicate(timeout=seconds + 20)[0].strip())
    assert process.returncode == 0
    assert all(times for _kind, times, _sent in json.loads(done[0])), f"some could not come at all: {done[0]}"


@contextmanager
def onlooker(plant: Plant, password: str = "") -> Iterator[Hands]:
    """Somebody at the menu who has writes (E) and the traffic of the slave (T) shown, and reads it all."""
    with socket.create_connection(("127.0.0.1", plant.telnet)) as terminal:
        hands = Hands(terminal.fileno())
        if password:
            hands.carry_out([("Password: ", f"{password}\r")])
        hands.carry_out([("rtugate> ", "e"), ("E ends it.", ""), ("rtugate> ", "t"), ("Line: ", "2")])
        hands.sees("until any key")
        reading = threading.Thread(target=hands.sees_the_end)
        reading.start()
        try:
            yield hands
        finally:
            terminal.shutdown(socket.SHUT_RDWR)
            reading.join()


def the_menu_works(plant: Plant, password: str = "") -> None:
    """Somebody who comes now is let in, and finds what the device says."""
    with socket.create_connection(("127.0.0.1", plant.telnet), source_address=("127.0.0.99", 0)) as terminal:
        hands = Hands(terminal.fileno())
        if password:
            hands.carry_out([("Password: ", f"{password}\r")])
        hands.carry_out([("rtugate> ", "d"), ("Table: ", "3"), ("First point (0-1999): ", "0\r"), (" [1]: ", "\r")])
        hands.sees("   642 ")


def is_quiet_again(plant: Plant, before: Figures) -> None:
    """Threads and descriptors come back to what they were."""
    wanted = (before.threads, before.descriptors)
    eventually(lambda: (plant.figures().threads, plant.figures().descriptors), lambda now: now == wanted)


def record_speeds(record: Callable[[str, object], None], quiet: list[Speed], others: dict[str, list[Speed]]) -> None:
    """Record all rounds, and how the others compare with the quiet ones; none may be much slower."""
    for name, speeds in {"quiet": quiet, **others}.items():
        for speed in speeds:
            record(name, speed.text())
    for name, speeds in others.items():
        fast, steady, polls = (
            median(look(speed) for speed in speeds) / median(look(speed) for speed in quiet)
            for look in (Speed.fast, Speed.steady, Speed.polled)
        )
        record(f"{name}, against quiet", f"fast {fast:.2f}, steady {steady:.2f}, polls {polls:.2f}")
        assert fast >= FAST_LEAST
        assert steady >= LEAST
        assert polls >= LEAST


def test_storms_at_the_menu_slow_no_modbus_and_leave_nothing_behind(
    tmp_path: Path, device: Device, record_property: Callable[[str, object], None]
) -> None:
    with plant(tmp_path, device) as here:
        before = here.figures()
        rage(here, WARM_UP_S)
        is_quiet_again(here, before)
        warm = here.figures()
        quiet, watched, stormy = [], [], []
        for _ in range(ROUNDS):
            quiet.append(here.measured(QUIET_S))
            with onlooker(here):
                watched.append(here.measured(QUIET_S))
                with storm(here, STORM, STORM_S) as done:
                    stormy.append(here.measured(STORM_S * 0.7))
            record_property("connections and bytes of a storm", done[0])
        rage(here, WARM_UP_S)
        is_quiet_again(here, before)
        after = here.figures()
        memory = f"{before.rss_kib}, {warm.rss_kib}, {after.rss_kib} KiB"
        record_property("memory before, after warm-up, at the end", memory)
        record_speeds(record_property, quiet, {"with E and T on": watched, "in the storm, with E and T on": stormy})
        the_menu_works(here)
        assert here.station.stop() == 0
        assert "Traceback" not in here.station.said
    assert after.rss_kib <= warm.rss_kib + GROWTH_KIB


def rage(plant: Plant, seconds: float) -> None:
    """Every kind of storm for a while, those as well that have the menu for themselves, one after the other."""
    with onlooker(plant), storm(plant, STORM, seconds):
        pass
    with storm(plant, ALL_ALONE, seconds):
        pass


def test_guessing_passwords_slows_no_modbus(
    tmp_path: Path, device: Device, record_property: Callable[[str, object], None]
) -> None:
    with plant(tmp_path, device, hash_password(PASSWORD)) as here:
        quiet, stormy = [], []
        before = here.figures()
        the_menu_works(here, PASSWORD)
        for _ in range(ROUNDS):
            quiet.append(here.measured(QUIET_S))
            with storm(here, ["guesses"] * 8, STORM_S) as done:
                stormy.append(here.measured(STORM_S * 0.7))
            record_property("connections and bytes of a storm", done[0])
        is_quiet_again(here, before)
        record_speeds(record_property, quiet, {"while passwords are tried": stormy})
        wrong = here.station.said.count("wrong password from")
        record_property(
            "passwords tried, addresses locked out", f"{wrong}, {here.station.said.count('too many wrong')}"
        )
        the_menu_works(here, PASSWORD)
        assert here.station.stop() == 0
    assert wrong > ROUNDS * STORM_S / 4  # they were tried at all
