"""The virtual board as whoever has installed the package finds it: ``delivered`` puts the .deb on it.

What Debian has to bring is what the package says that it depends on, and nothing else. Its file has, beside the serial
ports, what is dangerous and therefore off at first: Modbus on port 502 and telnet on port 23, on every address.
"""

from __future__ import annotations

import json
import shlex
import shutil
from functools import partial
from pathlib import Path
from typing import Final

from gateway.config import WatchdogConfig
from gateway.hmi.access import hash_password
from tests.changing import section
from tests.system.board.station import INSTALL_LIMIT_S, OUR_UNIT, Delivery, Station, configuration
from tests.system.package.deb import ROOT, another_version, depends_of, field

HERE: Final = Path(__file__).parent
ACCEPTANCE: Final = ROOT / "packaging" / "debian" / "tests" / "installed-service"
PACKAGE, LATER = "/mnt/rtugate.deb", "/mnt/later.deb"
VISIT: Final = "python3 /mnt/visit.py"
MODBUS, TELNET = 502, 23
EVERY_ADDRESS, HERE_ONLY = "0.0.0.0", "127.0.0.1"
PASSWORD: Final = "correct horse"  # noqa: S105 - of nobody but this board
INSTALL: Final = "DEBIAN_FRONTEND=noninteractive dpkg --install"


def delivered(package: Path, scratch: Path) -> Delivery:
    """Return how *package* gets onto a board. *scratch*: a folder for a later version of it."""

    def fill(folder: Path) -> None:
        shutil.copy(package, folder / Path(PACKAGE).name)
        shutil.copy(another_version(package, scratch), folder / Path(LATER).name)
        shutil.copy(HERE / "visit.py", folder)
        shutil.copy(ACCEPTANCE, folder)

    return Delivery(
        packages=depends_of(package),
        fill=fill,
        script=f"{INSTALL} {PACKAGE}\nsystemctl stop rtugate.service",
        configuration=partial(configuration, timeout_s=WatchdogConfig().timeout, beside=_beside()),
    )


def _beside() -> str:
    return "\n".join(
        (
            section("[[slave]]", name="scada", line=f"tcp://{EVERY_ADDRESS}:{MODBUS}", unit=OUR_UNIT),
            section("[hmi]", serial_hold=0, password=hash_password(PASSWORD)),  # telnet waits for no console
            section("[hmi.telnet]", listen=f"{EVERY_ADDRESS}:{TELNET}"),
        )
    )


def version_of(package: Path) -> str:
    return field(package, "Version")


def installed_version(board: Station) -> str:
    """Return the version of rtugate on the *board*; "" where it is not installed."""
    _code, told = board.machine.order("dpkg-query --show --showformat='${db:Status-Status} ${Version}' rtugate")
    return told.removeprefix("installed ") if told.startswith("installed ") else ""


def install(board: Station, package: str = PACKAGE) -> str:
    return board.machine.do(f"{INSTALL} {package}", INSTALL_LIMIT_S)


def purge(board: Station) -> str:
    return board.machine.do("dpkg --purge rtugate", INSTALL_LIMIT_S)


def visit(board: Station, *words: object) -> str:
    """Return what a visitor on the board is shown: see ``visit.py``."""
    return board.machine.do(f"{VISIT} {shlex.join(map(str, words))}")


def read_tcp(board: Station, point: int, count: int, address: str = HERE_ONLY) -> list[int]:
    """Return the holding registers that SCADA reads over TCP."""
    values: list[int] = json.loads(visit(board, "modbus", address, MODBUS, OUR_UNIT, point, count))
    return values
