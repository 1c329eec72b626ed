"""Independent peers for the tests of the whole project: pymodbus's synchronous clients, and mbpoll (libmodbus).

It hides the one difference that callers of pymodbus 3.8 and 3.16 would meet, the name of the unit's keyword; nothing
else is wrapped. A client tries each request once, so that a test sees what happened to that very request.
"""

from __future__ import annotations

import inspect
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.framer import FramerType

_UNIT_KEYWORD = "device_id" if "device_id" in inspect.signature(ModbusTcpClient.read_coils).parameters else "slave"


def unit_kwargs(unit: int) -> dict[str, Any]:
    """Return the keyword that addresses *unit*: ``client.read_coils(0, count=8, **unit_kwargs(17))``."""
    return {_UNIT_KEYWORD: unit}


@contextmanager
def client_tcp(port: int, timeout_s: float = 2.0) -> Iterator[ModbusTcpClient]:
    """Give a Modbus TCP client connected to *port* on 127.0.0.1."""
    with _connected(ModbusTcpClient("127.0.0.1", port=port, timeout=timeout_s, retries=0)) as client:
        yield client


@contextmanager
def client_rtu_over_tcp(port: int, timeout_s: float = 2.0) -> Iterator[ModbusTcpClient]:
    """Give a client that sends RTU frames over TCP to *port* on 127.0.0.1."""
    client = ModbusTcpClient("127.0.0.1", port=port, framer=FramerType.RTU, timeout=timeout_s, retries=0)
    with _connected(client):
        yield client


@contextmanager
def client_serial(
    path: str, framing: str = "rtu", timeout_s: float = 2.0, baudrate: int = 19200
) -> Iterator[ModbusSerialClient]:
    """Give a client on a serial device; framing "rtu" or "ascii", 8N1."""
    framer = FramerType(framing)
    with _connected(ModbusSerialClient(path, framer=framer, baudrate=baudrate, timeout=timeout_s, retries=0)) as client:
        yield client


def has_mbpoll() -> bool:
    """Tell whether mbpoll is installed."""
    return shutil.which("mbpoll") is not None


def mbpoll(*args: str, timeout_s: float = 10.0) -> str:
    """Run mbpoll; return what it prints, errors included. Its ``-r`` counts from 1 unless ``-0`` is given."""
    done = subprocess.run(["mbpoll", *args], capture_output=True, text=True, timeout=timeout_s, check=False)
    return done.stdout + done.stderr


def free_port() -> int:
    """Return a TCP port of 127.0.0.1 that nobody used a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def _connected(client: Any) -> Iterator[Any]:
    try:
        assert client.connect(), f"no connection: {client}"
        yield client
    finally:
        client.close()
