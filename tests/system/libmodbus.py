"""libmodbus's own C library as client and as server, by ctypes: what the system tests need of it, and no more.

The client's calls return what came, or raise ``Refused`` with the exception code. The server is what libmodbus's
examples are: ``modbus_receive``, ``modbus_reply``, again; its tables are the library's own memory.

Source: <modbus.h> of libmodbus 3.1. Threads: a client belongs to one thread; a server has a thread of its own, and its
tables are read and written by the test while no request is on its way.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes import POINTER, c_char, c_char_p, c_int, c_uint8, c_uint16, c_uint32, c_void_p
from typing import Any

LIBRARY = "libmodbus.so.5"
ERROR_BASE = 112345678  # MODBUS_ENOBASE: exception n is this and n
EXCEPTIONS = range(1, 12)
FRAME_MAX = 260  # MODBUS_MAX_ADU_LENGTH
STOP_LIMIT_S = 5.0


class Mapping(ctypes.Structure):
    """modbus_mapping_t: four tables and where each starts."""

    _fields_ = [
        ("nb_bits", c_int),
        ("start_bits", c_int),
        ("nb_input_bits", c_int),
        ("start_input_bits", c_int),
        ("nb_input_registers", c_int),
        ("start_input_registers", c_int),
        ("nb_registers", c_int),
        ("start_registers", c_int),
        ("tab_bits", POINTER(c_uint8)),
        ("tab_input_bits", POINTER(c_uint8)),
        ("tab_input_registers", POINTER(c_uint16)),
        ("tab_registers", POINTER(c_uint16)),
    ]


class Refused(Exception):
    """The other side answered with exception *code*."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


class Failed(Exception):
    """libmodbus reports an error that is no exception of the protocol: a timeout, a wrong CRC, a wrong reply."""


CONTEXT = c_void_p
SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "modbus_new_tcp": (CONTEXT, [c_char_p, c_int]),
    "modbus_new_rtu": (CONTEXT, [c_char_p, c_int, c_char, c_int, c_int]),
    "modbus_free": (None, [CONTEXT]),
    "modbus_connect": (c_int, [CONTEXT]),
    "modbus_close": (None, [CONTEXT]),
    "modbus_set_slave": (c_int, [CONTEXT, c_int]),
    "modbus_set_socket": (c_int, [CONTEXT, c_int]),
    "modbus_get_socket": (c_int, [CONTEXT]),
    "modbus_set_response_timeout": (c_int, [CONTEXT, c_uint32, c_uint32]),
    "modbus_strerror": (c_char_p, [c_int]),
    "modbus_read_bits": (c_int, [CONTEXT, c_int, c_int, POINTER(c_uint8)]),
    "modbus_read_input_bits": (c_int, [CONTEXT, c_int, c_int, POINTER(c_uint8)]),
    "modbus_read_registers": (c_int, [CONTEXT, c_int, c_int, POINTER(c_uint16)]),
    "modbus_read_input_registers": (c_int, [CONTEXT, c_int, c_int, POINTER(c_uint16)]),
    "modbus_write_bit": (c_int, [CONTEXT, c_int, c_int]),
    "modbus_write_register": (c_int, [CONTEXT, c_int, c_uint16]),
    "modbus_write_bits": (c_int, [CONTEXT, c_int, c_int, POINTER(c_uint8)]),
    "modbus_write_registers": (c_int, [CONTEXT, c_int, c_int, POINTER(c_uint16)]),
    "modbus_mask_write_register": (c_int, [CONTEXT, c_int, c_uint16, c_uint16]),
    "modbus_write_and_read_registers": (
        c_int,
        [CONTEXT, c_int, c_int, POINTER(c_uint16), c_int, c_int, POINTER(c_uint16)],
    ),
    "modbus_report_slave_id": (c_int, [CONTEXT, c_int, POINTER(c_uint8)]),
    "modbus_send_raw_request": (c_int, [CONTEXT, POINTER(c_uint8), c_int]),
    "modbus_receive_confirmation": (c_int, [CONTEXT, POINTER(c_uint8)]),
    "modbus_tcp_listen": (c_int, [CONTEXT, c_int]),
    "modbus_tcp_accept": (c_int, [CONTEXT, POINTER(c_int)]),
    "modbus_receive": (c_int, [CONTEXT, POINTER(c_uint8)]),
    "modbus_reply": (c_int, [CONTEXT, POINTER(c_uint8), c_int, POINTER(Mapping)]),
    "modbus_mapping_new": (POINTER(Mapping), [c_int, c_int, c_int, c_int]),
    "modbus_mapping_free": (None, [POINTER(Mapping)]),
}


