"""Key R: the polling requests of a master, one at a time (spec section 5)."""

from __future__ import annotations

from typing import Any, Final

from gateway.config import FUNCTION_CODES, FUNCTION_NAMES, NATURAL_TABLES, Config, MasterConfig, RequestConfig
from gateway.config_fields import is_name
from gateway.counters import PollCounters
from gateway.hmi.menu import Back, Dialogue, Ui, whole_number
from gateway.hmi.screens.changes import (
    READS_ONLY,
    WRITES_ONLY,
    changed,
    given,
    put_to_work,
    section,
    tell_faults,
    with_master,
    with_request,
)
from gateway.hmi.screens.data import ask_point
from gateway.hmi.screens.settings import ask_line_of
from gateway.hmi.station import MasterView, Station
from gateway.hmi.wording import Translate, age_text, point_name
from gateway.modbus.describe import exception_name
from gateway.modbus.pdu import BROADCAST, QUANTITY_LIMITS, READS, Table
from gateway.polls import Poll, Status

NAME_LIMIT: Final = 32
SINGLE_WRITES: Final = (5, 6)


def requests(ui: Ui, station: Station) -> Dialogue[None]:
    """Show requests in turn, and change them."""
    _ = ui.translate
    line = yield from ask_line_of(ui, station.config.master, _("Master"))
    if line is None:
        return
    place = 0
    while True:
        ui.help = _("One request at a time: what is asked, where it goes, how it fares. Changes act at once.")
        config = station.config
        master = _master(config, line.name)
        if master is None:
            ui.say(_("There is no master {name} any more.").format(name=line.name))
            return
        place = _show(ui, station, master, place)
        ui.say("", _("S next  M modify  B delete  X delete all  N new  0 back"))
        key = yield from ui.key(_("{name}: requests").format(name=master.name), "smbxn0", "s")
        if key == "0":
            return
        if key == "s":
            place += 1
            continue
        try:
            place = yield from _edit(key, ui, station, config, master, place)
        except Back:
            ui.say(_("Nothing is changed."))


def _master(config: Config, name: str) -> MasterConfig | None:
    return next((master for master in config.master if master.name == name), None)


def _edit(key: str, ui: Ui, station: Station, config: Config, master: MasterConfig, place: int) -> Dialogue[int]:
    """Do what *key* says with what *config*, as it was shown, has; return the place of the request to show next."""
    _ = ui.translate
    if key == "n":
        is_made = yield from _ask_request(ui, station, config, master, None)
        return len(master.request) if is_made else place
    if not master.request:
        ui.say(_("There is no request: N makes one."))
        return place
    if key == "x":
        yield from _delete_all(ui, station, config, master)
        return 0
    request = master.request[place % len(master.request)]
    if key == "m":
        yield from _ask_request(ui, station, config, master, request)
    else:
        yield from _delete(ui, station, config, master, request)
    return place


def _delete(ui: Ui, station: Station, config: Config, master: MasterConfig, request: RequestConfig) -> Dialogue[None]:
    _ = ui.translate
    if (yield from ui.confirmed(_("Delete {name}?").format(name=request.title))):
        told = _("{name} is deleted.").format(name=request.title)
        yield from put_to_work(ui, station, config, with_request(config, master, request, None), told)


def _delete_all(ui: Ui, station: Station, config: Config, master: MasterConfig) -> Dialogue[None]:
    _ = ui.translate
    question = _("Delete all requests of {name} ({count})?").format(count=len(master.request), name=master.name)
    if (yield from ui.confirmed(question)):
        new = with_master(config, master, master.model_copy(update={"request": []}))
        yield from put_to_work(ui, station, config, new, _("All requests are deleted."))


# ------------------------------------------------------------------------------------------------ showing one


def _show(ui: Ui, station: Station, master: MasterConfig, place: int) -> int:
    """Show the request at *place*, which goes round; return the place it has."""
    _ = ui.translate
    if not master.request:
        ui.say("", _("{name} has no requests.").format(name=master.name))
        return 0
    place %= len(master.request)
    request = master.request[place]
    title = _("Request {number} of {count}: {name}").format(
        number=place + 1, count=len(master.request), name=request.title
    )
    ui.say("", title if request.enabled else _("{title} (off)").format(title=title))
    ui.say(*_asked_lines(master, request, _))
    view = station.master(master.name)
    poll = _poll_of(view, request)
    if view is not None and poll is not None:
        ui.say(*_state_lines(ui, view, poll))
    return place


