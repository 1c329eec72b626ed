"""Key N: the lines, masters and slaves: new, modify, delete (spec section 5)."""

from __future__ import annotations

from ipaddress import ip_network
from typing import Any, Final

from gateway.config import Config, LineConfig, MasterConfig, SlaveConfig
from gateway.config_fields import is_name
from gateway.hmi.menu import Back, Dialogue, Ui
from gateway.hmi.screens.changes import changed, put_to_work, section, tell_faults, with_line, with_master, with_slave
from gateway.hmi.screens.settings import ask_format, ask_port, format_text, line_title
from gateway.hmi.station import Station
from gateway.hmi.wording import Translate

NAME_LIMIT: Final = 32
NETWORKS_LIMIT: Final = 255
FRAMINGS: Final = {"1": "rtu", "2": "ascii", "3": "tcp"}
STALES: Final = {"1": "serve", "2": "exception"}
SERIAL_KEYS: Final = (
    "baudrate",
    "parity",
    "data_bits",
    "stop_bits",
    "rs485",
    "rts_before",
    "rts_after",
    "discard_echo",
)


def lines(ui: Ui, station: Station) -> Dialogue[None]:
    """Show all lines, and change them."""
    _ = ui.translate
    while True:
        ui.help = _("A master polls devices on its line; a slave is polled by SCADA. Changes act at once.")
        config = station.config
        yield from _show(ui, station)
        ui.say("", _("N new  M modify  B delete  0 back"))
        key = yield from ui.key(_("Lines"), "nmb0")
        if key == "0":
            return
        try:
            if key == "n":
                yield from _new(ui, station, config)
            else:
                yield from _modify_or_delete(key, ui, station, config)
        except Back:
            ui.say(_("Nothing is changed."))


def _all(config: Config) -> list[LineConfig]:
    return [*config.master, *config.slave]


def _show(ui: Ui, station: Station) -> Dialogue[None]:
    _ = ui.translate
    rows = [""]
    for master in station.config.master:
        what = _("requests: {count}").format(count=len(master.request))
        rows += _line_rows(ui, station, master, _("master"), what)
    for slave in station.config.slave:
        what = _("unit {unit}").format(unit=slave.unit)
        rows += _line_rows(ui, station, slave, _("slave"), what)
    if len(rows) == 1:
        rows.append(_("There are no lines: N makes one."))
    yield from ui.listed(rows)


def _line_rows(ui: Ui, station: Station, line: LineConfig, kind: str, what: str) -> list[str]:
    """Return a line in one row, or in two where its port has a long name."""
    _ = ui.translate
    view = station.master(line.name) or station.slave(line.name)
    state = _("on") if line.enabled else _("off")
    if view is not None and line.enabled and view.trouble:
        state = _("trouble")
    form = line.framing_used if line.is_tcp else f"{line.framing_used} {format_text(line)}"
    where = line.line or _("no port yet")
    row = f"  {kind:<7} {line.name:<16} {state:<8} {form}, {what}"
    whole = f"{row}, {where}"
    return [whole] if len(whole) < ui.columns else [row, f"          {where}"]


def _modify_or_delete(key: str, ui: Ui, station: Station, config: Config) -> Dialogue[None]:
    _ = ui.translate
    if not _all(config):
        ui.say(_("There are no lines: N makes one."))
        return
    place = yield from ui.choice(_("Line"), [line_title(line) for line in _all(config)])
    line = _all(config)[place]
    if key == "m":
        yield from _modify(ui, station, config, line)
        return
    if isinstance(line, MasterConfig) and line.request:
        ui.say(_("Its requests go with it: {count}.").format(count=len(line.request)))
    if (yield from ui.confirmed(_("Delete {name}?").format(name=line.name))):
        told = _("{name} is deleted.").format(name=line.name)
        yield from put_to_work(ui, station, config, with_line(config, line, None), told)


def _new(ui: Ui, station: Station, config: Config) -> Dialogue[None]:
    """Make a line; one that is given a port is switched on."""
    _ = ui.translate
    ui.say(f"  1  {_('master (client): polls field devices')}", f"  2  {_('slave (server): is polled by SCADA')}")
    kind = yield from ui.key(_("Kind"), "12")
    name = yield from _ask_name(ui, config)
    new: LineConfig
    if kind == "1":
        new = section(MasterConfig, {"name": name, "line": "", "enabled": False})
    else:
        new = section(SlaveConfig, {"name": name, "line": "", "enabled": False, "unit": 1})
    wanted, is_fitting = config, False
    while not is_fitting:
        new = changed((yield from _ask_line(ui, new)), {}, without=["enabled"])
        wanted = _with_new(config, new)
        is_fitting = not tell_faults(ui, wanted)
    told = _("{name} is at work.").format(name=name)
    if isinstance(new, MasterConfig):
        told += " " + _("R gives it requests.")
    yield from put_to_work(ui, station, config, wanted, told)


def _with_new(config: Config, line: LineConfig) -> Config:
    if isinstance(line, MasterConfig):
        return with_master(config, None, line)
    return with_slave(config, None, line) if isinstance(line, SlaveConfig) else config


def _modify(ui: Ui, station: Station, config: Config, line: LineConfig) -> Dialogue[None]:
    new, is_fitting = line, False
    while not is_fitting:
        new = yield from _ask_line(ui, new)
        is_fitting = not tell_faults(ui, with_line(config, line, new))
    if new == line:
        ui.say(ui.translate("Nothing is changed."))
        return
    _ = ui.translate
    told = _("{name} works with its new settings.") if new.enabled else _("{name} has its new settings; it is off.")
    told = told.format(name=line.name)
    yield from put_to_work(ui, station, config, with_line(config, line, new), told)


