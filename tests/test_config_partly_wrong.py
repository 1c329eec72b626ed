"""A file with wrong keys: all that is wrong is said at once, and nothing that goes away when they are set right."""

from __future__ import annotations

import datetime
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.config import Config
from gateway.config_checks import validate
from gateway.config_fields import HINTS, Path
from tests.configs import IO, MASTER, REQUEST, SLAVE, said, with_requests

# --- what is said with it


def test_errors_of_fields_and_of_what_does_not_fit_come_together() -> None:
    data = with_requests({"unit": "x"}, {"count": 126, "point": 50}, {"name": "a", "point": 60, "address": 0})
    data["master"].insert(0, {"name": "broken"})
    data["slave"] = [{"name": "bad"}, SLAVE | {"name": "field"}]
    data["log"] = {"level": 1}
    paths = {finding.path for finding in validate(data)[1]}
    assert paths == {
        ("master", 0, "line"),
        ("master", 1, "request", 0, "unit"),
        ("master", 1, "request", 1, "count"),
        ("master", 1, "request", 2, "point"),  # overlaps request 1
        ("slave", 0, "line"),
        ("slave", 0, "unit"),
        ("slave", 1, "name"),
        ("log", "level"),
    }


def test_a_name_that_is_taken_is_found_in_an_entry_with_a_wrong_key() -> None:
    data = {"master": [MASTER | {"baudrate": 1}, {"name": "field"}], "slave": [SLAVE | {"name": "field", "unit": 0}]}
    assert said(data) == [
        "baudrate 1 is not one of 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400",
        "line is missing: a device such as /dev/ttyS2, or tcp://host:port",
        "unit 0 is less than 1",
        'name "field" is already that of another master',
        'name "field" is already that of a master',
    ]


def test_a_shared_port_is_found_in_an_entry_with_a_wrong_key() -> None:
    data = {"master": [MASTER | {"name": "two words"}], "slave": [SLAVE | {"line": "/dev/ttyS2", "writable": "yes"}]}
    assert said(data)[2:] == ["line /dev/ttyS2 is already used by master 1"]


def test_a_shared_gpio_line_is_found_in_an_entry_with_a_wrong_key() -> None:
    data = {"io": [IO | {"name": 1, "scale": "x"}, IO | {"name": "b", "point": "x"}]}
    assert said(data)[3:] == ['line "17" of /dev/gpiochip0 is already used by io 1']


def test_overlapping_points_are_found_in_requests_with_wrong_keys() -> None:
    data = with_requests({"unit": "x"}, {"name": "b", "every": -1, "point": 2}, {"name": "c", "count": "x", "point": 4})
    assert said(data)[3:] == [
        'point 2: point 2 of holding-registers is already filled by master "field", request 1',
        'point 4: point 4 of holding-registers is already filled by master "field", request "b"',
    ]


def test_points_beyond_a_table_are_found_in_requests_with_wrong_keys() -> None:
    data = with_requests({"unit": "x", "point": 1999}, {"name": "b", "count": "x", "point": 3000, "status_point": 1999})
    assert said(data)[2:] == [
        "point 1999 with 3 points goes beyond holding-registers, which end at 1999",
        "point 3000 lies beyond holding-registers, which end at 1999",
        "status_point 1999 with 4 points goes beyond input-registers, which end at 1999",
    ]


def test_a_wrong_table_size_spares_the_other_tables() -> None:
    data = with_requests({"point": 5000}, {"function": 1, "point": 5000})
    data["register"] = {"holding_registers": "10000", "coils": 50}
    assert said(data) == [
        'holding_registers "10000" is not a whole number',
        "point 5000 with 3 points goes beyond coils, which end at 49",
    ]


def test_entries_keep_their_places_behind_one_that_is_no_table() -> None:
    data = with_requests({"name": "a"}, {"name": "a", "point": 10})
    data["master"][0]["request"].insert(1, 5)
    data["master"].insert(0, "field")
    assert [one.path for one in validate(data)[1]] == [
        ("master", 0),
        ("master", 1, "request", 1),
        ("master", 1, "request", 2, "name"),
    ]


def test_polls_that_cannot_fit_are_found_beside_a_wrong_one() -> None:
    data = with_requests({"every": 0.01}, {"name": "b", "point": 9, "unit": "x"})
    assert said(data)[1:] == ["the polls need 149 % of the line at 19200 baud"]


# --- what is not said with it


