"""From a configuration to a station: the one file that knows every kind of task.

It opens nothing itself: it hands each task what opens its line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gateway import __version__
from gateway.clock import Clock
from gateway.config import Config, LineConfig, MasterConfig, SlaveConfig
from gateway.events import EventQueue
from gateway.link import Link, SerialSettings, Waker, open_serial
from gateway.link_tcp import connect_tcp, listen_tcp
from gateway.master import Master
from gateway.modbus.identification import Identity
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister
from gateway.serving import Station as SlaveStation
from gateway.slave import SerialSlave
from gateway.slave_tcp import TcpSlave
from gateway.supervisor import Plan

CONNECT_LIMIT_S = 5.0  # a TCP device that does not take a connection by then is not there


@dataclass(frozen=True)
class Station:
    """The shared register, and how each task on it is made."""

    register: DataRegister
    plans: list[Plan]


def build(config: Config, clock: Clock) -> Station:
    """Return the station that *config* describes. Nothing runs yet."""
    register = DataRegister(clock, config.register_.sizes)
    wait_limit_s = config.watchdog.timeout / 3
    masters: dict[str, Master] = {}
    plans = [_master(master, register, clock, wait_limit_s, masters) for master in config.master]
    beside = SlaveStation(
        Identity(config.identity.vendor, config.identity.product, config.identity.revision or __version__),
        lambda: _exception_status([master.name for master in config.master], masters),
        _event_queue(config, register, clock).read_fifo,
    )
    plans += [_slave(slave, register, clock, wait_limit_s, beside) for slave in config.slave]
    return Station(register, plans)


def _exception_status(names: list[str], masters: Mapping[str, Master]) -> int:
    """Return the eight outputs of function 7: bit n is 1 while something is wrong on the n-th ``[[master]]``."""
    return sum(1 << n for n, name in enumerate(names[:8]) if name in masters and masters[name].has_alarm)


def _event_queue(config: Config, register: DataRegister, clock: Clock) -> EventQueue:
    requests = [request for master in config.master for request in master.request if request.events and request.enabled]
    spans = [Span(request.target, request.point, request.count) for request in requests]
    fifo, block = config.events.fifo_point, config.events.block_point
    return EventQueue(
        register,
        clock,
        spans,
        config.events.size,
        fifo if fifo >= 0 else None,
        Span(Table.HOLDING_REGISTERS, block, config.event_block_registers) if block >= 0 else None,
    )


def _master(
    config: MasterConfig, register: DataRegister, clock: Clock, wait_limit_s: float, masters: dict[str, Master]
) -> Plan:
    def make(waker: Waker) -> Master:
        masters[config.name] = Master(config, register, clock, waker, _opener(config, waker, clock), wait_limit_s)
        return masters[config.name]

    return Plan(config.name, make)


def _slave(
    config: SlaveConfig, register: DataRegister, clock: Clock, wait_limit_s: float, beside: SlaveStation
) -> Plan:
    def make(waker: Waker) -> SerialSlave | TcpSlave:
        if config.is_tcp:
            host, port = config.address
            return TcpSlave(config, register, clock, waker, lambda: listen_tcp(host, port, waker), wait_limit_s, beside)
        return SerialSlave(config, register, clock, waker, _opener(config, waker, clock), wait_limit_s, beside)

    return Plan(config.name, make)


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
