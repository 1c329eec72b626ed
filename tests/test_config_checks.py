"""What must fit together in a configuration, what earns a warning, and the load of a line."""

from __future__ import annotations

from typing import Any

import pytest

from gateway.config import Config
from gateway.config_checks import cross_check, not_yet, validate
from gateway.config_fields import Finding
from gateway.line_load import line_load
from tests.configs import IO, MASTER, REQUEST, SLAVE, a_master, a_request, said, with_requests

# --- what must fit together


def test_times_may_be_written_as_whole_numbers() -> None:
    assert a_request(every=1).every == 1.0


@pytest.mark.parametrize(
    ("function", "limit"), [(1, 2000), (2, 2000), (3, 125), (4, 125), (5, 1), (6, 1), (15, 1968), (16, 123)]
)
def test_count_ends_at_the_functions_limit(function: int, limit: int) -> None:
    assert said(with_requests({"function": function, "count": limit, "address": 0})) == []
    over = said(with_requests({"function": function, "count": limit + 1, "address": 0}))
    assert over[0] == f"count {limit + 1} is more than {limit}"


def test_addresses_end_at_65535() -> None:
    assert said(with_requests({"address": 65534, "count": 2})) == []
    assert said(with_requests({"address": 65534, "count": 3})) == ["count 3 from address 65534 goes beyond 65535"]


@pytest.mark.parametrize("unit", [0, 1, 248, 255])
def test_with_framing_tcp_every_unit_may_be_read(unit: int) -> None:
    assert said(with_requests({"unit": unit}, line="tcp://plc")) == []


def test_a_broadcast_may_write() -> None:
    assert said(with_requests({"unit": 0, "function": 16})) == []


@pytest.mark.parametrize(("key", "value"), [("on_failure", "zero"), ("stale_after", 5), ("events", True)])
def test_keys_for_reads_are_refused_on_a_write(key: str, value: object) -> None:
    messages = said(with_requests({"function": 16, key: value}))
    assert messages == [f"{key} is for reads, and write-multiple-registers writes"]


def test_keys_of_the_other_kind_may_stand_at_their_default() -> None:
    assert said(with_requests({"trigger": "cycle", "expire": 10})) == []
    assert said(with_requests({"function": 6, "count": 1, "on_failure": "hold"})) == []


@pytest.mark.parametrize(("key", "value"), [("whole", True), ("expire", 5)])
def test_keys_for_writes_on_change_are_refused_on_a_cyclic_write(key: str, value: object) -> None:
    text = f'{key} is for writes on change, and this one writes every cycle: trigger = "change" is missing'
    assert validate(with_requests({"function": 16, key: value}))[1] == [Finding(("master", 0, "request", 0, key), text)]
    assert said(with_requests({"function": 16, "trigger": "change", key: value})) == []


def test_an_address_in_a_model_has_no_spelling_and_is_taken_as_it_is() -> None:
    assert said(with_requests({"address": 40108})) == []


def test_a_name_belongs_to_one_master_slave_or_input() -> None:
    data = {"master": [MASTER, MASTER | {"line": "/dev/ttyS3"}], "slave": [SLAVE | {"name": "field"}], "io": [IO]}
    assert validate(data)[1] == [
        Finding(("master", 1, "name"), 'name "field" is already that of another master'),
        Finding(("slave", 0, "name"), 'name "field" is already that of a master'),
    ]


def test_requests_of_one_master_have_different_titles() -> None:
    assert validate(with_requests({"name": "a"}, {"name": "a", "point": 10}))[1] == [
        Finding(("master", 0, "request", 1, "name"), 'name "a" is already that of another request')
    ]
    assert validate(with_requests({}, {"point": 10}))[1] == [
        Finding(("master", 0, "request", 1), 'another request is called "u17-f3-107" too: give one of them a name')
    ]


def test_a_device_has_one_user() -> None:
    data = {
        "master": [MASTER],
        "slave": [SLAVE | {"line": "/dev//ttyS2", "enabled": False}],
        "hmi": {"serial": {"line": "/dev/./ttyS2"}, "wifly": {"line": "/dev/ttyS2"}, "password": "scrypt$x"},
    }
    assert validate(data)[1] == [
        Finding(("slave", 0, "line"), 'line /dev//ttyS2 is already used by master "field"'),
        Finding(("hmi", "serial", "line"), 'line /dev/./ttyS2 is already used by master "field"'),
        Finding(("hmi", "wifly", "line"), 'line /dev/ttyS2 is already used by master "field"'),
    ]


