"""From a configuration to a station: the one file that knows every kind of task.

It opens nothing itself: it hands each task what opens its line.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from socket import socket
from typing import TypedDict

from gateway import __version__
from gateway.clock import Clock
from gateway.config import Config, LineConfig, MasterConfig, SlaveConfig
from gateway.events import EventQueue
from gateway.hmi.console import SerialConsole
from gateway.hmi.control import Commands, ControlDoor
from gateway.hmi.session import Shared
from gateway.hmi.terminals import TelnetDoor, Terminals
from gateway.link import Link, SerialSettings, Waker, open_serial
from gateway.link_tcp import connect_tcp, listen_tcp
from gateway.master import Master
from gateway.modbus.identification import Identity
from gateway.modbus.pdu import Span, Table
from gateway.opening import in_thread
from gateway.polls import STATUS_COUNT
from gateway.register import DataRegister
from gateway.retained import TASK_NAME, Points, RetainedFile, Retainer
from gateway.serving import Station as SlaveStation
from gateway.slave import SerialSlave
from gateway.slave_tcp import TcpSlave
from gateway.supervisor import Plan, Task

CONTROL, SERIAL_CONSOLE, TELNET = "control socket", "serial console", "telnet server"  # no line can be called that
CONNECT_LIMIT_S = 5.0  # a TCP device that does not take a connection by then is not there
LEAST_WAIT_S = 0.3  # less than a third of the shortest watchdog.timeout (1 s): for a task that no configuration changes


class Station:
    """The shared register, and how each task on it is made; a new configuration changes both."""

    def __init__(self, config: Config, clock: Clock, retained: RetainedFile | None = None) -> None:
        """*retained*: where values survive a restart; None: nowhere."""
        self.config = config
        self.clock = clock
        self.register = DataRegister(clock, config.register_.sizes)
        self.events = EventQueue(self.register, clock, **_event_settings(config))
        self.masters: dict[str, Master] = {}  # those made last, by name
        self._late_s: dict[str, float] = {}  # until when a late reply may come on a port, monotonic
        self._retained = retained
        self._retainer: Retainer | None = None
        if retained is not None and config.register_.retain:  # the event queue knows by now, and so takes no harm
            retained.restore(self.register, clock, config.register_.retained)

    @property
    def plans(self) -> list[Plan]:
        """How the tasks of the lines are made, by the present configuration."""
        return self.plans_for(self.config)

    def plans_for(self, config: Config) -> list[Plan]:
        """Return how the tasks of the lines are made once *config* is adopted."""
        masters = [self._master(config, master) for master in config.master]
        return self._retaining(config) + masters + [self._slave(config, slave) for slave in config.slave]

    def adopt(self, config: Config) -> None:
        """Make *config* the present one; between stopping the tasks that it changes and starting others."""
        if config.register_.sizes != self.config.register_.sizes:
            self.register.resize(config.register_.sizes)
        settings = _event_settings(config)
        if settings != _event_settings(self.config):
            self.events.change(**settings)
        if self._retained is not None and self.config.register_.retain and not config.register_.retain:
            self._retained.forget()
            self._retainer = None
        self.config = config
        self.masters = {line.name: self.masters[line.name] for line in config.master if line.name in self.masters}

    def save_last(self) -> None:
        """Save what tasks wrote while the others were stopped already; after all of them have ended."""
        if self._retainer is not None:
            self._retainer.save_last()

    def _retaining(self, config: Config) -> list[Plan]:
        """Return how the task is made that has values survive a restart; none where none are to."""
        file, points, wait_limit_s = self._retained, _retained_points(config), config.watchdog.timeout / 3
        if file is None or not points:
            return []

        def make(waker: Waker) -> Retainer:
            self._retainer = Retainer(file, self.register, points, self.clock, waker, wait_limit_s)
            return self._retainer

        return [Plan(TASK_NAME, make, (points, wait_limit_s))]

    def _master(self, config: Config, line: MasterConfig) -> Plan:
        wait_limit_s = config.watchdog.timeout / 3

        def make(waker: Waker) -> Master:
            opener = _opener(line, waker, self.clock)
            self.masters[line.name] = Master(
                line, self.register, self.clock, waker, opener, wait_limit_s, self._late_s, in_thread
            )
            return self.masters[line.name]

        return _plan(config, line, make)

    def _slave(self, config: Config, line: SlaveConfig) -> Plan:
        wait_limit_s = config.watchdog.timeout / 3
        identity = config.identity
        beside = SlaveStation(
            Identity(identity.vendor, identity.product, identity.revision or __version__),
            self._exception_status,
            self.events.read_fifo,
        )

        def make(waker: Waker) -> SerialSlave | TcpSlave:
            shared = (wait_limit_s, beside, in_thread)
            if line.is_tcp:
                host, port = line.address
                listen = partial(listen_tcp, host, port, waker)
                return TcpSlave(line, self.register, self.clock, waker, listen, *shared)
            opener = _opener(line, waker, self.clock)
            return SerialSlave(line, self.register, self.clock, waker, opener, *shared)

        return _plan(config, line, make, identity)

    def _exception_status(self) -> int:
        """Return the eight outputs of function 7: bit n is 1 while something is wrong on the n-th ``[[master]]``."""
        masters = [self.masters.get(line.name) for line in self.config.master[:8]]
        return sum(1 << n for n, master in enumerate(masters) if master is not None and master.has_alarm)


def terminal_plans(config: Config, shared: Shared, control: Plan | None) -> list[Plan]:
    """Return how the ways to the menu are made: the control socket, the serial console, telnet."""
    hmi, wait_limit_s = config.hmi, config.watchdog.timeout / 3
    plans = [control] if control is not None else []

    def make_console(waker: Waker) -> SerialConsole:
        settings = SerialSettings(hmi.serial.line, hmi.serial.baudrate, parity="none", mark_errors=True)
        opener = partial(open_serial, settings, waker, shared.clock)
        return SerialConsole(shared, shared.clock, waker, opener, wait_limit_s, in_thread)

    if hmi.serial.line:
        plans.append(Plan(SERIAL_CONSOLE, make_console, (hmi.serial.line, hmi.serial.baudrate, wait_limit_s)))
    if hmi.telnet.address is not None:
        host, port = hmi.telnet.address

        def make_telnet(waker: Waker) -> Terminals:
            listen = partial(listen_tcp, host, port, waker)
            return Terminals(TELNET, shared.clock, waker, listen, TelnetDoor(shared), wait_limit_s, in_thread)

        plans.append(Plan(TELNET, make_telnet, (host, port, wait_limit_s)))
    return plans


def control_plan(shared: Shared, listen: Callable[[], socket], commands: Commands) -> Plan:
    """Return how the control socket's task is made; it never changes."""

    def make(waker: Waker) -> Terminals:
        return Terminals(CONTROL, shared.clock, waker, listen, ControlDoor(shared, commands), LEAST_WAIT_S)

    return Plan(CONTROL, make)


