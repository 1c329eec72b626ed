"""The texts that are made from the configuration's models: a starting file, what is in effect, a schema for editors.

The starting file shows every key, with its default or an example, in a comment where that changes nothing; it loads as
the factory settings. What is in effect is a file again, with every key as it is used, and no secret in it: where one
was, *** refuses to load until a person has typed it in. The schema lets an editor complete, explain and check keys; it
knows nothing of what must fit together, which is for `rtugate check`. Nothing is read or written here.

Source: specification of rtugate, sections 6 and 9; JSON Schema 2020-12. Any thread; nothing is shared.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from textwrap import wrap
from typing import Any, Final, NamedTuple

import tomli_w

from gateway import __version__
from gateway.config import (
    FUNCTION_CODES,
    FUNCTION_NAMES,
    TABLE_NAMES,
    Config,
    IoConfig,
    LineConfig,
    MasterConfig,
    RequestConfig,
    SlaveConfig,
    factory,
    function_code,
)
from gateway.config_fields import SECRETS, escaped
from gateway.hmi.wording import point_name, reference_problem
from gateway.modbus.pdu import Table
from gateway.save import data_of

SCHEMA_NAME: Final = "rtugate.schema.json"  # beside the TOML file, whose first line names it
DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
HIDDEN: Final = "***"
COLUMNS: Final = 100
EXPLANATION_COLUMN: Final = 32
MANY: Final = 255  # characters: a limit that nobody needs to be told of
LONGEST_STALE_S: Final = 86400.0  # what stale_after may be

Node = dict[str, Any]

# ------------------------------------------------------------------------------------------------ schema


def schema_text() -> str:
    """Return the JSON Schema of the file as a text."""
    return json.dumps(schema(), indent=2) + "\n"


def schema() -> Node:
    """Return the JSON Schema of the file; the description of a key is what may be told of it in one line.

    Everything stands where it is meant, nothing is referred to: not every editor for TOML follows a "$ref".
    """
    made = Config.model_json_schema()
    about = {"$schema": DIALECT, "title": "rtugate.toml", "$comment": f"made by `rtugate schema`, {__version__}"}
    return about | _tidy(made, made["$defs"], is_required=False)


def _tidy(node: Node, definitions: Mapping[str, Node], is_required: bool) -> Node:
    """Return pydantic's *node* without references, made-up titles, and null, which TOML does not have."""
    node = dict(definitions[node["$ref"].rpartition("/")[2]]) if "$ref" in node else dict(node)
    node.pop("$defs", None)
    title = node.pop("title", "")
    if "anyOf" in node:
        node |= _without_null(node.pop("anyOf"))
    if node.get("default", "") is None:
        del node["default"]
    if "properties" in node:
        required = node.get("required", [])
        node["properties"] = {
            key: _tidy(inner, definitions, key in required) for key, inner in node["properties"].items()
        }
        return node
    if "items" in node:
        node["items"] = _tidy(node["items"], definitions, is_required=False)
    if _is_table(node):
        return {"type": "array", "description": node["items"]["description"], "items": node["items"]}
    if "description" in node:
        node["description"] = f"{title}: {node['description']}" if is_required else _with_range(node)
    return node


def _without_null(choices: Sequence[Node]) -> Node:
    left = [choice for choice in choices if choice.get("type") != "null"]
    return left[0] if len(left) == 1 else {"anyOf": left}


def _is_table(node: Node) -> bool:
    """Whether a table, or a list of tables, and no value stands here."""
    return "properties" in node or "properties" in node.get("items", {})


def _with_range(node: Node) -> str:
    return "; ".join(part for part in (node["description"], _range(node)) if part)


def _range(node: Node) -> str:
    """Say what may stand for a value: "1 to 247"; "" where there are no bounds."""
    if "enum" in node:
        *others, last = (json.dumps(choice) for choice in node["enum"])
        return f"{', '.join(others)} or {last}"
    if "exclusiveMinimum" in node:
        return f"more than {node['exclusiveMinimum']:g}, at most {_plain(node['maximum'])}"
    if "minimum" in node:
        return f"{_plain(node['minimum'])} to {_plain(node['maximum'])}"
    return f"at most {node['maxLength']} characters" if node.get("maxLength", MANY) < MANY else ""


def _plain(bound: float) -> str:
    return str(int(bound)) if bound == int(bound) and abs(bound) < 1e9 else f"{bound:g}"


# ------------------------------------------------------------------------------------------------ starting file


