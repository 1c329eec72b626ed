"""`rtugate demo`: three simulated devices, a gateway that polls them, and a SCADA that looks at the gateway.

The devices and the SCADA are pymodbus, not our own protocol code; the gateway between them is the real one. It needs no
hardware and no root. With a number of seconds it ends with a verdict: did every device's moving values arrive, whole
and right, and did a value written by SCADA arrive in its device?

Threads: the simulator's one, the gateway's (a supervisor and its tasks), and the caller's, which is the SCADA.
"""

from __future__ import annotations

import inspect
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TextIO

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException

from gateway.clock import SystemClock
from gateway.config_file import ConfigFile
from gateway.errors import LinkUnavailable
from gateway.link_tcp import listen_tcp
from gateway.logs import LogRing
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister, Quality
from gateway.running import Gateway
from gateway.service import shared_of
from gateway.simulator import Device, Simulator, demo_devices
from gateway.wiring import terminal_plans

CONFIGURATION: Final = """\
[[master]]                      # an RS-485 pair with two devices
name = "field"
line = "{serial}"
parity = "none"                 # a pseudo terminal cannot do parity
response_timeout = 0.5

[[master.request]]
name = "meter"
unit = 2
function = "read-input-registers"
address = 0
count = 5
every = 0.25
point = 0

[[master.request]]
name = "boiler"
unit = 17
function = "read-holding-registers"
address = 107
count = 4
every = 0.25
point = 107

[[master.request]]
name = "setpoint"               # what SCADA writes to point 110 goes to the boiler
unit = 17
function = "write-single-register"
address = 110
count = 1
point = 110
trigger = "change"

[[master]]                      # a device on the network
name = "plant"
line = "tcp://127.0.0.1:{tcp}"
response_timeout = 0.5

[[master.request]]
name = "io"
unit = 1
function = "read-input-registers"
address = 0
count = 4
every = 0.25
point = 20

[[master.request]]
name = "io-inputs"
unit = 1
function = "read-discrete-inputs"
address = 0
count = 16
every = 0.25
point = 0

[[slave]]
name = "scada"
line = "tcp://127.0.0.1:{port}"
unit = 1

[hmi.telnet]                    # the menu
listen = "{menu}"
"""

HIGHEST_PORT: Final = 65535
LOOK_EVERY_S: Final = 0.5
KEPT: Final = 50  # values of each device that still count as its own: 10 s
CHANGES_WANTED: Final = 3
SETPOINT: Final = 110
SETPOINT_AFTER: Final = 3  # looks, then SCADA writes


@dataclass
class Watched:
    """The moving values of one device, as it had them and as SCADA saw them through the gateway."""

    device: Device
    table: Table  # in the device and in the register
    address: int
    point: int
    count: int
    had: deque[tuple[int, ...]] = field(default_factory=lambda: deque(maxlen=KEPT))
    seen: tuple[int, ...] = ()
    looks: int = 0
    agreed: int = 0
    changes: int = 0

    def follow(self) -> None:
        """Keep a copy of the device's values each time they move."""
        move = self.device.moves

        def moves(device: Device, seconds: float) -> None:
            if move is not None:
                move(device, seconds)
            self.had.append(self.now())

        self.had.append(self.now())
        self.device.moves = moves

    @property
    def span(self) -> Span:
        """Where the gateway keeps them."""
        return Span(self.table, self.point, self.count)

    def now(self) -> tuple[int, ...]:
        """Return the device's own values."""
        return tuple(self.device.get(self.table, self.address, self.count))

    def look(self, values: tuple[int, ...]) -> None:
        """Take what SCADA sees now."""
        self.looks += 1
        self.agreed += values in tuple(self.had)
        self.changes += bool(self.seen) and values != self.seen
        self.seen = values

    def is_well(self) -> bool:
        """True if the values moved, and were always the device's own."""
        return self.changes >= CHANGES_WANTED and self.agreed == self.looks

    def summary(self) -> str:
        """One line for the verdict."""
        return (
            f"{self.device.name:7} looked at {self.looks} times, changed {self.changes} times, "
            f"agreed with the device {self.agreed} times"
        )


