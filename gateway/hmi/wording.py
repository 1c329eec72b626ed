"""How the menu words points, values, ages and times: plain ASCII, field terms, both ways of counting an address.

Pure. Source: specification of rtugate, section 5 and its preface on words.
"""

from __future__ import annotations

import re
import struct
import unicodedata
from collections.abc import Callable
from datetime import datetime
from typing import Final

from gateway.config import REFERENCES_EACH, meant_by_reference
from gateway.modbus.pdu import Table

Translate = Callable[[str], str]

REFERENCE_DIGITS: Final = {
    Table.COILS: "0",
    Table.DISCRETE_INPUTS: "1",
    Table.INPUT_REGISTERS: "3",
    Table.HOLDING_REGISTERS: "4",
}
DROPPED: Final = str.maketrans("", "", "¿¡")  # a question reads well without, and badly with "?" for it
ORDERS: Final = {"ABCD": (0, 1, 2, 3), "CDAB": (2, 3, 0, 1), "BADC": (1, 0, 3, 2), "DCBA": (3, 2, 1, 0)}


def N_(text: str) -> str:  # noqa: N802 - the name that gettext's tools look for
    """Mark *text* for translation where it is not shown yet."""
    return text


def without_accents(text: str) -> str:
    """Return *text* for a terminal that knows ASCII only: "n" for "ñ"; "?" for what has no such letter."""
    letters = unicodedata.normalize("NFKD", text.translate(DROPPED))
    return "".join(c for c in letters if not unicodedata.combining(c)).encode("ascii", "replace").decode("ascii")


def table_name(table: Table, _: Translate) -> str:
    """Return a table's name for the middle of a sentence."""
    names = {
        Table.COILS: _("coils"),
        Table.DISCRETE_INPUTS: _("discrete inputs"),
        Table.HOLDING_REGISTERS: _("holding registers"),
        Table.INPUT_REGISTERS: _("input registers"),
    }
    return names[table]


def reference(table: Table, address: int) -> str:
    """Return the number that handbooks give to PDU *address*: "40108"; "410000" beyond 49999."""
    number = address + 1
    return REFERENCE_DIGITS[table] + (f"{number:04}" if number <= REFERENCES_EACH else f"{number:05}")


def point_name(table: Table, address: int, _: Translate) -> str:
    """Return "holding 108 (40108, address 107 = 0x006B)"."""
    names = {
        Table.COILS: _("coil"),
        Table.DISCRETE_INPUTS: _("discrete input"),
        Table.HOLDING_REGISTERS: _("holding"),
        Table.INPUT_REGISTERS: _("input"),
    }
    of_address = _("address {address} = 0x{address:04X}").format(address=address)
    return f"{names[table]} {address + 1} ({reference(table, address)}, {of_address})"


def age_text(age_s: float | None) -> str:
    """Return an age in five characters or less: "0.2s", "47s", "3m", "5h", "12d"; "-" for None."""
    if age_s is None:
        return "-"
    if age_s < 9.95:
        return f"{age_s:.1f}s"
    for unit_s, name in ((86400, "d"), (3600, "h"), (60, "m")):
        if age_s >= 2 * unit_s:
            return f"{int(age_s / unit_s)}{name}"
    return f"{int(age_s)}s"


def duration_text(seconds: float) -> str:
    """Return a duration for a person: "3 d 04:05:06"; days only when there are some."""
    days, rest = divmod(int(seconds), 86400)
    clock = f"{rest // 3600:02}:{rest // 60 % 60:02}:{rest % 60:02}"
    return f"{days} d {clock}" if days else clock


def time_text(wall_s: float) -> str:
    """Return the local time of day: "12:03:04"."""
    return datetime.fromtimestamp(wall_s).strftime("%H:%M:%S")  # the station's own time


def signed(value: int) -> int:
    """Return a register as a two's complement number."""
    return value - 0x10000 if value & 0x8000 else value


def ordered(first: int, second: int, order: str) -> bytes:
    """Return the four bytes of two registers, most significant first, as *order* says they were sent."""
    data = struct.pack(">HH", first, second)
    return bytes(data[place] for place in ORDERS[order])


def registers_of(data: bytes, order: str) -> tuple[int, int]:
    """Return the two registers that carry *data* (four bytes, most significant first) in *order*."""
    first, second = struct.unpack(">HH", bytes(data[place] for place in ORDERS[order]))  # each order is its own inverse
    return first, second


def plain_reference_problem(table: Table, text: str, _: Translate) -> str | None:
    """Return what to say of *text*, typed where an address is meant, if it can be nothing but a reference: "400108"
    with its six digits, or a coil's "00108"."""
    found = re.fullmatch(f"{REFERENCE_DIGITS[table]}([0-9]{{4,5}})", text)
    number = int(found[1]) if found is not None else 0
    if not 1 <= number <= 0x10000 or (len(text) == 5 and table is not Table.COILS):
        return None
    return _("{number} looks like a reference number: for it type {address}.").format(number=text, address=number - 1)


def reference_problem(table: Table, number: int, _: Translate) -> str | None:
    """Return what to say of *number*, typed where an address is meant, if it looks like a handbook's 40108."""
    meant = meant_by_reference(table, number)
    if meant is None:
        return None
    told = _("{number} looks like a reference number: for it type {address}; for the address, 0x{number:04X}.")
    return told.format(number=number, address=meant)
