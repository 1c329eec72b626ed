"""A station is configured from nothing by keys alone, saved, started anew, and polls (spec section 5).

All of it is real: the gateway's process, a telnet connection or a pty, pymodbus as the device and as SCADA.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.modbus.pdu import Table
from gateway.simulator import Device, Simulator
from gateway.store import load
from tests.hmi.real_station import Hands, RealStation, Steps, eventually, real_station, scada_reads
from tests.lines import pty_pair
from tests.peers import free_port

PASSWORD = "open sesame"  # noqa: S105 - opens nothing but these tests
IAC, DONT, WONT, DO, WILL = 255, 254, 252, 253, 251
ECHO, SUPPRESS_GO_AHEAD, NAWS = 1, 3, 31
REFUSED = bytes([IAC, DONT, ECHO, IAC, DONT, SUPPRESS_GO_AHEAD, IAC, WONT, SUPPRESS_GO_AHEAD, IAC, WONT, NAWS])
AGREED = bytes([IAC, DO, ECHO, IAC, DO, SUPPRESS_GO_AHEAD, IAC, WILL, SUPPRESS_GO_AHEAD, IAC, WONT, NAWS])
NOTHING_BUT_TELNET = '# The way in; the rest is typed.\n[hmi.telnet]\nlisten = "127.0.0.1:{port}"  # this desk\n'
AN_OLD_SITE = """\
[hmi.serial]
line = "{console}"

[hmi.telnet]
listen = "127.0.0.1:{telnet}"

[[master]]
name = "old"
enabled = false
line = "/dev/ttyS7"

[[master.request]]
unit = 3
function = 4
address = 0
count = 4
point = 0
"""
MAIN, UNSAVED = "rtugate> ", "rtugate*> "
UNIT, POINT = 5, 40  # of the slave, and where the device's values are to be found


@pytest.fixture
def device() -> Device:
    """A boiler with three registers."""
    boiler = Device("boiler", 17)
    boiler.set(Table.HOLDING_REGISTERS, 107, [642, 630, 544])
    return boiler


@pytest.fixture
def simulator() -> Iterator[Simulator]:
    with Simulator() as running:
        yield running


# ------------------------------------------------------------------------------------------------ what is typed


def a_master(line: str) -> Steps:
    return [
        (MAIN, "n"),
        ("Lines: ", "n"),
        ("Kind: ", "1"),
        ("Name: ", "field\r"),
        ("Port or address: ", f"{line}\r"),
        ("Framing [3]: ", "\r"),
        ("Response timeout in seconds [2.5]: ", "0.5\r"),
        ("Gap within an answer that ends it, in seconds [0.2]: ", "\r"),
        ("Extra silence before each request, in seconds [0]: ", "\r"),
        ("Retries (0-100) [0]: ", "\r"),
    ]


def a_slave(line: str) -> Steps:
    return [
        ("Lines: ", "n"),
        ("Kind: ", "2"),
        ("Name: ", "scada\r"),
        ("Port or address: ", f"{line}\r"),
        ("Framing [3]: ", "\r"),
        ("Unit identifier (1-247) [1]: ", f"{UNIT}\r"),
        ("Access [1]: ", "\r"),
        ("Old data [1]: ", "\r"),
        ("Networks [any]: ", "\r"),
        ("Lines: ", "0"),
    ]


def a_request(last_unit: int) -> Steps:
    return [
        (UNSAVED, "r"),
        ("field: requests [s]: ", "n"),
        (f"Unit (0-{last_unit}): ", "17\r"),
        ("Function code: ", "3\r"),
        ("Address (0-65535): ", "107\r"),
        ("Count (1-125): ", "3\r"),
        ("Cycle time in seconds [1]: ", "0.1\r"),
        ("First point (0-1997): ", f"{POINT}\r"),
        ("field: requests [s]: ", "0"),
    ]


A_PASSWORD: Steps = [
    (UNSAVED, "p"),
    ("New password: ", f"{PASSWORD}\r"),
    ("The same again: ", f"{PASSWORD}\r"),
]
A_SAVE: Steps = [
    (UNSAVED, "w"),
    ("Save this? (y/n/c)", "y"),
    ("Saved.", ""),
]
A_RESTART: Steps = [(MAIN, "x"), ("Restart the gateway? (y/n): ", "y"), ("Restarting.", "")]


def factory_settings(port: str, slave_line: str) -> Steps:
    """From whatever there is to the factory's two lines, which are given their ports."""
    return [
        ("Press any key for the menu.", "\r"),
        (MAIN, "f"),
        ("Go back to factory settings? (y/n): ", "y"),
        (UNSAVED, "a"),
        ("Port or address: ", f"{port}\r"),
        ("Speed [2]: ", "5"),
        ("Parity [2]: ", "1"),
        ("Stop bits (1 or 2) [1]: ", "2"),
        (UNSAVED, "s"),
        ("Port or address: ", f"{slave_line}\r"),
        (UNSAVED, "k"),
        ("Unit identifier (1-247) [1]: ", f"{UNIT}\r"),
    ]


