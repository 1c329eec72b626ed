"""An hour on the virtual board, with its processor at its limit and its clock jumping by years: nothing is tripped.

Two programs that only compute run for each core, at the gateway's own priority; field devices are polled and an upper
master is served all the while. $RTUGATE_HOUR_S makes the hour shorter for a trial. What it needs: see ``test_board``.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator
from itertools import cycle
from typing import Final

import pytest

from tests.system.board.station import EVERY_S, Station, station

Record = Callable[[str, object], None]

HOUR_S: Final = float(os.environ.get("RTUGATE_HOUR_S", "3600"))
JUMP_EVERY_S: Final = 60.0
ASK_EVERY_S: Final = 1.0
HOGS_EACH: Final = 2  # programs for each core
JUMPS: Final = (  # what the board's clock is set to, in turn
    "2037-12-31 23:59:30",
    "1970-01-02 00:00:00",
    "2026-06-01 12:00:00",
    "2031-02-28 23:59:50",
    "2021-12-31 23:59:50",
    "2000-02-29 00:00:00",
)
START: Final = ("MainPID", "NRestarts", "ActiveState", "ActiveEnterTimestampMonotonic")


@pytest.fixture
def board(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    with station(tmp_path_factory.mktemp("hour")) as made:
        made.settle()
        yield made


class Upper:
    """The upper master's hour: how often it asked, how long it waited, how often in vain."""

    def __init__(self, board: Station) -> None:
        self._board = board
        self.waited_s: list[float] = []
        self.unanswered = 0

    def ask(self) -> None:
        begun_s = time.monotonic()
        values = self._board.ask()
        self.waited_s.append(time.monotonic() - begun_s)
        self.unanswered += len(values) != 4


def load(board: Station) -> int:
    """Have the board's processor at its limit from now on; return how many programs do so."""
    count = HOGS_EACH * int(board.machine.do("nproc"))
    for number in range(count):
        board.machine.do(f"systemd-run --quiet --unit=hog{number} sh -c 'while :; do :; done'")
    return count


def jump(board: Station, to: str) -> int:
    """Set the board's clock; return by how many seconds that moved it."""
    before, after = board.machine.do(f"date +%s; date --utc --set='{to}' >/dev/null; date +%s").split()
    return int(after) - int(before)


def test_nothing_is_tripped_by_an_hour_of_full_load_and_clock_jumps_of_years(
    board: Station, record_property: Record
) -> None:
    machine, upper = board.machine, Upper(board)
    start, boot_id = board.show(*START), machine.boot_id
    devices = (board.meter, board.boiler)
    polled = [device.served for device in devices]
    record_property("programs that only compute", load(board))
    jumps: list[int] = []
    for device in devices:
        device.forget()
    begun_s = time.monotonic()
    for to in cycle(JUMPS):
        if time.monotonic() - begun_s >= HOUR_S:
            break
        jumps.append(jump(board, to))
        end_s = time.monotonic() + min(JUMP_EVERY_S, HOUR_S)
        while time.monotonic() < end_s:
            upper.ask()
            machine.watch(lambda: False, ASK_EVERY_S)
    passed_s = time.monotonic() - begun_s
    gaps_s = [device.longest_s for device in devices]
    record_property("seconds, clock jumps, the farthest in years", told(passed_s, len(jumps), years(jumps)))
    counts = [device.served - count for device, count in zip(devices, polled, strict=True)]
    record_property("polls of meter and boiler; due each", told(*counts, passed_s / EVERY_S))
    record_property("longest time between two polls", f"{max(gaps_s):.2f} s, with one due each {EVERY_S:g} s")
    asked = upper.waited_s
    record_property("mbpoll asked, unanswered", told(len(asked), upper.unanswered))
    record_property("mbpoll waited, median and longest, s", f"{statistics.median(asked):.2f}, {max(asked):.2f}")
    check_untripped(board, start, boot_id)
    board.wait_polling()
    board.wait_served()


def check_untripped(board: Station, start: dict[str, str], boot_id: str) -> None:
    """Nothing was restarted, nothing was reset, and nobody complains."""
    machine = board.machine
    assert machine.resets == []
    assert machine.do("cat /proc/sys/kernel/random/boot_id") == boot_id == machine.boot_id
    assert board.show(*START) == start
    assert start["NRestarts"] == "0"
    complaints = machine.do("journalctl --boot --unit=rtugate.service --priority=err --no-pager --quiet --output=cat")
    assert complaints == ""
    told_ = board.status()
    assert told_["alarms"] == []
    assert [master["offline_units"] for master in told_["masters"]] == [[], []]
    assert [request["state"] for master in told_["masters"] for request in master["requests"]] == ["good", "good"]


def years(jumps: list[int]) -> float:
    return max(map(abs, jumps)) / (365.25 * 86400)


def told(*figures: float) -> str:
    return ", ".join(f"{figure:.0f}" for figure in figures)
