"""Stacks of a living program, and of one that was ended by its backstop or a signal, in processes of their own."""

from __future__ import annotations

import _thread
import contextlib
import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.stacks import (
    DUMP_BYTES,
    FILE_NAME,
    HEADER_BYTES,
    LINE_MOST,
    LINES_MOST,
    SUSPECTS_MOST,
    UNKNOWN,
    Evidence,
    read_evidence,
    stack_lines,
    start_of,
)
from tests.changing import read as read_request
from tests.changing import section, serial_master, slave
from tests.lines import PATIENCE_S
from tests.peers import free_port
from tests.programs import is_listening, program, until
from tests.struck import REARMED, ROOT, TICK_S, TIMEOUT_S, command, ended

ALLOWANCE_S = 1.0  # for a process to end on a busy machine
Record = Callable[[str, object], None]


# ------------------------------------------------------------------------------------------------ what is left of it


def evidence_of(path: Path) -> Evidence:
    evidence = read_evidence(path)
    assert evidence is not None, path.read_bytes()
    return evidence


def test_a_call_that_holds_the_interpreter_ends_the_process_in_time_and_is_known_by_its_task(
    tmp_path: Path, record_property: Record
) -> None:
    path = tmp_path / "stacks"
    with subprocess.Popen(command("a call holds the interpreter", path), cwd=ROOT, stdout=subprocess.PIPE) as station:
        try:
            assert station.stdout is not None
            began_s = float(station.stdout.readline())
            assert station.wait(PATIENCE_S) == 1
        finally:
            station.kill()
    took_s = time.monotonic() - began_s
    assert took_s < TIMEOUT_S + TICK_S + ALLOWANCE_S
    record_property("from the call to the end of the process", f"{took_s:.3f} s of {TIMEOUT_S + TICK_S:.3f}")
    evidence = evidence_of(path)
    assert evidence.is_hang
    assert evidence.names == ("field",)
    assert evidence.first_line == evidence.lines[0] == "Timeout (0:00:00.600000)!"
    assert evidence.lines[1].startswith("field (0x")
    field = evidence.lines[1 : next(n for n, line in enumerate(evidence.lines) if n > 1 and "(0x" in line)]
    assert "in hold_the_interpreter" in field[-1]
    assert "in goes_wrong" in field[-2]


@pytest.mark.parametrize(
    ("way", "names"),
    [("the main thread is blocked", ("main thread",)), ("the main thread never comes back", (UNKNOWN,))],
)
def test_whoever_is_in_no_wait_of_a_gateway_is_suspected_and_nobody_if_all_are(
    tmp_path: Path, way: str, names: tuple[str, ...]
) -> None:
    assert ended(way, tmp_path / "stacks").returncode == 1
    evidence = evidence_of(tmp_path / "stacks")
    assert (evidence.is_hang, evidence.names) == (True, names)
    for name in ("main thread", "plant", "scada", "telnet", "signals", "slow work", "joiner"):
        assert any(line.startswith(f"{name} (0x") for line in evidence.lines), name


@pytest.mark.parametrize(
    ("way", "number", "first_line", "name"),
    [
        ("aborted", signal.SIGABRT, "Fatal Python error: Aborted", "main thread"),
        ("a segment that is not there", signal.SIGSEGV, "Fatal Python error: Segmentation fault", "field"),
    ],
)
def test_a_fatal_signal_leaves_stacks_and_is_no_hang(
    tmp_path: Path, way: str, number: int, first_line: str, name: str
) -> None:
    assert ended(way, tmp_path / "stacks").returncode == -number
    evidence = evidence_of(tmp_path / "stacks")
    assert (evidence.is_hang, evidence.first_line, evidence.names) == (False, first_line, (name,))


@pytest.mark.parametrize("way", ["closed", "disarmed"])
def test_closed_or_disarmed_it_strikes_no_more_and_a_clean_end_leaves_no_file(tmp_path: Path, way: str) -> None:
    result = ended(way, tmp_path / "stacks")
    assert (result.returncode, result.stderr) == (0, "")
    assert list(tmp_path.iterdir()) == []


def test_a_kill_leaves_no_evidence_and_the_next_run_takes_the_file_over(tmp_path: Path) -> None:
    path = tmp_path / "stacks"
    assert ended("aborted", path).returncode == -signal.SIGABRT
    assert read_evidence(path) is not None
    assert ended("killed", path).returncode == -signal.SIGKILL
    assert path.exists()
    assert read_evidence(path) is None


