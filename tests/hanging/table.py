"""One fault in one run, and all that is wrong with how it was noticed (spec section 7); and many such runs at once.

A hang ends the process; a thread that has ended is made anew, and nobody else may feel it.
"""

from __future__ import annotations

import contextlib
import queue
import select
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from gateway.wiring import SERIAL_CONSOLE, TELNET
from tests.hanging.bench import MASTER, OPEN_WORDS, SERIAL_SLAVE, SOUND, TCP_SLAVE, THREADS, Plant, Run, a_run, asks
from tests.hanging.faults import SUPERVISOR
from tests.lines import RawClient, raw_client

TASKS: Final = (MASTER, TCP_SLAVE, SERIAL_SLAVE, SERIAL_CONSOLE, TELNET)
WAYS: Final = {  # faults, in words
    "deadlock": "deadlock",
    "loop": "endless loop",
    "blocked": "blocked call",
    "leave": "dead thread (SystemExit)",
    "vanish": "dead thread (that Python believes alive)",
    "interpreter": "call that holds the interpreter",
    "ready": "flag without progress (ready for ever)",
    "due": "flag without progress (due for ever)",
}
NO_WAYS: Final = {(MASTER, "ready")}  # then it goes on: its requests fail in time, and its devices are offline
WAYS_OF_SUPERVISOR: Final = ("deadlock", "loop", "blocked", "interpreter")
NEVER_S: Final = 10.0  # beyond the limit: what has not been noticed by then never is
LAST_WORDS_S: Final = 2.5  # from noticing to the end: the stacks go into the log, the cause to the disk, which has 2 s
EXACT_S: Final = 0.1  # a feeding and a line of the log come by two pipes


def tick_s(timeout_s: float) -> float:
    """How often the flags are looked at."""
    return min(1.0, timeout_s / 10)


def limit_s(timeout_s: float) -> float:
    """Within what a hang has to be noticed."""
    return timeout_s + tick_s(timeout_s)


@dataclass(frozen=True)
class Case:
    """One fault in one run."""

    who: str  # a task, or the supervisor
    kind: str  # of the fault
    number: int = 0  # of the run; the first is followed by another start, which has to know why
    of: int = 1  # so many runs: each comes at another place between two ticks


@dataclass(frozen=True)
class Outcome:
    """How a fault was noticed."""

    case: Case
    noticed_s: float | None  # after the fault: what the log says, or the end of the process where that says nothing
    ended_s: float | None  # after the fault: the end of the process, if it has to end
    wrong: list[str]


def provoke(case: Case, plant: Plant, folder: Path, timeout_s: float, allowed_s: float) -> Outcome:
    """Have a gateway of its own commit the fault; *allowed_s*: for the measuring itself."""
    noticed_s = ended_s = None
    wrong: list[str] = []
    try:
        with a_run(plant, folder, timeout_s) as run:
            run.watch(bool, tick_s(timeout_s) * case.number / case.of)
            fault = _end_of_thread if case.kind == "leave" else _hang
            noticed_s, ended_s = (None if at_s is None else at_s - run.fault_s for at_s in fault(case, run, wrong))
        if not case.number and case.kind != "leave":
            _next_start(case, plant, folder, timeout_s, wrong)
    except (AssertionError, OSError) as error:
        wrong.append(repr(error))
    wrong += _too_late_or_early(case, noticed_s, ended_s, timeout_s, allowed_s)
    return Outcome(case, noticed_s, ended_s, [f"{case.who}, {case.kind}, run {case.number}: {what}" for what in wrong])


def _too_late_or_early(
    case: Case, noticed_s: float | None, ended_s: float | None, timeout_s: float, allowed_s: float
) -> list[str]:
    wrong = []
    if noticed_s is None or noticed_s > limit_s(timeout_s) + allowed_s:
        wrong.append(f"noticed after {noticed_s} s")
    if ended_s is not None and ended_s > limit_s(timeout_s) + allowed_s + LAST_WORDS_S:
        wrong.append(f"ended after {ended_s} s")
    if noticed_s is not None and case.kind != "leave" and noticed_s < timeout_s - 2 * tick_s(timeout_s) - EXACT_S:
        wrong.append(f"noticed after {noticed_s} s already: that is something else")
    return wrong


def provoke_all(
    cases: Sequence[Case], plants: Sequence[Plant], folder: Path, timeout_s: float, allowed_s: float
) -> list[Outcome]:
    """Provoke them all, so many at once as there are plants."""
    free: queue.SimpleQueue[Plant] = queue.SimpleQueue()
    for plant in plants:
        free.put(plant)

    def work(case: Case) -> Outcome:
        plant = free.get()
        try:
            name = f"{case.who}-{case.kind}-{case.number}".replace(" ", "-")
            return provoke(case, plant, folder / name, timeout_s, allowed_s)
        finally:
            free.put(plant)

    with ThreadPoolExecutor(len(plants)) as pool:
        return list(pool.map(work, cases))


def assert_all_well(outcomes: Sequence[Outcome]) -> None:
    """Fail with all that is wrong with any of them."""
    wrong = [what for outcome in outcomes for what in outcome.wrong]
    assert not wrong, "\n\n".join(wrong)


# ------------------------------------------------------------------------------------------------ a hang


Moments = tuple[float | None, float | None]  # when the fault was noticed; when the process ended, if it has to


