"""What people see: Debian's telnet and picocom, each in a terminal of 80 x 24, at a gateway that runs (spec section 5).

Their screens are kept in real_screens/, a file each, as they stand on the glass; what differs from run to run (ports,
ages, times, counts) is replaced by the words of ``VARYING``. UPDATE_SCREENS=1 writes them anew, and fails.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import pytest

from gateway.modbus.pdu import Table
from gateway.simulator import Device, Simulator
from tests.hmi.real_station import eventually, real_station
from tests.hmi.terminals import CHEAP_HASH, PASSWORD
from tests.hmi.tmux import UPDATES, Terminal, matches, tmux
from tests.lines import cable
from tests.peers import client_tcp, free_port, unit_kwargs

SCREENS = Path(__file__).parent / "real_screens"
VARYING = (
    (r"127\.0\.0\.1:\d+", "127.0.0.1:<port>"),
    (r"\b\d\.\ds\b", "n.ns"),  # an age, as wide as it was
    (r"\b\d\d:\d\d:\d\d\b", "hh:mm:ss"),
    (r"hh:mm:ss\.\d\d\d\b", "hh:mm:ss.mmm"),
    (r"\b(good \d+ of|sent|good|asked|overruns|avg|p95|last|min|max|use) \d+(\.\d+)?\b", r"\1 N"),
    (r"\bgood \d+ of N", "good N of N"),
    (r"\bin \d+ s\b", "in N s"),
    (r"\| [0-9A-F]{2} .*", "| <bytes>"),
    (r"(?s)^.*Terminal ready\n", ""),  # picocom's own words, which its versions change
)
STATION = """\
# A boiler, and SCADA.
[hmi]
language = "{language}"
password = "{password}"
serial_hold = {hold}  # seconds

[hmi.serial]
line = "{console}"

[hmi.telnet]
listen = "127.0.0.1:{telnet}"

[[master]]
name = "field"
line = "tcp://127.0.0.1:{field}"

[[master.request]]
name = "boiler"
unit = 17
function = 3
address = 107
count = 3
every = 0.2
point = 0

