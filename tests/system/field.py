"""The devices of a busy station, in a process of their own: `python -m tests.system.field KIND...`.

KIND is a line with DEVICES devices, units 1 to DEVICES: "rtu" or "ascii" on a pty, "tcp" on a port. The process prints
where the lines are, as a JSON list of what a configuration calls ``line``, and ends when its input does.

Of each device the holding registers below VALUES count the tenths of a second since the start, all at once, so that a
torn or an old block shows. SETPOINT is there to be written.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from gateway.modbus.pdu import Table
from gateway.simulator import Device, Simulator
from tests.hmi.real_station import REPOSITORY

DEVICES = 10
VALUES = 128
SETPOINT = 900
HOLDING = Table.HOLDING_REGISTERS


def moves(device: Device, seconds: float) -> None:
    device.set(HOLDING, 0, [int(seconds * 10) & 0xFFFF] * VALUES)


def a_device(unit: int) -> Device:
    device = Device(f"device {unit}", unit, moves=moves)
    device.set(HOLDING, SETPOINT, [0])
    return device


def add_line(simulator: Simulator, kind: str) -> str:
    devices = [a_device(unit) for unit in range(1, DEVICES + 1)]
    if kind == "tcp":
        return f"tcp://127.0.0.1:{simulator.add_tcp(devices)}"
    return simulator.add_serial(devices, kind)


@contextmanager
def field(kinds: list[str]) -> Iterator[list[str]]:
    """Run the process; give where its lines are."""
    command = [sys.executable, "-m", "tests.system.field", *kinds]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=REPOSITORY) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())
        finally:
            process.stdin.close()
    assert process.returncode == 0


def main() -> None:
    with Simulator() as simulator:
        print(json.dumps([add_line(simulator, kind) for kind in sys.argv[1:]]), flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