def _ask_name(ui: Ui, config: Config) -> Dialogue[str]:
    _ = ui.translate
    taken = {line.name for line in _all(config)} | {entry.name for entry in config.io}

    def judge(text: str) -> str:
        if not is_name(text):
            raise ValueError(_("A name has 1 to 32 letters, digits, - and _."))
        if text in taken:
            raise ValueError(_("There is a line of that name already."))
        return text

    return (yield from ui.value(_("Name"), judge, limit=NAME_LIMIT))


# ------------------------------------------------------------------------------------------------ all of a line


def _ask_line(ui: Ui, line: LineConfig) -> Dialogue[LineConfig]:
    """Ask for port, framing, format and what belongs to a master or a slave; Enter keeps each."""
    where = yield from ask_port(ui, line)
    line = _at(line, where)
    line = yield from _ask_framing(ui, line)
    if not line.is_tcp:
        line = changed(line, (yield from ask_format(ui, line)))
    if isinstance(line, MasterConfig):
        return changed(line, (yield from _ask_times(ui, line)))
    if isinstance(line, SlaveConfig):
        return changed(line, (yield from _ask_serving(ui, line)))
    return line


def _at(line: LineConfig, where: str) -> LineConfig:
    """Return *line* at another port; what only suits the old kind of port goes."""
    if line.is_tcp == where.startswith("tcp://"):
        return changed(line, {"line": where})
    unfit = ("framing", *(SERIAL_KEYS if where.startswith("tcp://") else ("allow", "max_clients", "idle_timeout")))
    return changed(line, {"line": where}, without=unfit)


def _ask_framing(ui: Ui, line: LineConfig) -> Dialogue[LineConfig]:
    _ = ui.translate
    choices = FRAMINGS if line.is_tcp else {key: framing for key, framing in FRAMINGS.items() if framing != "tcp"}
    ui.say("  " + "  ".join(f"{key} {framing}" for key, framing in choices.items()))
    default = next(key for key, framing in choices.items() if framing == line.framing_used)
    framing = choices[(yield from ui.key(_("Framing"), "".join(choices), default))]
    if framing == line.framing_used:
        return line
    is_usual = framing == ("tcp" if line.is_tcp else "rtu")
    without = ("framing", "data_bits") if is_usual else ("data_bits",)
    return changed(line, {} if is_usual else {"framing": framing}, without=without)


def _ask_times(ui: Ui, line: MasterConfig) -> Dialogue[dict[str, Any]]:
    _ = ui.translate
    response_s = yield from ui.seconds(_("Response timeout in seconds"), 0.001, 86400, line.response_timeout)
    character_s = yield from ui.seconds(
        _("Gap within an answer that ends it, in seconds"), 0.001, 86400, line.character_timeout_used
    )
    delay_s = yield from ui.seconds(_("Extra silence before each request, in seconds"), 0.0, 86400, line.delay)
    retries = yield from ui.number(_("Retries"), 0, 100, line.retries)
    asked = {"response_timeout": response_s, "delay": delay_s, "retries": retries}
    found: dict[str, Any] = {key: value for key, value in asked.items() if value != getattr(line, key)}
    if character_s != line.character_timeout_used:
        found["character_timeout"] = character_s
    return found


def _ask_serving(ui: Ui, line: SlaveConfig) -> Dialogue[dict[str, Any]]:
    _ = ui.translate
    unit = yield from ui.number(_("Unit identifier"), 1, 247, line.unit)
    ui.say(f"  1  {_('SCADA may read and write')}", f"  2  {_('SCADA may only read')}")
    writable = (yield from ui.key(_("Access"), "12", "1" if line.writable else "2")) == "1"
    ui.say(f"  1  {_('old data is served as it is')}", f"  2  {_('old data is answered with an exception')}")
    stale = STALES[(yield from ui.key(_("Old data"), "12", "1" if line.stale == "serve" else "2"))]
    asked: dict[str, Any] = {"unit": unit, "writable": writable, "stale": stale}
    if line.is_tcp:
        asked["allow"] = yield from _ask_networks(ui, line)
    return {key: value for key, value in asked.items() if value != getattr(line, key)}


def _ask_networks(ui: Ui, line: SlaveConfig) -> Dialogue[list[str]]:
    """Ask for the networks whose clients are let in."""
    _ = ui.translate
    ui.say(_("Networks that may connect, such as 192.168.1.0/24, with spaces between; any: everybody."))

    def judge(text: str) -> list[str]:
        networks = [] if text.lower() in ("any", _("any")) else text.replace(",", " ").split()
        for network in networks:
            _check_network(network, _)
        return networks

    return (yield from ui.value(_("Networks"), judge, " ".join(line.allow) or _("any"), limit=NETWORKS_LIMIT))


def _check_network(text: str, _: Translate) -> None:
    """Raise ValueError, which says what to type, unless *text* is a network."""
    try:
        network = ip_network(text, strict=False)
    except ValueError:
        raise ValueError(_("{text} is no network such as 192.168.1.0/24.").format(text=text)) from None
    if str(network) != text and "/" in text:
        raise ValueError(_("{text} is an address in a network: type {network}.").format(text=text, network=network))