@pytest.mark.parametrize(
    "data",
    [
        {"slave": [SLAVE | {"line": "tcp://0.0.0.0:2323"}], "hmi": {"telnet": {"listen": 1}}},
        {"slave": [SLAVE | {"line": "tcp://0.0.0.0:2323"}], "hmi": {"telnet": {"lisen": ""}}},
        {"slave": [SLAVE | {"line": "tcp://0.0.0.0:2323"}], "hmmi": {"telnet": {"listen": ""}}},
        {"hmi": {"password": 1, "wifly": {"line": "/dev/ttyS0"}}},
        {"hmi": {"wifly": {"line": "/dev/ttyS0", "password": "scrypt$1"}}},
        {"watchdog": {"device": "/dev/watchdog", "device_timeout": 20, "timeout": "3"}},
        {"register": {"coils": "5000"}, "slave": [SLAVE | {"first": 4000}]},
        {"register": 5000, "io": [IO | {"point": 4000}]},
        {"register": {"inputs": 5000}, "io": [IO | {"point": 4000}]},
        {"coils": 5000, "register": {}, "io": [IO | {"point": 4000, "kind": "gpio-out"}]},
        {"io": [IO | {"point": 0, "kind": "gpio"}, IO | {"name": "b", "line": 18, "kind": "gpio-in"}]},
        with_requests({"every": 0.05}, baudrate=115201),
        with_requests({"every": 0.05}, bauds=115200),
        with_requests({"every": 0.05, "baudrate": 115200}),
        with_requests({"every": 0.01, "enabled": "false"}),
        with_requests({"every": 0.01, "count": 126}),
        with_requests({"unit": 255}, line="plc:502"),
        with_requests({"unit": 0, "function": "write-coil"}),
        with_requests({"count": 500, "function": "read-coil"}),
        with_requests({"count": 500, "function": 1, "point": 0, "pont": 1}, {"point": 2000, "function": 33}),
        with_requests({"table": "coils", "function": 33}),
        with_requests({"point": 1999, "table": "hold"}) | {"register": {"input_registers": 3000}},
        with_requests({"whole": True, "function": 16, "trigger": "chnge"}),
        with_requests({"whole": True, "function": 16, "triger": "change"}),
        with_requests({"events": True}) | {"events": {"fifo_point": "0"}},
        with_requests({}, parity="none", stopbits=2),
        with_requests({}, {"point": 10, "nmae": "b"}),
        with_requests({}, {"point": 10, "address": "x"}),
        {"master": [MASTER | {"line": "/dev/ttyS2", "data_bits": 7, "framing": "asci"}]},
        {"master": [MASTER | {"line": "", "enable": False}]},
        {"master": [{"nam": "a", "lin": "/dev/ttyS2"}, {"nam": "a", "lin": "/dev/ttyS2"}]},
    ],
)
def test_nothing_is_said_that_rests_on_a_wrong_key(data: dict[str, Any]) -> None:
    wrong = [one.message for one in validate(data)[1]]
    assert wrong == errors_of_keys(data)


