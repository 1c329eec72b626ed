"""What a gateway is wired to in these tests, and one run of it of which everything is noted with its time.

The watchdog device is a FIFO: it takes what is written, and refuses ioctls. All times are CLOCK_MONOTONIC, which is
the same in every process. Threads: a plant and its runs belong to one thread at a time.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from gateway.modbus.pdu import Table
from gateway.simulator import Device, Simulator
from gateway.wiring import CONTROL, SERIAL_CONSOLE, TELNET
from tests.changing import read, section, serial_master, serial_slave, slave
from tests.hanging.faults import MOMENT, ORDER, SUPERVISOR
from tests.lines import Pty, RawClient, raw_client, rtu_frame
from tests.peers import free_port

REPOSITORY: Final = Path(__file__).parents[2]
FAULTY, SOUND = "tests.hanging", "gateway"  # which program
MASTER, TCP_SLAVE, SERIAL_SLAVE = "field", "scada", "plc"
THREADS: Final = (SUPERVISOR, MASTER, TCP_SLAVE, SERIAL_SLAVE, CONTROL, SERIAL_CONSOLE, TELNET)
SOON_S: Final = 20.0  # for what another program has to do; a test that needs it has failed
STOP_LIMIT_S: Final = 2.0  # a clean stop takes under 2 s (spec section 7)
LOOK_EVERY_S: Final = 0.02  # nothing tells a test that a simulated device was polled
DEVICE_TIMEOUT_S: Final = 30
ASK_TCP: Final = bytes.fromhex("0001 0000 0006 01 03 0000 0001")  # read holding register 0 of unit 1
ANSWER_TCP, ANSWER_RTU = 11, 7  # bytes
OPEN_WORDS: Final = (
    f"{TCP_SLAVE}: listening",
    f"{SERIAL_SLAVE}: listening",
    f"{SERIAL_CONSOLE}: open",
    f"{TELNET}: listening",
    f"{CONTROL}: listening",
)


class Plant:
    """A device, wires and ports for one gateway at a time; ``close`` takes it down."""

    def __init__(self, simulator: Simulator) -> None:
        self.device = Device("boiler", 17)
        self.device.set(Table.HOLDING_REGISTERS, 107, [555])
        self.line = simulator.add_serial([self.device])
        self.plc, self.console = Pty(), Pty()
        self.scada_port, self.telnet_port = free_port(), free_port()

    def close(self) -> None:
        self.plc.unplug()
        self.console.unplug()

    def configuration(self, timeout_s: float, watchdog: Path) -> str:
        return "".join(
            (
                section("[watchdog]", timeout=timeout_s, device=str(watchdog), device_timeout=DEVICE_TIMEOUT_S),
                section("[hmi]", serial_hold=0),  # telnet need not wait for the serial console
                section("[hmi.serial]", line=self.console.device),
                section("[hmi.telnet]", listen=f"127.0.0.1:{self.telnet_port}"),
                serial_master(MASTER, self.line, read(0, every=0.1)),
                slave(TCP_SLAVE, self.scada_port),
                serial_slave(SERIAL_SLAVE, self.plc.device),
            )
        )

    def forget(self) -> None:
        """Throw away what an earlier gateway has said and nobody has read."""
        for pty in (self.plc, self.console):
            termios.tcflush(pty.wire, termios.TCIOFLUSH)

    def is_polled(self, times: int = 2) -> Callable[[], bool]:
        """Return what tells whether the device has been polled so often from now on."""
        goal = self.device.served + times
        return lambda: self.device.served >= goal

    def serves_scada(self) -> bool:
        with raw_client(self.scada_port) as client:
            return asks(client)

    def serves_plc(self) -> bool:
        termios.tcflush(self.plc.wire, termios.TCIFLUSH)
        self.plc.send(rtu_frame("03 00 00 00 01", unit=1))
        return self.plc.receive(ANSWER_RTU)[:3] == bytes.fromhex("01 03 02")

    def shows_menu(self) -> bool:
        """Whether somebody at the serial console who presses a key is shown something."""
        termios.tcflush(self.console.wire, termios.TCIFLUSH)
        self.console.send(b"\r")
        return self.console.receive(1) != b""

    def lets_in(self) -> bool:
        """Whether somebody who comes by telnet is told something."""
        with raw_client(self.telnet_port) as client:
            return client.receive(1) != b""


@dataclass(frozen=True)
class Seen:
    """A line of the log, or what was written to the watchdog device, and when it came."""

    at_s: float
    text: str


@dataclass(eq=False)
class Run:
    """One run of the gateway; ``lines`` is its log, ``fed`` what its watchdog device got."""

    plant: Plant
    folder: Path  # its configuration, its state directory, its watchdog device; used again by the next start
    timeout_s: float
    program: str = FAULTY
    lines: list[Seen] = field(default_factory=list)
    fed: list[Seen] = field(default_factory=list)
    ended_s: float | None = None

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.order, self._watchdog = self.folder / "order", self.folder / "watchdog"
        if not self._watchdog.exists():
            os.mkfifo(self._watchdog)
        (self.folder / "rtugate.toml").write_text(self.plant.configuration(self.timeout_s, self._watchdog))
        self._fifo = os.open(self._watchdog, os.O_RDWR | os.O_NONBLOCK)  # a writer of our own: no end of file
        self._arguments = ["-c", str(self.folder / "rtugate.toml"), "--state", str(self.folder / "state")]
        self._environment = os.environ | {"PYTHONPATH": str(REPOSITORY), ORDER: str(self.order)}
        self._environment.pop("NOTIFY_SOCKET", None)
        self.process = subprocess.Popen(
            [sys.executable, "-m", self.program, "run", *self._arguments],
            stderr=subprocess.PIPE,
            env=self._environment,
            cwd=self.folder,
        )
        assert self.process.stderr is not None
        os.set_blocking(self.process.stderr.fileno(), False)
        self._pid = os.pidfd_open(self.process.pid)
        self._rest, self._has_log_ended = b"", False  # of a line of the log
        self._selector = selectors.DefaultSelector()
        self._selector.register(self.process.stderr, selectors.EVENT_READ, self._hear)
        self._selector.register(self._fifo, selectors.EVENT_READ, self._take_food)
        self._selector.register(self._pid, selectors.EVENT_READ, self._notice_end)

    # -------------------------------------------------------------------------------------------- what it does

    @property
    def said(self) -> str:
        return "\n".join(line.text for line in self.lines)

    @property
    def food(self) -> str:
        """All that the watchdog device got."""
        return "".join(fed.text for fed in self.fed)

    def watch(self, is_over: Callable[[], object], limit_s: float = SOON_S) -> bool:
        """Note what happens until *is_over*; False if that has not come true within *limit_s*."""
        until_s = time.monotonic() + limit_s
        while not is_over():
            left_s = until_s - time.monotonic()
            if left_s <= 0:
                return False
            for key, _ in self._selector.select(min(left_s, LOOK_EVERY_S)):
                key.data()
        return True

    def wait_until(self, is_over: Callable[[], object], what: str) -> None:
        """``watch``; that it does not come true is an error."""
        self.watch(lambda: is_over() or self.ended_s is not None)
        assert is_over(), f"never: {what}. The log:\n{self.said}"

    def settle(self) -> None:
        """Wait until all its lines are open, its device is polled and its watchdog fed."""
        is_polled = self.plant.is_polled()
        self.wait_until(lambda: all(words in self.said for words in OPEN_WORDS), "all is open")
        self.wait_until(lambda: is_polled() and self.fed, "the device is polled, the watchdog fed")

    @property
    def is_over(self) -> bool:
        """The process has ended, and all that it said has been heard."""
        return self.ended_s is not None and self._has_log_ended

    def first(self, pattern: Callable[[str], object]) -> Seen | None:
        """Return the first line of the log that *pattern* is true of."""
        return next((line for line in self.lines if pattern(line.text)), None)

    def _hear(self) -> None:
        assert self.process.stderr is not None
        data, now_s = self.process.stderr.read(), time.monotonic()
        if data == b"":
            self._selector.unregister(self.process.stderr)
            self._has_log_ended = True
        *lines, self._rest = (self._rest + (data or b"")).split(b"\n")
        self.lines += [Seen(now_s, line.decode(errors="replace")) for line in lines]

    def _take_food(self) -> None:
        data, now_s = os.read(self._fifo, 4096), time.monotonic()
        self.fed += [Seen(now_s, chr(byte)) for byte in data]

    def _notice_end(self) -> None:
        self.ended_s = time.monotonic()
        self._selector.unregister(self._pid)
        self.process.wait()

    # -------------------------------------------------------------------------------------------- what is done to it

    def commit(self, who: str, kind: str) -> None:
        """Order a fault; whoever it is for commits it before its next step."""
        written = self.order.with_suffix(".new")
        written.write_text(f"{who}:{kind}")
        written.replace(self.order)

    @property
    def fault_s(self) -> float:
        """When the fault was committed."""
        return float(self.order.with_name(self.order.name + MOMENT).read_text())

    def status(self) -> dict[str, Any]:
        """Return what `rtugate status --json` says."""
        command = [sys.executable, "-m", SOUND, "status", "--json", *self._arguments]
        told = subprocess.run(command, env=self._environment, stdout=subprocess.PIPE, check=True, timeout=SOON_S).stdout
        answer: dict[str, Any] = json.loads(told)
        return answer

    def stop(self) -> int | None:
        """End it as systemd does; return its exit code, None if it does not end in time."""
        self.process.send_signal(signal.SIGTERM)
        self.watch(lambda: self.ended_s, STOP_LIMIT_S)
        return self.process.poll()

    def close(self) -> None:
        """Nothing of it is left."""
        self.process.kill()
        self.process.wait()
        self._selector.close()
        os.close(self._fifo)
        os.close(self._pid)
        assert self.process.stderr is not None
        self.process.stderr.close()


@contextmanager
def a_run(plant: Plant, folder: Path, timeout_s: float, program: str = FAULTY) -> Iterator[Run]:
    """Run the gateway; give it once it has settled."""
    plant.forget()
    with contextlib.closing(Run(plant, folder, timeout_s, program)) as run:
        run.settle()
        yield run


@contextmanager
def plants(count: int) -> Iterator[list[Plant]]:
    """Give so many plants, each for a gateway of its own."""
    with Simulator() as simulator, contextlib.ExitStack() as stack:
        yield [stack.enter_context(contextlib.closing(Plant(simulator))) for _ in range(count)]


def asks(client: RawClient) -> bool:
    """Whether this SCADA system is answered."""
    return len(client.ask(ASK_TCP, ANSWER_TCP)) == ANSWER_TCP
