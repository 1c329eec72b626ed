"""Keys of every terminal, and the line editor against a terminal that does what it is told."""

from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gateway.hmi.keys import ENTER, ERASE, ERASE_LINE, ESC, KEYS_MAX, KeyDecoder, LineEditor, Outcome
from gateway.hmi.telnet import TelnetFilter
from tests.modbus import one_by_one, pieces

searched = settings(derandomize=True, deadline=None, max_examples=400)


def keys_of(decoder: KeyDecoder) -> list[str]:
    """Return all the keys that *decoder* has to give."""
    found = []
    while (key := decoder.next_key()) is not None:
        found.append(key)
    return found


def typed(*chunks: bytes) -> list[str]:
    """Return the keys in *chunks*, with a pause behind the last."""
    decoder = KeyDecoder()
    for chunk in chunks:
        decoder.receive(chunk)
    decoder.pause()
    assert not decoder.has_part
    return keys_of(decoder)


# ------------------------------------------------------------------------------------------------ keys


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"m", ["m"]),
        (b"m\rd", ["m", ENTER, "d"]),  # a serial terminal
        (b"m\nd", ["m", ENTER, "d"]),  # a pipe
        (b"m\r\nd", ["m", ENTER, "d"]),  # Windows telnet
        (b"m\r\0d", ["m", ENTER, "d"]),  # RFC 854
        (b"\r\r\n\n", [ENTER, ENTER, ENTER]),
        (b"\r\0\n", [ENTER, ENTER]),
        (b"\n\r", [ENTER, ENTER]),
        (b"\r\n\0\r\0\0", [ENTER, ENTER]),
        (b"\r\x1b\n", [ENTER, ESC, ENTER]),
        (b"\0a\0", ["a"]),
        (b"1\x082\x7f", ["1", ERASE, "2", ERASE]),
        (b"12\x15", ["1", "2", ERASE_LINE]),
        (b"\x03", [ESC]),  # Ctrl-C
        (b"\x01\x02\x07\x09\x0c\x1a\x1f", []),
        ("ñandú €".encode(), ["ñ", "a", "n", "d", "ú", " ", "€"]),
        (b"a\xe9b\xff\xc3c", ["a", "b", "c"]),  # Latin-1, IAC, half a letter
        (b"\xc3\r", [ENTER]),
        (b"\xc2\x9b\xc2\xa0\xe2\x80\xa8", []),  # a C1 control character, a hard space, a line separator
        (b"\xed\xa0\x80\xf5\x80\x80\x80\xc0\xaf", []),  # a surrogate, beyond Unicode, an overlong "/"
        (b"\xf0\x9f\x94\xa5", ["\U0001f525"]),
    ],
)
def test_bytes_are_keys(data: bytes, keys: list[str]) -> None:
    assert typed(data) == keys
    assert typed(*one_by_one(data)) == keys


@pytest.mark.parametrize(
    "sequence",
    [
        b"\x1b[A",  # an arrow
        b"\x1bOA",  # an arrow in application mode
        b"\x1b[3~",  # delete
        b"\x1b[1;5C",  # Ctrl and an arrow
        b"\x1bOP",  # F1
        b"\x1bO5P",  # F1 with Ctrl, as some terminals have it
        b"\x1b[[A",  # F1 on the Linux console
        b"\x1b[24;2~",
        b"\x1b[?1;2c",  # what a terminal says of itself
        b"\x1b[3$b",
    ],
)
def test_arrows_and_function_keys_do_nothing(sequence: bytes) -> None:
    assert typed(b"x" + sequence + b"y" + sequence) == ["x", "y"]
    assert typed(*one_by_one(b"x" + sequence + b"y")) == ["x", "y"]


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"\x1b", [ESC]),
        (b"\x1b\x1b", [ESC, ESC]),
        (b"\x1b\x1b[A", [ESC]),  # Esc, then an arrow
        (b"\x1bm", [ESC, "m"]),  # typed quickly
        (b"\x1b\r", [ESC, ENTER]),
        (b"\x1b\x7f", [ESC, ERASE]),
        (b"\x1b\x03", [ESC, ESC]),
        ("\x1bé".encode(), [ESC, "é"]),
        (b"\x1b\0[A", [ESC, "[", "A"]),  # the telnet filter's Esc: a NUL says that it is whole
        (b"\x1b[\rA", [ENTER, "A"]),  # no key has control characters in its sequence: it is over
        (b"\x1b[1\x1bm", [ESC, "m"]),
        (b"\x1b[\x7f", [ERASE]),
        ("\x1b[é".encode(), ["é"]),
        (b"\x1b[", []),  # a part, then nothing
        (b"\x1b[12", []),
        (b"\x1bO", []),
    ],
)
def test_esc_is_told_from_what_begins_with_it(data: bytes, keys: list[str]) -> None:
    assert typed(data) == keys
    assert typed(*one_by_one(data)) == keys


