"""A virtual board with rtugate on it, and all that it is wired to.

ttyS0 polls a simulated meter, ttyS3 a simulated boiler; ttyS1 serves an upper master, mbpoll; on ttyS2 somebody sits at
the console. How rtugate gets onto the board is a ``Delivery``; ``SOURCES`` brings what lies in this tree.

Threads: the simulator's and the cable's to the upper master; ``Station`` belongs to one thread, the test's.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gateway.modbus.pdu import Table
from gateway.simulator import Device, Simulator
from tests import peers
from tests.changing import section
from tests.lines import cable
from tests.system.board.image import HERE, base
from tests.system.board.machine import SOON_S, Machine, a_machine

ROOT: Final = HERE.parents[2]
CONFIG: Final = "/etc/rtugate/rtugate.toml"
DROP_INS: Final = "/run/systemd/system/rtugate.service.d"
METER_UNIT, BOILER_UNIT, OUR_UNIT = 2, 17, 1
BAUD: Final = 19200
TIMEOUT_S: Final = 5.0  # of a task without progress
DEVICE_TIMEOUT_S: Final = 30  # of the hardware; more than TIMEOUT_S + 15
EVERY_S: Final = 0.5  # a poll
CONSOLE: Final = 2  # which UART
ANSWER_S: Final = 5.0  # that mbpoll waits: the board is slow
START_LIMIT_S: Final = 180.0  # the gateway takes 3 s on an idle machine, 20 s right after a boot on a busy one
SEVERAL: Final = 5  # polls: no left-over
ORDER: Final = "/run/faults/order"  # who is to commit which fault: tests.hanging
INSTALL_LIMIT_S: Final = 300.0
NO_TELNET: Final = section("[hmi.telnet]", listen="")


def configuration(unit: int = OUR_UNIT, timeout_s: float = TIMEOUT_S, beside: str = NO_TELNET) -> str:
    """Return the board's file. *unit*: what its slave answers to; *beside*: what it has beside the serial ports."""

    def request(name: str, device: int, table: int, address: int, count: int, point: int) -> str:
        keys = {"name": name, "unit": device, "function": table, "address": address, "count": count, "point": point}
        return section("[[master.request]]", **keys, every=EVERY_S)

    return "\n".join(
        (
            "# The virtual board: what stands in comments is kept.",
            section("[watchdog]", timeout=timeout_s, device="/dev/watchdog", device_timeout=DEVICE_TIMEOUT_S),
            section("[hmi.serial]", line="/dev/ttyS2"),
            section("[[master]]", name="field", line="/dev/ttyS0", baudrate=BAUD, parity="none"),
            request("meter", METER_UNIT, 3, 0, 4, 0),
            section("[[master]]", name="plant", line="/dev/ttyS3", baudrate=BAUD, parity="none"),
            request("boiler", BOILER_UNIT, 3, 107, 2, 100),
            section("[[slave]]", name="plc", line="/dev/ttyS1", unit=unit, baudrate=BAUD, parity="none"),
            beside,
        )
    )


@dataclass(frozen=True)
class Delivery:
    """How rtugate gets onto a board.

    packages:      of Debian, in what the board boots from.
    fill:          puts what is to be installed into a folder, which the board finds at /mnt.
    script:        installs it from there, by the board's shell, as root; the service is enabled afterwards, and not
                   started.
    configuration: the board's file, for the unit that its slave answers to.
    """

    packages: Sequence[str]
    fill: Callable[[Path], None]
    script: str
    configuration: Callable[[int], str] = configuration


def _bring_sources(folder: Path) -> None:
    for name in ("install.sh", "rtugate.sh", "rtugate.service", "rtugate.rules"):
        shutil.copy(HERE / name, folder)
    shutil.copytree(ROOT / "gateway", folder / "gateway", ignore=shutil.ignore_patterns("__pycache__"))


SOURCES: Final = Delivery(
    packages=("python3", "python3-serial", "python3-pydantic", "python3-tomli-w"),
    fill=_bring_sources,
    script="cd /mnt && sh install.sh",
)


