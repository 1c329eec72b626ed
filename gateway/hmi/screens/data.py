"""Keys D and Z: the register's values for a person, and values by a person (spec section 5)."""

from __future__ import annotations

import math
import struct
from typing import Final

from gateway.hmi.menu import Dialogue, Ui, whole_number
from gateway.hmi.station import Station
from gateway.hmi.wording import (
    ORDERS,
    Translate,
    age_text,
    ordered,
    plain_reference_problem,
    point_name,
    reference,
    reference_problem,
    registers_of,
    signed,
    table_name,
)
from gateway.modbus.pdu import Span, Table, pack_bits, pack_words
from gateway.plain_text import cut
from gateway.register import DataRegister, Quality, Sample, Source, SourceKind

WIDE_LIMIT: Final = 20  # characters of a 32-bit value
FORMATS: Final = ("16", "u32", "i32", "f32")
MENU: Final = Source(SourceKind.MENU, "menu")


def ask_table(ui: Ui) -> Dialogue[Table]:
    """Have a table chosen by the code of its read function."""
    _ = ui.translate
    for table in Table:
        ui.say(f"  {int(table)}  {table_name(table, _)}")
    answer = yield from ui.key(_("Table"), "1234")
    return Table(int(answer))


def ask_point(ui: Ui, prompt: str, table: Table, last: int, default: int | None = None) -> Dialogue[int]:
    """Ask for an address, 0 to *last*, of *table*; a handbook's 40108 is none, and what to type is told."""
    _ = ui.translate

    def judge(text: str) -> int:
        number = whole_number(text)
        is_hexadecimal = text.lower().startswith("0x")
        problem = plain_reference_problem(table, text, _)
        if number is not None and not is_hexadecimal:
            problem = problem or reference_problem(table, number, _)
        if number is None or problem or not 0 <= number <= last:
            told = _("Please type a whole number from {low} to {high}.").format(low=0, high=last)
            raise ValueError(problem or told)
        return number

    shown = "" if default is None else address_text(table, default)
    return (yield from ui.value(f"{prompt} (0-{last})", judge, shown))


def address_text(table: Table, address: int) -> str:
    """Return *address* as it can be typed: in hex where the decimal number would be taken for a handbook's."""
    return f"0x{address:04X}" if reference_problem(table, address, str) else str(address)


# ------------------------------------------------------------------------------------------------ D


def show_data(ui: Ui, station: Station) -> Dialogue[None]:
    """Show values, live, until a key."""
    _ = ui.translate
    ui.help = _("Shows points of the register. Points count from 0, as a PDU address does: holding 40108 is point 107.")
    table = yield from ask_table(ui)
    size = station.register.size(table)
    first = yield from ask_point(ui, _("First point"), table, size - 1)
    count = yield from ui.number(_("How many"), 1, size - first, 1)
    place = 0

    def body() -> tuple[list[str], list[str]]:
        if place:
            samples = _samples(station.register, table, first, count + count % 2)
            return _wide_page(table, first, samples, FORMATS[place], _)
        return _page(table, first, _samples(station.register, table, first, count), ui)

    while True:
        is_wide = not table.is_bits and first + 1 < size
        hint = _("F: 32-bit values. Any other key: back.") if is_wide else _("Any key: back.")
        answer = yield from ui.pages(body, hint)
        if answer != "f" or not is_wide:
            return
        place = (place + 1) % len(FORMATS)


def _samples(register: DataRegister, table: Table, first: int, count: int) -> list[Sample]:
    """Return what is there: the table may have become smaller since it was asked for."""
    count = min(count, register.size(table) - first)
    return register.samples(Span(table, first, count)) if count > 0 else []


def _page(table: Table, first: int, samples: list[Sample], ui: Ui) -> tuple[list[str], list[str]]:
    _ = ui.translate
    where = f"{'':>6} {_('point'):>5} "
    values = f"{_('value'):>5}" if table.is_bits else f"{_('value'):>5} {_('signed'):>6} {_('hex'):<4} {_('bits'):<16}"
    head = [_title(table, first, len(samples), _), where + values + f" {_('quality'):<7} {_('age'):>5} {_('source')}"]
    return head, [_row(table, first + n, sample, ui) for n, sample in enumerate(samples)]


def _title(table: Table, first: int, count: int, _: Translate) -> str:
    name = point_name(table, first, _)
    title = name[0].upper() + name[1:]
    return title if count == 1 else _("{first} and {count} more").format(first=title, count=count - 1)


def _row(table: Table, point: int, sample: Sample, ui: Ui) -> str:
    where = f"{reference(table, point):>6} {point:>5} "
    value = sample.value
    shown = f"{value:>5}" if table.is_bits else f"{value:>5} {signed(value):>6} {value:04X} {value:016b}"
    state = f" {quality_name(sample.quality, ui.translate):<7} {age_text(sample.age_s):>5} {sample.source or ''}"
    return cut((where + shown + state).rstrip(), ui.columns - 1)


def quality_name(quality: Quality, _: Translate) -> str:
    """Return how far a value can be trusted, in a word of at most 7 letters."""
    names = {
        Quality.NEVER: _("never"),
        Quality.GOOD: _("good"),
        Quality.BAD: _("bad"),
        Quality.STALE: _("stale"),
        Quality.MANUAL: _("manual"),
    }
    return names[quality]


