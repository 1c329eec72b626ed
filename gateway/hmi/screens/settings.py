"""Keys V, B, A, S and K: speed, on/off, unit identifier of one line; G: safe mode ends (spec sections 5 and 7)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from gateway.config import Config, LineConfig, SlaveConfig
from gateway.errors import ConfigError
from gateway.hmi.menu import Dialogue, Ui
from gateway.hmi.screens.changes import carried_out, changed, put_to_work, tell_faults, with_line, with_slave
from gateway.hmi.station import Station

SPEEDS: Final = {  # 1 to 3 as on the original board
    "1": 9600,
    "2": 19200,
    "3": 38400,
    "4": 57600,
    "5": 115200,
    "6": 230400,
    "7": 1200,
    "8": 2400,
    "9": 4800,
}
PARITIES: Final = {"1": "none", "2": "even", "3": "odd"}
LINE_LIMIT: Final = 255  # characters of a port or an address


def master_speed(ui: Ui, station: Station) -> Dialogue[None]:
    """Speed, parity and stop bits of a master's port."""
    yield from _speed(ui, station, station.config.master, ui.translate("Master"))


def slave_speed(ui: Ui, station: Station) -> Dialogue[None]:
    """Speed, parity and stop bits of a slave's port."""
    yield from _speed(ui, station, station.config.slave, ui.translate("Slave"))


def _speed(ui: Ui, station: Station, lines: Sequence[LineConfig], what: str) -> Dialogue[None]:
    _ = ui.translate
    ui.help = _("Speed and format of a serial port; they act at once. The other side needs the same.")
    config = station.config
    line = yield from ask_line_of(ui, lines, what)
    if line is None:
        return
    if line.is_tcp:
        ui.say(_("{name} is on TCP: it has no speed.").format(name=line.name))
        return
    new = changed(line, (yield from ask_format(ui, line)))
    if new == line:
        ui.say(_("Nothing is changed."))
        return
    told = f"{line.name}: {format_text(new)}"
    if new.parity == "none" and new.stop_bits == 1 and new.framing_used == "rtu":
        told += _("; without parity the standard asks for 2 stop bits")
    yield from put_to_work(ui, station, config, with_line(config, line, new), told)


def ask_format(ui: Ui, line: LineConfig) -> Dialogue[dict[str, Any]]:
    """Ask for speed, parity and stop bits; Enter keeps."""
    _ = ui.translate
    ui.say("  " + "  ".join(f"{key} {speed}" for key, speed in SPEEDS.items()))
    speed = yield from ui.key(_("Speed"), "".join(SPEEDS), _key_of(SPEEDS, line.baudrate))
    ui.say("  " + "  ".join(f"{key} {parity_name(parity, ui)}" for key, parity in PARITIES.items()))
    parity = yield from ui.key(_("Parity"), "".join(PARITIES), _key_of(PARITIES, line.parity))
    stop_bits = yield from ui.key(_("Stop bits (1 or 2)"), "12", str(line.stop_bits))
    asked = {"baudrate": SPEEDS[speed], "parity": PARITIES[parity], "stop_bits": int(stop_bits)}
    return {key: value for key, value in asked.items() if value != getattr(line, key)}


def parity_name(parity: str, ui: Ui) -> str:
    """Return a parity in the person's language."""
    _ = ui.translate
    return {"none": _("none"), "even": _("even"), "odd": _("odd")}[parity]


def format_text(line: LineConfig) -> str:
    """Return "19200 8E1"."""
    return f"{line.baudrate} {line.data_bits_used}{line.parity[0].upper()}{line.stop_bits}"


def _key_of(choices: dict[str, Any], value: object) -> str:
    return next(key for key, choice in choices.items() if choice == value)


def ask_line_of(ui: Ui, lines: Sequence[LineConfig], what: str) -> Dialogue[LineConfig | None]:
    """Have one of *lines* chosen; None, and why, where there is none."""
    _ = ui.translate
    if not lines:
        ui.say(_("There is none: N makes one."))
        return None
    place = yield from ui.choice(what, [line_title(line) for line in lines])
    return lines[place]


def line_title(line: LineConfig) -> str:
    """Return "field (/dev/ttyS2)"."""
    return f"{line.name} ({line.line})" if line.line else line.name