def test_two_masters_do_not_poll_one_address() -> None:
    other = {"name": "other", "line": "tcp://PLC:502"}
    assert validate({"master": [MASTER | {"line": "tcp://plc"}, other]})[1] == [
        Finding(("master", 1, "line"), 'line tcp://PLC:502 is already used by master "field"')
    ]


@pytest.mark.parametrize(
    ("one", "other", "clashes"),
    [
        ("10.0.0.1:502", "10.0.0.1:502", True),
        ("10.0.0.1:502", "10.0.0.1", True),
        ("10.0.0.1:502", "10.0.0.2:502", False),
        ("10.0.0.1:502", "10.0.0.1:503", False),
        ("0.0.0.0:502", "127.0.0.1:502", True),
        ("localhost:502", "127.0.0.1:502", True),
        ("0.0.0.0:502", "[::1]:502", False),
        ("[::]:502", "0.0.0.0:502", True),
        ("[::]:502", "[::1]:502", True),
        ("[::0001]:502", "[::1]:502", True),
        ("plc:502", "0.0.0.0:502", True),
    ],
)
def test_two_slaves_do_not_listen_on_one_port(one: str, other: str, clashes: bool) -> None:
    for first, second in ((one, other), (other, one)):
        slaves = [SLAVE | {"line": f"tcp://{first}"}, SLAVE | {"name": "two", "line": f"tcp://{second}"}]
        message = f'line tcp://{second} is already used by slave "scada"'
        assert said({"slave": slaves}) == [message] * clashes


def test_telnet_and_a_slave_do_not_listen_on_one_port() -> None:
    assert validate({"slave": [SLAVE | {"line": "tcp://0.0.0.0:2323"}]})[1] == [
        Finding(("hmi", "telnet", "listen"), 'listen 127.0.0.1:2323 is already used by slave "scada"')
    ]
    assert said({"slave": [SLAVE | {"line": "tcp://0.0.0.0:2323"}], "hmi": {"telnet": {"listen": ""}}}) == []


def test_a_gpio_line_has_one_user() -> None:
    data = {"io": [IO, IO | {"name": "lamp", "kind": "gpio-out"}]}
    assert said(data) == ['line "17" of /dev/gpiochip0 is already used by io "door"']
    assert said({"io": [IO | {"kind": "iio"}, IO | {"name": "b", "kind": "iio", "point": 1}]}) == []


def test_a_line_that_is_off_may_be_empty() -> None:
    assert said({"master": [MASTER | {"line": "", "enabled": False, "framing": "tcp"}]}) == []


# --- points


def a_fill(point: int, count: int = 1, **keys: Any) -> dict[str, Any]:
    return {"name": f"p{point}-{count}", "point": point, "count": count} | keys


def test_two_reads_do_not_fill_one_point() -> None:
    two = MASTER | {"name": "two", "line": "tcp://plc", "request": [REQUEST | a_fill(4, 2)]}
    data = with_requests(a_fill(0, 5))
    data["master"].append(two)
    message = 'point 4: point 4 of holding-registers is already filled by master "field", request "p0-5"'
    assert validate(data)[1] == [Finding(("master", 1, "request", 0, "point"), message)]


def test_a_wide_read_is_found_behind_a_narrow_one() -> None:
    found = validate(with_requests(a_fill(8, 3), a_fill(1), a_fill(0, 100)))[1]
    assert [(one.path[3], one.message) for one in found] == [
        (2, 'point 0: point 1 of holding-registers is already filled by master "field", request "p1-1"'),
        (2, 'point 0: points 8 to 10 of holding-registers are already filled by master "field", request "p8-3"'),
    ]


