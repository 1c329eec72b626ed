"""What must fit together in a configuration, and what is worth a warning: everything at once, each with its path.

Functions of a ``Config``, apart from its models because a model's own validator does not run while one of its fields is
wrong. Entries that are switched off count too, since a key of the menu switches them on. Nothing is opened or resolved:
two names of one device (a link below /dev/serial/by-id) pass.

Source: specification of rtugate, sections 1 to 8 and 12; reference.toml.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
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
from gateway.config_fields import Finding, Path, explain
from gateway.line_load import line_load
from gateway.modbus.pdu import Table

ADDRESSES: Final = 65536  # application protocol V1.1b3, section 4.4
STATUS_REGISTERS: Final = 4  # specification, section 3
BLOCK_REGISTERS: Final = (
    122  # acknowledge, waiting, lost, and 17 entries of 7: see events.py, which may not be asked here
)
DEVICE_MARGIN_S: Final = 15  # reference.toml, [watchdog]

REFERENCES: Final = {  # how handbooks number points; coils (1 to 9999) cannot be told from addresses
    Table.DISCRETE_INPUTS: (10001, "discrete input"),
    Table.INPUT_REGISTERS: (30001, "input register"),
    Table.HOLDING_REGISTERS: (40001, "holding register"),
}
READ_KEYS: Final = ("on_failure", "stale_after", "events")
WRITE_KEYS: Final = ("trigger", "whole", "expire")


def validate(data: Mapping[str, Any]) -> tuple[Config | None, list[Finding]]:
    """Return the configuration that *data* (a parsed file) describes, None if it has errors, and every finding."""
    try:
        config = Config.model_validate(data)
    except ValidationError as error:
        found = explain(error, Config)
        return None, found + _check_the_rest(data, found)
    found = cross_check(config)
    return (None if any(one.severity == "error" for one in found) else config), found


def cross_check(config: Config) -> list[Finding]:
    """Return what does not fit together in *config* (errors) and what looks wrong (warnings, notes)."""
    found = [*_names(config), *_devices(config), *_polled_hosts(config), *_listeners(config)]
    for i, master in enumerate(config.master):
        found += _line(master, ("master", i))
        found += _requests(config, master, ("master", i))
        found += _load(master, ("master", i))
    for i, slave in enumerate(config.slave):
        found += _line(slave, ("slave", i))
        found += _window(config, i)
    return [*found, *_own_points(config), *_overlaps(config), *_access(config), *_watchdog(config)]


def not_yet(config: Config) -> list[Finding]:
    """Return a warning for everything in *config* that this version accepts and does not carry out."""
    asked: list[tuple[Path, bool]] = [
        (("register", "retain"), bool(config.register_.retain)),
        (("hmi", "serial"), bool(config.hmi.serial.line)),
        (("hmi", "telnet"), "telnet" in config.hmi.model_fields_set and bool(config.hmi.telnet.listen)),
        (("hmi", "wifly"), bool(config.hmi.wifly.line)),
        (("watchdog", "device"), bool(config.watchdog.device)),
    ]
    asked += [(("io", i), True) for i in range(len(config.io))]
    return [Finding(path, _not_carried_out(path), "warning") for path, is_asked in asked if is_asked]


def _not_carried_out(path: Path) -> str:
    key = [part for part in path if isinstance(part, str)][-1]
    return f"{key} is accepted, but this version does not carry it out yet"


# --- the sound part of a file with errors


def _check_the_rest(data: Mapping[str, Any], found: list[Finding]) -> list[Finding]:
    """Cross-check what is left of *data* when each entry or table with an error is taken away."""
    if any(finding.path[0] == "register" for finding in found):
        return []  # without the tables' sizes nothing fits
    bad = {_entry(finding.path) for finding in found}
    origins: dict[Path, Path] = {}
    rest = {key: _sound((key,), value, bad, origins) for key, value in data.items() if (key,) not in bad}
    findings = cross_check(Config.model_validate(rest))
    moved = [replace(finding, path=_origin(finding.path, origins)) for finding in findings]
    return [finding for finding in moved if finding.path[:1] not in bad]  # not of the defaults in a table's place


def _entry(path: Path) -> Path:
    """The innermost entry of a list of tables that *path* lies in, else its outermost table."""
    if path[0] == "master" and path[2:3] == ("request",) and len(path) > 3:
        return path[:4]
    return path[:2] if path[0] in ("master", "slave", "io") else path[:1]


def _sound(path: Path, value: Any, bad: set[Path], origins: dict[Path, Path]) -> Any:
    """*value* without its *bad* entries; *origins* learns where each one that moves up stood."""
    if path[0] not in ("master", "slave", "io"):
        return value
    kept = [(i, entry) for i, entry in enumerate(value) if (*path, i) not in bad]
    for new, (old, _) in enumerate(kept):
        origins[*path, new] = (*path, old)
    if path != ("master",):
        return [entry for _, entry in kept]
    return [
        entry | {"request": _sound_requests(entry.get("request", []), old, new, bad, origins)}
        for new, (old, entry) in enumerate(kept)
    ]


def _sound_requests(entries: list[Any], old: int, new: int, bad: set[Path], origins: dict[Path, Path]) -> list[Any]:
    kept = [(j, entry) for j, entry in enumerate(entries) if ("master", old, "request", j) not in bad]
    for moved, (j, _) in enumerate(kept):
        origins["master", new, "request", moved] = ("master", old, "request", j)
    return [entry for _, entry in kept]


def _origin(path: Path, origins: dict[Path, Path]) -> Path:
    for length in (4, 2):
        if path[:length] in origins:
            return origins[path[:length]] + path[length:]
    return path


# --- names


def _names(config: Config) -> Iterator[Finding]:
    taken: dict[str, str] = {}
    named: list[tuple[str, int, str]] = [("master", i, master.name) for i, master in enumerate(config.master)]
    named += [("slave", i, slave.name) for i, slave in enumerate(config.slave)]
    named += [("io", i, io.name) for i, io in enumerate(config.io)]
    for kind, i, name in named:
        if name in taken:
            other = f"another {kind}" if taken[name] == kind else f"a {taken[name]}"
            yield Finding((kind, i, "name"), f'name "{name}" is already that of {other}')
        taken.setdefault(name, kind)
    for i, master in enumerate(config.master):
        yield from _titles(master, ("master", i, "request"))


def _titles(master: MasterConfig, path: Path) -> Iterator[Finding]:
    taken: set[str] = set()
    for j, request in enumerate(master.request):
        if request.title in taken and request.name:
            yield Finding((*path, j, "name"), f'name "{request.name}" is already that of another request')
        elif request.title in taken:
            yield Finding((*path, j), f'another request is called "{request.title}" too: give one of them a name')
        taken.add(request.title)


# --- ports and addresses


def _devices(config: Config) -> Iterator[Finding]:
    users: list[tuple[str, Path, str]] = [
        (entry.line, (kind, i, "line"), f'{kind} "{entry.name}"')
        for kind, entries in (("master", config.master), ("slave", config.slave))
        for i, entry in enumerate(entries)
    ]
    users += [
        (config.hmi.serial.line, ("hmi", "serial", "line"), "[hmi.serial]"),
        (config.hmi.wifly.line, ("hmi", "wifly", "line"), "[hmi.wifly]"),
    ]
    taken: dict[PurePosixPath, str] = {}
    for line, path, owner in users:
        if line.startswith("/"):
            device = PurePosixPath("/" + line.lstrip("/"))
            if device in taken:
                yield Finding(path, f"line {line} is already used by {taken[device]}")
            taken.setdefault(device, owner)
    yield from _gpio_lines(config)


def _gpio_lines(config: Config) -> Iterator[Finding]:
    taken: dict[tuple[str, str], str] = {}
    for i, io in enumerate(config.io):
        if io.kind != "iio":  # an analogue channel may be read twice
            if (io.chip, io.line) in taken:
                owner = taken[io.chip, io.line]
                yield Finding(("io", i, "line"), f'line "{io.line}" of {io.chip} is already used by io "{owner}"')
            taken.setdefault((io.chip, io.line), io.name)


def _polled_hosts(config: Config) -> Iterator[Finding]:
    taken: dict[tuple[str, int], str] = {}
    for i, master in enumerate(config.master):
        if master.is_tcp:
            host, port = master.address
            address = (_plain_host(host), port)
            if address in taken:
                yield Finding(("master", i, "line"), f'line {master.line} is already used by master "{taken[address]}"')
            taken.setdefault(address, master.name)


def _listeners(config: Config) -> Iterator[Finding]:
    """Two that listen on one port, also where one of them listens on every address."""
    listeners: list[tuple[str, tuple[str, int], Path, str]] = [
        (slave.line, slave.address, ("slave", i, "line"), f'slave "{slave.name}"')
        for i, slave in enumerate(config.slave)
        if slave.is_tcp
    ]
    telnet = config.hmi.telnet.address
    if telnet is not None:
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


def _line(line: LineConfig, path: Path) -> Iterator[Finding]:
    if not line.line and line.enabled:
        yield Finding((*path, "line"), "line is empty: one that is enabled needs a device or tcp://host:port")
    if not line.line.startswith("/"):
        return
    if line.framing_used == "tcp":
        yield Finding((*path, "framing"), 'framing "tcp" is for tcp:// lines only')
    elif line.framing_used == "rtu" and line.data_bits_used != 8:
        yield Finding((*path, "data_bits"), "data_bits 7 is too few: rtu needs 8")
    elif line.framing_used == "rtu" and (line.parity, line.stop_bits) == ("none", 1):
        text = "8N1 is accepted; without parity the standard asks for stop_bits = 2"
        yield Finding((*path, "parity"), text, "note")


def _load(master: MasterConfig, path: Path) -> Iterator[Finding]:
    load = line_load(master)
    if load.percent > 100:
        speed = " at 1 ms a request" if master.is_tcp else f" at {master.baudrate} baud"
        yield Finding(path, f"the polls need {load.percent:.0f} % of the line{speed}", "warning")


def _window(config: Config, i: int) -> Iterator[Finding]:
    slave = config.slave[i]
    if slave.first >= max(config.register_.sizes.values()):
        yield Finding(("slave", i, "first"), f"first {slave.first} lies beyond every table of the register")
    if slave.first + slave.count > ADDRESSES:
        yield Finding(("slave", i, "count"), f"count {slave.count} from first {slave.first} goes beyond 65535")


# --- one request


def _requests(config: Config, master: MasterConfig, path: Path) -> Iterator[Finding]:
    for j, request in enumerate(master.request):
        here = (*path, "request", j)
        yield from _unit(master, request, here)
        yield from _count(request, here)
        yield from _direction(request, here)
        yield from _reference_number(request, here)
        yield from _beyond(config, request.target, request.point, request.count, (*here, "point"))
        if request.status_point >= 0:
            status = (*here, "status_point")
            yield from _beyond(config, Table.INPUT_REGISTERS, request.status_point, STATUS_REGISTERS, status)


def _unit(master: MasterConfig, request: RequestConfig, path: Path) -> Iterator[Finding]:
    if master.framing_used == "tcp":
        return
    if request.unit > 247:
        yield Finding((*path, "unit"), f"unit {request.unit} is more than 247")
    if request.unit == 0 and request.is_read:
        yield Finding((*path, "unit"), "unit 0 is broadcast, for writes only: a read needs 1 to 247")


def _count(request: RequestConfig, path: Path) -> Iterator[Finding]:
    if request.count > request.count_limit:
        yield Finding((*path, "count"), f"count {request.count} is more than {request.count_limit}")
    elif request.address + request.count > ADDRESSES:
        yield Finding((*path, "count"), f"count {request.count} from address {request.address} goes beyond 65535")
    if not _fits_width(request):
        fitting = " or ".join(
            f'"{TABLE_NAMES[table]}"' for table in Table if table.is_bits == request.natural_table.is_bits
        )
        text = f'table "{request.table}" does not fit {FUNCTION_NAMES[request.code]}: {fitting} does'
        yield Finding((*path, "table"), text)


def _fits_width(request: RequestConfig) -> bool:
    return request.target.is_bits == request.natural_table.is_bits


def _direction(request: RequestConfig, path: Path) -> Iterator[Finding]:
    keys, kind, other = (WRITE_KEYS, "writes", "reads") if request.is_read else (READ_KEYS, "reads", "writes")
    for key in keys:
        if getattr(request, key) != RequestConfig.model_fields[key].default:
            yield Finding((*path, key), f"{key} is for {kind}, and {FUNCTION_NAMES[request.code]} {other}")


def _reference_number(request: RequestConfig, path: Path) -> Iterator[Finding]:
    first, point = REFERENCES.get(request.natural_table, (ADDRESSES, ""))
    if first <= request.address < first + 9999:
        text = (
            f"address {request.address} looks like a reference number: "
            f"for {point} {request.address} type address = {request.address - first}"
        )
        yield Finding((*path, "address"), text, "warning")


# --- points of the register


def _beyond(config: Config, table: Table, start: int, count: int, path: Path) -> Iterator[Finding]:
    size = config.register_.size(table)
    if start + count > size:
        points = "lies" if count == 1 else f"with {count} points goes"
        yield Finding(path, f"{path[-1]} {start} {points} beyond {TABLE_NAMES[table]}, which end at {size - 1}")


def _own_points(config: Config) -> Iterator[Finding]:
    for i, io in enumerate(config.io):
        yield from _beyond(config, io.target, io.point, 1, ("io", i, "point"))
    for key, count in (("fifo_point", 1), ("block_point", config.event_block_registers)):
        point = getattr(config.events, key)
        if point >= 0:
            yield from _beyond(config, Table.HOLDING_REGISTERS, point, count, ("events", key))


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


def _uses(config: Config) -> Iterator[_Use]:
    for i, master in enumerate(config.master):
        for j, request in enumerate(master.request):
            owner = f'master "{master.name}", request "{request.title}"'
            path = ("master", i, "request", j)
            if _fits_width(request):
                kind: Literal["fill", "take"] = "fill" if request.is_read else "take"
                yield _Use(request.target, request.point, request.count, kind, owner, (*path, "point"))
            if request.status_point >= 0:
                status = (*path, "status_point")
                yield _Use(Table.INPUT_REGISTERS, request.status_point, STATUS_REGISTERS, "status", owner, status)
    for i, io in enumerate(config.io):
        yield _Use(io.target, io.point, 1, "fill" if io.is_input else "take", f'io "{io.name}"', ("io", i, "point"))
    if config.events.block_point >= 0:
        block = ("events", "block_point")
        yield _Use(
            Table.HOLDING_REGISTERS, config.events.block_point, config.event_block_registers, "fill", "[events]", block
        )


def _overlaps(config: Config) -> Iterator[Finding]:
    """Each use that overlaps an earlier one, once: one pass over the points in order."""
    order = {use: n for n, use in enumerate(_uses(config))}
    furthest: dict[tuple[Table, str], _Use] = {}
    for use in sorted(order, key=lambda use: (use.table, use.start)):
        others = [furthest[use.table, kind] for kind in _CLASHES[use.kind] if (use.table, kind) in furthest]
        other = next((other for other in others if other.end > use.start), None)
        if other is not None:
            yield _clash(*sorted((use, other), key=order.__getitem__))
        known = furthest.get((use.table, use.kind))
        if known is None or use.end > known.end:
            furthest[use.table, use.kind] = use


def _clash(earlier: _Use, later: _Use) -> Finding:
    first, last = max(earlier.start, later.start), min(earlier.end, later.end) - 1
    points = f"point {first}" if first == last else f"points {first} to {last}"
    verb = "is" if first == last else "are"
    text = f"{points} of {TABLE_NAMES[later.table]} {verb} already {_USED[earlier.kind]} {earlier.owner}"
    return Finding(later.path, f"{later.path[-1]} {later.start}: {text}")


# --- menu and watchdog


def _access(config: Config) -> Iterator[Finding]:
    hmi = config.hmi
    if hmi.password:
        return
    remedy = "needs a password: `rtugate passwd` sets one"
    if hmi.telnet.address is not None and not _is_loopback(hmi.telnet.address[0]):
        text = f"listen {hmi.telnet.listen} is beyond this machine and {remedy}"
        yield Finding(("hmi", "telnet", "listen"), text)
    if hmi.wifly.line:
        yield Finding(("hmi", "wifly", "line"), f"line {hmi.wifly.line}: a menu over WiFi {remedy}")


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(_plain_host(host)).is_loopback
    except ValueError:
        return False


def _watchdog(config: Config) -> Iterator[Finding]:
    watchdog = config.watchdog
    least = watchdog.timeout + DEVICE_MARGIN_S
    if watchdog.device and watchdog.device_timeout <= least:
        text = f"device_timeout {watchdog.device_timeout} is not more than timeout + 15 ({least:g})"
        yield Finding(("watchdog", "device_timeout"), text)
