"""The telnet filter: annotated sessions, clients that answer in every way there is, and any bytes at all."""

from __future__ import annotations

import re

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gateway.hmi.telnet import REPLIES_MAX, SUBNEGOTIATION_MAX, TelnetFilter
from tests.modbus import one_by_one, pieces, wire

IAC, SE, SB, WILL, WONT, DO, DONT = 255, 240, 250, 251, 252, 253, 254
AYT, ECHO, SGA, NAWS, LINEMODE = 246, 1, 3, 31, 34
HERE = b"\r\n[rtugate is here]\r\n"
searched = settings(derandomize=True, deadline=None, max_examples=400)


def said(*words: int) -> bytes:
    """Return commands of three bytes each: ``said(WILL, ECHO, DO, NAWS)``."""
    return b"".join(bytes([IAC, verb, option]) for verb, option in zip(words[::2], words[1::2], strict=True))


def window(columns: int, rows: int) -> bytes:
    sizes = columns.to_bytes(2, "big") + rows.to_bytes(2, "big")
    return bytes([IAC, SB, NAWS]) + sizes.replace(b"\xff", b"\xff\xff") + bytes([IAC, SE])


def answers_to(data: bytes) -> bytes:
    """Return what a filter that has just started answers to *data*."""
    telnet = TelnetFilter()
    telnet.receive(data)
    return telnet.replies()


# ------------------------------------------------------------------------------------------------ text


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ("6D 0D 00", "6D 0D 00"),  # m, CR NUL: line ends are left as they are
        ("6D 0D 0A", "6D 0D 0A"),
        ("61 FF FF 62", "61 FF 62"),  # IAC IAC is the byte 255
        ("61 FF F1 62", "61 62"),  # NOP
        ("61 FF F2 62", "61 62"),  # data mark
        ("61 FF F9 62", "61 62"),  # go ahead
        ("61 FF F5 62", "61 62"),  # abort output
        ("61 FF F6 62", "61 62"),  # are you there: answered, not typed
        ("61 FF F0 62", "61 62"),  # SE without SB
        ("61 FF EF 62", "61 62"),  # end of record, which nobody agreed on
        ("61 FF 41 62", "61 62"),  # no command
        ("61 FF F7 62", "61 08 62"),  # erase character is backspace
        ("61 FF F8 62", "61 15 62"),  # erase line is Ctrl-U
        ("FF F4 5B 41", "1B 00 5B 41"),  # interrupt is Esc, and "[A" behind it no arrow
        ("FF F3 5B 41", "1B 00 5B 41"),  # so is break
        ("61 FF FD 01 62", "61 62"),  # DO ECHO
        ("61 FF FB FF 62", "61 62"),  # WILL 255: the option's number is no IAC
        ("61 FF FA 1F 00 50 00 18 FF F0 62", "61 62"),  # a window's size
        ("61 FF FA 18 00 FF FF F0 FF F0 62", "61 62"),  # IAC IAC and an SE that is none within a subnegotiation
        ("61 FF FA 1F 00 50 FF F1 62", "61 62"),  # SE is missing: the next command ends it
        ("61 FF FA 1F 00 50 FF FD 03 62", "61 62"),
        ("61 FF FA 1F FF FA 1F 00 84 00 32 FF F0 62", "61 62"),  # a second one begins within the first
        ("61 FF FA 62 63", "61"),  # and without any, it is not text
    ],
)
def test_commands_are_taken_out_of_the_text_wherever_the_stream_is_cut(data: str, text: str) -> None:
    whole, cut = TelnetFilter(), TelnetFilter()
    assert whole.receive(wire(data)) == wire(text)
    assert b"".join(cut.receive(piece) for piece in one_by_one(wire(data))) == wire(text)


def test_an_0xff_in_our_text_is_doubled() -> None:
    assert TelnetFilter.quoted(b"a\xff\xffb\r\n") == b"a\xff\xff\xff\xffb\r\n"
    assert TelnetFilter().receive(TelnetFilter.quoted(bytes(range(256)))) == bytes(range(256))


# ------------------------------------------------------------------------------------------------ options


