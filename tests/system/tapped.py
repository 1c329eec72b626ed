"""Taps between clients and servers, on TCP and on a pair of ptys: all that passes is kept, one packet a frame.

Threads: a tap has one of its own; its packets are read when what passes has been answered.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from gateway.config import SlaveConfig
from gateway.link import Link, SerialSettings, Waker, open_serial
from gateway.link_tcp import listen_tcp
from gateway.register import DataRegister
from gateway.serving import STATION_ALONE, Station
from gateway.slave import SerialSlave
from gateway.slave_tcp import TcpSlave
from tests.lines import CLOCK, PATIENCE_S, STOP_LIMIT_S, UNIT, Running, pty_pair, running

BAUD = 115200
Kind = Literal["tcp", "rtu over tcp", "rtu"]


@dataclass
class Packet:
    """One frame, from the client or to it."""

    is_request: bool
    data: bytes


@dataclass
class Tap:
    """What has passed. All that goes one way before something comes back is one frame, unless it was ``cut``."""

    packets: list[Packet] = field(default_factory=list)
    is_cut: bool = True

    def cut(self) -> None:
        """What comes next is a frame of its own, for nobody answers the one before."""
        self.is_cut = True

    def keep(self, is_request: bool, data: bytes) -> None:
        if self.is_cut or self.packets[-1].is_request != is_request:
            self.packets.append(Packet(is_request, data))
        else:
            self.packets[-1].data += data
        self.is_cut = False

    def carry(self, client: int, server: int, done: int) -> bool:
        """Carry bytes both ways until one side closes, which is True, or *done* is readable."""
        while True:
            ready, _, _ = select.select([client, server, done], [], [])
            if done in ready:
                return False
            for end in ready:
                try:
                    data = os.read(end, 4096)
                except ConnectionError:
                    return True
                if not data:
                    return True
                self.keep(end == client, data)
                os.write(server if end == client else client, data)


@contextmanager
def _in_thread(work: Callable[[int], object]) -> Iterator[None]:
    """Run *work* with a descriptor that becomes readable when it is to end."""
    done, end = os.pipe()
    thread = threading.Thread(target=work, args=(done,), name="tap")
    thread.start()
    try:
        yield
    finally:
        os.close(end)
        thread.join(STOP_LIMIT_S)
        os.close(done)


@contextmanager
def tapped_tcp(port: int) -> Iterator[tuple[Tap, int]]:
    """Give a port of 127.0.0.1 that leads to *port*, one connection after the other."""
    tap = Tap()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def work(done: int) -> None:
            while done not in select.select([listener.fileno(), done], [], [])[0]:
                client, _ = listener.accept()
                with client, socket.create_connection(("127.0.0.1", port)) as server:
                    for end in (client, server):
                        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    tap.cut()
                    if not tap.carry(client.fileno(), server.fileno(), done):
                        return

        with _in_thread(work):
            yield tap, listener.getsockname()[1]


@contextmanager
def tapped_cable() -> Iterator[tuple[Tap, str, str]]:
    """Give two ptys with a cable between them: the client's path and the server's."""
    tap = Tap()
    with (
        pty_pair() as client,
        pty_pair() as server,
        _in_thread(lambda done: tap.carry(client.wire, server.wire, done)),
    ):
        yield tap, client.device, server.device


# ------------------------------------------------------------------------------------------------ slaves


@dataclass
class Served:
    """A slave of ours that runs behind a tap. *place*: the device or the port where a client finds it."""

    kind: Kind
    register: DataRegister
    tap: Tap
    run: Running
    place: Any


@contextmanager
def served(kind: Kind, register: DataRegister, station: Station = STATION_ALONE) -> Iterator[Served]:
    """Give a slave on TCP, on RTU over TCP, or on a pty."""
    keys: dict[str, Any] = {"name": "scada", "framing": "tcp" if kind == "tcp" else "rtu", "unit": UNIT}
    with contextlib.ExitStack() as stack:
        waker = stack.enter_context(contextlib.closing(Waker()))
        if kind == "rtu":
            tap, place, device = stack.enter_context(tapped_cable())
            config = SlaveConfig.model_validate(keys | {"line": "/dev/ttyS2", "baudrate": BAUD, "parity": "none"})
            opened = threading.Event()

            def opening() -> Link:
                link = open_serial(SerialSettings(device, BAUD, "none"), waker, CLOCK)
                opened.set()
                return link

            run = stack.enter_context(running(SerialSlave(config, register, CLOCK, waker, opening, station=station)))
            assert opened.wait(PATIENCE_S)
            yield Served(kind, register, tap, run, place)
        else:
            config = SlaveConfig.model_validate(keys | {"line": "tcp://127.0.0.1:502"})
            listener = listen_tcp("127.0.0.1", 0)
            slave = TcpSlave(config, register, CLOCK, waker, lambda: listener, station=station)
            run = stack.enter_context(running(slave))
            tap, port = stack.enter_context(tapped_tcp(listener.getsockname()[1]))
            yield Served(kind, register, tap, run, port)
