"""The master (client) of one line: commands first, then polls in turn (spec section 2).

It asks, through a ``Line``, and carries what comes to the register. A line that cannot be opened, or is lost, is
reported once and opened again with back-off. It never decides how bytes become frames, nor what a write is worth:
those are ``transaction`` and ``commands``.

Threads: one, which alone owns the link, the line and the schedule. ``submit``, ``wake`` and ``set_enabled`` may be
called from any thread. ``step`` does one thing and waits no longer than *wait_limit_s*: it is what the tests drive.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from gateway.clock import Clock
from gateway.commands import Command, CommandQueue
from gateway.config import MasterConfig
from gateway.counters import PollCounters
from gateway.errors import LinkError
from gateway.link import Link, Waker
from gateway.modbus.pdu import AnyRequest
from gateway.opening import Opening, Start, at_once
from gateway.polls import Device, Poll, ProbeBudget, StatusPoints, count_response, polls_of, take_points, timing_of
from gateway.register import DataRegister
from gateway.schedule import Schedule
from gateway.tickets import Ticket, TicketQueue
from gateway.traffic import Tap
from gateway.transaction import DAMAGED, TIMEOUT, Line, Response

COMMANDS_IN_A_ROW: Final = 4  # then one poll goes through
SILENT_TCP_LIMIT: Final = 3  # requests in a row without any answer: a half-open connection, made anew
PROBE_LEAST_S: Final = 0.1  # a probe that found nothing to send is not tried again without a pause

log = logging.getLogger(__name__)


@dataclass(eq=False)
class _Opened:
    """The line while it is open, and how it has fared since then."""

    link: Link
    line: Line
    silent_in_row: int = 0  # requests
    has_answered: bool = False


class Master:
    """One ``[[master]]`` at work; a ``Task``."""

    def __init__(
        self,
        config: MasterConfig,
        register: DataRegister,
        clock: Clock,
        waker: Waker,
        open_link: Callable[[], Link],
        wait_limit_s: float = 3.0,
        late_s: dict[str, float] | None = None,
        start: Start = at_once,
    ) -> None:
        """*open_link* opens the line, or raises LinkError; *start* has that done, here or in another thread.

        late_s: until when a late reply may come on a port (monotonic), shared by all that use it."""
        self.name = config.name
        self.config = config
        self.enabled = config.enabled
        self.ready = threading.Event()
        self.counters = PollCounters()
        self.busy_s, self._since_s = 0.0, clock.monotonic()  # of the line's time, silences and listening included
        self.polls, self.devices = polls_of(config)
        self.traffic = Tap(config.framing_used, clock, config.character_timeout_used)
        self._register = register
        self._clock = clock
        self._waker = waker
        self._late_s = {} if late_s is None else late_s
        self._wait_limit_s = wait_limit_s
        self._opened: _Opened | None = None
        self._opening = Opening(config.name, clock, open_link, waker, start)
        self._is_resting = False  # a connection that worked and was closed: opened again when there is work for it
        self._busy_since_s: float | None = None  # since when the line has not been silent
        self._listens_since_s: float | None = None  # since when nothing was sent because somebody else may speak
        self._schedule = Schedule([poll.config.every for poll in self.polls if poll.is_scheduled])
        self._scheduled = self._online = sum(device.polls for device in self.devices.values())  # as bits
        self._offline: set[Device] = set()
        self._probes = ProbeBudget()
        self._commands_in_row = 0
        self._tickets = TicketQueue(clock, waker.wake, has_broadcast=config.framing_used != "tcp")
        self._status = StatusPoints(self.polls, register)
        self._stopping: Callable[[], bool] = bool  # until ``run``: False
        self._alive: Callable[[], object] = bool
        self._queue = CommandQueue(register, clock, waker.wake)
        self._by_outlet = {poll.outlet: poll for poll in self.polls if poll.outlet}
        self._undo = take_points(self.polls, register, self._queue)

    @property
    def trouble(self) -> str:
        """Why the line cannot be used, for people; "" while it can."""
        return self._opening.trouble

    @property
    def busy_share(self) -> float:
        """Share of the line's time in use since it is polled, 0 to 1."""
        return min(1.0, self.busy_s / max(self._clock.monotonic() - self._since_s, 1e-9))

    @property
    def has_alarm(self) -> bool:
        """True while the line cannot be used, or one of its devices is offline."""
        return bool(self._opening.trouble or self._offline)

    # -------------------------------------------------------------------------------------------- from any thread

    def wake(self) -> None:
        """End any wait of this master's thread."""
        self._waker.wake()

    def set_enabled(self, enabled: bool) -> None:
        """False: maintenance, nothing is sent and the port is let go; True: the line polls again."""
        self.enabled = enabled
        self.wake()

    def submit(self, unit: int, request: AnyRequest, told: Callable[[], None] | None = None) -> Ticket:
        """Queue a command before all polls. Raises QueueFull, RequestInvalid.

        It is given up, like any command, when it could not be sent within 10 s: also where the line is in maintenance.
        told: called once, when the ticket is done; from this master's thread, or at once where it has stopped.
        """
        return self._tickets.submit(unit, request, told)

    def state(self) -> str:
        """Return what the line does, in one word or two."""
        if not self.enabled:
            return "maintenance"
        opened = self._opened
        return opened.line.state.value if opened else "no line"

    # -------------------------------------------------------------------------------------------- the thread

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        """Poll until *stop*; *alive* is called whenever something has been got on with."""
        self._stopping, self._alive = stop.is_set, alive
        try:
            while not stop.is_set():
                if self.step():
                    alive()
        finally:
            self.close()

    def close(self) -> None:
        """Let go of the line, the register's points and the commands."""
        self._let_go()
        self._opening.close()
        if len(self._queue):
            log.warning("%s: %d writes are not delivered: the line stops or is made anew", self.name, len(self._queue))
        for undo in self._undo:
            undo()
        self._undo.clear()
        self._tickets.close()

    def step(self) -> bool:
        """Do one thing: a command, a poll, a probe, opening the line; or wait for the next. False: neither of them."""
        self._expire()
        self._status.show_all(self._clock.monotonic(), not self.enabled)
        if not self.enabled:
            self.ready.set()
            self._let_go()
            return self._waker.rest(self._wait_s())
        if self._opened is None:
            return self._open()
        try:
            has_got_on = self._work(self._opened)
        except LinkError as error:
            self._broke(str(error))
            return True
        if self._opened is not None and not self.config.is_tcp and self._opening.trouble:
            self._opening.worked()  # a port has to carry something first; a connection, an answer
        return has_got_on

    def _work(self, opened: _Opened) -> bool:
        if self.config.is_tcp and opened.silent_in_row >= SILENT_TCP_LIMIT:
            self._renew("nothing answers")
            return True
        line = opened.line
        if not line.is_free or (line.silent_in_s() and not self._is_never_silent()):
            return self._listen(line)  # what is taken is sent at once: a newer value may come meanwhile
        self._busy_since_s = self._listens_since_s = None
        if self.config.is_tcp:
            line.advance(0.0)  # a device that has hung up after its last reply fails no request
        if self._carry_out_command(line) or self._carry_out_probe(line) or self._carry_out_poll(line):
            return True
        wait_s = self._wait_s()
        line.advance(wait_s)
        return wait_s > 0.0

    def _listen(self, line: Line) -> bool:
        """Let a spoiled line, or the silence before the next request, get on; False if it goes on for too long.

        That is time in use, too."""
        began_s = self._clock.monotonic()
        since_s = self._listens_since_s = (self._listens_since_s or began_s) if line.is_free else None
        timeout_s = self.config.response_timeout + self.config.delay  # also of the silence after late replies
        over_by_s = line.late_until_s if since_s is None else since_s + timeout_s
        line.advance(min(line.silent_in_s() or self._wait_limit_s, self._wait_limit_s))
        now_s = self._clock.monotonic()
        self.busy_s += now_s - began_s
        return now_s <= over_by_s + self._wait_limit_s

    def _is_never_silent(self) -> bool:
        """True when the line has babbled for a whole response timeout: polls then fail, and say so."""
        now_s = self._clock.monotonic()
        if self._busy_since_s is None:
            self._busy_since_s = now_s
        return now_s - self._busy_since_s >= self.config.response_timeout + self.config.delay

    def _wait_s(self) -> float:
        """How long nothing is due."""
        due_s = [self._clock.monotonic() + self._wait_limit_s]
        may_open = self._is_resting and not self._opening.wait_s()  # while it is being opened, what is due has to wait
        if self.enabled and (self._opened is not None or may_open):
            due_s.append(self._schedule.next_due_s() or due_s[0])
            if self._offline:
                due_s.append(self._probes.due_s())
        for next_s in (self._queue.next_expiry_s(), self._tickets.next_expiry_s(), self._status.due_s()):
            due_s.append(due_s[0] if next_s is None else next_s)
        return max(0.0, min(due_s) - self._clock.monotonic())

    # -------------------------------------------------------------------------------------------- the line

    def _open(self) -> bool:
        wait_s = self._opening.wait_s()
        if wait_s or (self._is_resting and not self._is_work_due()):
            return self._waker.rest(min(self._wait_s(), wait_s or self._wait_limit_s))
        link = self._opening.attempt(self.ready, self._lost)
        if link is not None:
            self._take(link)
        return True

    def _take(self, link: Link) -> None:
        """Work on this line from now on."""
        log.debug("%s: polling on %s", self.name, self.config.line)
        timing = timing_of(self.config, link.character_s)
        late_until_s = self._late_s.get(self.config.line, 0.0)
        line = Line(link, self.config.framing_used, timing, self._clock, self.traffic.tell, late_until_s)
        self._opened = _Opened(link, line)
        again = self._schedule.due(self._clock.monotonic()) if self._is_resting else self._scheduled
        self._schedule.at_once(again)  # what was missed meanwhile is no overrun
        self._is_resting = False
        self._busy_since_s = self._listens_since_s = None

    def _is_work_due(self) -> bool:
        is_probe_due = bool(self._offline) and self._clock.monotonic() >= self._probes.due_s()
        return len(self._tickets) > 0 or len(self._queue) > 0 or is_probe_due or self._poll_due() is not None

    def _broke(self, reason: str) -> None:
        """A connection that worked is made anew: devices close idle ones. Another is in trouble."""
        if self._opened is not None and self._opened.has_answered:
            self._renew(reason)
        else:
            self._lost(reason)

    def _renew(self, reason: str) -> None:
        log.debug("%s: %s; opening it anew", self.name, reason)
        self._is_resting = self.config.is_tcp
        self._let_go()

    def _lost(self, reason: str) -> None:
        """The line is not to be had: say so once, spoil all points, try again later and later."""
        self._let_go()
        self._is_resting = False
        if self._opening.failed(reason):
            for poll in self.polls:
                if poll.config.is_read:
                    poll.spoil(self._register)
                    poll.last_error = TIMEOUT

    def _let_go(self) -> None:
        if self._opened is not None:
            self._opened.link.close()
            self.traffic.ended()
            if not self.config.is_tcp:  # a new connection brings no late reply of the old one
                self._late_s[self.config.line] = self._opened.line.late_until_s
        self._opened = None

    # -------------------------------------------------------------------------------------------- what is next

    def _carry_out_command(self, line: Line) -> bool:
        if self._commands_in_row >= COMMANDS_IN_A_ROW and self._poll_due() is not None:
            return False
        self._commands_in_row += 1  # also of one that ends the connection: polls go on after 4
        ticket = self._tickets.take()
        if ticket is not None:
            self._carry_out_ticket(line, ticket)
            return True
        held_back = {outlet for device in self._offline for outlet in device.outlets}
        command = self._queue.take(held_back)
        if command is None:
            self._commands_in_row -= 1
            return False
        self._send_command(line, command)
        return True

    def _carry_out_probe(self, line: Line) -> bool:
        """Try one offline device, if the budget allows: with a command that waits for it, else with a poll."""
        began_s = self._clock.monotonic()
        if not self._offline or began_s < self._probes.due_s():
            return False
        waiting = self._queue.waiting()
        wanted = {device for device in self._offline if device.outlets & waiting}
        is_sent = any(
            self._probe(line, device, device in wanted) for device in self._probes.in_turn(self._offline, wanted)
        )
        while self._has(line) and not line.is_free and not self._stopping():
            if self._listen(line):
                self._alive()
        least_s = PROBE_LEAST_S if self._has(line) else self.config.response_timeout  # a connection has its price
        self._probes.spent(began_s, max(self._clock.monotonic(), began_s + least_s))
        return is_sent

    def _has(self, line: Line) -> bool:
        """True while *line* is still the one that is open."""
        return self._opened is not None and self._opened.line is line

    def _probe(self, line: Line, device: Device, is_wanted: bool) -> bool:
        """Send what there is for *device*; False if there is nothing."""
        others = {outlet for outlet in self._by_outlet if outlet not in device.outlets}
        command = self._queue.take(others) if is_wanted else None
        polls = 0 if command else device.sendable(self.polls, self._queue)
        if command is None and not polls:
            return False
        self._probes.picked(device, is_wanted)
        if command is not None:
            self._send_command(line, command)
        else:
            index = self._schedule.pick(self._clock.monotonic(), polls)
            self._send_poll(line, self._schedule.next_in_turn(polls) if index is None else index)
        return True

    def _carry_out_poll(self, line: Line) -> bool:
        index = self._poll_due()
        if index is None:
            return False
        self._commands_in_row = 0
        self._send_poll(line, index)
        return True

    def _poll_due(self) -> int | None:
        return self._schedule.pick(self._clock.monotonic(), self._online)

    # -------------------------------------------------------------------------------------------- sending

    def _send_poll(self, line: Line, index: int) -> None:
        poll = self.polls[index]
        overruns = self._schedule.sent(index, self._clock.monotonic())
        number, data = 0, None
        if poll.outlet is not None:
            values = self._queue.cyclic_values(poll.outlet)
            if values is None:  # nobody has written all of its points yet
                return
            data, number = values
        if not poll.device.is_offline:
            poll.counters.overruns += overruns
            self.counters.overruns += overruns
        response = self._ask(line, poll, poll.request(data))
        if response is None:
            return
        self._take_outcome(poll, index, number, response)
        self._status.show(poll, self._clock.monotonic(), not self.enabled)

    def _take_outcome(self, poll: Poll, index: int, number: int, response: Response) -> None:
        if response.has_error():
            if poll.outlet is not None and response.error_code not in (TIMEOUT, DAMAGED):
                self._queue.refused(poll.outlet, number)
            self._poll_failed(poll, index, response)
        elif poll.outlet is not None:
            self._queue.delivered(poll.outlet, number)
            self._poll_succeeded(poll)
        else:
            self._register.write(poll.span, response.data, poll.source)
            self._poll_succeeded(poll)

    def _poll_succeeded(self, poll: Poll) -> None:
        poll.failed_tries = 0
        if poll.is_bad and poll.outlet is not None:
            self._queue.restore(poll.outlet)
        poll.is_bad = False
        if poll.is_told:
            poll.is_told = False
            log.info("%s: good again", poll.source, extra={"about": poll.source})

    def _poll_failed(self, poll: Poll, index: int, response: Response) -> None:
        poll.failed_tries += 1
        is_silent = response.error_code in (TIMEOUT, DAMAGED)
        if is_silent and poll.failed_tries <= self.config.retries and not poll.device.is_offline:
            self._schedule.at_once(1 << index)
            return
        poll.failed_tries = 0
        if not poll.is_told and not poll.device.is_offline:
            poll.is_told = True
            log.warning("%s: %s", poll.source, response.reason, extra={"about": poll.source})
        poll.spoil(self._register)

    def _send_command(self, line: Line, command: Command) -> None:
        poll = self._by_outlet[command.outlet]
        response = self._ask(line, poll, poll.command(command))
        if response is None or response.error_code in (TIMEOUT, DAMAGED):
            self._queue.put_back(command)
        elif response.has_error():
            log.warning("%s: point %d not written: %s", poll.source, command.span.start, response.reason)
            poll.is_bad = True
            self._queue.drop(command)
        else:
            poll.is_bad = False
            self._queue.answered(command)
        self._status.show(poll, self._clock.monotonic(), not self.enabled)

    def _carry_out_ticket(self, line: Line, ticket: Ticket) -> None:
        self.counters.sent += 1
        response = None
        try:
            response = self._transact(line, ticket.unit, ticket.request, None)
        finally:  # nobody waits for ever, even where a bug ends this thread
            ticket.finish(response)
        if response is not None:
            count_response(self.counters, response)
            if ticket.unit in self.devices:
                self._judge(self.devices[ticket.unit], response)

    def _ask(self, line: Line, poll: Poll, request: AnyRequest) -> Response | None:
        """Send *request* and wait for what becomes of it; None when stopped on the way."""
        poll.counters.sent += 1
        self.counters.sent += 1
        response = self._transact(line, poll.device.unit, request, poll.timeout_s)
        if response is not None:
            poll.count(response, self._clock.monotonic())
            count_response(self.counters, response)
            self._judge(poll.device, response)
        return response

    def _transact(self, line: Line, unit: int, request: AnyRequest, timeout_s: float | None) -> Response | None:
        began_s, response = self._clock.monotonic(), None
        try:
            line.send(unit, request, timeout_s)
            while response is None and not self._stopping():
                response = line.advance(self._wait_limit_s)
                if self._clock.monotonic() <= line.over_by_s + self._wait_limit_s:
                    self._alive()
        except LinkError as error:  # no answer either: whose request ends every connection is offline in the end
            if self.config.is_tcp and self._online:  # of no concern to those who answer
                self._renew(str(error))
            else:
                self._broke(str(error))
            response = Response(unit, request.function, TIMEOUT, reason=str(error))
        self.busy_s += self._clock.monotonic() - began_s
        if response is not None and self._opened is not None:
            is_silent = response.error_code == TIMEOUT
            self._opened.silent_in_row = self._opened.silent_in_row + 1 if is_silent else 0
            if not is_silent and not self._opened.has_answered:
                self._opened.has_answered = True
                self._opening.worked()
        return response

    # -------------------------------------------------------------------------------------------- devices

    def _judge(self, device: Device, response: Response) -> None:
        """Only silence and damaged replies count against a device: an exception proves it alive."""
        if response.error_code not in (TIMEOUT, DAMAGED):
            device.failures_in_row = 0
            if device.is_offline:
                self._back(device)
            return
        if device.failed():
            log.warning("%s: unit %d is offline: %s", self.name, device.unit, response.reason, extra=device.told)
            self._offline.add(device)
            self._online &= ~device.polls
            device.spoil(self.polls, self._register)

    def _back(self, device: Device) -> None:
        log.warning("%s: unit %d is back", self.name, device.unit, extra=device.told)
        device.is_offline = False
        self._offline.discard(device)
        self._online |= device.polls
        self._schedule.at_once(device.polls)
        for poll in self.polls:
            if poll.device is device and poll.outlet is not None:
                poll.is_bad = bool(poll.outlet.dropped)
                self._queue.restore(poll.outlet)

    # -------------------------------------------------------------------------------------------- by the way

    def _expire(self) -> None:
        for command in self._queue.expire():
            poll = self._by_outlet[command.outlet]
            poll.counters.expired += 1
            self.counters.expired += 1
            log.warning("%s: point %d not written: not delivered in time", poll.source, command.span.start)
        for ticket in self._tickets.expire():
            log.warning("%s: unit %d: a command of the menu not sent in time", self.name, ticket.unit)
