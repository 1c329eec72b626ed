"""The types of the configuration's keys, and what is said to a person when a value does not fit.

Strict: a whole number is an integer and nothing that looks like one; a time may be written 1 for 1.0, and is finite.
Everything has bounds. Nothing here knows which keys there are (see ``config``) or what must fit together (see
``config_checks``).

Source: specification of rtugate, section 6; reference.toml for the limits.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from ipaddress import ip_address, ip_interface, ip_network
from typing import Annotated, Any, Final, Literal, get_args

from annotated_types import Ge, Gt, Le, MaxLen
from pydantic import AfterValidator, AllowInfNan, BaseModel, BeforeValidator, ValidationError
from pydantic_core import ErrorDetails, PydanticCustomError

from gateway.plain_text import printable

Path = tuple[str | int, ...]
Severity = Literal["error", "warning", "note"]

SECRETS: Final = frozenset({"password", "passphrase"})  # never shown, whatever is wrong with them
SHOWN_CHARACTERS: Final = 60  # of a wrong text
HINTS: Final = 100  # unknown keys that are compared with the known ones


@dataclass(frozen=True, slots=True)
class Finding:
    """Something wrong or worth knowing at *path*; the message names the key and says what is allowed."""

    path: Path
    message: str
    severity: Severity = "error"


def wrong(predicate: str) -> PydanticCustomError:
    """The error of a value that *predicate* describes: "is not a network"; key and value are put before it."""
    return PydanticCustomError("rtugate", "{predicate}", {"predicate": predicate})


def _only_integers(value: object) -> object:
    if type(value) is not int:  # a Literal takes true for 1 and 1.0 for 1
        raise wrong("is not a whole number")
    return value


def _unit(number: int) -> int:
    if number > 255:
        raise wrong("is more than 247 (255 with framing tcp)")
    return number


def _printable(text: str) -> str:
    if not text.isprintable():
        raise wrong("holds a character that cannot be printed")
    return text


def is_name(text: str) -> bool:
    """Whether *text* may name a line, a request or an input."""
    return re.fullmatch(r"[A-Za-z0-9_-]{1,32}", text) is not None


def _name(text: str) -> str:
    if not is_name(text):
        raise wrong("is no name: 1 to 32 letters, digits, - and _")
    return text


def _device(text: str) -> str:
    if text and not text.startswith("/"):
        raise wrong("is not a device such as /dev/ttyS2")
    return text


def _line(text: str) -> str:
    host = text.removeprefix("tcp://")
    if text.startswith("/") or not text:
        return text
    if host == text:
        raise wrong("is neither a device such as /dev/ttyS2 nor tcp://host:port")
    if host_port(host, 1) is None:
        raise wrong("is not tcp://host:port, with a port from 1 to 65535")
    return text


def _listen(text: str) -> str:
    if text and host_port(text, None) is None:
        raise wrong("is not host:port, with a port from 1 to 65535")
    return text


def _network(text: str) -> str:
    try:
        ip_network(text)
    except ValueError:
        raise wrong(_network_problem(text)) from None
    return text


def _network_problem(text: str) -> str:
    try:
        return f"is an address inside a network: the network is {ip_network(text, strict=False)}"
    except ValueError:
        return "is not a network such as 192.168.1.0/24"


def _interface(text: str) -> str:
    try:
        if text != "dhcp":
            ip_interface(text if "/" in text else "")
    except ValueError:
        raise wrong('is neither "dhcp" nor an address such as 192.168.1.50/24') from None
    return text


def _hash(text: str) -> str:
    if text and not text.startswith("scrypt$"):
        raise wrong("is not a hash: `rtugate passwd` makes one")
    return text


# No Field() in here: pydantic 2.10 gives the default of one field of a shared type to the others.
Name = Annotated[str, AfterValidator(_name)]
Text = Annotated[str, MaxLen(64), AfterValidator(_printable)]
Ssid = Annotated[str, MaxLen(32), AfterValidator(_printable)]  # IEEE 802.11: 32 octets
Device = Annotated[str, MaxLen(255), AfterValidator(_printable), AfterValidator(_device)]
LineText = Annotated[str, MaxLen(255), AfterValidator(_printable), AfterValidator(_line)]
Listen = Annotated[str, MaxLen(255), AfterValidator(_listen)]
Network = Annotated[str, AfterValidator(_network)]
Interface = Annotated[str, AfterValidator(_interface)]
PasswordHash = Annotated[str, MaxLen(255), AfterValidator(_hash)]

Seconds = Annotated[float, Ge(0), Le(86400), AllowInfNan(False)]
SomeSeconds = Annotated[float, Gt(0), Le(86400), AllowInfNan(False)]
SecondOrMore = Annotated[float, Ge(1), Le(86400), AllowInfNan(False)]
Cycle = Annotated[float, Ge(0.01), Le(86400), AllowInfNan(False)]
Factor = Annotated[float, Ge(-1e12), Le(1e12), AllowInfNan(False)]

Unit = Annotated[int, Ge(0), AfterValidator(_unit)]
Address = Annotated[int, Ge(0), Le(65535)]  # of a device or of the register: a point
OptionalPoint = Annotated[int, Ge(-1), Le(65535)]
TableSize = Annotated[int, Ge(1), Le(65536)]

Baudrate = Annotated[
    Literal[1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400],
    BeforeValidator(_only_integers),
]
DataBits = Annotated[Literal[7, 8], BeforeValidator(_only_integers)]
StopBits = Annotated[Literal[1, 2], BeforeValidator(_only_integers)]
Parity = Literal["none", "even", "odd"]
Framing = Literal["rtu", "ascii", "tcp"]

_HOST_PORT: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::([0-9]{1,5}))?")


def host_port(text: str, default_port: int | None) -> tuple[str, int] | None:
    """Host (IPv6 without its brackets) and port of "host:port", or None if *text* is nothing of the kind.

    A *default_port* of None: the port must be there. Names are not looked up.
    """
    found = _HOST_PORT.fullmatch(text)
    port = int(found[2]) if found and found[2] else default_port
    if found is None or port is None or not 1 <= port <= 65535:
        return None
    host = found[1].strip("[]")
    if found[1].startswith("[") or re.fullmatch(r"[0-9.]+", host):
        try:
            ip_address(host)
        except ValueError:
            return None
    return host, port


def shown(value: object) -> str:
    """*value* as TOML would have it, made safe and short."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{escaped(value)}"'
    if isinstance(value, int) and value.bit_length() > 64:
        return f"of {value.bit_length()} bits"
    if isinstance(value, Mapping | list):
        return "(a table)" if isinstance(value, Mapping) else "(a list)"
    return str(value)