def test_the_server_asks_for_characters_and_the_size_of_the_window() -> None:
    assert TelnetFilter().start() == wire("""
        FF FB 01   # WILL ECHO
        FF FB 03   # WILL SUPPRESS-GO-AHEAD
        FF FD 03   # DO SUPPRESS-GO-AHEAD
        FF FD 1F   # DO NAWS
    """)


def test_a_client_that_agrees_to_all_is_answered_nothing() -> None:
    telnet = TelnetFilter()
    assert not telnet.echoes
    telnet.receive(said(DO, ECHO, DO, SGA, WILL, SGA, WILL, NAWS))
    assert telnet.replies() == b""
    assert telnet.echoes
    assert not telnet.refuses_characters


@pytest.mark.parametrize("option", [ECHO, SGA])
def test_a_client_that_refuses_one_of_our_options_edits_lines_itself(option: int) -> None:
    telnet = TelnetFilter()
    assert not telnet.refuses_characters  # it may not have answered yet, or be no telnet client at all
    telnet.receive(said(DONT, option))
    assert telnet.refuses_characters
    assert telnet.replies() == b""


@pytest.mark.parametrize("option", [SGA, NAWS])
def test_what_a_client_does_not_do_itself_says_nothing_of_characters(option: int) -> None:
    telnet = TelnetFilter()
    telnet.receive(said(DO, ECHO, DO, SGA, WONT, option))
    assert not telnet.refuses_characters
    assert telnet.replies() == b""


def test_a_client_may_change_its_mind_and_each_change_is_answered_once() -> None:
    telnet = TelnetFilter()
    telnet.receive(said(DO, ECHO))
    telnet.receive(said(DONT, ECHO, DONT, ECHO))
    assert telnet.replies() == said(WONT, ECHO)
    assert not telnet.echoes
    telnet.receive(said(DO, ECHO, DO, ECHO))
    assert telnet.replies() == said(WILL, ECHO)
    assert telnet.echoes
    assert telnet.replies() == b""  # replies are given once


def test_a_client_that_takes_back_what_it_does_is_answered_with_dont() -> None:
    assert answers_to(said(WILL, SGA, WONT, SGA, WILL, SGA)) == said(DONT, SGA, DO, SGA)


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        (said(WILL, LINEMODE), said(DONT, LINEMODE)),
        (said(DO, LINEMODE), said(WONT, LINEMODE)),
        (said(WILL, ECHO), said(DONT, ECHO)),  # the client would echo to us: the way to a loop
        (said(DO, NAWS), said(WONT, NAWS)),  # we have no window
        (said(DO, 255), said(WONT, 255)),
        (said(WILL, 0, WILL, 0), said(DONT, 0, DONT, 0)),  # each request, each time
        (said(DONT, LINEMODE, WONT, LINEMODE), b""),  # what is not done anyway needs no answer
    ],
)
def test_every_other_option_is_refused(asked: bytes, answer: bytes) -> None:
    assert answers_to(asked) == answer


def test_are_you_there_is_answered() -> None:
    assert answers_to(bytes([IAC, AYT])) == HERE


@pytest.mark.parametrize("storm", [said(WILL, LINEMODE), said(DO, ECHO, DONT, ECHO), bytes([IAC, AYT]), said(DO, 99)])
def test_a_storm_of_requests_has_bounded_answers(storm: bytes) -> None:
    telnet = TelnetFilter()
    telnet.receive(storm * 5000)
    assert 0 < len(telnet.replies()) <= REPLIES_MAX
    telnet.receive(storm)
    assert telnet.replies() != b""  # and is answered again when it is over


def test_refusals_leave_room_for_the_options_that_matter() -> None:
    telnet = TelnetFilter()
    telnet.receive(said(DO, ECHO) + said(WILL, LINEMODE) * 5000 + said(DONT, ECHO))
    assert telnet.replies().endswith(said(WONT, ECHO))
    assert not telnet.echoes


def test_an_option_is_as_we_said_last_even_when_an_answer_had_no_room() -> None:
    telnet = TelnetFilter()
    telnet.receive(said(DO, ECHO) + said(DONT, ECHO, DO, ECHO) * 5000)
    is_on = telnet.replies().endswith(said(WILL, ECHO))
    assert telnet.echoes == is_on