@pytest.mark.parametrize(
    ("other", "clashes"),
    [
        ({"function": 16}, False),  # a read and a write: command and read back
        ({"function": 4}, False),
        ({"function": 3}, True),
        ({"function": 4, "table": "holding-registers"}, True),
        ({"function": 3, "point": 3}, False),
        ({"function": 3, "enabled": False}, True),
    ],
)
def test_what_may_share_points_with_a_read(other: dict[str, Any], clashes: bool) -> None:
    found = said(with_requests({}, {"name": "other"} | other))
    text = 'points 0 to 2 of holding-registers are already filled by master "field", request "u17-f3-107"'
    assert found == [f"point 0: {text}"] * clashes


@pytest.mark.parametrize(
    ("other", "used"),
    [
        ({"function": 4, "point": 3}, "point 3: point 3 of input-registers is already the status of {}"),
        ({"status_point": 1}, "status_point 1: points 1 to 3 of input-registers are already the status of {}"),
        (
            {"function": 16, "table": "input-registers", "point": 3},
            "point 3: point 3 of input-registers is already the status of {}",
        ),
    ],
)
def test_a_status_point_overlaps_nothing(other: dict[str, Any], used: str) -> None:
    elsewhere = {"name": "other", "point": 100}
    found = said(with_requests({"status_point": 0}, elsewhere | other))
    assert found == [used.format('master "field", request "u17-f3-107"')]


def test_a_status_point_after_a_write_source_names_it() -> None:
    write = {"function": 16, "table": "input-registers", "point": 0}
    found = said(with_requests(write, {"point": 9, "status_point": 2}))
    assert found == [
        'status_point 2: point 2 of input-registers is already sent by master "field", request "u17-f16-107"'
    ]


def test_own_inputs_fill_points_and_outputs_follow_them() -> None:
    reads = with_requests({"function": 2, "address": 0}, {"function": 1, "address": 0})
    lamp = IO | {"name": "lamp", "kind": "gpio-out", "line": "18"}
    assert validate(reads | {"io": [IO, lamp]})[1] == [
        Finding(
            ("io", 0, "point"),
            'point 0: point 0 of discrete-inputs is already filled by master "field", request "u17-f2-0"',
        )
    ]


def test_the_event_block_is_not_filled_by_a_read() -> None:
    found = said(with_requests({}) | {"events": {"block_point": 2}})
    assert found == [
        'block_point 2: point 2 of holding-registers is already filled by master "field", request "u17-f3-107"'
    ]


@pytest.mark.parametrize("address", [0, 1, 1999, 2000, 65535])
def test_the_fifo_is_an_address_and_no_point(address: int) -> None:
    assert said(with_requests({}) | {"events": {"fifo_point": address}}) == []


@pytest.mark.parametrize("events", [{}, {"size": 5}, {"fifo_point": -1, "block_point": -1}])
def test_changes_that_nobody_can_take_are_a_warning(events: dict[str, int]) -> None:
    text = "nobody can take the changes: set fifo_point or block_point in [events]"
    config, found = validate(with_requests({"events": True}) | {"events": events})
    assert config is not None
    assert found == [Finding(("master", 0, "request", 0, "events"), text, "warning")]


@pytest.mark.parametrize("events", [{"fifo_point": 0}, {"block_point": 100}])
def test_changes_are_taken_by_function_24_or_from_the_block(events: dict[str, int]) -> None:
    assert said(with_requests({"events": True}) | {"events": events}) == []


def test_an_overlap_is_judged_by_the_count_that_the_function_allows() -> None:
    found = said(with_requests({"count": 200, "point": 0}, {"name": "next", "point": 125}))
    assert found == ["count 200 is more than 125"]


# --- access


@pytest.mark.parametrize("listen", ["0.0.0.0:2323", "[::]:2323", "192.168.1.1:23", "gateway.local:23"])
def test_telnet_beyond_this_machine_needs_a_password(listen: str) -> None:
    telnet = {"telnet": {"listen": listen}}
    text = f"listen {listen} is beyond this machine and needs a password: `rtugate passwd` sets one"
    assert validate({"hmi": telnet})[1] == [Finding(("hmi", "telnet", "listen"), text)]
    assert said({"hmi": telnet | {"password": "scrypt$1$2"}}) == []


@pytest.mark.parametrize("listen", ["", "127.0.0.1:2323", "127.9.9.9:23", "[::1]:2323", "localhost:23"])
def test_telnet_on_this_machine_needs_none(listen: str) -> None:
    assert said({"hmi": {"telnet": {"listen": listen}}}) == []


