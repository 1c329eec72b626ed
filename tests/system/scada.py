"""SCADA systems that read and write all the time, in a process of their own.

`python -m tests.system.scada PORT READ WRITTEN`: PORT is a slave's. READ: so many holding registers from 0 on are read,
in blocks of BLOCK; what stands in one block is equal and counts up, or it is torn. WRITTEN: so many setpoints behind
them; each is written by a client of its own, which waits until the field gives it back WRITTEN registers further on,
and then writes the next. The process ends when its input does, and prints what it has seen (``Seen``).
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

from pymodbus.exceptions import ModbusException

from tests.hmi.real_station import REPOSITORY, SOON_S
from tests.peers import client_tcp, unit_kwargs

READERS = 4
READS_EACH = 40  # a second
BLOCK = 8
BLOCKS_AT_ONCE = 10
ANSWER_LIMIT_S = 5.0  # a machine shared with others may stand still for a second or two
BACK_LIMIT_S = 10.0  # for a setpoint to come back from the field


@dataclass
class Seen:
    """What clients have seen. late_s: how long each answer took; back_s: how long each setpoint took to come back.

    still_s: the longest that any block has stood still.
    """

    errors: list[str] = field(default_factory=list)
    late_s: list[float] = field(default_factory=list)
    back_s: list[float] = field(default_factory=list)
    still_s: float = 0.0

    def __add__(self, other: Seen) -> Seen:
        return Seen(
            self.errors + other.errors,
            self.late_s + other.late_s,
            self.back_s + other.back_s,
            max(self.still_s, other.still_s),
        )


class Scada:
    """One client with one connection, in a thread of its own."""

    def __init__(self, port: int, stop: threading.Event) -> None:
        self.seen = Seen()
        self._stop = stop
        self._port = port
        self._changed: dict[int, tuple[int, float]] = {}  # of each block: its value, and when it changed

    def run(self, work: Callable[[Any], None]) -> None:
        """Connect, and do *work*; what ends it too early is one of the errors."""
        try:
            with client_tcp(self._port, ANSWER_LIMIT_S) as client:
                work(client)
        except (AssertionError, ModbusException) as error:
            self.seen.errors.append(f"a client has ended: {error}")

    def read_all(self, client: Any, first: int, count: int) -> None:
        """Read *count* registers again and again, *first* first, READS_EACH times a second."""
        at, due_s = first, time.monotonic()
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + 1 / READS_EACH, time.monotonic())
            registers = self._read(client, at, min(BLOCKS_AT_ONCE * BLOCK, count - at))
            for start in range(0, len(registers), BLOCK):
                self._judge(at + start, registers[start : start + BLOCK])
            at = (at + BLOCKS_AT_ONCE * BLOCK) % count

    def write_all(self, client: Any, point: int, back: int) -> None:
        """Write one number after the other to *point*, as soon as the last one has come back at *back*."""
        number = 0
        while not self._stop.is_set():
            number = number % 0xFFFF + 1
            began_s = time.monotonic()
            reply = client.write_register(point, number, **unit_kwargs(1))
            if reply.isError():
                self.seen.errors.append(f"setpoint {number}: {reply}")
            elif self._comes_back(client, back, number, began_s):
                self.seen.back_s.append(time.monotonic() - began_s)

    def _comes_back(self, client: Any, back: int, number: int, began_s: float) -> bool:
        while not self._stop.wait(1 / READS_EACH):
            if self._read(client, back, 1) == [number]:
                return True
            if time.monotonic() > began_s + BACK_LIMIT_S:
                self.seen.errors.append(f"setpoint {number} does not come back at {back}")
                return False
        return False

    def _read(self, client: Any, point: int, count: int) -> list[int]:
        asked_s = time.monotonic()
        reply = client.read_holding_registers(point, count=count, **unit_kwargs(1))
        self.seen.late_s.append(time.monotonic() - asked_s)
        if reply.isError():
            self.seen.errors.append(f"{point}: {reply}")
            return []
        return list(reply.registers)

    def _judge(self, point: int, block: list[int]) -> None:
        now_s = time.monotonic()
        value, changed_s = self._changed.get(point, (-1, now_s))
        self.seen.still_s = max(self.seen.still_s, now_s - changed_s)
        if len(set(block)) != 1:
            self.seen.errors.append(f"a torn block at {point}: {block}")
        elif block[0] != value:
            if (block[0] - value) & 0xFFFF > 0x7FFF and value >= 0:
                self.seen.errors.append(f"an old block at {point}: {block[0]} after {value}")
            self._changed[point] = block[0], now_s


class Crowd:
    """The process, as a test sees it; ``seen`` once it has ended."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process
        self.seen = Seen()

    def end(self) -> None:
        told, _ = self._process.communicate(timeout=SOON_S)
        self.seen = Seen(**json.loads(told))


@contextmanager
def scada(port: int, read: int, written: int) -> Iterator[Crowd]:
    """Let them loose until the block ends."""
    command = [sys.executable, "-m", "tests.system.scada", *map(str, (port, read, written))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=REPOSITORY) as process:
        crowd = Crowd(process)
        try:
            yield crowd
        finally:
            crowd.end()
    assert process.returncode == 0


def main() -> None:
    port, read, written = map(int, sys.argv[1:])
    stop = threading.Event()
    clients = [Scada(port, stop) for _ in range(READERS + written)]
    step = read // READERS // BLOCK * BLOCK
    works = [partial(clients[n].read_all, first=n * step, count=read) for n in range(READERS)]
    for n in range(written):
        works.append(partial(clients[READERS + n].write_all, point=read + n, back=read + written + n))
    threads = [threading.Thread(target=client.run, args=(work,)) for client, work in zip(clients, works, strict=True)]
    for thread in threads:
        thread.start()
    sys.stdin.read()
    stop.set()
    for thread in threads:
        thread.join()
    seen = sum((client.seen for client in clients), Seen())
    print(json.dumps(asdict(seen)))


if __name__ == "__main__":
    main()
