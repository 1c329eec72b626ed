"""Tickets: what a person sends through a master is always done in the end, exactly once, and its sender is told."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Iterator

import pytest

from gateway.errors import LinkUnavailable, QueueFull, RequestInvalid
from gateway.modbus.pdu import ReadRequest
from gateway.tickets import SUBMIT_EXPIRE_S, SUBMIT_LIMIT, Ticket, TicketQueue
from gateway.transaction import NO_ERROR
from tests.fakes import JumpingClock, MasterBench, reads

READ = ReadRequest(3, 0, 1)


class Sender:
    """Whoever sends a command: notes each time it is told, and whether its ticket was done by then."""

    def __init__(self) -> None:
        self.ticket: Ticket | None = None
        self.told: list[bool | None] = []
        self.threads: set[int] = set()

    def __call__(self) -> None:
        self.told.append(self.ticket.done.is_set() if self.ticket else None)
        self.threads.add(threading.get_ident())

    def sends(self, it: MasterBench) -> Ticket:
        self.ticket = it.master.submit(5, READ, self)
        return self.ticket


def a_queue(clock: JumpingClock) -> TicketQueue:
    return TicketQueue(clock, lambda: None, has_broadcast=True)


def test_the_sender_is_told_once_right_after_the_ticket_is_done(clock: JumpingClock) -> None:
    it, sender = MasterBench(clock, reads(1, 0)), Sender()
    it.run_s(0.2)
    ticket = sender.sends(it)
    assert sender.told == []
    it.run_s(30.0)
    it.master.close()
    assert sender.told == [True]
    assert ticket.response is not None
    assert ticket.response.error_code == NO_ERROR


@pytest.mark.parametrize("why", ["maintenance", "no line"])
def test_the_sender_is_told_once_after_10_s_where_nothing_can_be_sent(clock: JumpingClock, why: str) -> None:
    it, told_s = MasterBench(clock, enabled=why != "maintenance"), []
    it.missing = LinkUnavailable("not there") if why == "no line" else None
    it.steps(3)
    sent_s, ticket = clock.monotonic(), it.master.submit(5, READ, lambda: told_s.append(clock.monotonic()))
    it.run_s(30.0)
    it.master.close()
    assert told_s == [pytest.approx(sent_s + SUBMIT_EXPIRE_S)]
    assert (ticket.done.is_set(), ticket.response) == (True, None)


def test_a_line_in_maintenance_that_is_switched_on_in_time_sends_the_ticket(clock: JumpingClock) -> None:
    it, sender = MasterBench(clock, enabled=False), Sender()
    ticket = sender.sends(it)
    it.run_s(5.0)
    it.master.set_enabled(True)
    it.run_s(1.0)
    assert sender.told == [True]
    assert ticket.response is not None


def test_the_sender_is_told_once_when_the_master_stops_before_it_was_sent(clock: JumpingClock) -> None:
    it, sender = MasterBench(clock), Sender()
    ticket = sender.sends(it)
    it.master.close()
    it.master.close()
    assert (sender.told, ticket.response) == ([True], None)


def test_the_sender_is_told_once_when_the_master_stops_while_the_device_is_silent(clock: JumpingClock) -> None:
    it, sender, stop = MasterBench(clock), Sender(), threading.Event()
    it.field.silent = {5}
    it.field.during = lambda unit, pdu: stop.set()
    ticket = sender.sends(it)
    it.master.run(stop, lambda: None)
    assert len(it.field.asked) == 1
    assert (sender.told, ticket.response) == ([True], None)


def test_the_sender_is_told_even_when_a_bug_ends_the_master(clock: JumpingClock) -> None:
    it, sender = MasterBench(clock), Sender()
    ticket = sender.sends(it)

    def bug(unit: int, pdu: bytes) -> None:
        raise ZeroDivisionError

    it.field.during = bug
    with pytest.raises(ZeroDivisionError):
        it.master.run(threading.Event(), lambda: None)
    assert (sender.told, ticket.response) == ([True], None)


def test_a_ticket_for_a_master_that_has_stopped_is_done_at_once(clock: JumpingClock) -> None:
    it, sender = MasterBench(clock), Sender()
    it.master.close()
    ticket = sender.sends(it)
    assert (ticket.done.is_set(), ticket.response) == (True, None)
    assert len(sender.told) == 1
    it.steps(3)
    assert it.field.asked == []


def test_a_master_that_has_stopped_still_refuses_what_no_line_may_send(clock: JumpingClock) -> None:
    it = MasterBench(clock)
    it.master.close()
    with pytest.raises(RequestInvalid):
        it.master.submit(1, ReadRequest(3, 0, 126))


def test_a_refused_ticket_tells_nobody(clock: JumpingClock) -> None:
    queue, sender = a_queue(clock), Sender()
    for _ in range(SUBMIT_LIMIT):
        queue.submit(1, READ)
    with pytest.raises(QueueFull):
        queue.submit(1, READ, sender)
    queue.close()
    assert sender.told == []


def test_tickets_are_taken_in_the_order_of_their_coming(clock: JumpingClock) -> None:
    queue = a_queue(clock)
    tickets = [queue.submit(unit, READ) for unit in (3, 1, 2)]
    assert len(queue) == 3
    assert [queue.take(), queue.take(), queue.take(), queue.take()] == [*tickets, None]


def test_only_those_that_have_waited_too_long_expire(clock: JumpingClock) -> None:
    queue = a_queue(clock)
    assert (queue.next_expiry_s(), queue.expire()) == (None, [])
    old = queue.submit(1, READ)
    clock.pass_s(6.0)
    young = queue.submit(2, READ)
    assert queue.next_expiry_s() == old.made_s + SUBMIT_EXPIRE_S
    clock.pass_s(4.0)
    assert queue.expire() == [old]
    assert (old.done.is_set(), young.done.is_set(), len(queue)) == (True, False, 1)


class SlowToCount(deque[Ticket]):
    """A queue that is closed by another thread while it is asked how long it is."""

    closer: threading.Thread | None = None

    def __len__(self) -> int:
        closer, self.closer = self.closer, None
        if closer is not None:
            closer.start()
            closer.join(0.05)  # it has to wait for the lock, so that there is no event to wait for
        return super().__len__()


def test_a_ticket_that_comes_while_the_master_stops_is_done_too(clock: JumpingClock) -> None:
    queue, sender = a_queue(clock), Sender()
    closer = threading.Thread(target=queue.close)
    waiting = SlowToCount()
    waiting.closer = closer
    queue._waiting = waiting
    ticket = queue.submit(1, READ, sender)
    closer.join(5.0)
    assert (ticket.done.is_set(), len(sender.told)) == (True, 1)


@pytest.fixture
def hurried() -> Iterator[None]:
    """Threads take turns as often as the interpreter can."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before_s)


