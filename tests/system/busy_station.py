"""A small station with 100 times the work of one, and with all that can go wrong around it (see ``test_station_soak``).

Three lines on which nothing goes wrong, with their devices in a process of their own (``field``); four lines with two
devices each that know trouble, simulated in this process; a slave for SCADA; telnet; a FIFO as the watchdog's device.
"""

from __future__ import annotations

import itertools
import json
import os
import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from gateway.simulator import Device, Simulator
from tests.hmi.real_station import RealStation, eventually, real_station, scada_reads
from tests.peers import free_port
from tests.system.field import DEVICES, SETPOINT, a_device
from tests.system.field import field as devices_of
from tests.system.scada import ANSWER_LIMIT_S, BLOCK
from tests.system.troubles import (
    Coming,
    HalfOpen,
    Refusal,
    Silence,
    Trouble,
    Unplugging,
    connected,
    is_told_who_has_the_menu,
    reads_once,
)

KINDS = {
    "rtu": 35,
    "ascii": 25,
    "tcp": 140,
}  # requests of each line on which nothing goes wrong: what 230400 baud allow
EVERY_S = 0.2
REQUESTS = sum(KINDS.values())
TROUBLED = ("silent", "mute", "refuses", "adapter")  # the other lines
HALF_OPEN = 8
BACK_LIMIT_S = (
    100.0  # an offline device is tried once a minute at least; whether a silent peer is there still, after 30 s
)


# ------------------------------------------------------------------------------------------------ the watchdog's device


