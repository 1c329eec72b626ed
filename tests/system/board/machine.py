"""The virtual board itself: qemu, its power, its four UARTs, its watchdog, and the orders that it carries out.

What it is: one object for a board that may be switched on and off again, its disk kept. Beside the UARTs it has two
wires for the test alone: ``do`` has a shell of the board carry something out (``agent.sh``), and all that kernel and
journal say is in ``log``. What qemu tells of the machine (WATCHDOG, RESET, SHUTDOWN) is in ``events``.
Losing its power it keeps what was flushed to the disk, and loses what was not.

Threads: none; whatever waits meanwhile reads what comes. One thread at a time.
"""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import selectors
import shlex
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.system.board.image import Base, disk_of, layer

MEMORY_MIB: Final = 512
BOOT_LIMIT_S: Final = 300.0  # takes 15 s on an idle machine
ORDER_LIMIT_S: Final = 120.0
SOON_S: Final = 60.0
LOOK_EVERY_S: Final = 0.05  # nothing tells a test that a simulated device was polled
UART_IRQS: Final = (4, 3, 5, 7)  # each its own: a PC's third and fourth share those of the first two
PROCESSOR: Final = ("-accel", "tcg,tb-size=64", "-cpu", "max,-cx16")  # other sizes boot slower; with cx16 Linux dies
RESETS: Final = ("WATCHDOG", "RESET", "SHUTDOWN")
KERNEL_WORDS: Final = (
    "console=hvc0 quiet systemd.show_status=no systemd.getty_auto=no systemd.condition-needs-update=no "
    "systemd.journald.forward_to_console=1 systemd.journald.max_level_console=info"
)  # no panic=: a kernel that is dead is the watchdog's affair


@dataclass(frozen=True)
class Event:
    """What happened to the machine, by qemu's name for it, and when (monotonic)."""

    name: str
    at_s: float


class Wire:
    """One end of a socket whose other end is qemu's; ``came`` is what came and nobody has taken."""

    def __init__(self) -> None:
        self.near, self.far = socket.socketpair()
        self.near.setblocking(False)
        self.came = b""

    def read(self) -> bool:
        """Take in what has come; False at the end."""
        try:
            data = self.near.recv(65536)
        except BlockingIOError:
            return True
        except ConnectionResetError:
            return False
        self.came += data
        return data != b""

    def lines(self) -> list[str]:
        """Take the whole lines that have come."""
        *lines, self.came = self.came.split(b"\n")
        return [line.decode(errors="replace").strip() for line in lines]

    def send(self, data: bytes) -> None:
        self.near.sendall(data)

    def close(self) -> None:
        self.near.close()
        self.far.close()


