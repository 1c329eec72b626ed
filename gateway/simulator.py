"""Simulated field devices: Modbus servers of pymodbus, on ptys and on TCP, for the demo and for tests.

They are the independent peer of our own protocol code (architecture, "Why pymodbus is not in the drivers"), so nothing
here uses our framing or our server. What a device holds is a `Device`; who carries its bytes is a `Simulator`.

It refuses to listen beyond 127.0.0.1, to keep the speed of a real line (a pty has none), and to be a model of
conformance: odd requests get what pymodbus gives them. A unit that is not there is silent, on TCP too.

Source: spec section 9 (`demo`, `simulate`); pymodbus 3.8.6, 3.11 and 3.16, whose servers differ in how they ask for
data: `_Bus` and `_Unit` have every face.

Threads: one, "simulator", with one asyncio loop: servers, ptys and `moves` live there. `Simulator` is called from
any one other thread, `Device.get`, `set` and `silent` from any number.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import struct
import threading
import tty
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self, TypeVar

from pymodbus.framer import FramerAscii, FramerType
from pymodbus.pdu import ExceptionResponse
from pymodbus.server import ModbusSerialServer, ModbusTcpServer

from gateway.errors import LinkUnavailable, PointsOutOfRange, RequestInvalid
from gateway.modbus.pdu import Table

# A server is built around a context that `_Bus` replaces at once; 3.16 wants a device in it, 3.8 takes nothing.
try:
    from pymodbus.constants import ExcCodes
    from pymodbus.simulator import SimData, SimDevice
except ImportError:
    _ILLEGAL_ADDRESS: int = 2
    _NO_SUCH_POINTS: Any = []
    _PLACEHOLDER: Any = None
else:
    _ILLEGAL_ADDRESS = _NO_SUCH_POINTS = ExcCodes.ILLEGAL_ADDRESS
    _PLACEHOLDER = SimDevice(1, [SimData(0)])

TICK_S = 0.2
WRITES_KEPT = 10_000
_CALL_LIMIT_S = 5.0
_CHUNK_BYTES = 4096
# Its own table, not ours in modbus/pdu.py: a fault there must not be shared by its peer.
_TABLE_OF_FUNCTION = {
    **dict.fromkeys((1, 5, 15), Table.COILS),
    **dict.fromkeys((3, 6, 16, 22, 23), Table.HOLDING_REGISTERS),
    2: Table.DISCRETE_INPUTS,
    4: Table.INPUT_REGISTERS,
}
_FRAMERS = {"rtu": FramerType.RTU, "ascii": FramerType.ASCII, "tcp": FramerType.SOCKET}
_T = TypeVar("_T")


@dataclass(eq=False)
class Device:
    """One simulated device: sparse tables of points, which exist once `set` has named them.

    unit:   1 to 247 (0 to 255 on TCP).
    moves:  called in the simulator's thread when the device is added and then every TICK_S, with the seconds since the
            simulator's start, to move the values. What it raises ends the simulator.
    silent: True: answers nothing and takes no write, as if its wire were cut.
    writes: every write that came through Modbus, in order; the oldest are dropped beyond WRITES_KEPT.
    served: requests that reached it while it was not silent; broadcasts are not counted.
    """

    name: str
    unit: int
    moves: Callable[[Device, float], None] | None = None
    silent: bool = False
    writes: deque[tuple[Table, int, list[int]]] = field(default_factory=lambda: deque(maxlen=WRITES_KEPT), init=False)
    served: int = field(default=0, init=False)
    _tables: dict[Table, dict[int, int]] = field(
        default_factory=lambda: {table: {} for table in Table}, init=False, repr=False
    )
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    def get(self, table: Table, address: int, count: int = 1) -> list[int]:
        """Return *count* values, 0 or 1 for bits, 0 to 65535 for registers; raises PointsOutOfRange."""
        with self._lock:
            self._demand(table, address, count)
            return [self._tables[table][address + i] for i in range(count)]

    def set(self, table: Table, address: int, values: Sequence[int]) -> None:
        """Set values at once; points that did not exist come into being. Raises RequestInvalid."""
        top = 1 if table.is_bits else 0xFFFF
        if not 0 <= address <= 0x10000 - len(values):
            raise PointsOutOfRange(f"{self.name}: address {address} and {len(values)} values")
        if any(not 0 <= value <= top for value in values):
            raise RequestInvalid(f"{self.name}: a value outside 0 to {top} at address {address}")
        with self._lock:
            self._tables[table].update(enumerate(map(int, values), address))

    def has(self, table: Table, address: int, count: int) -> bool:
        """Tell whether one Modbus read may ask for these points."""
        with self._lock:
            return count <= (2000 if table.is_bits else 125) and self._exist(table, address, count)

    def receive(self, table: Table, address: int, values: Sequence[int]) -> None:
        """Store a write that came through Modbus, whole or not at all; raises PointsOutOfRange."""
        numbers = [int(value) for value in values]
        with self._lock:
            self._demand(table, address, len(numbers))
            self._tables[table].update(enumerate(numbers, address))
            self.writes.append((table, address, numbers))

    def _exist(self, table: Table, address: int, count: int) -> bool:
        points = self._tables[table]
        return count > 0 and all(address + i in points for i in range(count))

    def _demand(self, table: Table, address: int, count: int) -> None:
        if not self._exist(table, address, count):
            raise PointsOutOfRange(f"{self.name}: no {count} points at {table.name} {address}")


class _Unit:
    """A device as pymodbus up to 3.11 sees it; in 3.8 it validates first, except before it reads bits."""

    def __init__(self, device: Device) -> None:
        self._device = device

    def validate(self, function: int, address: int, count: int = 1) -> bool:
        return self._device.has(_TABLE_OF_FUNCTION[function], address, count)

    async def async_getValues(self, function: int, address: int, count: int = 1) -> Any:  # noqa: N802 (pymodbus's name)
        """Return the values, or what tells pymodbus that there are no such points."""
        if not self.validate(function, address, count):
            return _NO_SUCH_POINTS
        return self._device.get(_TABLE_OF_FUNCTION[function], address, count)

    async def async_setValues(self, function: int, address: int, values: Sequence[int]) -> Any:  # noqa: N802
        """Store the values and return None, or the exception code."""
        if not self.validate(function, address, len(values)):
            return _ILLEGAL_ADDRESS
        self._device.receive(_TABLE_OF_FUNCTION[function], address, values)
        return None


class _Bus:
    """The devices of one line, as the context of a pymodbus server (3.8 to 3.11 ask a unit), and the line's silence."""

    def __init__(self, devices: Sequence[Device], broadcasts: bool) -> None:
        self._broadcasts = broadcasts
        self._devices = {device.unit: device for device in devices}
        if len(self._devices) < len(devices):
            raise RequestInvalid("two simulated devices with one unit on one line")

    def device_ids(self) -> list[int]:
        """Return the units that a broadcast reaches."""
        return [unit for unit, device in self._devices.items() if not device.silent]

    slaves = device_ids  # its name in 3.8

    def __getitem__(self, unit: int) -> _Unit:
        return _Unit(self._devices[unit])

    async def async_getValues(self, unit: int, function: int, address: int, count: int = 1) -> Any:  # noqa: N802
        return await self[unit].async_getValues(function, address, count)

    async def async_setValues(self, unit: int, function: int, address: int, values: Sequence[int]) -> Any:  # noqa: N802
        return await self[unit].async_setValues(function, address, values)

    def trace(self, sending: bool, pdu: Any) -> Any:
        """See each decoded request before it is served (None: it never came) and each reply before it is sent."""
        if sending:
            return _refusal(pdu) if pdu.function_code in (1, 2) and not pdu.bits else pdu
        device = self._devices.get(pdu.dev_id)
        if device is None:
            return pdu if pdu.dev_id == 0 and self._broadcasts else None
        if device.silent:
            return None
        device.served += 1
        return pdu