@contextmanager
def beside(work: Callable[[threading.Event], None]) -> Iterator[None]:
    """Have *work* done in a thread until the block ends."""
    stop = threading.Event()
    thread = threading.Thread(target=work, args=(stop,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@dataclass
class Watchdog:
    """Reads what the gateway writes to the watchdog's device."""

    path: Path
    count: int = 0
    last: bytes = b""
    longest_s: float = 0.0  # between two feedings

    def listen(self, stop: threading.Event) -> None:
        device = os.open(self.path, os.O_RDWR | os.O_NONBLOCK)  # also for writing: so it has no end
        fed_s = None
        try:
            while not stop.is_set():
                if not select.select([device], [], [], 0.5)[0]:
                    continue
                now_s, data = time.monotonic(), os.read(device, 4096)
                self.longest_s = max(self.longest_s, now_s - (fed_s or now_s))
                fed_s, self.last, self.count = now_s, data[-1:], self.count + len(data)
        finally:
            os.close(device)


# ------------------------------------------------------------------------------------------------ the file


@dataclass
class Ports:
    """Where the gateway is reached."""

    scada: int = field(default_factory=free_port)
    telnet: int = field(default_factory=free_port)
    extra: int = field(default_factory=free_port)


SERIAL = 'parity = "none"\nstop_bits = 2\nbaudrate = 230400\ndata_bits = 8\n'


def head(ports: Ports, watchdog: Path) -> str:
    return (
        f'[watchdog]\ndevice = "{watchdog}"\n[hmi.telnet]\nlisten = "127.0.0.1:{ports.telnet}"\n'
        f'[[slave]]\nname = "scada"\nline = "tcp://127.0.0.1:{ports.scada}"\nunit = 1\n'
    )


def master(name: str, line: str, framing: str, timeout_s: float) -> str:
    serial = "" if framing == "tcp" else SERIAL
    return (
        f'[[master]]\nname = "{name}"\nline = "{line}"\nframing = "{framing}"\nresponse_timeout = {timeout_s}\n{serial}'
    )


def request(unit: int, function: int, address: int, count: int, point: int) -> str:
    when = 'trigger = "change"' if function == 6 else f"every = {EVERY_S}"
    return (
        f"[[master.request]]\nunit = {unit}\nfunction = {function}\naddress = {address}\ncount = {count}\n"
        f"point = {point}\n{when}\n"
    )


def steady_lines(places: Sequence[str]) -> str:
    """The lines on which nothing goes wrong: their blocks from point 0 on, then their setpoints, there and back."""
    text, numbers = [], itertools.count()
    for line, ((kind, count), place) in enumerate(zip(KINDS.items(), places, strict=True)):
        text.append(master(kind, place, kind, ANSWER_LIMIT_S))
        for n in range(count):
            text.append(request(1 + n % DEVICES, 3, BLOCK * (n // DEVICES), BLOCK, BLOCK * next(numbers)))
        setpoint = BLOCK * REQUESTS + line
        text.append(request(1, 6, SETPOINT, 1, setpoint))
        text.append(request(1, 3, SETPOINT, 1, setpoint + len(KINDS)))
    return "\n".join(text)


def troubled_lines(places: dict[str, str], is_changed: bool) -> str:
    """The others; *is_changed*: as the file says after a reload, which makes one of them anew."""
    text, points = [], itertools.count(BLOCK * REQUESTS + 100, BLOCK)
    for name, place in places.items():
        timeout_s = 0.25 if is_changed and name == "mute" else 0.3
        text.append(master(name, place, "tcp" if place.startswith("tcp") else "rtu", timeout_s))
        text += [request(unit, 3, 0, BLOCK, next(points)) for unit in (1, 2)]
    return "\n".join(text)


def extra_slave(ports: Ports) -> str:
    return f'[[slave]]\nname = "extra"\nline = "tcp://127.0.0.1:{ports.extra}"\nunit = 1\n'


def status_of(station: RealStation) -> Any:
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(station.state / "control"))
        client.sendall(b"status --json\n")
        return json.loads(client.makefile().read())


class Reload:
    """Somebody edits the file, a line and a slave, and takes it back."""

    def __init__(self, station: RealStation, now: str, then: str, port: int) -> None:
        """*now*: the file as it is; *then*: what it is to become, with a slave at *port*."""
        self._station, self._now, self._then, self._port = station, now, then, port

    def begin(self) -> None:
        self._load(self._then)
        eventually(self._is_open)

    def end(self) -> None:
        self._load(self._now)
        eventually(lambda: not self._is_open())

    def _load(self, text: str) -> None:
        self._station.file.write_text(text)
        self._station.process.send_signal(signal.SIGHUP)

    def _is_open(self) -> bool:
        try:
            with connected(self._port):
                return True
        except OSError:
            return False


@dataclass
class Place:
    """The station, and all that goes wrong there: lines with devices, and the rest."""

    station: RealStation
    ports: Ports
    watchdog: Watchdog
    troubles: dict[str, Trouble]
    devices: dict[str, list[Device]]  # of the troubled lines
    first_answer_s: float  # after the program was started

    def is_polled_again(self) -> None:
        """Wait until every device of the troubled lines has been asked once more."""
        before = {device: device.served for devices in self.devices.values() for device in devices}
        eventually(lambda: [d.unit for d, n in before.items() if d.served == n], lambda left: not left, BACK_LIMIT_S)

    def alarms(self) -> list[str]:
        return list(status_of(self.station)["alarms"])

    def steady_masters(self) -> list[dict[str, Any]]:
        return [master for master in status_of(self.station)["masters"] if master["name"] in KINDS]


@contextmanager
def place(folder: Path) -> Iterator[Place]:
    """A station with its field, which runs until the block ends."""
    ports, watchdog = Ports(), Watchdog(folder / "watchdog")
    os.mkfifo(watchdog.path)
    devices = {name: [a_device(unit) for unit in (1, 2)] for name in TROUBLED}
    with ExitStack() as stack:
        steady = stack.enter_context(devices_of(list(KINDS)))
        here, of_refusal, of_adapter = (stack.enter_context(Simulator()) for _ in range(3))
        refusal = Refusal(of_refusal, devices["refuses"])
        adapter = stack.enter_context(closing(Unplugging(of_adapter, devices["adapter"], folder / "usb-adapter")))
        lines = {
            "silent": here.add_serial(devices["silent"]),
            "mute": f"tcp://127.0.0.1:{here.add_tcp(devices['mute'])}",
            "refuses": refusal.line,
            "adapter": str(folder / "usb-adapter"),
        }
        now, then = (head(ports, watchdog.path) + extra for extra in ("", extra_slave(ports)))
        now += steady_lines(steady) + troubled_lines(lines, False)
        then += steady_lines(steady) + troubled_lines(lines, True)
        stack.enter_context(beside(watchdog.listen))
        began_s = time.monotonic()
        station = stack.enter_context(real_station(folder, now))
        eventually(lambda: isinstance(scada_reads(ports.scada, 1, 0, BLOCK), list))
        first_answer_s = time.monotonic() - began_s
        troubles: dict[str, Trouble] = {
            "silent": Silence(devices["silent"][1]),
            "mute": Silence(devices["mute"][1]),
            "refuses": refusal,
            "adapter": adapter,
            "half-open clients": HalfOpen(ports.scada, HALF_OPEN),
            "clients that come and go": Coming(partial(reads_once, ports.scada)),
            "visitors at the menu": Coming(partial(is_told_who_has_the_menu, ports.telnet)),
            "reload": Reload(station, now, then, ports.extra),
        }
        yield Place(station, ports, watchdog, troubles, devices, first_answer_s)
