"""The models: keys, defaults and single values, on parsed data; lines and files are in test_store_load."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from gateway.config import Config, LineConfig, MasterConfig, RequestConfig, SlaveConfig, function_code, table_number
from gateway.config_checks import validate
from gateway.config_fields import host_port
from gateway.modbus.pdu import Table
from tests.configs import IO, MASTER, REQUEST, SLAVE, a_master, a_request, said, with_requests

FULL = tomllib.loads((Path(__file__).parent / "data" / "full.toml").read_text(encoding="utf-8"))


def wrong_with(model: type[BaseModel], **keys: Any) -> list[str]:
    """What is said of one key of one entry."""
    if model is RequestConfig:
        return said(with_requests(keys))
    return said({"master": [MASTER | keys]} if model is MasterConfig else {"slave": [SLAVE | keys]})


# --- keys and defaults


def keys_of(model: BaseModel, prefix: str = "") -> set[str]:
    """Every key that was written, as a dotted name."""
    found: set[str] = set()
    for name in model.model_fields_set:
        key = prefix + (type(model).model_fields[name].alias or name)
        value = getattr(model, name)
        entry = value[0] if isinstance(value, list) and value else value
        found |= keys_of(entry, f"{key}.") if isinstance(entry, BaseModel) else {key}
    return found


def known_keys(schema: dict[str, Any], node: dict[str, Any], prefix: str = "") -> set[str]:
    found: set[str] = set()
    for key, inner in node["properties"].items():
        name = (inner.get("items") or inner).get("$ref", "").rpartition("/")[2]
        found |= known_keys(schema, schema["$defs"][name], f"{prefix}{key}.") if name else {prefix + key}
    return found


def test_the_full_file_holds_every_key_and_no_other() -> None:
    schema = Config.model_json_schema()
    assert keys_of(Config.model_validate(FULL)) == known_keys(schema, schema)


def test_the_full_file_says_nothing_but_what_every_full_file_must() -> None:
    assert validate(FULL)[1] == []


def test_what_is_not_written_has_the_default_that_the_full_file_shows() -> None:
    bare = Config.model_validate({"master": [MASTER | {"request": [REQUEST]}], "slave": [SLAVE], "io": [IO]})
    full = Config.model_validate(FULL)
    derived = {"framing", "data_bits", "character_timeout", "name", "table", "function", "request"}
    assert bare.model_dump(exclude={"master", "slave"}) == full.model_dump(exclude={"master", "slave"})
    assert bare.slave[0].model_dump(exclude=derived) == full.slave[0].model_dump(exclude=derived)
    assert bare.master[0].model_dump(exclude=derived) == full.master[0].model_dump(exclude=derived)
    request, shown = bare.master[0].request[0], full.master[0].request[0]
    assert request.model_dump(exclude=derived) == shown.model_dump(exclude=derived)
    assert (request.code, request.target) == (shown.code, shown.target)


def test_an_empty_file_is_a_configuration() -> None:
    assert validate({}) == (Config(), [])


# --- derived defaults


@pytest.mark.parametrize(
    ("keys", "framing", "data_bits", "character_timeout"),
    [
        ({}, "rtu", 8, 0.2),
        ({"framing": "ascii"}, "ascii", 7, 1.0),
        ({"framing": "ascii", "data_bits": 8, "character_timeout": 3}, "ascii", 8, 3.0),
        ({"line": "tcp://plc"}, "tcp", 8, 0.2),
        ({"line": "tcp://plc", "framing": "ascii"}, "ascii", 8, 1.0),
        ({"line": "tcp://plc", "framing": "rtu"}, "rtu", 8, 0.2),
    ],
)
def test_a_line_fills_in_what_follows_from_its_kind(
    keys: dict[str, Any], framing: str, data_bits: int, character_timeout: float
) -> None:
    line = LineConfig.model_validate(MASTER | keys)
    assert (line.framing_used, line.data_bits_used, line.character_timeout_used) == (
        framing,
        data_bits,
        character_timeout,
    )


@pytest.mark.parametrize(
    ("line", "address"),
    [
        ("tcp://192.168.1.20", ("192.168.1.20", 502)),
        ("tcp://plc-7.local:1502", ("plc-7.local", 1502)),
        ("tcp://[fe80::1]:503", ("fe80::1", 503)),
        ("tcp://[::1]", ("::1", 502)),
    ],
)
def test_a_tcp_line_has_a_host_and_a_port(line: str, address: tuple[str, int]) -> None:
    assert a_master(line=line).address == address


def test_a_device_has_no_host() -> None:
    with pytest.raises(ValueError, match="no tcp:// line"):
        _ = a_master().address


@pytest.mark.parametrize(
    "text", ["", "host", "host:", "host:0", "host:65536", "[::1:2", "::1:2", "[1.2]:3", "1.2.3.300:4"]
)
def test_what_is_no_host_with_a_port_is_none(text: str) -> None:
    assert host_port(text, None) is None


@pytest.mark.parametrize(
    ("function", "code", "target", "is_read"),
    [
        ("read-coils", 1, Table.COILS, True),
        ("read_discrete_inputs", 2, Table.DISCRETE_INPUTS, True),
        (3, 3, Table.HOLDING_REGISTERS, True),
        ("read-input-registers", 4, Table.INPUT_REGISTERS, True),
        ("write-single-coil", 5, Table.COILS, False),
        ("write-single-register", 6, Table.HOLDING_REGISTERS, False),
        (15, 15, Table.COILS, False),
        ("write_multiple-registers", 16, Table.HOLDING_REGISTERS, False),
    ],
)
def test_a_function_gives_code_table_and_direction(
    function: int | str, code: int, target: Table, is_read: bool
) -> None:
    request = a_request(function=function)
    assert (request.code, request.target, request.is_read) == (code, target, is_read)
    assert request.function == function  # as it was written


def test_a_table_redirects_and_may_be_written_with_either_dash() -> None:
    assert a_request(table="input_registers").target == Table.INPUT_REGISTERS
    assert table_number("discrete-inputs") == Table.DISCRETE_INPUTS


def test_a_request_without_a_name_is_called_by_what_it_asks() -> None:
    assert a_request().title == "u17-f3-107"
    assert a_request(name="boiler").title == "boiler"


def test_points_are_stale_after_three_cycles_unless_said_otherwise() -> None:
    assert a_request(every=2).stale_after_used == 6.0
    assert a_request(every=2, stale_after=1).stale_after_used == 1.0


def test_a_response_timeout_of_zero_is_the_lines() -> None:
    master = a_master({}, {"response_timeout": 0.5}, response_timeout=4)
    assert [master.response_timeout_of(request) for request in master.request] == [4.0, 0.5]


def test_unit_0_is_a_broadcast_except_with_framing_tcp() -> None:
    assert a_master().is_broadcast(a_request(unit=0))
    assert not a_master(line="tcp://plc").is_broadcast(a_request(unit=0))
    assert a_master(line="tcp://plc", framing="rtu").is_broadcast(a_request(unit=0))


def test_functions_that_a_slave_answers_are_codes_or_names() -> None:
    slave = SlaveConfig.model_validate(SLAVE | {"functions": [3, "mask_write_register", "read-coils"]})
    assert slave.function_codes == {3, 22, 1}
    assert function_code("read-device-identification") == 43


def test_a_configuration_is_never_changed_in_place() -> None:
    with pytest.raises(ValueError, match="frozen"):
        Config().log.level = "debug"


def test_retained_tables_are_numbers() -> None:
    config = Config.model_validate({"register": {"retain": ["coils", "holding_registers"]}})
    assert config.register_.retained == [Table.COILS, Table.HOLDING_REGISTERS]


# --- one wrong value


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("unit", 300, "unit 300 is more than 247 (255 with framing tcp)"),
        ("unit", 248, "unit 248 is more than 247"),
        ("unit", -1, "unit -1 is less than 0"),
        ("unit", 0, "unit 0 is broadcast, for writes only: a read needs 1 to 247"),
        ("address", True, "address true is not a whole number"),
        ("address", 502.0, "address 502.0 is not a whole number"),
        ("address", "502", 'address "502" is not a whole number'),
        ("address", 65536, "address 65536 is more than 65535"),
        ("address", 10**30, "address of 100 bits is more than 65535"),
        ("count", 126, "count 126 is more than 125"),
        ("count", 0, "count 0 is less than 1"),
        ("every", 0, "every 0 is less than 0.01"),
        ("every", 86401, "every 86401 is more than 86400"),
        ("every", float("inf"), "every inf is not a finite number"),
        ("every", float("nan"), "every nan is not a finite number"),
        ("every", True, "every true is not a number"),
        ("every", "1", 'every "1" is not a number'),
        ("every", 10**400, "every of 1329 bits is too large"),
        ("enabled", 1, "enabled 1 is neither true nor false"),
        ("name", "two words", 'name "two words" is no name: 1 to 32 letters, digits, - and _'),
        ("name", 3, "name 3 is not a text: put it in quotes"),
        ("function", 7, "function 7 is not one of 1, 2, 3, 4, 5, 6, 15, 16, nor a name such as read-coils"),
        ("function", True, "function true is not one of 1, 2, 3, 4, 5, 6, 15, 16, nor a name such as read-coils"),
        ("table", "coil", 'table "coil" is not one of coils, discrete-inputs, holding-registers, input-registers'),
        (
            "table",
            "coils",
            'table "coils" does not fit read-holding-registers: "holding-registers" or "input-registers" does',
        ),
        ("trigger", "once", 'trigger "once" is not one of "cycle", "change"'),
        ("adress", 1, 'unknown key "adress"; did you mean "address"?'),
        ("zz\x07", 1, 'unknown key "zz\\x07"'),
        ("status_point", 1997, "status_point 1997 with 4 points goes beyond input-registers, which end at 1999"),
        ("point", 1998, "point 1998 with 3 points goes beyond holding-registers, which end at 1999"),
        ("trigger", "change", "trigger is for writes, and read-holding-registers reads"),
        ("whole", True, "whole is for writes, and read-holding-registers reads"),
        ("expire", 1, "expire is for writes, and read-holding-registers reads"),
    ],
)
def test_what_is_wrong_with_a_request_is_said_plainly(key: str, value: object, message: str) -> None:
    assert wrong_with(RequestConfig, **{key: value}) == [message]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"line": "ttyS2"}, 'line "ttyS2" is neither a device such as /dev/ttyS2 nor tcp://host:port'),
        ({"line": "tcp://:502"}, 'line "tcp://:502" is not tcp://host:port, with a port from 1 to 65535'),
        ({"line": "/dev/\x00"}, 'line "/dev/\\x00" holds a character that cannot be printed'),
        ({"line": "/" * 256}, f'line "{"/" * 60}..." is longer than 255 characters'),
        ({"line": ""}, "line is empty: one that is enabled needs a device or tcp://host:port"),
        ({"framing": "tcp"}, 'framing "tcp" is for tcp:// lines only'),
        ({"data_bits": 7}, "data_bits 7 is too few: rtu needs 8"),
        ({"data_bits": 9}, "data_bits 9 is not one of 7, 8"),
        ({"stop_bits": True}, "stop_bits true is not a whole number"),
        ({"stop_bits": 1.0}, "stop_bits 1.0 is not a whole number"),
        ({"parity": "none"}, "8N1 is accepted; without parity the standard asks for stop_bits = 2"),
        (
            {"baudrate": 12345},
            "baudrate 12345 is not one of 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400",
        ),
        ({"bauderate": 9600}, 'unknown key "bauderate"; did you mean "baudrate"?'),
        ({"response_timeout": 0}, "response_timeout 0 is not more than 0"),
        ({"retries": 101}, "retries 101 is more than 100"),
        ({"request": {}}, "request must be written with double brackets: [[master.request]]"),
        ({"request": [1]}, "request must be a table"),
    ],
)
def test_what_is_wrong_with_a_master_is_said_plainly(keys: dict[str, Any], message: str) -> None:
    assert wrong_with(MasterConfig, **keys) == [message]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"unit": 0}, "unit 0 is less than 1"),
        ({"unit": 248}, "unit 248 is more than 247"),
        (
            {"allow": ["192.168.1.5/24"]},
            'allow "192.168.1.5/24" is an address inside a network: the network is 192.168.1.0/24',
        ),
        ({"allow": ["here"]}, 'allow "here" is not a network such as 192.168.1.0/24'),
        ({"allow": "10.0.0.0/8"}, 'allow "10.0.0.0/8" is not a list: put it in [ ]'),
        (
            {"functions": [9]},
            "functions 9 is not one of 1, 2, 3, 4, 5, 6, 7, 8, 11, 12, 15, 16, 17, 22, 23, 24, 43, "
            "nor a name such as read-coils",
        ),
        ({"first": 2000}, "first 2000 lies beyond every table of the register"),
        ({"first": 1, "count": 65536}, "count 65536 from first 1 goes beyond 65535"),
        ({"line": "", "enabled": True}, "line is empty: one that is enabled needs a device or tcp://host:port"),
    ],
)
def test_what_is_wrong_with_a_slave_is_said_plainly(keys: dict[str, Any], message: str) -> None:
    assert wrong_with(SlaveConfig, **keys) == [message]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"register": {"coils": 0}}, "coils 0 is less than 1"),
        ({"register": {"retain": ["coils", "coils"]}}, "retain (a list) names a table twice"),
        ({"register": []}, "register must be a table: [register]"),
        ({"hmi": {"password": "secret"}}, "password *** is not a hash: `rtugate passwd` makes one"),
        ({"hmi": {"password": ["secret"]}}, "password *** is not a text: put it in quotes"),
        ({"hmi": {"wifly": {"passphrase": 12345678}}}, "passphrase *** is not a text: put it in quotes"),
        ({"hmi": {"wifly": {"ssid": "x" * 33}}}, f'ssid "{"x" * 33}" is longer than 32 characters'),
        (
            {"hmi": {"wifly": {"address": "192.168.1.50"}}},
            'address "192.168.1.50" is neither "dhcp" nor an address such as 192.168.1.50/24',
        ),
        ({"hmi": {"telnet": {"listen": "2323"}}}, 'listen "2323" is not host:port, with a port from 1 to 65535'),
        ({"hmi": {"serial": {"line": "COM1"}}}, 'line "COM1" is not a device such as /dev/ttyS2'),
        ({"identity": {"vendor": "a\nb"}}, 'vendor "a\\nb" holds a character that cannot be printed'),
        (
            {"watchdog": {"device": "/dev/watchdog", "device_timeout": 25}},
            "device_timeout 25 is not more than timeout + 15 (25)",
        ),
        (
            {"events": {"block_point": 1998}},
            "block_point 1998 with 10 points goes beyond holding-registers, which end at 1999",
        ),
        ({"events": {"fifo_point": 65536}}, "fifo_point 65536 is more than 65535"),
        ({"io": [IO | {"point": 2000}]}, "point 2000 lies beyond discrete-inputs, which end at 1999"),
        ({"io": [IO | {"scale": 1e13}]}, "scale 10000000000000.0 is more than 1000000000000"),
        ({"log": {"level": {}}}, 'level (a table) is not one of "debug", "info", "warning", "error"'),
        ({"log": {"level": "\ud800"}}, 'level "\\ud800" is wrong: '),
    ],
)
def test_what_is_wrong_with_a_table_is_said_plainly(data: dict[str, Any], message: str) -> None:
    (only,) = said(data)
    assert only.startswith(message)


@pytest.mark.parametrize(
    ("kind", "missing"),
    [
        ("master", ["name: letters, digits, - and _", "line: a device such as /dev/ttyS2, or tcp://host:port"]),
        (
            "slave",
            [
                "name: letters, digits, - and _",
                "line: a device such as /dev/ttyS2, or tcp://host:port",
                "unit: 1 to 247",
            ],
        ),
        (
            "io",
            [
                "name: letters, digits, - and _",
                'kind: "gpio-in", "gpio-out" or "iio"',
                "chip: a path such as /dev/gpiochip0",
                "line: a line's offset or name, or an IIO channel",
                "point: the first point in the register",
            ],
        ),
    ],
)
def test_a_missing_key_is_named_with_what_it_takes(kind: str, missing: list[str]) -> None:
    assert said({kind: [{}]}) == [text.replace(":", " is missing:", 1) for text in missing]


def test_a_request_needs_to_know_what_to_ask_and_where_to_put_it() -> None:
    assert said({"master": [MASTER | {"request": [{}]}]}) == [
        "unit is missing: 1 to 247",
        'function is missing: a code or a name, such as "read-holding-registers"',
        "address is missing: 0 to 65535, the first in the device",
        "count is missing: how many, 1 to the function's limit",
        "point is missing: the first point in the register",
    ]


def test_only_the_first_unknown_keys_get_a_hint() -> None:
    messages = said({f"mastr{n}": 1 for n in range(150)})
    assert len(messages) == 150
    assert messages[99].endswith('did you mean "master"?')
    assert messages[100] == 'unknown key "mastr100"'
