"""A station whose configuration changes while it runs, with real lines; and the configurations, as short texts."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from gateway.clock import SystemClock
from gateway.master import Master
from gateway.modbus.pdu import Span, Table
from gateway.register import Sample
from gateway.slave import SerialSlave
from gateway.slave_tcp import TcpSlave
from gateway.store import load_text
from gateway.supervisor import Supervisor
from gateway.wiring import build
from tests.lines import PATIENCE_S
from tests.stations import RunningStation
from tests.tasks import RunningSupervisor, running

HOLDING = Table.HOLDING_REGISTERS


def section(head: str, **keys: object) -> str:
    """Return a section of the file; numbers, words and truths are the same in JSON and TOML."""
    return "\n".join([head, *(f"{key} = {json.dumps(value)}" for key, value in keys.items()), ""])


def master(name: str, line: str, *requests: str, **keys: object) -> str:
    return section("[[master]]", name=name, line=line, **{"response_timeout": 0.15} | keys) + "".join(requests)


def serial_master(name: str, path: str, *requests: str, **keys: object) -> str:
    """A master on a pty, which can do no parity."""
    return master(name, path, *requests, **{"parity": "none"} | keys)


def read(point: int, unit: int = 17, count: int = 1, **keys: object) -> str:
    """A request that reads *count* holding registers from 107 of *unit* to *point*, 50 times a second."""
    wanted = {"function": 3, "address": 107, "every": 0.02} | keys
    return section("[[master.request]]", unit=unit, count=count, point=point, **wanted)


def write(point: int, unit: int = 17, **keys: object) -> str:
    """A request that writes *point*, when changed, to holding register 107 of *unit*."""
    wanted = {"function": 6, "address": 107, "count": 1, "trigger": "change"} | keys
    return section("[[master.request]]", unit=unit, point=point, **wanted)


def slave(name: str, port: int, **keys: object) -> str:
    return section("[[slave]]", name=name, line=f"tcp://127.0.0.1:{port}", **{"unit": 1} | keys)


def serial_slave(name: str, path: str, **keys: object) -> str:
    return section("[[slave]]", name=name, line=path, parity="none", **{"unit": 1} | keys)


class ChangingStation(RunningStation):
    """A station that runs, and that a test gives another configuration."""

    def __init__(self, text: str) -> None:
        clock = SystemClock()
        self.station = build(load_text(text, "test.toml").config, clock)
        super().__init__(self.station.register, Supervisor(self.station.plans, clock))

    def follow(self, run: RunningSupervisor) -> None:
        self.run = run
        self.wait_until_ready()

    def change(self, *texts: str) -> None:
        """Have another configuration run; return once its tasks do."""
        self.submit(*texts)
        self.run.do(lambda: None)
        self.wait_until_ready()

    def submit(self, *texts: str) -> None:
        """Have another configuration run some time soon."""
        config = load_text("".join(texts), "test.toml").config

        def carry_out() -> None:
            self.supervisor.change(self.station.plans_for(config), partial(self.station.adopt, config))

        self.supervisor.submit(carry_out)

    def wait_until_ready(self) -> None:
        assert all(task.ready.wait(PATIENCE_S) for task in self.supervisor.tasks.values())

    def master(self, name: str) -> Master:
        task = self.supervisor.tasks[name]
        assert isinstance(task, Master)
        return task

    def tcp_slave(self, name: str) -> TcpSlave:
        task = self.supervisor.tasks[name]
        assert isinstance(task, TcpSlave)
        return task

    def serial_slave(self, name: str) -> SerialSlave:
        task = self.supervisor.tasks[name]
        assert isinstance(task, SerialSlave)
        return task

    def sample(self, point: int, table: Table = HOLDING) -> Sample:
        return self.register.samples(Span(table, point, 1))[0]

    def value(self, point: int) -> int:
        return self.sample(point).value

    def wait_for_value(self, point: int, value: int) -> None:
        self.wait_until(lambda: self.value(point) == value)

    def wait_for_polls(self, name: str, count: int = 3) -> None:
        """Wait until *count* more polls of a master have gone well."""
        task = self.master(name)
        goal = task.counters.good + count
        self.wait_until(lambda: task.counters.good >= goal)


@contextmanager
def changing_station(*texts: str) -> Iterator[ChangingStation]:
    station = ChangingStation("".join(texts))
    with running(station.supervisor) as run:
        station.follow(run)
        yield station
    assert run.was_clean


def descriptors() -> dict[int, str]:
    """Return every open descriptor of this program and what it is: a device's path, or "socket:[4711]"."""
    found = {}
    for entry in Path("/proc/self/fd").iterdir():
        try:
            found[int(entry.name)] = str(entry.readlink())
        except FileNotFoundError:  # the one that looked
            continue
    return found


def descriptors_on(path: str) -> set[int]:
    """Return the descriptors that are open on a device."""
    return {number for number, what in descriptors().items() if what == path}
