"""Keys W, U, P, F and X: save, undo, password, factory settings, restart (spec sections 5 and 6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, TypeVar

from gateway.config import factory
from gateway.errors import SaveError
from gateway.hmi.access import hash_password, password_problem
from gateway.hmi.keys import ENTER
from gateway.hmi.menu import AskKey, Back, Dialogue, Ui
from gateway.hmi.screens.changes import changed, put_to_work
from gateway.hmi.station import Job, Station
from gateway.hmi.wording import duration_text

PASSWORD_LIMIT: Final = 64
LONGEST_WORK_S: Final = 120.0  # a save on a slow card, a hash on a slow board

T = TypeVar("T")


# ------------------------------------------------------------------------------------------------ W and U


def save(ui: Ui, station: Station) -> Dialogue[None]:
    """Write what runs into the file, after showing what changes in it."""
    _ = ui.translate
    ui.help = _("Writes the configuration that runs into the file; comments and order in it stay.")
    if station.confirm_left_s is not None:
        yield from _confirm(ui, station, station.confirm_left_s)
        return
    overwrite = False
    if (yield from _found(ui, station, station.is_file_changed)):
        answer = yield from _ask_about_edited_file(ui)
        if answer == "r":
            yield from _wait(ui, station.reload(ui.wake), _("The file has been loaded anew."))
        if answer != "o":
            return
        overwrite = True
    elif not station.is_unsaved:
        ui.say(_("There is nothing to save."))
        return
    minutes = station.config.hmi.confirm_minutes
    told = _("C saves, too, but what was saved before comes back unless confirmed within {minutes} min.")
    lines = [*(yield from _found(ui, station, station.difference)), told.format(minutes=minutes)]
    answer = yield from _asked_below(ui, lines, _("Save this? (y/n/c)"), f"ync{_('y')}")
    if answer == "c":
        told = _("Saved. W confirms it within {minutes} min; else, or after a restart, the old file comes back.")
        yield from _wait(ui, station.save(overwrite, 60.0 * minutes, ui.wake), told.format(minutes=minutes))
    elif answer != "n":
        yield from _wait(ui, station.save(overwrite, None, ui.wake), _("Saved."))


def _found(ui: Ui, station: Station, look: Callable[[], T]) -> Dialogue[T]:
    """Return what *look* finds in the file: it is read and compared elsewhere, since that may take seconds.

    raises: SaveError, whatever the reason.
    """
    found: list[T] = []
    job = station.in_background(lambda: found.append(look()), ui.wake)
    yield from ui.wait_for(lambda: job.is_done, LONGEST_WORK_S)
    if not found:
        _ = ui.translate
        raise SaveError(_(job.problem) or _("This takes unusually long; see L."))
    return found[0]


def _asked_below(ui: Ui, lines: Sequence[str], question: str, keys: str) -> Dialogue[str]:
    """Show *lines*, and ask below each screenful of them; who has seen enough need not see the rest."""
    _ = ui.translate
    left = [part for line in lines for part in ui.parts(line)]
    while len(left) > ui.room:
        ui.say(*left[: ui.room])
        left = left[ui.room :]
        answer = yield AskKey(f"{question}, {_('Space: more')}: ", f"{keys} ", takes_enter=True)
        if answer not in (" ", ENTER):
            return answer or ""
    ui.say(*left)
    return (yield from ui.key(question, keys))


def _confirm(ui: Ui, station: Station, left_s: float) -> Dialogue[None]:
    """The last save waits: keep it, undo it, or leave it waiting."""
    _ = ui.translate
    ui.say(
        _("The last save waits for its confirmation, {time} more.").format(time=duration_text(left_s)),
        f"  C  {_('confirm: it stays')}",
        f"  U  {_('undo it now: what was saved before comes back')}",
        f"  L  {_('leave it waiting')}",
    )
    answer = yield from ui.key(_("Which"), "cul")
    if answer == "c":
        yield from _wait(ui, station.confirm(ui.wake), _("Confirmed."))
    elif answer == "u":
        yield from _wait(ui, station.revert(ui.wake), _("Undone: what was saved before runs again."))


def _ask_about_edited_file(ui: Ui) -> Dialogue[str]:
    _ = ui.translate
    ui.say(
        _("The file has been edited since it was loaded."),
        f"  R  {_('reload: the file as it is now runs; changes made here are dropped')}",
        f"  O  {_('overwrite: what runs here is saved; those edits are lost')}",
        f"  L  {_('leave both as they are')}",
    )
    return (yield from ui.key(_("Which"), "rol"))


def _wait(ui: Ui, job: Job, told: str) -> Dialogue[bool]:
    """Wait for *job*; say *told*, or what is wrong. Esc ends the waiting, not the work."""
    _ = ui.translate
    try:
        is_done = yield from ui.wait_for(lambda: job.is_done, LONGEST_WORK_S)
    except Back:
        ui.say(_("It goes on by itself; L shows how it ends."))
        return False
    ui.say(*map(_, job.remarks), _(job.problem) or (told if is_done else _("This takes unusually long; see L.")))
    return is_done and not job.problem


def undo(ui: Ui, station: Station) -> Dialogue[None]:
    """Go back to what the file says."""
    _ = ui.translate
    if not station.is_unsaved:
        ui.say(_("There is nothing to undo."))
        return
    yield from _wait(ui, station.undo(ui.wake), _("Undone: what was saved last runs again."))


# ------------------------------------------------------------------------------------------------ P


def set_password(ui: Ui, station: Station) -> Dialogue[None]:
    """Set the password that telnet asks for."""
    _ = ui.translate
    ui.help = _("The password that telnet asks for, 8 to 64 characters. Only a hash of it is kept.")
    while problem := password_problem(first := (yield from _ask_hidden(ui, _("New password")))):
        ui.say(_(problem))
    again = yield from _ask_hidden(ui, _("The same again"))
    if first != again:
        ui.say(_("These two differ: the password stays as it was."))
        return
    made: list[str] = []
    job = station.in_background(lambda: made.append(hash_password(first)), ui.wake)
    yield from ui.wait_for(lambda: job.is_done, LONGEST_WORK_S)
    if not made:
        ui.say(_(job.problem) or _("This takes unusually long; see L."))
        return
    config = station.config
    new = config.model_copy(update={"hmi": changed(config.hmi, {"password": made[0]})})
    yield from put_to_work(ui, station, config, new, _("The new password counts from the next login; W saves it."))


def _ask_hidden(ui: Ui, prompt: str) -> Dialogue[str]:
    return (yield from ui.line(prompt, limit=PASSWORD_LIMIT, is_hidden=True))


# ------------------------------------------------------------------------------------------------ F and X


def factory_settings(ui: Ui, station: Station) -> Dialogue[None]:
    """Have the factory settings run; the way to the menu stays as it is, so that nobody locks himself out."""
    _ = ui.translate
    ui.help = _("U goes back to what was saved last, as long as W has not saved the factory settings.")
    ui.say(
        _("Factory settings: one master and one slave, both off and without a port; all requests are deleted."),
        _("How this menu is reached, its password and its language stay. The file stays until W saves."),
    )
    if not (yield from ui.confirmed(_("Go back to factory settings?"))):
        return
    config = station.config
    new = factory().model_copy(update={"hmi": config.hmi, "watchdog": config.watchdog, "log": config.log})
    told = _("Factory settings are at work: A and S give the lines their ports.")
    yield from put_to_work(ui, station, config, new, told)


def restart(ui: Ui, station: Station) -> Dialogue[None]:
    """End the gateway and begin it anew."""
    _ = ui.translate
    ui.help = _("The gateway ends, and begins anew with what the file says; for some seconds it answers nobody.")
    if station.is_unsaved:
        ui.say(_("Unsaved changes will be lost: W saves them."))
    if (yield from ui.confirmed(_("Restart the gateway?"))):
        ui.say(_("Restarting."))
        station.restart()