[[slave]]
name = "scada"
line = "tcp://127.0.0.1:{scada}"
unit = 1
"""
MAIN, UNSAVED, LIVE = "rtugate>", "rtugate*>", "Any other key: back."


def needs(*programs: str) -> pytest.MarkDecorator:
    missing = [program for program in programs if shutil.which(program) is None]
    return pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}")


pytestmark = needs("tmux", "telnet", "picocom")
Opens = Callable[..., Terminal]


class Site:
    """A station, its device, and who looks at it."""

    def __init__(self, folder: Path, opened: Opens, device: Device, field: int) -> None:
        self.device = device
        self._folder, self._opened = folder, opened
        self._ports = {"telnet": free_port(), "scada": free_port(), "field": field}

    def text(self, console: str = "", hold: int = 30, language: str = "en", password: str = "") -> str:
        return STATION.format(console=console, hold=hold, language=language, password=password, **self._ports)

    def telnet(self, **size: int) -> Terminal:
        return self._opened("telnet", "127.0.0.1", str(self._ports["telnet"]), **size)

    def picocom(self, port: str) -> Terminal:
        terminal = self._opened("picocom", "--noreset", "--nolock", "--baud", "38400", port)
        terminal.sees("Terminal ready")
        return terminal

    def scada_writes(self, point: int, value: int) -> None:
        with client_tcp(self._ports["scada"]) as client:
            assert not client.write_register(point, value, **unit_kwargs(1)).isError()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    boiler = Device("boiler", 17)
    boiler.set(Table.HOLDING_REGISTERS, 107, [642, 65535, 32768])
    with Simulator() as simulator, tmux(tmp_path) as opened:
        yield Site(tmp_path, opened, boiler, simulator.add_tcp([boiler]))


@pytest.fixture(autouse=True)
def screens_written_anew_are_looked_at() -> Iterator[None]:
    yield
    if UPDATES:
        pytest.fail("the screens have been written anew: look at the difference")


def is_as_kept(terminal: Terminal, name: str) -> None:
    """The terminal comes to show what the file of that name says."""

    def look() -> str:
        screen = terminal.screen()
        for pattern, word in VARYING:
            screen = re.sub(pattern, word, screen)
        return screen

    matches(SCREENS / f"{name}.txt", look)


Tour = Sequence[tuple[str, str, str]]  # what is typed, with what the screen ends then, and where it is kept


def go_round(terminal: Terminal, tour: Tour) -> None:
    for keys, end, name in tour:
        if keys:
            terminal.type(*keys.split())
        terminal.ends_with(end)
        is_as_kept(terminal, name)


# ------------------------------------------------------------------------------------------------ telnet


def test_the_program_telnet_shows_each_screen(site: Site, tmp_path: Path) -> None:
    with real_station(tmp_path, site.text()):
        person = site.telnet()
        go_round(
            person,
            [
                ("", MAIN, "telnet-main-menu"),
                ("?", MAIN, "telnet-help"),
                ("d 3 0 Enter 4 Enter", LIVE, "telnet-data"),
            ],
        )
        site.device.set(Table.HOLDING_REGISTERS, 107, [643, 0, 1])
        person.sees("   643 ")
        is_as_kept(person, "telnet-data-a-moment-later")
        go_round(
            person,
            [
                ("f", LIVE, "telnet-data-32-bits"),
                ("Escape", MAIN, "telnet-data-left"),
                ("r", "field: requests [s]:", "telnet-requests"),
                ("0 i", "Any key: back.", "telnet-status"),
            ],
        )
        person.type("q")
        person.ends_with(MAIN)
        go_round(
            person,
            [
                ("n", "Lines:", "telnet-lines"),
                ("0 k 7 Enter w", "Save this? (y/n/c):", "telnet-save"),
            ],
        )
        person.type("y")
        person.sees("Saved.")
        person.type("q")
        person.sees("Connection closed by foreign host.")


def test_whoever_waits_at_telnet_is_told_why_and_what_he_has_lost(site: Site, tmp_path: Path) -> None:
    with cable() as (near, far), real_station(tmp_path, site.text(near, hold=300)) as station:
        first = site.telnet()
        first.ends_with("if nobody types there.")
        is_as_kept(first, "waiting-from-the-start")
        station.reload(site.text(near, hold=0))
        first.ends_with(MAIN)
        station.reload(site.text(near, hold=300))
        first.sees("The file has been reloaded.")
        first.type("z", "3", "5", "Enter", "12")
        first.ends_with("12")
        at_the_console = site.picocom(far)
        at_the_console.type("Enter")
        at_the_console.ends_with(MAIN)
        is_as_kept(first, "taken-by-the-serial-console")
        second = site.telnet()
        second.ends_with("before you.")
        is_as_kept(second, "waiting-as-the-second")
        first.type("34", "Enter", "d")
        at_the_console.type("d", "3", "5", "Enter", "Enter")
        at_the_console.sees("never")
        at_the_console.type("Escape")
        at_the_console.ends_with(MAIN)
        at_the_console.type("q")
        station.reload(site.text(near, hold=0))
        first.ends_with(MAIN)
        second.ends_with("127.0.0.1 (telnet) has the menu.")


def test_a_password_is_asked_for_and_never_shown(site: Site, tmp_path: Path) -> None:
    with real_station(tmp_path, site.text(password=CHEAP_HASH)):
        person = site.telnet()
        person.ends_with("Password:")
        person.type("not this one", "Enter")
        person.sees("Wrong password.")
        person.type(PASSWORD, "Enter")
        person.ends_with(MAIN)
        is_as_kept(person, "telnet-login")


def test_telnet_fills_a_window_of_any_size_and_follows_when_it_changes(site: Site, tmp_path: Path) -> None:
    with real_station(tmp_path, site.text()):
        person = site.telnet(columns=100, rows=40)
        person.ends_with(MAIN)
        person.type("d", "3", "0", "Enter", "200", "Enter")
        for columns, rows in ((100, 40), (60, 16), (132, 24)):
            person.resize(columns, rows)
            screen = eventually(person.screen, partial(is_a_whole_page, rows))
            assert max(map(len, screen.split("\n"))) < columns


def is_a_whole_page(rows: int, screen: str) -> bool:
    lines = screen.split("\n")
    return len(lines) == rows and lines[0].startswith("Holding") and lines[-1].startswith("page 1 of ")


# ------------------------------------------------------------------------------------------------ picocom


def test_picocom_shows_each_screen(site: Site, tmp_path: Path) -> None:
    with cable() as (near, far), real_station(tmp_path, site.text(near)) as station:
        station.wait_for("serial console: open")
        person = site.picocom(far)
        go_round(
            person,
            [
                ("Enter", MAIN, "picocom-main-menu"),
                ("d 3 0 Enter 4 Enter", LIVE, "picocom-data"),
            ],
        )
        site.scada_writes(3, 0xABCD)
        person.sees(" ABCD ")
        is_as_kept(person, "picocom-data-a-moment-later")
        person.type("x")
        person.ends_with(MAIN)
        go_round(
            person,
            [
                ("z 3 5 Enter 12 BSpace 3 Enter", MAIN, "picocom-change"),
                ("a e", UNSAVED, "picocom-off"),
            ],
        )
        site.scada_writes(30, 7)
        person.sees(": 7 ")
        is_as_kept(person, "picocom-writes")
        person.type("e", "t", "2")
        person.sees("until any key")
        site.scada_writes(30, 8)
        person.sees(": 8 ")
        is_as_kept(person, "picocom-traffic")


def test_accents_come_through_both(site: Site, tmp_path: Path) -> None:
    with cable() as (near, far), real_station(tmp_path, site.text(near, hold=0, language="es")) as station:
        station.wait_for("serial console: open")
        by_telnet = site.telnet()
        by_telnet.ends_with(MAIN)
        is_as_kept(by_telnet, "telnet-spanish")
        by_serial = site.picocom(far)
        by_serial.type("Enter")
        by_serial.ends_with(MAIN)
        is_as_kept(by_serial, "picocom-spanish")


# ------------------------------------------------------------------------------------------------ what is kept


def test_every_screen_that_is_kept_is_compared() -> None:
    here = Path(__file__).read_text()
    assert [path.name for path in SCREENS.iterdir() if f'"{path.stem}"' not in here] == []
