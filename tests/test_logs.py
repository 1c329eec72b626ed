"""What is logged: safe for a terminal, whole tracebacks, a ring that never grows, and the journal's prefixes."""

from __future__ import annotations

import io
import logging
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.logs import (
    KEPT,
    LONGEST,
    TRACEBACK_LONGEST,
    JournalFormatter,
    LogRing,
    SafeFormatter,
    console_formatter,
)


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


def test_a_traceback_without_end_is_cut_at_its_beginning(logger: logging.Logger, ring: LogRing) -> None:
    try:
        fail("\n".join(f"line {number} " + "z" * 3000 for number in range(50)))
    except ValueError:
        logger.exception("bug")
    kept = texts(ring)
    assert sum(map(len, kept)) < TRACEBACK_LONGEST + 100
    assert kept[1].startswith("[...]")
    assert kept[-1].startswith("line 49 zzz")


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


# ------------------------------------------------------------------------------------------------ the journal


def written_to_a_pipe(level: int, text: str, error: BaseException | None = None) -> list[str]:
    """What arrives at the other end of a pipe that the environment calls the journal."""
    reader, writer = os.pipe()
    with os.fdopen(reader) as read, os.fdopen(writer, "w") as console:
        status = os.fstat(console.fileno())
        handler = logging.StreamHandler(console)
        handler.setFormatter(console_formatter(f"{status.st_dev}:{status.st_ino}", status))
        info = (type(error), error, error.__traceback__) if error else None
        handler.handle(logging.LogRecord("test", level, "", 0, "%s", (text,), info))
        console.close()
        return read.read().splitlines()


@pytest.mark.parametrize(
    ("level", "prefix"),
    [
        (logging.CRITICAL, "<2>"),
        (logging.ERROR, "<3>"),
        (logging.WARNING, "<4>"),
        (logging.INFO, "<6>"),
        (logging.DEBUG, "<7>"),
        (logging.WARNING + 5, "<4>"),
        (logging.CRITICAL + 10, "<2>"),
    ],
)
def test_the_journal_gets_the_level_as_its_prefix_instead_of_the_word(level: int, prefix: str) -> None:
    assert written_to_a_pipe(level, "field: no reply") == [f"{prefix}field: no reply"]


def test_the_journal_gets_a_prefix_on_every_line_of_a_traceback() -> None:
    try:
        fail("of\x1b two\nlines")
    except ValueError as error:
        lines = written_to_a_pipe(logging.ERROR, "field: ended with an error", error)
    assert lines[:2] == ["<3>field: ended with an error", "<3>Traceback (most recent call last):"]
    assert lines[-2:] == ["<3>ValueError: of\\x1b two", "<3>lines"]
    assert all(line.startswith("<3>") for line in lines)


def test_the_traceback_of_a_record_is_prefixed_for_the_journal_only(ring: LogRing) -> None:
    try:
        fail("bug")
    except ValueError as error:
        record = logging.LogRecord("test", logging.ERROR, "", 0, "failed", None, (ValueError, error, None))
    assert JournalFormatter().format(record) == "<3>failed\n<3>ValueError: bug"
    ring.handle(record)
    assert texts(ring) == ["ERROR failed", "ValueError: bug"]


def test_a_name_cannot_make_a_line_of_its_own_priority_for_the_journal() -> None:
    assert written_to_a_pipe(logging.INFO, "<0>panic\n<0>panic") == ["<6><0>panic\\n<0>panic"]


@pytest.mark.parametrize("journal", ["", "0:0", "x", "8:", ":", "8:1:2", "\udcff", "9" * 5000 + ":1"])
def test_a_console_that_is_not_the_journal_is_worded_for_people(journal: str, tmp_path: Path) -> None:
    (tmp_path / "log").touch()
    formatter = console_formatter(journal, (tmp_path / "log").stat())
    assert formatter.format(logging.LogRecord("test", logging.INFO, "", 0, "up", None, None)) == "INFO up"


def test_a_program_without_a_console_is_not_at_the_journal() -> None:
    assert not isinstance(console_formatter("", None), JournalFormatter)
    assert not isinstance(console_formatter("None", None), JournalFormatter)
