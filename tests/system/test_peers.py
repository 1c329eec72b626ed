"""Other people's programs find nothing to complain about: libmodbus's C library both ways, nmap and mbpoll.

All traffic of libmodbus passes a tap, and tshark reads it when a test is over; test_tshark.py has it decode each field.

A program that is missing fails its tests: apt-get install libmodbus5 mbpoll nmap tshark.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from gateway.config import MasterConfig
from gateway.link import Link, SerialSettings, Waker, open_serial
from gateway.link_tcp import connect_tcp
from gateway.master import Master
from gateway.modbus.identification import Identity
from gateway.modbus.pdu import (
    AnyRequest,
    MaskWriteRequest,
    PlainRequest,
    ReadRequest,
    ReadWriteRequest,
    Span,
    Table,
    WriteRequest,
    pack_bits,
    pack_words,
)
from gateway.register import DataRegister, Quality, Source, SourceKind
from gateway.serving import Station
from gateway.transaction import TIMEOUT, Response
from tests import peers
from tests.lines import CLOCK, MENU, PATIENCE_S, UNIT, Running, holding, running, values
from tests.system import libmodbus
from tests.system.libmodbus import Failed, Refused
from tests.system.tapped import BAUD, Kind, Served, Tap, served, tapped_cable, tapped_tcp
from tests.system.tshark import complaints

LAST = 1999
BITS = [int(number % 3 == 0 or number % 7 == 0) for number in range(2000)]
WORDS = [number * 40503 & 0xFFFF for number in range(2000)]  # all different
TABLES = {1: BITS, 2: BITS[::-1], 3: WORDS, 4: WORDS[::-1]}  # by the function that reads them
QUANTITIES = {1: (1, 7, 8, 9, 2000), 2: (1, 7, 8, 9, 2000), 3: (1, 2, 124, 125), 4: (1, 2, 124, 125)}
STATION = Station(Identity("Maker", "Gate 4", "1.2"))
SERVER_ID = b"\x01\xffMaker Gate 4 1.2"

Record = Callable[[str, object], None]


def a_full_register() -> DataRegister:
    """Return a register whose tables differ, as ``TABLES`` has them."""
    register = DataRegister(CLOCK)
    for function, points in TABLES.items():
        data = pack_bits([bool(point) for point in points]) if function < 3 else pack_words(points)
        register.write(Span(Table(function), 0, 2000), data, MENU)
    return register


# ------------------------------------------------------------------------------------------------ libmodbus asks


@contextmanager
def client_of(slave: Served, unit: int = UNIT) -> Iterator[libmodbus.Client]:
    rtu = slave.kind == "rtu"
    made = libmodbus.client_rtu(slave.place, unit, BAUD) if rtu else libmodbus.client_tcp(slave.place, unit)
    with made as client:
        yield client


@pytest.fixture(params=["tcp", "rtu"])
def slave(request: pytest.FixtureRequest, tmp_path: Path, record_property: Record) -> Iterator[Served]:
    """A slave of ours; when the test is over tshark reads all that has passed."""
    with served(request.param, a_full_register(), STATION) as made:
        yield made
    assert made.tap.packets
    assert complaints(made.tap.packets, made.kind, tmp_path) == []
    record_property("frames that tshark read", len(made.tap.packets))


@pytest.fixture
def client(slave: Served) -> Iterator[libmodbus.Client]:
    with client_of(slave) as made:
        yield made


@pytest.mark.parametrize("function", TABLES)
def test_libmodbus_reads_every_quantity_at_both_ends(client: libmodbus.Client, function: int) -> None:
    for quantity in QUANTITIES[function]:
        for start in {0, 3, 2000 - quantity}:
            if start + quantity <= 2000:
                assert client.read(function, start, quantity) == TABLES[function][start : start + quantity]


def test_libmodbus_writes_single_points(client: libmodbus.Client, slave: Served) -> None:
    for start in (0, LAST):
        for on in (not BITS[start], BITS[start]):
            client.write_coil(start, bool(on))
            assert values(slave.register, Table.COILS, start) == [on]
        for value in (0, 0xFFFF, 0x1234):
            client.write_register(start, value)
            assert holding(slave.register, start) == [value]


@pytest.mark.parametrize(("start", "count"), [(0, 1), (3, 9), (LAST, 1), (2000 - 1968, 1968)])
def test_libmodbus_writes_coils_and_no_neighbour(
    client: libmodbus.Client, slave: Served, start: int, count: int
) -> None:
    changed = [1 - bit for bit in BITS[start : start + count]]
    client.write_coils(start, changed)
    assert values(slave.register, Table.COILS, 0, 2000) == BITS[:start] + changed + BITS[start + count :]


@pytest.mark.parametrize(("start", "count"), [(0, 1), (107, 2), (LAST, 1), (2000 - 123, 123)])
def test_libmodbus_writes_registers_and_no_neighbour(
    client: libmodbus.Client, slave: Served, start: int, count: int
) -> None:
    changed = [word ^ 0xFFFF for word in WORDS[start : start + count]]
    client.write_registers(start, changed)
    assert holding(slave.register, 0, 2000) == WORDS[:start] + changed + WORDS[start + count :]


def test_libmodbus_masks_a_register(client: libmodbus.Client, slave: Served) -> None:
    client.write_register(4, 0x0012)
    client.mask_write(4, 0x00F2, 0x0025)
    assert holding(slave.register, 4) == [0x0017]  # the example of the application protocol, section 6.16


@pytest.mark.parametrize(("read_count", "write_count"), [(1, 1), (125, 121)])
def test_libmodbus_reads_what_the_same_request_has_written(
    client: libmodbus.Client, slave: Served, read_count: int, write_count: int
) -> None:
    written = [number ^ 0xA5A5 for number in range(write_count)]
    found = client.write_and_read(100, written, 100, read_count)
    assert found == (written + WORDS[100 + write_count :])[:read_count]
    assert holding(slave.register, 100, write_count) == written


def test_libmodbus_is_told_who_we_are_on_the_serial_line_alone(client: libmodbus.Client, slave: Served) -> None:
    if slave.kind == "rtu":
        assert client.report_slave_id() == SERVER_ID
    else:
        with pytest.raises(Refused, match="exception 1"):
            client.report_slave_id()


def test_libmodbus_is_told_each_exception_and_nothing_changes(client: libmodbus.Client, slave: Served) -> None:
    calls: list[Callable[[], object]] = [
        lambda: client.read(1, LAST, 2),
        lambda: client.read(2, 2000, 1),
        lambda: client.read(3, 2000 - 124, 125),
        lambda: client.read(4, 65535, 1),
        lambda: client.write_coil(2000, True),
        lambda: client.write_register(65535, 1),
        lambda: client.write_coils(LAST, [1, 1]),
        lambda: client.write_registers(LAST, [1, 2]),
        lambda: client.mask_write(2000, 0, 0),
        lambda: client.write_and_read(LAST, [1, 2], 0, 1),
        lambda: client.write_and_read(0, [1, 2], LAST, 2),
    ]
    for call in calls:
        with pytest.raises(Refused, match="exception 2"):
            call()
    assert values(slave.register, Table.COILS, 0, 2000) == BITS
    assert holding(slave.register, 0, 2000) == WORDS


def test_libmodbus_is_refused_what_it_would_never_ask(client: libmodbus.Client, slave: Served) -> None:
    """Quantities 0, one too many and 65535; in libmodbus's own frames, whose answers it checks."""
    refused = {
        **{f"01 00 00 {quantity}": "81 03" for quantity in ("00 00", "07 D1", "FF FF")},
        **{f"02 00 00 {quantity}": "82 03" for quantity in ("00 00", "07 D1", "FF FF")},
        **{f"03 00 00 {quantity}": "83 03" for quantity in ("00 00", "00 7E", "FF FF")},
        **{f"04 00 00 {quantity}": "84 03" for quantity in ("00 00", "00 7E", "FF FF")},
        "05 00 00 00 01": "85 03",
        "0F 00 00 00 00 00": "8F 03",
        "10 00 00 00 00 00": "90 03",
        "10 00 00 00 7C F6" + 246 * " 00": "90 03",
        "17 00 00 00 7E 00 00 00 01 02 00 00": "97 03",
        "17 00 00 00 01 00 00 00 7A F2" + 242 * " 00": "97 03",
        "41": "C1 01",
    }
    for request, reply in refused.items():
        client.send_raw(UNIT, bytes.fromhex(request))
        frame = client.receive_raw()
        assert (frame[1:-2] if slave.kind == "rtu" else frame[7:]) == bytes.fromhex(reply), request
    assert holding(slave.register, 0, 2000) == WORDS


