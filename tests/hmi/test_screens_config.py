"""What the screens configure: which keys change, what is refused, what somebody else has changed meanwhile."""

from __future__ import annotations

from typing import Any

import pytest

from gateway.config import Config, LineConfig, RequestConfig, Section
from gateway.hmi.access import check_password
from gateway.hmi.keys import ENTER, ESC
from gateway.hmi.screens.changes import given, replaced, with_line
from gateway.hmi.station import Job
from gateway.modbus.pdu import Table
from tests.hmi.desk import PROMPTS, STALE, STATIONS, Desk, DeskStation

# ------------------------------------------------------------------------------------------------ R


def requests_of(desk: Desk, master: int = 0) -> list[RequestConfig]:
    return desk.station.config.master[master].request


def test_a_new_request_holds_what_was_typed_and_no_more(boiler: Desk) -> None:
    boiler.type("rn18\r3\r200\r2\r\r20\r")
    keys = {"unit": 18, "function": 3, "address": 200, "count": 2, "point": 20}
    assert given(requests_of(boiler)[-1]) == keys
    boiler.type("n18\r5\r7\r\r2\r9\r")
    assert given(requests_of(boiler)[-1]) == {
        "unit": 18,
        "function": 5,
        "address": 7,
        "count": 1,
        "every": 2.0,
        "point": 9,
    }


def test_a_request_that_is_kept_in_all_is_the_same(boiler: Desk) -> None:
    before = boiler.station.config
    boiler.type("rm" + ENTER * 7)
    assert boiler.station.config is before
    assert not boiler.station.is_unsaved


def test_a_changed_request_keeps_its_place_and_its_spelling(boiler: Desk) -> None:
    boiler.type("rm18" + ENTER * 7)
    assert [request.name for request in requests_of(boiler)] == ["boiler", "burner", "setpoint"]
    assert given(requests_of(boiler)[0]) == {
        "name": "boiler",
        "unit": 18,
        "function": "read-holding-registers",
        "address": 107,
        "count": 3,
        "point": 107,
    }


def test_a_name_made_of_what_is_asked_is_not_written_down(boiler: Desk) -> None:
    boiler.type("rm" + ENTER * 6 + "u17-f3-107\r")
    assert "name" not in given(requests_of(boiler)[0])
    boiler.type("m" + ENTER * 6 + "tank\r")
    assert requests_of(boiler)[0].name == "tank"


def test_when_a_read_becomes_a_write_what_is_of_no_use_is_left_out() -> None:
    desk = Desk(
        DeskStation(
            '[[master]]\nname = "field"\nline = "/dev/ttyS2"\n[[master.request]]\nunit = 1\nfunction = 3\n'
            'address = 0\ncount = 1\npoint = 0\non_failure = "zero"\nstale_after = 9.0\ntable = "input-registers"\n'
        )
    )
    assert "register: input 1" in desk.type("r")
    desk.type("m\r16\r" + ENTER * 5)
    assert "No longer of use and left out: on_failure, stale_after" in desk.screen
    assert given(requests_of(desk)[0]).keys() == {"unit", "function", "address", "count", "point", "table"}
    desk.type("m\r1\r" + ENTER * 5)
    assert "No longer of use and left out: table" in desk.screen
    assert requests_of(desk)[0].target is Table.COILS


def test_a_count_too_large_for_another_function_is_cut(boiler: Desk) -> None:
    boiler.type("rn18\r1\r0\r1000\r\r100\rm\r3" + ENTER * 4 + "300" + ENTER * 2)
    assert requests_of(boiler)[-1].count == 125


def test_deleting_takes_the_one_that_is_shown(boiler: Desk) -> None:
    boiler.type("rsby")
    assert [request.name for request in requests_of(boiler)] == ["boiler", "setpoint"]
    boiler.type("xy")
    assert requests_of(boiler) == []