def _hang(case: Case, run: Run, wrong: list[str]) -> Moments:
    run.commit(case.who, case.kind)
    if not run.watch(lambda: run.is_over, limit_s(run.timeout_s) + NEVER_S):
        wrong.append(f"the process goes on; log:\n{run.said}")
        return None, None
    if run.process.returncode <= 0:
        wrong.append(f"exit code {run.process.returncode}")
    if "V" in run.food:
        wrong.append("the watchdog device was told not to reset the machine")
    if not _is_logged(case):
        return run.ended_s, run.ended_s
    return _told_in_the_log(case, run, wrong), run.ended_s


def _is_logged(case: Case) -> bool:
    """Whether somebody is left to log it; else the next start names all who were in no wait, the right one included."""
    return case.who != SUPERVISOR and case.kind != "interpreter"


def _told_in_the_log(case: Case, run: Run, wrong: list[str]) -> float | None:
    """The supervisor itself has noticed: it names the task, shows all stacks, and feeds the device no more."""
    told = run.first(lambda line: line.startswith(f"CRITICAL {case.who}: got on with nothing for"))
    if told is None:
        wrong.append(f"the log does not name the task:\n{run.said}")
        return None
    stacks = run.said.partition(told.text)[2]
    missing = [name for name in THREADS if name not in stacks]
    if missing:
        wrong.append(f"no stacks of {missing} in the log:\n{run.said}")
    if case.kind not in ("ready", "due", "vanish") and f"in {case.kind}" not in stacks:
        wrong.append(f"the log does not show where it hangs:\n{run.said}")
    if run.fed[-1].at_s > told.at_s + EXACT_S:
        wrong.append("the watchdog device was fed after the hang was noticed")
    return told.at_s


def _next_start(case: Case, plant: Plant, folder: Path, timeout_s: float, wrong: list[str]) -> None:
    """The next start says why; and it stops cleanly, watchdog included."""
    with a_run(plant, folder, timeout_s, SOUND) as run:
        told = run.status()["last_restart"]
        head, _, names = told.partition("hang of ")
        if head or case.who not in names.split(", ") or (_is_logged(case) and names != case.who):
            wrong.append(f"the status says {told!r}")
        if f"last restart: {told}" not in run.said:
            wrong.append(f"the next start does not know why:\n{run.said}")
        if case.kind == "interpreter" and "in interpreter" not in run.said:
            wrong.append(f"the next start does not show where it hung:\n{run.said}")
        wrong += stopped_badly(run)


def stopped_badly(run: Run) -> list[str]:
    """Stop it; return what is wrong with that."""
    wrong = []
    if (code := run.stop()) != 0:
        wrong.append(f"a clean stop ends with {code}:\n{run.said}")
    if run.food.find("V") != len(run.food) - 1:
        wrong.append(f"a clean stop leaves the watchdog device with {run.food[-10:]!r}")
    return wrong


# ------------------------------------------------------------------------------------------------ a thread that ends


def _end_of_thread(case: Case, run: Run, wrong: list[str]) -> Moments:
    """Its task is made anew; the others go on, and their connections last."""
    with _connections(case, run.plant) as others:
        run.commit(case.who, case.kind)
        if not run.watch(lambda: run.first(partial(_is_end_of, case.who)), limit_s(run.timeout_s) + NEVER_S):
            wrong.append(f"the log does not say that the task is made anew:\n{run.said}")
            return None, None
        _made_anew(case, run)
        wrong += [f"a client of {name} was let go" for name, is_served in others.items() if not is_served()]
    wrong += [f"{name} does not work" for name, works in _work(run).items() if not works()]
    wrong += [
        f"made anew as well: {words}"
        for words in OPEN_WORDS
        if run.said.count(words) != 1 + words.startswith(f"{case.who}:")
    ]
    if run.ended_s is not None or "CRITICAL" in run.said:
        wrong.append(f"it is taken for a hang:\n{run.said}")
    wrong += stopped_badly(run)
    told = run.first(partial(_is_end_of, case.who))
    return None if told is None else told.at_s, None


def _is_end_of(who: str, line: str) -> bool:
    return line.startswith(f"ERROR {who}: ended")


def _made_anew(case: Case, run: Run) -> None:
    """Wait until the task is at work again."""
    if case.who == MASTER:
        run.wait_until(run.plant.is_polled(), "polled again")
        return
    (words,) = (words for words in OPEN_WORDS if words.startswith(f"{case.who}:"))
    run.wait_until(lambda: run.said.count(words) == 2, f"{words} again")


@contextlib.contextmanager
def _connections(case: Case, plant: Plant) -> Iterator[dict[str, Callable[[], bool]]]:
    """Give, for each task but the one of *case*, whether a connection from before the fault is still served."""
    with raw_client(plant.scada_port) as scada, raw_client(plant.telnet_port) as telnet:
        assert asks(scada)
        assert telnet.receive(1)
        known = {TCP_SLAVE: partial(asks, scada), TELNET: partial(_answers_key, telnet)}
        yield {name: is_served for name, is_served in known.items() if name != case.who}


def _answers_key(client: RawClient) -> bool:
    while select.select([client.socket], [], [], 0)[0] and client.socket.recv(4096):
        pass  # what it was shown before
    client.send(b"?")
    return client.receive(1) != b""


def _work(run: Run) -> dict[str, Callable[[], bool]]:
    """Return what tells whether each task does what it is for."""
    plant = run.plant
    return {
        MASTER: lambda: run.watch(plant.is_polled()),
        TCP_SLAVE: plant.serves_scada,
        SERIAL_SLAVE: plant.serves_plc,
        SERIAL_CONSOLE: plant.shows_menu,
        TELNET: plant.lets_in,
    }
