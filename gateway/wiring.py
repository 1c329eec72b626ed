"""From a configuration to a station: the one file that knows every kind of task.

It opens nothing itself: it hands each task what opens its line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gateway.clock import Clock
from gateway.config import Config, LineConfig, MasterConfig, SlaveConfig
from gateway.link import Link, SerialSettings, Waker, connect_tcp, listen_tcp, open_serial
from gateway.master import Master
from gateway.register import DataRegister
from gateway.slave import SerialSlave, TcpSlave
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
    plans = [_master(master, register, clock, wait_limit_s) for master in config.master]
    plans += [_slave(slave, register, clock, wait_limit_s) for slave in config.slave]
    return Station(register, plans)


def _master(config: MasterConfig, register: DataRegister, clock: Clock, wait_limit_s: float) -> Plan:
    def make(waker: Waker) -> Master:
        return Master(config, register, clock, waker, _opener(config, waker, clock), wait_limit_s)

    return Plan(config.name, make)


def _slave(config: SlaveConfig, register: DataRegister, clock: Clock, wait_limit_s: float) -> Plan:
    def make(waker: Waker) -> SerialSlave | TcpSlave:
        if config.is_tcp:
            host, port = config.address
            return TcpSlave(config, register, clock, waker, lambda: listen_tcp(host, port), wait_limit_s)
        return SerialSlave(config, register, clock, waker, _opener(config, waker, clock), wait_limit_s)

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
