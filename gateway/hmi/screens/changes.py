"""Changes of the configuration, as the screens make them: whole sections replaced, and put to work (spec section 5).

Models are never changed in place: a new configuration is made, checked as a file would be, and handed to the station.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from gateway.config import Config, LineConfig, MasterConfig, RequestConfig, Section, SlaveConfig
from gateway.config_checks import cross_check
from gateway.config_fields import explain
from gateway.errors import ConfigError
from gateway.hmi.menu import Back, Dialogue, Ui
from gateway.hmi.station import Job, Station

LONGEST_CHANGE_S: Final = 60.0  # to stop and start tasks; opening a port has its own limit
READS_ONLY: Final = ("on_failure", "stale_after", "events")
WRITES_ONLY: Final = ("trigger", "whole", "expire")

SectionType = TypeVar("SectionType", bound=Section)
LineType = TypeVar("LineType", MasterConfig, SlaveConfig)


def section(model: type[SectionType], data: Mapping[str, Any]) -> SectionType:
    """Return *data* as a section of the configuration; raises ConfigError with all that is wrong."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError([finding.message for finding in explain(error, model)]) from error


def changed(old: SectionType, changes: Mapping[str, Any], without: Sequence[str] = ()) -> SectionType:
    """Return *old* with *changes*; the keys of *without* go back to their defaults. Raises ConfigError."""
    kept = {key: value for key, value in given(old).items() if key not in without}
    return section(type(old), kept | dict(changes))


def given(old: Section) -> dict[str, Any]:
    """Return the keys of *old* that somebody gave, as they were given."""
    return old.model_dump(exclude_unset=True, by_alias=True)


def with_master(config: Config, old: MasterConfig | None, new: MasterConfig | None) -> Config:
    """Return *config* with *new* in the place of *old*; without an *old* it comes last, without a *new* it goes."""
    return config.model_copy(update={"master": replaced(config.master, old, new)})


def with_slave(config: Config, old: SlaveConfig | None, new: SlaveConfig | None) -> Config:
    """Return *config* with another slave, as ``with_master`` does."""
    return config.model_copy(update={"slave": replaced(config.slave, old, new)})


def with_line(config: Config, old: LineConfig, new: LineConfig | None) -> Config:
    """Return *config* with *new* in the place of *old*, a master or a slave."""
    if isinstance(old, MasterConfig):
        return with_master(config, old, new if isinstance(new, MasterConfig) else None)
    if isinstance(old, SlaveConfig):
        return with_slave(config, old, new if isinstance(new, SlaveConfig) else None)
    raise TypeError(f"{old!r} is neither a master nor a slave")


def with_request(config: Config, master: MasterConfig, old: RequestConfig | None, new: RequestConfig | None) -> Config:
    """Return *config* with another request of *master*, as ``with_master`` does."""
    requests = replaced(master.request, old, new)
    return with_master(config, master, master.model_copy(update={"request": requests}))


def replaced(entries: Sequence[SectionType], old: SectionType | None, new: SectionType | None) -> list[SectionType]:
    """Return *entries* with *new* for *old*, which is one of them by identity."""
    if old is None:
        return [*entries, *([new] if new is not None else [])]
    return [new if entry is old else entry for entry in entries if entry is not old or new is not None]  # type: ignore[misc] # an entry is only replaced by None where it is left out


def tell_faults(ui: Ui, config: Config) -> bool:
    """Say why *config* cannot run; True if there is a reason."""
    faults = [finding.message for finding in cross_check(config) if finding.severity == "error"]
    ui.say(*faults)
    return bool(faults)


def _warnings(old: Config, new: Config) -> list[str]:
    """Return what is doubtful in *new* and was not in *old*."""
    before = {finding.message for finding in cross_check(old)}
    found = [finding.message for finding in cross_check(new) if finding.severity == "warning"]
    return [message for message in found if message not in before]


def put_to_work(ui: Ui, station: Station, old: Config, new: Config, told: str = "") -> Dialogue[bool]:
    """Have *new* run instead of *old* and say so; False, with every reason, where it cannot."""
    _ = ui.translate
    try:
        job = station.change(old, new, ui.wake)
    except ConfigError as error:
        ui.say(*(_(str(getattr(finding, "message", finding))) for finding in error.findings))
        return False
    if not (yield from carried_out(ui, job, told)):
        return False
    ui.say(*(_("Warning: {text}").format(text=text) for text in _warnings(old, new)))
    return True


def carried_out(ui: Ui, job: Job, told: str) -> Dialogue[bool]:
    """Wait for *job*; say *told*, or what is wrong; False where it has failed. Esc ends the waiting, not the work."""
    _ = ui.translate
    try:
        is_done = yield from ui.wait_for(lambda: job.is_done, LONGEST_CHANGE_S)
    except Back:
        ui.say(_("It goes on by itself; I shows the station."))
        return True
    ui.say(*filter(None, [_(job.problem) or (told if is_done else _("This takes unusually long; see I."))]))
    return not job.problem