def test_libmodbus_asking_for_another_unit_is_told_so_on_tcp_and_nothing_on_a_line(slave: Served) -> None:
    with client_of(slave, UNIT + 1) as client:
        with pytest.raises(Refused if slave.kind == "tcp" else Failed, match=r"exception 11|timed out"):
            client.read(3, 0, 1)
        client.set_unit(UNIT)
        slave.tap.cut()
        assert client.read(3, 0, 1) == WORDS[:1]


def test_libmodbus_writes_to_all_and_nobody_answers() -> None:
    with served("rtu", a_full_register(), STATION) as slave, client_of(slave) as client:
        client.send_raw(0, bytes.fromhex("06 00 05 12 34"))
        slave.run.wait_until(lambda: holding(slave.register, 5) == [0x1234])
        assert client.read(3, 5, 1) == [0x1234]  # the first that comes back answers this


# ------------------------------------------------------------------------------------------------ libmodbus answers


@dataclass
class Field:
    """A device of libmodbus's behind a tap. *line*: how our master finds it."""

    kind: Kind
    server: libmodbus.Server
    tap: Tap
    line: str

    @contextmanager
    def master(self, register: DataRegister, *requests: dict[str, Any]) -> Iterator[tuple[Master, Running]]:
        """Give our master at work on it."""
        keys = {"name": "field", "line": self.line, "response_timeout": 1.0, "request": list(requests)}
        config = MasterConfig.model_validate(keys | {"baudrate": BAUD, "parity": "none"})
        with contextlib.closing(Waker()) as waker:

            def opening() -> Link:
                if config.is_tcp:
                    return connect_tcp(*config.address, waker, CLOCK, PATIENCE_S)
                return open_serial(SerialSettings(self.line, BAUD, "none"), waker, CLOCK)

            master = Master(config, register, CLOCK, waker, opening, wait_limit_s=0.5)
            with running(master) as run:
                yield master, run


