"""What must fit together in a configuration, and what is worth a warning: everything at once, each with its path.

Functions of a ``Config``, apart from its models because a model's own validator does not run while one of its fields is
wrong. A file with wrong keys is checked without them: an optional key has its default, a required one a stand-in, and
each check asks ``known`` for the keys whose default or stand-in could lead it astray. What it finds then is still there
when those keys are set right. Entries that are switched off count too, since a key of the menu switches them on.
Nothing is opened or resolved: two names of one device (a link below /dev/serial/by-id) pass.

Source: specification of rtugate, sections 1 to 8 and 12; reference.toml.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import PurePosixPath
from typing import Any, Final, Literal

from pydantic import ValidationError

from gateway.config import (
    FUNCTION_NAMES,
    TABLE_NAMES,
    Config,
    LineConfig,
    MasterConfig,
    RequestConfig,
)
from gateway.config_fields import Finding, Known, Path, doubtful, explain
from gateway.line_load import line_load
from gateway.modbus.pdu import Table

ADDRESSES: Final = 65536  # application protocol V1.1b3, section 4.4
STATUS_REGISTERS: Final = 4  # specification, section 3
DEVICE_MARGIN_S: Final = 15  # reference.toml, [watchdog]

READ_KEYS: Final = ("on_failure", "stale_after", "events")
CHANGE_KEYS: Final = ("whole", "expire")
WRITE_KEYS: Final = ("trigger", *CHANGE_KEYS)
LINE_LOAD_KEYS: Final = ("line", "framing", "baudrate", "parity", "data_bits", "stop_bits", "delay", "turnaround")
POLL_LOAD_KEYS: Final = ("enabled", "unit", "function", "address", "count", "every", "trigger")
EVERYTHING_KNOWN: Final = Known()


def validate(data: Mapping[str, Any]) -> tuple[Config | None, list[Finding]]:
    """Return the configuration that *data* (a parsed file) describes, None if it has errors, and every finding."""
    try:
        config = Config.model_validate(data)
    except ValidationError as error:
        return None, explain(error, Config) + _check_the_rest(data, error)
    found = cross_check(config)
    return (None if any(one.severity == "error" for one in found) else config), found


def cross_check(config: Config, known: Known = EVERYTHING_KNOWN) -> list[Finding]:
    """Return what does not fit together in *config* (errors) and what looks wrong (warnings, notes).

    known: the keys whose values are the person's own; nothing is said that rests on another.
    """
    found = [*_names(config, known), *_devices(config, known), *_polled_hosts(config, known)]
    found += _listeners(config, known)
    for i, master in enumerate(config.master):
        path: Path = ("master", i)
        own = [*_line(master, path, known), *_requests(config, master, path, known)]
        found += [*own, *_load(master, path, known, Known(one.path for one in own if one.severity == "error"))]
    for i, slave in enumerate(config.slave):
        found += _line(slave, ("slave", i), known)
        found += _window(config, i, known)
    found += [*_own_points(config, known), *_overlaps(config, known)]
    return [*found, *_access(config, known), *_watchdog(config, known)]


def not_yet(config: Config) -> list[Finding]:
    """Return a warning for everything in *config* that this version accepts and does not carry out."""
    asked: list[tuple[Path, bool]] = [
        (("hmi", "wifly"), bool(config.hmi.wifly.line)),
    ]
    asked += [(("io", i), True) for i in range(len(config.io))]
    return [Finding(path, _not_carried_out(path), "warning") for path, is_asked in asked if is_asked]


def _not_carried_out(path: Path) -> str:
    key = [part for part in path if isinstance(part, str)][-1]
    return f"{key} is accepted, but this version does not carry it out yet"


# --- the sound part of a file with errors


STAND_INS: Final[dict[str, dict[str, Any]]] = {  # for required keys; no finding may rest on one
    "master": {"name": "x", "line": ""},
    "request": {"unit": 1, "function": 3, "address": 0, "count": 1, "point": 0},
    "slave": {"name": "x", "line": "", "unit": 1},
    "io": {"name": "x", "kind": "iio", "chip": "", "line": "", "point": 0},
}


def _check_the_rest(data: Mapping[str, Any], error: ValidationError) -> list[Finding]:
    """Cross-check *data* without its wrong keys."""
    bad = frozenset(doubtful(error, Config, data))
    return cross_check(Config.model_validate(_sound(data, (), bad)), Known(bad))


def _sound(value: Any, path: Path, bad: frozenset[Path]) -> Any:
    """*value* without its *bad* keys, with a stand-in for each required one that is not there; all entries stay."""
    if isinstance(value, Mapping):
        kept = {key: _sound(inner, (*path, key), bad) for key, inner in value.items() if (*path, key) not in bad}
        return STAND_INS.get(str(path[-2]), {}) | kept if len(path) > 1 and isinstance(path[-1], int) else kept
    if isinstance(value, list):
        return [_sound({} if (*path, i) in bad else item, (*path, i), bad) for i, item in enumerate(value)]
    return value


# --- names


def _names(config: Config, known: Known) -> Iterator[Finding]:
    taken: dict[str, str] = {}
    named: list[tuple[str, int, str]] = [("master", i, master.name) for i, master in enumerate(config.master)]
    named += [("slave", i, slave.name) for i, slave in enumerate(config.slave)]
    named += [("io", i, io.name) for i, io in enumerate(config.io)]
    for kind, i, name in named:
        if not known((kind, i), "name"):
            continue
        if name in taken:
            other = f"another {kind}" if taken[name] == kind else f"a {taken[name]}"
            yield Finding((kind, i, "name"), f'name "{name}" is already that of {other}')
        taken.setdefault(name, kind)
    for i, master in enumerate(config.master):
        yield from _titles(master, ("master", i, "request"), known)


def _titles(master: MasterConfig, path: Path, known: Known) -> Iterator[Finding]:
    taken: set[str] = set()
    for j, request in enumerate(master.request):
        if not _is_title_known(request, (*path, j), known):
            continue
        if request.title in taken and request.name:
            yield Finding((*path, j, "name"), f'name "{request.name}" is already that of another request')
        elif request.title in taken:
            yield Finding((*path, j), f'another request is called "{request.title}" too: give one of them a name')
        taken.add(request.title)


def _is_title_known(request: RequestConfig, path: Path, known: Known) -> bool:
    return known(path, "name") if request.name else known(path, "name", "unit", "function", "address")


def _called(path: Path, name: str, is_known: bool) -> str:
    """`master "field"`, or `master 2` where there is no sound name."""
    return f'{path[-2]} "{name}"' if is_known else f"{path[-2]} {int(path[-1]) + 1}"


# --- ports and addresses


def _devices(config: Config, known: Known) -> Iterator[Finding]:
    users: list[tuple[str, Path, str]] = [
        (entry.line, (kind, i, "line"), _called((kind, i), entry.name, known((kind, i), "name")))
        for kind, entries in (("master", config.master), ("slave", config.slave))
        for i, entry in enumerate(entries)
    ]
    users += [
        (config.hmi.serial.line, ("hmi", "serial", "line"), "[hmi.serial]"),
        (config.hmi.wifly.line, ("hmi", "wifly", "line"), "[hmi.wifly]"),
    ]
    taken: dict[PurePosixPath, str] = {}
    for line, path, owner in users:
        if line.startswith("/"):  # and so no stand-in
            device = PurePosixPath("/" + line.lstrip("/"))
            if device in taken:
                yield Finding(path, f"line {line} is already used by {taken[device]}")
            taken.setdefault(device, owner)
    yield from _gpio_lines(config, known)


def _gpio_lines(config: Config, known: Known) -> Iterator[Finding]:
    taken: dict[tuple[str, str], str] = {}
    for i, io in enumerate(config.io):
        if io.kind != "iio" and known(("io", i), "chip", "line"):  # an analogue channel may be read twice
            if (io.chip, io.line) in taken:
                owner = taken[io.chip, io.line]
                yield Finding(("io", i, "line"), f'line "{io.line}" of {io.chip} is already used by {owner}')
            taken.setdefault((io.chip, io.line), _called(("io", i), io.name, known(("io", i), "name")))


def _polled_hosts(config: Config, known: Known) -> Iterator[Finding]:
    taken: dict[tuple[str, int], str] = {}
    for i, master in enumerate(config.master):
        if master.is_tcp:
            host, port = master.address
            address = (_plain_host(host), port)
            if address in taken:
                yield Finding(("master", i, "line"), f"line {master.line} is already used by {taken[address]}")
            taken.setdefault(address, _called(("master", i), master.name, known(("master", i), "name")))


def _listeners(config: Config, known: Known) -> Iterator[Finding]:
    """Two that listen on one port, also where one of them listens on every address."""
    listeners: list[tuple[str, tuple[str, int], Path, str]] = [
        (
            slave.line,
            slave.address,
            ("slave", i, "line"),
            _called(("slave", i), slave.name, known(("slave", i), "name")),
        )
        for i, slave in enumerate(config.slave)
        if slave.is_tcp
    ]
    telnet = config.hmi.telnet.address
    if telnet is not None and known(("hmi", "telnet"), "listen"):
        listeners.append((config.hmi.telnet.listen, telnet, ("hmi", "telnet", "listen"), "[hmi.telnet]"))
    taken: dict[tuple[str, int], str] = {}
    for text, (name, port), path, owner in listeners:
        host = _plain_host(name)
        clash = next((taken[other, port] for other in _clashing(host) if (other, port) in taken), None)
        if clash:
            yield Finding(path, f"{path[-1]} {text} is already used by {clash}")
        for other in (host, "any host", "any IPv6 host" if ":" in host else "any IPv4 host"):
            taken.setdefault((other, port), owner)


def _clashing(host: str) -> tuple[str, ...]:
    if host == "0.0.0.0":  # noqa: S104  (compared, not bound)
        return ("any IPv4 host", "::")
    if host == "::":
        return ("any host",)
    return (host, "::") if ":" in host else (host, "0.0.0.0", "::")  # noqa: S104


def _plain_host(host: str) -> str:
    if host.lower() == "localhost":
        return "127.0.0.1"
    try:
        return str(ip_address(host))
    except ValueError:
        return host.lower()


# --- one line


def _line(line: LineConfig, path: Path, known: Known) -> Iterator[Finding]:
    if not line.line and line.enabled and known(path, "line", "enabled"):
        yield Finding((*path, "line"), "line is empty: one that is enabled needs a device or tcp://host:port")
    if not line.line.startswith("/") or not known(path, "framing"):
        return
    if line.framing_used == "tcp":
        yield Finding((*path, "framing"), 'framing "tcp" is for tcp:// lines only')
    elif line.framing_used == "rtu" and line.data_bits_used != 8:
        yield Finding((*path, "data_bits"), "data_bits 7 is too few: rtu needs 8")
    elif line.framing_used == "rtu" and (line.parity, line.stop_bits) == ("none", 1) and known(path, "stop_bits"):
        text = "8N1 is accepted; without parity the standard asks for stop_bits = 2"
        yield Finding((*path, "parity"), text, "note")


def _load(master: MasterConfig, path: Path, *known: Known) -> Iterator[Finding]:
    """What the polls need at least: those with something wrong are left out."""
    if not all(each(path, *LINE_LOAD_KEYS) for each in known):
        return
    polls = [
        request
        for j, request in enumerate(master.request)
        if all(each((*path, "request", j), *POLL_LOAD_KEYS) for each in known)
    ]
    load = line_load(master.model_copy(update={"request": polls}))
    if load.percent > 100:
        speed = " at 1 ms a request" if master.is_tcp else f" at {master.baudrate} baud"
        yield Finding(path, f"the polls need {load.percent:.0f} % of the line{speed}", "warning")


def _window(config: Config, i: int, known: Known) -> Iterator[Finding]:
    slave = config.slave[i]
    if slave.first >= max(config.register_.sizes.values()) and _are_sizes_known(known, *Table):
        yield Finding(("slave", i, "first"), f"first {slave.first} lies beyond every table of the register")
    if slave.first + slave.count > ADDRESSES:
        yield Finding(("slave", i, "count"), f"count {slave.count} from first {slave.first} goes beyond 65535")


# --- one request


def _requests(config: Config, master: MasterConfig, path: Path, known: Known) -> Iterator[Finding]:
    for j, request in enumerate(master.request):
        here = (*path, "request", j)
        yield from _unit(master, request, here, known)
        yield from _count(request, here, known)
        if known(here, "function"):
            yield from _direction(request, here, known)
            yield from _events(config, request, here, known)
        if _fits_width(request) and known(here, "function", "table", "point"):
            yield from _beyond(config, request.target, request.point, _points(request), (*here, "point"), known)
        if request.status_point >= 0:
            status = (*here, "status_point")
            yield from _beyond(config, Table.INPUT_REGISTERS, request.status_point, STATUS_REGISTERS, status, known)


def _unit(master: MasterConfig, request: RequestConfig, path: Path, known: Known) -> Iterator[Finding]:
    framing = ("framing",) if master.framing else ("framing", "line")
    if master.framing_used == "tcp" or not known(path[:2], *framing):
        return
    if request.unit > 247:
        yield Finding((*path, "unit"), f"unit {request.unit} is more than 247")
    if request.unit == 0 and request.is_read and known(path, "function"):
        yield Finding((*path, "unit"), "unit 0 is broadcast, for writes only: a read needs 1 to 247")


def _count(request: RequestConfig, path: Path, known: Known) -> Iterator[Finding]:
    if request.count > request.count_limit and known(path, "function"):
        yield Finding((*path, "count"), f"count {request.count} is more than {request.count_limit}")
    elif request.address + request.count > ADDRESSES:
        yield Finding((*path, "count"), f"count {request.count} from address {request.address} goes beyond 65535")
    if not _fits_width(request) and known(path, "function"):
        fitting = " or ".join(
            f'"{TABLE_NAMES[table]}"' for table in Table if table.is_bits == request.natural_table.is_bits
        )
        text = f'table "{request.table}" does not fit {FUNCTION_NAMES[request.code]}: {fitting} does'
        yield Finding((*path, "table"), text)


def _fits_width(request: RequestConfig) -> bool:
    return request.target.is_bits == request.natural_table.is_bits


def _points(request: RequestConfig) -> int:
    """How many points it takes once its count is set right."""
    return min(request.count, request.count_limit)


def _direction(request: RequestConfig, path: Path, known: Known) -> Iterator[Finding]:
    """Keys that have no effect on this request."""
    keys, kind, other = (WRITE_KEYS, "writes", "reads") if request.is_read else (READ_KEYS, "reads", "writes")
    for key in keys:
        if _is_changed(request, key):
            yield Finding((*path, key), f"{key} is for {kind}, and {FUNCTION_NAMES[request.code]} {other}")
    if not request.is_read and request.trigger == "cycle" and known(path, "trigger"):
        for key in CHANGE_KEYS:
            if _is_changed(request, key):
                text = f'{key} is for writes on change, and this one writes every cycle: trigger = "change" is missing'
                yield Finding((*path, key), text)


def _is_changed(request: RequestConfig, key: str) -> bool:
    return bool(getattr(request, key) != RequestConfig.model_fields[key].default)


def _events(config: Config, request: RequestConfig, path: Path, known: Known) -> Iterator[Finding]:
    taken = max(config.events.fifo_point, config.events.block_point) >= 0
    if request.events and request.is_read and not taken and known(("events",), "fifo_point", "block_point"):
        text = "nobody can take the changes: set fifo_point or block_point in [events]"
        yield Finding((*path, "events"), text, "warning")


# --- points of the register


def _are_sizes_known(known: Known, *tables: Table) -> bool:
    return known(("register",), *(TABLE_NAMES[table].replace("-", "_") for table in tables))


def _beyond(config: Config, table: Table, start: int, count: int, path: Path, known: Known) -> Iterator[Finding]:
    size = config.register_.size(table)
    if start + count > size and _are_sizes_known(known, table):
        points = "lies" if count == 1 else f"with {count} points goes"
        yield Finding(path, f"{path[-1]} {start} {points} beyond {TABLE_NAMES[table]}, which end at {size - 1}")


def _own_points(config: Config, known: Known) -> Iterator[Finding]:
    for i, io in enumerate(config.io):
        if known(("io", i), "kind"):
            yield from _beyond(config, io.target, io.point, 1, ("io", i, "point"), known)
    block, count = config.events.block_point, config.event_block_registers
    if block >= 0:
        yield from _beyond(config, Table.HOLDING_REGISTERS, block, count, ("events", "block_point"), known)


@dataclass(frozen=True)
class _Use:
    """Points that something fills, shows a status in, or sends."""

    table: Table
    start: int
    count: int
    kind: Literal["fill", "status", "take"]
    owner: str
    path: Path

    @property
    def end(self) -> int:
        return self.start + self.count


_CLASHES: Final[dict[str, tuple[Literal["fill", "status", "take"], ...]]] = {
    "fill": ("fill", "status"),  # a fill and a take are the normal way to command and read back
    "status": ("fill", "status", "take"),
    "take": ("status",),
}
_USED: Final = {"fill": "filled by", "status": "the status of", "take": "sent by"}


def _uses(config: Config, known: Known) -> Iterator[_Use]:
    """All uses whose place is known; one without a sound count takes its first point at least."""
    for i, master in enumerate(config.master):
        for j in range(len(master.request)):
            yield from _uses_of_request(master, ("master", i, "request", j), known)
    for i, io in enumerate(config.io):
        if known(("io", i), "kind", "point"):
            owner = _called(("io", i), io.name, known(("io", i), "name"))
            yield _Use(io.target, io.point, 1, "fill" if io.is_input else "take", owner, ("io", i, "point"))
    start, count = config.events.block_point, config.event_block_registers
    if start >= 0 and _are_sizes_known(known, Table.HOLDING_REGISTERS):
        yield _Use(Table.HOLDING_REGISTERS, start, count, "fill", "[events]", ("events", "block_point"))


def _uses_of_request(master: MasterConfig, path: Path, known: Known) -> Iterator[_Use]:
    request = master.request[int(path[-1])]
    owner = _called(path[:2], master.name, known(path[:2], "name"))
    owner += f", {_called(path, request.title, _is_title_known(request, path, known))}"
    if _fits_width(request) and known(path, "function", "table", "point"):
        kind: Literal["fill", "take"] = "fill" if request.is_read else "take"
        yield _Use(request.target, request.point, _points(request), kind, owner, (*path, "point"))
    if request.status_point >= 0:
        status = (*path, "status_point")
        yield _Use(Table.INPUT_REGISTERS, request.status_point, STATUS_REGISTERS, "status", owner, status)


def _overlaps(config: Config, known: Known) -> Iterator[Finding]:
    """Each use that overlaps an earlier one, once: one pass over the points in order."""
    order = {use: n for n, use in enumerate(_uses(config, known))}
    furthest: dict[tuple[Table, str], _Use] = {}
    for use in sorted(order, key=lambda use: (use.table, use.start)):
        others = [furthest[use.table, kind] for kind in _CLASHES[use.kind] if (use.table, kind) in furthest]
        other = next((other for other in others if other.end > use.start), None)
        if other is not None:
            yield _clash(*sorted((use, other), key=order.__getitem__))
        longest = furthest.get((use.table, use.kind))
        if longest is None or use.end > longest.end:
            furthest[use.table, use.kind] = use


def _clash(earlier: _Use, later: _Use) -> Finding:
    first, last = max(earlier.start, later.start), min(earlier.end, later.end) - 1
    points = f"point {first}" if first == last else f"points {first} to {last}"
    verb = "is" if first == last else "are"
    text = f"{points} of {TABLE_NAMES[later.table]} {verb} already {_USED[earlier.kind]} {earlier.owner}"
    return Finding(later.path, f"{later.path[-1]} {later.start}: {text}")


# --- menu and watchdog


def _access(config: Config, known: Known) -> Iterator[Finding]:
    hmi = config.hmi
    if hmi.password or not known(("hmi",), "password"):
        return
    remedy = "needs a password: `rtugate passwd` sets one"
    if hmi.telnet.address is not None and not _is_loopback(hmi.telnet.address[0]):
        text = f"listen {hmi.telnet.listen} is beyond this machine and {remedy}"
        yield Finding(("hmi", "telnet", "listen"), text)
    if hmi.wifly.line:
        yield Finding(("hmi", "wifly", "line"), f"line {hmi.wifly.line}: a menu over WiFi {remedy}")
    if hmi.serial.password_required and hmi.serial.line:
        yield Finding(("hmi", "serial", "password_required"), f"password_required true {remedy}")


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(_plain_host(host)).is_loopback
    except ValueError:
        return False


def _watchdog(config: Config, known: Known) -> Iterator[Finding]:
    watchdog = config.watchdog
    least = watchdog.timeout + DEVICE_MARGIN_S
    if watchdog.device and watchdog.device_timeout <= least and known(("watchdog",), "timeout", "device_timeout"):
        text = f"device_timeout {watchdog.device_timeout} is not more than timeout + 15 ({least:g})"
        yield Finding(("watchdog", "device_timeout"), text)