def escaped(text: str, most: int = SHOWN_CHARACTERS) -> str:
    """*text* without control characters, cut behind *most* characters."""
    return printable(text if len(text) <= most else f"{text[:most]}...")


def explain(error: ValidationError, model: type[BaseModel]) -> list[Finding]:
    """Every error of *model*'s validation as a finding, in words of our own."""
    details = error.errors(include_url=False)
    return [_explain(detail, model, with_hint=n < HINTS) for n, detail in enumerate(details)]


class Known:
    """Says whether a key has a value to rely on; *doubtful* are the paths that have none, with all that is in them."""

    def __init__(self, doubtful: Iterable[Path] = ()) -> None:
        self._doubtful = frozenset(doubtful)

    def __call__(self, path: Path, *keys: str) -> bool:
        """Whether all *keys* of the table or entry at *path* can be relied on."""
        if not self._doubtful:
            return True
        around = [path[:length] for length in range(len(path) + 1)]
        return self._doubtful.isdisjoint(around) and self._doubtful.isdisjoint([(*path, key) for key in keys])


def doubtful(error: ValidationError, model: type[BaseModel], data: Mapping[str, Any]) -> Iterator[Path]:
    """The paths in *data* that have no value to rely on while *error* stands.

    A wrong item of a list spoils the whole key. An unknown key spoils what it may have been meant for.
    """
    for n, detail in enumerate(error.errors(include_url=False)):
        path = detail["loc"]
        if isinstance(path[-1], int) and detail["type"] != "model_type":
            path = path[:-1]
        yield path
        if detail["type"] == "extra_forbidden":
            yield from _meant(path, model, data) if n < HINTS else [path[:-1]]