@contextmanager
def a_field(kind: Kind) -> Iterator[Field]:
    if kind == "rtu":
        with tapped_cable() as (tap, path, device), libmodbus.server_rtu(device, UNIT, BAUD, 2000) as server:
            yield Field(kind, server, tap, path)
    else:
        with libmodbus.server_tcp(2000) as (server, port), tapped_tcp(port) as (tap, tapped):
            yield Field(kind, server, tap, f"tcp://127.0.0.1:{tapped}")


@pytest.fixture(params=["tcp", "rtu"])
def device(request: pytest.FixtureRequest, tmp_path: Path, record_property: Record) -> Iterator[Field]:
    """A device; when the test is over tshark reads all that has passed."""
    with a_field(request.param) as made:
        for function, points in TABLES.items():
            made.server.fill(function, points)
        yield made
    assert complaints(made.tap.packets, made.kind, tmp_path) == []
    record_property("frames that tshark read", len(made.tap.packets))


Ask = Callable[[AnyRequest], Response]


@pytest.fixture
def ask(device: Field) -> Iterator[Ask]:
    """Give what sends one command through our master and waits for what becomes of it."""
    with device.master(DataRegister(CLOCK)) as (master, _):

        def send(request: AnyRequest) -> Response:
            ticket = master.submit(UNIT, request)
            assert ticket.done.wait(PATIENCE_S)
            assert ticket.response is not None
            return ticket.response

        yield send


def data_of(function: int, points: list[int]) -> bytes:
    return pack_bits([bool(point) for point in points]) if function in (1, 2, 5, 15) else pack_words(points)


@pytest.mark.parametrize("function", TABLES)
def test_the_master_reads_every_quantity_from_libmodbus(device: Field, ask: Ask, function: int) -> None:
    for quantity in QUANTITIES[function]:
        for start in {0, 2000 - quantity}:
            response = ask(ReadRequest(function, start, quantity))
            assert not response.has_error()
            assert response.data == data_of(function, TABLES[function][start : start + quantity])
    assert device.server.errors == []


@pytest.mark.parametrize(
    ("function", "start", "count"),
    [(5, 0, 1), (5, LAST, 1), (6, 0, 1), (6, LAST, 1), (15, 3, 9), (15, 32, 1968), (16, 107, 1), (16, 2000 - 123, 123)],
)
def test_the_master_writes_to_libmodbus_and_no_neighbour(
    device: Field, ask: Ask, function: int, start: int, count: int
) -> None:
    table = 1 if function in (5, 15) else 3
    before = TABLES[table]
    changed = [1 - point if table == 1 else point ^ 0xFFFF for point in before[start : start + count]]
    assert not ask(WriteRequest(function, start, count, data_of(function, changed))).has_error()
    assert device.server.table(table)[:2000] == before[:start] + changed + before[start + count :]


def test_the_master_masks_and_reads_while_writing(device: Field, ask: Ask) -> None:
    device.server.table(3)[4] = 0x0012
    assert not ask(MaskWriteRequest(4, 0x00F2, 0x0025)).has_error()
    assert device.server.table(3)[4] == 0x0017
    written = [number ^ 0xA5A5 for number in range(121)]
    response = ask(ReadWriteRequest(100, 125, 100, 121, pack_words(written)))
    assert response.data == pack_words(written + WORDS[221:225])
    assert device.server.table(3)[100:221] == written


def test_the_master_is_told_who_libmodbus_is(ask: Ask) -> None:
    size, name, status, *text = ask(PlainRequest(17)).data
    assert (size, name, status) == (2 + len(text), 0xB4, 0xFF)
    assert bytes(text).startswith(b"LMB3.")


