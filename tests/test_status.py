"""`rtugate status`: the text is that of key I, the JSON has every counter, a gateway that runs gives both."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from gateway.errors import RequestInvalid
from gateway.hmi.station import Told
from gateway.status import status, status_data
from tests.hmi.desk import DeskStation
from tests.lines import pty_pair
from tests.test_cli import running, wait_for_line

STATIONS = Path(__file__).parent / "hmi" / "stations"


@pytest.fixture
def station() -> DeskStation:
    found = DeskStation((STATIONS / "plant.toml").read_text())
    found.fields["field"].refusing[3, 2] = 2
    found.pass_s(5.0)
    return found


def test_the_text_is_what_the_menu_shows(station: DeskStation) -> None:
    station.told_alarms = [Told("{name}: {trouble}", {"name": "plc", "trouble": "/dev/ttyS3 is not there"})]
    lines = status(station).splitlines()
    assert lines[0].startswith("Running for 01:01:")
    assert lines[1] == "ALARM: plc: /dev/ttyS3 is not there"
    assert next(line for line in lines if line.startswith(("Master", "Slave"))).startswith("Master field: idle, /dev/")


def test_the_object_has_every_line_request_and_counter(station: DeskStation) -> None:
    told = json.loads(status(station, "--json"))
    assert told == status_data(station)
    assert [line["name"] for line in told["masters"]] == [line.name for line in station.config.master]
    assert [line["name"] for line in told["slaves"]] == [line.name for line in station.config.slave]
    field = told["masters"][0]
    assert field["sent"] == field["good"] + sum(field["exceptions"].values()) > 0
    states = {request["name"]: request["state"] for request in field["requests"]}
    assert states["doors"] == "bad"
    assert {request["name"]: request["exceptions"] for request in field["requests"]}["doors"] == {"2": 1}
    assert told["unsaved_changes"] is False
    assert told["alarms"] == []


def test_without_safe_mode_and_a_watchdog_the_object_says_so(station: DeskStation) -> None:
    told = status_data(station)
    assert (told["safe_mode"], told["watchdog"], told["last_restart"]) == (False, None, "clean stop")


def test_safe_mode_the_watchdog_and_the_cause_are_told_in_the_text_and_in_the_object(station: DeskStation) -> None:
    station.enter_safe_mode(1800.0)
    station.last_restart = Told("hang of {name}", {"name": "field"})
    station.told_watchdog = Told("{device}: well", {"device": "/dev/watchdog"})
    told = json.loads(status(station, "--json"))
    assert (told["safe_mode"], told["watchdog"]) == (True, "/dev/watchdog: well")
    assert told["last_restart"] == "hang of field"
    assert told["alarms"] == ["safe mode: 3 bad restarts in a row; all lines are in maintenance"]
    assert [line["state"] for line in told["masters"] + told["slaves"]] == ["maintenance"] * 4
    assert all(line["enabled"] for line in told["masters"] + told["slaves"])
    lines = status(station).splitlines()
    assert lines[0].endswith("; last restart: hang of field")
    assert lines[1:4] == [
        "ALARM: safe mode: 3 bad restarts in a row; all lines are in maintenance",
        "Safe mode: G ends it; else it ends in 00:30:00, for one more try.",
        "Hardware watchdog: /dev/watchdog: well",
    ]


def test_a_line_that_is_being_made_anew_says_so(station: DeskStation) -> None:
    station.masters.pop("field").close()
    del station.slaves["scada"]
    told = status_data(station)
    assert told["masters"][0]["state"] == told["slaves"][0]["state"] == "being started anew"


def test_any_other_argument_is_refused(station: DeskStation) -> None:
    with pytest.raises(RequestInvalid, match="--json"):
        status(station, "--xml")


def ask(state: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gateway", "status", "--state", str(state), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=20)


def test_a_gateway_that_runs_answers(tmp_path: Path) -> None:
    with pty_pair() as pty:
        file = tmp_path / "rtugate.toml"
        file.write_text(
            f'[[slave]]\nname = "plc"\nunit = 1\nline = "{pty.device}"\nparity = "none"\n[hmi.telnet]\nlisten = ""\n'
        )
        with running("run", "-c", str(file)) as process:
            said = wait_for_line(process, "control socket: listening on ")
            state = Path(said.splitlines()[-1].rpartition(" ")[2]).parent
            text, told = ask(state), ask(state, "--json")
            process.terminate()
            assert process.wait(timeout=5.0) == 0
    assert (text.returncode, told.returncode) == (0, 0), text.stderr + told.stderr
    assert "Slave plc: answering" in text.stdout
    assert json.loads(told.stdout)["slaves"][0]["name"] == "plc"


def test_where_none_runs_that_is_said_and_the_exit_code_is_1(tmp_path: Path) -> None:
    ended = ask(tmp_path)
    assert ended.returncode == 1
    assert ended.stderr == f"rtugate: no gateway runs here (no socket at {tmp_path}/control)\n"