def _wide_page(table: Table, first: int, samples: list[Sample], kind: str, _: Translate) -> tuple[list[str], list[str]]:
    """Two registers as one value, in all four orders; the last of a table has no second one."""
    names = {"u32": _("32 bits, unsigned"), "i32": _("32 bits, signed"), "f32": _("32 bits, floating point")}
    title = f"{names[kind]}: {point_name(table, first, _)}"
    head = [title, f"{'':>6} {_('point'):>5}  " + "".join(f"{order:>14}" for order in ORDERS)]
    rows = []
    for place in range(0, len(samples), 2):
        pair = samples[place : place + 2]
        is_whole = len(pair) == 2
        values = [_wide(ordered(pair[0].value, pair[1].value, order), kind) if is_whole else "-" for order in ORDERS]
        worst = max(pair, key=lambda sample: _TRUST.index(sample.quality))
        point = first + place
        where = f"{reference(table, point):>6} {point:>5}  "
        rows.append(where + "".join(f"{value:>14}" for value in values) + f"  {quality_name(worst.quality, _)}")
    return head, rows


_TRUST: Final = (Quality.GOOD, Quality.MANUAL, Quality.STALE, Quality.BAD, Quality.NEVER)


def _wide(data: bytes, kind: str) -> str:
    if kind == "f32":
        return f"{struct.unpack('>f', data)[0]:.7g}"
    return str(int.from_bytes(data, "big", signed=kind == "i32"))


# ------------------------------------------------------------------------------------------------ Z


def change_data(ui: Ui, station: Station) -> Dialogue[None]:
    """Write a value into the register; where a write request follows the point, it goes to the device as well."""
    _ = ui.translate
    ui.help = _("Writes a value into the register. A point that a request polls is overwritten by its next poll.")
    table = yield from ask_table(ui)
    size = station.register.size(table)
    point = yield from ask_point(ui, _("Point"), table, size - 1)
    ui.say(point_name(table, point, _))
    if table.is_bits:
        is_on = yield from ask_bit(ui)
        data, count = pack_bits([is_on]), 1
    else:
        data, count = yield from _ask_register(ui, can_be_wide=point + 1 < size)
    span = Span(table, point, count)
    station.register.write(span, data, MENU, Quality.MANUAL)
    samples = station.register.samples(span)
    ui.say(_("Written: {values}").format(values=" ".join(str(sample.value) for sample in samples)))
    _tell_requests(ui, station, span)


def ask_bit(ui: Ui) -> Dialogue[bool]:
    """Ask for a bit: 0, or anything else for 1."""
    _ = ui.translate

    def judge(text: str) -> bool:
        if not text:
            raise ValueError(_("Please type 0, or anything else for 1."))
        return whole_number(text) != 0

    return (yield from ui.value(_("Value (0, or anything else = 1)"), judge))


def _ask_register(ui: Ui, can_be_wide: bool) -> Dialogue[tuple[bytes, int]]:
    """Ask for one register, or for a 32-bit value that takes two; return them as on the wire, and how many."""
    _ = ui.translate

    def judge(text: str) -> int | str:
        is_wide = can_be_wide and text.lower() in ("l", "f")
        return text.lower() if is_wide else register_value(text, _)

    prompt = _("Value (L: 32-bit integer, F: 32-bit float)") if can_be_wide else _("Value")
    value = yield from ui.value(prompt, judge)
    if isinstance(value, int):
        return pack_words([value]), 1
    for place, order in enumerate(ORDERS, start=1):
        ui.say(f"  {place}  {order}")
    order = list(ORDERS)[int((yield from ui.key(_("Order of the bytes"), "1234"))) - 1]
    data = yield from ui.value(_("Value"), lambda text: _wide_data(text, value == "f", _), limit=WIDE_LIMIT)
    return pack_words(list(registers_of(data, order))), 2


def register_value(text: str, _: Translate) -> int:
    """Return a register's value, 0 to 65535, as a person typed it; raises ValueError that says what is allowed."""
    number = whole_number(text)
    if number is None or not -0x8000 <= number <= 0xFFFF:
        raise ValueError(_("Please type 0 to 65535, -32768 to -1, or 0x0 to 0xFFFF."))
    return number & 0xFFFF


def _wide_data(text: str, is_float: bool, _: Translate) -> bytes:
    if is_float:
        return _float_data(text, _)
    number = whole_number(text)
    if number is None or not -0x80000000 <= number <= 0xFFFFFFFF:
        raise ValueError(_("Please type a whole number from -2147483648 to 4294967295."))
    return (number & 0xFFFFFFFF).to_bytes(4, "big")


def _float_data(text: str, _: Translate) -> bytes:
    try:
        value = float(text.replace(",", "."))
        data = struct.pack(">f", value)
    except (ValueError, OverflowError):
        value, data = math.nan, b""
    if not math.isfinite(value):
        raise ValueError(_("Please type a number such as -12.5 or 1e6, within 3.4e38."))
    return data


def _tell_requests(ui: Ui, station: Station, span: Span) -> None:
    """Say what becomes of the value: which requests send it, which will overwrite it."""
    _ = ui.translate
    for master in station.config.master:
        for request in master.request:
            name = f"{master.name}/{request.title}"
            if not (request.enabled and Span(request.target, request.point, request.count).overlaps(span)):
                continue
            if not request.is_read:
                ui.say(_("{request} sends it to unit {unit}.").format(request=name, unit=request.unit))
            elif master.enabled:
                ui.say(_("{request} reads this point: its next poll overwrites the value.").format(request=name))
