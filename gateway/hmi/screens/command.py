"""Key C: a command to a device through a master: look, ask, write, read back (spec section 5)."""

from __future__ import annotations

from typing import Final

from gateway.hmi.menu import Back, Dialogue, Ui
from gateway.hmi.screens.data import ask_bit, ask_point, register_value
from gateway.hmi.station import MasterView, Station
from gateway.hmi.wording import Translate, point_name
from gateway.modbus.describe import exception_name
from gateway.modbus.pdu import BROADCAST, AnyRequest, ReadRequest, Table, WriteRequest, pack_bits, pack_words
from gateway.transaction import DAMAGED, TIMEOUT, Response

LONGEST_WAIT_S: Final = 120.0  # for a ticket: it expires by itself after 10 s in the queue, and a response timeout
COIL, REGISTER = "1", "3"


def send_command(ui: Ui, station: Station) -> Dialogue[None]:
    """Write one coil or register of a device, whether a request polls it or not."""
    _ = ui.translate
    ui.help = _("Writes one coil or holding register of a device, past the register. Unit 0 writes to all devices.")
    master = yield from _ask_master(ui, station)
    if master is None:
        return
    is_tcp = master.config.framing_used == "tcp"
    unit = yield from ui.number(_("Unit"), 0, 255 if is_tcp else 247)
    ui.say(f"  {COIL}  {_('coil')}", f"  {REGISTER}  {_('holding register')}")
    kind = yield from ui.key(_("Kind"), COIL + REGISTER)
    table = Table.COILS if kind == COIL else Table.HOLDING_REGISTERS
    address = yield from ask_point(ui, _("Address"), table, 0xFFFF)
    ui.say(point_name(table, address, _))
    if kind == COIL:
        value = int((yield from ask_bit(ui)))
    else:
        value = yield from ui.value(_("Value"), lambda text: register_value(text, _))
    is_broadcast = unit == BROADCAST and not is_tcp
    if is_broadcast:
        ui.say(_("Unit 0: all devices carry it out, and none answers."))
    else:
        yield from _read(ui, master, unit, table, address, _("Present value"))
    if not (yield from ui.confirmed(_("Write {value} to it?").format(value=value))):
        return
    is_written = yield from _write(ui, master, unit, table, address, value)
    if is_written and not is_broadcast:
        yield from _read(ui, master, unit, table, address, _("Read back"))


def _ask_master(ui: Ui, station: Station) -> Dialogue[MasterView | None]:
    """Have a master chosen; None, and why, where it could not send anything."""
    _ = ui.translate
    names = [line.name for line in station.config.master]
    if not names:
        ui.say(_("There is no master: N makes one."))
        return None
    name = names[(yield from ui.choice(_("Master"), names))]
    master = station.master(name)
    if master is None:
        ui.say(_("{name} is being started anew: try again in a moment.").format(name=name))
    elif not master.enabled:
        safe, off = (
            _("{name} is in maintenance: safe mode; G ends it."),
            _("{name} is in maintenance: A switches it on."),
        )
        ui.say((safe if station.is_safe else off).format(name=name))
        return None
    elif master.trouble:
        ui.say(_("The line of {name} cannot be used: {reason}").format(name=name, reason=master.trouble))
        return None
    return master


def _write_request(table: Table, address: int, value: int) -> WriteRequest:
    if table is Table.COILS:
        return WriteRequest(5, address, 1, pack_bits([bool(value)]))
    return WriteRequest(6, address, 1, pack_words([value]))


def _read(ui: Ui, master: MasterView, unit: int, table: Table, address: int, what: str) -> Dialogue[None]:
    response = yield from _transact(ui, master, unit, ReadRequest(int(table), address, 1))
    problem = _problem(response, ui.translate)
    if response is None or problem:
        ui.say(f"{what}: {problem}")
    else:
        value = int(response.is_coil_set(0)) if table is Table.COILS else response.register(0)
        ms = response.reply_s * 1000
        ui.say(ui.translate("{what}: {value} (after {ms:.0f} ms)").format(what=what, value=value, ms=ms))


def _write(ui: Ui, master: MasterView, unit: int, table: Table, address: int, value: int) -> Dialogue[bool]:
    """Write, and say what has become of it; False unless it is written. An answer that is not waited for may come."""
    _ = ui.translate
    try:
        response = yield from _transact(ui, master, unit, _write_request(table, address, value))
    except Back:
        ui.say(_("Not waited for: it may be written all the same."))
        raise
    problem = _problem(response, _)
    if response is None:
        ui.say(problem)
    elif response.error_code in (TIMEOUT, DAMAGED):
        ui.say(_("It may be written all the same: {problem}").format(problem=problem))
    elif problem:
        ui.say(_("Not written: {problem}").format(problem=problem))
    elif unit == BROADCAST and master.config.framing_used != "tcp":
        ui.say(_("Sent to all."))
    else:
        ui.say(_("Written, answered after {ms:.0f} ms.").format(ms=response.reply_s * 1000))
    return not problem


def _transact(ui: Ui, master: MasterView, unit: int, request: AnyRequest) -> Dialogue[Response | None]:
    """Send *request* before all polls, and wait for what becomes of it."""
    ticket = master.submit(unit, request, ui.wake)
    yield from ui.wait_for(ticket.done.is_set, LONGEST_WAIT_S)
    return ticket.response


def _problem(response: Response | None, _: Translate) -> str:
    """Return why there is nothing, in words; "" where there is."""
    if response is None:
        return _("not sent: the line was busy or was stopped")
    if response.error_code == TIMEOUT:
        return _("no answer within {seconds:.1f} s").format(seconds=response.reply_s)
    if response.error_code == DAMAGED:
        return _("the answer was damaged: {reason}").format(reason=response.reason)
    if response.has_error():
        name = _(exception_name(response.error_code))
        ms = response.reply_s * 1000
        return _("exception {code} ({name}), after {ms:.0f} ms").format(code=response.error_code, name=name, ms=ms)
    return ""
