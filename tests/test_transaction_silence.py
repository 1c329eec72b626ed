"""A line between requests: spoiled, silent, after a broadcast; and the table of its states."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import pytest

from gateway.errors import LinkLost, RequestInvalid
from gateway.modbus.pdu import MaskWriteRequest, WriteRequest
from gateway.transaction import DAMAGED, NEXT, NO_ERROR, TIMEOUT, Event, Line, State, Timing
from tests.fakes import JumpingClock, rtu, tcp, words
from tests.line_bench import (
    ANSWER,
    CHARACTER_S,
    READ,
    SERIAL,
    SILENCE_S,
    UNIT,
    Framing,
    Script,
    bench,
    framed,
    reply,
    wrong_sum,
)

# ------------------------------------------------------------------------------------------------ spoiled


@SERIAL
def test_after_a_timeout_the_line_listens_for_one_reply_time_before_it_sends(
    clock: JumpingClock, framing: Framing
) -> None:
    it = bench(clock, framing, [], reply(framing))
    assert it.ask().error_code == TIMEOUT
    sent_bytes = len(it.link.written[0][1])
    gave_up_s = 1000.0 + sent_bytes * CHARACTER_S + 2.5
    assert clock.monotonic() == gave_up_s
    assert it.line.state is State.SPOILED
    assert not it.line.is_free
    assert it.ask().data == words(555, 0, 100)
    assert it.sent_s == [1000.0, gave_up_s + 2.5]


def test_after_damage_the_line_listens_for_one_reply_time_behind_the_one_that_was_awaited(clock: JumpingClock) -> None:
    good = rtu(UNIT, ANSWER)
    it = bench(clock, "rtu", [(0.5, wrong_sum(good, "rtu"))], reply("rtu"))
    assert it.ask().error_code == DAMAGED
    damaged_s = 1000.0 + 8 * CHARACTER_S + 0.5 + 0.25  # the rest of a reply might still have come: character timeout
    assert clock.monotonic() == damaged_s
    it.ask()
    assert it.sent_s[1] == 1000.0 + 8 * CHARACTER_S + 2.5 + 2.5


def test_after_damage_at_the_last_moment_it_listens_for_one_reply_time_from_then(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", [(2.375, rtu(UNIT, ANSWER)[:5])], reply("rtu"))
    assert it.ask().error_code == DAMAGED
    damaged_s = 1000.0 + 8 * CHARACTER_S + 2.375 + 0.25
    assert clock.monotonic() == damaged_s
    it.ask()
    assert it.sent_s[1] == damaged_s + 2.5


@pytest.mark.parametrize("damage", ["wrong CRC", "noise before", "more bytes behind"])
def test_a_late_reply_never_lands_in_the_next_request_though_damage_came_in_time(
    clock: JumpingClock, damage: str
) -> None:
    """The damage comes early; the true reply any time later, up to just before the end of the listening."""
    good = rtu(UNIT, ANSWER)
    early = {"wrong CRC": wrong_sum(good, "rtu"), "noise before": good[:4], "more bytes behind": good + b"\x00"}[damage]
    for late_s in [i / 16 for i in range(12, 80)]:
        late = rtu(UNIT, b"\x03\x06" + words(9, 9, 9))
        it = bench(clock, "rtu", [(0.25, early), (late_s, late)], reply("rtu", at_s=1.0), reply("rtu"))
        assert it.ask().error_code == DAMAGED
        assert it.ask().data == words(555, 0, 100)
        assert it.ask().data == words(555, 0, 100)


@SERIAL
def test_a_late_reply_is_thrown_away_and_its_silence_kept(clock: JumpingClock, framing: Framing) -> None:
    late = framed(framing, UNIT, bytes.fromhex("03 06 0001 0002 0003"), 0)
    it = bench(clock, framing, [(4.9990234375, late)], reply(framing))  # one character before listening ends
    assert it.ask().error_code == TIMEOUT
    assert it.ask().data == words(555, 0, 100)
    sent_bytes = len(it.link.written[0][1])
    heard_s = 1000.0 + sent_bytes * CHARACTER_S + 4.9990234375
    assert it.sent_s[1] == heard_s + SILENCE_S


def test_a_spoiled_line_becomes_free_by_itself(clock: JumpingClock) -> None:
    it = bench(clock, "rtu")
    it.ask()
    gave_up_s = clock.monotonic()
    while not it.line.is_free:
        assert it.line.advance(1.0) is None
    assert clock.monotonic() == gave_up_s + 2.5


def test_a_request_with_its_own_timeout_waits_and_listens_for_that_long(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", [], reply("rtu"))
    it.line.send(UNIT, READ, timeout_s=0.5)
    assert it.result().error_code == TIMEOUT
    assert clock.monotonic() == 1000.0 + 8 * CHARACTER_S + 0.5
    it.ask()
    assert it.sent_s[1] == 1000.0 + 8 * CHARACTER_S + 1.0


def test_tcp_sends_on_at_once_and_the_late_answer_is_known_by_its_transaction(clock: JumpingClock) -> None:
    old = ANSWER.replace(b"\x02\x2b", b"\x09\x09")
    it = bench(clock, "tcp", reply("tcp", old, at_s=2.75), reply("tcp", at_s=0.5))
    assert it.ask().error_code == TIMEOUT
    assert it.line.is_free
    assert it.ask().data == words(555, 0, 100)
    assert it.sent_s == [1000.0, 1002.5]
    assert [frame[:2] for _, frame in it.link.written] == [b"\x00\x01", b"\x00\x02"]


@pytest.mark.parametrize("cut", range(1, 15))
def test_half_of_a_late_reply_on_tcp_keeps_the_frames_in_step(clock: JumpingClock, cut: int) -> None:
    """The first bytes come before the line gives up, the rest before the next request is sent."""
    late = tcp(1, UNIT, ANSWER.replace(b"\x02\x2b", b"\x09\x09"))
    it = bench(clock, "tcp", [(2.25, late[:cut]), (3.0, late[cut:])], reply("tcp"), reply("tcp"))
    assert it.ask().error_code in (TIMEOUT, DAMAGED)
    assert it.line.advance(0.5) is None
    assert it.ask().data == words(555, 0, 100)
    assert it.ask().data == words(555, 0, 100)


@pytest.mark.parametrize("cut", range(1, 15))
def test_the_rest_of_a_late_reply_after_the_next_request_on_tcp_never_gives_a_wrong_value(
    clock: JumpingClock, cut: int
) -> None:
    """What cannot be told apart any more ends the connection; the master makes a new one."""
    late = tcp(1, UNIT, ANSWER.replace(b"\x02\x2b", b"\x09\x09"))
    it = bench(clock, "tcp", [(2.25, late[:cut]), (3.0, late[cut:])], reply("tcp", at_s=1.0), reply("tcp"))
    assert it.ask().error_code in (TIMEOUT, DAMAGED)
    try:
        responses = [it.ask(), it.ask()]
    except LinkLost:
        return
    assert all(response.has_error() or response.data == words(555, 0, 100) for response in responses)


def test_a_late_answer_on_an_idle_tcp_connection_keeps_the_frames_in_step(clock: JumpingClock) -> None:
    whole = tcp(1, UNIT, ANSWER)
    it = bench(clock, "tcp", [(3.0, whole[:5]), (3.5, whole[5:] + whole[:3]), (4.0, whole[3:])], reply("tcp"))
    assert it.ask().error_code == TIMEOUT
    for _ in range(5):
        assert it.line.advance(0.5) is None
    assert it.ask().data == words(555, 0, 100)


def test_transaction_identifiers_go_round_after_65535(clock: JumpingClock) -> None:
    it = bench(clock, "tcp", *[reply("tcp", at_s=0.0)] * 65537)
    seen = [it.ask().error_code for _ in range(65537)]
    assert set(seen) == {NO_ERROR}
    assert [frame[:2] for _, frame in it.link.written[65534:]] == [b"\xff\xff", b"\x00\x00", b"\x00\x01"]


def test_any_late_answer_never_lands_in_another_request(clock: JumpingClock) -> None:
    """Reply k says k; replies come at any time up to just before the end of the listening."""
    for late_s in [i / 16 for i in range(1, 80)]:
        say: list[Callable[[int], Script] | Script] = [
            [(late_s if k % 2 == 0 else 0.25, rtu(UNIT, b"\x03\x06" + words(k, k, k)))] for k in range(6)
        ]
        it = bench(clock, "rtu", *say)
        for k in range(6):
            response = it.ask()
            assert response.has_error() or response.register(0) == k


# ------------------------------------------------------------------------------------------------ silence


def test_between_reply_and_next_request_there_are_three_and_a_half_characters(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", reply("rtu"), reply("rtu"))
    it.ask()
    it.ask()
    assert it.sent_s[1] == 1000.0 + 8 * CHARACTER_S + 0.5 + SILENCE_S


def test_the_delay_of_the_line_is_kept_too(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", reply("rtu"), reply("rtu"), timing=Timing(2.5, 0.25, SILENCE_S, 0.25, 0.125, CHARACTER_S))
    it.ask()
    it.ask()
    assert it.sent_s == [1000.0, 1000.0 + 8 * CHARACTER_S + 0.5 + SILENCE_S + 0.25]


def test_stray_bytes_on_an_idle_line_begin_the_silence_anew(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", reply("rtu"))
    it.link.arriving = [(1000.5, b"\x00"), (1000.5 + 2 * CHARACTER_S, b"\x00")]
    assert it.line.advance(0.5) is None
    it.line.send(UNIT, READ)
    assert it.link.written == []
    assert it.line.state is State.HELD_BACK
    assert it.result().data == words(555, 0, 100)
    assert it.sent_s == [1000.5 + 2 * CHARACTER_S + SILENCE_S]


def test_a_line_silent_long_enough_sends_at_once(clock: JumpingClock) -> None:
    it = bench(clock, "rtu", reply("rtu"), reply("rtu"))
    it.ask()
    clock.pass_s(1.0)
    asked_s = clock.monotonic()
    it.ask()
    assert it.sent_s[1] == asked_s


def test_a_line_that_is_never_silent_is_damaged_and_nothing_is_sent_into_it(clock: JumpingClock) -> None:
    it = bench(clock, "rtu")
    it.link.arriving = [(1000.0 + i * CHARACTER_S, b"\x00") for i in range(8192)]
    it.line.advance(0.0)
    response = it.ask()
    assert (response.error_code, response.reason) == (DAMAGED, "the line is never silent")
    assert clock.monotonic() == 1002.5
    assert it.link.written == []
    assert it.line.is_free


# ------------------------------------------------------------------------------------------------ broadcast


@SERIAL
def test_a_broadcast_is_over_after_the_turnaround_whatever_is_said_meanwhile(
    clock: JumpingClock, framing: Framing
) -> None:
    it = bench(clock, framing, [(0.0625, framed(framing, 0, b"\x06\x00\x01\x00\x03", 0))])
    assert it.line.write_single_register(0, 1, 3)
    assert it.line.state is State.TURNAROUND
    response = it.result()
    sent_bytes = len(it.link.written[0][1])
    assert clock.monotonic() == 1000.0 + sent_bytes * CHARACTER_S + 0.125
    assert (response.unit, response.error_code) == (0, NO_ERROR)
    assert it.line.is_free


def test_a_broadcast_only_writes(clock: JumpingClock) -> None:
    it = bench(clock, "rtu")
    with pytest.raises(RequestInvalid):
        it.line.send(0, READ)
    with pytest.raises(RequestInvalid):
        it.line.send(0, MaskWriteRequest(1, 2, 3))
    assert it.line.send(0, WriteRequest(16, 1, 2, words(1, 2)))


def test_on_tcp_unit_0_is_a_device_that_answers(clock: JumpingClock) -> None:
    it = bench(clock, "tcp", reply("tcp", unit=0))
    assert it.ask(unit=0).data == words(555, 0, 100)


# ------------------------------------------------------------------------------------------------ the table


def test_every_step_of_a_lines_life_is_taken_and_no_other(clock: JumpingClock, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: set[tuple[State, Event]] = set()
    inner = Line._pass

    def note(line: Line, event: Event) -> None:
        taken.add((line.state, event))
        inner(line, event)

    monkeypatch.setattr(Line, "_pass", note)
    good = rtu(UNIT, ANSWER)
    it = bench(
        clock, "rtu", reply("rtu"), [], [(0.5, wrong_sum(good, "rtu"))], [(0.5, good), (0.5 + CHARACTER_S, b"x")]
    )
    for _ in range(4):
        it.ask()
    it.line.write_single_register(0, 1, 3)
    it.result()
    it.link.arriving = [(clock.monotonic() + i * CHARACTER_S, b"\x00") for i in range(8192)]
    it.line.advance(0.0)
    it.ask()
    assert taken == {(state, event) for state, events in NEXT.items() for event in events}


def test_what_the_table_does_not_foresee_is_a_bug_that_shows(clock: JumpingClock) -> None:
    for state, event in product(State, Event):
        line = bench(clock, "rtu").line
        line.state = state
        if event in NEXT[state]:
            line._pass(event)
            assert line.state is NEXT[state][event]
        else:
            with pytest.raises(KeyError):
                line._pass(event)