def test_an_endless_sequence_is_given_up_after_32_characters() -> None:
    assert typed(b"\x1b[" + b"1" * 29 + b"A") == []
    assert typed(b"\x1b[" + b"1" * 30 + b"A") == ["A"]
    assert typed(b"\x1b[" + b"1" * 100) == ["1"] * 70


def test_an_interrupt_of_telnet_is_esc_and_never_half_an_arrow() -> None:
    assert typed(TelnetFilter().receive(b"1\xff\xf4[A")) == ["1", ESC, "[", "A"]


def test_an_esc_waits_for_a_pause_and_then_is_a_key() -> None:
    decoder = KeyDecoder()
    decoder.receive(b"1\x1b")
    assert keys_of(decoder) == ["1"]
    assert decoder.has_part
    decoder.pause()
    assert not decoder.has_part
    decoder.receive(b"[A")
    assert keys_of(decoder) == [ESC, "[", "A"]


def test_half_a_letter_waits_for_a_pause_and_then_is_nothing() -> None:
    decoder = KeyDecoder()
    decoder.receive(b"\xc3")
    assert decoder.has_part
    decoder.pause()
    assert not decoder.has_part
    decoder.receive(b"\xb1a")
    assert keys_of(decoder) == ["a"]


def test_a_pause_within_a_line_end_makes_no_second_one() -> None:
    decoder = KeyDecoder()
    decoder.receive(b"m\r")
    assert not decoder.has_part
    assert keys_of(decoder) == ["m", ENTER]
    decoder.pause()
    decoder.receive(b"\n")
    assert keys_of(decoder) == []


def test_what_is_cleared_was_never_typed() -> None:
    decoder = KeyDecoder()
    decoder.receive(b"yes\r")
    decoder.clear()
    decoder.receive(b"\nno\x1b")  # the LF belongs to the Enter that was forgotten
    assert keys_of(decoder) == ["n", "o"]
    decoder.clear()
    decoder.pause()
    assert keys_of(decoder) == []