def test_the_master_is_told_libmodbuss_exceptions(device: Field, ask: Ask) -> None:
    requests: list[AnyRequest] = [
        *(ReadRequest(function, LAST, 2) for function in TABLES),
        WriteRequest(5, 2000, 1, b"\x01"),
        WriteRequest(6, 2000, 1, bytes(2)),
        WriteRequest(15, LAST, 2, b"\x03"),
        WriteRequest(16, LAST, 2, bytes(4)),
        MaskWriteRequest(2000, 0, 0),
        ReadWriteRequest(0, 1, LAST, 2, bytes(4)),
    ]
    assert [ask(request).error_code for request in requests] == [2] * len(requests)
    assert device.server.table(3)[:2000] == WORDS


@pytest.mark.parametrize("request_", [PlainRequest(7), PlainRequest(11), PlainRequest(24, bytes(2))], ids=str)
def test_what_libmodbus_does_not_know_disturbs_nothing_that_follows(
    device: Field, ask: Ask, request_: PlainRequest
) -> None:
    """It answers with exception 1, late, or not at all."""
    assert ask(request_).error_code in (1, TIMEOUT)
    device.tap.cut()
    for quantity in (1, 125):
        assert ask(ReadRequest(3, 0, quantity)).data == pack_words(WORDS[:quantity])


def test_the_masters_requests_fill_the_register_and_carry_writes(device: Field) -> None:
    register, scada = DataRegister(CLOCK), Source(SourceKind.CLIENT, "scada")

    def request(function: int, count: int, point: int, **more: Any) -> dict[str, Any]:
        plain = {"unit": UNIT, "function": function, "address": point, "count": count, "point": point}
        return plain | {"every": 0.05, "response_timeout": 1.0} | more

    reads = [request(1, 1000, 0), request(2, 2000, 0), request(3, 125, 0), request(4, 125, 0)]
    written = {5: [1], 6: [4711], 15: [1, 0, 1, 1, 0, 0, 1, 1, 1], 16: [815, 0, 65535]}
    writes = [request(function, len(points), 1500, trigger="change") for function, points in written.items()]
    spans = [Span(Table(read["function"]), 0, read["count"]) for read in reads]
    with device.master(register, *reads, *writes) as (_, run):
        for function, points in written.items():
            table = Table.COILS if function in (5, 15) else Table.HOLDING_REGISTERS
            register.write(Span(table, 1500, len(points)), data_of(function, points), scada)
            run.wait_until(lambda: device.server.table(table)[1500 : 1500 + len(points)] == points)  # noqa: B023
        run.wait_until(lambda: all(qualities(register, span) == {Quality.GOOD} for span in spans))
        for span in spans:
            assert values(register, span.table, 0, span.count) == TABLES[span.table][: span.count]


def qualities(register: DataRegister, span: Span) -> set[Quality]:
    return {sample.quality for sample in register.samples(span)}


# ------------------------------------------------------------------------------------------------ nmap, mbpoll


def test_nmap_finds_the_slave_and_who_it_is(record_property: Record) -> None:
    nmap = shutil.which("nmap")
    assert nmap, "nmap is missing: apt-get install nmap"
    with served("tcp", a_full_register(), STATION) as slave:
        script = ["--script", "+modbus-discover", "--script-args", "modbus-discover.aggressive=true"]  # on any port
        command = [nmap, "-Pn", "-n", "-sT", "-p", str(slave.place), *script, "-oX", "-", "127.0.0.1"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert (done.returncode, done.stderr) == (0, "")
        with client_of(slave) as client:
            assert client.read(3, 0, 125) == WORDS[:125]  # it is still there
    port = ElementTree.fromstring(done.stdout).find(".//port")  # noqa: S314 - written by the program we ran
    assert port is not None
    assert port.find("state").get("state") == "open"  # type: ignore[union-attr]
    units = {
        table.get("key"): {element.get("key"): element.text for element in table.findall("elem")}
        for table in port.findall("script[@id='modbus-discover']/table")
    }
    # Function 17 belongs to the serial line: exception 1 on TCP. Other units: nobody behind this gateway has them.
    assert units.pop(f"sid 0x{UNIT:x}") == {
        "error": "ILLEGAL FUNCTION",
        "Device identification": "Maker Gate 4 1.2",
    }
    assert {tuple(told.items()) for told in units.values()} == {
        (("error", "GATEWAY TARGET DEVICE FAILED TO RESPOND"),),
    }
    assert len(units) == 245
    record_property("units that nmap asked", 246)


def test_mbpoll_is_told_who_we_are_on_a_serial_line() -> None:
    assert peers.has_mbpoll(), "mbpoll is missing: apt-get install mbpoll"
    with served("rtu", a_full_register(), STATION) as slave:
        told = peers.mbpoll("-m", "rtu", "-a", str(UNIT), "-b", str(BAUD), "-P", "none", "-u", slave.place)
    assert "Status: On" in told
    assert "Maker Gate 4 1.2" in told
