"""The main menu: its text, its keys, and which dialogue each of them starts (spec section 5)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from gateway.errors import GatewayError
from gateway.hmi.menu import AskKey, Back, Dialogue, ToMainMenu, Ui
from gateway.hmi.screens.command import send_command
from gateway.hmi.screens.data import change_data, show_data
from gateway.hmi.screens.file import factory_settings, restart, save, set_password, undo
from gateway.hmi.screens.lines import lines
from gateway.hmi.screens.requests import requests
from gateway.hmi.screens.settings import (
    end_safe_mode,
    master_on_off,
    master_speed,
    slave_on_off,
    slave_speed,
    slave_unit,
)
from gateway.hmi.screens.status import safe_mode_rows, show_log, show_status, show_traffic
from gateway.hmi.screens.writes import WriteDisplay
from gateway.hmi.station import Station
from gateway.hmi.wording import duration_text

WRITES_EVERY_S: Final = 0.5
NOTICES_EVERY_S: Final = 2.0
LEAVE: Final = "q"
DIALOGUES: Final[dict[str, Callable[[Ui, Station], Dialogue[None]]]] = {
    "d": show_data,
    "z": change_data,
    "c": send_command,
    "r": requests,
    "v": master_speed,
    "b": slave_speed,
    "a": master_on_off,
    "s": slave_on_off,
    "k": slave_unit,
    "n": lines,
    "w": save,
    "u": undo,
    "i": show_status,
    "t": show_traffic,
    "l": show_log,
    "p": set_password,
    "f": factory_settings,
    "x": restart,
    "g": end_safe_mode,  # shown only in safe mode
}
KEYS: Final = "".join(DIALOGUES) + "me" + LEAVE


def main_menu(ui: Ui, station: Station, displays: Callable[[], WriteDisplay]) -> Dialogue[None]:
    """Show the main menu, and do what its keys say, until the person leaves."""
    display, noticed = displays(), station.notices(0)[0]
    try:
        _show_menu(ui, station)
        while True:
            try:
                key, noticed = yield from _next_key(ui, station, display, noticed)
                if key == LEAVE and (yield from _may_leave(ui, station)):
                    return
                yield from _do(key, ui, station, display)
            except Back:
                continue
            except ToMainMenu:
                _show_menu(ui, station)
            except GatewayError as error:
                ui.say(*str(error).splitlines())
    finally:
        display.switch_off()


def _do(key: str, ui: Ui, station: Station, display: WriteDisplay) -> Dialogue[None]:
    if key == "m":
        _show_menu(ui, station)
    elif key == "e":
        ui.say(display.switch(ui.translate))
    elif key in DIALOGUES:
        yield from DIALOGUES[key](ui, station)


def _next_key(ui: Ui, station: Station, display: WriteDisplay, noticed: int) -> Dialogue[tuple[str, int]]:
    """Wait at the prompt for a key; meanwhile show what is to be told, and writes, where that is switched on."""
    _ = ui.translate
    ui.help = _("Each key starts something at once, without Enter. M shows all keys.")
    wrong = _("{key} is no key of the main menu: M shows them all.")
    ui.show(_prompt(station))
    while True:
        every_s = WRITES_EVERY_S if display.is_on else NOTICES_EVERY_S
        key = yield AskKey(_prompt(station), KEYS, every_s=every_s, is_quiet=True, wrong=wrong)
        if key is not None:
            return key, noticed
        noticed, notices = station.notices(noticed)
        shown = [notice.words(_) for notice in notices] + display.lines(ui)
        if shown:
            ui.show("\n")
            ui.say(*shown)
            ui.show(_prompt(station))


def _prompt(station: Station) -> str:
    return "rtugate*> " if station.is_unsaved else "rtugate> "


def _may_leave(ui: Ui, station: Station) -> Dialogue[bool]:
    _ = ui.translate
    if not station.is_unsaved:
        return True
    ui.say(_("There are unsaved changes: they go on working, but are lost when the gateway is started anew."))
    return (yield from ui.confirmed(_("Leave without saving?")))


def _show_menu(ui: Ui, station: Station) -> None:
    _ = ui.translate
    rows = [
        ("M", _("this menu"), "N", _("lines: new, modify, delete")),
        ("D", _("show data"), "W", _("save the configuration")),
        ("Z", _("change data"), "U", _("undo unsaved changes")),
        ("C", _("send a command to a device"), "I", _("status")),
        ("R", _("polling requests"), "T", _("traffic of a line")),
        ("V", _("master speed"), "L", _("log")),
        ("B", _("slave speed"), "P", _("password")),
        ("A", _("master on/off"), "F", _("factory settings")),
        ("S", _("slave on/off"), "X", _("restart")),
        ("K", _("slave unit identifier"), "?", _("help, on any screen")),
        ("E", _("show writes as they happen"), "Q", _("leave")),
    ]
    ui.say("", _("rtugate: master (client) to the field, slave (server) to SCADA"), "")
    ui.say(*(f"  {left}  {text:<34} {right}  {other}" for left, text, right, other in rows))
    ui.say("")
    alarms = station.alarms()
    if alarms:
        ui.say(_("ALARM: {alarm}").format(alarm=alarms[0].words(_)))
        if len(alarms) > 1:
            ui.say(_("... and {count} more: I shows them.").format(count=len(alarms) - 1))
    ui.say(*safe_mode_rows(ui, station))
    if station.confirm_left_s is not None:
        left = duration_text(station.confirm_left_s)
        ui.say(_("The last save is undone in {time} unless W confirms it.").format(time=left))
    if station.is_unsaved:
        ui.say(_("* There are unsaved changes: W saves them, U undoes them."))
