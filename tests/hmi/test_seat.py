"""Who has the menu (spec section 5: serial before `rtugate menu` before telnet), on a clock that jumps."""

from __future__ import annotations

import threading

import hypothesis.strategies as st
from hypothesis import given

from gateway.hmi.seat import SERIAL_LEAST_S, Person, Rank, Seat
from tests.fakes import JumpingClock

HOLD_S = 30.0


class Room:
    """A seat, its clock, and who was woken."""

    def __init__(self, hold_s: float = HOLD_S) -> None:
        self.clock = JumpingClock()
        self.hold_s = hold_s
        self.seat = Seat(self.clock, lambda: self.hold_s)
        self.woken: list[str] = []

    def person(self, who: str, rank: Rank = Rank.TELNET) -> Person:
        return Person(who, rank, lambda: self.woken.append(who))

    def entered(self, who: str, rank: Rank = Rank.TELNET) -> Person:
        person = self.person(who, rank)
        self.seat.enter(person)
        return person

    def serial(self) -> Person:
        return self.person("serial console", Rank.SERIAL)

    def has(self, person: Person) -> bool:
        return self.seat.standing(person).has_menu


def test_without_a_serial_console_telnet_has_the_menu_at_once() -> None:
    room = Room(hold_s=0.0)
    assert room.has(room.entered("a"))


def test_telnet_waits_for_the_serial_console_from_the_start_of_the_program_on() -> None:
    room = Room()
    room.clock.pass_s(10)
    telnet = room.entered("a")
    assert room.seat.standing(telnet).wait_s == HOLD_S - 10
    room.clock.pass_s(HOLD_S - 10 - 0.001)
    assert not room.has(telnet)
    room.clock.pass_s(0.001)
    assert room.has(telnet)


def test_somebody_who_comes_after_the_hold_time_waits_for_nothing() -> None:
    room = Room()
    room.clock.pass_s(HOLD_S)
    assert room.has(room.entered("a"))
    assert room.seat.holder is not None


def test_any_serial_character_takes_the_menu_and_starts_the_hold_time_anew() -> None:
    room = Room(hold_s=HOLD_S)
    room.clock.pass_s(HOLD_S)
    telnet, serial = room.entered("a"), room.serial()
    room.seat.take(serial)
    assert room.has(serial)
    assert not room.has(telnet)
    assert room.woken == ["a"]
    room.clock.pass_s(HOLD_S - 1)
    room.seat.take(serial)
    room.clock.pass_s(HOLD_S - 1)
    standing = room.seat.standing(telnet)
    assert (standing.holder, standing.wait_s, standing.turn) == (serial, 1.0, 0)


def test_a_silent_serial_person_keeps_the_menu_until_somebody_waits() -> None:
    room = Room()
    serial = room.serial()
    room.seat.take(serial)
    room.clock.pass_s(1000)
    assert room.has(serial)
    telnet = room.entered("a")
    assert room.has(telnet)
    assert not room.has(serial)
    assert room.woken == ["serial console"]


def test_time_alone_gives_the_menu_to_who_waits_and_wakes_the_serial_console() -> None:
    room = Room()
    serial, telnet = room.serial(), room.entered("a")
    room.seat.take(serial)
    room.woken.clear()
    room.clock.pass_s(HOLD_S)
    assert room.has(telnet)
    assert room.woken == ["serial console"]


def test_a_serial_person_who_leaves_still_keeps_the_menu_free_for_the_hold_time() -> None:
    room = Room()
    serial, telnet = room.serial(), room.entered("a")
    room.seat.take(serial)
    room.seat.leave(serial)
    standing = room.seat.standing(telnet)
    assert (standing.holder, standing.wait_s) == (None, HOLD_S)
    room.clock.pass_s(HOLD_S)
    assert room.has(telnet)


def test_a_hold_time_of_zero_leaves_a_serial_person_time_to_press_a_second_key() -> None:
    room = Room(hold_s=0.0)
    telnet, serial = room.entered("a"), room.serial()
    assert room.has(telnet)
    room.seat.take(serial)
    assert room.has(serial)
    assert room.seat.standing(telnet).wait_s == SERIAL_LEAST_S
    room.clock.pass_s(SERIAL_LEAST_S)
    assert room.has(telnet)


