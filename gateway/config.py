"""The configuration as pydantic models: every key of the TOML file with its type, its range and its default.

A model refuses a wrong value of one key; what must fit together is found by ``config_checks``, and whoever makes a
configuration goes through it. Defaults that depend on other keys are properties here, never stored: what a person did
not write is not written for him. Nothing is opened, looked up or resolved.

Source: reference.toml (keys and defaults); specification of rtugate, sections 1 to 8 and 12.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema

from gateway.config_fields import (
    Address,
    Baudrate,
    Cycle,
    DataBits,
    Device,
    Factor,
    Framing,
    Interface,
    LineText,
    Listen,
    Name,
    Network,
    OptionalPoint,
    Parity,
    PasswordHash,
    SecondOrMore,
    Seconds,
    SomeSeconds,
    Ssid,
    StopBits,
    TableSize,
    Text,
    Unit,
    host_port,
    wrong,
)
from gateway.modbus.pdu import QUANTITY_LIMITS, READS, TABLE_OF, Table

FUNCTION_CODES: Final[dict[str, int]] = {
    "read-coils": 1,
    "read-discrete-inputs": 2,
    "read-holding-registers": 3,
    "read-input-registers": 4,
    "write-single-coil": 5,
    "write-single-register": 6,
    "write-multiple-coils": 15,
    "write-multiple-registers": 16,
}
SERVED_CODES: Final[dict[str, int]] = FUNCTION_CODES | {  # what a slave answers, specification section 3
    "read-exception-status": 7,
    "diagnostics": 8,
    "get-comm-event-counter": 11,
    "get-comm-event-log": 12,
    "report-server-id": 17,
    "mask-write-register": 22,
    "read-write-multiple-registers": 23,
    "read-fifo-queue": 24,
    "read-device-identification": 43,
}
TABLES: Final[dict[str, Table]] = {
    "coils": Table.COILS,
    "discrete-inputs": Table.DISCRETE_INPUTS,
    "holding-registers": Table.HOLDING_REGISTERS,
    "input-registers": Table.INPUT_REGISTERS,
}
TABLE_NAMES: Final = {table: name for name, table in TABLES.items()}
FUNCTION_NAMES: Final = {code: name for name, code in SERVED_CODES.items()}
NATURAL_TABLES: Final = {code: TABLE_OF[code] for code in QUANTITY_LIMITS}  # whose points a request carries
REFERENCE_FIRSTS: Final = {  # how handbooks number points; coils (1 to 9999) cannot be told from addresses
    Table.DISCRETE_INPUTS: 10001,
    Table.INPUT_REGISTERS: 30001,
    Table.HOLDING_REGISTERS: 40001,
}
REFERENCES_EACH: Final = 9999
MODBUS_PORT: Final = 502  # Modbus Messaging on TCP/IP Implementation Guide V1.0b, section 3.1.3


def _code_in(known: dict[str, int], value: object) -> object:
    """*value* as it was written, if it is a code or a name of *known*."""
    if type(value) is int and value in known.values():
        return value
    if isinstance(value, str) and value.replace("_", "-") in known:
        return value
    codes = ", ".join(str(code) for code in sorted(known.values()))
    raise wrong(f"is not one of {codes}, nor a name such as {next(iter(known))}")


def _polled(value: object) -> object:
    return _code_in(FUNCTION_CODES, value)


def _served(value: object) -> object:
    return _code_in(SERVED_CODES, value)


def _table(text: str) -> str:
    if text.replace("_", "-") not in TABLES:
        raise wrong(f"is not one of {', '.join(TABLES)}")
    return text


def _once_each(names: list[str]) -> list[str]:
    if len({name.replace("_", "-") for name in names}) < len(names):
        raise wrong("names a table twice")
    return names


def _written(names: Iterable[str], codes: Iterable[int] = ()) -> WithJsonSchema:
    """The JSON Schema of a name, written with - or _, or of a code."""
    spellings = "|".join(name.replace("-", "[-_]") for name in names)
    return WithJsonSchema({"anyOf": [{"enum": [*names, *codes]}, {"type": "string", "pattern": f"^({spellings})$"}]})


def about(text: str) -> Any:
    """What an optional key says, in one line; its range is added where it is shown (see ``documents``).

    A required key has a title as well, which says what it is; its description then says what to type.
    """
    return Field(description=text)


def _passphrase(text: str) -> str:
    if text == "***":
        raise wrong("stands where `rtugate show` left it out: type it in")
    return text


def function_code(function: int | str) -> int:
    """The code of a function that the configuration gives as a code or as a name."""
    return function if isinstance(function, int) else SERVED_CODES[function.replace("_", "-")]


def table_number(name: str) -> Table:
    """The table of a *name* written with - or _."""
    return TABLES[name.replace("_", "-")]


def meant_by_reference(table: Table, number: int) -> int | None:
    """The PDU address that *number* stands for if it looks like a handbook's 40108; None where it does not."""
    first = REFERENCE_FIRSTS.get(table)
    return number - first if first is not None and first <= number < first + REFERENCES_EACH else None