@pytest.mark.parametrize("keys", ["by", "xy", "m" + ENTER * 6 + "tank\r", "n18\r3\r0\r1\r\r300\r"])
def test_a_configuration_that_was_changed_meanwhile_is_not_overwritten(boiler: Desk, keys: str) -> None:
    boiler.type("r" + keys[0])
    boiler.station.reload_from_elsewhere()
    after = boiler.station.config
    assert STALE in boiler.type(keys[1:])
    assert boiler.station.config is after
    assert "Request 1 of 3: boiler" in boiler.screen[-700:]  # as it is now


def test_a_configuration_that_was_changed_before_the_key_is_not_overwritten(boiler: Desk) -> None:
    boiler.type("r")
    boiler.station.reload_from_elsewhere()
    assert STALE in boiler.type("by")
    assert len(requests_of(boiler)) == 3


def test_a_master_that_has_gone_meanwhile_ends_the_screen(boiler: Desk) -> None:
    boiler.type("r")
    station = boiler.station
    station.change(station.config, station.config.model_copy(update={"master": []}), lambda: None)
    boiler.type("s")
    assert boiler.told == "There is no master field any more."


def test_requests_that_are_off_or_not_at_work_are_shown_without_a_state() -> None:
    text = (STATIONS / "boiler.toml").read_text().replace('name = "boiler"', 'name = "boiler"\nenabled = false')
    desk = Desk(DeskStation(text.replace('trigger = "change"', 'trigger = "change"\nexpire = 0.0')))
    shown = desk.type("r")
    assert "Request 1 of 3: boiler (off)" in shown
    assert "state:" not in shown
    assert "function 6 (write-single-register), on change\n" in desk.type("ss")


@pytest.mark.parametrize(
    ("fault", "words"), [("silent", "no answer"), ("damaging", "damaged answer"), ("refusing", "exception 4")]
)
def test_the_last_error_is_told(boiler: Desk, fault: str, words: str) -> None:
    field = boiler.station.fields["field"]
    if fault == "refusing":
        field.refusing[17, 3] = 4
    else:
        getattr(field, fault).add(17)
    boiler.wait(3.0)
    assert f"last error: {words}" in boiler.type("r")


# ------------------------------------------------------------------------------------------------ V, B, A, S, K, N


def changes(old: Section, new: Section) -> dict[str, Any]:
    """The keys that somebody gave to *new* and not to *old*."""
    before = given(old)
    return {key: value for key, value in given(new).items() if before.get(key) != value}


@pytest.mark.parametrize(
    ("keys", "given_keys"),
    [
        ("v3\r\r", {"baudrate": 38400}),
        ("v\r3\r", {"parity": "odd"}),
        ("v\r\r2", {"stop_bits": 2}),
        ("v2\r1", {}),  # as they were
        ("a", {"enabled": False}),
    ],
)
def test_only_what_was_chosen_is_changed_in_a_master(boiler: Desk, keys: str, given_keys: dict[str, Any]) -> None:
    before = boiler.station.config.master[0]
    boiler.type(keys)
    assert changes(before, boiler.station.config.master[0]) == given_keys
    assert boiler.station.is_unsaved == bool(given_keys)


def test_a_slave_is_switched_and_numbered(boiler: Desk) -> None:
    before = boiler.station.config.slave[0]
    boiler.type("sk99\r")
    assert changes(before, boiler.station.config.slave[0]) == {"enabled": False, "unit": 99}


@pytest.mark.parametrize(
    "keys", ["v13\r\r", "a1", "b23\r\r", "s1", "k19\r", "nb1y", "nm1" + ENTER * 5 + "9" + ENTER * 4]
)
def test_lines_that_were_changed_meanwhile_are_not_overwritten(plant: Desk, keys: str) -> None:
    plant.type(keys[0])
    plant.station.reload_from_elsewhere()
    after = plant.station.config
    assert STALE in plant.type(keys[1:])
    assert plant.station.config is after