def build(config: Config, clock: Clock, retained: RetainedFile | None = None) -> Station:
    """Return the station that *config* describes. Nothing runs yet."""
    return Station(config, clock, retained)


def _retained_points(config: Config) -> Points:
    """Return the tables to retain, each with what the gateway itself writes there: that tells how things are now."""
    requests = [request for master in config.master for request in master.request]
    own = [Span(Table.INPUT_REGISTERS, r.status_point, STATUS_COUNT) for r in requests if r.status_point >= 0]
    block = _event_settings(config)["block"]
    own += [block] if block is not None else []
    return {
        table: frozenset(p for span in own if span.table is table for p in range(span.start, span.stop))
        for table in config.register_.retained
    }


class _EventSettings(TypedDict):
    spans: list[Span]
    size: int
    fifo_address: int | None
    block: Span | None


def _event_settings(config: Config) -> _EventSettings:
    requests = [request for master in config.master for request in master.request if request.events and request.enabled]
    fifo, block = config.events.fifo_point, config.events.block_point
    return {
        "spans": [Span(request.target, request.point, request.count) for request in requests],
        "size": config.events.size,
        "fifo_address": fifo if fifo >= 0 else None,
        "block": Span(Table.HOLDING_REGISTERS, block, config.event_block_registers) if block >= 0 else None,
    }


def _plan(config: Config, line: LineConfig, make: Callable[[Waker], Task], *also: object) -> Plan:
    """Return the plan of one line; to switch it on or off takes no new task."""
    basis = (line.model_copy(update={"enabled": True}), config.register_.sizes, config.watchdog.timeout, *also)
    return Plan(line.name, make, basis, line.enabled)


def _opener(config: LineConfig, waker: Waker, clock: Clock) -> Callable[[], Link]:
    """Return what opens the line of *config*: a connection, or a serial port with its settings."""
    if config.is_tcp:
        host, port = config.address
        return lambda: connect_tcp(host, port, waker, clock, CONNECT_LIMIT_S)
    settings = SerialSettings(
        device=config.line,
        baudrate=config.baudrate,
        parity=config.parity,
        data_bits=config.data_bits_used,
        stop_bits=config.stop_bits,
        rs485=config.rs485,
        rts_before_s=config.rts_before,
        rts_after_s=config.rts_after,
        discard_echo=config.discard_echo,
    )
    return lambda: open_serial(settings, waker, clock)