TableName = Annotated[str, AfterValidator(_table), _written(TABLES)]
Passphrase = Annotated[Text, AfterValidator(_passphrase)]

Served = Annotated[int | str, BeforeValidator(_served), _written(SERVED_CODES, SERVED_CODES.values())]


class Section(BaseModel):
    """What all tables of the file have in common: strict, no unknown keys, never changed in place."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class RegisterConfig(Section):
    """[register]: the sizes of the four tables, in points, and which of them outlive a restart."""

    coils: Annotated[TableSize, about("how many coils there are")] = 2000
    discrete_inputs: Annotated[TableSize, about("how many discrete inputs there are")] = 2000
    holding_registers: Annotated[TableSize, about("how many holding registers there are")] = 2000
    input_registers: Annotated[TableSize, about("how many input registers there are")] = 2000
    retain: Annotated[
        list[TableName],
        AfterValidator(_once_each),
        about('tables whose values survive a restart, such as ["holding-registers"]'),
    ] = []

    def size(self, table: Table) -> int:
        """How many points *table* has."""
        return self.sizes[table]

    @property
    def sizes(self) -> dict[Table, int]:
        return {
            Table.COILS: self.coils,
            Table.DISCRETE_INPUTS: self.discrete_inputs,
            Table.HOLDING_REGISTERS: self.holding_registers,
            Table.INPUT_REGISTERS: self.input_registers,
        }

    @property
    def retained(self) -> list[Table]:
        return [table_number(name) for name in self.retain]


_UNIT: Final = "unit identifier (0: broadcast, for writes; framing tcp: 0 to 255)"
_PORT: Final = 'the port, "" only while not enabled'
_IO_POINT: Final = "a discrete input, for gpio-out a coil, for iio an input register"


class RequestConfig(Section):
    """[[master.request]]: one poll or one write, and the points of the register that it fills or takes from."""

    name: Annotated[Name | None, about("default: u17-f3-107 (unit, function, address)")] = None
    enabled: Annotated[bool, about("false: the request rests")] = True
    unit: Annotated[Unit, Field(title=_UNIT, description="1 to 247", json_schema_extra={"maximum": 255})]
    function: Annotated[
        int | str,
        BeforeValidator(_polled),
        _written(FUNCTION_CODES, FUNCTION_CODES.values()),
        Field(title="what is asked or written", description='a code or a name, such as "read-holding-registers"'),
    ]
    address: Annotated[Address, Field(title="PDU address", description="0 to 65535, the first in the device")]
    count: Annotated[int, Field(ge=1, le=65536, title="points", description="how many, 1 to the function's limit")]
    every: Annotated[Cycle, about("cycle time in seconds")] = 1.0
    point: Annotated[Address, Field(title="where its data starts", description="the first point in the register")]
    table: Annotated[TableName | None, about("another table of the same width; default: the function's")] = None
    response_timeout: Annotated[Seconds, about("seconds to wait for the reply; 0: as long as its line does")] = 0.0
    on_failure: Annotated[Literal["hold", "zero"], about("reads: the last values are held, or zeros shown")] = "hold"
    stale_after: Annotated[Seconds, about("reads: seconds after which values are stale; 0: three cycles")] = 0.0
    status_point: Annotated[OptionalPoint, about("the first of 4 input registers that tell its status; -1: none")] = -1
    events: Annotated[bool, about("reads: changes go to the event queue with their time")] = False
    trigger: Annotated[Literal["cycle", "change"], about("writes: every cycle, or when its points are written")] = (
        "cycle"
    )
    whole: Annotated[bool, about("writes on change: send the whole request, not only what changed")] = False
    expire: Annotated[Seconds, about("writes on change: seconds a command may wait for delivery; 0: any time")] = 10.0

    @property
    def code(self) -> int:
        return function_code(self.function)

    @property
    def title(self) -> str:
        """Its name, or what it asks: unit, function, address."""
        return self.name or f"u{self.unit}-f{self.code}-{self.address}"

    @property
    def is_read(self) -> bool:
        return self.code in READS

    @property
    def natural_table(self) -> Table:
        """The table that the device's points come from or go to."""
        return NATURAL_TABLES[self.code]

    @property
    def target(self) -> Table:
        """The table of the register that it fills, or takes its values from."""
        return self.natural_table if self.table is None else table_number(self.table)

    @property
    def count_limit(self) -> int:
        return QUANTITY_LIMITS[self.code]

    @property
    def stale_after_used(self) -> float:
        """Seconds after which its points are stale: three cycles where nothing is given."""
        return self.stale_after or 3 * self.every