def _bring_faults(folder: Path) -> None:
    """The gateway with faults to order is for tests alone, so it goes beside what is delivered."""
    (folder / "faults" / "tests").mkdir(parents=True)
    (folder / "faults" / "tests" / "__init__.py").touch()
    target = folder / "faults" / "tests" / "hanging"
    shutil.copytree(ROOT / "tests" / "hanging", target, ignore=shutil.ignore_patterns("__pycache__"))


class TimedDevice(Device):
    """A device that notes when it is read; ``longest_s``: the longest time that passed between two readings."""

    last_s: float | None = None
    longest_s: float = 0.0

    def get(self, table: Table, address: int, count: int = 1) -> list[int]:
        now_s = time.monotonic()
        if self.last_s is not None:
            self.longest_s = max(self.longest_s, now_s - self.last_s)
        self.last_s = now_s
        return super().get(table, address, count)

    def forget(self) -> None:
        """Note anew from now on."""
        self.last_s, self.longest_s = None, 0.0


class Station:
    """The board in its house.

    meter:  polled on ttyS0, its 4 holding registers become 0 to 3; boiler: on ttyS3, its 2 become 100 and 101.
    """

    def __init__(
        self,
        machine: Machine,
        meter: TimedDevice,
        boiler: TimedDevice,
        upper_line: str,
        file: Callable[[int], str] = configuration,
    ) -> None:
        self.machine, self.meter, self.boiler = machine, meter, boiler
        self._upper_line, self._file = upper_line, file
        self._numbers = iter(range(1000, 65000))

    # -------------------------------------------------------------------------------------------- what is to be seen

    def is_polling(self, times: int = SEVERAL) -> Callable[[], bool]:
        """Return what tells whether each device was polled so often from now on."""
        goals = [(device, device.served + times) for device in (self.meter, self.boiler)]
        return lambda: all(device.served >= goal for device, goal in goals)

    def wait_polling(self, limit_s: float = START_LIMIT_S) -> float:
        """Return the seconds until both devices are being polled."""
        begun_s = time.monotonic()
        self.machine.until(self.is_polling(), "both devices are polled", limit_s)
        return time.monotonic() - begun_s

    def ask(self, count: int = 4, unit: int = OUR_UNIT, address: int = 0) -> list[int]:
        """Return what the upper master reads; nothing where it gets no answer."""
        return values_of(self._ask("-r", str(address), "-c", str(count), unit=unit))

    def _ask(self, *words: str, unit: int) -> str:
        line = ["-m", "rtu", "-b", str(BAUD), "-P", "none", "-o", str(ANSWER_S), "-0", "-1", "-t", "4", "-a", str(unit)]
        return peers.mbpoll(*line, *words, self._upper_line, timeout_s=60.0)

    def wait_served(self, unit: int = OUR_UNIT) -> float:
        """Change what both devices hold; return the seconds until the upper master has read it from the board."""
        fresh = [next(self._numbers) for _ in range(6)]
        self.meter.set(Table.HOLDING_REGISTERS, 0, fresh[:4])
        self.boiler.set(Table.HOLDING_REGISTERS, 107, fresh[4:])
        begun_s = time.monotonic()
        self.machine.until(
            lambda: self.ask(4, unit) + self.ask(2, unit, 100) == fresh, "the upper master reads what the devices hold"
        )
        return time.monotonic() - begun_s

    def status(self) -> dict[str, Any]:
        """Return what `rtugate status --json` says."""
        told: dict[str, Any] = json.loads(self.machine.do("rtugate status --json"))
        return told

    def show(self, *names: str) -> dict[str, str]:
        """Return what systemd says of the service."""
        told = self.machine.do(f"systemctl show rtugate.service -p {','.join(names)}")
        return dict(line.split("=", 1) for line in told.splitlines())

    @property
    def pid(self) -> str:
        return self.show("MainPID")["MainPID"]

    def watchdog_state(self) -> str:
        """Return what the kernel says of the hardware watchdog: active, inactive."""
        return self.machine.do("cat /sys/class/watchdog/watchdog0/state")

    def journal(self) -> str:
        """Return what the service has logged since the machine came up."""
        return self.machine.do("journalctl --boot --unit=rtugate.service --output=short-monotonic --no-pager --quiet")

    # -------------------------------------------------------------------------------------------- the console

    @property
    def shown(self) -> str:
        """What has come to the console since the last key."""
        return self.machine.uarts[CONSOLE].came.decode(errors="replace")

    def type(self, keys: str, awaited: str) -> str:
        """Type *keys*; return what is shown, once *awaited* is part of it."""
        wire = self.machine.uarts[CONSOLE]
        wire.came = b""
        wire.send(keys.encode())
        assert self.machine.watch(lambda: awaited in self.shown, SOON_S), (
            f"no {awaited!r} on the console: {self.shown!r}"
        )
        return self.shown

    # -------------------------------------------------------------------------------------------- what is done to it

    def restart(self) -> None:
        """A clean restart, which forgives all that went wrong before; everything works afterwards."""
        self.machine.do("systemctl restart rtugate.service")
        self.wait_works()

    def wait_works(self) -> None:
        """Return once both devices are polled and the watchdog is fed."""
        self.wait_polling()
        self.machine.until(lambda: self.watchdog_state() == "active", "the watchdog is opened")

    def settle(self) -> None:
        """Undo whatever was done to it; return once everything works."""
        if not self.machine.answers():
            self.machine.cut_power()
            self.machine.start()
        self.machine.do(f"rm -rf {DROP_INS} && systemctl daemon-reload")
        self.configure()
        self.restart()

    def configure(self, unit: int = OUR_UNIT) -> None:
        """Write the board's file."""
        self.machine.put(CONFIG, self._file(unit))
        self.machine.do("chown -R rtugate: /etc/rtugate && sync")

    def drop_in(self, text: str) -> None:
        """Change the unit, until ``settle`` or until the machine is restarted."""
        self.machine.put(f"{DROP_INS}/test.conf", text)
        self.machine.do("systemctl daemon-reload")

    def fit_faults(self, restart: str) -> None:
        """The service is now the same gateway with faults to order, and systemd restarts it so: "no", "always".

        Until ``settle``, or until the machine is reset.
        """
        self.machine.do("mkdir -p /run/faults && chown rtugate: /run/faults")
        program = "/usr/bin/python3 -m tests.hanging run"
        paths = "PYTHONPATH=/usr/share/rtugate-faults:/usr/share/rtugate"
        environment = f"Environment={paths} RTUGATE_FAULT={ORDER}\nReadWritePaths=/run/faults"
        self.drop_in(f"[Service]\nExecStart=\nExecStart={program}\n{environment}\nRestart={restart}\n")
        self.restart()

    def commit(self, who: str, kind: str) -> None:
        """Order a fault; whoever it is for commits it before its next step."""
        self.machine.do(f"printf {who}:{kind} >{ORDER}.new && chown rtugate: {ORDER}.new && mv {ORDER}.new {ORDER}")


