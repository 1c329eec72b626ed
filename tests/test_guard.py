"""The guard: what it tells the hardware, systemd and the next start, while all is well, at a hang and at the end.

The hardware is a fake kernel that resets a fake machine (``watchdogs``), and once a FIFO; systemd is a real socket.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest

from gateway import guard as guard_module
from gateway.guard import HUNG_EXIT, LONG_S, SLOW_STOP_S
from gateway.hmi.station import Told
from gateway.restart_cause import LastRun
from gateway.supervisor import STOP_LIMIT_S
from gateway.watchdog import WatchdogDevice
from tests.fakes import JumpingClock
from tests.guards import DEVICE, WATCHDOG_S, LeftError, Notified, StillBench, Whole, a_fifo
from tests.lines import PATIENCE_S
from tests.tasks import Deaf, running
from tests.watchdogs import CARD_RESET, KernelWatchdog

WELL = f"{DEVICE}: well; without us it resets the machine after 30 s"


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[Notified]:
    made = Notified(tmp_path / "notify")
    yield made
    made.close()


@pytest.fixture
def it(tmp_path: Path, clock: JumpingClock, systemd: Notified, monkeypatch: pytest.MonkeyPatch) -> Iterator[StillBench]:
    kernel = KernelWatchdog(clock)
    fake = partial(WatchdogDevice, calls=kernel, classes=tmp_path / "no classes")
    monkeypatch.setattr(guard_module, "WatchdogDevice", fake)
    made = StillBench(tmp_path, clock, systemd, kernel)
    yield made
    made.guard.close()


# ------------------------------------------------------------------------------------------------ the device


def test_the_device_is_opened_only_once_all_tasks_have_raised_their_first_flags(it: StillBench) -> None:
    it.configure()
    it.tick_for(100.0)
    assert (it.kernel.opens, it.kernel.is_counting) == ([], False)
    assert it.state() == f"{DEVICE}: not opened yet; that comes when all lines have begun"
    it.begin()
    assert len(it.kernel.opens) == 1
    assert (it.kernel.timeout_s, it.state(), it.alarms()) == (30, WELL, [])


def test_it_is_fed_at_each_tick(it: StillBench) -> None:
    it.configure()
    it.begin()
    pings = it.kernel.pings
    it.tick_for(1000.0)
    assert it.kernel.pings >= pings + 999
    assert not it.kernel.has_reset_machine


def test_it_is_fed_on_while_a_task_is_made_anew_but_not_while_a_flag_has_still_to_come(it: StillBench) -> None:
    it.configure()
    it.begin()
    pings = it.kernel.pings
    it.still.flags = False
    it.guard.tick()
    assert it.kernel.pings == pings
    it.begin()
    assert it.kernel.pings == pings + 1


def test_a_clean_end_stops_it(it: StillBench) -> None:
    it.configure()
    it.begin()
    it.guard.close()
    assert (it.kernel.is_counting, it.kernel.written, it.kernel.open_fds) == (False, b"V", set())
    assert it.backstop.is_closed


def test_after_a_hang_nothing_is_fed_or_armed_any_more_and_nobody_is_told_that_all_is_well(it: StillBench) -> None:
    it.configure()
    it.still.ready = True
    it.begin()
    it.systemd.told()
    armed = list(it.backstop.armed_s)
    it.hang("field")
    pings = it.kernel.pings
    for _ in range(40):
        assert it.guard.tick() == LONG_S
        it.clock.pass_s(1.0)
    assert (it.kernel.pings, b"V" in it.kernel.written, it.kernel.has_reset_machine) == (pings, False, True)
    assert (it.systemd.told(), it.backstop.armed_s) == ([], armed)


def test_another_device_takes_the_place_of_the_old_one_which_is_stopped(it: StillBench) -> None:
    it.configure()
    it.begin()
    it.configure(device="/dev/watchdog1")
    assert (it.kernel.written, it.kernel.is_counting, it.kernel.open_fds) == (b"V", False, set())
    assert it.state() == "/dev/watchdog1: not opened yet; that comes when all lines have begun"
    it.guard.tick()
    assert (it.kernel.is_counting, it.state()) == (True, WELL.replace(DEVICE, "/dev/watchdog1"))


def test_another_timeout_of_the_device_is_set_by_opening_it_anew(it: StillBench) -> None:
    it.configure()
    it.begin()
    it.configure(device_timeout=60)
    it.guard.tick()
    assert (it.kernel.written, it.kernel.timeout_s, len(it.kernel.opens)) == (b"V", 60, 2)
    assert it.state() == WELL.replace("30", "60")


def test_the_same_settings_do_not_touch_it(it: StillBench) -> None:
    it.configure()
    it.begin()
    for timeout_s in (10.0, 5.0, 5.0):
        it.configure(timeout=timeout_s)
        it.guard.tick()
    assert (len(it.kernel.opens), it.kernel.written, it.state()) == (1, b"", WELL)
    assert (it.supervisor.timeout_s, it.backstop.armed_s[-1]) == (5.0, 5.0)


def test_a_device_that_is_not_wanted_any_more_is_stopped_and_without_one_there_is_nothing_to_say(
    it: StillBench,
) -> None:
    it.configure()
    it.begin()
    it.configure(device="")
    it.tick_for(100.0)
    assert (it.kernel.written, it.kernel.is_counting, it.state(), it.alarms()) == (b"V", False, None, [])


def test_a_device_that_cannot_be_had_is_an_alarm_and_lived_without(it: StillBench) -> None:
    it.kernel.open_error = errno.EBUSY
    it.configure()
    it.begin()
    (alarm,) = it.alarms()
    assert alarm.startswith(f"hardware watchdog: {DEVICE}: ")
    state = it.state()
    assert state is not None
    assert alarm == f"hardware watchdog: {state}"
    assert state.count(DEVICE) == 1
    it.kernel.open_error = 0
    it.tick_for(61.0)
    assert (it.alarms(), it.state()) == ([], WELL)


def test_a_timeout_that_the_device_does_not_take_is_shown_as_what_it_is(it: StillBench) -> None:
    it.kernel.step_s = 7
    it.configure()
    it.begin()
    assert it.state() == WELL.replace("30", "35")


def test_tasks_that_end_by_themselves_are_alarms(it: StillBench) -> None:
    it.still.crashed = {"field": 3, "scada": 1}
    assert it.alarms() == [
        "field: ends with errors, 3 so far; made anew each time",
        "scada: ends with errors, 1 so far; made anew each time",
    ]


def test_a_device_that_has_reset_the_machine_is_told_of_once(it: StillBench) -> None:
    it.boot.write_text("yesterday\n")
    LastRun(it.folder, it.boot, bool).begin()
    it.boot.write_text("today\n")
    run = LastRun(it.folder, it.boot, bool)
    assert run.begin().cause == Told("power")
    it.guard._last_run = run
    told: list[Told] = []
    it.guard.has_reset = told.append
    it.kernel.boot_status = CARD_RESET
    it.configure()
    assert told == []
    it.begin()
    it.tick_for(10.0)
    it.configure(device_timeout=60)
    it.tick_for(10.0)
    assert told == [Told("watchdog reset")]


def test_a_device_that_has_reset_nothing_is_not(it: StillBench) -> None:
    told: list[Told] = []
    it.guard.has_reset = told.append
    it.configure()
    it.begin()
    assert told == []


# ------------------------------------------------------------------------------------------------ systemd


def test_systemd_is_told_once_that_all_is_ready_and_not_before(it: StillBench) -> None:
    it.begin()
    it.tick_for(10.0)
    assert "READY=1" not in it.systemd.told()
    it.still.ready = True
    it.guard.tick()
    it.still.ready = False
    it.guard.tick()
    it.still.ready = True
    it.tick_for(10.0)
    assert it.systemd.told().count("READY=1") == 1


def test_systemd_is_told_that_all_is_well_between_a_quarter_and_a_half_of_its_time(it: StillBench) -> None:
    told_s = []
    until_s = it.clock.monotonic() + 500.0
    while it.clock.monotonic() < until_s:
        wait_s = it.guard.tick()
        told_s += [it.clock.monotonic()] * it.systemd.told().count("WATCHDOG=1")
        it.clock.pass_s(min(1.0, wait_s))
    gaps_s = [after_s - before_s for before_s, after_s in pairwise(told_s)]
    assert len(gaps_s) > 30
    assert WATCHDOG_S / 4 <= min(gaps_s) <= max(gaps_s) <= WATCHDOG_S / 2


def test_systemd_shows_a_line_worth_reading(it: StillBench) -> None:
    it.guard.status = lambda: "field polling"
    it.guard.tick()
    assert "STATUS=field polling" in it.systemd.all_told()


def test_a_stop_is_told_as_one_and_a_restart_by_the_menu_as_reloading(it: StillBench) -> None:
    it.still.stopping = True
    it.supervisor.before_stops()
    assert it.systemd.told() == ["STOPPING=1"]
    it.is_restart = True
    it.supervisor.before_stops()
    (told,) = it.systemd.told()
    assert told.startswith(f"RELOADING=1\nMONOTONIC_USEC={int(it.clock.monotonic() * 1e6)}")


def test_tasks_that_are_changed_are_nobodys_concern(it: StillBench) -> None:
    it.supervisor.before_stops()
    assert it.systemd.told() == []


# ------------------------------------------------------------------------------------------------ the backstop


def test_the_backstop_is_armed_anew_at_each_tick_and_longer_while_tasks_stop(it: StillBench) -> None:
    it.configure(timeout=2.0)
    it.guard.tick()
    it.guard.tick()
    it.supervisor.before_stops()
    it.still.stopping = True
    it.supervisor.before_stops()
    assert it.backstop.armed_s == [2.0, 2.0, 2.0 + STOP_LIMIT_S, SLOW_STOP_S + STOP_LIMIT_S]
    assert it.backstop.named == 2


# ------------------------------------------------------------------------------------------------ hangs


def test_a_hang_is_logged_with_names_and_stacks_and_kept_before_the_process_ends(
    it: StillBench, caplog: pytest.LogCaptureFixture
) -> None:
    it.configure(timeout=2.5)
    it.hang("field", "scada")
    assert it.left == [HUNG_EXIT] == [1]
    assert it.mark_at_leaving == ["field", "scada"]
    assert caplog.messages[0] == "field, scada: got on with nothing for 2.5 s: ending the process"
    assert any("in test_a_hang_is_logged" in message for message in caplog.messages)  # this thread's stack
    assert {record.levelname for record in caplog.records} == {"CRITICAL"}


def test_the_next_start_knows_of_it(it: StillBench) -> None:
    it.hang("field")
    beginning = LastRun(it.folder, it.boot, bool).begin()
    assert (beginning.cause.words(str), beginning.bad_in_row) == ("hang of field", 1)


def test_tasks_that_do_not_stop_are_a_hang_of_those(it: StillBench) -> None:
    it.still.late = ["field"]
    with pytest.raises(LeftError):
        it.guard.did_not_stop()
    assert (it.left, it.mark_at_leaving) == ([HUNG_EXIT], ["field"])


# ------------------------------------------------------------------------------------------------ with real tasks


def test_with_real_tasks_and_a_fifo_feeding_begins_with_the_last_flag_and_a_clean_end_stops_it(
    tmp_path: Path, clock: JumpingClock, systemd: Notified
) -> None:
    with a_fifo(tmp_path) as (path, written):
        it = Whole(tmp_path, clock, systemd, path)
        with running(it.bench.supervisor) as run:
            it.flags(run, "field")
            assert written() == b""
            it.flags(run, "scada")
            fed = written()
            assert fed
            assert b"V" not in fed
            assert "READY=1" not in systemd.told()
            for name in ("field", "scada"):
                it.tasks.obedient(name).ready.set()
            it.flags(run, "field", "scada")
            assert systemd.told().count("READY=1") == 1
        assert systemd.told()[-1] == "STOPPING=1"
        assert b"V" not in written()
        it.bench.guard.close()
        assert written() == b"V"


def test_with_real_tasks_a_hang_ends_the_process_and_the_device_is_not_stopped(
    tmp_path: Path, clock: JumpingClock, systemd: Notified
) -> None:
    with a_fifo(tmp_path) as (path, written):
        it = Whole(tmp_path, clock, systemd, path)
        supervisor = it.bench.supervisor
        with running(supervisor) as run:
            it.flags(run, "field", "scada")
            assert written()
            hung = supervisor.hung
            told: list[list[str]] = []

            def hang(names: list[str]) -> None:
                if not told:
                    told.append(names)
                    written()  # what it was fed until now
                    with pytest.raises(LeftError):
                        hung(names)

            supervisor.hung = hang
            clock.pass_s(supervisor.timeout_s - 0.5)
            it.flags(run, "scada")
            clock.pass_s(1.0)
            run.look()
            assert told == [["field"]]
            assert written() == b""
        it.bench.guard.systemd.close()
        assert written() == b""  # neither by stopping its tasks
        assert (it.bench.left, it.bench.mark_at_leaving) == ([HUNG_EXIT], ["field"])


def test_with_real_tasks_one_that_does_not_stop_is_named_and_the_device_is_not_stopped(
    tmp_path: Path, clock: JumpingClock, systemd: Notified
) -> None:
    with a_fifo(tmp_path) as (path, written):
        it = Whole(tmp_path, clock, systemd, path)
        with running(it.bench.supervisor) as run:
            run.change([it.tasks.plan("deaf", kind=Deaf)])
            assert it.tasks.made[-1].ready.wait(PATIENCE_S)
        assert run.was_clean is False
        with pytest.raises(LeftError):
            it.bench.guard.did_not_stop()
        it.bench.guard.systemd.close()
        assert (it.bench.mark_at_leaving, b"V" in written()) == (["deaf"], False)
        it.tasks.let_go()