class LineConfig(Section):
    """What a master and a slave have in common: a serial device or a TCP address, and how it is used."""

    name: Annotated[Name, Field(title="unique in the file", description="letters, digits, - and _")]
    enabled: Annotated[bool, about("false: the line starts in maintenance")] = True
    line: Annotated[LineText, Field(title=_PORT, description="a device such as /dev/ttyS2, or tcp://host:port")]
    framing: Annotated[Framing | None, about('frames on the line; default: "rtu" on a device, "tcp" on tcp://')] = None
    baudrate: Annotated[Baudrate, about("on a device: bits per second")] = 19200
    parity: Annotated[Parity, about("on a device: the parity of each character")] = "even"
    data_bits: Annotated[DataBits | None, about("on a device: rtu needs 8; default: 7 with ascii, else 8")] = None
    stop_bits: Annotated[StopBits, about("on a device: the standard asks for 2 without parity")] = 1
    rs485: Annotated[
        Literal["none", "kernel", "rts"], about("on a device: who switches the direction, the kernel or we by RTS")
    ] = "none"
    rts_before: Annotated[Seconds, about("rs485: seconds from RTS to the first bit")] = 0.0
    rts_after: Annotated[Seconds, about("rs485: seconds from the last bit to RTS")] = 0.0
    discard_echo: Annotated[bool, about("on a device: true where the port hears what it sends")] = False
    character_timeout: Annotated[
        SomeSeconds | None, about("seconds of silence that end a frame; default: 0.2, with ascii 1.0")
    ] = None

    @property
    def is_tcp(self) -> bool:
        return self.line.startswith("tcp://")

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of a tcp:// line; raises ValueError on any other."""
        found = host_port(self.line.removeprefix("tcp://"), MODBUS_PORT) if self.is_tcp else None
        if found is None:
            raise ValueError(f"{self.line} is no tcp:// line")
        return found

    @property
    def framing_used(self) -> Framing:
        return self.framing or ("tcp" if self.is_tcp else "rtu")

    @property
    def data_bits_used(self) -> int:
        if self.data_bits is not None:
            return self.data_bits
        return 7 if self.framing_used == "ascii" and not self.is_tcp else 8

    @property
    def character_timeout_used(self) -> float:
        """Seconds of silence inside a frame that end it: 1.0 with ascii (specification, section 4)."""
        return self.character_timeout or (1.0 if self.framing_used == "ascii" else 0.2)


class MasterConfig(LineConfig):
    """[[master]]: a line that we poll."""

    response_timeout: Annotated[SomeSeconds, about("seconds to wait for a reply")] = 2.5
    delay: Annotated[Seconds, about("seconds of extra silence before each request")] = 0.0
    turnaround: Annotated[Seconds, about("seconds to rest after a broadcast")] = 0.1
    retries: Annotated[int, Field(ge=0, le=100, description="more tries before a request has failed")] = 0
    request: list[RequestConfig] = []

    def is_broadcast(self, request: RequestConfig) -> bool:
        """Whether nobody will answer: on framing tcp unit 0 is a device like any other."""
        return request.unit == 0 and self.framing_used != "tcp"

    def response_timeout_of(self, request: RequestConfig) -> float:
        """Seconds to wait for the answer to *request*."""
        return request.response_timeout or self.response_timeout


