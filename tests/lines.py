"""Real lines for tests of slaves: a task in its thread, raw TCP clients, ptys, and two ptys bridged into one cable.

Nothing here sleeps. A test learns what a task has done from the task's own turns (``Running.wait_until``) or from the
bytes that come; that nothing was answered shows by the answer to a later request coming first.

Checksums are computed here bit by bit, as the serial line guide words it, not with the gateway's table.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from gateway.clock import SystemClock
from gateway.config import SlaveConfig
from gateway.link import Waker
from gateway.link_tcp import listen_tcp
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister, Source, SourceKind
from gateway.slave_tcp import TcpSlave

PATIENCE_S = 5.0  # for what must happen; a test that needs it has failed
STOP_LIMIT_S = 2.0  # spec section 7: a clean stop takes under 2 s
CLOCK = SystemClock()
MENU = Source(SourceKind.MENU, "menu")
UNIT = 17

# Requests and replies without unit and checksum: the examples of the application protocol V1.1b3 where it has one.
EXAMPLES: dict[str, tuple[str, str]] = {
    "read coils, 6.1": ("01 00 13 00 13", "01 03 CD 6B 05"),
    "read discrete inputs, 6.2": ("02 00 C4 00 16", "02 03 AC DB 35"),
    "read holding registers, 6.3": ("03 00 6B 00 03", "03 06 02 2B 00 00 00 64"),
    "read input registers, 6.4": ("04 00 08 00 01", "04 02 00 0A"),
    "write single coil, 6.5": ("05 00 AC FF 00", "05 00 AC FF 00"),
    "write single register, 6.6": ("06 00 01 00 03", "06 00 01 00 03"),
    "write multiple coils, 6.11": ("0F 00 13 00 0A 02 CD 01", "0F 00 13 00 0A"),
    "write multiple registers, 6.12": ("10 00 01 00 02 04 00 0A 01 02", "10 00 01 00 02"),
    "mask write register, 6.16": ("16 00 04 00 F2 00 25", "16 00 04 00 F2 00 25"),
    "read/write registers, 6.17": (
        "17 00 03 00 06 00 0E 00 03 06 00 FF 00 FF 00 FF",
        "17 0C 00 00 00 12 00 00 00 00 00 00 00 0A",
    ),
    "unknown function": ("41 00 00 00 00", "C1 01"),
    "quantity 0": ("03 00 00 00 00", "83 03"),
    "quantity above 125": ("03 00 00 00 7E", "83 03"),
    "a byte left over": ("03 00 00 00 01 00", "83 03"),
    "a byte missing": ("03 00 00 00", "83 03"),
    "address beyond the table": ("03 07 CF 00 02", "83 02"),
    "range that wraps around": ("03 FF FF 00 02", "83 02"),
    "coil value neither on nor off": ("05 00 00 12 34", "85 03"),
}
READ_PDU, FOUND_PDU = EXAMPLES["read holding registers, 6.3"]
# The same on TCP: transaction 1, protocol 0, 6 bytes, unit 17, read 3 holding registers from 107.
READ = bytes.fromhex("0001 0000 0006 11 03 006B 0003")
FOUND = bytes.fromhex("0001 0000 0009 11 03 06 022B 0000 0064")


def a_register() -> DataRegister:
    """Return a register that holds what ``EXAMPLES`` find."""
    register = DataRegister(CLOCK)
    register.write(Span(Table.COILS, 19, 19), bytes.fromhex("CD 6B 05"), MENU)
    register.write(Span(Table.DISCRETE_INPUTS, 196, 22), bytes.fromhex("AC DB 35"), MENU)
    register.write(Span(Table.HOLDING_REGISTERS, 107, 3), bytes.fromhex("02 2B 00 00 00 64"), MENU)
    register.write(Span(Table.HOLDING_REGISTERS, 4, 1), bytes.fromhex("00 12"), MENU)
    register.write(Span(Table.HOLDING_REGISTERS, 8, 1), bytes.fromhex("00 0A"), MENU)
    register.write(Span(Table.INPUT_REGISTERS, 8, 1), bytes.fromhex("00 0A"), MENU)
    return register


def values(register: DataRegister, table: Table, start: int, count: int = 1) -> list[int]:
    """Return what the register holds, as the menu would show it."""
    return [sample.value for sample in register.samples(Span(table, start, count))]


def holding(register: DataRegister, start: int, count: int = 1) -> list[int]:
    """Return *count* holding registers."""
    return values(register, Table.HOLDING_REGISTERS, start, count)


# ------------------------------------------------------------------------------------------------ frames


def tcp_frame(transaction: int, pdu: str, unit: int = UNIT) -> bytes:
    """Return a Modbus TCP frame; *pdu* in hexadecimal."""
    body = bytes([unit]) + bytes.fromhex(pdu)
    return struct.pack(">HHH", transaction, 0, len(body)) + body


def rtu_frame(pdu: str, unit: int = UNIT) -> bytes:
    """Return unit, PDU and the CRC, computed as the serial line guide V1.02, section 2.5.1.2 does it by hand."""
    body = bytes([unit]) + bytes.fromhex(pdu)
    crc = 0xFFFF
    for byte in body:
        crc ^= byte
        for _ in range(8):
            carry, crc = crc & 1, crc >> 1
            crc ^= 0xA001 * carry
    return body + struct.pack("<H", crc)


def ascii_frame(pdu: str, unit: int = UNIT) -> bytes:
    """Return colon, characters, LRC, CR LF (serial line guide V1.02, section 2.5.2)."""
    body = bytes([unit]) + bytes.fromhex(pdu)
    lrc = (0x100 - sum(body) % 0x100) % 0x100
    return b":%s%02X\r\n" % (body.hex().upper().encode(), lrc)


# ------------------------------------------------------------------------------------------------ tasks


class Runnable(Protocol):
    """What a test needs of a task."""

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None: ...

    def wake(self) -> None: ...


class Running:
    """A task in its thread, seen from the test."""

    def __init__(self, task: Runnable) -> None:
        self.turns = 0
        self._task = task
        self._stop = threading.Event()
        self._turned = threading.Condition()
        self._ended = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="task under test")
        self._thread.start()

    def wait_until(self, condition: Callable[[], object], timeout_s: float = PATIENCE_S) -> None:
        """Return once *condition*, which only the task's own doing can change, is true; asked again at each turn."""
        with self._turned:
            self._turned.wait_for(lambda: self._ended or condition(), timeout_s)
            assert condition(), "the task has ended" if self._ended else f"nothing of the kind in {timeout_s:g} s"

    def come_round(self) -> None:
        """Wake the task; return once it has come round: what it was doing is done, and it looks at all things anew."""
        goal = self.turns + 1
        self._task.wake()
        self.wait_until(lambda: self.turns >= goal)

    def stop(self) -> None:
        """Stop the task as the supervisor does; raise what it raised."""
        self._stop.set()
        self._task.wake()
        self._thread.join(STOP_LIMIT_S)
        assert not self._thread.is_alive(), f"the task does not stop within {STOP_LIMIT_S:g} s"
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            self._task.run(self._stop, self._take_turn)
        except BaseException as error:  # noqa: BLE001 - raised again in the test's own thread
            self._error = error
        with self._turned:
            self._ended = True
            self._turned.notify_all()

    def _take_turn(self) -> None:
        with self._turned:
            self.turns += 1
            self._turned.notify_all()