EXAMPLES: Final[dict[str, dict[str, Any]]] = {  # for keys that have no default, or one that follows from others
    "master": {"framing": "rtu", "data_bits": 8, "character_timeout": 0.2},
    "master.request": {
        "name": "boiler",
        "unit": 17,
        "function": "read-holding-registers",
        "address": 107,
        "count": 3,
        "point": 0,
        "table": "holding-registers",
    },
    "slave": {"framing": "tcp", "data_bits": 8, "character_timeout": 0.2},
    "io": {"name": "door", "kind": "gpio-in", "chip": "/dev/gpiochip0", "line": "17", "point": 0},
}

PREFACE: Final = (
    "The configuration of rtugate, a Modbus gateway: its master (client) polls the devices in the field, its slave "
    "(server) gives what they said to SCADA. As it stands, nothing is polled or served: give both lines a port and "
    "enable them, and add requests, in this file or at the menu (`rtugate menu`).",
    "A line that starts with # and a key, such as #coils = 2000, shows a default or an example: take the # away and "
    "change the value. Beside each key stands what it means, in which unit, and what is allowed.",
    "Times are seconds. Addresses are PDU addresses, which start at 0: what a handbook calls holding 108, or 40108, is "
    "address 107. Points are the places of the gateway's own tables, and start at 0 too. Names of tables and of "
    "functions may be written with - or _.",
    "`rtugate check` finds every mistake in this file, with its line, and says how busy each line will be. A gateway "
    "that runs reads the file anew on SIGHUP.",
)
PROSE: Final = {
    "register": "The data register: masters fill its tables, slaves serve them. Every point has a quality and an age.",
    "master": "Field side: a line whose devices we poll as its master (client). Repeat the block for every other line.",
    "master.request": (
        "What is asked of a device on the line above, or written to it. Repeat the block for every other request. "
        "Functions: " + ", ".join(f"{name} ({code})" for name, code in FUNCTION_CODES.items()) + "."
    ),
    "slave": "Upper side: a line or TCP port where we answer as a slave (server). Repeat the block for each other one.",
    "identity": "What a slave says of itself (functions 17 and 43).",
    "events": "The event queue: what changed in requests with events = true, and when, until SCADA has taken it.",
    "io": "The gateway's own inputs and outputs: GPIO lines and analogue inputs (IIO). Repeat the block for each one.",
    "hmi": "The menu.",
    "hmi.serial": "The menu on a serial console, at 8N1.",
    "hmi.telnet": "The menu over telnet. Beyond this machine (0.0.0.0:2323, for example) it needs a password.",
    "hmi.wifly": "The menu through a WiFly module (RN-171, RN-XV) on a serial port.",
    "watchdog": "What happens when part of the gateway hangs.",
    "log": "The log.",
}
SECOND_REQUEST: Final = """
# A setpoint: what SCADA or the menu writes to point 3 goes on to the device, at once.
#[[master.request]]
#name = "setpoint"
#unit = 17
#function = "write-single-register"
#address = 110
#count = 1
#point = 3
#trigger = "change"
""".splitlines()


def starting_file() -> str:
    """Return a commented file that loads as the factory settings and shows every key."""
    lines = [f"#:schema {SCHEMA_NAME}"]
    for paragraph in PREFACE:
        lines += [*_comment(paragraph), "#"]
    return "\n".join([*lines[:-1], *_tables(schema(), "", data_of(factory()))]) + "\n"


def _tables(node: Node, path: str, given: Mapping[str, Any]) -> Iterator[str]:
    """The tables in the table at *path*, where the file gives the keys *given*; one it does not give is an example."""
    for key, inner in node["properties"].items():
        if not _is_table(inner):
            continue
        here = f"{path}.{key}" if path else key
        is_list = "items" in inner
        entries = given.get(key, [] if is_list else {})
        table, keys = (inner["items"], entries[0] if entries else {}) if is_list else (inner, entries)
        yield from ["", *_comment(PROSE[here])]
        yield f"[[{here}]]" if entries else f"#[[{here}]]" if is_list else f"[{here}]"
        yield from _keys(table, here, keys)
        yield from SECOND_REQUEST if here == "master.request" else []
        yield from _tables(table, here, keys)


def _keys(node: Node, path: str, given: Mapping[str, Any]) -> Iterator[str]:
    examples, required = EXAMPLES.get(path, {}), node.get("required", [])
    for key, inner in node["properties"].items():
        if _is_table(inner):
            continue
        explanation = f"required; {inner['description']}" if key in required else inner["description"]
        if key not in given:
            yield from _explained(f"#{key} = {_value(examples.get(key, inner.get('default')))}", explanation)
        elif given[key] == inner.get("default", given[key]):
            yield from _explained(f"{key} = {_value(given[key])}", explanation)
        else:
            yield from _explained(
                f"{key} = {_value(given[key])}", f"{explanation}; default: {_value(inner['default'])}"
            )


