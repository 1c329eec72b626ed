"""The gateway on a virtual board that boots Debian 13: hangs, kills, stops and power cuts, with a real watchdog.

One board for all of these tests, each of which begins with a clean restart. Where a tool is missing they fail:
apt-get install qemu-system-x86 qemu-utils debootstrap e2fsprogs xz-utils mbpoll. The first run makes the board's disk,
which takes minutes and a Debian mirror; where it is kept: ``tests.system.board.image``.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator

import pytest

from tests.system.board.machine import BOOT_LIMIT_S
from tests.system.board.station import DEVICE_TIMEOUT_S, START_LIMIT_S, TIMEOUT_S, Station, station

Record = Callable[[str, object], None]

NO_RESET_S = DEVICE_TIMEOUT_S + 15.0  # after so long the watchdog would have bitten
TICK_S = TIMEOUT_S / 10
SLOW_S = 3.0  # to notice and to write down what hung, on this processor
THREADS = ("main thread", "field", "plant", "plc", "serial console", "control socket")
ABORT_S = 10  # WatchdogSec: with two of RestartSec and a slow start still before the hardware
UNFLUSHED = "/etc/rtugate/unflushed"  # what nobody has had written to the disk: lost with the power
MOMENT = "/run/faults/order.moment"


@pytest.fixture(scope="module")
def the_station(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    with station(tmp_path_factory.mktemp("station")) as made:
        yield made


@pytest.fixture
def board(the_station: Station) -> Station:
    """The board, on which everything works, and nothing has gone wrong lately."""
    the_station.settle()
    return the_station


def wait_new_process(board: Station, old: str) -> None:
    """Return once another process than *old* runs, and both devices are polled by it."""
    board.machine.until(lambda: board.pid not in ("0", old), "systemd starts the gateway again", START_LIMIT_S)
    board.wait_polling()


def is_not_reset(board: Station, boot_id: str) -> None:
    """Nothing resets the machine, for longer than the watchdog would have waited."""
    machine = board.machine
    before = machine.resets
    assert not machine.watch(lambda: machine.resets != before, NO_RESET_S), machine.resets
    assert machine.do("cat /proc/sys/kernel/random/boot_id") == boot_id == machine.boot_id


def seconds_of(board: Station, moment: str, pattern: str) -> float:
    """Return how long after the board's time *moment* the first line of the journal with *pattern* came."""
    found = re.search(rf"^\[ *([0-9.]+)\].*({pattern})", board.journal(), re.MULTILINE)
    assert found, f"{pattern!r} is not in the journal:\n{board.journal()}"
    return float(found[1]) - float(moment)


def test_the_board_boots_and_master_slave_and_console_work(board: Station, record_property: Record) -> None:
    board.machine.cut_power()
    begun_s = time.monotonic()
    board.machine.start()
    record_property("from power to a shell", f"{time.monotonic() - begun_s:.0f} s")
    board.wait_polling()
    record_property("from power to polling", f"{time.monotonic() - begun_s:.0f} s")
    served_s = board.wait_served()
    record_property("from a device's change to SCADA, mbpoll's start included", f"{served_s:.1f} s")
    assert "K  slave unit identifier" in board.type("\r", "rtugate> ")
    board.machine.until(lambda: board.show("ActiveState")["ActiveState"] == "active", "READY=1", START_LIMIT_S)
    shown = board.show("Type", "SubState", "StatusText", "NRestarts")
    assert (shown["Type"], shown["SubState"], shown["NRestarts"]) == ("notify-reload", "running", "0")
    assert shown["StatusText"] == "field polling, plant polling, plc answering"
    board.wait_works()
    assert board.watchdog_state() == "active"
    assert board.status()["last_restart"] == "power"
    assert board.status()["alarms"] == []


def test_a_hang_that_nobody_restarts_resets_the_machine_and_the_station_comes_back_polling(
    board: Station, record_property: Record
) -> None:
    board.fit_faults(restart="no")
    machine, boots, bites = board.machine, len(board.machine.boots), board.machine.count("WATCHDOG")
    board.commit("field", "deadlock")
    machine.until(lambda: board.show("ActiveState")["ActiveState"] == "failed", "the hang ends the process")
    ended_s, moment = time.monotonic(), machine.do(f"cat {MOMENT}")
    noticed_s = seconds_of(board, moment, "field: got on with nothing")
    record_property("from the hang to the log", f"{noticed_s:.1f} s of {TIMEOUT_S + TICK_S:.1f} s")
    assert noticed_s < TIMEOUT_S + TICK_S + SLOW_S
    assert board.show("ExecMainStatus", "NRestarts") == {"ExecMainStatus": "1", "NRestarts": "0"}
    assert set(re.findall(r": (.+) \(0x[0-9a-f]+\), newest call last:", board.journal())) >= set(THREADS)
    assert re.search(r"faults\.py.*deadlock", board.journal())
    assert board.watchdog_state() == "active"
    machine.until(lambda: machine.count("WATCHDOG") > bites, "the watchdog bites", NO_RESET_S)
    reset_s = time.monotonic()
    record_property("from the end of the process to the reset", f"{reset_s - ended_s:.1f} s of {DEVICE_TIMEOUT_S} s")
    machine.until(lambda: len(machine.boots) > boots, "the board comes up again", BOOT_LIMIT_S)
    board.wait_polling()
    record_property("from the reset to polling", f"{time.monotonic() - reset_s:.0f} s")
    assert board.status()["last_restart"] == "watchdog reset after a hang of field"
    board.wait_served()