def _asked_lines(master: MasterConfig, request: RequestConfig, _: Translate) -> list[str]:
    natural = request.natural_table
    unit = _("0 (broadcast)") if master.is_broadcast(request) else str(request.unit)
    when = _("every {every:g} s").format(every=request.every)
    if not request.is_read and request.trigger == "change":
        when = _("on change")
        if request.expire:
            when = _("on change, given up after {expire:g} s").format(expire=request.expire)
    lines = [
        _("  unit {unit}, function {code} ({name}), {when}").format(
            unit=unit, code=request.code, name=FUNCTION_NAMES[request.code], when=when
        ),
        _("  device:   {point}, {count} of them").format(
            point=point_name(natural, request.address, _), count=request.count
        ),
        _("  register: {point}").format(point=point_name(request.target, request.point, _)),
    ]
    if request.is_read:
        kept = _("kept") if request.on_failure == "hold" else _("zero")
        stale = request.stale_after_used
        lines.append(_("  on failure: {kept}; stale after {stale:g} s").format(kept=kept, stale=stale))
    timeout = _("  response timeout {timeout:g} s").format(timeout=master.response_timeout_of(request))
    if request.status_point >= 0:
        timeout += _("; status in input registers {point} to {last}").format(
            point=request.status_point, last=request.status_point + 3
        )
    return [*lines, timeout]


def _poll_of(view: MasterView | None, request: RequestConfig) -> Poll | None:
    polls = view.polls if view is not None else []
    return next((poll for poll in polls if poll.config.title == request.title), None)


def _state_lines(ui: Ui, view: MasterView, poll: Poll) -> list[str]:
    _ = ui.translate
    now_s = ui.clock.monotonic()
    counters, times = poll.counters, poll.counters.times
    state = _("  state: {state}").format(state=state_name(poll.state(now_s, not view.enabled), _))
    if poll.last_good_s is not None:
        state += _(", last success {age} ago").format(age=age_text(now_s - poll.last_good_s))
    if poll.last_error:
        state += _("; last error: {error}").format(error=error_name(poll.last_error, _))
    return [
        state,
        _("  sent {sent}, good {good}, timeouts {timeouts}, damaged {damaged}, exceptions {exceptions}").format(
            sent=counters.sent,
            good=counters.good,
            timeouts=counters.timeouts,
            damaged=counters.damaged,
            exceptions=_exceptions(counters, _),
        ),
        _("  overruns {overruns}, expired {expired}").format(overruns=counters.overruns, expired=counters.expired),
        _("  reply last {last:.0f}, min {least:.0f}, avg {average:.0f}, max {most:.0f}, p95 {p95:.0f} ms").format(
            last=times.last_s * 1000,
            least=times.min_s * 1000,
            average=times.average_s * 1000,
            most=times.max_s * 1000,
            p95=times.p95_s * 1000,
        ),
    ]


def _exceptions(counters: PollCounters, _: Translate) -> str:
    """Return how many exceptions came, and how many of each code."""
    of_code = [
        _("code {code}: {count}").format(code=code, count=count) for code, count in sorted(counters.exceptions.items())
    ]
    return f"{sum(counters.exceptions.values())} ({', '.join(of_code)})" if of_code else "0"


def state_name(state: Status, _: Translate) -> str:
    """Return a request's state in a word."""
    names = {
        Status.NEVER: _("never answered"),
        Status.GOOD: _("good"),
        Status.BAD: _("bad"),
        Status.STALE: _("stale"),
        Status.OFFLINE: _("offline"),
        Status.MAINTENANCE: _("maintenance"),
    }
    return names[state]


def error_name(code: int, _: Translate) -> str:
    """Return an error code of ``Response`` in words."""
    if code == 0xFFFF:
        return _("no answer")
    if code == 0xFFFE:
        return _("damaged answer")
    return _("exception {code} ({name})").format(code=code, name=_(exception_name(code)))


# ------------------------------------------------------------------------------------------------ making one


def _ask_request(
    ui: Ui, station: Station, config: Config, master: MasterConfig, old: RequestConfig | None
) -> Dialogue[bool]:
    """Ask for all of a request, with the *old* one's values as defaults, until it fits; True when it is at work."""
    asked: dict[str, Any] = {} if old is None else given(old)
    while True:
        asked = yield from _ask_all(ui, config, master, asked, is_new=old is None)
        new = _made(ui, old, asked)
        if old is None:
            new = _named_apart(master, new)
        wanted = with_request(config, master, old, new)
        if not tell_faults(ui, wanted):
            break
    if new == old:
        ui.say(ui.translate("Nothing is changed."))
        return False
    told = ui.translate("{name} is at work.").format(name=new.title)
    return (yield from put_to_work(ui, station, config, wanted, told))