def test_a_wifly_line_needs_a_password() -> None:
    found = said({"hmi": {"wifly": {"line": "/dev/ttyS0"}}})
    assert found == ["line /dev/ttyS0: a menu over WiFi needs a password: `rtugate passwd` sets one"]


# --- warnings


def test_warnings_and_notes_do_not_stop_a_configuration() -> None:
    config, found = validate(with_requests({"every": 0.01}, parity="none"))
    assert config is not None
    assert [one.severity for one in found] == ["note", "warning"]


# --- line load


@pytest.mark.parametrize(
    ("request_keys", "master_keys", "busy_s"),
    [
        ({}, {}, (8 + 11) * 11 / 19200 + 2 * 3.5 * 11 / 19200),
        ({}, {"baudrate": 9600, "parity": "none"}, (8 + 11) * 10 / 9600 + 7 * 10 / 9600),
        ({}, {"baudrate": 115200, "stop_bits": 2}, 19 * 12 / 115200 + 2 * 0.00175),
        ({}, {"delay": 0.05}, 26 * 11 / 19200 + 0.05),
        ({"function": 1, "count": 9}, {}, (8 + 7 + 7) * 11 / 19200),
        ({"function": 16}, {}, (15 + 8 + 7) * 11 / 19200),
        ({"function": 15, "count": 8}, {}, (10 + 8 + 7) * 11 / 19200),
        ({"function": 6, "count": 1}, {}, (8 + 8 + 7) * 11 / 19200),
        ({"function": 6, "count": 1, "unit": 0}, {}, (8 + 7) * 11 / 19200 + 0.1),
        ({}, {"framing": "ascii"}, (17 + 23 + 7) * 10 / 19200),
        ({}, {"line": "tcp://plc"}, 0.001),
        ({"function": 16, "trigger": "change"}, {}, 0.0),
        ({"enabled": False}, {}, 0.0),
    ],
)
def test_a_poll_costs_its_frames_silences_and_waits(
    request_keys: dict[str, Any], master_keys: dict[str, Any], busy_s: float
) -> None:
    load = line_load(a_master({"every": 0.5} | request_keys, **master_keys))
    assert load.percent == pytest.approx(100 * busy_s / 0.5)


def test_the_slowest_cycle_is_a_whole_round_or_the_longest_cycle_time() -> None:
    one_s = 26 * 11 / 19200
    crowded = a_master(*[{"every": 0.01, "address": n} for n in range(3)])
    assert line_load(crowded).slowest_cycle_s == pytest.approx(3 * one_s)
    assert line_load(a_master({"every": 0.01}, {"every": 7})).slowest_cycle_s == 7.0
    assert line_load(a_master()).slowest_cycle_s == 0.0


def test_polls_that_do_not_fit_their_line_are_a_warning() -> None:
    percent = 100 * 26 * 11 / 19200 / 0.01
    text = f"the polls need {percent:.0f} % of the line at 19200 baud"
    assert cross_check(Config.model_validate(with_requests({"every": 0.01}))) == [
        Finding(("master", 0), text, "warning")
    ]
    many = [{"every": 0.01, "address": n, "point": 3 * n} for n in range(11)]
    assert said(with_requests(*many, line="tcp://plc")) == ["the polls need 110 % of the line at 1 ms a request"]


# --- what this version does not do yet


@pytest.mark.parametrize(
    ("data", "path"),
    [
        ({"io": [IO]}, ("io", 0)),
        ({"hmi": {"wifly": {"line": "/dev/ttyS0"}}}, ("hmi", "wifly")),
    ],
)
def test_what_is_accepted_and_not_carried_out_is_named(data: dict[str, Any], path: tuple[str | int, ...]) -> None:
    (finding,) = not_yet(Config.model_validate(data))
    key = [part for part in path if isinstance(part, str)][-1]
    text = f"{key} is accepted, but this version does not carry it out yet"
    assert finding == Finding(path, text, "warning")


def test_defaults_written_out_are_no_reason_to_warn() -> None:
    assert not_yet(Config.model_validate({"identity": {"vendor": "rtugate"}, "events": {"size": 10}})) == []
    assert not_yet(Config.model_validate({"hmi": {"telnet": {"listen": ""}}})) == []