def test_the_file_names_the_threads_and_is_written_only_when_there_is_a_new_one(tmp_path: Path) -> None:
    said = ended("names kept", tmp_path / "stacks").stdout.splitlines()
    first, second = eval(said[0])  # noqa: S307 - what our own program printed
    assert first.endswith(" main thread")
    assert second.endswith(r" first \x1b[2J")
    assert said[1:] == [
        "False when one has ended",
        "True when a helper has taken its number",
        "False when all is as it was",
        "False when there is another helper",
        "True when there is a new one",
    ]


def test_arming_it_again_leaves_nothing_behind(tmp_path: Path, record_property: Record) -> None:
    result = ended("rearmed", tmp_path / "stacks")
    assert (result.returncode, result.stderr) == (0, "")
    each_s, descriptors, memory_kib = map(float, result.stdout.split())
    assert descriptors == 0
    assert memory_kib < 512
    record_property(f"armed {REARMED} times", f"{1e6 * each_s:.0f} us each, memory grew by {memory_kib:.0f} KiB")


def test_where_there_is_no_thread_for_it_that_is_told_once_and_lived_with(tmp_path: Path) -> None:
    result = ended("no threads left", tmp_path / "stacks")
    assert result.returncode == 0
    assert result.stderr.count("a call that holds the interpreter would not be noticed: unable to start") == 1


def test_a_python_whose_waits_go_by_the_wall_clock_is_told_once_and_never_struck(tmp_path: Path) -> None:
    result = ended("disarmed", tmp_path / "stacks", "wall clock")
    assert result.returncode == 0
    assert result.stderr.count("this Python waits by the wall clock") == 1


@pytest.mark.parametrize("way", ["the main thread is blocked", "disarmed"])
@pytest.mark.parametrize("trouble", ["no folder", "a folder in its place", "full"])
def test_without_a_file_it_strikes_all_the_same_and_the_stacks_are_told_elsewhere(
    tmp_path: Path, trouble: str, way: str
) -> None:
    path = tmp_path / "stacks"
    if trouble == "no folder":
        path = tmp_path / "nowhere" / "stacks"
    elif trouble == "a folder in its place":
        path.mkdir()
    result = ended(way, path, trouble)
    strikes = way != "disarmed"
    assert result.returncode == strikes
    assert result.stderr.count("stacks cannot be written, so stacks go to the standard error output: ") == 1
    assert ("Timeout (0:00:00.600000)!" in result.stderr) is strikes
    assert ("in main_thread_blocked" in result.stderr) is strikes
    assert read_evidence(path) is None


def test_names_that_cannot_be_kept_are_told_once(tmp_path: Path) -> None:
    result = ended("file that takes no more", tmp_path / "stacks")
    assert result.returncode == 0
    assert result.stderr.count("which thread is which cannot be kept: File too large") == 1


def test_more_threads_than_the_header_holds_leave_the_stacks_whole(tmp_path: Path) -> None:
    assert ended("many threads", tmp_path / "stacks").returncode == 1
    assert (tmp_path / "stacks").read_bytes()[HEADER_BYTES:].startswith(b"Timeout (")
    assert evidence_of(tmp_path / "stacks").names == ("main thread",)


def test_handlers_that_were_there_before_come_back_in_the_end(tmp_path: Path) -> None:
    for before, count in (("1", 1), ("", 0)):
        result = ended("closed, then aborted", tmp_path / "stacks", PYTHONFAULTHANDLER=before)
        assert result.returncode == -signal.SIGABRT
        assert result.stderr.count("Fatal Python error: Aborted") == count


def test_the_threads_of_a_real_gateway_that_does_nothing_are_all_in_waits_that_are_known(tmp_path: Path) -> None:
    """Whoever gives a task another wait learns here that ``stacks`` has to know it, or names innocents."""
    port = free_port()
    text = (
        serial_master("gone", "/dev/rtugate-is-not-there", read_request(0))
        + slave("scada", port)
        + section("[hmi.telnet]", listen=f"127.0.0.1:{free_port()}")
    )
    with program(tmp_path, text) as gateway:
        gateway.started()
        gateway.wait_for("telnet server: listening")
        until(lambda: is_listening(port))
        until(lambda: all(is_asleep(gateway.run.pid) for _ in range(50)))
        gateway.run.send_signal(signal.SIGABRT)
        assert gateway.run.wait(PATIENCE_S) == -signal.SIGABRT
        left = (gateway.state / FILE_NAME).read_bytes()
    found = read(tmp_path / "stacks", left.replace(b"Fatal Python error: Aborted", b"Timeout (0:00:10)!"))
    assert found is not None
    assert found.names == (UNKNOWN,)
    for name in ("main thread", "gone", "scada", "telnet server", "control socket", "signals"):
        assert any(line.startswith(f"{name} (0x") for line in found.lines), found.lines


