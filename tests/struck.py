"""A small station with a backstop that goes wrong in a way of its choice, in a process of its own.

    python -m tests.struck WAY FILE [full] [wall clock]

Its threads are in the waits that there are in a gateway. It says on its standard output what the test has to know.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from gateway.link import Waker, wait_ready
from gateway.stacks import HEADER_BYTES, Backstop
from tests.programs import SOON_S, until

ROOT = Path(__file__).parents[1]
TIMEOUT_S = 0.6
TICK_S = 0.06
FOR_EVER_S = 10_000
WIPED = b"wiped\n"
REARMED = 10_000


def idle_threads() -> None:
    """Everybody in one of the waits that there are in a gateway."""
    waker, selector, reader = Waker(), selectors.DefaultSelector(), os.pipe()[0]
    selector.register(waker, selectors.EVENT_READ)
    other = threading.Event()
    waits: dict[str, Callable[[], object]] = {
        "plant": lambda: wait_ready((reader,), (), None),
        "scada": lambda: waker.wait(None),
        "telnet": lambda: selector.select(None),
        "signals": lambda: signal.sigwait({signal.SIGUSR2}),
        "slow work": other.wait,
        "joiner": lambda: next(one for one in threading.enumerate() if one.name == "plant").join(),
    }
    for name, wait in waits.items():
        threading.Thread(target=wait, name=name).start()


def hold_the_interpreter() -> None:
    ctypes.PyDLL(None).sleep(FOR_EVER_S)


def in_a_task(fault: Callable[[], object]) -> Callable[[Backstop], None]:
    """A station whose main thread does its ticks until the thread "field" goes wrong, after some of them."""

    def goes_wrong(has_ticked: threading.Semaphore) -> None:
        for _ in range(3):
            has_ticked.acquire()
        say_moment()
        fault()

    def work(backstop: Backstop) -> None:
        waker, ticks = Waker(), threading.Semaphore(0)
        threading.Thread(target=goes_wrong, args=(ticks,), name="field").start()
        idle_threads()
        while True:
            backstop.name_threads()
            backstop.arm(TIMEOUT_S)
            ticks.release()
            waker.wait(TICK_S)

    return work


def main_thread_blocked(backstop: Backstop) -> None:
    idle_threads()
    backstop.name_threads()
    backstop.arm(TIMEOUT_S)
    say_moment()
    os.read(os.pipe()[0], 1)


def main_thread_never_back(backstop: Backstop) -> None:
    idle_threads()
    backstop.name_threads()
    backstop.arm(TIMEOUT_S)
    say_moment()
    Waker().wait(None)


def closed_in_time(backstop: Backstop) -> None:
    descriptors = entries("/proc/self/fd")
    backstop.arm(0.05)
    backstop.close()
    backstop.close()
    assert entries("/proc/self/fd") == descriptors - 1
    time.sleep(0.2)


def disarmed(backstop: Backstop) -> None:
    backstop.arm(0.05)
    backstop.disarm()
    time.sleep(0.2)
    backstop.close()


def aborted(backstop: Backstop) -> None:
    idle_threads()
    backstop.name_threads()
    os.kill(os.getpid(), signal.SIGABRT)


def killed(backstop: Backstop) -> None:
    backstop.arm(TIMEOUT_S)
    os.kill(os.getpid(), signal.SIGKILL)


def names_kept(backstop: Backstop) -> None:
    """Say what the file's header is, and then for each change whether it was written because of it."""
    path = Path(sys.argv[2])

    def is_written() -> bool:
        with path.open("r+b") as file:
            file.write(WIPED)
        backstop.name_threads()
        return not path.read_bytes().startswith(WIPED)

    with waiting("first \x1b[2J") as first:
        backstop.name_threads()
        print(path.read_bytes()[:HEADER_BYTES].decode().split("\n")[:2], flush=True)
    print(is_written(), "when one has ended", flush=True)
    helper = None
    while helper is None or helper.ident != first.ident:  # soon: the system gives the number again once it is free
        with waiting("helper", daemon=True) as helper:
            if helper.ident == first.ident:
                print(is_written(), "when a helper has taken its number", flush=True)
                print(is_written(), "when all is as it was", flush=True)
    with waiting("another helper", daemon=True):
        print(is_written(), "when there is another helper", flush=True)
    with waiting("second"):
        print(is_written(), "when there is a new one", flush=True)
    backstop.close()