def test_within_a_rank_it_is_first_come_first_served_and_each_knows_his_place() -> None:
    room = Room(hold_s=0.0)
    first, second, third = room.entered("a"), room.entered("b"), room.entered("c")
    assert [room.seat.standing(p).ahead for p in (second, third)] == [0, 1]
    assert room.seat.standing(third).holder is first
    assert room.seat.standing(third).wait_s is None
    room.woken.clear()
    room.seat.leave(first)
    assert sorted(room.woken) == ["b", "c"]
    assert room.has(second)
    room.seat.leave(third)
    assert room.seat.standing(third).turn == 0


def test_the_local_menu_takes_it_from_telnet_at_once_but_not_from_another_local_one() -> None:
    room = Room(hold_s=0.0)
    telnet = room.entered("a")
    assert room.has(telnet)
    local = room.entered("b", Rank.LOCAL)
    assert room.has(local)
    assert not room.has(telnet)
    assert room.woken == ["a"]
    assert not room.has(room.entered("c", Rank.LOCAL))
    assert room.seat.standing(telnet).ahead == 1


def test_the_local_menu_waits_for_the_serial_console_as_telnet_does_and_goes_before_it() -> None:
    room = Room()
    telnet, local = room.entered("a"), room.entered("b", Rank.LOCAL)
    assert not room.has(local)
    assert room.seat.standing(telnet).ahead == 1
    room.clock.pass_s(HOLD_S)
    assert room.has(local)


def test_who_loses_the_menu_keeps_his_place_in_the_queue() -> None:
    room = Room()
    room.clock.pass_s(HOLD_S)
    first, second, serial = room.entered("a"), room.entered("b"), room.serial()
    room.seat.take(serial)
    room.clock.pass_s(HOLD_S)
    assert not room.has(second)
    assert room.has(first)


def test_each_turn_has_its_own_number_so_that_a_loss_nobody_noticed_shows() -> None:
    room = Room()
    room.clock.pass_s(HOLD_S)
    telnet, serial = room.entered("a"), room.serial()
    before = room.seat.standing(telnet).turn
    room.seat.take(serial)
    room.clock.pass_s(HOLD_S)
    assert room.seat.standing(telnet).turn > before


def test_a_person_at_rest_has_no_turn_and_may_leave_without_harm() -> None:
    room = Room()
    serial = room.serial()
    room.seat.leave(serial)
    assert not room.has(serial)
    assert room.seat.holder is None


def test_nobody_is_woken_when_nothing_changes() -> None:
    room = Room()
    telnet, serial = room.entered("a"), room.serial()
    room.seat.take(serial)
    room.woken.clear()
    for _ in range(3):
        room.seat.take(serial)
        room.has(telnet)
    assert room.woken == []


def test_the_others_are_woken_after_the_lock_is_let_go_of() -> None:
    room = Room()
    asked = []
    telnet = Person("a", Rank.TELNET, lambda: asked.append(room.seat.standing(telnet).has_menu))
    room.seat.enter(telnet)
    done = threading.Thread(target=lambda: room.seat.take(room.serial()))
    done.start()
    done.join(5)
    assert asked == [False]


steps = st.lists(
    st.tuples(st.sampled_from(["enter", "leave", "take", "ask", "pass"]), st.integers(0, 5), st.floats(0, 40)),
    max_size=60,
)


@given(steps, st.sampled_from([0.0, 30.0]))
def test_whatever_happens_there_is_one_holder_at_most_and_no_lower_rank_before_a_higher_one(
    story: list[tuple[str, int, float]], hold_s: float
) -> None:
    room = Room(hold_s)
    people = [room.person(str(n), Rank.LOCAL if n < 2 else Rank.TELNET) for n in range(5)] + [room.serial()]
    present: list[Person] = []
    for step, number, seconds in story:
        person = people[number]
        if step == "pass":
            room.clock.pass_s(seconds)
        elif step == "leave":
            room.seat.leave(person)
            present = [p for p in present if p is not person]
        elif step == "take":
            room.seat.take(people[-1])
        elif step == "enter" and person.rank is not Rank.SERIAL and person not in present:
            room.seat.enter(person)
            present.append(person)
        holders = [p for p in people if room.has(p)]
        assert len(holders) <= 1
        for holder in holders:
            assert holder.rank is Rank.SERIAL or all(p.rank <= holder.rank for p in present)
    room.clock.pass_s(max(hold_s, SERIAL_LEAST_S))
    serial_has = room.has(people[-1])
    assert [p for p in present if room.has(p)] or not present
    assert not serial_has or not present
