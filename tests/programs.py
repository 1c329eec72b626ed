"""`rtugate run` as a program of its own, for tests: what it says, its terminals, and what it leaves behind."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from gateway.edits import ask_gateway
from tests.hmi.terminals import Client, unix_client

HERE = Path(__file__).parent.parent
SOON_S = 20.0  # for what another program has to do; a test that needs it has failed
LOOK_EVERY_S = 0.02  # nothing tells a test what another program has written into a file
STOP_LIMIT_S = 2.0  # a clean stop takes under 2 s (spec section 7)
COMMAND = ["-m", "gateway"]


def until(condition: Callable[[], object], what: Callable[[], str] = str) -> None:
    """Look until *condition*; *what* is told if it never comes true."""
    end_s = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < end_s, f"it never came true: {what()}"
        time.sleep(LOOK_EVERY_S)


class Program:
    """One gateway over all its runs; ``said``: what they have logged."""

    def __init__(self, folder: Path, text: str | bytes, state: Path | None = None) -> None:
        self.folder = folder
        self.path, self.state = folder / "rtugate.toml", state or folder / "state"
        self.control = self.state / "control"
        self.path.write_bytes(text.encode() if isinstance(text, str) else text)
        self.arguments = ["-c", str(self.path), "--state", str(self.state)]
        self.runs: list[subprocess.Popen[bytes]] = []
        self._log = folder / "log"
        self._log.touch()

    @property
    def said(self) -> str:
        return self._log.read_text()

    @property
    def run(self) -> subprocess.Popen[bytes]:
        """The run that was started last."""
        return self.runs[-1]

    def start(
        self,
        command: Sequence[str] = COMMAND,
        environment: Mapping[str, str] | None = None,
        before: Callable[[], None] | None = None,
    ) -> None:
        """Start it, without waiting for anything; *before* is done in its process, before it begins."""
        known = os.environ | {"PYTHONPATH": str(HERE), "PYTHONUNBUFFERED": "1", **(environment or {})}
        with self._log.open("ab") as log:
            arguments = [sys.executable, *command, "run", *self.arguments]
            self.runs.append(
                subprocess.Popen(arguments, stderr=log, env=known, cwd=self.folder, preexec_fn=before)  # noqa: PLW1509 - no thread of the tests holds a lock that it needs
            )

    def started(self, command: Sequence[str] = COMMAND, environment: Mapping[str, str] | None = None) -> Program:
        """Start it; return once it answers at its control socket."""
        count = self.said.count("control socket: listening")
        self.start(command, environment)
        self.wait_for("control socket: listening", count + 1)
        return self

    def wait_for(self, words: str, times: int = 1) -> None:
        """Wait until it has logged *words* so often."""
        until(lambda: self.said.count(words) >= times, lambda: f"{words!r} in:\n{self.said}")

    def reload(self, text: str | None = None) -> None:
        """Have it load its file anew, as systemd does."""
        if text is not None:
            self.path.write_text(text)
        self.run.send_signal(signal.SIGHUP)

    def ask(self, line: str) -> str | None:
        return ask_gateway(self.control, line)

    def command(self, *words: str) -> tuple[int, str]:
        """Run another `rtugate` command on the same file; return its exit code and all that it says."""
        ended = subprocess.run(
            [sys.executable, *COMMAND, *words, *self.arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
            check=False,
            cwd=HERE,
        )
        return ended.returncode, ended.stdout

    @contextmanager
    def menu(self) -> Iterator[Client]:
        """The menu, in a terminal in which everything has room."""
        with unix_client(self.control) as client:
            client.send(b"menu 120 80 maria\n")
            yield client

    def stop(self, number: int = signal.SIGTERM) -> int:
        """End it as systemd does; return its exit code. It must not take longer than it may."""
        self.run.send_signal(number)
        return self.run.wait(STOP_LIMIT_S)


@contextmanager
def program(folder: Path, text: str | bytes, state: Path | None = None) -> Iterator[Program]:
    """Give a gateway that is not started yet; nothing of it is left afterwards."""
    made = Program(folder, text, state)
    try:
        yield made
    finally:
        for run in made.runs:
            run.kill()
            run.wait()


def is_listening(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