# ------------------------------------------------------------------------------------------------ the tests


def polls(device: Device, scada_port: int) -> None:
    """SCADA finds what the device says now, and what it says a moment later."""
    for values in ([642, 630, 544], [643, 0, 65535]):
        device.set(Table.HOLDING_REGISTERS, 107, values)
        scada_finds(scada_port, values)


def scada_finds(port: int, values: list[int]) -> None:
    eventually(lambda: scada_reads(port, UNIT, POINT, len(values)), lambda read: read == values)


def logs_in(port: int, answers: bytes, ends_keys_with_enter: bool) -> None:
    """Whoever comes after the restart needs the password that was typed before it."""
    with socket.create_connection(("127.0.0.1", port)) as terminal:
        terminal.sendall(answers)
        hands = Hands(terminal.fileno(), ends_keys_with_enter)
        hands.carry_out([("Password: ", "wrong pass\r"), ("Wrong password.", ""), ("Password: ", f"{PASSWORD}\r")])
        hands.carry_out([(MAIN, "q")])
        hands.sees_the_end()


@pytest.mark.parametrize(
    ("answers", "ends_keys_with_enter"), [(AGREED, False), (REFUSED, True)], ids=["character mode", "line mode"]
)
def test_by_telnet_from_an_empty_station_to_one_that_polls_after_a_restart(
    tmp_path: Path, simulator: Simulator, device: Device, answers: bytes, ends_keys_with_enter: bool
) -> None:
    telnet, scada, field = free_port(), free_port(), simulator.add_tcp([device])
    with real_station(tmp_path, NOTHING_BUT_TELNET.format(port=telnet)) as station:
        with socket.create_connection(("127.0.0.1", telnet)) as terminal:
            terminal.sendall(answers)
            hands = Hands(terminal.fileno(), ends_keys_with_enter)
            hands.carry_out(a_master(f"tcp://127.0.0.1:{field}"))
            hands.carry_out(a_slave(f"tcp://127.0.0.1:{scada}"))
            hands.carry_out(a_request(255))
            polls(device, scada)
            hands.carry_out(A_PASSWORD)
            hands.carry_out(A_SAVE)
            hands.carry_out(A_RESTART)
            assert "The menu is closed" in hands.sees_the_end()
            assert b"Please type" not in hands.seen  # no key was taken for another one
            assert b"A name has" not in hands.seen
        station.has_started()
        polls(device, scada)
        logs_in(telnet, answers, ends_keys_with_enter)
        keeps_what_was_there(station, NOTHING_BUT_TELNET.format(port=telnet))
        assert station.stop() == 0


def keeps_what_was_there(station: RealStation, before: str) -> None:
    """The file says more than before, and of what it said before each line is still there."""
    text = station.file.read_text()
    assert [line for line in text.splitlines() if line in before.splitlines()] == before.splitlines()
    assert load(station.file).findings == []


def test_by_the_serial_console_from_factory_settings_to_one_that_polls_after_a_restart(
    tmp_path: Path, simulator: Simulator, device: Device
) -> None:
    scada, port = free_port(), simulator.add_serial([device])
    with (
        pty_pair() as console,
        real_station(tmp_path, AN_OLD_SITE.format(console=console.device, telnet=free_port())) as station,
    ):
        hands = Hands(console.wire)
        hands.carry_out(factory_settings(port, f"tcp://127.0.0.1:{scada}"))
        hands.carry_out(a_request(247))
        polls(device, scada)
        hands.carry_out(A_SAVE)
        assert station.stop() == 0
        station.start()
        polls(device, scada)
        (master,), (slave,) = load(station.file).config.master, load(station.file).config.slave
        assert (master.name, master.line, master.baudrate, master.parity, master.stop_bits) == (
            "field", port, 115200, "none", 2,
        )  # fmt: skip
        assert (slave.name, slave.unit) == ("scada", UNIT)
        assert [request.title for request in master.request] == ["u17-f3-107"]
        hands.carry_out([("Press any key for the menu.", "\r"), (MAIN, "w"), ("There is nothing to save.", "")])