def errors_of_keys(data: dict[str, Any]) -> list[str]:
    """What is said of single keys, as the models say it, and of a count beyond its function."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gateway.config_checks._check_the_rest", lambda *_: [])
        return said(data)


def test_defaults_in_the_place_of_a_wrong_table_are_not_judged() -> None:
    data = {"slave": [SLAVE | {"line": "tcp://0.0.0.0:2323"}], "hmi": {"password": 1, "telnet": {"listen": ""}}}
    assert said(data) == ["password *** is not a text: put it in quotes"]


def test_without_table_sizes_points_are_not_judged() -> None:
    data = with_requests({"point": 5000}) | {"register": {"holding_registers": "10000"}}
    assert said(data) == ['holding_registers "10000" is not a whole number']


def test_behind_the_last_hint_an_unknown_key_may_mean_any() -> None:
    data = with_requests({"every": 0.05}, **{f"x{n}": 1 for n in range(HINTS)}, bauds=115200)
    assert len(said(data)) == HINTS + 1


# --- any key


STATION: dict[str, Any] = {  # next to everything that does not fit together
    "register": {"coils": 100, "discrete_inputs": 100, "holding_registers": 150, "input_registers": 100},
    "master": [
        {
            "name": "field",
            "enabled": True,
            "line": "/dev/ttyS2",
            "framing": "rtu",
            "baudrate": 1200,
            "parity": "none",
            "data_bits": 8,
            "stop_bits": 1,
            "delay": 0.1,
            "turnaround": 0.1,
            "request": [
                REQUEST | {"name": "a", "every": 0.01, "unit": 248, "status_point": 98, "events": True},
                REQUEST | {"name": "a", "function": 16, "count": 124, "point": 2, "whole": True, "trigger": "cycle"},
                REQUEST | {"address": 65535, "count": 3, "point": 2, "unit": 0, "table": "holding-registers"},
                REQUEST | {"address": 65535, "count": 3, "function": 4, "table": "coils", "point": 200},
                REQUEST
                | {"address": 65535, "function": 6, "on_failure": "zero", "count": 1, "table": "input_registers"},
                REQUEST | {"name": "b", "function": 4, "point": 20, "status_point": 21},
                REQUEST | {"name": "b", "function": 2, "point": 99, "status_point": 23, "whole": True, "expire": 1},
            ],
        },
        {"name": "field", "line": "/dev/ttyS2", "framing": "tcp", "request": [REQUEST | {"point": 1, "every": 0.02}]},
        {"name": "c", "line": "tcp://plc", "framing": "rtu", "request": [REQUEST | {"unit": 255}]},
        {"name": "d", "line": "tcp://PLC:502", "framing": "tcp", "request": [REQUEST | {"unit": 0, "every": 0.01}]},
        {"name": "e", "line": "/dev/ttyS5", "framing": "rtu", "data_bits": 7},
        {"name": "f", "line": "", "enabled": True},
    ],
    "slave": [
        {"name": "field", "enabled": True, "line": "/dev/ttyS2", "unit": 1, "first": 151, "count": 65500},
        {"name": "g", "line": "tcp://0.0.0.0:2323", "unit": 1, "functions": [3]},
        {"name": "g", "line": "tcp://127.0.0.1:2323", "unit": 1, "allow": ["10.0.0.0/8"]},
    ],
    "events": {"size": 10, "fifo_point": -1, "block_point": -1},
    "io": [
        IO | {"name": "c", "kind": "gpio-out", "point": 100},
        IO | {"name": "c", "kind": "gpio-out", "point": 0},
        IO | {"kind": "iio", "point": 21},
    ],
    "hmi": {
        "password": "",
        "serial": {"line": "/dev/ttyS2"},
        "telnet": {"listen": "0.0.0.0:2323"},
        "wifly": {"line": "/dev/ttyS2"},
    },
    "watchdog": {"timeout": 20.0, "device": "/dev/watchdog", "device_timeout": 30},
}
ALL_OF_IT = {one.path for one in validate(STATION)[1]}
WITH_BLOCK = STATION | {"events": {"block_point": 140}}


def places(node: Any, path: Path = ()) -> list[Path]:
    """Every key, and every entry of a list of tables."""
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [*([path] if path else []), *(place for key, value in inner for place in places(value, (*path, key)))]


def spoilt(node: Any, path: Path, how: str) -> Any:
    """*node* with the key at *path* made wrong: another type, or another name."""
    key, rest = path[0], path[1:]
    if not isinstance(node, dict | list) or (isinstance(node, dict) and key not in node):
        return node  # spoilt already
    copied: Any = node.copy()
    if rest:
        copied[key] = spoilt(copied[key], rest, how)
    elif how == "type" or isinstance(copied, list):
        copied[key] = datetime.date(1979, 5, 27)  # fits no key
    else:
        copied[f"{key}_"] = copied.pop(key)
    return copied


def test_the_station_has_every_kind_of_trouble() -> None:
    config = Config.model_validate(STATION)  # and no wrong key
    assert len(config.master) == 6
    assert len(ALL_OF_IT) > 35


@pytest.mark.parametrize("base", [STATION, WITH_BLOCK])
@settings(deadline=None)
@given(damage=st.data())
def test_whatever_key_is_wrong_the_rest_stands(base: dict[str, Any], damage: st.DataObject) -> None:
    kinds = st.tuples(st.sampled_from(places(base)), st.sampled_from(["type", "name"]))
    data = base
    for path, how in damage.draw(st.lists(kinds, min_size=1, max_size=3)):
        data = spoilt(data, path, how)
    of_keys = errors_of_keys(data)
    sound = {(one.path, one.severity) for one in validate(base)[1]}
    for one in validate(data)[1][len(of_keys) :]:
        if " already " not in one.message:  # of two that clash the later one is named: which that is may change
            assert (one.path, one.severity) in sound, one


@pytest.mark.parametrize("how", ["type", "name"])
def test_each_wrong_key_takes_little_with_it(how: str) -> None:
    for path in places(STATION):
        if isinstance(path[-1], int) or path in ALL_OF_IT or path[:1] == ("register",) or len(path) == 1:
            continue
        left = {one.path for one in validate(spoilt(STATION, path, how))[1]}
        gone = {lost for lost in ALL_OF_IT - left if lost[: len(path)] != path}
        assert len(gone) <= 6, (path, gone)
