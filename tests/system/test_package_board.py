"""The package on a virtual board that boots Debian 13: installed, run by systemd as it is delivered, and taken away.

One board for all of these tests, each of which begins with the package installed and a clean restart. What they need is
what ``test_board`` and ``test_package`` need. The board has no network but its own: telnet and Modbus TCP are visited
from where the service runs.

Not tried here: a USB adapter that is plugged in later, as the board's kernel has no USB.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.modbus.pdu import Table
from tests.system.board.machine import BOOT_LIMIT_S
from tests.system.board.station import CONFIG, DEVICE_TIMEOUT_S, Station, station
from tests.system.package.board import (
    ACCEPTANCE,
    LATER,
    PASSWORD,
    TELNET,
    delivered,
    install,
    installed_version,
    purge,
    read_tcp,
    version_of,
    visit,
)
from tests.system.package.deb import ROOT, built
from tests.system.test_board import Record, is_not_reset, wait_new_process

UNIT_FILE = "/usr/lib/systemd/system/rtugate.service"
AS_RTUGATE = ("setpriv", "--reuid=rtugate", "--regid=rtugate", "--init-groups")
LOOPBACK_2323 = "0100007F:0913"  # in /proc/net/tcp: 127.0.0.1, the octets reversed, and the port
LISTENS = "0A"  # there, too: TCP_LISTEN
LOW_PORTS = 1 << 10  # CAP_NET_BIND_SERVICE of linux/capability.h
EXPOSURE_MOST = 1.5
DENIED = re.compile(r"denied|not permitted|EPERM|EACCES|seccomp|SIGSYS|code=killed|Traceback", re.IGNORECASE)
ACCEPTANCE_LIMIT_S = 900.0  # a minute on a machine with a real processor
PRIVATE, PUBLIC = "192.168.77.1", "203.0.113.7"
NEW_UNIT = 7
LEFT = "/etc/rtugate /var/lib/rtugate /run/rtugate /usr/share/rtugate /usr/bin/rtugate"


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("built"))


@pytest.fixture(scope="module")
def the_station(tmp_path_factory: pytest.TempPathFactory, package: Path) -> Iterator[Station]:
    delivery = delivered(package, tmp_path_factory.mktemp("later"))
    with station(tmp_path_factory.mktemp("station"), delivery) as made:
        yield made


@pytest.fixture
def board(the_station: Station, package: Path) -> Station:
    """The board with the package on it, everything works, and nothing has gone wrong lately."""
    wake(the_station)
    if installed_version(the_station) != version_of(package):
        purge(the_station)
        install(the_station)
    the_station.settle()
    return the_station


def wake(board: Station) -> None:
    """Return once it carries out orders, and has what is to be installed."""
    if not board.machine.answers():
        board.machine.cut_power()
        board.machine.start()
    board.machine.do("mountpoint --quiet /mnt || mount -o ro /dev/vdb /mnt")


def save_at_console(board: Station, unit: int = NEW_UNIT) -> None:
    """Somebody at the console changes the serial slave's unit, and saves."""
    board.type("\r", "rtugate> ")
    board.type("k", "Slave")
    board.type("1", "Unit identifier (1-247) [1]")
    board.type(f"{unit}\r", f"plc answers to unit {unit}.")
    board.type("w", "Save this? (y/n/c)")
    board.type("y", "Saved.")


def is_as_saved(board: Station, unit: int = NEW_UNIT) -> None:
    board.wait_served(unit)
    text = board.machine.do(f"cat {CONFIG}")
    assert "# The virtual board: what stands in comments is kept." in text
    assert board.status()["unsaved_changes"] is False
    assert "bytes" in board.machine.do("rtugate history")


def milliseconds_to_ready(board: Station) -> float:
    """Return how long systemd has waited for READY=1, modprobe's time included."""
    shown = board.show("InactiveExitTimestampMonotonic", "ActiveEnterTimestampMonotonic")
    return (int(shown["ActiveEnterTimestampMonotonic"]) - int(shown["InactiveExitTimestampMonotonic"])) / 1000


