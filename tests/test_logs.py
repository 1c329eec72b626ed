"""What is logged: safe for a terminal, whole tracebacks, and a ring that never grows."""

from __future__ import annotations

import io
import logging
import threading
from collections.abc import Iterator

import pytest

from gateway.logs import KEPT, LONGEST, LogRing, SafeFormatter


@pytest.fixture
def logger() -> Iterator[logging.Logger]:
    """A logger of its own, which tells nobody but the handlers of the test."""
    made = logging.Logger("test", logging.DEBUG)
    yield made
    for handler in made.handlers:
        handler.close()


@pytest.fixture
def ring(logger: logging.Logger) -> LogRing:
    made = LogRing()
    logger.addHandler(made)
    return made


def texts(ring: LogRing) -> list[str]:
    """The kept lines without month, day and time."""
    return [line.split(" ", 2)[2] for line in ring.lines()]


def fail(text: str) -> None:
    raise ValueError(text)


def test_a_line_has_its_time_its_level_and_its_message(logger: logging.Logger, ring: LogRing) -> None:
    logger.warning("%s: %d clients", "scada", 3)
    (line,) = ring.lines()
    day, time, rest = line.split(" ", 2)
    assert (len(day), day[2], len(time), time[2], time[5]) == (5, "-", 8, ":", ":")
    assert rest == "WARNING scada: 3 clients"


def test_control_characters_are_escaped_and_letters_stay_what_they_are(logger: logging.Logger, ring: LogRing) -> None:
    logger.info("%s", "a\x1b[2J\r\nERROR forged\tb\x07\x9b\u2028\u202e\udc80 Zähler 1 µs")
    assert texts(ring) == ["INFO a\\x1b[2J\\r\\nERROR forged\\tb\\x07\\x9b\\u2028\\u202e\\udc80 Zähler 1 µs"]


def test_a_traceback_keeps_its_line_ends_and_nothing_else_that_a_terminal_obeys(
    logger: logging.Logger, ring: LogRing
) -> None:
    try:
        fail("unit \x1b[31m\r9\u2028")
    except ValueError:
        logger.exception("boiler\x1b: ended")
    lines = texts(ring)
    assert lines[:2] == ["ERROR boiler\\x1b: ended", "Traceback (most recent call last):"]
    assert lines[-1] == "ValueError: unit \\x1b[31m\\r9\\u2028"
    assert any("in fail" in line for line in lines)
    assert all(line.isprintable() for line in lines)


def test_both_ways_out_say_the_same(logger: logging.Logger, ring: LogRing) -> None:
    shown = io.StringIO()
    console = logging.StreamHandler(shown)
    console.setFormatter(SafeFormatter())
    logger.addHandler(console)
    try:
        fail("\x1b")
    except ValueError:
        logger.exception("\x07")
    assert shown.getvalue().splitlines() == texts(ring)


def test_an_endless_message_is_cut_off(logger: logging.Logger, ring: LogRing) -> None:
    logger.info("%s", "x" * 10 * LONGEST)
    logger.info("%s", "\x00" * 10 * LONGEST)
    try:
        fail("y" * 10 * LONGEST)
    except ValueError:
        logger.exception("bug")
    assert max(map(len, texts(ring))) == LONGEST
    assert texts(ring)[0] == "INFO " + "x" * (LONGEST - 5)


def test_the_ring_keeps_the_newest_lines_and_no_more(logger: logging.Logger, ring: LogRing) -> None:
    for number in range(KEPT + 5):
        logger.info("line %d", number)
    assert texts(ring) == [f"INFO line {number}" for number in range(5, KEPT + 5)]


def test_a_message_without_a_word_is_a_line_as_well(logger: logging.Logger, ring: LogRing) -> None:
    logger.info("")
    assert texts(ring) == ["INFO "]


class Unspeakable:
    """Something that cannot be put into words."""

    def __str__(self) -> str:
        raise ZeroDivisionError("a bug")


def test_whoever_logs_what_cannot_be_worded_does_not_suffer_for_it(
    logger: logging.Logger, ring: LogRing, capsys: pytest.CaptureFixture[str]
) -> None:
    logger.info("%d", "three")
    logger.info("%s", Unspeakable())
    logger.info("goes on")
    assert texts(ring) == ["INFO goes on"]
    assert capsys.readouterr().err.count("--- Logging error ---") == 2


def test_the_lines_can_be_read_while_others_log(logger: logging.Logger, ring: LogRing) -> None:
    is_over = threading.Event()

    def chatter() -> None:
        while not is_over.is_set():
            logger.info("busy")

    threads = [threading.Thread(target=chatter) for _ in range(3)]
    for thread in threads:
        thread.start()
    try:
        seen = [len(ring.lines()) for _ in range(300)]
    finally:
        is_over.set()
        for thread in threads:
            thread.join()
    assert max(seen) <= KEPT