# ------------------------------------------------------------------------------------------------ clients


class Client:
    """A telnet client after RFC 1143 that has *ours* and wants *theirs*; it asks for all of it first."""

    def __init__(self, ours: set[int], theirs: set[int]) -> None:
        self._ours, self._theirs = ours, theirs
        self.on: dict[tuple[int, int], bool] = {}
        self._asked = {(WILL, option) for option in ours} | {(DO, option) for option in theirs}

    def first(self) -> bytes:
        return b"".join(said(*asked) for asked in sorted(self._asked))

    def answer(self, data: bytes) -> bytes:
        """Each command is answered unless it changes nothing, or answers what was asked."""
        answer = b""
        for _, verb, option in zip(*(iter(data),) * 3, strict=True):
            mine = WILL if verb in (DO, DONT) else DO
            side, was = (mine, option), self.on.get((mine, option), False)
            wanted = option in (self._ours if mine == WILL else self._theirs)
            is_on = verb in (DO, WILL) and wanted
            self.on[side] = is_on
            if side in self._asked:
                self._asked.discard(side)
            elif is_on != was or (verb in (DO, WILL) and not wanted):
                refusal = WONT if mine == WILL else DONT
                answer += said(mine if is_on else refusal, option)
        return answer


class Obedient:
    """A client that does not know what it has said: every command is agreed to, again and again."""

    def first(self) -> bytes:
        return b""

    def answer(self, data: bytes) -> bytes:
        agreements = {DO: WILL, DONT: WONT, WILL: DO, WONT: DONT}
        return b"".join(said(agreements[data[at + 1]], data[at + 2]) for at in range(0, len(data), 3))


class Mirror:
    """Not a telnet client at all: something that sends everything back."""

    def first(self) -> bytes:
        return b""

    def answer(self, data: bytes) -> bytes:
        return data


def talk(client: Client | Obedient | Mirror) -> TelnetFilter:
    """Let both answer each other until nobody has anything to say; return our side."""
    telnet = TelnetFilter()
    ours = telnet.start()
    theirs = client.first()
    for _ in range(20):
        theirs += client.answer(ours)
        assert telnet.receive(theirs) == b""
        ours, theirs = telnet.replies(), b""
        if not ours:
            return telnet
    raise AssertionError("they talk for ever")


@pytest.mark.parametrize(
    "client", [Client({SGA, NAWS}, {ECHO, SGA}), Client({SGA, NAWS, 24, 32, 34, 39}, {ECHO, SGA, 5})]
)
def test_a_client_with_all_of_it_gets_character_mode(client: Client) -> None:
    telnet = talk(client)
    assert telnet.echoes
    assert not telnet.refuses_characters
    assert {side for side, is_on in client.on.items() if is_on} == {(WILL, SGA), (WILL, NAWS), (DO, ECHO), (DO, SGA)}


@pytest.mark.parametrize("client", [Client(set(), set()), Client({NAWS}, {SGA}), Client({ECHO}, {ECHO})])
def test_a_client_without_character_mode_is_known_as_such(client: Client) -> None:
    assert talk(client).refuses_characters


def test_a_client_that_agrees_again_and_again_makes_no_loop() -> None:
    assert talk(Obedient()).echoes


def test_a_mirror_makes_no_loop() -> None:
    assert not talk(Mirror()).echoes


@searched
@given(st.sets(st.sampled_from([0, ECHO, SGA, NAWS, LINEMODE])), st.sets(st.sampled_from([0, ECHO, SGA, NAWS])))
def test_both_sides_agree_on_what_is_on(ours: set[int], theirs: set[int]) -> None:
    client = Client(ours, theirs)
    telnet = talk(client)
    assert telnet.echoes == client.on[DO, ECHO] == (ECHO in theirs)
    assert telnet.refuses_characters == (not {ECHO, SGA} <= theirs)


# ------------------------------------------------------------------------------------------------ the window


