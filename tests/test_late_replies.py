"""A reply that is still on its way when a line changes hands: to another master, to the same one made anew."""

from __future__ import annotations

import threading

import pytest

from gateway.config import MasterConfig
from gateway.master import Master
from gateway.register import DataRegister
from gateway.transaction import Line, Timing
from tests.fakes import FakeField, JumpingClock, JumpingWaker, ScriptedLink, rtu, words

LATE_S = 1.0
TIMING = Timing(response_timeout_s=2.5)


def a_config(address: int, **keys: object) -> MasterConfig:
    request = {"unit": 17, "function": 3, "address": address, "count": 1, "point": 0}
    return MasterConfig.model_validate({"name": "field", "line": "/dev/ttyS2", "request": [request], **keys})


def stopped_while_it_waits(
    config: MasterConfig, link: ScriptedLink, register: DataRegister, late_s: dict[str, float]
) -> None:
    """Run a master until it has asked its device, and stop it before the reply is there."""
    stop = threading.Event()
    device = link.device

    def asked(frame: bytes) -> list[tuple[float, bytes]]:
        stop.set()
        return device(frame)

    link.device = asked
    Master(config, register, link.clock, JumpingWaker(link.clock), lambda: link, late_s=late_s).run(stop, lambda: None)
    link.device = device


@pytest.fixture
def field(clock: JumpingClock) -> FakeField:
    found = FakeField(clock, answer_after_s=LATE_S)
    found.registers.update({(17, 107): 107, (17, 108): 108})
    return found


def test_a_late_reply_to_the_old_master_never_lands_in_a_poll_of_the_new_one(
    clock: JumpingClock, register: DataRegister, field: FakeField
) -> None:
    link, late_s = ScriptedLink(clock, field), dict[str, float]()
    stopped_while_it_waits(a_config(107), link, register, late_s)
    assert link.arriving  # the reply to 107 is still on its way
    new = Master(a_config(108), register, clock, JumpingWaker(clock), lambda: link, late_s=late_s)
    values = set()
    began_s = clock.monotonic()
    while clock.monotonic() < began_s + 20.0:
        new.step()
        values.add(register.read(new.polls[0].span))
    new.close()
    assert values == {words(0), words(108)}


def test_a_line_that_ends_at_rest_holds_up_nobody(
    clock: JumpingClock, register: DataRegister, field: FakeField
) -> None:
    link, late_s = ScriptedLink(clock, field), dict[str, float]()
    old = Master(a_config(107), register, clock, JumpingWaker(clock), lambda: link, late_s=late_s)
    old.step()
    old.step()
    assert register.read(old.polls[0].span) == words(107)
    old.close()
    began_s = clock.monotonic()
    new = Master(a_config(108), register, clock, JumpingWaker(clock), lambda: link, late_s=late_s)
    new.step()
    new.step()
    new.close()
    assert register.read(new.polls[0].span) == words(108)
    assert clock.monotonic() - began_s < LATE_S + 0.1


def test_a_connection_made_anew_brings_no_late_reply_and_waits_for_none(
    clock: JumpingClock, register: DataRegister
) -> None:
    late_s: dict[str, float] = {}
    link = ScriptedLink(clock, FakeField(clock, "tcp", answer_after_s=LATE_S))
    stopped_while_it_waits(a_config(107, line="tcp://10.0.0.1"), link, register, late_s)
    assert late_s == {}


def test_a_line_tells_until_when_a_late_reply_may_come(clock: JumpingClock) -> None:
    link = ScriptedLink(clock, lambda frame: [])
    line = Line(link, "rtu", TIMING, clock)
    assert line.late_until_s == 0.0
    line.read_holding_registers(17, 107, 1)
    asked_s = clock.monotonic()
    assert line.state.value == "awaiting reply"
    assert line.late_until_s == asked_s + 5.0  # the reply is due within 2.5 s, and listened for as long again
    line.advance(2.5)
    assert line.state.value == "spoiled"
    assert line.late_until_s == asked_s + 5.0
    line.advance(2.5)
    assert line.late_until_s == 0.0


def test_a_line_begun_as_spoiled_throws_away_what_comes_and_sends_afterwards(clock: JumpingClock) -> None:
    link = ScriptedLink(clock, lambda frame: [(0.01, rtu(17, bytes([3, 2]) + words(108)))])
    link.arriving.append((clock.monotonic() + 1.0, rtu(17, bytes([3, 2]) + words(107))))
    line = Line(link, "rtu", TIMING, clock, late_until_s=clock.monotonic() + 3.0)
    began_s = clock.monotonic()
    line.read_holding_registers(17, 108, 1)
    while (response := line.advance(1.0)) is None:
        pass
    assert response.register(0) == 108
    assert link.written[0][0] >= began_s + 3.0