def test_of_a_flood_the_first_4096_keys_are_kept() -> None:
    decoder = KeyDecoder()
    decoder.receive(b"ab" * 100_000)
    decoder.receive("ñ".encode())
    assert keys_of(decoder) == ["a", "b"] * (KEYS_MAX // 2)
    decoder.receive(b"c")
    assert keys_of(decoder) == ["c"]


# ------------------------------------------------------------------------------------------------ any keys, any bytes

letters = st.sampled_from(list("m1ñ€\U0001f525 O[~"))
SPELLINGS = {ENTER: [b"\r\n", b"\r\0"], ERASE: [b"\b", b"\x7f"], ERASE_LINE: [b"\x15"], ESC: [b"\x03", b"\x1b\0"]}
NOTHING = [b"", b"", b"\0", b"\x1b[A", b"\x1bOP", b"\x1b[[B", b"\x1b[1;5~", b"\xff", b"\t"]


@st.composite
def sessions(draw: st.DrawFn) -> tuple[list[str], bytes]:
    """Keys, and bytes that some terminal would send for them, other keys in between."""
    keys = draw(st.lists(st.one_of(letters, st.sampled_from(sorted(SPELLINGS))), max_size=20))
    data = b"".join(
        draw(st.sampled_from(SPELLINGS.get(key) or [key.encode()])) + draw(st.sampled_from(NOTHING)) for key in keys
    )
    return keys, data


streams = st.lists(
    st.one_of(st.binary(max_size=6), st.sampled_from([b"\r", b"\n", b"\x1b", b"\x1b[", b"\x1bO", b"\xc3", b"\xb1"])),
    max_size=40,
).map(b"".join)
cuts = st.lists(st.integers(0, 500), max_size=12)


@searched
@given(sessions(), cuts)
def test_what_a_person_types_is_what_arrives(session: tuple[list[str], bytes], cuts: list[int]) -> None:
    keys, data = session
    assert typed(*pieces(data, cuts)) == keys


@searched
@given(streams, cuts)
@example(b"\xe2\x80\r\n", [2, 3])
@example(b"\xf0\x9f\xed\xa0\x80", [1, 3])
def test_any_stream_gives_the_same_keys_however_it_is_cut(stream: bytes, cuts: list[int]) -> None:
    keys = typed(stream)
    assert typed(*pieces(stream, cuts)) == keys
    assert all(len(key) == 1 and (key.isprintable() or key in (ENTER, ERASE, ERASE_LINE, ESC)) for key in keys)


# ------------------------------------------------------------------------------------------------ the line editor

WIDTHS = {"a": 1, "1": 1, " ": 1, "ñ": 1, "\u0301": 0, "漢": 2}  # a letter, an accent of its own, a wide one


class Terminal:
    """One line of a terminal; a wide letter takes two cells, an accent goes into the one before."""

    def __init__(self) -> None:
        self.cells: list[str] = []
        self._at = 0

    def show(self, text: str) -> None:
        for character in text:
            if character == "\b":
                self._at -= 1
                assert self._at >= 0, "the prompt was erased"
            elif width := WIDTHS[character]:
                self.cells[self._at : self._at + width] = [character, *[""] * (width - 1)]
                self._at += width
            elif self._at:
                self.cells[self._at - 1] += character

    @property
    def line(self) -> str:
        """What stands before the cursor; behind it is nothing."""
        assert not "".join(self.cells[self._at :]).strip()
        return "".join(self.cells[: self._at])


def after(*keys: str, limit: int = 8, hidden: bool = False) -> tuple[str, str, Outcome]:
    """Return the text, all that was shown, and what came of the last key."""
    editor, shown, outcome = LineEditor(limit, hidden), "", Outcome.GOING_ON
    for key in keys:
        echo, outcome = editor.key(key)
        shown += echo
    return editor.text, shown, outcome


def test_a_line_is_typed_and_ends_with_enter() -> None:
    assert after(*"107", ENTER) == ("107", "107\r\n", Outcome.DONE)
    assert after(ENTER) == ("", "\r\n", Outcome.DONE)


def test_esc_leaves_the_line_and_shows_nothing() -> None:
    assert after(*"10", ESC) == ("10", "10", Outcome.ESCAPE)


def test_erase_takes_one_character_back_and_nothing_from_an_empty_line() -> None:
    assert after(*"10", ERASE, "7") == ("17", "10\b \b7", Outcome.GOING_ON)
    assert after(ERASE) == ("", "", Outcome.GOING_ON)
    assert after("1", ERASE, ERASE) == ("", "1\b \b", Outcome.GOING_ON)


def test_ctrl_u_takes_the_whole_line_back() -> None:
    assert after(*"107", ERASE_LINE) == ("", "107" + 3 * "\b \b", Outcome.GOING_ON)
    assert after(ERASE_LINE) == ("", "", Outcome.GOING_ON)


def test_the_ninth_character_is_too_much_and_is_not_taken() -> None:
    assert after(*"12345678") == ("12345678", "12345678", Outcome.GOING_ON)
    assert after(*"123456789") == ("12345678", "12345678", Outcome.OVERFLOW)
    assert after(*"12345678", ERASE, "9", ENTER)[::2] == ("12345679", Outcome.DONE)
    assert after(*"a" * 65, limit=64)[2] is Outcome.OVERFLOW


def test_of_a_password_nothing_is_shown_but_the_end_of_its_line() -> None:
    assert after(*"secre", ERASE, ERASE_LINE, *"secret", ERASE, ENTER, hidden=True) == ("secre", "\r\n", Outcome.DONE)
    assert after(*"123456789", hidden=True) == ("12345678", "", Outcome.OVERFLOW)


@pytest.mark.parametrize("key", ["\t", "\0", "\x7f", "\u200b", "\xa0", "", "ab", "\r\n"])
def test_what_is_no_key_is_not_taken(key: str) -> None:
    assert after("1", key) == ("1", "1", Outcome.GOING_ON)
    assert after(*"12345678", key) == ("12345678", "12345678", Outcome.GOING_ON)


def test_an_accent_goes_with_its_letter() -> None:
    assert after("1", "e", "\u0301", ERASE) == ("1", "1e\u0301\b \b", Outcome.GOING_ON)
    assert after("\u0301", ERASE) == ("", "\u0301", Outcome.GOING_ON)


@searched
@given(st.lists(st.sampled_from([*WIDTHS, *WIDTHS, ERASE, ERASE, ERASE_LINE]), max_size=30))
def test_the_screen_shows_what_the_line_is(keys: list[str]) -> None:
    editor, terminal = LineEditor(limit=12), Terminal()
    for key in keys:
        was = editor.text
        echo, outcome = editor.key(key)
        terminal.show(echo)
        assert terminal.line == editor.text.lstrip("\u0301")  # nothing to put it on
        assert len(editor.text) <= 12
        assert outcome is (Outcome.OVERFLOW if len(was) == 12 and key in WIDTHS else Outcome.GOING_ON)