@pytest.mark.parametrize("kind", ["deadlock", "interpreter"])
def test_a_hang_restarts_only_the_process_where_systemd_does(
    board: Station, kind: str, record_property: Record
) -> None:
    board.fit_faults(restart="always")
    machine, boot_id, pid = board.machine, board.machine.boot_id, board.pid
    begun_s = time.monotonic()
    board.commit("field", kind)
    wait_new_process(board, pid)
    record_property(f"{kind}: from the hang to polling", f"{time.monotonic() - begun_s:.0f} s")
    assert board.show("NRestarts")["NRestarts"] == "1"
    told, _, names = board.status()["last_restart"].partition("hang of ")
    assert told == ""
    assert "field" in names.split(", ")  # who holds the interpreter may have bystanders beside it
    assert machine.do("cat /proc/sys/kernel/random/boot_id") == boot_id
    is_not_reset(board, boot_id)


def test_a_clean_stop_does_not_reset_the_machine(board: Station, record_property: Record) -> None:
    assert board.watchdog_state() == "active"
    boot_id = board.machine.boot_id
    begun_s = time.monotonic()
    board.machine.do("systemctl stop rtugate.service")
    record_property("the stop took, with systemctl", f"{time.monotonic() - begun_s:.1f} s")
    shown = board.show("ActiveState", "ExecMainStatus", "Result")
    assert shown == {"ActiveState": "inactive", "ExecMainStatus": "0", "Result": "success"}
    assert board.watchdog_state() == "inactive"
    is_not_reset(board, boot_id)
    board.machine.do("systemctl start rtugate.service")
    board.wait_polling()
    assert board.status()["last_restart"] == "clean stop"


def test_a_kill_restarts_only_the_process(board: Station, record_property: Record) -> None:
    boot_id, pid = board.machine.boot_id, board.pid
    begun_s = time.monotonic()
    board.machine.do(f"kill -KILL {pid}")
    wait_new_process(board, pid)
    record_property("from the kill to polling", f"{time.monotonic() - begun_s:.0f} s")
    assert board.show("NRestarts")["NRestarts"] == "1"
    assert board.status()["last_restart"] == "crash"
    is_not_reset(board, boot_id)
    assert board.watchdog_state() == "active"
    assert board.pid != pid
    board.wait_served()


def test_a_process_that_stands_still_as_a_whole_is_restarted_by_systemd(
    board: Station, record_property: Record
) -> None:
    board.drop_in(f"[Service]\nWatchdogSec={ABORT_S}\n")
    board.restart()
    boot_id, pid = board.machine.boot_id, board.pid
    begun_s = time.monotonic()
    board.machine.do(f"kill -STOP {pid}")
    wait_new_process(board, pid)
    record_property("from the standstill to polling", f"{time.monotonic() - begun_s:.0f} s, WatchdogSec={ABORT_S}")
    assert board.show("NRestarts")["NRestarts"] == "1"
    assert "Watchdog timeout" in board.journal()
    cause = board.status()["last_restart"]  # systemd's signal and our own backstop both strike when it goes on
    assert cause == "crash" or cause.startswith("hang of "), cause
    record_property("the cause it tells", cause)
    is_not_reset(board, boot_id)


def test_a_process_that_stands_still_as_a_whole_resets_the_machine_where_systemd_does_not_look(
    board: Station, record_property: Record
) -> None:
    board.drop_in("[Service]\nWatchdogSec=0\n")
    board.restart()
    machine, boots, bites = board.machine, len(board.machine.boots), board.machine.count("WATCHDOG")
    begun_s = time.monotonic()
    machine.do(f"kill -STOP {board.pid}")
    machine.until(lambda: machine.count("WATCHDOG") > bites, "the watchdog bites", NO_RESET_S)
    record_property("from the standstill to the reset", f"{time.monotonic() - begun_s:.1f} s of {DEVICE_TIMEOUT_S} s")
    machine.until(lambda: len(machine.boots) > boots, "the board comes up again", BOOT_LIMIT_S)
    board.wait_works()
    assert board.status()["last_restart"] == "watchdog reset"
    board.wait_served()


def test_what_the_console_saved_before_the_power_is_cut_is_what_the_board_starts_with(
    board: Station, record_property: Record
) -> None:
    board.type("\r", "rtugate> ")
    board.type("k", "Unit identifier (1-247) [1]")
    board.type("7\r", "plc answers to unit 7.")
    board.machine.do(f"echo unflushed >{UNFLUSHED}")
    board.type("w", "Save this? (y/n/c)")
    board.type("y", "Saved.")
    board.machine.cut_power()
    begun_s = time.monotonic()
    board.machine.start()
    board.wait_polling()
    record_property("from power to polling", f"{time.monotonic() - begun_s:.0f} s")
    assert board.machine.order(f"cat {UNFLUSHED}")[1] != "unflushed\n", "this was no power cut"
    board.wait_served(unit=7)
    assert board.ask(unit=1) == []
    told = board.status()
    assert (told["last_restart"], told["unsaved_changes"]) == ("power", False)
    assert "# The virtual board: what stands in comments is kept." in board.machine.do("cat /etc/rtugate/rtugate.toml")


def test_a_reload_is_told_to_systemd_and_nothing_is_restarted(board: Station, record_property: Record) -> None:
    pid = board.pid
    board.configure(unit=9)
    begun_s = time.monotonic()
    board.machine.do("systemctl reload rtugate.service")
    record_property("the reload took, with systemctl", f"{time.monotonic() - begun_s:.1f} s")
    assert board.show("ActiveState", "MainPID") == {"ActiveState": "active", "MainPID": pid}
    board.wait_served(unit=9)
    assert board.ask(unit=1) == []
