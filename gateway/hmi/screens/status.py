"""Keys I, T and L: how the station fares, what goes over a line, and the log (spec section 5)."""

from __future__ import annotations

from typing import Final

from gateway.config import LineConfig, MasterConfig, SlaveConfig
from gateway.counters import ServeCounters
from gateway.hmi.menu import HELP, AskKey, Dialogue, Ui
from gateway.hmi.screens.requests import error_name, state_name
from gateway.hmi.screens.settings import ask_line_of, format_text
from gateway.hmi.station import LineView, MasterView, SlaveView, Station
from gateway.hmi.wording import age_text, duration_text
from gateway.plain_text import cut
from gateway.polls import Poll

STATUS_EVERY_S: Final = 2.0
TRAFFIC_EVERY_S: Final = 0.25
LINES_AT_ONCE: Final = 20
LONGEST_CAUSE: Final = 100  # characters of why it was started; where many lines have hung the log names them all


# ------------------------------------------------------------------------------------------------ I


def show_status(ui: Ui, station: Station) -> Dialogue[None]:
    """Show the whole station, live, until a key."""
    _ = ui.translate
    ui.help = _("The whole station at a glance; it is refreshed by itself.")
    body = lambda: (status_head(ui, station), status_rows(ui, station))  # noqa: E731 - as a def it says no more
    yield from ui.pages(body, _("Any key: back."), every_s=STATUS_EVERY_S)


def status_head(ui: Ui, station: Station) -> list[str]:
    """Return what is told first: since when it runs, and why it was started."""
    _ = ui.translate
    uptime = duration_text(ui.clock.monotonic() - station.started_s)
    cause = cut(station.last_restart.words(_), LONGEST_CAUSE)
    text = _("Running for {uptime}; last restart: {cause}").format(uptime=uptime, cause=cause)
    return ui.parts(text + (_("; unsaved changes") if station.is_unsaved else ""))


def status_rows(ui: Ui, station: Station) -> list[str]:
    """Return alarms, safe mode, the hardware watchdog, lines, requests and clients, a row each."""
    _ = ui.translate
    alarms = station.alarms()
    told = [_("ALARM: {alarm}").format(alarm=alarm.words(_)) for alarm in alarms] or [_("No alarms.")]
    told += [*safe_mode_rows(ui, station), *_watchdog_rows(ui, station)]
    rows = [part for row in told for part in ui.parts(row)]
    for line in station.config.master:
        rows += _master_rows(ui, line, station.master(line.name))
    for slave in station.config.slave:
        rows += _slave_rows(ui, slave, station.slave(slave.name))
    return [cut(row, ui.columns - 1) for row in rows]


def safe_mode_rows(ui: Ui, station: Station) -> list[str]:
    """Return how safe mode ends; nothing where there is none."""
    _ = ui.translate
    left_s = station.safe_left_s
    if left_s is None:
        return []
    left = duration_text(max(0.0, left_s))  # it is over when the supervisor has seen to it
    return [_("Safe mode: G ends it; else it ends in {time}, for one more try.").format(time=left)]


def _watchdog_rows(ui: Ui, station: Station) -> list[str]:
    _ = ui.translate
    state = station.watchdog_state()
    return [_("Hardware watchdog: {state}").format(state=state.words(_))] if state is not None else []


def _title_rows(ui: Ui, line: LineConfig, kind: str, state: str, trouble: str = "") -> list[str]:
    """Return the line's row, in which its port comes last, since that may be cut off; and its trouble, whole."""
    _ = ui.translate
    where = line.line or _("no port yet")
    form = "" if line.is_tcp else f" {format_text(line)}"
    state = _("trouble") if trouble else state
    title = f"{kind} {line.name}: {state}, {where}{form}"
    return [title, *ui.parts(f"  {trouble}")] if trouble else [title]


def _master_rows(ui: Ui, line: MasterConfig, view: MasterView | None) -> list[str]:
    _ = ui.translate
    if view is None:
        return _title_rows(ui, line, _("Master"), _("being started anew"))
    counters = view.counters
    rows = [
        *_title_rows(ui, line, _("Master"), _line_state(view.state(), ui), view.trouble if view.enabled else ""),
        _("  sent {sent}, good {good}, timeouts {timeouts}, damaged {damaged}, exceptions {exceptions}").format(
            sent=counters.sent,
            good=counters.good,
            timeouts=counters.timeouts,
            damaged=counters.damaged,
            exceptions=sum(counters.exceptions.values()),
        ),
        _("  reply avg {average:.1f}, p95 {p95:.1f} ms; overruns {overruns}, expired {expired}").format(
            average=counters.times.average_s * 1000,
            p95=counters.times.p95_s * 1000,
            overruns=counters.overruns,
            expired=counters.expired,
        )
        + _("; line in use {share:.0f} %").format(share=100 * view.busy_share),
    ]
    offline = [str(unit) for unit, device in sorted(view.devices.items()) if device.is_offline]
    if offline:
        rows.append(_("  offline: unit {units}").format(units=", ".join(offline)))
    return rows + [_request_row(ui, view, poll) for poll in view.polls]