def line(desk: Desk, name: str) -> LineConfig:
    return next(line for line in [*desk.station.config.master, *desk.station.config.slave] if line.name == name)


def test_a_new_slave_holds_what_was_typed(boiler: Desk) -> None:
    boiler.type("nn2plc\r/dev/ttyS3\r" + ENTER * 4 + "3\r22")
    assert given(line(boiler, "plc")) == {
        "name": "plc",
        "line": "/dev/ttyS3",
        "unit": 3,
        "writable": False,
        "stale": "exception",
    }


def test_a_new_master_holds_what_was_typed(boiler: Desk) -> None:
    boiler.type("nn1meters\rtcp://192.168.1.20\r\r1\r0.3\r0.05\r2\r")
    assert given(line(boiler, "meters")) == {
        "name": "meters",
        "line": "tcp://192.168.1.20",
        "response_timeout": 1.0,
        "character_timeout": 0.3,
        "delay": 0.05,
        "retries": 2,
    }


def test_a_line_that_is_kept_in_all_is_the_same(plant: Desk) -> None:
    before = plant.station.config
    for choice in "1234":
        plant.type("nm" + choice + ENTER * 12 + "0" + ESC * 2)
        assert plant.station.config is before


def test_a_line_that_moves_to_tcp_leaves_its_serial_settings(plant: Desk) -> None:
    plant.type("nm1tcp://10.0.0.7:502\r" + ENTER * 5)
    assert given(line(plant, "field")).keys() == {"name", "line", "response_timeout", "request"}


def test_a_slave_that_moves_to_a_serial_port_leaves_its_networks(plant: Desk) -> None:
    plant.type("nm3/dev/ttyS9\r" + ENTER * 7)
    assert given(line(plant, "scada")) == {"name": "scada", "line": "/dev/ttyS9", "unit": 1}


def test_framings_other_than_the_usual_are_written_down(plant: Desk) -> None:
    plant.type("nm3\r1" + ENTER * 5)
    assert given(line(plant, "scada"))["framing"] == "rtu"
    plant.type("m3\r3" + ENTER * 5)
    assert "framing" not in given(line(plant, "scada"))
    plant.type("m4\r2" + ENTER * 6)
    assert (line(plant, "plc").framing, line(plant, "plc").data_bits_used) == ("ascii", 7)


def test_deleting_a_master_takes_its_requests_and_leaves_the_rest(plant: Desk) -> None:
    before = plant.station.config
    plant.type("nb1y")
    assert plant.station.config.master == before.master[1:]
    assert plant.station.config.slave == before.slave
    plant.type("b2y")
    assert [slave.name for slave in plant.station.config.slave] == ["plc"]


def test_a_slave_that_is_made_anew_is_shown_as_such(plant: Desk) -> None:
    plant.station.slaves.clear()
    plant.station.masters.pop("meters").close()
    shown = plant.type("i")
    assert "Slave plc: being started anew, /dev/ttyS3 19200 8E1" in shown
    assert "Master meters: being started anew, tcp://192.168.1.20:502" in shown


# ------------------------------------------------------------------------------------------------ what takes long


def test_who_does_not_wait_for_a_change_is_told_that_it_goes_on(boiler: Desk) -> None:
    boiler.station.is_slow, boiler.is_working = True, False
    boiler.type("rby" + ESC)
    assert "It goes on by itself; I shows the station." in boiler.screen
    assert "Nothing is changed." not in boiler.screen
    assert len(requests_of(boiler)) == 2
    assert boiler.screen.endswith("field: requests [s]: ")


@pytest.mark.parametrize(
    ("keys", "words"), [("k9\r", "see I."), ("k9\ru", "see L."), ("posesameopen\rosesameopen\r", "")]
)
def test_what_takes_unusually_long_is_not_waited_for_for_ever(boiler: Desk, keys: str, words: str) -> None:
    boiler.station.is_slow = True
    boiler.type(keys)
    assert words in boiler.told
    assert boiler.screen.endswith(PROMPTS)


