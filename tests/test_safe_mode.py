"""Safe mode: how it begins, what it keeps still, what ends it; alone, in a gateway, in the real program."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.config import Config
from gateway.restart_cause import FILE, SAFE_AFTER
from gateway.running import GOOD_AFTER_S
from gateway.safe_mode import LASTED_S, LONGEST_S, NEVER_S, SafeMode
from tests.changing import slave
from tests.config_files import BAD, GOOD, Place, config_of
from tests.fakes import JumpingClock
from tests.gateways import Bench, Live, done, nobody
from tests.lines import PATIENCE_S, STOP_LIMIT_S
from tests.peers import free_port
from tests.programs import SOON_S, Program, is_listening, program, until

ALARM = "safe mode: 3 bad restarts in a row; all lines are in maintenance"
OVER = "Safe mode is over: all lines run as configured."


# ------------------------------------------------------------------------------------------------ alone


class Told:
    """What a safe mode tells; ``mode`` is under test."""

    def __init__(self, clock: JumpingClock, bad_in_row: int) -> None:
        self.clock = clock
        self.said: list[str] = []
        lasted, forgiven = lambda: self.said.append("lasted"), lambda row: self.said.append(f"forgiven {row}")
        self.mode = SafeMode(clock, bad_in_row, lasted, forgiven)

    def look(self) -> float:
        return self.mode.look(lambda: self.said.append("the hour is over"))

    def run_s(self, seconds: float) -> None:
        """Let time pass as in a gateway, which looks when it was told to, and each second."""
        until_s = self.clock.monotonic() + seconds
        while (left_s := until_s - self.clock.monotonic()) > 0:
            self.clock.pass_s(min(left_s, self.look(), 1.0))
        self.look()


@pytest.mark.parametrize("bad_in_row", range(SAFE_AFTER))
def test_fewer_than_three_bad_restarts_are_no_safe_mode_and_a_run_that_lasts_says_so_once(
    clock: JumpingClock, bad_in_row: int
) -> None:
    it = Told(clock, bad_in_row)
    assert (it.mode.is_on, it.mode.left_s, it.look()) == (False, None, LASTED_S)
    it.run_s(LASTED_S - 1.0)
    assert it.said == []
    it.run_s(1.0)
    assert it.said == ["lasted"]
    it.run_s(2 * NEVER_S)
    assert it.said == ["lasted"]
    assert not it.mode.end(0)
    assert it.said == ["lasted"]


def test_three_bad_restarts_in_a_row_are_safe_mode_for_an_hour_which_is_told_once(clock: JumpingClock) -> None:
    it = Told(clock, SAFE_AFTER)
    assert (it.mode.is_on, it.mode.bad_in_row, it.mode.left_s, it.look()) == (True, 3, LONGEST_S, LONGEST_S)
    clock.pass_s(LASTED_S)
    assert it.mode.left_s == LONGEST_S - LASTED_S
    it.run_s(LONGEST_S - LASTED_S - 1.0)
    assert it.said == []
    it.run_s(1.0)
    it.run_s(LONGEST_S)
    assert it.said == ["the hour is over"]
    assert it.mode.is_on  # until it is ended


@pytest.mark.parametrize("row", [0, SAFE_AFTER - 1])
def test_once_it_is_ended_the_run_has_to_last_ten_minutes_from_then_on(clock: JumpingClock, row: int) -> None:
    it = Told(clock, SAFE_AFTER)
    it.run_s(1000.0)
    assert it.mode.end(row)
    assert (it.mode.is_on, it.mode.left_s, it.said) == (False, None, [f"forgiven {row}"])
    assert not it.mode.end(row)
    it.run_s(LASTED_S - 1.0)
    assert it.said == [f"forgiven {row}"]
    it.run_s(1.0)
    assert it.said == [f"forgiven {row}", "lasted"]


def test_clocks_that_are_set_change_nothing(clock: JumpingClock) -> None:
    it = Told(clock, SAFE_AFTER)
    clock.jump_wall(1e9)
    assert (it.mode.left_s, it.look()) == (LONGEST_S, LONGEST_S)


# ------------------------------------------------------------------------------------------------ in a gateway


class Safe:
    """A gateway that has begun in safe mode, at work, with a slave that is on and one that is off."""

    def __init__(self, place: Place, row: int) -> None:
        clock: Any = place.clock
        self.place, self.clock = place, place.clock
        self.live = Live(place, clock)
        self.gateway = self.live.gateway
        self.forgiven: list[int] = []
        self.gateway.safe_mode = SafeMode(clock, row, forgiven=self.forgiven.append)

    def states(self) -> dict[str, bool]:
        """Which slaves are at work."""
        self.settle()
        found = {line.name: self.gateway.slave(line.name) for line in self.gateway.config.slave}
        return {name: task.enabled for name, task in found.items() if task is not None}

    def settle(self) -> None:
        """Return once all that was asked for is done."""
        for _ in range(2):
            with self.live.held():
                pass
        assert self.gateway.finish_work(STOP_LIMIT_S)
        for _ in range(2):
            with self.live.held():
                pass

    def pass_s(self, seconds: float) -> None:
        self.clock.pass_s(seconds)
        looked = threading.Event()

        def look() -> float:  # after the chore that is meant here
            looked.set()
            return NEVER_S

        self.gateway.supervisor.chores.append(look)
        self.gateway.supervisor.submit(nobody)
        assert looked.wait(PATIENCE_S)
        self.settle()

    def told(self) -> list[str]:
        return [told.words(str) for told in self.gateway.notices(0)[1]]

    def alarms(self) -> list[str]:
        return [told.words(str) for told in self.gateway.alarms()]


def two_slaves(**keys: object) -> str:
    return GOOD + slave("on", free_port(), **keys) + slave("off", free_port(), enabled=False)


@contextmanager
def gateway_in(place: Place, row: int = SAFE_AFTER) -> Iterator[Safe]:
    it = Safe(place, row)
    it.live.start()
    try:
        yield it
    finally:
        it.live.stop()


@pytest.fixture
def place(tmp_path: Path, clock: JumpingClock) -> Place:
    return Place(tmp_path, clock, two_slaves())


def with_on_enabled(config: Config, enabled: bool) -> Config:
    lines = [line.model_copy(update={"enabled": enabled}) if line.name == "on" else line for line in config.slave]
    return config.model_copy(update={"slave": lines})


def test_all_lines_are_in_maintenance_and_the_menu_is_there(place: Place) -> None:
    with gateway_in(place) as it:
        assert it.states() == {"on": False, "off": False}
        master = it.gateway.master("field")
        assert master is not None
        assert not master.enabled
        assert [task.name for task in it.live.tasks.made] == ["menu"]
        assert "menu off" not in it.live.tasks.told
        assert (it.gateway.is_safe, it.alarms()[0]) == (True, ALARM)
        assert it.gateway.config.slave[0].enabled  # as configured
        assert not it.gateway.is_unsaved


def test_without_safe_mode_lines_run_and_there_is_no_alarm(place: Place) -> None:
    with gateway_in(place, SAFE_AFTER - 1) as it:
        assert it.states() == {"on": True, "off": False}
        assert (it.gateway.is_safe, it.gateway.safe_left_s, it.alarms()) == (False, None, [])


def test_a_person_ends_it_and_begins_a_new_row(place: Place) -> None:
    with gateway_in(place) as it:
        assert done(it.gateway.end_safe_mode(nobody)).problem == ""
        assert it.states() == {"on": True, "off": False}
        assert (it.forgiven, it.gateway.is_safe, it.alarms()) == ([0], False, [])
        assert done(it.gateway.end_safe_mode(nobody)).problem == ""
        assert it.forgiven == [0]


def test_after_an_hour_it_tries_once_more_by_itself_and_says_so(place: Place) -> None:
    with gateway_in(place) as it:
        it.pass_s(LONGEST_S - 1.0)
        assert (it.states(), it.told(), it.gateway.safe_left_s) == ({"on": False, "off": False}, [], 1.0)
        it.pass_s(1.0)
        assert it.states() == {"on": True, "off": False}
        assert (it.forgiven, it.told(), it.alarms()) == ([SAFE_AFTER - 1], [OVER], [])


def test_a_reload_ends_it(place: Place) -> None:
    with gateway_in(place) as it:
        assert done(it.gateway.reload()).problem == ""
        assert it.states() == {"on": True, "off": False}
        assert (it.forgiven, it.gateway.is_safe) == ([0], False)


def test_a_reload_of_a_bad_file_does_not(place: Place) -> None:
    with gateway_in(place) as it:
        place.path.write_text(BAD)
        assert "not reloaded, nothing has changed" in done(it.gateway.reload()).problem
        assert it.states() == {"on": False, "off": False}
        assert (it.forgiven, it.gateway.is_safe, it.alarms()[0]) == ([], True, ALARM)


def test_lines_changed_switched_or_added_meanwhile_stay_in_maintenance_until_it_ends(place: Place) -> None:
    with gateway_in(place) as it:
        for enabled in (False, True):
            config = it.gateway.config
            done(it.gateway.change(config, with_on_enabled(config, enabled), nobody))
            assert it.states() == {"on": False, "off": False}
        added = config_of(place.text + slave("new", free_port())).slave[-1]
        other = it.gateway.config.slave[0].model_copy(update={"unit": 9})
        new = it.gateway.config.model_copy(update={"slave": [other, it.gateway.config.slave[1], added]})
        done(it.gateway.change(it.gateway.config, new, nobody))
        assert it.states() == {"on": False, "off": False, "new": False}
        done(it.gateway.save(False, None, nobody))
        assert it.states() == {"on": False, "off": False, "new": False}
        assert not it.gateway.is_unsaved
        done(it.gateway.end_safe_mode(nobody))
        assert it.states() == {"on": True, "off": False, "new": True}


def test_an_undo_in_safe_mode_does_not_end_it(place: Place) -> None:
    with gateway_in(place) as it:
        config = it.gateway.config
        done(it.gateway.change(config, with_on_enabled(config, False), nobody))
        done(it.gateway.undo(nobody))
        assert (it.states(), it.gateway.is_safe) == ({"on": False, "off": False}, True)


def test_a_line_that_crashes_in_safe_mode_is_made_anew_in_maintenance(place: Place) -> None:
    with gateway_in(place) as it:
        it.settle()
        task: Any = it.gateway.slave("on")
        task.step = lambda: 1 // 0
        task.wake()
        until(lambda: it.gateway.supervisor.failed_s is not None)
        assert it.gateway.supervisor.crashes == {"on": 1}
        assert it.gateway.slave("on") is None
        it.pass_s(1.0)
        assert it.states() == {"on": False, "off": False}


def test_a_run_in_safe_mode_keeps_no_last_good_configuration_and_the_one_after_it_only_once_it_has_run_well(
    tmp_path: Path, clock: JumpingClock
) -> None:
    bench = Bench(Place(tmp_path, clock))
    bench.gateway.safe_mode = SafeMode(clock, SAFE_AFTER)
    bench.run_s(1000.0)
    assert bench.last_good() is None
    bench.gateway._leave_safe_mode(0)
    bench.look()
    assert bench.last_good() is None
    bench.run_s(GOOD_AFTER_S - 1.0)
    assert bench.last_good() is None
    bench.run_s(GOOD_AFTER_S)
    assert bench.last_good() == bench.config


# ------------------------------------------------------------------------------------------------ the real program


def status(gateway: Program) -> dict[str, Any]:
    answer = gateway.ask("status --json")
    assert answer is not None
    found = json.loads(answer)
    assert isinstance(found, dict)
    return found


def kill(gateway: Program) -> None:
    gateway.run.kill()
    gateway.run.wait()


def stopped(gateway: Program) -> int:
    """End it as systemd does, however busy the machine is; return its exit code."""
    gateway.run.terminate()
    return gateway.run.wait(SOON_S)


def states(gateway: Program) -> list[str]:
    told = status(gateway)
    return [line["state"] for line in told["slaves"] + told["masters"]]


def last_run_of(gateway: Program) -> dict[str, Any]:
    found = json.loads((gateway.state / FILE).read_text())
    assert isinstance(found, dict)
    return found


@contextmanager
def a_program(folder: Path, port: int) -> Iterator[Program]:
    with program(folder, GOOD + slave("scada", port)) as gateway:
        yield gateway.started()


def test_three_kills_in_a_row_are_safe_mode_and_g_ends_it(tmp_path: Path) -> None:
    port = free_port()
    with a_program(tmp_path, port) as gateway:
        until(lambda: is_listening(port))
        for count in (1, 2):
            kill(gateway)
            gateway.started()
            assert (status(gateway)["safe_mode"], status(gateway)["last_restart"]) == (False, "crash")
            assert last_run_of(gateway)["bad_in_row"] == count + 1
            until(lambda: is_listening(port))
        kill(gateway)
        gateway.started()
        told = status(gateway)
        assert (told["safe_mode"], told["alarms"]) == (True, [ALARM])
        until(lambda: states(gateway) == ["maintenance"] * 2)  # the control socket is there before they are
        assert json.loads(gateway.command("status", "--json")[1])["safe_mode"] is True
        assert f"ERROR {ALARM}" in gateway.said
        assert not is_listening(port)
        with gateway.menu() as person:
            person.read_until("ALARM: safe mode: 3 bad restarts in a row")
            person.read_until("rtugate> ")
            person.send(b"gy")
            person.read_until(OVER)
            person.read_until("rtugate> ")
        until(lambda: is_listening(port))
        assert (status(gateway)["safe_mode"], status(gateway)["alarms"]) == (False, [])
        kill(gateway)  # the row begins anew
        gateway.started()
        assert status(gateway)["safe_mode"] is False
        assert stopped(gateway) == 0


def test_safe_mode_is_still_on_after_another_kill_and_a_reload_of_a_good_file_ends_it(tmp_path: Path) -> None:
    port = free_port()
    with a_program(tmp_path, port) as gateway:
        for _ in range(4):
            kill(gateway)
            gateway.started()
        assert status(gateway)["safe_mode"] is True
        good = gateway.path.read_text()
        gateway.reload(good.replace("count = 3", "count = 126"))
        gateway.wait_for("not reloaded, nothing has changed")
        assert status(gateway)["safe_mode"] is True
        assert not is_listening(port)
        gateway.reload(good)
        gateway.wait_for("rtugate.toml: reloaded")
        until(lambda: is_listening(port))
        assert status(gateway)["safe_mode"] is False
        assert stopped(gateway) == 0


def test_a_clean_stop_in_between_ends_the_row(tmp_path: Path) -> None:
    port = free_port()
    with a_program(tmp_path, port) as gateway:
        for _ in range(2):
            kill(gateway)
            gateway.started()
        assert stopped(gateway) == 0
        gateway.started()
        assert status(gateway)["last_restart"] == "clean stop"
        kill(gateway)
        gateway.started()
        assert status(gateway)["safe_mode"] is False
        until(lambda: is_listening(port))
        assert stopped(gateway) == 0


def test_a_stop_in_safe_mode_is_clean_and_ends_the_row(tmp_path: Path) -> None:
    port = free_port()
    with a_program(tmp_path, port) as gateway:
        for _ in range(3):
            kill(gateway)
            gateway.started()
        assert status(gateway)["safe_mode"] is True
        assert stopped(gateway) == 0
        gateway.started()
        assert status(gateway)["safe_mode"] is False
        assert stopped(gateway) == 0
