"""Safe mode and the hardware watchdog as a person sees them; the screens themselves are in the transcripts."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gateway.hmi.keys import ESC
from gateway.hmi.screens.status import status_head, status_rows
from gateway.hmi.station import Job, Told
from gateway.hmi.texts import translation
from tests.hmi.catalogues import LANGUAGES
from tests.hmi.desk import PROMPTS, SAFE_MODE, STATIONS, Desk, DeskStation, desk_of


class CountingStation(DeskStation):
    """A station that counts how often safe mode was to be ended."""

    ended = 0

    def end_safe_mode(self, told: Callable[[], None]) -> Job:
        self.ended += 1
        return super().end_safe_mode(told)


@pytest.fixture
def safe() -> Desk:
    """A person at a station in safe mode, for an hour less ten minutes yet."""
    station = CountingStation((STATIONS / "boiler.toml").read_text())
    station.enter_safe_mode(3000.0)
    return Desk(station)


def ended(desk: Desk) -> int:
    assert isinstance(desk.station, CountingStation)
    return desk.station.ended


# ------------------------------------------------------------------------------------------------ G


def test_yes_ends_safe_mode_once_and_every_line_that_is_on_works_again(safe: Desk) -> None:
    safe.wait(5.0)
    assert safe.station.fields["field"].asked == []
    safe.type("gy")
    assert (ended(safe), safe.station.is_safe, safe.station.alarms()) == (1, False, [])
    assert safe.screen.endswith("\nSafe mode is over: all lines run as configured.\nrtugate> ")
    safe.wait(5.0)
    assert safe.station.fields["field"].asked != []


@pytest.mark.parametrize("answer", ["n", ESC, "123456789" + ESC])
def test_who_does_not_say_yes_stays_in_safe_mode(safe: Desk, answer: str) -> None:
    safe.type("g" + answer)
    assert (ended(safe), safe.station.is_safe) == (0, True)
    assert safe.screen.endswith(PROMPTS)


def test_without_safe_mode_g_asks_nothing_and_changes_nothing() -> None:
    desk = Desk(CountingStation((STATIONS / "boiler.toml").read_text()))
    desk.type("g")
    assert desk.told == "The gateway is not in safe mode."
    assert (ended(desk), desk.screen.endswith("rtugate> ")) == (0, True)


def test_the_end_of_safe_mode_is_not_waited_for_for_ever(safe: Desk) -> None:
    safe.station.is_slow = True
    safe.type("gy")
    assert safe.told == "This takes unusually long; see I."


def test_who_does_not_wait_for_the_end_is_told_that_it_goes_on(safe: Desk) -> None:
    safe.station.is_slow, safe.is_working = True, False
    safe.type("gy" + ESC)
    assert safe.told == "It goes on by itself; I shows the station."
    assert safe.screen.endswith(PROMPTS)


def test_an_end_that_fails_says_why_and_not_that_safe_mode_is_over(safe: Desk) -> None:
    safe.station.is_slow, safe.is_working = True, False
    safe.type("gy")
    safe.station.finish_work("it failed; the log says why")
    assert safe.wait(0.1) == "it failed; the log says why\nrtugate> "


# ------------------------------------------------------------------------------------------------ A and S


@pytest.mark.parametrize(("key", "name"), [("a", "field"), ("s", "scada")])
def test_a_line_switched_in_safe_mode_is_so_in_the_configuration_and_stays_in_maintenance(
    safe: Desk, key: str, name: str
) -> None:
    def works() -> bool:
        view = safe.station.master(name) or safe.station.slave(name)
        assert view is not None
        return view.enabled

    def is_on() -> bool:
        config = safe.station.config
        return next(line.enabled for line in [*config.master, *config.slave] if line.name == name)

    safe.type(key)
    assert (safe.told, is_on(), works()) == (f"{name} is off: maintenance.", False, False)
    safe.type(key)
    assert safe.told == f"{name} is on, but stays in maintenance until safe mode ends (G)."
    assert (is_on(), works()) == (True, False)
    safe.type("gy")
    assert works()
    safe.type(key * 2)
    assert safe.told == f"{name} is on."


# ------------------------------------------------------------------------------------------------ T


def test_the_traffic_of_a_line_in_safe_mode_is_not_waited_for(safe: Desk) -> None:
    safe.type("t1")
    assert safe.told == "field is in maintenance: safe mode; G ends it."
    assert safe.screen.endswith("rtugate> ")


def test_of_a_line_that_is_off_the_key_that_switches_it_on_is_told_in_safe_mode_too(safe: Desk) -> None:
    safe.type("at1")
    assert safe.told == "field is in maintenance: A or S switches it on."


# ------------------------------------------------------------------------------------------------ I and the main menu


def rows_of(desk: Desk) -> list[str]:
    return status_rows(desk.ui, desk.station)


def test_the_main_menu_says_below_the_alarms_how_safe_mode_ends(safe: Desk) -> None:
    assert safe.screen.splitlines()[-3:] == [
        "ALARM: safe mode: 3 bad restarts in a row; all lines are in maintenance",
        "Safe mode: G ends it; else it ends in 00:50:00, for one more try.",
        "rtugate> ",
    ]


def test_the_time_left_goes_down_and_never_below_nothing(safe: Desk) -> None:
    safe.station.time.pass_s(1.0)
    assert "Safe mode: G ends it; else it ends in 00:49:59, for one more try." in rows_of(safe)
    safe.station.time.pass_s(5000.0)  # the supervisor has not looked yet
    assert "Safe mode: G ends it; else it ends in 00:00:00, for one more try." in rows_of(safe)


def test_without_safe_mode_and_a_watchdog_nothing_is_said_of_them(boiler: Desk) -> None:
    assert "afe mode" not in boiler.type("m")
    assert rows_of(boiler)[:2] == ["No alarms.", "Master field: no connection, /dev/ttyS2 19200 8E1"]


def test_a_trouble_of_the_watchdog_is_told_to_its_end(boiler: Desk) -> None:
    trouble = "/dev/watchdog cannot be opened: " + "device or resource busy " * 5 + "end"
    boiler.station.told_watchdog = Told("hardware watchdog: {trouble}", {"trouble": trouble})
    rows = rows_of(boiler)
    told = rows[1 : next(place for place, row in enumerate(rows) if row.startswith("Master field"))]
    assert " ".join(told) == f"Hardware watchdog: hardware watchdog: {trouble}"
    assert max(len(row) for row in told) < 80


@pytest.mark.parametrize(("count", "end"), [(2, "line-2-{x}"), (30, "..")])
def test_a_cause_that_is_long_is_told_and_the_picture_stays_as_tall_as_the_terminal(count: int, end: str) -> None:
    desk = desk_of("plant")
    names = ", ".join(f"line-{n}-{'x' * 24}" for n in range(1, count + 1))
    desk.station.last_restart = Told("watchdog reset after a hang of {name}", {"name": names})
    head = status_head(desk.ui, desk.station)
    assert " ".join(head).endswith(end.format(x="x" * 24))
    assert "last restart: watchdog reset after a hang of line-1-" in " ".join(head)
    assert max(len(line) for line in head) < 80
    shown = desk.type("i")
    assert shown.count("\n") == desk.ui.rows + 1  # the one that ends the prompt's line, then a full picture
    assert "Master field: " in shown


# ------------------------------------------------------------------------------------------------ languages


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize(
    "text",
    [SAFE_MODE, "hang of {name}", "watchdog reset", "watchdog reset after a hang of {name}", "crash", "power"],
)
def test_what_the_supervision_tells_is_told_in_the_person_s_language(language: str, text: str) -> None:
    said = Told(text, {"count": 3, "name": "field"}).words(translation(language))
    assert said != Told(text, {"count": 3, "name": "field"}).words(str)
    assert ("field" in said) == ("{name}" in text)


@pytest.mark.parametrize("language", LANGUAGES)
def test_the_alarm_and_what_stands_below_it_take_a_line_each_in_every_language(language: str) -> None:
    station = DeskStation((STATIONS / "boiler.toml").read_text())
    station.enter_safe_mode(3000.0)
    below = Desk(station, language, is_ascii=True).screen.partition("  Q  ")[2].splitlines()[2:]
    assert below[2] == "rtugate> "
    assert [" G " in line for line in below] == [False, True, False]