def library() -> ctypes.CDLL:
    """Return libmodbus with its functions declared."""
    try:
        loaded = ctypes.CDLL(LIBRARY, use_errno=True)
    except OSError:
        raise AssertionError(f"{LIBRARY} is missing: apt-get install libmodbus5") from None
    for name, (result, arguments) in SIGNATURES.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    return loaded


def checked(modbus: ctypes.CDLL, result: int) -> int:
    """Return *result*, or raise what it stands for."""
    if result >= 0:
        return result
    error = ctypes.get_errno()
    if error - ERROR_BASE in EXCEPTIONS:
        raise Refused(error - ERROR_BASE)
    raise Failed(modbus.modbus_strerror(error).decode())


class Client:
    """libmodbus's functions, with lists of numbers in and out."""

    def __init__(self, modbus: ctypes.CDLL, context: int) -> None:
        self._modbus, self._context = modbus, context

    def _call(self, name: str, *arguments: Any) -> int:
        return checked(self._modbus, getattr(self._modbus, name)(self._context, *arguments))

    def _read(self, name: str, item: Any, address: int, count: int) -> list[int]:
        found = (item * count)()
        assert self._call(name, address, count, found) == count
        return list(found)

    def read(self, function: int, address: int, count: int) -> list[int]:
        """Functions 1 to 4."""
        names = {1: "read_bits", 2: "read_input_bits", 3: "read_registers", 4: "read_input_registers"}
        item = c_uint8 if function < 3 else c_uint16
        return self._read(f"modbus_{names[function]}", item, address, count)

    def write_coil(self, address: int, on: bool) -> None:
        """Function 5."""
        assert self._call("modbus_write_bit", address, int(on)) == 1

    def write_register(self, address: int, value: int) -> None:
        """Function 6."""
        assert self._call("modbus_write_register", address, value) == 1

    def write_coils(self, address: int, bits: list[int]) -> None:
        """Function 15."""
        assert self._call("modbus_write_bits", address, len(bits), (c_uint8 * len(bits))(*bits)) == len(bits)

    def write_registers(self, address: int, words: list[int]) -> None:
        """Function 16."""
        assert self._call("modbus_write_registers", address, len(words), (c_uint16 * len(words))(*words)) == len(words)

    def mask_write(self, address: int, and_mask: int, or_mask: int) -> None:
        """Function 22."""
        self._call("modbus_mask_write_register", address, and_mask, or_mask)

    def write_and_read(self, write_address: int, words: list[int], address: int, count: int) -> list[int]:
        """Function 23."""
        found = (c_uint16 * count)()
        written = (c_uint16 * len(words))(*words)
        name = "modbus_write_and_read_registers"
        assert self._call(name, write_address, len(words), written, address, count, found) == count
        return list(found)

    def report_slave_id(self) -> bytes:
        """Function 17: all after the byte count."""
        found = (c_uint8 * FRAME_MAX)()
        return bytes(found[: self._call("modbus_report_slave_id", FRAME_MAX, found)])

    def send_raw(self, unit: int, pdu: bytes) -> None:
        """Send a PDU that libmodbus would not make, framed by libmodbus."""
        self._call("modbus_send_raw_request", (c_uint8 * (1 + len(pdu)))(unit, *pdu), 1 + len(pdu))

    def receive_raw(self) -> bytes:
        """Return the whole next frame, whose checksum or header libmodbus has found right."""
        found = (c_uint8 * FRAME_MAX)()
        return bytes(found[: self._call("modbus_receive_confirmation", found)])

    def set_unit(self, unit: int) -> None:
        self._call("modbus_set_slave", unit)


@contextmanager
def _client(modbus: ctypes.CDLL, context: int, unit: int) -> Iterator[Client]:
    try:
        checked(modbus, modbus.modbus_set_slave(context, unit))
        checked(modbus, modbus.modbus_set_response_timeout(context, 2, 0))
        checked(modbus, modbus.modbus_connect(context))
        yield Client(modbus, context)
    finally:
        modbus.modbus_close(context)
        modbus.modbus_free(context)