def owners(board: Station, *paths: str) -> list[str]:
    """Return mode and owner of each path."""
    return board.machine.do(f"stat --format='%a %U:%G' {' '.join(paths)}").splitlines()


def process_of(board: Station) -> dict[str, str]:
    """Return what the kernel says of the service's process."""
    lines = board.machine.do(f"cat /proc/{board.pid}/status").splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


def is_nothing_denied(board: Station) -> None:
    """Neither the kernel nor the unit has refused anything since the machine came up."""
    assert [line for line in board.journal().splitlines() if DENIED.search(line)] == []


def is_the_watchdog_rtugates(board: Station) -> None:
    assert owners(board, "/dev/watchdog", "/dev/watchdog0") == ["660 root:rtugate"] * 2


# ------------------------------------------------------------------------------------------------ installed, at work


def test_installing_alone_starts_a_service_that_only_this_machine_reaches(
    the_station: Station, record_property: Record
) -> None:
    board = the_station
    wake(board)
    purge(board)
    board.machine.do(
        """
        userdel rtugate
        ! getent group rtugate
        udevadm control --reload
        udevadm trigger --settle --subsystem-match=watchdog --subsystem-match=misc --sysname-match='watchdog*'
        chown root: /dev/watchdog /dev/watchdog0
        chmod 600 /dev/watchdog /dev/watchdog0
        """
    )
    begun_s = time.monotonic()
    install(board)
    record_property("dpkg --install took, start included", f"{time.monotonic() - begun_s:.0f} s")
    is_the_watchdog_rtugates(board)
    assert board.machine.do("systemctl is-enabled rtugate; systemctl is-active rtugate") == "enabled\nactive"
    record_property("from the unit's start to READY", f"{milliseconds_to_ready(board) / 1000:.1f} s")
    process = process_of(board)
    user, group, dialout = (board.machine.do(words) for words in ("id -u rtugate", "id -g rtugate", GROUP_DIALOUT))
    assert process["Uid"].split() == [user] * 4
    assert set(process["Groups"].split()) == {group, dialout}
    assert [int(process[name], 16) for name in ("CapEff", "CapPrm", "CapBnd", "CapAmb")] == [LOW_PORTS] * 4
    assert process["NoNewPrivs"] == "1"
    assert listening(board) == [LOOPBACK_2323]
    opened = board.machine.do(f"ls -l /proc/{board.pid}/fd")
    assert "socket:" in opened
    assert not re.search("/dev/(tty|watchdog)", opened)
    assert owners(board, "/etc/rtugate", CONFIG, "/var/lib/rtugate", "/run/rtugate", "/run/rtugate/control") == [
        "2770 rtugate:rtugate",
        "640 rtugate:rtugate",
        "750 rtugate:rtugate",
        "750 rtugate:rtugate",
        "660 rtugate:rtugate",
    ]
    for before in ((), AS_RTUGATE):
        assert "K  slave unit identifier" in visit(board, "menu", *before)
    told = board.status()
    assert (told["last_restart"], told["alarms"]) == ("first start", [])
    assert board.machine.do("systemctl --failed --no-legend --plain") == ""


GROUP_DIALOUT = "getent group dialout | cut -d : -f 3"


def listening(board: Station) -> list[str]:
    """Return address and port of each TCP socket that listens on the board, as the kernel writes them."""
    rows = [line.split() for line in board.machine.do("cat /proc/net/tcp /proc/net/tcp6").splitlines()]
    return [row[1] for row in rows if row[3] == LISTENS]