class SlaveConfig(LineConfig):
    """[[slave]]: a line on which masters poll us."""

    unit: Annotated[int, Field(ge=1, le=247, title="the unit identifier it answers to", description="1 to 247")]
    writable: Annotated[bool, about("false: writes are refused with exception 1")] = True
    stale: Annotated[Literal["serve", "exception"], about("old data: its last value, or exception 11 (0x0B)")] = "serve"
    functions: Annotated[list[Served], about("what it answers, codes or names, such as [3, 4]; []: everything")] = []
    first: Annotated[Address, about("the first point it serves of each table")] = 0
    count: Annotated[int, Field(ge=0, le=65536, description="how many points it serves of each table; 0: all")] = 0
    allow: Annotated[list[Network], about('tcp: networks that may connect, such as ["192.168.1.0/24"]; []: any')] = []
    max_clients: Annotated[
        int, Field(ge=1, le=1000, description="tcp: clients at a time; for one more the longest idle is closed")
    ] = 32
    idle_timeout: Annotated[Seconds, about("tcp: seconds after which a silent client is closed; 0: never")] = 300.0

    @property
    def function_codes(self) -> frozenset[int]:
        """The codes it answers; empty: everything."""
        return frozenset(function_code(function) for function in self.functions)


class IdentityConfig(Section):
    """[identity]: what functions 17 and 43 say."""

    vendor: Annotated[Text, about("the name of the vendor")] = "rtugate"
    product: Annotated[Text, about("the product code")] = "rtugate"
    revision: Annotated[Text, about('its revision; "": the version of rtugate')] = ""


EVENT_BLOCK_HEAD: Final = 3  # acknowledge, waiting, lost
EVENT_ENTRY: Final = 7  # registers of one change: number, table, point, value, time (3)
EVENT_BLOCK_ENTRIES: Final = 17  # 3 + 17 x 7 = 122 registers: one read


class EventsConfig(Section):
    """[events]: the queue of changes for the upper side."""

    size: Annotated[int, Field(ge=1, le=1_000_000, description="changes kept until SCADA takes them")] = 1000
    fifo_point: Annotated[OptionalPoint, about("the address that function 24 reads; -1: none")] = -1
    block_point: Annotated[OptionalPoint, about("the first holding register of the event block; -1: none")] = -1


class IoConfig(Section):
    """[[io]]: an input or output of our own."""

    name: Annotated[Name, Field(title="unique in the file", description="letters, digits, - and _")]
    kind: Annotated[
        Literal["gpio-in", "gpio-out", "iio"], Field(title="what it is", description='"gpio-in", "gpio-out" or "iio"')
    ]
    chip: Annotated[Device, Field(title="the chip", description="a path such as /dev/gpiochip0")]
    line: Annotated[Text, Field(title="which of its lines", description="a line's offset or name, or an IIO channel")]
    point: Annotated[Address, Field(title=_IO_POINT, description="the first point in the register")]
    every: Annotated[Cycle, about("seconds from one look to the next")] = 0.1
    scale: Annotated[Factor, about("iio: raw * scale + offset, rounded, held within 0 to 65535")] = 1.0
    offset: Annotated[Factor, about("iio: what is added after scaling")] = 0.0

    @property
    def target(self) -> Table:
        """The table of the register that it fills or, as an output, follows."""
        kinds = {"gpio-in": Table.DISCRETE_INPUTS, "gpio-out": Table.COILS}
        return kinds.get(self.kind, Table.INPUT_REGISTERS)

    @property
    def is_input(self) -> bool:
        return self.kind != "gpio-out"


class HmiSerialConfig(Section):
    """[hmi.serial]: the menu's serial console, always 8N1."""

    line: Annotated[Device, about('a device such as /dev/ttyS3; "": none')] = ""
    baudrate: Annotated[Baudrate, about("bits per second, always 8N1")] = 38400
    password_required: Annotated[bool, about("true: asks for the password as telnet does")] = False