@contextmanager
def running(task: Runnable) -> Iterator[Running]:
    """Run *task* in a thread; on leaving it has to stop in under 2 s, and what it raised is raised here."""
    run = Running(task)
    try:
        yield run
    finally:
        run.stop()


# ------------------------------------------------------------------------------------------------ TCP


class RawClient:
    """A TCP client that knows nothing of Modbus."""

    def __init__(self, port: int, host: str = "127.0.0.1", source: str = "") -> None:
        """*source*: the address to come from, one of 127.0.0.0/8."""
        origin = (source, 0) if source else None
        self.socket = socket.create_connection((host, port), timeout=PATIENCE_S, source_address=origin)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def receive(self, count: int) -> bytes:
        """Return the next *count* bytes, fewer if the connection ends before."""
        data = b""
        while len(data) < count and (more := self.socket.recv(count - len(data))):
            data += more
        return data

    def ask(self, request: bytes, count: int) -> bytes:
        """Send *request* and return the *count* bytes that answer it."""
        self.send(request)
        return self.receive(count)

    def is_closed(self) -> bool:
        """Wait for the other side to close; False if bytes come instead."""
        try:
            return self.socket.recv(1) == b""
        except ConnectionError:
            return True

    def reset(self) -> None:
        """End the connection with RST."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()

    def close(self) -> None:
        self.socket.close()


@contextmanager
def raw_client(port: int | None, host: str = "127.0.0.1", source: str = "") -> Iterator[RawClient]:
    """Give a client connected to *port*."""
    assert port is not None, "the slave does not listen"
    with contextlib.closing(RawClient(port, host, source)) as client:
        yield client


class ServedTcp:
    """A TCP slave that runs, and the register it serves."""

    def __init__(self, task: TcpSlave, run: Running, register: DataRegister) -> None:
        self.task, self.run, self.register = task, run, register

    @property
    def port(self) -> int:
        """The port, once it is listened on."""
        self.task.wake()
        self.run.wait_until(lambda: self.task.port)
        assert self.task.port is not None
        return self.task.port

    @contextmanager
    def client(self, source: str = "") -> Iterator[RawClient]:
        """Give a client whom the slave has accepted."""
        before = set(self.task.clients.values())
        with raw_client(self.port, source=source) as client:
            self.run.wait_until(lambda: set(self.task.clients.values()) - before)
            yield client


def tcp_config(**changes: Any) -> SlaveConfig:
    """Return a slave's configuration; *changes* by key."""
    return SlaveConfig.model_validate({"name": "scada", "line": "tcp://127.0.0.1:502", "unit": 17} | changes)


