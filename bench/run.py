"""`make bench`: how fast the drivers are, each as a ratio against a peer in the same run.

Peers: libmodbus (the C library that `mbpoll` brings along, called through ctypes) where it is installed, pymodbus
always. Nothing here passes or fails: it measures, three rounds of each, alternating, and prints the medians.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import pty
import select
import statistics
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable
from functools import partial

from bench.servers import free_port, start_server
from gateway.clock import SystemClock, sharpen_timers
from gateway.config import MasterConfig
from gateway.link import SerialSettings, Waker, open_serial, silence_s
from gateway.master import Master
from gateway.modbus.framing import Frame, encode_rtu
from gateway.register import DataRegister

ROUND_S = 2.0
ROUNDS = 3
COUNT = 10  # registers of each read


def main() -> None:
    """Run every measurement."""
    libmodbus = ctypes.util.find_library("modbus")
    print("libmodbus: " + (libmodbus or "not installed, its comparisons are left out") + "\n")
    bench_tcp(libmodbus)
    for baud in (9600, 19200, 115200):
        bench_master(libmodbus, baud)
    bench_schedule()


def medians(measures: dict[str, Callable[[], float]]) -> dict[str, float]:
    """Return the median of each measure, taken in turns."""
    taken: dict[str, list[float]] = {name: [] for name in measures}
    for _ in range(ROUNDS):
        for name, measure in measures.items():
            taken[name].append(measure())
    return {name: statistics.median(values) for name, values in taken.items()}


def show(title: str, unit: str, found: dict[str, float]) -> None:
    """Print one comparison; the first is ours."""
    ours = next(iter(found.values()))
    print(title)
    for name, value in found.items():
        ratio = f"   rtugate is {ours / value:.2f} x" if value and value != ours else ""
        print(f"  {name:28}{value:10.1f} {unit}{ratio}")
    print()


# ------------------------------------------------------------------------------------------------ slave, TCP


def bench_tcp(libmodbus: str | None) -> None:
    """Requests a second that a TCP slave answers: 1 client, one request at a time; and 4 clients."""
    kinds = ["rtugate", "pymodbus"] + (["libmodbus"] if libmodbus else [])
    ports = {kind: free_port() for kind in kinds}
    servers = [start_server(kind, port) for kind, port in ports.items()]
    try:
        for clients in (1, 4):
            found = medians({kind: partial(tcp_rate, port, clients) for kind, port in ports.items()})
            show(f"slave on TCP, {clients} client(s), read {COUNT} holding registers", "requests/s", found)
    finally:
        for server in servers:
            server.kill()
            server.wait()


def tcp_rate(port: int, clients: int) -> float:
    """Return how many requests a second *clients* other processes get answered together."""
    command = [sys.executable, "-m", "bench.client", str(port), str(ROUND_S), str(COUNT)]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(clients)]
    return sum(float(process.communicate()[0]) for process in running)


# ------------------------------------------------------------------------------------------------ master, serial


def bench_master(libmodbus: str | None, baud: int) -> None:
    """Polls a second on a line that takes its time, against a C program that keeps the same silences."""
    line = PacedDevice(baud)
    try:
        measures: dict[str, Callable[[], float]] = {"rtugate": lambda: master_rate(line, baud)}
        if libmodbus:
            library = ctypes.CDLL(libmodbus)
            measures["libmodbus"] = lambda: libmodbus_rate(library, line, baud)
        found = medians(measures)
    finally:
        line.close()
    found["the line's limit"] = 1 / (line.frames_s + 2 * silence_s(baud, 10 / baud))
    show(f"master at {baud} baud, read {COUNT} holding registers", "polls/s", found)


class PacedDevice:
    """A device on a pty that answers after the time both frames take on the wire, in a process of its own."""

    def __init__(self, baud: int) -> None:
        master, slave = pty.openpty()
        tty.setraw(master)
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self.frames_s = (8 + 5 + 2 * COUNT) * 10 / baud
        reply = encode_rtu(Frame(1, bytes([3, 2 * COUNT]) + bytes(2 * COUNT)))
        self._child = os.fork()
        if self._child == 0:
            sharpen_timers()
            while True:
                os.read(master, 256)
                time.sleep(self.frames_s + silence_s(baud, 10 / baud))
                os.write(master, reply)
        self._ends = (master, slave)

    def settle(self) -> None:
        """Let the answer to whoever asked last come, and throw it away."""
        time.sleep(5 * self.frames_s)
        termios.tcflush(self._ends[1], termios.TCIFLUSH)

    def close(self) -> None:
        """End the process."""
        os.kill(self._child, 9)
        os.waitpid(self._child, 0)
        for end in self._ends:
            os.close(end)


def master_rate(line: PacedDevice, baud: int) -> float:
    """Return our master's polls a second with more due than the line can carry."""
    line.settle()
    clock, waker, stop = SystemClock(), Waker(), threading.Event()
    request = {"unit": 1, "function": 3, "address": 0, "count": COUNT, "every": 0.01}
    requests = [{**request, "name": f"r{i}", "point": i * COUNT} for i in range(50)]
    config = MasterConfig.model_validate(
        {"name": "bench", "line": line.path, "parity": "none", "baudrate": baud, "request": requests}
    )
    settings = SerialSettings(line.path, baud, "none")
    master = Master(config, DataRegister(clock), clock, waker, lambda: open_serial(settings, waker, clock))

    def work() -> None:
        sharpen_timers()
        master.run(stop, lambda: None)

    thread = threading.Thread(target=work)
    thread.start()
    master.ready.wait()
    began, began_s = master.counters.good, time.monotonic()
    select.select([], [], [], ROUND_S)
    rate = (master.counters.good - began) / (time.monotonic() - began_s)
    stop.set()
    master.wake()
    thread.join()
    waker.close()
    return rate


def libmodbus_rate(library: ctypes.CDLL, line: PacedDevice, baud: int) -> float:
    """Return libmodbus's polls a second, with the silence that the standard asks for before each."""
    line.settle()
    sharpen_timers()
    library.modbus_new_rtu.restype = ctypes.c_void_p
    library.modbus_new_rtu.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_char, ctypes.c_int, ctypes.c_int]
    context = ctypes.c_void_p(library.modbus_new_rtu(line.path.encode(), baud, b"N", 8, 1))
    library.modbus_set_slave(context, 1)
    assert library.modbus_connect(context) == 0
    values = (ctypes.c_uint16 * COUNT)()
    gap_s, good, began_s = silence_s(baud, 10 / baud), 0, time.monotonic()
    while time.monotonic() < began_s + ROUND_S:
        good += library.modbus_read_registers(context, 0, COUNT, values) == COUNT
        time.sleep(gap_s)
    rate = good / (time.monotonic() - began_s)
    library.modbus_close(context)
    library.modbus_free(context)
    return rate


# ------------------------------------------------------------------------------------------------ cost of a choice


def bench_schedule() -> None:
    """What a poll costs the processor with 10 requests and with 1000."""
    from gateway.schedule import Schedule

    def choices(requests: int) -> float:
        schedule, now_s, began_s = Schedule([1.0] * requests), 0.0, time.process_time()
        for _ in range(20000):
            index = schedule.pick(now_s)
            if index is None:
                now_s = schedule.next_due_s() or now_s
            else:
                schedule.sent(index, now_s)
        return 20000 / (time.process_time() - began_s)

    show("whose turn is it", "choices/s", medians({"10 requests": lambda: choices(10), "1000": lambda: choices(1000)}))


if __name__ == "__main__":
    main()
