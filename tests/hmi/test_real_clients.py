"""What people see: Debian's telnet and picocom, each in a terminal of 80 x 24, at a gateway that runs (spec section 5).

Their screens are kept in real_screens/, a file each, as they stand on the glass; what differs from run to run (ports,
ages, times, counts) is replaced by the words of ``VARYING``. UPDATE_SCREENS=1 writes them anew, and fails.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from gateway.modbus.pdu import Table
from gateway.simulator import Device, Simulator
from tests.hmi.real_station import RealStation, real_station
from tests.hmi.tmux import UPDATES, Terminal, matches, tmux
from tests.lines import cable
from tests.peers import client_tcp, free_port, unit_kwargs

SCREENS = Path(__file__).parent / "real_screens"
VARYING = (
    (r"127\.0\.0\.1:\d+", "127.0.0.1:<port>"),
    (r"\b\d\.\ds\b", "n.ns"),  # an age, as wide as it was
    (r"\b\d\d:\d\d:\d\d\b", "hh:mm:ss"),
    (r"\b(sent|good|of|asked|overruns|avg|p95|last|min|max) \d+\b", r"\1 N"),
    (r"\bin \d+ s\b", "in N s"),
)
STATION = """\
# A boiler, and SCADA.
[hmi]
language = "{language}"
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

    def text(self, console: str = "", hold: int = 30, language: str = "en") -> str:
        return STATION.format(console=console, hold=hold, language=language, **self._ports)

    def telnet(self, **size: int) -> Terminal:
        return self._opened("telnet", "127.0.0.1", str(self._ports["telnet"]), **size)

    def picocom(self, port: str) -> Terminal:
        return self._opened("picocom", "--quiet", "--noreset", "--nolock", "--baud", "38400", port)

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
        is_as_kept(person, "telnet-data-a-moment-later")
        go_round(
            person,
            [
                ("f", LIVE, "telnet-data-32-bits"),
                ("Escape", MAIN, "telnet-data-left"),
                ("r", "field: requests [s]:", "telnet-requests"),
                ("0 i", "Any key: back.", "telnet-status"),
                ("Escape", MAIN, "telnet-status-left"),
                ("n", "Lines:", "telnet-lines"),
                ("0 k 7 Enter w", "Save this? (y/n/c):", "telnet-save"),
                ("y", MAIN, "telnet-saved"),
            ],
        )
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
