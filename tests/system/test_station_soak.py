"""A station of 3 lines, 200 requests and 4 SCADA clients runs for 5 minutes: no error, nothing grows."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from gateway.modbus.pdu import Table
from gateway.simulator import Device, Simulator
from tests.peers import client_tcp, free_port, unit_kwargs

MINUTES_S = float(os.environ.get("RTUGATE_SOAK_S", "300"))
WARM_UP_S = 80.0  # after a minute the last good configuration is written, once: what that takes stays
DEVICES = 10  # on each line
REQUESTS = 200
COUNT = 8  # registers of each request
CLIENTS = 4
GROWTH_KIB = 512
HOLDING = Table.HOLDING_REGISTERS


@dataclass
class Figures:
    """One look at a process."""

    rss_kib: int
    threads: int
    descriptors: int


def look_at(pid: int) -> Figures:
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    descriptors = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return Figures(int(status["VmRSS"].split()[0]), int(status["Threads"]), descriptors)


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def moves(device: Device, seconds: float) -> None:
    """Every register of the device counts tenths of a second, so that a torn or old block shows."""
    device.set(HOLDING, 0, [int(seconds * 10) & 0xFFFF] * 200)


def configuration(lines: list[str], port: int) -> str:
    text = [f'[[slave]]\nname = "scada"\nline = "tcp://127.0.0.1:{port}"\nunit = 1\n']
    for number, line in enumerate(lines):
        text.append(f'[[master]]\nname = "line{number}"\nresponse_timeout = 1.0\n{line}\n')
        for request in range(REQUESTS // len(lines) + (number < REQUESTS % len(lines))):
            unit, place = 1 + request % DEVICES, request // DEVICES
            point = 600 * number + COUNT * request
            text.append(
                f"[[master.request]]\nunit = {unit}\nfunction = 3\naddress = {COUNT * place}\n"
                f"count = {COUNT}\nevery = 1.0\npoint = {point}\n"
            )
    return "\n".join(text)


@dataclass
class Client:
    """A SCADA that reads blocks as fast as one answer follows the other, 50 a second at most."""

    port: int
    stop: threading.Event
    reads: int = 0
    errors: list[str] = field(default_factory=list)
    seen: set[int] = field(default_factory=set)

    def run(self) -> None:
        with client_tcp(self.port) as client:
            while not self.stop.wait(0.02):
                point = COUNT * (self.reads % (REQUESTS // 3))
                reply = client.read_holding_registers(point, count=COUNT, **unit_kwargs(1))
                self.reads += 1
                if reply.isError():
                    self.errors.append(str(reply))
                elif len(set(reply.registers)) != 1:
                    self.errors.append(f"a torn block: {reply.registers}")
                else:
                    self.seen.add(reply.registers[0])


@contextmanager
def gateway(file: Path, said: Path) -> Iterator[subprocess.Popen[bytes]]:
    with said.open("wb") as out:
        process = subprocess.Popen([sys.executable, "-m", "gateway", "run", "-c", str(file)], stderr=out)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def wait_for_answer(port: int, process: subprocess.Popen[bytes]) -> float:
    """Return how long it took from now until the slave answered."""
    began_s = time.monotonic()
    while process.poll() is None and time.monotonic() < began_s + 20:
        try:
            with client_tcp(port) as client:
                if not client.read_holding_registers(0, count=1, **unit_kwargs(1)).isError():
                    return time.monotonic() - began_s
        except AssertionError:
            time.sleep(0.01)  # nothing tells a client that a port will be listened to
    raise AssertionError("the gateway never answered")


def test_three_lines_200_requests_and_4_clients_run_without_an_error(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    file, said, port = tmp_path / "rtugate.toml", tmp_path / "said", free_port()
    with Simulator() as simulator:

        def devices() -> list[Device]:
            return [Device(f"device {unit}", unit, moves=moves) for unit in range(1, DEVICES + 1)]

        serial = 'parity = "none"\nbaudrate = 230400\ndata_bits = 8'
        lines = [
            f'line = "{simulator.add_serial(devices())}"\n{serial}',
            f'line = "{simulator.add_serial(devices(), "ascii")}"\n{serial}\nframing = "ascii"',
            f'line = "tcp://127.0.0.1:{simulator.add_tcp(devices())}"',
        ]
        file.write_text(configuration(lines, port))
        with gateway(file, said) as process:
            record_property("from start to first answer", f"{wait_for_answer(port, process):.2f} s")
            stop = threading.Event()
            clients = [Client(port, stop) for _ in range(CLIENTS)]
            threads = [threading.Thread(target=client.run) for client in clients]
            for thread in threads:
                thread.start()
            try:
                first, last, used = watch(process)
            finally:
                stop.set()
                for thread in threads:
                    thread.join()
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=2.0) == 0
    reads = sum(client.reads for client in clients)
    record_property("SCADA reads", f"{reads}, errors {sum(len(c.errors) for c in clients)}")
    record_property("memory after warm-up, at the end", f"{first.rss_kib} KiB, {last.rss_kib} KiB")
    record_property("threads, descriptors", f"{last.threads}, {last.descriptors}")
    record_property("processor", f"{100 * used:.1f} % of one core")
    record_property("what it logged beyond info", said.read_text().count("WARNING") + said.read_text().count("ERROR"))
    assert [client.errors for client in clients] == [[]] * CLIENTS
    assert all(len(client.seen) > MINUTES_S / 2 for client in clients)
    assert (last.threads, last.descriptors) == (first.threads, first.descriptors)
    assert last.rss_kib <= first.rss_kib + GROWTH_KIB
    assert "WARNING" not in said.read_text()
    assert "ERROR" not in said.read_text()


def watch(process: subprocess.Popen[bytes]) -> tuple[Figures, Figures, float]:
    """Let the station run; return its figures after warm-up and at the end, and its share of a core."""
    time.sleep(WARM_UP_S)  # there is no event: five minutes are to pass
    first, began_cpu_s = look_at(process.pid), cpu_s(process.pid)
    time.sleep(MINUTES_S)
    assert process.poll() is None
    return first, look_at(process.pid), (cpu_s(process.pid) - began_cpu_s) / MINUTES_S
