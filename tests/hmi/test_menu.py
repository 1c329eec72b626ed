"""The menu machine with little dialogues of the test's own: keys to answers, and what is the same on every screen."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.hmi.keys import ENTER, ERASE, ESC
from gateway.hmi.menu import AskKey, Back, Dialogue, ToMainMenu, Ui, seconds_text, whole_number
from tests.hmi.person import Person, asking, person_asked

# ------------------------------------------------------------------------------------------------ one key


def test_a_choice_is_one_key_in_either_case() -> None:
    person, answers = person_asked(lambda ui: ui.key("Which", "ab"))
    assert person.screen == "Which: "
    assert person.type("aB") == "a\nWhich: B\nWhich: "
    assert answers == ["a", "b"]


def test_a_wrong_key_is_told_which_there_are() -> None:
    person, answers = person_asked(lambda ui: ui.key("Which", "aba"))
    assert person.type("x") == "x\nx is no choice here; one of: A B. Esc goes back, ? helps.\nWhich: "
    assert person.type(" ") == " \nSpace is no choice here; one of: A B. Esc goes back, ? helps.\nWhich: "
    assert answers == []


def test_only_a_choice_with_a_default_takes_enter() -> None:
    person, answers = person_asked(lambda ui: ui.key("Which", "ab"))
    assert person.type(ENTER) == "\nWhich: "
    assert answers == []
    person, answers = person_asked(lambda ui: ui.key("Which", "ab", "b"))
    assert person.screen == "Which [b]: "
    person.type(ENTER)
    assert answers == ["b"]


@pytest.mark.parametrize("key", [ERASE, "\x15"])
def test_keys_that_show_nothing_are_no_answer(key: str) -> None:
    person, answers = person_asked(lambda ui: ui.key("Which", "ab"))
    assert person.type(key) == "\nWhich: "
    assert answers == []


def test_esc_goes_back() -> None:
    person, answers = person_asked(lambda ui: ui.key("Which", "ab"))
    assert person.type(ESC) == "\nWhich: "
    assert answers == [Back]


def test_yes_is_y_and_the_letter_of_the_language() -> None:
    answers: list[object] = []
    spanish = {"y": "s"}
    person = Person(asking(lambda ui: ui.confirmed("Sure?"), answers), lambda text: spanish.get(text, text))
    assert person.screen == "Sure? (s/n): "
    person.type("sSyYnN")
    assert answers == [True] * 4 + [False] * 2


# ------------------------------------------------------------------------------------------------ one line


def test_a_line_ends_with_enter_and_loses_spaces_around() -> None:
    person, answers = person_asked(lambda ui: ui.line("Name"))
    assert person.type(" ab " + ENTER) == " ab \nName: "
    assert answers == ["ab"]


def test_enter_alone_keeps_the_default() -> None:
    person, answers = person_asked(lambda ui: ui.line("Name", "boiler"))
    assert person.screen == "Name [boiler]: "
    person.type(ENTER + "  " + ENTER)
    assert answers == ["boiler", "boiler"]


def test_eight_characters_are_taken_and_the_ninth_leads_to_the_main_menu() -> None:
    person, answers = person_asked(lambda ui: ui.line("Value"))
    person.type("12345678" + ENTER)
    assert answers == ["12345678"]
    assert person.type("123456789") == "12345678\nValue: "
    assert answers == ["12345678", ToMainMenu]


def test_the_rest_of_a_line_that_was_too_long_is_no_answer() -> None:
    person, answers = person_asked(lambda ui: ui.line("Value"))
    assert person.type("123456789" + "0123" + ENTER + "7" + ENTER) == "12345678\nValue: 7\nValue: "
    assert answers == [ToMainMenu, "7"]
    person.type("123456789")
    assert person.menu.pause() == ""  # who typed it by hand has stopped
    person.type("5" + ENTER)
    assert answers == [ToMainMenu, "7", ToMainMenu, "5"]


def test_a_prompt_may_have_a_longer_limit() -> None:
    person, answers = person_asked(lambda ui: ui.line("Port", limit=12))
    person.type("123456789012" + ENTER + "1234567890123")
    assert answers == ["123456789012", ToMainMenu]


def test_a_password_is_not_shown_and_keeps_its_spaces() -> None:
    person, answers = person_asked(lambda ui: ui.line("Password", "-", is_hidden=True, limit=64))
    assert person.type(" open sesame " + ERASE + " " + ENTER) == "\nPassword: "
    assert answers == [" open sesame "]


def test_esc_in_a_line_goes_back_and_the_text_is_gone() -> None:
    person, answers = person_asked(lambda ui: ui.line("Value"))
    person.type("12" + ESC + "3" + ENTER)
    assert answers == [Back, "3"]


# ------------------------------------------------------------------------------------------------ numbers and times


def test_a_number_is_asked_for_until_it_is_one() -> None:
    person, answers = person_asked(lambda ui: ui.number("Unit", 1, 247, 17))
    assert person.screen == "Unit (1-247) [17]: "
    told = "Please type a whole number from 1 to 247.\nUnit (1-247) [17]: "
    for wrong in ("0", "248", "x", "1.5", "-1", "0xF8", "\u0663", "0x\u0663", "1_0", "0x", "1e1"):
        assert person.type(wrong + ENTER).endswith(told), wrong
    assert answers == []
    person.type("247" + ENTER + "0x10" + ENTER + "0XF" + ENTER + "007" + ENTER + ENTER)
    assert answers == [247, 16, 15, 7, 17]


def test_seconds_take_a_comma_and_no_nonsense() -> None:
    person, answers = person_asked(lambda ui: ui.seconds("Every", 0.01, 86400, 1.0))
    assert person.screen == "Every [1]: "
    for wrong in ("0", "nan", "inf", "x", "86401", "-1", "0.009"):
        assert "Please type seconds from 0.01 to 86400, such as 0.5." in person.type(wrong + ENTER), wrong
    person.type("0,5" + ENTER + "1e2" + ENTER + ENTER)
    assert answers == [0.5, 100.0, 1.0]


@given(st.floats(0.001, 86400))
def test_enter_keeps_a_time_to_the_last_digit(seconds: float) -> None:
    person, answers = person_asked(lambda ui: ui.seconds("Every", 0.001, 86400, seconds))
    person.type(ENTER)
    assert answers == [seconds]
    assert float(seconds_text(seconds)) == seconds


def test_a_time_is_shown_short() -> None:
    assert [seconds_text(s) for s in (1.0, 0.5, 86400.0, 0.001, 3600.1257)] == [
        "1",
        "0.5",
        "86400",
        "0.001",
        "3600.1257",
    ]


def test_whole_numbers() -> None:
    assert [whole_number(text) for text in ("12", " 12 ", "-3", "0x1F", "")] == [12, 12, -3, 31, None]


# ------------------------------------------------------------------------------------------------ help


def test_help_is_on_every_prompt_and_asks_again() -> None:
    def ask(ui: Ui) -> Dialogue[object]:
        ui.help = "Of this screen.\nIn two lines."
        key = yield from ui.key("Which", "ab")
        return key, (yield from ui.line("Value"))

    person, answers = person_asked(ask)
    keys = "Enter keeps what stands in brackets, Esc goes back, more than 8 characters lead\nto the main menu.\n"
    assert person.type("?") == f"?\nOf this screen.\nIn two lines.\n{keys}Which: "
    assert person.type("a?" + ENTER) == f"a\nValue: ?\nOf this screen.\nIn two lines.\n{keys}Value: "
    person.type("5" + ENTER)
    assert answers == [("a", "5")]


# ------------------------------------------------------------------------------------------------ whole lines


def test_a_terminal_in_line_mode_ends_each_key_with_enter() -> None:
    person, answers = person_asked(lambda ui: ui.key("Which", "ab", "b"))
    person.menu.ends_keys_with_enter = True
    person.type("a" + ENTER + ENTER + "a" + ERASE + "b" + ENTER + "along" + ENTER + " b" + ENTER)
    assert answers == ["a", "b", "b", "a", "b"]


def test_in_line_mode_a_wrong_key_is_forgotten() -> None:
    person, answers = person_asked(lambda ui: ui.key("Which", "ab"))
    person.menu.ends_keys_with_enter = True
    assert person.type("x" + ENTER).endswith("? helps.\nWhich: ")
    person.type("a" + ENTER + "?" + ENTER + "b" + ENTER)
    assert answers == ["a", "b"]


def test_in_line_mode_a_long_line_leads_to_the_main_menu() -> None:
    person, answers = person_asked(lambda ui: ui.key("Which", "ab"))
    person.menu.ends_keys_with_enter = True
    person.type("aaaaaaaaaaaa" + ENTER)
    assert answers == [ToMainMenu]


def test_a_live_display_waits_while_a_line_is_half_typed() -> None:
    def main(ui: Ui) -> Dialogue[None]:
        while True:
            answer = yield AskKey("", "", any_key=True, every_s=1.0)
            ui.say(f"<{answer}>")

    person = Person(main)
    person.menu.ends_keys_with_enter = True
    assert person.pass_s(1.0) == "<None>\n"
    person.type("x")
    assert person.pass_s(5.0) == ""
    assert person.type(ENTER) == "\n<x>\n"
    assert person.pass_s(1.0) == "<None>\n"


# ------------------------------------------------------------------------------------------------ beginning and end


def test_who_leaves_has_left() -> None:
    ends: list[str] = []

    def main(ui: Ui) -> Dialogue[None]:
        try:
            yield from ui.key("Leave", "q")
        finally:
            ends.append("end")

    person = Person(main)
    person.type("q")
    assert person.menu.has_left
    assert ends == ["end"]
    assert person.type("q?" + ENTER + ESC) == ""
    assert (person.pass_s(10.0), person.menu.due_s()) == ("", None)


def test_a_menu_that_is_taken_away_drops_what_was_half_done() -> None:
    answers: list[object] = []
    ends: list[str] = []

    def main(ui: Ui) -> Dialogue[None]:
        try:
            answers.append((yield from ui.line("Value")))
        finally:
            ends.append("end")

    person = Person(main)
    person.type("12")
    person.menu.close()
    person.menu.close()
    assert person.type("3" + ENTER) == ""
    assert (answers, ends, person.menu.has_left) == ([], ["end"], True)


def test_a_terminal_says_how_large_it_is() -> None:
    person, _ = person_asked(lambda ui: ui.key("Which", "a"), rows=40, columns=132)
    assert (person.menu.rows, person.menu.columns) == (40, 132)
    assert (person.ui.rows, person.ui.columns) == (40, 132)


@given(st.text(st.sampled_from("ab?19 " + ENTER + ESC + ERASE + "\x15" + "\u00e9\u4e2d\u0301"), max_size=60))
def test_any_keys_leave_the_machine_working(keys: str) -> None:
    def ask(ui: Ui) -> Dialogue[object]:
        key = yield from ui.key("Which", "ab", "a")
        return key, (yield from ui.number("Value", 1, 9, 5))

    person, answers = person_asked(ask)
    person.type(keys)
    person.menu.pause()
    person.type(ENTER + ESC + ESC)
    before = len(answers)
    person.type("b7" + ENTER)
    assert answers[before:] == [("b", 7)]