def _refusal(reply: Any) -> ExceptionResponse:
    """Return exception 2 in place of *reply*: 3.8 reads bits without asking first whether they exist."""
    refusal = ExceptionResponse(reply.function_code, _ILLEGAL_ADDRESS)
    refusal.dev_id, refusal.transaction_id = reply.dev_id, reply.transaction_id
    return refusal


class _Wire:
    """Two ptys joined end to end, since pymodbus opens one by its path and so does the master.

    The slave descriptors stay open, so that either side may close its end and open it again. What one side does not
    read is kept by the kernel as far as it has room (some kilobytes), then dropped, as a UART does.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._masters: list[int] = []
        self._slaves: list[int] = []
        try:
            for _ in range(2):
                self._open_end()
        except OSError as error:
            self.close()
            raise LinkUnavailable(f"no pty for a simulated line: {error.strerror}") from error
        self.device_end, self.master_end = map(os.ttyname, self._slaves)
        for source, target in (self._masters, reversed(self._masters)):
            loop.add_reader(source, self._carry, source, target)

    def close(self) -> None:
        for master in self._masters:
            self._loop.remove_reader(master)
        for descriptor in (*self._masters, *self._slaves):
            os.close(descriptor)

    def _open_end(self) -> None:
        master, slave = os.openpty()
        self._masters.append(master)
        self._slaves.append(slave)
        tty.setraw(slave)
        os.set_blocking(master, False)

    @staticmethod
    def _carry(source: int, target: int) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(target, os.read(source, _CHUNK_BYTES))


class _Field:
    """What the simulator's thread owns: servers, wires, and the devices that move."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.stop = asyncio.Event()
        self._start_s = self.loop.time()
        self._devices: list[Device] = []
        self._servers: list[Any] = []
        self._wires: list[_Wire] = []

    async def live(self) -> None:
        """Move the devices until `stop` is set, then close everything."""
        try:
            while not self.stop.is_set():
                self._move(self._devices)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self.stop.wait(), TICK_S)
        finally:
            for server in self._servers:
                await _close_server(server)
            for wire in self._wires:
                wire.close()

    async def open_serial(self, devices: Sequence[Device], framer: FramerType, baud: int) -> str:
        bus = _Bus(devices, broadcasts=True)
        wire = _Wire(self.loop)
        self._wires.append(wire)
        server = ModbusSerialServer(
            _PLACEHOLDER,
            framer=framer,
            port=wire.device_end,
            baudrate=baud,
            broadcast_enable=True,
            trace_pdu=bus.trace,
        )
        await self._listen(server, bus, devices, wire.device_end)
        return wire.master_end

    async def open_tcp(self, devices: Sequence[Device], framer: FramerType, port: int) -> int:
        broadcasts = framer is not FramerType.SOCKET
        bus = _Bus(devices, broadcasts)
        address = ("127.0.0.1", port)
        server: Any = ModbusTcpServer(
            _PLACEHOLDER,
            framer=framer,
            address=address,
            broadcast_enable=broadcasts,
            trace_pdu=bus.trace,
        )
        await self._listen(server, bus, devices, "{}:{}".format(*address))
        return int(server.transport.sockets[0].getsockname()[1])

    async def _listen(self, server: Any, bus: _Bus, devices: Sequence[Device], place: str) -> None:
        server.context = bus
        connect = server.callback_new_connection
        server.callback_new_connection = lambda: _hardened(connect())
        new = [device for device in devices if device not in self._devices]
        self._move(new)
        if not await server.listen():
            raise LinkUnavailable(f"a simulated device cannot use {place}")
        self._servers.append(server)
        self._devices += new

    def _move(self, devices: Sequence[Device]) -> None:
        for device in devices:
            if device.moves is not None:
                device.moves(device, self.loop.time() - self._start_s)