def values_of(told: str) -> list[int]:
    """Return the values that mbpoll prints: "[0]:  4711", or "[0]:  65535 (-1)"."""
    return [int(value) for value in re.findall(r"^\[\d+\]:\s+(\d+)", told, re.MULTILINE)]


@contextmanager
def station(folder: Path, delivery: Delivery = SOURCES) -> Iterator[Station]:
    """Give a board with rtugate on it, which was just installed and started."""
    assert peers.has_mbpoll(), "mbpoll is missing: apt-get install mbpoll"
    parts = folder / "parts"
    parts.mkdir(parents=True)
    delivery.fill(parts)
    _bring_faults(parts)
    meter, boiler = TimedDevice("meter", METER_UNIT), TimedDevice("boiler", BOILER_UNIT)
    meter.set(Table.HOLDING_REGISTERS, 0, [0] * 4)
    boiler.set(Table.HOLDING_REGISTERS, 107, [0] * 2)
    with contextlib.ExitStack() as stack:
        simulator = stack.enter_context(Simulator())
        ports = [simulator.add_serial([device], baudrate=BAUD) for device in (meter, boiler)]
        near, far = stack.enter_context(cable())
        wires = (ports[0], near, "", ports[1])
        board = stack.enter_context(a_machine(folder / "board", base(delivery.packages), parts, wires))
        board.do(f"mount -o ro /dev/vdb /mnt\n{delivery.script}", INSTALL_LIMIT_S)
        board.do("cp -r /mnt/faults /usr/share/rtugate-faults")
        made = Station(board, meter, boiler, far, delivery.configuration)
        made.configure()
        board.do("systemctl start rtugate.service")
        yield made