@contextmanager
def client_tcp(port: int, unit: int) -> Iterator[Client]:
    """Give a client connected to *port* on 127.0.0.1."""
    modbus = library()
    with _client(modbus, modbus.modbus_new_tcp(b"127.0.0.1", port), unit) as client:
        yield client


@contextmanager
def client_rtu(path: str, unit: int, baudrate: int) -> Iterator[Client]:
    """Give a client on a serial device, 8N1."""
    modbus = library()
    with _client(modbus, modbus.modbus_new_rtu(path.encode(), baudrate, b"N", 8, 1), unit) as client:
        yield client


# ------------------------------------------------------------------------------------------------ server


class Server:
    """libmodbus as a device. *size* points in each table, all 0."""

    def __init__(self, modbus: ctypes.CDLL, context: int, size: int) -> None:
        self._modbus, self._context = modbus, context
        self.mapping = modbus.modbus_mapping_new(size, size, size, size)
        self.requests = 0
        self.errors: list[str] = []
        self._stopped, self._stop = os.pipe()
        self._thread: threading.Thread | None = None

    def table(self, function: int) -> Any:
        """The library's memory of the table that *function* reads, to index and to slice."""
        mapping = self.mapping.contents
        return {
            1: mapping.tab_bits,
            2: mapping.tab_input_bits,
            3: mapping.tab_registers,
            4: mapping.tab_input_registers,
        }[function]

    def fill(self, function: int, values: list[int]) -> None:
        """Set the table that *function* reads, from its start."""
        for place, value in enumerate(values):
            self.table(function)[place] = value

    def start(self, serve: Callable[[], None]) -> None:
        self._thread = threading.Thread(target=serve, name="libmodbus server")
        self._thread.start()

    def wait_for(self, descriptor: int) -> bool:
        """Wait until *descriptor* is readable; False when the server is to stop."""
        ready, _, _ = select.select([descriptor, self._stopped], [], [])
        return self._stopped not in ready

    def answer(self, descriptor: int) -> None:
        """Answer what comes on *descriptor* until it is closed or the server is to stop."""
        request = (c_uint8 * FRAME_MAX)()
        while self.wait_for(descriptor):
            length = self._modbus.modbus_receive(self._context, request)
            if length > 0:
                self.requests += 1
                length = self._modbus.modbus_reply(self._context, request, length, self.mapping)
            if length < 0:
                error = ctypes.get_errno()
                if error in (104, ERROR_BASE + 104):  # ECONNRESET: the client has closed
                    return
                self.errors.append(self._modbus.modbus_strerror(error).decode())

    def close(self) -> None:
        os.write(self._stop, b".")
        if self._thread is not None:
            self._thread.join(STOP_LIMIT_S)
            assert not self._thread.is_alive(), "libmodbus's server does not stop"
        os.close(self._stop)
        os.close(self._stopped)
        self._modbus.modbus_close(self._context)
        self._modbus.modbus_mapping_free(self.mapping)
        self._modbus.modbus_free(self._context)


@contextmanager
def server_tcp(size: int) -> Iterator[tuple[Server, int]]:
    """Give a server that takes one connection after the other, and its port on 127.0.0.1."""
    modbus = library()
    context = modbus.modbus_new_tcp(b"127.0.0.1", 0)
    listening = checked(modbus, modbus.modbus_tcp_listen(context, 4))
    with socket.socket(fileno=listening) as listener, contextlib.closing(Server(modbus, context, size)) as server:
        modbus.modbus_set_socket(context, -1)

        def serve() -> None:
            while server.wait_for(listening):
                accepted = checked(modbus, modbus.modbus_tcp_accept(context, ctypes.byref(c_int(listening))))
                server.answer(accepted)
                modbus.modbus_close(context)

        server.start(serve)
        yield server, listener.getsockname()[1]


@contextmanager
def server_rtu(path: str, unit: int, baudrate: int, size: int) -> Iterator[Server]:
    """Give a server with *unit* on a serial device, 8N1."""
    modbus = library()
    context = modbus.modbus_new_rtu(path.encode(), baudrate, b"N", 8, 1)
    checked(modbus, modbus.modbus_set_slave(context, unit))
    with contextlib.closing(Server(modbus, context, size)) as server:
        checked(modbus, modbus.modbus_connect(context))
        server.start(lambda: server.answer(modbus.modbus_get_socket(context)))
        yield server