def listen() -> socket.socket:
    """Listen on a port that the system chooses."""
    return listen_tcp("127.0.0.1", 0)


@contextmanager
def serving_tcp(
    config: SlaveConfig,
    register: DataRegister | None = None,
    opening: Callable[[], socket.socket] = listen,
    wait_limit_s: float = 0.02,
) -> Iterator[ServedTcp]:
    """Give a TCP slave that runs.

    wait_limit_s: how often it comes round by itself, so that a test soon learns what it has done; much longer where
                  its own deadlines, or a wake, have to end its wait.
    """
    register = register or a_register()
    with contextlib.closing(Waker()) as waker:
        task = TcpSlave(config, register, CLOCK, waker, opening, wait_limit_s)
        with running(task) as run:
            yield ServedTcp(task, run, register)


# ------------------------------------------------------------------------------------------------ ptys


class Pty:
    """A pty: ``device`` is the path that a slave opens, ``wire`` the end where the test plays everybody else."""

    def __init__(self) -> None:
        self.wire, self._near = os.openpty()  # the near end stays open, so that the pty outlives whoever opens it
        tty.setraw(self._near)
        self.device = os.ttyname(self._near)

    def send(self, data: bytes) -> None:
        """Put *data* on the wire in one piece."""
        assert os.write(self.wire, data) == len(data)

    def receive(self, count: int) -> bytes:
        """Return the next *count* bytes that came over the wire, fewer after ``PATIENCE_S`` of silence."""
        data = b""
        while len(data) < count and select.select([self.wire], [], [], PATIENCE_S)[0]:
            data += os.read(self.wire, count - len(data))
        return data

    def is_silent(self) -> bool:
        """Tell whether nothing waits to be received now."""
        return not select.select([self.wire], [], [], 0)[0]

    def unplug(self) -> None:
        """Take both ends away; calling again does nothing."""
        for descriptor in (self.wire, self._near):
            if descriptor >= 0:
                os.close(descriptor)
        self.wire = self._near = -1


@contextmanager
def pty_pair() -> Iterator[Pty]:
    """Give a pty that is gone afterwards."""
    pty = Pty()
    try:
        yield pty
    finally:
        pty.unplug()


@contextmanager
def cable() -> Iterator[tuple[str, str]]:
    """Give the paths of two ptys with a cable between them: what one writes the other reads."""
    with pty_pair() as left, pty_pair() as right:
        done, pull = os.pipe()
        carrier = threading.Thread(target=_carry, args=(left.wire, right.wire, done), name="cable")
        carrier.start()
        try:
            yield left.device, right.device
        finally:
            os.close(pull)
            carrier.join(STOP_LIMIT_S)
            os.close(done)


def _carry(left: int, right: int, done: int) -> None:
    others = {left: right, right: left}
    while True:
        ready, _, _ = select.select([left, right, done], [], [])
        if done in ready:
            return
        for end in ready:
            os.write(others[end], os.read(end, 4096))
