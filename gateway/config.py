"""The configuration as pydantic models: every key of the TOML file with its type, its range and its default.

A model refuses a wrong value of one key; what must fit together is found by ``config_checks``, and whoever makes a
configuration goes through it. Defaults that depend on other keys are properties here, never stored: what a person did
not write is not written for him. Nothing is opened, looked up or resolved.

Source: reference.toml (keys and defaults); specification of rtugate, sections 1 to 8 and 12.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

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


def function_code(function: int | str) -> int:
    """The code of a function that the configuration gives as a code or as a name."""
    return function if isinstance(function, int) else SERVED_CODES[function.replace("_", "-")]


def table_number(name: str) -> Table:
    """The table of a *name* written with - or _."""
    return TABLES[name.replace("_", "-")]


TableName = Annotated[str, AfterValidator(_table)]


class Section(BaseModel):
    """What all tables of the file have in common: strict, no unknown keys, never changed in place."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class RegisterConfig(Section):
    """[register]: the sizes of the four tables, in points, and which of them outlive a restart."""

    coils: TableSize = 2000
    discrete_inputs: TableSize = 2000
    holding_registers: TableSize = 2000
    input_registers: TableSize = 2000
    retain: Annotated[list[TableName], AfterValidator(_once_each)] = []

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


class RequestConfig(Section):
    """[[master.request]]: one poll or one write, and the points of the register that it fills or takes from."""

    name: Name | None = None
    enabled: bool = True
    unit: Annotated[Unit, Field(description="1 to 247", json_schema_extra={"maximum": 255})]
    function: Annotated[
        int | str,
        BeforeValidator(_polled),
        Field(description='a code or a name, such as "read-holding-registers"'),
    ]
    address: Annotated[Address, Field(description="0 to 65535, the first in the device")]
    count: Annotated[int, Field(ge=1, le=65536, description="how many, 1 to the function's limit")]
    every: Cycle = 1.0
    point: Annotated[Address, Field(description="the first point in the register")]
    table: TableName | None = None
    response_timeout: Seconds = 0.0
    on_failure: Literal["hold", "zero"] = "hold"
    stale_after: Seconds = 0.0
    status_point: OptionalPoint = -1
    events: bool = False
    trigger: Literal["cycle", "change"] = "cycle"
    whole: bool = False
    expire: Seconds = 10.0

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

    name: Annotated[Name, Field(description="letters, digits, - and _")]
    enabled: bool = True
    line: Annotated[LineText, Field(description="a device such as /dev/ttyS2, or tcp://host:port")]
    framing: Framing | None = None
    baudrate: Baudrate = 19200
    parity: Parity = "even"
    data_bits: DataBits | None = None
    stop_bits: StopBits = 1
    rs485: Literal["none", "kernel", "rts"] = "none"
    rts_before: Seconds = 0.0
    rts_after: Seconds = 0.0
    discard_echo: bool = False
    character_timeout: SomeSeconds | None = None

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

    response_timeout: SomeSeconds = 2.5
    delay: Seconds = 0.0
    turnaround: Seconds = 0.1
    retries: Annotated[int, Field(ge=0, le=100)] = 0
    request: list[RequestConfig] = []

    def is_broadcast(self, request: RequestConfig) -> bool:
        """Whether nobody will answer: on framing tcp unit 0 is a device like any other."""
        return request.unit == 0 and self.framing_used != "tcp"

    def response_timeout_of(self, request: RequestConfig) -> float:
        """Seconds to wait for the answer to *request*."""
        return request.response_timeout or self.response_timeout


class SlaveConfig(LineConfig):
    """[[slave]]: a line on which masters poll us."""

    unit: Annotated[int, Field(ge=1, le=247, description="1 to 247")]
    writable: bool = True
    stale: Literal["serve", "exception"] = "serve"
    functions: list[Annotated[int | str, BeforeValidator(_served)]] = []
    first: Address = 0
    count: Annotated[int, Field(ge=0, le=65536)] = 0
    allow: list[Network] = []
    max_clients: Annotated[int, Field(ge=1, le=1000)] = 32
    idle_timeout: Seconds = 300.0

    @property
    def function_codes(self) -> frozenset[int]:
        """The codes it answers; empty: everything."""
        return frozenset(function_code(function) for function in self.functions)


class IdentityConfig(Section):
    """[identity]: what functions 17 and 43 say."""

    vendor: Text = "rtugate"
    product: Text = "rtugate"
    revision: Text = ""


EVENT_BLOCK_HEAD: Final = 3  # acknowledge, waiting, lost
EVENT_ENTRY: Final = 7  # registers of one change: number, table, point, value, time (3)
EVENT_BLOCK_ENTRIES: Final = 17  # 3 + 17 x 7 = 122 registers: one read


class EventsConfig(Section):
    """[events]: the queue of changes for the upper side."""

    size: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    fifo_point: OptionalPoint = -1
    block_point: OptionalPoint = -1


class IoConfig(Section):
    """[[io]]: an input or output of our own."""

    name: Annotated[Name, Field(description="letters, digits, - and _")]
    kind: Annotated[Literal["gpio-in", "gpio-out", "iio"], Field(description='"gpio-in", "gpio-out" or "iio"')]
    chip: Annotated[Device, Field(description="a path such as /dev/gpiochip0")]
    line: Annotated[Text, Field(description="a line's offset or name, or an IIO channel")]
    point: Annotated[Address, Field(description="the first point in the register")]
    every: Cycle = 0.1
    scale: Factor = 1.0
    offset: Factor = 0.0

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

    line: Device = ""
    baudrate: Baudrate = 38400
    password_required: bool = False


class HmiTelnetConfig(Section):
    """[hmi.telnet]: where telnet listens, and for whom."""

    listen: Listen = "127.0.0.1:2323"
    allow: list[Network] = []

    @property
    def address(self) -> tuple[str, int] | None:
        """Host and port, or None without telnet."""
        return host_port(self.listen, None)


class HmiWiflyConfig(Section):
    """[hmi.wifly]: a WiFly module that carries the menu."""

    line: Device = ""
    baudrate: Baudrate = 9600
    ssid: Ssid = ""
    passphrase: Text = ""
    address: Interface = "dhcp"
    retries: Annotated[int, Field(ge=0, le=100)] = 5


class HmiConfig(Section):
    """[hmi]: the menu."""

    language: Literal["en", "es", "pt"] = "en"
    ascii: bool = False
    serial_hold: Seconds = 30.0
    idle_timeout: SecondOrMore = 300.0
    login_timeout: SecondOrMore = 60.0
    password: PasswordHash = ""
    confirm_minutes: Annotated[int, Field(ge=1, le=1440)] = 10
    serial: HmiSerialConfig = HmiSerialConfig()
    telnet: HmiTelnetConfig = HmiTelnetConfig()
    wifly: HmiWiflyConfig = HmiWiflyConfig()


class WatchdogConfig(Section):
    """[watchdog]: how long a task may stand still, and the device that then resets the machine."""

    timeout: SecondOrMore = 10.0
    device: Device = ""
    device_timeout: Annotated[int, Field(ge=1, le=86400)] = 30


class LogConfig(Section):
    """[log]"""

    level: Literal["debug", "info", "warning", "error"] = "info"


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