def is_asleep(pid: int) -> bool:
    try:
        states = [path.read_text().rpartition(")")[2].split()[0] for path in Path(f"/proc/{pid}/task").glob("*/stat")]
    except OSError:  # one has just ended
        return False
    return set(states) == {"S"}


# ------------------------------------------------------------------------------------------------ damage


HEADER = b"0x7f01 field\n0x7f02 scada\n0x7f03 main thread\n0x7f04 resolver\n".ljust(HEADER_BYTES, b"\n")
DUMP = b"""Timeout (0:00:10)!
Thread 0x0000000000007f04 [resolver] (most recent call first):
  File "/usr/lib/python3.14/socket.py", line 983 in getaddrinfo

Thread 0x0000000000007f05 [rtugate] (most recent call first):
  <no Python frame>

Thread 0x0000000000007f01 [field] (most recent call first):
  File "/usr/share/rtugate/gateway/transaction.py", line 12 in __init__
  File "/usr/share/rtugate/gateway/master.py", line ??? in step
  ...

Thread 0x0000000000007f02 [scada] (most recent call first):
  File "/usr/share/rtugate/gateway/link.py", line 95 in wait_ready
  File "/usr/share/rtugate/gateway/slave_tcp.py", line 83 in step

Thread 0x0000000000007f03 [rtugate] (most recent call first):
  File "/usr/share/rtugate/gateway/link.py", line 95 in wait_ready
"""


def read(path: Path, content: bytes) -> Evidence | None:
    path.write_bytes(content)
    return read_evidence(path)


def test_a_dump_is_read_in_the_words_of_newer_pythons_too(tmp_path: Path) -> None:
    evidence = read(tmp_path / "stacks", HEADER + DUMP)
    assert evidence is not None
    assert evidence.names == ("field",)
    assert evidence.lines[:4] == (
        "Timeout (0:00:10)!",
        "field (0x7f01), newest call last:",
        '  File "/usr/share/rtugate/gateway/master.py", line ??? in step',
        '  File "/usr/share/rtugate/gateway/transaction.py", line 12 in __init__',
    )
    assert "a thread without a name (0x7f05), newest call last:" in evidence.lines


@pytest.mark.parametrize("place", ["gateway/files.py", "socket.py"])
def test_slow_work_is_suspected_in_the_main_thread_alone(tmp_path: Path, place: str) -> None:
    call = b'/%s", line 7 in getaddrinfo' % place.encode()
    elsewhere = DUMP.replace(b'/gateway/transaction.py", line 12 in __init__', call)
    assert (found := read(tmp_path / "stacks", HEADER + elsewhere)) is not None
    assert found.names == (UNKNOWN,)
    main = call.join(elsewhere.rsplit(b'/gateway/link.py", line 95 in wait_ready', 1))
    assert (found := read(tmp_path / "stacks", HEADER + main)) is not None
    assert found.names == ("main thread",)


def test_several_suspects_are_all_named_and_so_many_of_them_that_a_line_holds_them(tmp_path: Path) -> None:
    names = b"".join(b"0x%x line-%d\n" % (number, number) for number in range(20))
    one = b'Thread 0x%016x (most recent call first):\n  File "/x/gateway/master.py", line 1 in step\n\n'
    dump = b"Timeout (0:00:10)!\n" + b"".join(one % (number % 20) for number in range(40))
    assert (found := read(tmp_path / "stacks", names.ljust(HEADER_BYTES, b"\n") + dump)) is not None
    assert found.names == tuple(f"line-{number}" for number in range(SUSPECTS_MOST))


def check_fit_to_show(evidence: Evidence | None) -> None:
    if evidence is None:
        return
    assert 0 < len(evidence.names) <= SUSPECTS_MOST
    assert len(evidence.lines) <= LINES_MOST + 2
    for line in (*evidence.names, evidence.first_line, *evidence.lines):
        assert line.isprintable()
        assert len(line) <= LINE_MOST


@pytest.mark.parametrize("kind", ["cut off", "bits flipped", "parts moved"])
def test_whatever_became_of_the_file_what_is_read_of_it_can_be_shown(tmp_path: Path, kind: str) -> None:
    chance, whole = random.Random(7), HEADER[:100] + DUMP
    for _ in range(500):
        at = chance.randrange(len(whole))
        content = bytearray(whole[:at] if kind == "cut off" else whole)
        if kind == "bits flipped":
            for place in chance.choices(range(len(content)), k=20):
                content[place] ^= 1 << chance.randrange(8)
        elif kind == "parts moved":
            content = content[at:] + content[:at]
        check_fit_to_show(read(tmp_path / "stacks", bytes(content)))