class Scada:
    """A pymodbus client on the gateway's slave."""

    def __init__(self, port: int) -> None:
        self._client: Any = ModbusTcpClient("127.0.0.1", port=port, timeout=2, retries=1)
        known = inspect.signature(self._client.read_coils).parameters
        self._unit = {"device_id" if "device_id" in known else "slave": 1}  # the name changed in pymodbus 3.10

    def close(self) -> None:
        """Let go of the connection."""
        self._client.close()

    def read(self, watched: Watched) -> tuple[int, ...] | None:
        """Return the values of *watched* in the gateway's register, or None if it does not answer."""
        is_input = watched.table is Table.INPUT_REGISTERS
        read = self._client.read_input_registers if is_input else self._client.read_holding_registers
        reply = self._call(read, watched.point, count=watched.count)
        return None if reply is None else tuple(reply.registers)

    def write(self, point: int, value: int) -> bool:
        """Write one holding register; True if the gateway took it."""
        return self._call(self._client.write_register, point, value) is not None

    def _call(self, function: Callable[..., Any], *values: int, **more: int) -> Any:
        try:
            self._client.connect()
            reply = function(*values, **more, **self._unit)
        except (ModbusException, OSError):
            return None
        return None if reply.isError() else reply


class Demo:
    """The whole plant: devices, gateway, SCADA."""

    def __init__(self, port: int, silent: str | None = None) -> None:
        """*silent*: the name of a device that answers nothing, to see what the gateway makes of it."""
        self.port = port
        meter, boiler, block = demo_devices()
        self.boiler = boiler
        self.watched = [
            Watched(meter, Table.INPUT_REGISTERS, address=0, point=0, count=5),
            Watched(boiler, Table.HOLDING_REGISTERS, address=107, point=107, count=3),
            Watched(block, Table.INPUT_REGISTERS, address=0, point=20, count=4),
        ]
        for watched in self.watched:
            watched.follow()
            watched.device.silent = watched.device.name == silent
        self.menu_port = port + 1 if port < HIGHEST_PORT else None
        self.has_ended = False  # the menu's X has stopped the gateway
        self.setpoint: int | None = None
        self.register: DataRegister | None = None

    def quality(self, watched: Watched) -> str:
        """Return what the gateway itself thinks of the values, unless they are good."""
        if self.register is None:
            return ""
        worst = {sample.quality for sample in self.register.samples(watched.span)} - {Quality.GOOD}
        return "".join(f"  ({quality.name.lower()})" for quality in sorted(worst))

    @contextmanager
    def running(self) -> Iterator[Scada]:
        """Run devices and gateway while the caller looks at them."""
        meter, boiler, block = (watched.device for watched in self.watched)
        listen_tcp("127.0.0.1", self.port).close()  # say now, not in a log line, that the port is taken
        with Simulator() as simulator, tempfile.TemporaryDirectory(prefix="rtugate-demo-") as folder:
            serial = simulator.add_serial([meter, boiler])
            gateway = self._gateway(Path(folder), serial, simulator.add_tcp([block]))
            self.register = gateway.register
            started = threading.Event()
            thread = threading.Thread(target=self._run, args=(gateway, started), name="supervisor")
            scada = Scada(self.port)
            thread.start()
            try:
                started.wait()
                for task in gateway.supervisor.tasks.values():
                    task.ready.wait()
                yield scada
            finally:
                scada.close()
                gateway.stop()
                thread.join()

    def _gateway(self, folder: Path, serial: str, tcp: int) -> Gateway:
        """Return the gateway with its menu; what the menu saves goes into *folder*."""
        path, clock = folder / "demo.toml", SystemClock()
        listen = f"127.0.0.1:{self.menu_port}" if self.menu_port else ""
        path.write_text(CONFIGURATION.format(serial=serial, tcp=tcp, port=self.port, menu=listen), encoding="utf-8")
        gateway = Gateway(ConfigFile(path, folder, clock), clock, LogRing())
        shared = shared_of(gateway)
        gateway.terminal_plans = lambda config: terminal_plans(config, shared, None)
        return gateway

    def _run(self, gateway: Gateway, started: threading.Event) -> None:
        gateway.run(started.set)
        self.has_ended = True

    def look(self, scada: Scada, number: int) -> None:
        """Look at everything once; on the third look write a setpoint."""
        for watched in self.watched:
            values = scada.read(watched)
            if values is not None:
                watched.look(values)
        if number == SETPOINT_AFTER:
            value = 600 + int(time.time()) % 200
            self.setpoint = value if scada.write(SETPOINT, value) else None

    def setpoint_arrived(self) -> bool:
        """True if the boiler was given what SCADA wrote, once."""
        written = [values for _, address, values in tuple(self.boiler.writes) if address == SETPOINT]
        return self.setpoint is not None and written.count([self.setpoint]) == 1

    def is_well(self) -> bool:
        """The verdict."""
        return all(watched.is_well() for watched in self.watched) and self.setpoint_arrived()