class Machine:
    """One board.

    ports:   for each UART the host's device that it is wired to, or "": its bytes are then ``uarts``' affair.
    boots:   the boot identifiers it has said hello with, in order; the agent's hello is its first sign of life.
    """

    def __init__(self, folder: Path, base: Base, parts: Path, ports: Sequence[str] = ("", "", "", "")) -> None:
        """*folder*: for its disks; *parts*: what its second disk holds, /dev/vdb, read-only."""
        self.events: list[Event] = []
        self.boots: list[str] = []
        self.uarts: dict[int, Wire] = {}
        self._folder, self._base, self._ports = folder, base, ports
        self._tags = itertools.count(1)
        self._answers: dict[str, tuple[int, str]] = {}
        self._qemu: subprocess.Popen[bytes] | None = None
        self._selector = selectors.DefaultSelector()
        folder.mkdir(parents=True)
        (folder / "log").touch()
        layer(base, folder / "disk.qcow2")
        disk_of(parts, folder / "parts.ext4")

    @property
    def log(self) -> str:
        """All that kernel and journal have said since it was made."""
        return (self._folder / "log").read_text(errors="replace")

    @property
    def boot_id(self) -> str:
        return self.boots[-1]

    def count(self, event: str) -> int:
        """Return how often this has happened to the machine."""
        return sum(event == known.name for known in self.events)

    @property
    def resets(self) -> list[Event]:
        """All that has ended a run of the machine, but for the power."""
        return [event for event in self.events if event.name in RESETS]

    # -------------------------------------------------------------------------------------------- power

    def start(self) -> None:
        """Switch it on; return once it carries out orders."""
        assert self._qemu is None, "it is on already"
        self._qmp, self._agent = Wire(), Wire()
        self.uarts = {number: Wire() for number, port in enumerate(self._ports) if not port}
        wires = [self._qmp, self._agent, *self.uarts.values()]
        self._qemu = subprocess.Popen(
            self._command(), pass_fds=[wire.far.fileno() for wire in wires], stdin=subprocess.DEVNULL
        )
        self._hear(self._qmp, self._note_events)
        self._hear(self._agent, self._note_answers)
        for wire in self.uarts.values():
            self._hear(wire, lambda: None)
        for command in ("qmp_capabilities", "cont"):
            self._qmp.send(json.dumps({"execute": command}).encode())
        boots = len(self.boots)
        self.until(lambda: len(self.boots) > boots, "the board comes up", BOOT_LIMIT_S)

    def cut_power(self) -> None:
        """Off, at once; what was not flushed is lost. Again: nothing."""
        if self._qemu is None:
            return
        self._qemu.kill()
        self._qemu.wait()
        self._qemu = None
        for wire in (self._qmp, self._agent, *self.uarts.values()):
            with contextlib.suppress(KeyError):  # its end was seen before
                self._selector.unregister(wire.near)
            wire.close()

    def close(self) -> None:
        self.cut_power()
        self._selector.close()

    def _command(self) -> list[str]:
        files = self._folder
        return [
            *("setpriv", "--pdeathsig", "KILL"),  # nothing of it is left, however the tests end
            "qemu-system-x86_64",
            *PROCESSOR,
            *("-machine", "pc", "-smp", "1", "-m", str(MEMORY_MIB)),
            *("-nodefaults", "-no-user-config", "-display", "none", "-S"),
            *("-kernel", str(self._base.kernel), "-initrd", str(self._base.initrd), "-append", KERNEL_WORDS),
            *("-drive", f"file={files / 'disk.qcow2'},if=virtio,format=qcow2,cache=writeback"),
            *("-drive", f"file={files / 'parts.ext4'},if=virtio,format=raw,readonly=on"),
            *("-chardev", f"socket,id=qmp,fd={self._qmp.far.fileno()}", "-mon", "chardev=qmp,mode=control"),
            *("-device", "virtio-serial-pci"),
            *("-chardev", f"file,id=log,path={files / 'log'},append=on", "-device", "virtconsole,chardev=log"),
            *("-chardev", f"socket,id=agent,fd={self._agent.far.fileno()}"),
            *("-device", "virtserialport,chardev=agent,name=board.agent"),
            *("-device", "i6300esb", "-action", "watchdog=reset"),
            *(word for number, irq in enumerate(UART_IRQS) for word in self._uart(number, irq)),
        ]

    def _uart(self, number: int, irq: int) -> Iterator[str]:
        port = self._ports[number]
        wire = f"serial,path={port}" if port else f"socket,fd={self.uarts[number].far.fileno()}"
        yield from ("-chardev", wire.replace(",", f",id=uart{number},", 1))
        yield from ("-device", f"isa-serial,chardev=uart{number},index={number},irq={irq}")

    # -------------------------------------------------------------------------------------------- waiting

    def until(self, condition: Callable[[], object], what: str, limit_s: float = SOON_S) -> None:
        """Take in what comes until *condition*; *what* is told if it never comes true."""
        assert self.watch(condition, limit_s), f"never in {limit_s:g} s: {what}. The board's log ends:\n{self._end()}"

    def watch(self, condition: Callable[[], object], limit_s: float) -> bool:
        """Take in what comes until *condition*; False if that has not come true within *limit_s*."""
        end_s = time.monotonic() + limit_s
        while not condition():
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return False
            for key, _events in self._selector.select(min(left_s, LOOK_EVERY_S)):
                key.data()
        return True

    def _end(self) -> str:
        return "\n".join(self.log.splitlines()[-40:])

    def _hear(self, wire: Wire, note: Callable[[], None]) -> None:
        def take() -> None:
            if not wire.read():
                self._selector.unregister(wire.near)
            note()

        self._selector.register(wire.near, selectors.EVENT_READ, take)

    def _note_events(self) -> None:
        for line in self._qmp.lines():
            told: dict[str, Any] = json.loads(line)
            assert "error" not in told, told
            if "event" in told:
                self.events.append(Event(told["event"], time.monotonic()))

    def _note_answers(self) -> None:
        for line in self._agent.lines():
            match line.split(" "):
                case ["hello", boot_id]:
                    self.boots.append(boot_id)
                case [tag, code, output]:
                    self._answers[tag] = int(code), base64.b64decode(output).decode(errors="replace")
                case [tag, code]:
                    self._answers[tag] = int(code), ""
                case _:  # a line that a reset cut off
                    pass

    # -------------------------------------------------------------------------------------------- orders

    def order(self, script: str, limit_s: float = ORDER_LIMIT_S) -> tuple[int, str]:
        """Have the board's shell carry out *script*, as root; return its exit code and all that it said."""
        tag = self._send(script)
        self.until(lambda: tag in self._answers, f"an answer to {script!r}", limit_s)
        return self._answers.pop(tag)

    def answers(self) -> bool:
        """Tell whether it is on, and carries out orders."""
        if self._qemu is None or self._qemu.poll() is not None:
            return False
        tag = self._send("true")
        return self.watch(lambda: tag in self._answers, SOON_S)

    def do(self, script: str, limit_s: float = ORDER_LIMIT_S) -> str:
        """``order`` what has to succeed; return what it said, without the last line's end."""
        code, said = self.order(f"set -e\n{script}", limit_s)
        assert code == 0, f"{script!r} ended with {code}:\n{said}"
        return said.rstrip("\n")

    def _send(self, script: str) -> str:
        """Send an order; return its tag."""
        tag = str(next(self._tags))
        self._agent.send(f"{tag} {base64.b64encode(script.encode()).decode()}\n".encode())
        return tag

    def put(self, path: str, text: str) -> None:
        """Write a file of the board."""
        told = base64.b64encode(text.encode()).decode()
        self.do(f"mkdir -p $(dirname {shlex.quote(path)})\nprintf %s {told} | base64 -d >{shlex.quote(path)}")


@contextmanager
def a_machine(folder: Path, base: Base, parts: Path, ports: Sequence[str] = ("", "", "", "")) -> Iterator[Machine]:
    """Give a board that is switched on; nothing of it runs afterwards."""
    made = Machine(folder, base, parts, ports)
    try:
        made.start()
        yield made
    finally:
        made.close()