def _line_state(state: str, ui: Ui) -> str:
    """Return what a line does, in the person's language; the states are those of the specification."""
    _ = ui.translate
    names = {"idle": _("idle"), "no line": _("no connection"), "maintenance": _("maintenance")}
    return names.get(state) or _("awaiting reply")


def _request_row(ui: Ui, view: MasterView, poll: Poll) -> str:
    _ = ui.translate
    now_s = ui.clock.monotonic()
    state = state_name(poll.state(now_s, not view.enabled), _)
    age = age_text(None if poll.last_good_s is None else now_s - poll.last_good_s)
    counters = poll.counters
    row = f"    {poll.config.title:<20} {state:<14} {age:>5}  "
    row += _("good {good} of {sent}").format(good=counters.good, sent=counters.sent)
    return row + (f"  {error_name(poll.last_error, _)}" if poll.last_error else "")


def _slave_rows(ui: Ui, line: SlaveConfig, view: SlaveView | None) -> list[str]:
    _ = ui.translate
    if view is None:
        return _title_rows(ui, line, _("Slave"), _("being started anew"))
    state = _("answering") if view.enabled else _("maintenance")
    rows = _title_rows(ui, line, _("Slave"), state, view.trouble if view.enabled else "")
    rows.append("  " + _("unit {unit}").format(unit=line.unit) + f"; {_served(ui, view.counters)}")
    now_s = ui.clock.monotonic()
    for client in list(view.clients.values()):
        active = age_text(now_s - client.active_s)
        since = duration_text(now_s - client.since_s)
        told = _("{name} for {since}, last asked {active} ago").format(name=client.name, since=since, active=active)
        rows += [f"    {told}", f"      {_served(ui, client.counters)}"]
    return rows


def _served(ui: Ui, counters: ServeCounters) -> str:
    _ = ui.translate
    text = _("asked {requests}, good {good}, exceptions {exceptions}, damaged {damaged}, foreign {foreign}")
    return text.format(
        requests=counters.requests,
        good=counters.good,
        exceptions=sum(counters.exceptions.values()),
        damaged=counters.damaged,
        foreign=counters.foreign,
    )


# ------------------------------------------------------------------------------------------------ T


def show_traffic(ui: Ui, station: Station) -> Dialogue[None]:
    """Show the frames of one line as they come, until a key."""
    _ = ui.translate
    ui.help = _("> was sent, < was heard. What the terminal cannot keep up with is dropped; the line is never slowed.")
    config = station.config
    line = yield from ask_line_of(ui, [*config.master, *config.slave], _("Line"))
    if line is None:
        return
    if not line.enabled:
        ui.say(_("{name} is in maintenance: A or S switches it on.").format(name=line.name))
        return
    if station.is_safe:
        ui.say(_("{name} is in maintenance: safe mode; G ends it.").format(name=line.name))
        return
    ui.say(_("Traffic of {name}, until any key: > sent, < heard").format(name=line.name))
    is_over = False
    while not is_over:  # a line that is made anew meanwhile is followed on
        is_over = yield from _follow(ui, station, line.name)
    ui.say("")


def _follow(ui: Ui, station: Station, name: str) -> Dialogue[bool]:
    """Show the traffic of a line as long as it is the same; True when a key was typed."""
    view = _line_view(station, name)
    undo = view.traffic.watch() if view is not None else lambda: None
    dropped = view.traffic.dropped if view is not None else 0
    try:
        while _line_view(station, name) is view:
            key = yield AskKey("", "", any_key=True, every_s=TRAFFIC_EVERY_S, is_quiet=True)
            if key == HELP:
                ui.say(*ui.help_lines())
            elif key is not None:
                return True
            if view is not None:
                dropped = _show_frames(ui, view, dropped)
    finally:
        undo()
    return False


def _line_view(station: Station, name: str) -> LineView | None:
    return station.master(name) or station.slave(name)


def _show_frames(ui: Ui, view: LineView, dropped: int) -> int:
    """Show what came since the last time; *dropped* of it until then. Returns how much was dropped until now."""
    _ = ui.translate
    seen = view.traffic.take()
    ui.say(*(frame.line(ui.columns - 1) for frame in seen[-LINES_AT_ONCE:]))
    left_out = view.traffic.dropped - dropped + max(0, len(seen) - LINES_AT_ONCE)
    if left_out:
        ui.say(_("... not shown: {count} more.").format(count=left_out))
    return view.traffic.dropped


# ------------------------------------------------------------------------------------------------ L


def show_log(ui: Ui, station: Station) -> Dialogue[None]:
    """Show the newest log lines, newest first, live, until a key."""
    _ = ui.translate
    ui.help = _("The newest lines of the log, newest first.")

    def body() -> tuple[list[str], list[str]]:
        lines = [part for line in reversed(station.log_lines()) for part in _wrapped(line, ui.columns - 1)]
        return [_("Log, newest first")], lines or [_("Nothing has been logged.")]

    yield from ui.pages(body, _("Any key: back."))


def _wrapped(line: str, width: int) -> list[str]:
    return [line[start : start + width] for start in range(0, len(line), width)] or [""]