def _hardened(handler: Any) -> Any:
    """Let noise pass a connection of 3.8, which keeps all it cannot decode, and raises on some; 3.16 drops both."""
    receive = handler.callback_data
    longest = 516 if isinstance(handler.framer, FramerAscii) else 264  # bytes of a frame, as 3.16 has it

    def callback_data(data: bytes, addr: Any = None) -> int:
        if len(data) > longest:
            return len(data)
        try:
            return int(receive(data, addr))
        except (ValueError, IndexError, struct.error):
            return len(data)

    handler.callback_data = callback_data
    return handler


async def _close_server(server: Any) -> None:
    """Close a server at once; pymodbus alone would wait for clients that do not read."""
    for handler in list(server.active_connections.values()):
        if handler.transport is not None:
            handler.transport.abort()
    await server.shutdown()


class Simulator:
    """Runs simulated devices in a thread of its own: start (or `with`), add lines, stop.

    Lines are added while it runs, in any number and at any time. After `stop` it may be started again, empty.
    """

    def __init__(self) -> None:
        self._field: _Field | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Return when the loop runs; a second start does nothing."""
        if self._thread is not None:
            return
        # pymodbus logs what its clients and servers meet; a terminal with a demo on it must stay clean.
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL + 1)
        running: Future[_Field] = Future()
        self._thread = threading.Thread(target=lambda: asyncio.run(_live(running)), name="simulator", daemon=True)
        self._thread.start()
        self._field = running.result(_CALL_LIMIT_S)

    def stop(self) -> None:
        """Return when thread, ports and ptys are gone, well within 1 s; a second stop does nothing."""
        if self._thread is None or self._field is None:
            return
        with contextlib.suppress(RuntimeError):  # the loop is closed: `moves` has raised
            self._field.loop.call_soon_threadsafe(self._field.stop.set)
        self._thread.join()
        self._thread = self._field = None

    def add_serial(self, devices: Sequence[Device], framing: str = "rtu", baudrate: int = 19200) -> str:
        """Put *devices* on a serial line of their own; return the path that a master opens.

        framing: "rtu" or "ascii".
        raises:  LinkUnavailable (not started, no pty left), RequestInvalid (a unit twice, a framing unknown).
        """
        if framing not in ("rtu", "ascii"):
            raise RequestInvalid(f"framing {framing!r} on a serial line: rtu or ascii")
        running = self._running()
        return self._call(running, running.open_serial(devices, _FRAMERS[framing], baudrate))

    def add_tcp(self, devices: Sequence[Device], port: int = 0, framing: str = "tcp") -> int:
        """Let *devices* listen on 127.0.0.1; return the port, chosen by the system where *port* is 0.

        framing: "tcp"; "rtu" or "ascii" for such frames over TCP.
        raises:  LinkUnavailable (not started, port taken), RequestInvalid (a unit twice, a framing unknown).
        """
        if framing not in _FRAMERS:
            raise RequestInvalid(f"framing {framing!r}: tcp, rtu or ascii")
        running = self._running()
        return self._call(running, running.open_tcp(devices, _FRAMERS[framing], port))

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def _running(self) -> _Field:
        if self._field is None or self._thread is None or not self._thread.is_alive():
            raise LinkUnavailable("the simulator is not running")
        return self._field

    @staticmethod
    def _call(running: _Field, opening: Coroutine[Any, Any, _T]) -> _T:
        return asyncio.run_coroutine_threadsafe(opening, running.loop).result(_CALL_LIMIT_S)


async def _live(running: Future[_Field]) -> None:
    here = _Field()
    running.set_result(here)
    await here.live()


def demo_devices() -> tuple[Device, Device, Device]:
    """Return the devices of `rtugate demo`: a meter, a boiler, a block of inputs and outputs.

    meter, unit 2:   input registers 0 volts (0.1 V), 1 amps (0.01 A), 2 power (W), 3 and 4 energy (Wh, 32 bits, ABCD).
    boiler, unit 17: holding registers 107 boiler, 108 flow, 109 return (0.1 degrees C), 110 setpoint (likewise, to be
                     written); coils 0 burner allowed, 1 pump.
    io, unit 1:      coils 0 to 7; discrete inputs 0 to 7 a running light, 8 to 15 as the coils are; input registers
                     0 a ramp, 1 a sine (both 0 to 1000), 2 half seconds, 3 how many coils are on.
    """
    boiler = Device("boiler", 17, moves=_Boiler())
    boiler.set(Table.HOLDING_REGISTERS, 110, [600])
    boiler.set(Table.COILS, 0, [1, 1])
    io_block = Device("io", 1, moves=_move_io)
    io_block.set(Table.COILS, 0, [0] * 8)
    demo = Device("meter", 2, moves=_move_meter), boiler, io_block
    for device in demo:
        if device.moves is not None:
            device.moves(device, 0.0)
    return demo


def _move_meter(meter: Device, seconds: float) -> None:
    volts = 230 + 4 * math.sin(seconds / 7)
    amps = 50 + 30 * math.sin(seconds / 11)
    energy_wh = 1_234_500 + int(230 * 50 * seconds / 3600)
    registers = [round(volts * 10), round(amps * 100), round(volts * amps)]
    meter.set(Table.INPUT_REGISTERS, 0, [*registers, energy_wh >> 16 & 0xFFFF, energy_wh & 0xFFFF])


def _move_io(block: Device, seconds: float) -> None:
    half_seconds = int(seconds * 2)
    coils = block.get(Table.COILS, 0, 8)
    light = [int(i == half_seconds % 8) for i in range(8)]
    block.set(Table.DISCRETE_INPUTS, 0, [*light, *coils])
    sine = 500 + round(500 * math.sin(seconds / 5))
    ramp = int(seconds * 100) % 1001
    block.set(Table.INPUT_REGISTERS, 0, [ramp, sine, half_seconds & 0xFFFF, sum(coils)])


class _Boiler:
    """Heats by 1 degree C a second to a little above the setpoint, cools by 0.2 to a little below it."""

    def __init__(self) -> None:
        self._water_c = 55.5
        self._heats = True
        self._last_s = 0.0

    def __call__(self, boiler: Device, seconds: float) -> None:
        passed_s, self._last_s = max(0.0, min(1.0, seconds - self._last_s)), seconds
        setpoint_c = boiler.get(Table.HOLDING_REGISTERS, 110)[0] / 10
        burner, pump = boiler.get(Table.COILS, 0, 2)
        if abs(self._water_c - setpoint_c) > 1.0:
            self._heats = self._water_c < setpoint_c
        rate = 1.0 if self._heats and burner else -0.2
        self._water_c = max(20.0, min(110.0, self._water_c + rate * passed_s))
        flow_c = self._water_c - 1.5 if pump else 20.0
        return_c = 20.0 + (flow_c - 20.0) * 0.8
        degrees = (self._water_c, flow_c, return_c)
        boiler.set(Table.HOLDING_REGISTERS, 107, [round(10 * value) for value in degrees])