@pytest.mark.usefixtures("hurried")
def test_whatever_threads_do_each_ticket_is_done_and_told_once(clock: JumpingClock) -> None:
    """Two send, one takes, one closes in the middle of it; nobody waits for ever."""
    for _ in range(100):
        queue, senders, start = a_queue(clock), [Sender() for _ in range(20)], threading.Barrier(4)
        tickets: list[Ticket] = []

        def send(mine: list[Sender], queue: TicketQueue = queue, start: threading.Barrier = start) -> None:
            start.wait(5.0)
            for sender in mine:
                try:
                    tickets.append(queue.submit(1, READ, sender))  # noqa: B023 - joined before the next round
                except QueueFull:
                    sender.told.append(None)

        def carry_out(queue: TicketQueue = queue, start: threading.Barrier = start) -> None:
            start.wait(5.0)
            for _ in range(15):
                if (ticket := queue.take()) is not None:
                    ticket.finish(None)

        threads = [threading.Thread(target=send, args=(senders[half::2],)) for half in (0, 1)]
        threads.append(threading.Thread(target=carry_out))
        for thread in threads:
            thread.start()
        start.wait(5.0)
        queue.close()
        for thread in threads:
            thread.join(5.0)
        assert all(ticket.done.is_set() for ticket in tickets)
        assert [len(sender.told) for sender in senders] == [1] * 20