def test_everything_works_under_the_unit_as_it_is_delivered(board: Station, record_property: Record) -> None:
    shown = board.show("FragmentPath", "DropInPaths", "NeedDaemonReload", "Type")
    assert shown == {"FragmentPath": UNIT_FILE, "DropInPaths": "", "NeedDaemonReload": "no", "Type": "notify-reload"}
    assert board.machine.do(f"cat {UNIT_FILE}") == (ROOT / "etc" / "rtugate.service").read_text().rstrip("\n")
    boot_id = board.machine.boot_id

    board.wait_served()
    assert read_tcp(board, 0, 4) == [board.meter.get(Table.HOLDING_REGISTERS, n)[0] for n in range(4)]
    assert read_tcp(board, 100, 2) == [board.boiler.get(Table.HOLDING_REGISTERS, n)[0] for n in (107, 108)]
    assert "K  slave unit identifier" in board.type("\r", "rtugate> ")
    board.type("q", "")
    said = visit(board, "telnet", "127.0.0.1", TELNET, PASSWORD)
    assert "Slave scada: answering" in said
    assert "Master field: " in said
    assert board.show("StatusText")["StatusText"] == "field polling, plant polling, plc answering, scada answering"
    assert board.status()["alarms"] == []
    assert "i6300ESB" in board.journal()
    is_not_reset(board, boot_id)
    assert board.watchdog_state() == "active"
    is_nothing_denied(board)

    record_property("from the unit's start to READY", f"{milliseconds_to_ready(board) / 1000:.1f} s")
    record_property("resident", f"{int(process_of(board)['VmRSS'].split()[0]) / 1024:.1f} MiB")
    record_property("the unit's memory", f"{int(board.show('MemoryCurrent')['MemoryCurrent']) / 1024**2:.1f} MiB")


def test_the_unit_as_it_is_loaded_is_exposed_little(board: Station, record_property: Record) -> None:
    told = board.machine.do("systemd-analyze security --no-pager rtugate.service | tail -n 1")
    record_property("systemd-analyze security", told)
    found = re.search(r"level for rtugate\.service: ([0-9.]+)", told)
    assert found, told
    assert float(found[1]) <= EXPOSURE_MOST


def test_public_addresses_and_other_devices_are_out_of_reach_whatever_the_file_says(board: Station) -> None:
    for address in (PRIVATE, PUBLIC):
        board.machine.do(f"busybox ip address add {address}/32 dev lo 2>/dev/null || true")
    assert len(read_tcp(board, 0, 4, PRIVATE)) == 4
    code, told = board.machine.order(f"python3 /mnt/visit.py modbus {PUBLIC} 502 1 0 4")
    assert (code, "TimeoutError" in told) == (1, True), told

    def opened_by_the_service(path: str) -> str:
        """Return what becomes of opening *path* with root's rights, and the devices that the service may have."""
        script = f"echo $$ >/sys/fs/cgroup/system.slice/rtugate.service/cgroup.procs; exec 3<>{path}"
        return board.machine.order(f"sh -c {script!r} 2>&1")[1]

    assert opened_by_the_service("/dev/null") == opened_by_the_service("/dev/ttyS0") == ""
    assert "not permitted" in opened_by_the_service("/dev/vda")
    assert "not permitted" in opened_by_the_service("/dev/kmsg")


def test_the_packages_own_acceptance_test_passes(board: Station, record_property: Record) -> None:
    begun_s = time.monotonic()
    told = board.machine.do(f"python3 /mnt/{ACCEPTANCE.name} --here 2>&1", ACCEPTANCE_LIMIT_S)
    record_property("installed-service took", f"{time.monotonic() - begun_s:.0f} s")
    assert told.splitlines()[-1] == "installed-service: passed"
    assert "NOT SO" not in told
    board.wait_works()
    board.wait_served()


# ------------------------------------------------------------------------------------------------ restarts


def test_a_reboot_is_a_clean_stop_and_the_station_comes_back_as_it_was_saved(
    board: Station, record_property: Record
) -> None:
    save_at_console(board)
    board.machine.do(f"sed -i s,/dev/watchdog,/dev/watchdog0, {CONFIG} && chown rtugate: {CONFIG}")  # its newer name
    machine = board.machine
    boots, bites, logged = len(machine.boots), machine.count("WATCHDOG"), len(machine.log)
    begun_s = time.monotonic()
    machine.do("reboot")
    machine.until(lambda: len(machine.boots) > boots, "the board comes up again", BOOT_LIMIT_S)
    record_property("from `reboot` to a shell", f"{time.monotonic() - begun_s:.0f} s")
    board.wait_works()
    record_property("from `reboot` to polling, with the watchdog", f"{time.monotonic() - begun_s:.0f} s")
    assert (len(machine.boots), machine.count("WATCHDOG")) == (boots + 1, bites)
    assert "rtugate.service: Deactivated successfully" in machine.log[logged:]
    assert "rtugate.service: Failed" not in machine.log[logged:]
    assert machine.do("systemctl is-enabled rtugate") == "enabled"
    is_the_watchdog_rtugates(board)
    is_nothing_denied(board)
    is_as_saved(board)
    assert board.status()["last_restart"] == "clean stop"
    assert board.status()["alarms"] == []
    assert "/dev/watchdog0: i6300ESB" in board.journal()