def run_demo(seconds: float | None, port: int, silent: str | None, out: TextIO, stop: threading.Event) -> int:
    """Run the demo for *seconds*, or until *stop*; return the exit code. Raises LinkUnavailable (port in use)."""
    demo = Demo(port, silent)
    try:
        with demo.running() as scada:
            print(_welcome(port, demo.menu_port), file=out, flush=True)
            _watch(demo, scada, seconds, out, stop)
    except LinkUnavailable as error:
        print(f"rtugate demo: {error}; try --port", file=sys.stderr)
        return 1
    if seconds is None:
        return 0
    print(_verdict(demo), file=out, flush=True)
    return 0 if demo.is_well() else 1


def _watch(demo: Demo, scada: Scada, seconds: float | None, out: TextIO, stop: threading.Event) -> None:
    began_s = time.monotonic()
    number = 0
    while not stop.wait(LOOK_EVERY_S) and not demo.has_ended:
        number += 1
        passed_s = time.monotonic() - began_s
        demo.look(scada, number)
        _show(demo, passed_s, number, out)
        if seconds is not None and passed_s + LOOK_EVERY_S > seconds:
            return


def _welcome(port: int, menu_port: int | None) -> str:
    menu = f"\n  telnet 127.0.0.1 {menu_port}    the menu; what it saves is gone with the demo\n" if menu_port else ""
    return f"""\
rtugate demo: a meter and a boiler on a serial line, an I/O block on TCP; the gateway polls them
and serves them as a slave (server) on 127.0.0.1:{port}, unit 1. Look at it yourself:

  mbpoll -m tcp -p {port} -0 -t 3 -r 0 -c 5 127.0.0.1        meter: 0.1 V, 0.01 A, W, Wh (2)
  mbpoll -m tcp -p {port} -0 -t 4 -r 107 -c 4 127.0.0.1      boiler: 0.1 C, 110 is the setpoint
  mbpoll -m tcp -p {port} -0 -t 4 -r 110 127.0.0.1 700       give the boiler a setpoint of 70 C

  python -c "from pymodbus.client import ModbusTcpClient as C; c = C('127.0.0.1', port={port}); c.connect(); \\
print(c.read_input_registers(0, count=5).registers)"
{menu}"""


def _show(demo: Demo, passed_s: float, number: int, out: TextIO) -> None:
    meter, boiler, block = (watched.seen or (0,) * watched.count for watched in demo.watched)
    texts = [
        f"{meter[0] / 10:.1f} V  {meter[1] / 100:.2f} A  {meter[2]} W  {meter[3] << 16 | meter[4]} Wh",
        f"{boiler[0] / 10:.1f} C  flow {boiler[1] / 10:.1f} C  return {boiler[2] / 10:.1f} C",
        f"ramp {block[0]}  sine {block[1]}  coils on {block[3]}",
    ]
    rows = [(w.device.name, text + demo.quality(w)) for w, text in zip(demo.watched, texts, strict=True)]
    if not out.isatty():
        if number % 2 == 0:
            print(f"{passed_s:5.0f} s  " + " | ".join(f"{name}: {text}" for name, text in rows), file=out, flush=True)
        return
    if number > 1:
        print(f"\x1b[{len(rows) + 1}A", end="", file=out)
    print(f"\x1b[2Kafter {passed_s:.0f} s, through 127.0.0.1:{demo.port} (Ctrl-C ends)", file=out)
    for name, text in rows:
        print(f"\x1b[2K  {name:7}{text}", file=out, flush=True)


def _verdict(demo: Demo) -> str:
    lines = [watched.summary() for watched in demo.watched]
    if demo.setpoint is None:
        lines.append("setpoint: the gateway did not take it")
    else:
        arrived = "arrived in the boiler" if demo.setpoint_arrived() else "did not arrive in the boiler"
        lines.append(f"setpoint {demo.setpoint / 10:.1f} C, written to holding {SETPOINT}, {arrived}")
    lines.append("demo: passed" if demo.is_well() else f"demo: FAILED ({CHANGES_WANTED} changes each were wanted)")
    return "\n".join(lines)