def _meant(path: Path, root: type[BaseModel], data: Mapping[str, Any]) -> Iterator[Path]:
    """A key with nearly that name, else any that is not written; or the same key, meant for another table."""
    *outer, key = path
    written: Any = data
    for part in outer:
        written = written[part]
    known = _keys(_model_at(root, path))
    for meant in _close_to(str(key), known) or [name for name in known if name not in written]:
        yield (*outer, meant)
    for length in range(len(outer)):
        yield (*outer[:length], key)
    if not outer:
        yield from ((table, key) for table in known)


def _explain(detail: ErrorDetails, root: type[BaseModel], with_hint: bool) -> Finding:
    path = detail["loc"]
    key = next((str(part) for part in reversed(path) if isinstance(part, str)), "")
    model = _model_at(root, path)
    match detail["type"]:
        case "missing":
            allowed = model.model_fields[key].description
            return Finding(path, f"{key} is missing: {allowed}")
        case "extra_forbidden":
            return Finding(path, _unknown(key, _keys(model) if with_hint else ()))
        case "model_type":
            return Finding(path, f"{key} must be a table" + ("" if path[-1] != key else f": [{_header(path)}]"))
        case "list_type":
            return Finding(path, _no_list(key, path, detail["input"]))
    value = "***" if key in SECRETS else shown(detail["input"])
    return Finding(path, f"{key} {value} {_predicate(detail)}")


def _unknown(key: str, known: Iterable[str]) -> str:
    close = _close_to(key, known)
    return f'unknown key "{escaped(key)}"' + (f'; did you mean "{close[0]}"?' if close else "")


def _close_to(key: str, known: Iterable[str]) -> list[str]:
    """The one of *known* that *key* is likely to mean, if any."""
    return get_close_matches(key, known, n=1) if len(key) < SHOWN_CHARACTERS else []


def _header(path: Path) -> str:
    return ".".join(part for part in path if isinstance(part, str))


def _no_list(key: str, path: Path, value: object) -> str:
    if isinstance(value, Mapping):
        return f"{key} must be written with double brackets: [[{_header(path)}]]"
    return f"{key} {'***' if key in SECRETS else shown(value)} is not a list: put it in [ ]"


def _expected(context: Mapping[str, Any]) -> str:
    allowed = str(context["expected"]).replace(" or ", ", ").replace("'", '"')
    return f"is not one of {allowed}"


_PREDICATES: Final[dict[str, Callable[[Mapping[str, Any]], str]]] = {
    "rtugate": lambda context: str(context["predicate"]),
    "int_type": lambda _: "is not a whole number",
    "float_type": lambda _: "is not a number",
    "finite_number": lambda _: "is not a finite number",
    "bool_type": lambda _: "is neither true nor false",
    "string_type": lambda _: "is not a text: put it in quotes",
    "literal_error": _expected,
    "string_too_long": lambda context: f"is longer than {context['max_length']} characters",
    "greater_than": lambda context: f"is not more than {context['gt']:g}",
    "greater_than_equal": lambda context: f"is less than {context['ge']:g}",
    "less_than_equal": lambda context: f"is more than {_plain(context['le'])}",
}


def _plain(limit: float) -> str:
    return str(int(limit)) if limit == int(limit) else str(limit)


def _predicate(detail: ErrorDetails) -> str:
    if detail["type"] == "float_type" and type(detail["input"]) is int:
        return "is too large"
    words = _PREDICATES.get(detail["type"])
    return words(detail.get("ctx", {})) if words else f"is wrong: {detail['msg']}"


def _model_at(root: type[BaseModel], path: Path) -> type[BaseModel]:
    """The model that holds the last key of *path*."""
    model = root
    for part in path[:-1]:
        if isinstance(part, str):
            fields = {field.alias or name: field for name, field in model.model_fields.items()}
            annotation = fields[part].annotation
            inner = next(iter(get_args(annotation)), annotation)
            if isinstance(inner, type) and issubclass(inner, BaseModel):
                model = inner
    return model


def _keys(model: type[BaseModel]) -> list[str]:
    return [field.alias or name for name, field in model.model_fields.items()]