def test_after_a_power_cut_the_station_comes_back_as_it_was_saved(board: Station, record_property: Record) -> None:
    save_at_console(board)
    board.machine.cut_power()
    begun_s = time.monotonic()
    board.machine.start()
    board.wait_works()
    record_property("from power to polling, with the watchdog", f"{time.monotonic() - begun_s:.0f} s")
    record_property(
        "from the unit's start to READY, right after the boot", f"{milliseconds_to_ready(board) / 1000:.1f} s"
    )
    is_the_watchdog_rtugates(board)
    is_nothing_denied(board)
    is_as_saved(board)
    assert board.status()["last_restart"] == "power"


def test_a_reload_applies_an_edit_in_the_same_process(board: Station, record_property: Record) -> None:
    pid = board.pid
    board.configure(unit=9)
    begun_s = time.monotonic()
    board.machine.do("systemctl reload rtugate.service")
    record_property("the reload took, with systemctl", f"{time.monotonic() - begun_s:.1f} s")
    assert board.show("ActiveState", "MainPID", "NRestarts") == {
        "ActiveState": "active",
        "MainPID": pid,
        "NRestarts": "0",
    }
    board.wait_served(unit=9)
    assert board.ask(unit=1) == []
    assert board.status()["last_restart"] == "clean stop"


def test_a_broken_file_at_reload_changes_nothing_and_is_told(board: Station) -> None:
    pid = board.pid
    board.configure(unit=9)
    board.machine.do(f"sed -i s/count.=.4/count=126/ {CONFIG} && chown rtugate: {CONFIG}")
    line = board.machine.do(f"grep -n count=126 {CONFIG}").partition(":")[0]
    wrong = f'rtugate.toml:{line}: master "field", request "meter": count 126 is more than 125'
    board.machine.do("systemctl reload rtugate.service")
    assert board.show("ActiveState", "MainPID", "NRestarts") == {
        "ActiveState": "active",
        "MainPID": pid,
        "NRestarts": "0",
    }
    assert wrong in board.journal()
    code, told = board.machine.order("rtugate check")
    assert (code, wrong in told) == (1, True)
    board.wait_served(unit=1)
    board.configure()
    board.machine.do("systemctl reload rtugate.service")
    assert board.status()["alarms"] == []


def test_a_killed_service_is_back_within_seconds(board: Station, record_property: Record) -> None:
    boot_id, pid = board.machine.boot_id, board.pid
    begun_s = time.monotonic()
    board.machine.do(f"kill -KILL {pid}")
    wait_new_process(board, pid)
    took_s = time.monotonic() - begun_s
    record_property("from the kill to polling", f"{took_s:.0f} s")
    assert took_s < DEVICE_TIMEOUT_S
    assert board.show("NRestarts")["NRestarts"] == "1"
    assert board.status()["last_restart"] == "crash"
    is_not_reset(board, boot_id)
    assert board.watchdog_state() == "active"


def test_a_standstill_of_the_whole_process_is_ended_by_systemd_before_the_hardware_bites(
    board: Station, record_property: Record
) -> None:
    boot_id, pid = board.machine.boot_id, board.pid
    begun_s = time.monotonic()
    board.machine.do(f"kill -STOP {pid}")
    board.machine.until(lambda: board.pid != pid, "systemd ends it", DEVICE_TIMEOUT_S)
    record_property("from the standstill to the end of the process", f"{time.monotonic() - begun_s:.1f} s")
    wait_new_process(board, pid)
    board.wait_works()
    record_property("from the standstill to polling, with the watchdog", f"{time.monotonic() - begun_s:.0f} s")
    assert board.show("NRestarts")["NRestarts"] == "1"
    assert "Watchdog timeout" in board.journal()
    is_not_reset(board, boot_id)
    record_property("the cause it tells", board.status()["last_restart"])