def _ask_all(
    ui: Ui, config: Config, master: MasterConfig, known: dict[str, Any], is_new: bool
) -> Dialogue[dict[str, Any]]:
    """Ask in the order of the specification; *known* are the defaults."""
    _ = ui.translate
    is_tcp = master.framing_used == "tcp"
    unit = yield from ui.number(_("Unit"), 0, 255 if is_tcp else 247, known.get("unit"))
    known_code = None if "function" not in known else section(RequestConfig, known).code
    code = yield from _ask_function(ui, known_code, is_broadcast=unit == BROADCAST and not is_tcp)
    table = NATURAL_TABLES[code]
    address = yield from ask_point(ui, _("Address"), table, 0xFFFF, known.get("address"))
    most = 1 if code in SINGLE_WRITES else min(QUANTITY_LIMITS[code], 0x10000 - address)
    default = min(int(known.get("count", 1)), most) if known or most == 1 else None
    count = yield from ui.number(_("Count"), 1, most, default)
    every = yield from ui.seconds(_("Cycle time in seconds"), 0.01, 86400, known.get("every", 1.0))
    target = _target(known, code)
    size = config.register_.size(target)
    point = yield from ask_point(ui, _("First point"), target, max(0, size - count), known.get("point"))
    ui.say(point_name(target, point, _))
    answers: dict[str, Any] = {
        "unit": unit,
        "function": code,
        "address": address,
        "count": count,
        "every": every,
        "point": point,
    }
    if not is_new:
        answers["name"] = yield from _ask_name(ui, known, unit, code, address)
    if every == RequestConfig.model_fields["every"].default and "every" not in known:
        del answers["every"]  # nobody gave it
    return known | answers


def _target(known: dict[str, Any], code: int) -> Table:
    """Return the table of the register that a request with *code* fills, if its ``table`` still fits."""
    if known and "table" in known:
        target = section(RequestConfig, known).target
        if target.is_bits == NATURAL_TABLES[code].is_bits:
            return target
    return NATURAL_TABLES[code]


def _ask_function(ui: Ui, default: int | None, is_broadcast: bool) -> Dialogue[int]:
    _ = ui.translate
    codes = [code for code in FUNCTION_CODES.values() if not (is_broadcast and code in READS)]
    names = [f"{code:>2} {FUNCTION_NAMES[code]}" for code in codes]
    for left in range(0, len(names), 2):
        ui.say("  " + "".join(f"{name:<34}" for name in names[left : left + 2]).rstrip())

    def judge(text: str) -> int:
        number = whole_number(text)
        if number not in codes:
            allowed = ", ".join(str(code) for code in codes)
            raise ValueError(_("Please type one of {allowed}.").format(allowed=allowed))
        return number

    shown = str(default) if default in codes else ""
    return (yield from ui.value(_("Function code"), judge, shown))


def _ask_name(ui: Ui, known: dict[str, Any], unit: int, code: int, address: int) -> Dialogue[str | None]:
    """Ask for a name; the name made of unit, function and address is none that has to be written down."""
    _ = ui.translate
    automatic = f"u{unit}-f{code}-{address}"

    def judge(text: str) -> str:
        if not is_name(text):
            raise ValueError(_("A name has 1 to 32 letters, digits, - and _."))
        return text

    name = yield from ui.value(_("Name"), judge, known.get("name") or automatic, NAME_LIMIT)
    return None if name == automatic else name


def _made(ui: Ui, old: RequestConfig | None, asked: dict[str, Any]) -> RequestConfig:
    """Return what was asked for as a request; keys that do not fit its function any more go, and that is told."""
    data = {key: value for key, value in asked.items() if value is not None}
    request = section(RequestConfig, {key: value for key, value in data.items() if key != "table"})
    unfit = WRITES_ONLY if request.is_read else READS_ONLY
    gone = [key for key in unfit if key in data]
    if "table" in data and section(RequestConfig, data).target.is_bits != request.natural_table.is_bits:
        gone.append("table")
    if gone:
        ui.say(ui.translate("No longer of use and left out: {keys}").format(keys=", ".join(gone)))
    if old is not None and "function" in given(old) and old.code == request.code:
        data["function"] = old.function  # spelled as the person spelled it
    return section(RequestConfig, {key: value for key, value in data.items() if key not in gone})


def _named_apart(master: MasterConfig, new: RequestConfig) -> RequestConfig:
    """Give *new* a name of its own where another request has the name made of unit, function and address."""
    titles = {request.title for request in master.request}
    number, name = 2, new.title
    while name in titles:
        name, number = f"{new.title}-{number}", number + 1
    return new if name == new.title else changed(new, {"name": name})
