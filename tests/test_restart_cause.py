"""Why the gateway was started last, over runs that end well, badly, in a hang and in a power cut; and the row of bad
restarts that ends in safe mode.

A station here is what ``running`` makes of it: SAFE_AFTER bad restarts in a row and it runs in safe mode.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import random
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.restart_cause import (
    END_LIMIT_S,
    FILE,
    HUNG_LIMIT_S,
    LARGEST_FILE,
    SAFE_AFTER,
    LastRun,
    was_reset_by_watchdog,
)
from gateway.stacks import SUSPECTS_MOST, Evidence
from tests.lines import CLOCK, PATIENCE_S

HANG = Evidence(True, "Timeout (0:00:10)!", ("scada",), ("Timeout (0:00:10)!", "scada (0x7f01), newest call last:"))
FATAL = Evidence(
    False, "Fatal Python error: Segmentation fault", ("scada",), ("Fatal Python error: Segmentation fault",)
)
BAD_ENDS: dict[str, Callable[[LastRun], object]] = {
    "crash": lambda run: None,
    "hang of field": lambda run: run.hung(["field"]),
}


def a_run(state: Path, boot: str = "boot 1", was_reset: bool = False) -> LastRun:
    boot_id = state / "boot_id"
    boot_id.write_text(f"{boot}\n")
    return LastRun(state, boot_id, lambda: was_reset)


def cause(run: LastRun, evidence: Evidence | None = None) -> str:
    return run.begin(evidence).cause.words(str)


def settled(run: LastRun) -> LastRun:
    """Return *run* once all that it has to write is written."""
    for thread in threading.enumerate():
        if thread.name == "last run":
            thread.join(PATIENCE_S)
            assert not thread.is_alive()
    return run


# ------------------------------------------------------------------------------------------------ why


def test_the_first_run_of_all_says_so(tmp_path: Path) -> None:
    beginning = a_run(tmp_path).begin()
    assert (beginning.cause.words(str), beginning.bad_in_row) == ("first start", 0)


@pytest.mark.parametrize("how", ["clean stop", "restart by the menu"])
@pytest.mark.parametrize("boot", ["boot 1", "boot 2"])
@pytest.mark.parametrize("evidence", [None, HANG, FATAL])
def test_a_run_that_ended_well_is_told_as_it_ended_whatever_became_of_the_machine(
    tmp_path: Path, how: str, boot: str, evidence: Evidence | None
) -> None:
    run = a_run(tmp_path)
    run.begin()
    run.end(how)
    assert cause(a_run(tmp_path, boot, was_reset=True), evidence) == how


@pytest.mark.parametrize(
    ("boot", "was_reset", "hung", "evidence", "told"),
    [
        ("boot 1", False, [], None, "crash"),
        ("boot 1", True, [], None, "crash"),  # the driver speaks of the boot, and this is not the first run in it
        ("boot 1", False, [], FATAL, "crash"),
        ("boot 1", False, ["field"], None, "hang of field"),
        ("boot 1", False, ["field", "plant"], None, "hang of field, plant"),
        ("boot 1", False, [], HANG, "hang of scada"),
        ("boot 1", False, ["field"], HANG, "hang of field"),  # the supervisor knows better than the stacks
        ("boot 1", False, [""], None, "hang of "),
        ("boot 2", False, [], None, "power"),
        ("boot 2", False, [], FATAL, "power"),
        ("boot 2", True, [], None, "watchdog reset"),
        ("boot 2", False, ["field"], None, "watchdog reset after a hang of field"),
        ("boot 2", True, ["field"], None, "watchdog reset after a hang of field"),
        ("boot 2", False, [], HANG, "watchdog reset after a hang of scada"),
    ],
)
def test_a_run_without_an_end_is_told_by_its_marks_its_evidence_and_what_became_of_the_machine(
    tmp_path: Path, boot: str, was_reset: bool, hung: list[str], evidence: Evidence | None, told: str
) -> None:
    run = a_run(tmp_path)
    run.begin()
    if hung:
        run.hung(hung)
    beginning = a_run(tmp_path, boot, was_reset).begin(evidence)
    assert (beginning.cause.words(str), beginning.bad_in_row) == (told, 1)
    assert cause(a_run(tmp_path, boot)) == "crash"  # a mark is about one run


def test_a_hang_that_nothing_is_known_of_is_told_all_the_same(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    run.begin()
    run.hung([])
    assert cause(a_run(tmp_path)) == "hang of unknown"


def test_a_boot_identifier_that_cannot_be_read_makes_no_power_cut(tmp_path: Path) -> None:
    for state, order in ((tmp_path / "a", ("known", "")), (tmp_path / "b", ("", "known"))):
        state.mkdir()
        for boot in order:
            run = LastRun(state, tmp_path / "nowhere") if not boot else a_run(state, boot)
            told = cause(run)
        assert told == "crash"


def test_what_a_watchdog_tells_only_when_it_is_open_makes_a_power_cut_its_reset(tmp_path: Path) -> None:
    a_run(tmp_path).begin()
    run = a_run(tmp_path, "boot 2")
    assert cause(run) == "power"
    assert run.reset_by_watchdog().words(str) == "watchdog reset"
    assert run.reset_by_watchdog().words(str) == "watchdog reset"


@pytest.mark.parametrize("way", ["first start", "clean stop", *BAD_ENDS])
def test_it_makes_no_other_cause_its_reset(tmp_path: Path, way: str) -> None:
    if way != "first start":
        run = a_run(tmp_path)
        run.begin()
        if way in BAD_ENDS:
            BAD_ENDS[way](run)
        else:
            run.end(way)
    run = a_run(tmp_path)
    run.begin()
    assert run.reset_by_watchdog().words(str) == way


def test_the_evidence_of_the_run_before_goes_to_the_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    a_run(tmp_path).begin(FATAL)
    a_run(tmp_path).begin(HANG)
    assert [record.getMessage() for record in caplog.records] == [
        "the run before: Fatal Python error: Segmentation fault",
        "the run before: Timeout (0:00:10)!",
        "the run before: scada (0x7f01), newest call last:",
    ]
    assert all(record.__dict__["is_unlimited"] for record in caplog.records)


@pytest.mark.parametrize(("evidence", "told"), [(HANG, "hang of scada"), (FATAL, "crash")])
def test_evidence_counts_where_nothing_else_could_be_kept(
    tmp_path: Path, evidence: Evidence, told: str, caplog: pytest.LogCaptureFixture
) -> None:
    beginning = LastRun(tmp_path / "nowhere").begin(evidence)
    assert (beginning.cause.words(str), beginning.bad_in_row) == (told, 1)


@pytest.mark.parametrize(
    ("statuses", "was_reset"),
    [
        ({}, False),
        ({"watchdog0": "0\n"}, False),
        ({"watchdog0": "32\n"}, True),
        ({"watchdog0": "31\n", "watchdog1": "33\n"}, True),
        ({"watchdog0": "65503\n"}, False),  # all bits but that one
        ({"watchdog0": "", "watchdog1": "-32", "watchdog2": "0x20", "watchdog3": "ja", "watchdog4": "٣٢"}, False),
    ],
)
def test_the_drivers_say_whether_a_watchdog_has_reset_the_machine(
    tmp_path: Path, statuses: dict[str, str], was_reset: bool
) -> None:
    for name, status in statuses.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "bootstatus").write_text(status)
    assert was_reset_by_watchdog(tmp_path) is was_reset


def test_drivers_that_say_nothing_have_reset_nothing(tmp_path: Path) -> None:
    (tmp_path / "watchdog0").mkdir()
    (tmp_path / "watchdog1" / "bootstatus").mkdir(parents=True)
    (tmp_path / "watchdog2").mkdir()
    os.mkfifo(tmp_path / "watchdog2" / "bootstatus")
    assert not was_reset_by_watchdog(tmp_path)
    assert not was_reset_by_watchdog(tmp_path / "nowhere")


# ------------------------------------------------------------------------------------------------ the row


class Station:
    """Runs, one after the other; ``rows`` are their bad restarts in a row. Each event happens in the present run."""

    def __init__(self, state: Path) -> None:
        self.state, self.boots, self.rows = state, 1, list[int]()
        self.start()

    def start(self) -> None:
        self.run = a_run(self.state, f"boot {self.boots}")
        self.rows.append(self.run.begin().bad_in_row)

    @property
    def is_safe(self) -> bool:
        return self.rows[-1] >= SAFE_AFTER

    def crash(self) -> None:
        settled(self.run)
        self.start()

    def hang(self) -> None:
        self.run.hung(["field"])
        self.crash()

    def power_cut(self) -> None:
        self.boots += 1
        self.crash()

    def clean_stop(self) -> None:
        self.run.end("clean stop")
        self.start()

    def menu_restart(self) -> None:
        self.run.end("restart by the menu")
        self.start()

    def lasts(self) -> None:
        self.run.lasted()

    def is_ended_by_a_person(self) -> None:
        self.run.forgiven()

    def hour_is_over(self) -> None:
        self.run.forgiven(2)

    def after(self, *events: str) -> list[int]:
        """Have *events* happen, one after the other; return the rows of the runs that began with them."""
        count = len(self.rows)
        for event in events:
            getattr(self, event.replace(" ", "_"))()
        return self.rows[count:]


@pytest.fixture
def station(tmp_path: Path) -> Station:
    return Station(tmp_path)


@pytest.fixture
def safe_station(station: Station) -> Station:
    assert station.after("crash", "hang", "power cut") == [1, 2, 3]
    assert station.is_safe
    return station


def test_three_bad_restarts_in_a_row_of_any_kind_are_safe_mode_and_no_more_are_counted(station: Station) -> None:
    assert station.after("crash", "hang") == [1, 2]
    assert not station.is_safe
    assert station.after("power cut") == [3]
    assert station.is_safe
    assert station.after("crash", "hang", "power cut", "crash") == [3, 3, 3, 3]


@pytest.mark.parametrize("how", ["clean stop", "menu restart"])
def test_what_somebody_asked_for_ends_the_row(station: Station, how: str) -> None:
    assert station.after("crash", "crash", how, "crash", "crash", "crash") == [1, 2, 0, 1, 2, 3]


@pytest.mark.parametrize("how", ["clean stop", "menu restart"])
def test_what_somebody_asked_for_ends_safe_mode(safe_station: Station, how: str) -> None:
    assert safe_station.after(how, "crash") == [0, 1]


@pytest.mark.parametrize("how", ["crash", "hang", "power cut"])
def test_a_run_that_has_lasted_ends_the_row_and_its_own_bad_end_does_not_count(station: Station, how: str) -> None:
    assert station.after("crash", "crash", "lasts", how, how) == [1, 2, 0, 1]


@pytest.mark.parametrize("how", ["crash", "hang", "power cut"])
def test_safe_mode_that_ends_badly_is_safe_mode_again(safe_station: Station, how: str) -> None:
    assert safe_station.after(how, how) == [3, 3]


@pytest.mark.parametrize("how", ["crash", "hang", "power cut"])
def test_after_its_hour_one_more_try_that_ends_badly_is_safe_mode_again(safe_station: Station, how: str) -> None:
    assert safe_station.after("hour is over", how) == [3]
    assert safe_station.after("hour is over", "hour is over", how, how) == [3, 3]


@pytest.mark.parametrize("how", ["crash", "hang", "power cut"])
def test_a_try_that_lasts_is_the_end_of_it(safe_station: Station, how: str) -> None:
    assert safe_station.after("hour is over", "lasts", how, how, how) == [0, 1, 2]


def test_whoever_ends_safe_mode_has_three_tries_again(safe_station: Station) -> None:
    assert safe_station.after("is ended by a person", "crash", "crash", "crash") == [1, 2, 3]


@pytest.mark.parametrize(("row", "then"), [(-5, 0), (-1, 0), (0, 1), (1, 2), (2, 3), (3, 3), (10**9, 3)])
def test_whatever_is_forgiven_the_row_stays_within_its_bounds(station: Station, row: int, then: int) -> None:
    station.run.forgiven(row)
    assert station.after("crash") == [then]


def test_no_order_of_events_takes_the_row_out_of_its_bounds(tmp_path: Path) -> None:
    chance = random.Random(7)
    events = "crash", "hang", "power cut", "clean stop", "menu restart", "lasts", "is ended by a person", "hour is over"
    station = Station(tmp_path)
    station.after(*chance.choices(events, k=300))
    assert set(station.rows) == {0, 1, 2, 3}


# ------------------------------------------------------------------------------------------------ the file


@pytest.mark.parametrize(
    ("ended", "boot", "told", "row"),
    [
        ("clean stop", "boot 1", "clean stop", 0),
        ("restart by the menu", "boot 1", "restart by the menu", 0),
        ("", "boot 1", "crash", 1),
        ("", "boot 2", "power", 1),
    ],
)
def test_the_file_of_an_older_version_is_understood(tmp_path: Path, ended: str, boot: str, told: str, row: int) -> None:
    (tmp_path / FILE).write_text(json.dumps({"boot": "boot 1", "ended": ended}))
    beginning = a_run(tmp_path, boot).begin()
    assert (beginning.cause.words(str), beginning.bad_in_row) == (told, row)


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"{", b"[]", b'{"ended": ""}', b"\xff\xfe", b"null", b"0", b'"boot"', b"\0" * 4096),
        *(b"[" * 100_000, b'{"boot": 1, "ended": "clean stop"}', b'{"boot": ["boot 1"], "ended": ""}'),
        b'{"boot": "boot 1", "x": "' + b"x" * LARGEST_FILE + b'", "ended": "clean stop"}',
        b'{"boot": "boot 1", "bad_in_row": ' + b"9" * 10_000 + b"}",
    ],
)
def test_a_damaged_file_counts_as_a_crash(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE).write_bytes(content)
    beginning = a_run(tmp_path).begin()
    assert (beginning.cause.words(str), beginning.bad_in_row) == ("crash", 1)
    assert cause(a_run(tmp_path, "boot 2")) == "power"  # it has been written anew


@pytest.mark.parametrize("ended", ['"cle\\u001b[2Jan"', "true", "1", "[]", '["clean stop"]', "{}", '"crash"', "null"])
def test_an_end_that_was_never_written_by_us_is_none(tmp_path: Path, ended: str) -> None:
    (tmp_path / FILE).write_text(f'{{"boot": "boot 1", "ended": {ended}}}')
    assert cause(a_run(tmp_path)) == "crash"


@pytest.mark.parametrize("row", ["-1", "4", "1e9", "true", "null", '"2"', "[2]", "2.0", "NaN", "Infinity"])
def test_a_row_that_was_never_written_by_us_is_one_bad_restart(tmp_path: Path, row: str) -> None:
    (tmp_path / FILE).write_text(f'{{"boot": "boot 1", "ended": "", "bad_in_row": {row}}}')
    assert a_run(tmp_path).begin().bad_in_row == 1


def test_names_are_kept_and_told_so_that_they_can_be_shown(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    run.begin()
    run.hung(["\x1b[2Jfield", *("\N{GRINNING FACE}" * 100 for _ in range(20))])
    told = cause(a_run(tmp_path))
    assert told.startswith(r"hang of \x1b[2Jfield, " + "\N{GRINNING FACE}")
    assert told.isprintable()
    assert told.count(", ") == SUSPECTS_MOST - 1
    (tmp_path / FILE).write_text(json.dumps({"boot": "boot 1", "hung": [7, "\r\n", None, "x" * 1000, ["y"]] * 9}))
    told = cause(a_run(tmp_path))
    assert told.startswith(r"hang of \r\n, xxx")
    assert len(told) < 1000


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
        lambda inner: (
            st.lists(inner) | st.dictionaries(st.sampled_from(["boot", "ended", "hung", "bad_in_row"]), inner)
        ),
    )
)
def test_whatever_stands_in_the_file_a_run_begins(tmp_path_factory: pytest.TempPathFactory, content: object) -> None:
    state = tmp_path_factory.mktemp("state")
    (state / FILE).write_text(json.dumps(content))
    beginning = a_run(state).begin()
    assert beginning.cause.words(str).isprintable()
    assert 0 <= beginning.bad_in_row <= SAFE_AFTER
    assert cause(a_run(state)) == "crash"


def troubled(state: Path, trouble: str) -> Path:
    if trouble == "missing":
        return state / "nowhere"
    if trouble == "a folder has its name":
        (state / FILE).mkdir()
    elif trouble == "a FIFO has its name":
        os.mkfifo(state / FILE)
    elif trouble == "it leads to a device":
        (state / FILE).symlink_to("/dev/full")
    return state


@pytest.mark.parametrize("trouble", ["missing", "a folder has its name", "a FIFO has its name", "it leads to a device"])
def test_a_file_that_cannot_be_kept_is_told_once_and_lived_without(
    tmp_path: Path, trouble: str, caplog: pytest.LogCaptureFixture
) -> None:
    state = troubled(tmp_path, trouble)
    with caplog.at_level(logging.WARNING):
        run = LastRun(state)
        assert cause(run) == "first start"
        run.lasted()
        run.forgiven()
        run.hung(["field"])
        run.end("clean stop")
    assert caplog.text.count("cannot be kept") == 1


# ------------------------------------------------------------------------------------------------ a slow disk


@contextmanager
def slow_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Semaphore]:
    """Give what lets one flush of the disk after the other come to its end."""
    may_go, real = threading.Semaphore(0), os.fsync

    def fsync(fd: int) -> None:
        assert may_go.acquire(timeout=2 * PATIENCE_S)
        real(fd)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", fsync)
        try:
            yield may_go
        finally:
            may_go.release(100)
            settled_all()


def settled_all() -> None:
    for thread in threading.enumerate():
        if thread.name == "last run":
            thread.join(PATIENCE_S)


def test_a_slow_disk_holds_up_nobody_who_says_that_a_run_has_lasted_and_the_newest_comes_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = a_run(tmp_path)
    run.begin()
    with slow_disk(monkeypatch):
        began_s = CLOCK.monotonic()
        run.lasted()
        run.forgiven(1)
        run.forgiven(0)
        assert CLOCK.monotonic() - began_s < 0.5
    assert a_run(tmp_path).begin().bad_in_row == 1


def test_a_disk_that_does_not_answer_holds_up_the_exit_after_a_hang_for_two_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = a_run(tmp_path)
    run.begin()
    with slow_disk(monkeypatch):
        began_s = CLOCK.monotonic()
        run.hung(["field"])
        assert 0.9 * HUNG_LIMIT_S < CLOCK.monotonic() - began_s < HUNG_LIMIT_S + 0.5
    assert cause(a_run(tmp_path)) == "hang of field"  # it had two flushes to wait for, and got them


def test_a_hang_whose_mark_is_kept_holds_up_the_exit_no_longer(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    run.begin()
    began_s = CLOCK.monotonic()
    run.hung(["field"])
    assert CLOCK.monotonic() - began_s < 0.5 * HUNG_LIMIT_S
    assert json.loads((tmp_path / FILE).read_bytes())["hung"] == ["field"]


def test_a_hang_is_marked_even_where_there_is_no_thread_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_thread(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    run = a_run(tmp_path)
    run.begin()
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", no_thread)
        run.hung(["field"])
    assert cause(a_run(tmp_path)) == "hang of field"


def test_an_end_comes_after_what_is_still_being_written_and_is_given_up_where_the_disk_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run = a_run(tmp_path)
    run.begin()
    run.lasted()
    run.end("clean stop")
    run = a_run(tmp_path)
    assert cause(run) == "clean stop"
    with slow_disk(monkeypatch):
        run.lasted()
        began_s = CLOCK.monotonic()
        run.end("clean stop")
        assert CLOCK.monotonic() - began_s < END_LIMIT_S + 0.5
    assert "cannot be kept: the disk does not answer" in caplog.text
    assert cause(a_run(tmp_path)) == "clean stop"  # late, since this process lives on


def test_on_a_full_disk_what_the_old_file_says_is_not_told_of_a_later_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = a_run(tmp_path)
    run.begin()
    run.end("clean stop")
    make = os.open

    def full(path: str | Path, flags: int, mode: int = 0o777) -> int:
        if flags & os.O_CREAT:
            raise OSError(errno.ENOSPC, "full")
        return make(path, flags, mode)

    monkeypatch.setattr(os, "open", full)
    rows = [LastRun(tmp_path, tmp_path / "boot_id").begin() for _ in range(4)]
    assert [one.cause.words(str) for one in rows] == ["clean stop", "crash", "crash", "crash"]
    assert [one.bad_in_row for one in rows] == [0, 1, 2, SAFE_AFTER]
