"""Starts the installed service as its unit would, talks to it, stops it; prints figures as JSON.

What the unit gives it and can be given without systemd: user, groups, the capability for low ports, no other one, no
memory that is writable and executable, folders, the environment, a socket for sd_notify. Runs as root in the system
that rtugate is installed in, in a network of its own.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

from pymodbus.client import ModbusTcpClient

FILE = Path("/etc/rtugate/rtugate.toml")
STATE, RUNTIME = Path("/var/lib/rtugate"), Path("/run/rtugate")
NOTIFY = "/run/notify"
LIMIT_S = 30.0
PR_SET_MDWE, REFUSE_EXEC_GAIN = 65, 1  # linux/prctl.h; Linux 6.3
USER = ["setpriv", "--reuid=rtugate", "--regid=rtugate", "--init-groups", "--no-new-privs"]
RIGHTS = [
    "--inh-caps=-all,+net_bind_service",
    "--ambient-caps=+net_bind_service",
    "--bounding-set=-all,+net_bind_service",
]


def deny_writable_code() -> bool:
    """From now on, for this process and its children; return whether this kernel can."""
    return bool(ctypes.CDLL(None).prctl(PR_SET_MDWE, REFUSE_EXEC_GAIN, 0, 0, 0) == 0)


def make_folders() -> None:
    for folder in (STATE, RUNTIME):
        folder.mkdir(mode=0o750)
        shutil.chown(folder, "rtugate", "rtugate")


def open_low_ports() -> None:
    text = FILE.read_text().replace('#listen = "127.0.0.1:2323"', 'listen = "127.0.0.1:23"')
    assert 'listen = "127.0.0.1:23"' in text
    FILE.write_text(text + '\n[[slave]]\nname = "low"\nline = "tcp://0.0.0.0:502"\nunit = 1\n')


def wait_ready(listener: socket.socket) -> str:
    """Return all that was told until READY=1."""
    told = ""
    while "READY=1" not in told:
        told += listener.recv(4096).decode() + "\n"
    return told


def exchange() -> list[int]:
    """Write and read by Modbus; return what was read."""
    client: Any = ModbusTcpClient("127.0.0.1", port=502, timeout=5)
    assert client.connect()
    client.write_registers(5, [4711, 4712], slave=1)
    values = client.read_holding_registers(5, count=2, slave=1).registers
    client.close()
    return list(values)


def telnet_says() -> bytes:
    """Return the first that comes from the menu."""
    with socket.create_connection(("127.0.0.1", 23), timeout=LIMIT_S) as telnet:
        said = b""
        while b"rtugate" not in said:
            said += telnet.recv(4096)
        return said


def memory_kib(process: int) -> int:
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))


def main() -> None:
    make_folders()
    open_low_ports()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listener.bind(NOTIFY)
    Path(NOTIFY).chmod(0o666)  # systemd's is so, too
    listener.settimeout(LIMIT_S)
    figures: dict[str, object] = {"writable code denied": deny_writable_code()}
    environment = os.environ | {
        "STATE_DIRECTORY": str(STATE),
        "RUNTIME_DIRECTORY": str(RUNTIME),
        "NOTIFY_SOCKET": NOTIFY,
    }
    begun_s = time.monotonic()
    service = subprocess.Popen([*USER, *RIGHTS, "/usr/bin/rtugate", "run"], env=environment)
    try:
        wait_ready(listener)
        figures["seconds to READY"] = round(time.monotonic() - begun_s, 2)
        assert exchange() == [4711, 4712]
        assert telnet_says()
        status = json.loads(subprocess.run(["rtugate", "status", "--json"], capture_output=True, check=True).stdout)
        assert status, "status is empty"
        figures["resident KiB"] = memory_kib(service.pid)
        service.send_signal(signal.SIGTERM)
        assert service.wait(LIMIT_S) == 0
        assert list(RUNTIME.iterdir()) == [], "something is left in /run/rtugate"
    finally:
        service.kill()
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