@settings(max_examples=300)
@given(st.binary(max_size=2000), st.booleans(), st.integers(1, 40))
def test_any_bytes_at_all_can_be_read(
    tmp_path_factory: pytest.TempPathFactory, junk: bytes, is_hang: bool, by: int
) -> None:
    first_line = b"Timeout (0:00:10)!\n" if is_hang else b"Fatal Python error: "
    path = tmp_path_factory.mktemp("any") / "stacks"
    assert read(path, junk) is None or any(word in junk for word in (b"Timeout (", b"Fatal Python error: "))
    thread = b'Thread 0x7f01 (most recent call first):\n  File "' + junk + b'", line 1 in ' + junk[::-1] + b"\n"
    check_fit_to_show(read(path, b"0x7f01 " + junk + b"\n" + first_line + thread * by))


def test_what_is_no_file_of_ours_is_no_evidence(tmp_path: Path) -> None:
    folder, fifo, empty, huge = (tmp_path / name for name in ("folder", "fifo", "empty", "huge"))
    folder.mkdir()
    os.mkfifo(fifo)
    empty.touch()
    with huge.open("wb") as file:
        file.truncate(2**40)
        file.seek(HEADER_BYTES + DUMP_BYTES)
        file.write(DUMP)
    for path in (tmp_path / "nothing", folder, fifo, empty, huge, Path("/dev/zero")):
        assert read_evidence(path) is None
        assert start_of(path, 10) in (None, b"", bytes(10))
    read(tmp_path / "long", HEADER + DUMP + 100_000 * b'  File "/x/y.py", line 1 in f\n')
    check_fit_to_show(read_evidence(tmp_path / "long"))


# ------------------------------------------------------------------------------------------------ a living program


@contextlib.contextmanager
def threads_deep(names: list[str], depth: int) -> Iterator[None]:
    """Threads of these *names* wait, each so many calls deep."""
    may_go, there = threading.Event(), threading.Barrier(len(names) + 1)

    def innermost() -> None:
        there.wait(PATIENCE_S)
        may_go.wait(PATIENCE_S)

    def deeper(left: int) -> None:
        deeper(left - 1) if left else innermost()

    threads = [threading.Thread(target=deeper, args=(depth,), name=name) for name in names]
    for thread in threads:
        thread.start()
    there.wait(PATIENCE_S)
    try:
        yield
    finally:
        may_go.set()
        for thread in threads:
            thread.join()


def test_every_thread_is_told_with_its_name_and_its_newest_call_last() -> None:
    with threads_deep(["fi\x1beld", "scada"], depth=2):
        lines = stack_lines()
    start = next(n for n, line in enumerate(lines) if line.startswith(r"fi\x1beld (0x"))
    assert lines[start].endswith("), newest call last:")
    calls = [line.rpartition(" in ")[2].rpartition(".")[2] for line in lines[start + 1 : start + 12]]
    assert [call for call in calls if call in ("deeper", "innermost")][:4] == ["deeper"] * 3 + ["innermost"]
    assert calls.index("run") < calls.index("deeper") < calls.index("innermost") < calls.index("wait")
    assert f'  File "{__file__}", line ' in lines[start + calls.index("innermost") + 1]
    assert lines[0].startswith("main thread (0x")
    assert any(line.startswith("scada (0x") for line in lines)


def test_those_who_hang_come_first() -> None:
    with threads_deep(["field", "scada", "plant"], depth=1):
        lines = stack_lines(first=["plant"])
    assert lines[0].startswith("plant (0x")
    assert sum(line.startswith("plant (0x") for line in lines) == 1


def test_many_threads_deep_in_calls_are_told_in_so_many_lines() -> None:
    with threads_deep([f"{number:03} {'x' * 300}" for number in range(30)], depth=200):
        lines = stack_lines()
    assert len(lines) == LINES_MOST + 1
    assert lines[-1].endswith(" more lines are left out")
    assert "  older calls are left out" in lines
    assert all(len(line) <= LINE_MOST and line.isprintable() for line in lines)


def test_a_thread_that_nobody_named_is_told_as_well() -> None:
    """One that was not made by ``threading``."""

    may_go, there = threading.Lock(), threading.Lock()
    may_go.acquire()
    there.acquire()

    def work() -> None:
        there.release()
        may_go.acquire()
        may_go.release()

    _thread.start_new_thread(work, ())
    there.acquire()
    try:
        lines = stack_lines()
    finally:
        may_go.release()
    assert any(line.startswith("a thread without a name (0x") for line in lines)