def test_what_fails_says_why(plant: Desk) -> None:
    plant.station.is_slow, plant.is_working = True, False
    plant.type("k19\r")
    plant.station.finish_work("the card is full")
    plant.wait(0.1)
    assert plant.told == "the card is full"


def test_a_password_whose_hash_fails_stays_as_it_was(boiler: Desk) -> None:
    def fails(work: object, told: object) -> Any:
        return Job.failed("it failed; the log says why")

    boiler.station.in_background = fails  # type: ignore[method-assign] # the one thing that cannot be brought about
    boiler.type("popensesame\ropensesame\r")
    assert boiler.told == "it failed; the log says why"
    assert boiler.station.config.hmi.password == ""


# ------------------------------------------------------------------------------------------------ W, U, P, F, X, Q


def test_a_save_overwrites_only_where_the_person_says_so(boiler: Desk) -> None:
    boiler.type("k7\r")
    boiler.station.file_is_edited = True
    boiler.type("wo")
    assert boiler.station.file_is_edited
    boiler.type("y")
    assert not boiler.station.file_is_edited
    assert not boiler.station.is_unsaved


@pytest.mark.parametrize("keys", ["wn", "w" + ESC])
def test_who_does_not_say_yes_saves_nothing(boiler: Desk, keys: str) -> None:
    boiler.type("k7\r" + keys)
    assert boiler.station.is_unsaved


def test_a_save_with_confirmation_has_its_time(boiler: Desk) -> None:
    boiler.type("k7\rwc")
    assert boiler.station.confirm_left_s == 600.0
    boiler.type("wl")
    assert boiler.station.confirm_left_s == 600.0
    boiler.type("wu")
    assert boiler.station.config.slave[0].unit == 1


def test_undo_brings_back_what_was_saved(boiler: Desk) -> None:
    saved = boiler.station.config
    boiler.type("k7\rau")
    assert boiler.station.config == saved


def test_a_password_is_kept_as_a_hash_with_every_character_typed(boiler: Desk) -> None:
    boiler.type("p open sesame \r open sesame \r")
    stored = boiler.station.config.hmi.password
    assert check_password(" open sesame ", stored)
    assert "sesame" not in boiler.screen
    assert given(boiler.station.config.hmi).keys() == {"password"}


def test_factory_settings_keep_the_way_to_the_menu(boiler: Desk) -> None:
    boiler.type("popensesame\ropensesame\rfy")
    config = boiler.station.config
    assert [(line.name, line.line, line.enabled) for line in [*config.master, *config.slave]] == [
        ("field", "", False),
        ("scada", "", False),
    ]
    assert check_password("opensesame", config.hmi.password)


def test_a_restart_asks_first(boiler: Desk) -> None:
    boiler.type("xnx" + ESC + "x\r")
    assert boiler.station.restarts == 0
    boiler.type("y")
    assert boiler.station.restarts == 1


def test_leaving_with_unsaved_changes_asks_first(boiler: Desk) -> None:
    boiler.type("k7\rqn")
    assert not boiler.menu.has_left
    boiler.type("qy")
    assert boiler.menu.has_left
    assert boiler.station.is_unsaved


# ------------------------------------------------------------------------------------------------ little things


def test_entries_are_told_apart_by_identity_not_by_value() -> None:
    one, same = (RequestConfig(unit=1, function=3, address=0, count=1, point=0) for _ in range(2))
    assert [entry is same for entry in replaced([one, same], one, None)] == [True]
    assert replaced([one], None, None) == [one]


def test_only_masters_and_slaves_are_lines() -> None:
    with pytest.raises(TypeError, match="neither a master nor a slave"):
        with_line(Config(), LineConfig(name="x", line=""), None)