def _explained(text: str, explanation: str) -> Iterator[str]:
    """*text* with its explanation beside it, on as many lines as that takes."""
    column = max(EXPLANATION_COLUMN, len(text) + 2)
    first, *more = wrap(explanation, COLUMNS - EXPLANATION_COLUMN - 2, break_on_hyphens=False)
    if column + 2 + len(first) > COLUMNS:  # a long key, and a long explanation: it takes a line more
        first, *more = wrap(explanation, COLUMNS - column - 2, break_on_hyphens=False)
    yield f"{text:<{column}}# {first}"
    yield from (f"{'':<{column}}# {line}" for line in more)


def _comment(paragraph: str) -> list[str]:
    return [f"# {line}" for line in wrap(paragraph, COLUMNS - 2, break_on_hyphens=False)]


# ------------------------------------------------------------------------------------------------ what is in effect


class Noted(NamedTuple):
    """A value as it is spelled in the file, and what is said beside it."""

    text: str
    note: str


def effective_text(config: Config, file_name: str) -> str:
    """Return *config* as a file that gives every key the value that is used; a secret is shown as ***."""
    preface = _comment(f"What {escaped(file_name)} says, and the defaults, as rtugate {__version__} uses them.")
    if config.hmi.password or config.hmi.wifly.passphrase:
        preface += _comment(f"{HIDDEN} stands for what is not shown: type it in before this text is used as a file.")
    return "\n".join([*preface, *_written(_effective(config), "")]) + "\n"


def _effective(config: Config) -> Node:
    data = config.model_dump(by_alias=True)
    data["register"]["retain"] = [TABLE_NAMES[table] for table in config.register_.retained]
    data["master"] = [_effective_master(master) for master in config.master]
    data["slave"] = [_effective_slave(slave) for slave in config.slave]
    data["io"] = [_effective_io(io) for io in config.io]
    data["identity"]["revision"] = config.identity.revision or __version__
    return data


def _effective_line(line: LineConfig) -> Node:
    return line.model_dump(exclude={"request"}) | {
        "framing": line.framing_used,
        "data_bits": line.data_bits_used,
        "character_timeout": line.character_timeout_used,
    }


def _effective_master(master: MasterConfig) -> Node:
    return _effective_line(master) | {"request": [_effective_request(master, request) for request in master.request]}


def _effective_request(master: MasterConfig, request: RequestConfig) -> Node:
    return request.model_dump() | {
        "name": request.title,
        "function": FUNCTION_NAMES[request.code],
        "address": _address(request),
        "point": _point(request.target, request.point),
        "table": TABLE_NAMES[request.target],
        "response_timeout": master.response_timeout_of(request),
        "stale_after": _stale_after(request),
    }


def _address(request: RequestConfig) -> Noted:
    """The address as it loads: one that looks like a reference number must be spelled in hexadecimal."""
    table, address = request.natural_table, request.address
    is_confusing = reference_problem(table, address, _english)
    return Noted(f"0x{address:04X}" if is_confusing else str(address), point_name(table, address, _english))


def _point(table: Table, point: int) -> Noted:
    return Noted(str(point), point_name(table, point, _english))


def _english(text: str) -> str:
    return text


def _stale_after(request: RequestConfig) -> float:
    """What is used, if it may be written: a write has none, and three of the longest cycles are beyond its range."""
    used = round(request.stale_after_used, 6)  # three times 0.1 is 0.3
    return used if request.is_read and used <= LONGEST_STALE_S else request.stale_after


def _effective_slave(slave: SlaveConfig) -> Node:
    names = [FUNCTION_NAMES[function_code(function)] for function in slave.functions]
    return _effective_line(slave) | {"functions": names}


def _effective_io(io: IoConfig) -> Node:
    return io.model_dump() | {"point": _point(io.target, io.point)}


def _written(table: Node, path: str) -> Iterator[str]:
    """The keys of *table*, then the tables in it; a secret is hidden, and one that is not set visibly empty."""
    tables: list[tuple[str, Node]] = []
    for key, value in table.items():
        here = f"{path}.{key}" if path else key
        if isinstance(value, dict):
            tables.append((f"[{here}]", value))
        elif key in ("master", "request", "slave", "io"):
            tables += [(f"[[{here}]]", entry) for entry in value]
        else:
            note = f"  # {value.note}" if isinstance(value, Noted) else ""
            yield f"{key} = {_value(HIDDEN if key in SECRETS and value else value)}{note}"
    for header, inner in tables:
        yield from ["", header, *_written(inner, header.strip("[]"))]


def _value(value: object) -> str:
    """*value* as TOML, on one line."""
    if isinstance(value, Noted):
        return value.text
    if isinstance(value, list):
        return f"[{', '.join(_value(item) for item in value)}]"
    return tomli_w.dumps({"_": value}).removeprefix("_ = ").rstrip("\n")
