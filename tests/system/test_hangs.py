"""The table of hangs: tasks times ways to hang, each provoked in the real process (spec section 7; `tests/hanging`).

Every figure is the worst of its runs, from the moment of the fault. It was noticed when the log says so or, where none
is left to log it, when the process has ended. The limit is `watchdog.timeout` and one tick, and ``ALLOWED_S`` for the
measuring: the test hears of it by a pipe, and three gateways and their devices share the machine.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from tests.hanging.bench import MASTER, SOUND, Plant, a_run, plants
from tests.hanging.faults import SUPERVISOR
from tests.hanging.table import (
    LAST_WORDS_S,
    NO_WAYS,
    TASKS,
    WAYS,
    WAYS_OF_SUPERVISOR,
    Case,
    Outcome,
    assert_all_well,
    limit_s,
    provoke_all,
    stopped_badly,
)

RUNS = int(os.environ.get("RTUGATE_HANG_RUNS", "5"))
SIDE_BY_SIDE = 2  # as many as the least machine has cores: one of the ways is to use one up
TIMEOUT_S = 2.0
ALLOWED_S = 0.3
FED_EVERY_S = 1.5  # the device is fed once a second
Record = Callable[[str, object], None]


@pytest.fixture(scope="module")
def wired() -> Iterator[list[Plant]]:
    with plants(SIDE_BY_SIDE) as made:
        yield made


def all_runs(who: str, kind: str) -> list[Case]:
    return [Case(who, kind, number, RUNS) for number in range(RUNS)]


def record(outcomes: Sequence[Outcome], record_property: Record) -> None:
    """Put one line of the table into the figures for each way to hang."""
    for kind, words in WAYS.items():
        runs = [outcome for outcome in outcomes if outcome.case.kind == kind]
        noticed_s = [run.noticed_s for run in runs if run.noticed_s is not None]
        ended_s = [run.ended_s for run in runs if run.ended_s is not None]
        if runs:
            worst = f"noticed after {max(noticed_s, default=0):.2f} s at worst, limit {limit_s(TIMEOUT_S):.1f} s"
            ended = f", process ended after {max(ended_s):.2f} s" if ended_s else ""
            record_property(words, f"{len(noticed_s)} of {len(runs)} {worst}{ended}")


@pytest.mark.parametrize("who", TASKS)
def test_a_hang_in_any_way_is_noticed_within_the_timeout_and_one_tick_and_told(
    who: str, wired: list[Plant], tmp_path: Path, record_property: Record
) -> None:
    cases = [case for kind in WAYS if (who, kind) not in NO_WAYS for case in all_runs(who, kind)]
    outcomes = provoke_all(cases, wired, tmp_path, TIMEOUT_S, ALLOWED_S)
    record(outcomes, record_property)
    assert_all_well(outcomes)


def test_a_hang_of_the_supervisor_itself_is_noticed_just_as_soon(
    wired: list[Plant], tmp_path: Path, record_property: Record
) -> None:
    cases = [case for kind in WAYS_OF_SUPERVISOR for case in all_runs(SUPERVISOR, kind)]
    outcomes = provoke_all(cases, wired, tmp_path, TIMEOUT_S, ALLOWED_S)
    record(outcomes, record_property)
    assert_all_well(outcomes)


def test_without_a_fault_the_same_program_is_fed_runs_on_and_stops_cleanly(
    wired: list[Plant], tmp_path: Path, record_property: Record
) -> None:
    with a_run(wired[0], tmp_path, TIMEOUT_S) as run:
        run.commit("nobody", "deadlock")
        assert not run.watch(lambda: run.ended_s is not None, 5 * TIMEOUT_S), run.said
        gaps_s = [after.at_s - before.at_s for before, after in zip(run.fed, run.fed[1:], strict=False)]
        record_property("longest time between two feedings", f"{max(gaps_s):.2f} s")
        assert max(gaps_s) < FED_EVERY_S
        assert stopped_badly(run) == []


@pytest.mark.parametrize(("lock", "ticks"), [("journal", 2), ("register", 1)])
def test_whoever_hangs_with_a_lock_that_all_need_is_noticed_and_named(
    lock: str, ticks: int, wired: list[Plant], tmp_path: Path, record_property: Record
) -> None:
    """Whoever logs the hang hangs in the log himself; the backstop then takes its own time."""
    with a_run(wired[0], tmp_path, TIMEOUT_S) as run:
        run.commit(MASTER, lock)
        assert run.watch(lambda: run.ended_s is not None, 4 * TIMEOUT_S), run.said
        assert run.ended_s is not None
        record_property("ended after", f"{run.ended_s - run.fault_s:.2f} s")
        assert run.process.returncode > 0
        assert run.ended_s - run.fault_s < ticks * limit_s(TIMEOUT_S) + ALLOWED_S + LAST_WORDS_S
        assert "V" not in run.food
    with a_run(wired[0], tmp_path, TIMEOUT_S, SOUND) as run:
        told = run.status()["last_restart"]
        record_property("the next start says", told)
        assert told.startswith("hang of ")
        assert MASTER in told.removeprefix("hang of ").split(", ")
