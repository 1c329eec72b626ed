"""Faults for the real gateway: each has one of its threads hang, die, or turn without getting anywhere.

What it is: ``arm`` has every task look for an order before each of its steps. The order is a file that says who does
what, "field:deadlock"; whoever it is for takes the file away, notes the moment beside it, and commits the fault in his
own thread. The supervisor itself is called "main thread".
What it refuses: touching flags, the watchdog or anything else that is to notice. What the step then does is real.

Threads: each task looks in its own.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import logging
import os
import platform
import select
import selectors
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Never

from gateway.hmi.console import SerialConsole
from gateway.hmi.terminals import Terminals
from gateway.link import Waker
from gateway.master import Master
from gateway.slave import SerialSlave
from gateway.slave_tcp import TcpSlave

ORDER: Final = "RTUGATE_FAULT"  # the environment's name for the path of the order
MOMENT: Final = ".moment"  # behind that path: the file with the time of the fault, CLOCK_MONOTONIC in seconds
SUPERVISOR: Final = "main thread"
EXIT: Final = {"x86_64": 60, "i686": 1, "aarch64": 93, "armv7l": 1}  # exit(2), of one thread; asm/unistd.h
LONG_S: Final = 10_000


def arm(order: Path) -> None:
    """Have all tasks of this process, and its supervisor, commit whatever fault the file *order* names."""
    tasks: list[Any] = [Master, TcpSlave, SerialSlave, SerialConsole, Terminals]
    for kind in tasks:
        kind.step = _obedient(kind.step, order)
    waker: Any = Waker
    waker.wait = _obedient_supervisor(waker.wait, order)


def _obedient(step: Callable[[Any], Any], order: Path) -> Callable[[Any], Any]:
    @functools.wraps(step)
    def obey_then_step(task: Any) -> Any:
        _obey(order, task.name, task)
        return step(task)

    return obey_then_step


def _obedient_supervisor(wait: Callable[[Any, Any], Any], order: Path) -> Callable[[Any, Any], Any]:
    @functools.wraps(wait)
    def obey_then_wait(waker: Any, timeout_s: Any) -> Any:
        if threading.current_thread() is threading.main_thread():
            _obey(order, SUPERVISOR, None)
        return wait(waker, timeout_s)

    return obey_then_wait


def _obey(order: Path, name: str, task: Any) -> None:
    """Commit the fault of *order* if there is one for *name*."""
    with contextlib.suppress(FileNotFoundError):
        who, _, kind = order.read_text().strip().rpartition(":")
        if who == name:
            order.unlink()  # whoever runs next does not obey it as well
            order.with_name(order.name + MOMENT).write_text(repr(time.monotonic()))
            FAULTS[kind](task)


# ------------------------------------------------------------------------------------------------ the faults


def deadlock(_task: Any) -> None:
    """Two threads have taken two locks crosswise."""
    ours, theirs, is_taken = threading.Lock(), threading.Lock(), threading.Event()

    def take_crosswise() -> None:
        with theirs:
            is_taken.set()
            ours.acquire()

    ours.acquire()
    threading.Thread(target=take_crosswise, name="the other one", daemon=True).start()
    is_taken.wait()
    theirs.acquire()


def loop(_task: Any) -> Never:
    """A loop that nothing ends; others get the interpreter now and then."""
    while True:
        pass


def blocked(_task: Any) -> None:
    """A system call that does not return: nobody will ever write into this pipe."""
    os.read(os.pipe()[0], 1)


def leave(_task: Any) -> Never:
    """The thread ends, and ``threading`` says nothing of this error."""
    raise SystemExit


def vanish(_task: Any) -> None:
    """The thread ends in the kernel, and Python is never told: it is listed as alive for ever."""
    ctypes.CDLL(None).syscall(EXIT[platform.machine()], 0)


def interpreter(_task: Any) -> None:
    """A call into a library that never gives the interpreter back: no other thread runs Python any more."""
    ctypes.PyDLL(None).sleep(LONG_S)


def ready(task: Any) -> None:
    """From now on all waits of the task end at once, and there is nothing to do: it turns round and round."""
    if hasattr(task, "_selector"):  # a descriptor is ready for ever, and nobody's
        reading, writing = os.pipe()
        os.write(writing, b"!")
        task._selector.register(reading, selectors.EVENT_READ)
    else:  # the port is said to be ready for ever, and has no bytes
        task._link.read = lambda _timeout_s: b""


def due(task: Any) -> None:
    """From now on something is due for ever and never done: the task turns round and round."""
    if hasattr(task, "_carry_out_poll"):  # a poll, of a master
        task._carry_out_poll, task._wait_s = lambda _line: False, lambda: 0.0
    elif hasattr(task, "_due_s"):  # the end of a silence, on a serial slave
        task._due_s = lambda now_s: now_s
    else:
        task._wait_s = lambda *_: 0.0


def journal(_task: Any) -> None:
    """The thread hangs while it logs, since whoever reads the log takes nothing: all others who log hang as well."""
    _reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writing, bytes(select.PIPE_BUF))
    os.set_blocking(writing, True)
    os.dup2(writing, sys.stderr.fileno())
    logging.getLogger("gateway").error("nobody reads this")


def register(task: Any) -> None:
    """The thread hangs while it holds the one lock that all others need."""
    task._register._lock.acquire()
    os.read(os.pipe()[0], 1)


FAULTS: Final[dict[str, Callable[[Any], None]]] = {
    fault.__name__: fault
    for fault in (deadlock, loop, blocked, leave, vanish, interpreter, ready, due, journal, register)
}