@pytest.mark.parametrize(
    ("told", "size"),
    [
        (window(132, 50), (132, 50)),
        (window(255, 24), (255, 24)),  # 255 comes doubled
        (window(132, 50) + window(0, 0), (80, 24)),  # the client does not say
        (window(0, 50), (80, 50)),
        (window(1, 1), (40, 10)),
        (window(65535, 65535), (500, 200)),
        (wire("FF FA 1F 00 84 00 FF F0"), (80, 24)),  # a byte short
        (wire("FF FA 1F 00 84 00 32 00 FF F0"), (80, 24)),  # a byte long
        (wire("FF FA 18 00 84 00 32 FF F0"), (80, 24)),  # of another option
        (wire("FF FA FF F0"), (80, 24)),  # of none
        (wire("FF FA 1F 00 84 00 32 FF F1"), (80, 24)),  # not ended, but broken off
        (wire("FF FA 1F 00 84 FF FA 1F 00 64 00 1E FF F0"), (100, 30)),  # broken off by the next
        (wire("FF FA 18 FF FF FF F0") + window(100, 30), (100, 30)),
    ],
)
def test_the_window_is_as_large_as_the_client_says_within_reason(told: bytes, size: tuple[int, int]) -> None:
    for chunks in ([told], one_by_one(told)):
        telnet = TelnetFilter()
        for chunk in chunks:
            telnet.receive(chunk)
        assert (telnet.columns, telnet.rows) == size
        assert telnet.pending == 0


def test_of_an_endless_subnegotiation_little_is_kept_and_the_rest_skipped() -> None:
    telnet = TelnetFilter()
    for _ in range(100):
        assert telnet.receive(bytes([IAC, SB, NAWS]) + b"text" * 1000) == b""
        assert telnet.pending <= SUBNEGOTIATION_MAX
    assert telnet.receive(bytes([IAC, SE]) + b"m") == b"m"
    assert telnet.pending == 0


# ------------------------------------------------------------------------------------------------ any bytes

verbs = st.sampled_from([WILL, WONT, DO, DONT])
commands = st.one_of(
    st.builds(said, verbs, st.sampled_from([ECHO, SGA, NAWS, LINEMODE, SE, IAC])),
    st.builds(lambda command: bytes([IAC, command]), st.integers(235, 255)),
    st.builds(window, st.integers(0, 65535), st.integers(0, 65535)),
    st.binary(max_size=8),
    st.just(b"\r\0"),
)
streams = st.lists(commands, max_size=30).map(b"".join)
cuts = st.lists(st.integers(0, 500), max_size=12)

TOKEN = re.compile(
    rb"""
    \xff\xfa (?: [^\xff] | \xff\xff )* (?: \xff\xf0 | (?=\xff[^\xff]) | \xff?\Z )  # up to SE, a command, the end
    | \xff [\xfb-\xfe] (?: . | \Z )
    | \xff (?: . | \Z )
    """,
    re.DOTALL | re.VERBOSE,
)
TEXTS = {b"\xff\xff": b"\xff", b"\xff\xf4": b"\x1b\0", b"\xff\xf3": b"\x1b\0", b"\xff\xf7": b"\b", b"\xff\xf8": b"\x15"}
ANSWERS = re.compile(rb"(?:\xff[\xfb-\xfe].|" + re.escape(HERE) + rb")*", re.DOTALL)


@searched
@given(streams, cuts)
@example(b"\xff\xfa\xff", [1])
@example(b"\xff", [])
def test_any_stream_is_understood_however_it_is_cut(stream: bytes, cuts: list[int]) -> None:
    telnet, cut = TelnetFilter(), TelnetFilter()
    text = telnet.receive(stream)
    assert text == TOKEN.sub(lambda token: TEXTS.get(token[0], b""), stream)
    assert b"".join(cut.receive(piece) for piece in pieces(stream, cuts)) == text
    assert telnet.pending == cut.pending <= SUBNEGOTIATION_MAX
    assert (telnet.columns, telnet.rows, telnet.echoes) == (cut.columns, cut.rows, cut.echoes)
    replies = telnet.replies()
    assert cut.replies() == replies
    assert len(replies) <= REPLIES_MAX
    assert ANSWERS.fullmatch(replies)
