"""The texts made from the models: the starting file, what is in effect, the JSON Schema."""

from __future__ import annotations

import copy
import random
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from jsonschema import Draft202012Validator
from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticUndefined

from gateway import __version__
from gateway.config import Config, HmiConfig, HmiWiflyConfig, factory
from gateway.config_checks import validate
from gateway.documents import DIALECT, SCHEMA_NAME, effective_text, schema, starting_file
from gateway.errors import ConfigError
from gateway.save import text_for
from gateway.store import load_text
from tests.configs import IO, MASTER, REQUEST, SLAVE, with_requests
from tests.random_configs import RandomConfig

FULL = tomllib.loads((Path(__file__).parent / "data" / "full.toml").read_text(encoding="utf-8"))
HASH = "scrypt$16384$8$5$c2FsdA$aGFzaA"
SEEDS = range(40)

SCHEMA = schema()
START = starting_file()

validator = Draft202012Validator(SCHEMA)


def models(model: type[BaseModel] = Config, path: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Every table of the file with its model."""
    yield path, model
    for name, field in model.model_fields.items():
        annotation = field.annotation
        inner = next(iter(get_args(annotation)), annotation)
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            key = field.alias or name
            yield from models(inner, f"{path}.{key}" if path else key)


MODELS = dict(models())


def keys_of(path: str) -> list[str]:
    """The keys of a table, without the tables in it."""
    inner = {table.rpartition(".")[2] for table in MODELS if table.rpartition(".")[0] == path and table}
    return [key for name, field in MODELS[path].model_fields.items() if (key := field.alias or name) not in inner]


def table_at(data: dict[str, Any], path: str) -> dict[str, Any]:
    """The table at *path*, of a list of tables the first."""
    table: Any = data
    for part in path.split(".") if path else []:
        table = table[part]
        table = table[0] if isinstance(table, list) else table
    assert isinstance(table, dict)
    return table


def node_at(path: str) -> dict[str, Any]:
    node = SCHEMA
    for part in path.split(".") if path else []:
        node = node["properties"][part]
        node = node.get("items", node)
    return node


def a_config(data: dict[str, Any]) -> Config:
    config, found = validate(data)
    assert config is not None, found
    return config


KEYS = [(path, key) for path in MODELS for key in keys_of(path)]


def written(table: dict[str, Any], path: str = "") -> Iterator[tuple[str, str]]:
    """Every key in *table*, with the table it is in."""
    for key, value in table.items():
        inner = value[0] if isinstance(value, list) and value else value
        if isinstance(inner, dict):
            yield from written(inner, f"{path}.{key}" if path else key)
        else:
            yield path, key


def test_the_walk_over_the_models_finds_every_table_and_every_key() -> None:
    assert sorted(KEYS) == sorted(written(FULL))


# --- the schema


def test_the_schema_is_sound_in_its_own_dialect_refers_to_nothing_and_knows_no_null() -> None:
    Draft202012Validator.check_schema(SCHEMA)
    assert SCHEMA["$schema"] == DIALECT
    assert "$ref" not in str(SCHEMA)
    assert "null" not in str(SCHEMA)


@pytest.mark.parametrize("data", [FULL, {}, tomllib.loads(START)])
def test_the_schema_accepts_a_sound_file(data: dict[str, Any]) -> None:
    assert list(validator.iter_errors(data)) == []


@pytest.mark.parametrize("seed", SEEDS)
def test_the_schema_accepts_any_sound_file(seed: int) -> None:
    assert list(validator.iter_errors(RandomConfig(random.Random(seed)).data)) == []


@pytest.mark.parametrize("path", MODELS)
def test_the_schema_refuses_an_unknown_key_in_every_table(path: str) -> None:
    data = copy.deepcopy(FULL)
    table_at(data, path)["bogus"] = 1
    assert [error.validator for error in validator.iter_errors(data)] == ["additionalProperties"]


@pytest.mark.parametrize("path", ["master", "master.request", "slave", "io"])
def test_the_schema_asks_for_every_key_that_has_no_default(path: str) -> None:
    data = copy.deepcopy(FULL)
    table_at(data, path).clear()
    missing = {key for key, field in MODELS[path].model_fields.items() if field.is_required()}
    assert {error.message.split("'")[1] for error in validator.iter_errors(data)} == missing


VALUES: list[Any] = [
    True,
    -2,
    -1,
    0,
    1,
    2,
    3,
    7,
    8,
    100,
    101,
    247,
    248,
    255,
    256,
    1000,
    9600,
    65535,
    65536,
    65537,
    86400,
    86401,
]
VALUES += [0.005, 0.5, 86400.5, 1e13, 10**7, "", "none", "rtu", "coils", "discrete_inputs", "x" * 65, "x" * 256, [], {}]
VALUES += [
    "read-coils",
    "read_coils",
    "write-multiple_coils",
    "mask-write-register",
    [3, "read-coils"],
    [99],
    ["coils"],
]


@pytest.mark.parametrize(("path", "key"), KEYS)
def test_the_schema_judges_a_value_as_the_model_does_but_for_what_a_text_looks_like(path: str, key: str) -> None:
    judge = Draft202012Validator(node_at(path)["properties"][key])
    for value in VALUES:
        data = copy.deepcopy(FULL)
        table_at(data, path)[key] = value
        refused = list(judge.iter_errors(value))
        try:
            Config.model_validate(data)
        except ValidationError:
            is_loose = isinstance(value, str) and "enum" not in str(node_at(path)["properties"][key])
            assert refused or is_loose or isinstance(value, list), (value, "is accepted")
        else:
            assert not refused, (value, refused)


@pytest.mark.parametrize(("path", "key"), KEYS)
def test_every_key_is_explained_in_one_line_with_its_default(path: str, key: str) -> None:
    node = node_at(path)["properties"][key]
    field = next(field for name, field in MODELS[path].model_fields.items() if key in (name, field.alias))
    assert 10 < len(node["description"]) <= 140
    assert "\n" not in node["description"]
    assert ("default" in node) == (field.default not in (None, PydanticUndefined))
    assert node.get("default") == (None if field.is_required() else field.default)


@pytest.mark.parametrize(
    ("path", "key", "text"),
    [
        ("register", "coils", "how many coils there are; 1 to 65536"),
        ("master", "parity", 'on a device: the parity of each character; "none", "even" or "odd"'),
        ("master", "data_bits", "on a device: rtu needs 8; default: 7 with ascii, else 8; 7 or 8"),
        ("master", "response_timeout", "seconds to wait for a reply; more than 0, at most 86400"),
        ("master.request", "every", "cycle time in seconds; 0.01 to 86400"),
        ("master.request", "address", "PDU address: 0 to 65535, the first in the device"),
        ("slave", "unit", "the unit identifier it answers to: 1 to 247"),
        ("io", "offset", "iio: what is added after scaling; -1e+12 to 1e+12"),
        ("hmi.wifly", "ssid", "the name of the WiFi network; at most 32 characters"),
        ("hmi.serial", "line", 'a device such as /dev/ttyS3; "": none'),
    ],
)
def test_an_explanation_ends_with_what_is_allowed(path: str, key: str, text: str) -> None:
    assert node_at(path)["properties"][key]["description"] == text


def test_a_table_is_explained_where_an_editor_looks_for_it() -> None:
    assert SCHEMA["properties"]["master"]["description"] == "[[master]]: a line that we poll."
    assert SCHEMA["properties"]["hmi"]["properties"]["telnet"]["description"].startswith("[hmi.telnet]: where telnet")


# --- the starting file


def uncommented(text: str) -> str:
    return re.sub(r"^#(?=[a-z[])", "", text, flags=re.MULTILINE)


def test_the_starting_file_loads_as_the_factory_settings_and_nothing_is_said_of_it() -> None:
    loaded = load_text(START, "rtugate.toml")
    assert loaded.config == factory()
    assert loaded.findings == []


def test_the_starting_file_names_its_schema_first_and_fits_100_columns() -> None:
    lines = START.splitlines()
    assert lines[0] == f"#:schema {SCHEMA_NAME}"
    assert max(map(len, lines)) <= 100
    assert START.isascii()


@pytest.mark.parametrize("path", [path for path in MODELS if path])
def test_the_starting_file_shows_every_key_of_every_table_with_its_default(path: str) -> None:
    shown = table_at(tomllib.loads(uncommented(START)), path)
    assert [key for key in shown if f"{path}.{key}" not in MODELS] == keys_of(path)
    for key in keys_of(path):
        default = node_at(path)["properties"][key].get("default", shown[key])
        assert shown[key] == default or (key == "enabled" and path in ("master", "slave"))


def test_the_starting_file_says_what_is_the_default_where_it_shows_something_else() -> None:
    lines = START.splitlines()
    assert [line for line in lines if line.startswith("enabled")] == [
        "enabled = false                 # false: the line starts in maintenance; default: true"
    ] * 2


def test_the_starting_file_explains_each_key_beside_it() -> None:
    text = " ".join(part.strip("# ") for part in START.splitlines() for part in part.split("  #"))
    for path, key in KEYS:
        told = node_at(path)["properties"][key]["description"]
        told = f"required; {told}" if key in node_at(path).get("required", []) else told
        assert f" {told}" in re.sub(" +", " ", text), (path, key)


def test_with_every_example_taken_in_the_starting_file_loads() -> None:
    loaded = load_text(uncommented(START), "rtugate.toml")
    assert {one.severity for one in loaded.findings} <= {"warning"}
    assert all("does not carry it out yet" in one.message for one in loaded.findings)
    assert [request.title for request in loaded.config.master[0].request] == ["boiler", "setpoint"]
    assert list(validator.iter_errors(tomllib.loads(uncommented(START)))) == []


@pytest.mark.parametrize("seed", SEEDS)
def test_the_menu_can_save_into_the_starting_file_and_leaves_its_comments(seed: int) -> None:
    rendered = text_for(START, a_config(RandomConfig(random.Random(seed)).data), "rtugate.toml")
    assert not rendered.is_whole, rendered.reason
    assert rendered.text.startswith(START.partition("\n\n")[0])


# --- what is in effect


def in_effect(data: dict[str, Any], file_name: str = "rtugate.toml") -> dict[str, Any]:
    return tomllib.loads(effective_text(a_config(data), file_name))


@pytest.mark.parametrize("path", [path for path in MODELS if path])
def test_what_is_in_effect_shows_every_key_of_every_table(path: str) -> None:
    bare = in_effect({"master": [MASTER | {"request": [REQUEST]}], "slave": [SLAVE], "io": [IO]})
    assert [key for key in table_at(bare, path) if f"{path}.{key}" not in MODELS] == keys_of(path)


def test_what_is_in_effect_of_a_full_file_is_what_it_says() -> None:
    wanted = copy.deepcopy(FULL)
    wanted["master"][0]["request"][0] |= {"response_timeout": 2.5, "stale_after": 3.0}
    wanted["identity"]["revision"] = __version__
    assert in_effect(FULL) == wanted


@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_in_effect_loads_as_the_same(seed: int) -> None:
    data = RandomConfig(random.Random(seed)).data
    data.get("hmi", {}).pop("password", None)
    data.get("hmi", {}).get("wifly", {}).pop("passphrase", None)
    shown = effective_text(a_config(data), "rtugate.toml")
    assert effective_text(load_text(shown, "rtugate.toml").config, "rtugate.toml") == shown


def test_what_follows_from_other_keys_is_shown_as_it_is_used() -> None:
    line = {"name": "a", "line": "/dev/ttyS5", "framing": "ascii", "response_timeout": 4}
    read = {"unit": 2, "function": 4, "address": 5, "count": 1, "point": 6, "every": 0.1}
    write = read | {"function": "write_single_register", "point": 7, "response_timeout": 9}
    master = in_effect({"master": [line | {"request": [read, write]}]})["master"][0]
    assert (master["data_bits"], master["character_timeout"]) == (7, 1.0)
    shown = [(one["name"], one["function"], one["table"], one["response_timeout"]) for one in master["request"]]
    assert shown == [
        ("u2-f4-5", "read-input-registers", "input-registers", 4.0),
        ("u2-f6-5", "write-single-register", "holding-registers", 9.0),
    ]
    assert [one["stale_after"] for one in master["request"]] == [0.3, 0.0]
    slave = in_effect(
        {"slave": [SLAVE | {"functions": [3, "read_coils"]}], "register": {"retain": ["input_registers"]}}
    )
    assert slave["slave"][0]["functions"] == ["read-holding-registers", "read-coils"]
    assert slave["register"]["retain"] == ["input-registers"]


def test_three_of_the_longest_cycles_are_not_more_than_may_be_written() -> None:
    shown = effective_text(a_config(with_requests(REQUEST | {"every": 86400})), "rtugate.toml")
    assert load_text(shown, "rtugate.toml").config.master[0].request[0].stale_after_used == 3 * 86400


def test_an_address_is_shown_in_both_ways_of_counting_and_loads_where_it_looks_like_a_reference_number() -> None:
    shown = effective_text(a_config(with_requests(REQUEST | {"address": 40107, "count": 1})), "rtugate.toml")
    assert "\naddress = 0x9CAB  # holding 40108 (440108, address 40107 = 0x9CAB)\n" in shown
    assert load_text(shown, "rtugate.toml").config.master[0].request[0].address == 40107


def test_secrets_are_never_shown_and_their_place_refuses_to_load() -> None:
    wifly = {"passphrase": "correct horse", "ssid": "plant"}
    shown = effective_text(a_config({"hmi": {"password": HASH, "wifly": wifly}}), "rtugate.toml")
    assert HASH not in shown
    assert "correct" not in shown
    assert "*** stands for what is not shown" in shown
    with pytest.raises(ConfigError) as refused:
        load_text(shown, "rtugate.toml")
    assert [str(one).partition("]: ")[2] for one in refused.value.findings] == [
        "password *** is not a hash: `rtugate passwd` makes one",
        "passphrase *** stands where `rtugate show` left it out: type it in",
    ]


@pytest.mark.parametrize("hmi", [{"password": HASH}, {"wifly": {"passphrase": "correct horse"}}])
def test_the_text_says_that_something_is_not_shown(hmi: dict[str, Any]) -> None:
    assert "not shown" in effective_text(a_config({"hmi": hmi}), "rtugate.toml").partition("\n\n")[0]


def test_a_secret_that_is_not_set_is_visibly_empty() -> None:
    shown = effective_text(Config(), "rtugate.toml")
    assert "***" not in shown
    assert (HmiConfig().password, HmiWiflyConfig().passphrase) == ("", "")
    assert 'password = ""' in shown
    assert 'passphrase = ""' in shown


def test_a_file_name_cannot_break_out_of_its_comment() -> None:
    assert in_effect({}, 'a\n[hmi]\nlanguage = "es"')["hmi"]["language"] == "en"