# ------------------------------------------------------------------------------------------------ A and S


def master_on_off(ui: Ui, station: Station) -> Dialogue[None]:
    """Switch a master on, or into maintenance."""
    yield from _on_off(ui, station, station.config.master, ui.translate("Master"))


def slave_on_off(ui: Ui, station: Station) -> Dialogue[None]:
    """Switch a slave on, or into maintenance."""
    yield from _on_off(ui, station, station.config.slave, ui.translate("Slave"))


def _on_off(ui: Ui, station: Station, lines: Sequence[LineConfig], what: str) -> Dialogue[None]:
    _ = ui.translate
    ui.help = _("Switches a line on or off. Off is maintenance: a master sends nothing, a slave answers nothing.")
    config = station.config
    line = yield from ask_line_of(ui, lines, what)
    if line is None:
        return
    if line.line or line.enabled:
        new = changed(line, {"enabled": not line.enabled})
    else:
        new = yield from _ask_missing(ui, config, line)
    told = _switched(ui, station, new).format(name=line.name)
    yield from put_to_work(ui, station, config, with_line(config, line, new), told)


def _switched(ui: Ui, station: Station, line: LineConfig) -> str:
    _ = ui.translate
    if not line.enabled:
        return _("{name} is off: maintenance.")
    if station.is_safe:
        return _("{name} is on, but stays in maintenance until safe mode ends (G).")
    return _("{name} is on.")


def _ask_missing(ui: Ui, config: Config, line: LineConfig) -> Dialogue[LineConfig]:
    """Ask for what a line that has never been used needs: its port, and a serial port's format; return it, on."""
    new = line
    while True:
        new = changed(new, {"line": (yield from ask_port(ui, new)), "enabled": True})
        if not new.is_tcp:
            new = changed(new, (yield from ask_format(ui, new)))
        if not tell_faults(ui, with_line(config, line, new)):
            return new


def ask_port(ui: Ui, line: LineConfig) -> Dialogue[str]:
    """Ask for a serial device or a TCP address."""
    _ = ui.translate
    if isinstance(line, SlaveConfig):
        ui.say(_("A serial port such as /dev/ttyS2, or tcp://0.0.0.0:502 to listen on TCP."))
    else:
        ui.say(_("A serial port such as /dev/ttyS2, or tcp://192.168.1.20:502 for a device on TCP."))

    def judge(text: str) -> str:
        try:
            changed(line, {"line": text, "enabled": False})
        except ConfigError as error:
            raise ValueError(str(error)) from error
        if not text:
            raise ValueError(_("Please type a port or an address."))
        return text

    return (yield from ui.value(_("Port or address"), judge, line.line, limit=LINE_LIMIT))


# ------------------------------------------------------------------------------------------------ G


def end_safe_mode(ui: Ui, station: Station) -> Dialogue[None]:
    """Have all lines run as configured again, after bad restarts."""
    _ = ui.translate
    ui.help = _("Three bad restarts in a row, each within 10 minutes, start safe mode; I shows the cause of the last.")
    if not station.is_safe:
        ui.say(_("The gateway is not in safe mode."))
        return
    ui.say(_("All lines will run as configured; three more bad restarts undo this."))
    if not (yield from ui.confirmed(_("End safe mode?"))):
        return
    yield from carried_out(ui, station.end_safe_mode(ui.wake), _("Safe mode is over: all lines run as configured."))


# ------------------------------------------------------------------------------------------------ K


def slave_unit(ui: Ui, station: Station) -> Dialogue[None]:
    """Change the unit identifier that a slave answers to."""
    _ = ui.translate
    ui.help = _("The number that SCADA calls this slave by, 1 to 247; it acts at once.")
    config = station.config
    line = yield from ask_line_of(ui, config.slave, _("Slave"))
    if not isinstance(line, SlaveConfig):
        return
    unit = yield from ui.number(_("Unit identifier"), 1, 247, line.unit)
    if unit == line.unit:
        ui.say(_("Nothing is changed."))
        return
    told = _("{name} answers to unit {unit}.").format(name=line.name, unit=unit)
    yield from put_to_work(ui, station, config, with_slave(config, line, changed(line, {"unit": unit})), told)
