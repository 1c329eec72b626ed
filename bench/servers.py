"""Modbus TCP servers to compare, each in a process of its own: ours, pymodbus's, libmodbus's."""

from __future__ import annotations

import ctypes
import ctypes.util
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable

REGISTERS = 200


def free_port() -> int:
    """Return a port nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def start_server(kind: str, port: int) -> subprocess.Popen[bytes]:
    """Start the server and return once it takes connections."""
    process = subprocess.Popen([sys.executable, "-m", "bench.servers", kind, str(port)])
    while process.poll() is None:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
        except OSError:
            time.sleep(0.02)
        else:
            return process
    raise RuntimeError(f"{kind} did not start")


def serve_rtugate(port: int) -> None:
    """Run our slave with nothing else."""
    from gateway.clock import SystemClock
    from gateway.config import SlaveConfig
    from gateway.link import Waker
    from gateway.link_tcp import listen_tcp
    from gateway.register import DataRegister
    from gateway.slave_tcp import TcpSlave

    clock = SystemClock()
    config = SlaveConfig(name="bench", line=f"tcp://127.0.0.1:{port}", unit=1)
    slave = TcpSlave(config, DataRegister(clock), clock, Waker(), lambda: listen_tcp("127.0.0.1", port))
    slave.run(threading.Event(), lambda: None)


def serve_pymodbus(port: int) -> None:
    """Run pymodbus's server, as the simulator does."""
    from gateway.modbus.pdu import Table
    from gateway.simulator import Device, Simulator

    device = Device("bench", 1)
    device.set(Table.HOLDING_REGISTERS, 0, [0] * REGISTERS)
    with Simulator() as simulator:
        simulator.add_tcp([device], port)
        threading.Event().wait()


def serve_libmodbus(port: int) -> None:
    """Run libmodbus's server: one select loop over its clients, all protocol work in C."""
    import select

    library = ctypes.CDLL(ctypes.util.find_library("modbus"))
    for function in (library.modbus_new_tcp, library.modbus_mapping_new):
        function.restype = ctypes.c_void_p
    context = ctypes.c_void_p(library.modbus_new_tcp(b"127.0.0.1", port))
    mapping = ctypes.c_void_p(library.modbus_mapping_new(REGISTERS, REGISTERS, REGISTERS, REGISTERS))
    listening = library.modbus_tcp_listen(context, 8)
    query, connections = (ctypes.c_uint8 * 260)(), [listening]
    while True:
        for ready in select.select(connections, [], [])[0]:
            if ready == listening:
                connections.append(library.modbus_tcp_accept(context, ctypes.byref(ctypes.c_int(listening))))
                continue
            library.modbus_set_socket(context, ready)
            size = library.modbus_receive(context, query)
            if size < 0:
                library.modbus_close(context)
                connections.remove(ready)
            else:
                library.modbus_reply(context, query, size, mapping)


SERVERS: dict[str, Callable[[int], None]] = {
    "rtugate": serve_rtugate,
    "pymodbus": serve_pymodbus,
    "libmodbus": serve_libmodbus,
}

if __name__ == "__main__":
    SERVERS[sys.argv[1]](int(sys.argv[2]))
