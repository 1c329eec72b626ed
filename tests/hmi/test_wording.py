"""How points, values, ages and times are worded."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.hmi.wording import (
    N_,
    ORDERS,
    age_text,
    duration_text,
    ordered,
    point_name,
    reference,
    reference_problem,
    registers_of,
    signed,
    table_name,
    time_text,
    without_accents,
)
from gateway.modbus.pdu import Table
from gateway.plain_text import cut

HOLDING, INPUT, DISCRETE, COILS = Table.HOLDING_REGISTERS, Table.INPUT_REGISTERS, Table.DISCRETE_INPUTS, Table.COILS


@pytest.mark.parametrize(
    ("table", "address", "name"),
    [
        (HOLDING, 107, "holding 108 (40108, address 107 = 0x006B)"),
        (HOLDING, 9998, "holding 9999 (49999, address 9998 = 0x270E)"),
        (HOLDING, 9999, "holding 10000 (410000, address 9999 = 0x270F)"),
        (HOLDING, 65535, "holding 65536 (465536, address 65535 = 0xFFFF)"),
        (INPUT, 0, "input 1 (30001, address 0 = 0x0000)"),
        (DISCRETE, 16, "discrete input 17 (10017, address 16 = 0x0010)"),
        (COILS, 0, "coil 1 (00001, address 0 = 0x0000)"),
    ],
)
def test_a_point_is_named_in_both_ways_of_counting(table: Table, address: int, name: str) -> None:
    assert point_name(table, address, str) == name


def test_tables_have_the_names_of_the_field() -> None:
    names = [table_name(table, str) for table in Table]
    assert names == ["coils", "discrete inputs", "holding registers", "input registers"]
    assert table_name(HOLDING, str.upper) == "HOLDING REGISTERS"


@pytest.mark.parametrize(
    ("table", "number", "meant"),
    [(HOLDING, 40001, 0), (HOLDING, 49999, 9998), (INPUT, 30001, 0), (INPUT, 39999, 9998), (DISCRETE, 10001, 0)],
)
def test_a_handbooks_number_is_told_with_what_to_type(table: Table, number: int, meant: int) -> None:
    problem = reference_problem(table, number, str)
    assert problem is not None
    assert str(number) in problem
    assert f" {meant};" in problem
    assert f"0x{number:04X}" in problem
    assert len(problem) < 80


@pytest.mark.parametrize(
    ("table", "number"),
    [
        (HOLDING, 40000),
        (HOLDING, 50000),
        (HOLDING, 30001),
        (INPUT, 40001),
        (DISCRETE, 10000),
        (COILS, 108),
        (COILS, 10001),
    ],
)
def test_other_numbers_are_addresses(table: Table, number: int) -> None:
    assert reference_problem(table, number, str) is None


@given(st.sampled_from(Table), st.integers(0, 65535))
def test_a_reference_number_leads_back_to_its_address(table: Table, address: int) -> None:
    number = reference(table, address)
    assert int(number[1:]) - 1 == address
    assert number[0] == {COILS: "0", DISCRETE: "1", INPUT: "3", HOLDING: "4"}[table]


@pytest.mark.parametrize(
    ("age_s", "text"),
    [
        (None, "-"),
        (0.0, "0.0s"),
        (0.24, "0.2s"),
        (9.94, "9.9s"),
        (9.96, "9s"),
        (47.9, "47s"),
        (119.9, "119s"),
        (120.0, "2m"),
        (7199.0, "119m"),
        (7200.0, "2h"),
        (172800.0, "2d"),
        (86400.0 * 9999, "9999d"),
    ],
)
def test_an_age_in_five_characters(age_s: float | None, text: str) -> None:
    assert age_text(age_s) == text
    assert len(text) <= 5


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.9, "00:00:00"), (59, "00:00:59"), (86399, "23:59:59"), (3 * 86400 + 14706, "3 d 04:05:06")]
)
def test_a_duration(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text


def test_a_time_of_day_is_the_stations_own() -> None:
    assert time_text(1_700_000_000.0) == "22:13:20"  # UTC, see conftest


@pytest.mark.parametrize(
    ("text", "columns", "shown"),
    [("abcdef", 6, "abcdef"), ("abcdef", 5, "abc.."), ("abc", 2, ".."), ("abc", 1, "."), ("abc", 0, "")],
)
def test_what_is_cut_off_is_marked(text: str, columns: int, shown: str) -> None:
    assert cut(text, columns) == shown


def test_a_register_with_a_sign() -> None:
    assert [signed(value) for value in (0, 0x7FFF, 0x8000, 0xFFFF)] == [0, 32767, -32768, -1]


@given(st.binary(min_size=4, max_size=4), st.sampled_from(sorted(ORDERS)))
def test_an_order_and_back_is_the_same_value(data: bytes, order: str) -> None:
    assert ordered(*registers_of(data, order), order) == data


def test_the_orders_are_those_that_devices_have() -> None:
    registers = {order: registers_of(b"ABCD", order) for order in ORDERS}
    sent = {order: struct.pack(">HH", *pair) for order, pair in registers.items()}
    assert sent == {order: order.encode() for order in ("ABCD", "CDAB", "BADC", "DCBA")}


def test_accents_are_left_out() -> None:
    assert without_accents("Configuraci\u00f3n, a\u00f1o, \u00e7\u00e3o") == "Configuracion, ano, cao"
    assert N_("text") == "text"