class HmiTelnetConfig(Section):
    """[hmi.telnet]: where telnet listens, and for whom."""

    listen: Annotated[Listen, about('where telnet listens, host:port; "": nowhere')] = "127.0.0.1:2323"
    allow: Annotated[list[Network], about('networks that may connect, such as ["192.168.1.0/24"]; []: any')] = []

    @property
    def address(self) -> tuple[str, int] | None:
        """Host and port, or None without telnet."""
        return host_port(self.listen, None)


class HmiWiflyConfig(Section):
    """[hmi.wifly]: a WiFly module that carries the menu."""

    line: Annotated[Device, about('a device such as /dev/ttyS0; "": none')] = ""
    baudrate: Annotated[Baudrate, about("bits per second, always 8N1")] = 9600
    ssid: Annotated[Ssid, about("the name of the WiFi network")] = ""
    passphrase: Annotated[Passphrase, about("the passphrase of the WiFi network")] = ""
    address: Annotated[Interface, about('"dhcp", or address and network such as "192.168.1.50/24"')] = "dhcp"
    retries: Annotated[int, Field(ge=0, le=100, description="more tries to set up the module")] = 5


class HmiConfig(Section):
    """[hmi]: the menu."""

    language: Annotated[Literal["en", "es", "pt"], about("what the menu speaks")] = "en"
    ascii: Annotated[bool, about("true: no accents, for a terminal without UTF-8")] = False
    serial_hold: Annotated[Seconds, about("seconds without a serial character until telnet gets the menu")] = 30.0
    idle_timeout: Annotated[SecondOrMore, about("seconds without a key until a session ends")] = 300.0
    login_timeout: Annotated[SecondOrMore, about("seconds to log in")] = 60.0
    password: Annotated[PasswordHash, about("a hash by `rtugate passwd`, for WiFly and telnet beyond loopback")] = ""
    confirm_minutes: Annotated[int, Field(ge=1, le=1440, description='what "commit confirmed" offers, in minutes')] = 10
    serial: HmiSerialConfig = HmiSerialConfig()
    telnet: HmiTelnetConfig = HmiTelnetConfig()
    wifly: HmiWiflyConfig = HmiWiflyConfig()


class WatchdogConfig(Section):
    """[watchdog]: how long a task may stand still, and the device that then resets the machine."""

    timeout: Annotated[SecondOrMore, about("seconds without progress after which a task hangs")] = 10.0
    device: Annotated[Device, about('a device such as /dev/watchdog; "": none')] = ""
    device_timeout: Annotated[
        int, Field(ge=1, le=86400, description="seconds it waits for us; more than timeout + 15")
    ] = 30


class LogConfig(Section):
    """[log]: how much is told."""

    level: Annotated[Literal["debug", "info", "warning", "error"], about("the least that is worth logging")] = "info"


class Config(Section):
    """The whole file."""

    register_: Annotated[RegisterConfig, Field(alias="register")] = RegisterConfig()
    master: list[MasterConfig] = []
    slave: list[SlaveConfig] = []
    identity: IdentityConfig = IdentityConfig()
    events: EventsConfig = EventsConfig()
    io: list[IoConfig] = []
    hmi: HmiConfig = HmiConfig()
    watchdog: WatchdogConfig = WatchdogConfig()
    log: LogConfig = LogConfig()

    @property
    def event_block_registers(self) -> int:
        """How many holding registers the event block takes: 3, and 7 an entry, 17 entries at most, one at least."""
        room = self.register_.holding_registers - self.events.block_point - EVENT_BLOCK_HEAD
        return EVENT_BLOCK_HEAD + EVENT_ENTRY * min(EVENT_BLOCK_ENTRIES, max(1, room // EVENT_ENTRY))


def factory() -> Config:
    """The factory settings: a master and a slave, both off and without a port; the menu gives them what is missing."""
    return Config(
        master=[MasterConfig(name="field", enabled=False, line="")],
        slave=[SlaveConfig(name="scada", enabled=False, line="", unit=1)],
    )