def test_a_hang_restarts_the_process_only(board: Station, record_property: Record) -> None:
    board.fit_faults(restart="always")
    boot_id, pid = board.machine.boot_id, board.pid
    begun_s = time.monotonic()
    board.commit("field", "deadlock")
    wait_new_process(board, pid)
    record_property("from the hang to polling", f"{time.monotonic() - begun_s:.0f} s")
    assert board.show("NRestarts")["NRestarts"] == "1"
    assert board.status()["last_restart"] == "hang of field"
    is_not_reset(board, boot_id)


# ------------------------------------------------------------------------------------------------ upgraded, taken away


def test_an_upgrade_of_a_working_station_keeps_everything_and_resets_nothing(
    board: Station, package: Path, record_property: Record
) -> None:
    save_at_console(board)
    boot_id, pid = board.machine.boot_id, board.pid
    kept = "cat /etc/rtugate/rtugate.toml; rtugate history"
    before = board.machine.do(kept)
    board.meter.forget()
    begun_s = time.monotonic()
    install(board, LATER)
    record_property("dpkg --install took", f"{time.monotonic() - begun_s:.0f} s")
    board.wait_works()
    record_property("the meter was not polled for", f"{board.meter.longest_s:.0f} s")
    assert installed_version(board) == f"{version_of(package)}+later"
    assert board.pid not in ("0", pid)
    assert board.machine.do(kept) == before
    is_as_saved(board)
    assert board.status()["last_restart"] == "clean stop"
    is_the_watchdog_rtugates(board)
    assert board.show("NRestarts", "NeedDaemonReload") == {"NRestarts": "0", "NeedDaemonReload": "no"}
    is_not_reset(board, boot_id)
    assert board.watchdog_state() == "active"


def test_remove_stops_it_for_good_the_next_install_goes_on_and_purge_leaves_nothing(board: Station) -> None:
    save_at_console(board)
    boot_id = board.machine.boot_id
    saved = board.machine.do(f"cat {CONFIG}")
    assert board.watchdog_state() == "active"

    board.machine.do("dpkg --remove rtugate")
    assert board.watchdog_state() == "inactive"
    assert board.machine.order("systemctl is-active rtugate.service")[1] == "inactive\n"
    assert board.machine.do(f"cat {CONFIG}") == saved
    assert board.machine.order("pgrep --full /usr/bin/rtugate") == (1, "")
    is_not_reset(board, boot_id)

    install(board)
    assert board.machine.do("systemctl is-enabled rtugate; systemctl is-active rtugate") == "enabled\nactive"
    board.wait_works()
    is_as_saved(board)
    assert board.status()["last_restart"] == "clean stop"

    purge(board)
    assert board.watchdog_state() == "inactive"
    assert [path for path in LEFT.split() if board.machine.order(f"test ! -e {path}")[0]] == []
    assert board.machine.order("systemctl list-unit-files --no-legend 'rtugate*'") == (1, "")
    assert board.machine.do("systemctl --failed --no-legend") == ""
    assert board.machine.order("find /etc/systemd /run/systemd/system /var/lib/systemd -name '*rtugate*'") == (0, "")
    assert board.machine.boot_id == boot_id


def test_an_upgrade_leaves_alone_what_somebody_has_switched_off(board: Station) -> None:
    board.machine.do("systemctl disable --now rtugate.service")
    install(board, LATER)
    assert board.machine.order("systemctl is-enabled rtugate; systemctl is-active rtugate")[1] == "disabled\ninactive\n"
    assert board.machine.order("pgrep --full /usr/bin/rtugate") == (1, "")
    board.machine.do("systemctl enable rtugate.service")
