"""What the menu machine shows, and how it waits: lists, wide lines, live pages, jobs."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.hmi.keys import ENTER, ESC
from gateway.hmi.menu import TYPED_AHEAD_MOST, AskKey, AskLine, Back, Dialogue, Menu, Ui
from gateway.plain_text import printable
from tests.fakes import JumpingClock
from tests.hmi.person import Main, Person, person_asked

# ------------------------------------------------------------------------------------------------ lists


def names(count: int) -> list[str]:
    return [f"line-{n} (/dev/ttyS{n})" for n in range(1, count + 1)]


def test_one_name_is_no_choice() -> None:
    person = Person(lambda ui: _said(ui, ui.choice("Which", names(1))))
    assert person.screen == "0\n"


def _said(ui: Ui, dialogue: Dialogue[int]) -> Dialogue[None]:
    ui.say(str((yield from dialogue)))


@pytest.mark.parametrize(("count", "key", "place"), [(2, "2", 1), (12, "c", 11), (35, "z", 34), (35, "Z", 34)])
def test_up_to_35_names_have_a_key_each(count: int, key: str, place: int) -> None:
    person, answers = person_asked(lambda ui: ui.choice("Which", names(count)))
    assert person.screen.count("\n") <= 22
    assert all(name in person.screen for name in names(count))
    person.type(key)
    assert answers == [place]


def test_more_than_35_are_chosen_by_the_first_word_of_their_name() -> None:
    person, answers = person_asked(lambda ui: ui.choice("Which", names(36)))
    assert person.screen.endswith("Which, its name: ")
    person.type("line-37" + ENTER + "1" + ENTER)
    assert answers == []
    assert "There is none of that name." in person.screen
    person.type("line-36" + ENTER)
    assert answers == [35]


def test_long_lists_come_a_screenful_at_a_time_and_esc_leads_out() -> None:
    lines = [f"line {n}" for n in range(30)]
    person, answers = person_asked(lambda ui: ui.listed(lines), rows=16)
    for first in (0, 10):
        shown = "\n".join(lines[first : first + 10])
        assert person.screen.endswith(f"{shown}\nAny key: more. Esc: back.")
        assert answers == []
        person.type(" ")
    assert answers == [None]
    person.type(ESC)
    assert answers == [None, Back]


# ------------------------------------------------------------------------------------------------ what is shown


def saying(*lines: str) -> Main:
    def main(ui: Ui) -> Dialogue[None]:
        ui.say(*lines)
        yield AskKey("> ", "q")

    return main


def test_what_is_wider_than_the_terminal_goes_on_below() -> None:
    text = "word " * 30
    shown = Person(saying(text), columns=40).screen.splitlines()
    assert " ".join(shown[:-1]).split() == text.split()
    assert max(map(len, shown)) == 39


def test_paths_are_not_broken_at_their_hyphens() -> None:
    path = "/dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A50285BI-if00-port0"
    person, answers = person_asked(lambda ui: ui.line("Port or address", path, limit=255))
    assert person.screen == f"Port or address\n[{path}]: "
    person.type(ENTER)
    assert answers == [path]


def test_what_cannot_be_printed_is_escaped_before_it_is_measured() -> None:
    shown = Person(saying("a\x1b[2J\u009b\r\x07b", "\x00" * 60, "two\nlines")).screen
    assert shown.startswith("a\\x1b[2J\\x9b\\r\\x07b\n")
    assert shown.endswith("\ntwo\nlines\n> ")
    assert max(map(len, shown.splitlines())) < 80
    assert printable("caf\u00e9 \u202e") == "caf\u00e9 \\u202e"


def test_accents_are_left_out_where_the_terminal_has_none() -> None:
    ui = Ui(JumpingClock())
    menu = Menu(saying("Configuraci\u00f3n de l\u00ednea"), ui, is_ascii=lambda: True)
    assert menu.start() == "Configuracion de linea\n> "


def test_a_terminal_that_echoes_by_itself_is_not_echoed() -> None:
    person, answers = person_asked(lambda ui: ui.line("Value"))
    person.menu.echoes = False
    assert person.type("12" + ENTER) == "\nValue: "
    person.menu.ends_keys_with_enter = True  # then its Enter has begun a new line already
    assert person.type("34" + ENTER) == "Value: "
    assert answers == ["12", "34"]


# ------------------------------------------------------------------------------------------------ pages


def paged(head: list[str], rows: list[str], hint: str = "Any key: back.") -> Main:
    def main(ui: Ui) -> Dialogue[None]:
        while True:
            ui.say((yield from ui.pages(lambda: (list(head), list(rows)), hint)))

    return main


@given(st.integers(10, 200), st.integers(0, 3), st.integers(0, 500), st.lists(st.sampled_from("+- "), max_size=8))
def test_a_page_is_as_tall_as_the_terminal(height: int, heads: int, count: int, keys: list[str]) -> None:
    rows = [f"row {n} " + "x" * 100 for n in range(count)]
    person = Person(paged(["head"] * heads, rows, "hint" * 30), rows=height)
    shown = person.screen
    for key in keys if count > height - heads - 1 else []:
        shown = person.type(key)
    picture = shown.split("\n")[1:]
    assert len(picture) == height
    assert picture[:heads] == ["head"] * heads
    assert max(map(len, picture)) < 80


def test_turning_pages_goes_round() -> None:
    person = Person(paged(["head"], [f"row {n}" for n in range(20)]), rows=10)
    seen = [person.screen] + [person.type(key) for key in "+ + -"]
    assert [shown.split("\n")[2] for shown in seen] == ["row 0", "row 8", "row 16", "row 0", "row 8", "row 0"]
    assert seen[0].endswith("page 1 of 3, + and - turn.  Any key: back.")


def test_a_page_is_drawn_anew_only_when_something_has_changed() -> None:
    rows = ["a"]
    person = Person(paged(["head"], rows))
    assert person.pass_s(1.0) == ""
    rows[0] = "b"
    assert person.pass_s(0.5) == ""  # not due yet
    assert "\nb\n" in person.pass_s(0.5)


def test_a_page_that_has_gone_shows_the_last_there_is() -> None:
    rows = [f"row {n}" for n in range(40)]
    person = Person(paged(["head"], rows), rows=10)
    person.type("-")
    del rows[12:]
    assert "page 2 of 2" in person.pass_s(1.0)
    rows.clear()
    assert person.pass_s(1.0).endswith("\nAny key: back.")


def test_with_one_page_the_turning_keys_are_like_any_other() -> None:
    person = Person(paged([], ["row"]))
    assert person.type("+").startswith("\n+\n")


# ------------------------------------------------------------------------------------------------ waiting


def waiting(is_done: Callable[[], bool]) -> tuple[Person, list[object]]:
    answers: list[object] = []

    def main(ui: Ui) -> Dialogue[None]:
        try:
            answers.append((yield from ui.wait_for(is_done, 60.0)))
        except Back:
            answers.append(Back)
        while True:
            answers.append((yield AskLine("next: ")))

    return Person(main), answers


def test_what_is_done_already_is_not_waited_for() -> None:
    person, answers = waiting(lambda: True)
    assert (answers, person.menu.is_busy, person.menu.due_s()) == ([True], False, None)


def test_a_job_that_is_done_ends_the_waiting() -> None:
    done: list[bool] = []
    person, answers = waiting(lambda: bool(done))
    assert person.menu.is_busy
    assert person.menu.due_s() == person.clock.monotonic() + 60.0
    assert person.pass_s(59.0) == ""
    done.append(True)
    assert person.pass_s(0.0) == "next: "
    assert answers == [True]


def test_nothing_is_waited_for_for_ever() -> None:
    person, answers = waiting(lambda: False)
    assert person.pass_s(60.0) == "next: "
    assert answers == [False]


def test_keys_typed_meanwhile_are_taken_afterwards() -> None:
    done: list[bool] = []
    person, answers = waiting(lambda: bool(done))
    assert person.type("12" + ENTER + "3") == ""
    done.append(True)
    assert person.pass_s(0.0) == "next: 12\nnext: 3"
    assert answers == [True, "12"]


def test_no_more_keys_are_kept_than_a_person_types() -> None:
    done: list[bool] = []
    person, answers = waiting(lambda: bool(done))
    person.type(ENTER * (TYPED_AHEAD_MOST + 50))
    done.append(True)
    person.pass_s(0.0)
    assert answers == [True] + [""] * TYPED_AHEAD_MOST


def test_esc_ends_the_waiting_and_forgets_what_was_typed() -> None:
    answers: list[object] = []

    def main(ui: Ui) -> Dialogue[None]:
        while True:
            try:
                answers.append((yield from ui.wait_for(lambda: False, 60.0)))
            except Back:
                answers.append(Back)
            answers.append((yield AskLine("next: ")))

    person = Person(main)
    person.type("12" + ENTER)
    assert person.type(ESC) == "next: "
    person.type("3" + ENTER)
    assert person.pass_s(60.0) == "next: "  # and nothing is typed there
    assert answers == [Back, "3", False]
