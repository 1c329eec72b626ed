"""What the gateway says of itself, to `rtugate status`: as a person reads it, or as one JSON object.

The text is that of the menu's key I, in English. Pure but for the station that it looks at; any thread.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

from gateway import __version__
from gateway.config import MasterConfig, SlaveConfig
from gateway.counters import PollCounters, ServeCounters
from gateway.errors import RequestInvalid
from gateway.hmi.menu import Ui
from gateway.hmi.screens.status import status_head, status_rows
from gateway.hmi.station import MasterView, SlaveView, Station
from gateway.polls import Poll

AS_JSON: Final = "--json"
COLUMNS: Final = 200


def status(station: Station, argument: str = "") -> str:
    """Return the status: a text, or with the argument ``--json`` an object (see ``status_data``)."""
    if argument == AS_JSON:
        return json.dumps(status_data(station), indent=2)
    if argument:
        raise RequestInvalid(f"status knows {AS_JSON} and nothing else")
    ui = Ui(station.clock)
    ui.columns = COLUMNS
    return "\n".join([*status_head(ui, station), *status_rows(ui, station)])


def status_data(station: Station) -> dict[str, Any]:
    """Return all that is counted; times in seconds, ages null before the first success."""
    config, watchdog = station.config, station.watchdog_state()
    return {
        "version": __version__,
        "uptime_s": round(station.clock.monotonic() - station.started_s, 1),
        "last_restart": station.last_restart.words(str),
        "unsaved_changes": station.is_unsaved,
        "safe_mode": station.is_safe,
        "watchdog": watchdog.words(str) if watchdog is not None else None,
        "alarms": [alarm.words(str) for alarm in station.alarms()],
        "masters": [_master(station, line, station.master(line.name)) for line in config.master],
        "slaves": [_slave(station, line, station.slave(line.name)) for line in config.slave],
    }


def status_line(station: Station) -> str:
    """Return how the lines fare and what is wrong: one line, the most important first, which may be cut off."""
    alarms = [alarm.words(str) for alarm in station.alarms()]
    told = [f"{len(alarms)} alarms: {alarms[0]}" if len(alarms) > 1 else f"alarm: {alarms[0]}"] if alarms else []
    states = [_in_a_word(line.name, station.master(line.name), "polling") for line in station.config.master]
    states += [_in_a_word(line.name, station.slave(line.name), "answering") for line in station.config.slave]
    return "; ".join([*told, ", ".join(states) or "no lines"])


def _in_a_word(name: str, view: MasterView | SlaveView | None, working: str) -> str:
    if view is None:
        return f"{name} being started anew"
    if not view.enabled:
        return f"{name} in maintenance"
    if view.trouble:
        return f"{name} has no line"
    return f"{name} {working if view.ready.is_set() else 'is being opened'}"


def _master(station: Station, line: MasterConfig, view: MasterView | None) -> dict[str, Any]:
    told: dict[str, Any] = {"name": line.name, "line": line.line, "enabled": line.enabled}
    if view is None:
        return told | {"state": "being started anew"}
    now_s = station.clock.monotonic()
    return told | {
        "state": view.state(),
        "trouble": view.trouble,
        "busy_share": round(view.busy_share, 3),
        "offline_units": sorted(unit for unit, device in view.devices.items() if device.is_offline),
        **_polled(view.counters),
        "requests": [_request(poll, now_s, view.enabled) for poll in view.polls],
    }


def _request(poll: Poll, now_s: float, is_enabled: bool) -> dict[str, Any]:
    age_s = None if poll.last_good_s is None else round(now_s - poll.last_good_s, 1)
    state = poll.state(now_s, not is_enabled).name.lower()
    return {"name": poll.config.title, "state": state, "age_s": age_s, **_polled(poll.counters)}


def _polled(counters: PollCounters) -> dict[str, Any]:
    times = counters.times
    return {
        "sent": counters.sent,
        "good": counters.good,
        "timeouts": counters.timeouts,
        "damaged": counters.damaged,
        "exceptions": _by_code(counters.exceptions),
        "overruns": counters.overruns,
        "expired": counters.expired,
        "reply_s": {
            "last": round(times.last_s, 4),
            "min": round(times.min_s, 4),
            "average": round(times.average_s, 4),
            "max": round(times.max_s, 4),
            "p95": round(times.p95_s, 4),
        },
    }


def _slave(station: Station, line: SlaveConfig, view: SlaveView | None) -> dict[str, Any]:
    told: dict[str, Any] = {"name": line.name, "line": line.line, "enabled": line.enabled, "unit": line.unit}
    if view is None:
        return told | {"state": "being started anew"}
    now_s = station.clock.monotonic()
    clients = [
        {
            "name": client.name,
            "connected_s": round(now_s - client.since_s, 1),
            "idle_s": round(now_s - client.active_s, 1),
            **_served(client.counters),
        }
        for client in list(view.clients.values())
    ]
    state = (
        "maintenance" if not view.enabled else "answering" if view.ready.is_set() and not view.trouble else "no line"
    )
    return told | {"state": state, "trouble": view.trouble, **_served(view.counters), "clients": clients}


def _served(counters: ServeCounters) -> dict[str, Any]:
    return {
        "requests": counters.requests,
        "good": counters.good,
        "exceptions": _by_code(counters.exceptions),
        "broadcasts": counters.broadcasts,
        "damaged": counters.damaged,
        "foreign": counters.foreign,
        "unanswered": counters.unanswered,
    }


def _by_code(exceptions: Mapping[int, int]) -> dict[str, int]:
    return {str(code): count for code, count in sorted(exceptions.items())}
