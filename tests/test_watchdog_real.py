"""The hardware watchdog on real things: FIFOs, terminals, files, folders, sockets."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.watchdog import WatchdogDevice
from tests.fakes import JumpingClock


@contextlib.contextmanager
def a_fifo(tmp_path: Path) -> Iterator[tuple[Path, int]]:
    """A FIFO and the descriptor of its reader."""
    path = tmp_path / "watchdog"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        yield path, reader
    finally:
        os.close(reader)


def real(path: Path, clock: JumpingClock | SystemClock) -> WatchdogDevice:
    return WatchdogDevice(path, 30, clock)


def test_a_fifo_is_fed_a_byte_at_a_time_and_gets_v_on_a_clean_close(clock: JumpingClock, tmp_path: Path) -> None:
    with a_fifo(tmp_path) as (path, reader):
        device = real(path, clock)
        device.feed()
        assert os.read(reader, 100) == b"\0"
        device.feed()
        device.feed()
        assert os.read(reader, 100) == b"\0\0"
        device.close(clean=True)
        assert (os.read(reader, 100), os.read(reader, 100), device.trouble) == (b"V", b"", "")


def test_a_fifo_gets_no_v_on_any_other_close(clock: JumpingClock, tmp_path: Path) -> None:
    with a_fifo(tmp_path) as (path, reader):
        device = real(path, clock)
        device.feed()
        device.close(clean=False)
        assert (os.read(reader, 100), os.read(reader, 100)) == (b"\0", b"")


def test_a_fifo_without_a_reader_is_trouble_and_no_wait_and_used_when_one_comes(
    clock: JumpingClock, tmp_path: Path
) -> None:
    path = tmp_path / "watchdog"
    os.mkfifo(path)
    device = real(path, clock)
    device.feed()
    assert device.trouble == f"{path}: nobody is behind it (no driver, no reader)"
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    clock.pass_s(1.0)
    device.feed()
    assert (os.read(reader, 100), device.trouble) == (b"\0", "")
    os.close(reader)
    device.feed()
    assert device.trouble == f"{path}: its reader is gone"
    device.close(clean=True)


def test_a_reader_that_does_not_read_is_trouble_and_no_wait(clock: JumpingClock, tmp_path: Path) -> None:
    with a_fifo(tmp_path) as (path, reader):
        device = real(path, clock)
        device.feed()
        filler = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(filler, bytes(1 << 16))
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(filler, b"\0")
        os.close(filler)
        device.feed()
        assert device.trouble == f"{path}: takes nothing any more (its reader does not read)"
        device.close(clean=False)
        assert reader


def test_a_terminal_refuses_the_ioctls_and_is_fed(clock: JumpingClock, caplog: pytest.LogCaptureFixture) -> None:
    ours, theirs = os.openpty()
    device = real(Path(os.ttyname(theirs)), clock)
    device.feed()
    device.close(clean=True)
    came = b""
    while len(came) < 2 and select.select([ours], [], [], 5.0)[0]:  # a terminal may hand on byte by byte
        came += os.read(ours, 100)
    assert came == b"\0V"
    assert "it refuses a watchdog's requests (is it one?)" in caplog.text
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize("content", [b"", b"something to lose\n"])
def test_a_regular_file_is_refused_and_stays_as_it_is(clock: JumpingClock, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "notes"
    path.write_bytes(content)
    device = real(path, clock)
    for _ in range(5):
        device.feed()
        clock.pass_s(60.0)
    device.close(clean=True)
    assert device.trouble == f"{path}: is a file or a disk and no watchdog"
    assert path.read_bytes() == content


def test_a_name_with_a_typo_creates_no_file(clock: JumpingClock, tmp_path: Path) -> None:
    path = tmp_path / "wachtdog"
    device = real(path, clock)
    device.feed()
    assert device.trouble == f"{path}: is not there (is its driver loaded?)"
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_refused(clock: JumpingClock, tmp_path: Path) -> None:
    device = real(tmp_path, clock)
    device.feed()
    assert device.trouble == f"{tmp_path}: is a folder and no watchdog"


def test_a_socket_is_refused(clock: JumpingClock, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket"))
        device = real(tmp_path / "socket", clock)
        device.feed()
    assert device.trouble.endswith("nobody is behind it (no driver, no reader)")


def test_a_path_that_no_file_can_have_is_trouble(clock: JumpingClock) -> None:
    device = real(Path("/dev/watch\0dog"), clock)
    device.feed()
    assert device.trouble == "/dev/watch\\x00dog: is a path that no file can have"


def test_a_thousand_failures_leave_no_descriptor_behind(clock: JumpingClock, tmp_path: Path) -> None:
    path = tmp_path / "notes"
    path.touch()
    device = real(path, clock)
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(1000):
        device.feed()
        clock.pass_s(60.0)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_no_child_inherits_it(tmp_path: Path) -> None:
    with a_fifo(tmp_path) as (path, _):
        device = real(path, SystemClock())
        device.feed()
        listing = subprocess.run(
            ["ls", "-l", "/proc/self/fd"], capture_output=True, text=True, check=True, close_fds=False
        )
        device.close(clean=False)
    assert str(path) not in listing.stdout