@contextlib.contextmanager
def waiting(name: str, daemon: bool = False) -> Iterator[threading.Thread]:
    """A thread that does nothing meanwhile."""
    may_go = threading.Event()
    thread = threading.Thread(target=may_go.wait, name=name, daemon=daemon)
    thread.start()
    try:
        yield thread
    finally:
        may_go.set()
        thread.join()


def file_that_takes_no_more(backstop: Backstop) -> None:
    with waiting("first"), files_of_at_most(0):
        backstop.name_threads()
        with waiting("second"):
            backstop.name_threads()
    backstop.close()


def many_threads(backstop: Backstop) -> None:
    with contextlib.ExitStack() as threads:
        for number in range(300):
            threads.enter_context(waiting(f"{number:03} {'x' * 100}"))
        backstop.name_threads()
    main_thread_blocked(backstop)


def closed_then_aborted(backstop: Backstop) -> None:
    backstop.close()
    os.kill(os.getpid(), signal.SIGABRT)


def rearmed(backstop: Backstop) -> None:
    """Arm it again and again; say what that costs, and how many descriptors and KiB of memory are left of it."""
    threads = entries("/proc/self/task")
    backstop.arm(60.0)
    before = entries("/proc/self/fd"), memory_kib()
    began_s = time.perf_counter()
    for _ in range(REARMED):
        backstop.arm(60.0)
    each_s = (time.perf_counter() - began_s) / REARMED
    print(each_s, entries("/proc/self/fd") - before[0], memory_kib() - before[1], flush=True)
    backstop.close()
    until(lambda: entries("/proc/self/task") == threads)  # the last one is still on its way out


def entries(folder: str) -> int:
    return len(list(Path(folder).iterdir()))


def memory_kib() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024


def no_threads_left(backstop: Backstop) -> None:
    """The system gives no more threads."""
    resource.setrlimit(resource.RLIMIT_AS, (2**28, 2**28))
    threading.stack_size(2**28)
    backstop.arm(TIMEOUT_S)
    backstop.arm(TIMEOUT_S)
    backstop.close()


@contextlib.contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """No file can become larger meanwhile, as on a full disk; what measures the tests writes its own afterwards."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def say_moment() -> None:
    print(time.monotonic(), flush=True)


WAYS: dict[str, Callable[[Backstop], None]] = {
    "a call holds the interpreter": in_a_task(hold_the_interpreter),
    "the main thread is blocked": main_thread_blocked,
    "the main thread never comes back": main_thread_never_back,
    "aborted": aborted,
    "a segment that is not there": in_a_task(lambda: ctypes.string_at(0)),
    "killed": killed,
    "closed": closed_in_time,
    "disarmed": disarmed,
    "closed, then aborted": closed_then_aborted,
    "names kept": names_kept,
    "file that takes no more": file_that_takes_no_more,
    "many threads": many_threads,
    "rearmed": rearmed,
    "no threads left": no_threads_left,
}


def main(way: str, path: Path, *options: str) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with files_of_at_most(8192) if "full" in options else contextlib.nullcontext():
        backstop = Backstop(path, is_monotonic=False if "wall clock" in options else None)
    if "wall clock" in options:
        backstop.arm(TIMEOUT_S)
    WAYS[way](backstop)


def command(way: str, path: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "tests.struck", way, str(path), *options]


def ended(way: str, path: Path, *options: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(way, path, *options),
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=SOON_S,
    )


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
