"""The serial line's event counter and event log, functions 11 and 12 (application protocol V1.1b3, 6.9 and 6.10)."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from gateway.modbus.diagnostics import LineDiagnostics
from gateway.modbus.server import Server
from gateway.register import DataRegister
from tests.fakes import JumpingClock
from tests.modbus import wire
from tests.modbus.line_server import (
    CLEAR,
    EVENT_COUNTER,
    EVENT_LOG,
    LISTEN_ONLY,
    QUERY,
    RESTART,
    RESTART_AND_CLEAR_LOG,
    a_server,
    asked,
    no_room,
)


@pytest.fixture
def line() -> LineDiagnostics:
    return LineDiagnostics()


@pytest.fixture
def server(register: DataRegister, line: LineDiagnostics) -> Server:
    return a_server(register, line)


@pytest.fixture
def full(server: Server, clock: JumpingClock) -> Iterator[Server]:
    with no_room(server, clock) as without_room:
        yield without_room


@pytest.fixture
def listening(server: Server) -> Server:
    assert asked(server, LISTEN_ONLY) == ""
    return server


def events(server: Server) -> str:
    """The event log, newest first, without the receive event of the request that asks for it."""
    reply = bytes.fromhex(asked(server, EVENT_LOG))
    assert len(reply) == 2 + reply[1]
    assert reply[8] & 0xDF == 0x80  # the request itself
    return reply[9:].hex(" ").upper()


# ------------------------------------------------------------------------------------------------ the event counter


def test_the_event_counter_counts_messages_carried_out(server: Server) -> None:
    for request in ("07", "03 00 00 00 01", "06 00 00 12 34", QUERY, "11", "2B 0E 01 00"):
        asked(server, request)
    asked(server, "06 00 00 12 35", broadcast=True)
    assert asked(server, EVENT_COUNTER) == "0B 00 00 00 07"


def test_the_event_counter_counts_no_exceptions_and_not_function_11(server: Server) -> None:
    asked(server, "07")
    for request in ("41", "07 00", "03 FF FF 00 01", "0B 00"):
        asked(server, request)
    asked(server, "06 FF FF 12 34", broadcast=True)
    for _ in range(3):
        assert asked(server, EVENT_COUNTER) == "0B 00 00 00 01"


def test_the_event_log_counts_as_an_event_only_after_it_was_told(server: Server) -> None:
    assert asked(server, EVENT_LOG)[6:17] == "00 00 00 00"
    assert asked(server, EVENT_COUNTER) == "0B 00 00 00 01"


def test_listening_only_carries_out_nothing_that_would_be_an_event(listening: Server, line: LineDiagnostics) -> None:
    asked(listening, "07")
    assert line.events == 1  # the request that led there


# ------------------------------------------------------------------------------------------------ the event log


def test_the_log_of_a_new_line_holds_only_the_request_that_asks(server: Server) -> None:
    assert asked(server, EVENT_LOG) == "0C 07 00 00 00 00 00 01 80"


def test_each_message_leaves_a_receive_and_a_send_event_newest_first(server: Server, line: LineDiagnostics) -> None:
    asked(server, "07")
    assert events(server) == "40 80"
    line.heard_damaged()
    assert events(server) == "82 40 80 40 80"  # damaged; function 12; function 7


@pytest.mark.parametrize(
    ("exception", "sent"),
    [
        (0, 0x40),
        (1, 0x41),  # bit 0: read exception
        (2, 0x41),
        (3, 0x41),
        (4, 0x42),  # bit 1: abort
        (5, 0x44),  # bit 2: busy
        (6, 0x44),
        (7, 0x48),  # bit 3: program NAK
        (8, 0x40),  # section 6.10 has no bit for these
        (10, 0x40),
        (11, 0x40),
    ],
)
def test_a_send_event_says_which_exception_was_sent(line: LineDiagnostics, exception: int, sent: int) -> None:
    line.carried_out(3, exception, answered=True)
    assert list(line.log) == [sent]


def test_a_busy_answer_is_logged_as_one(full: Server) -> None:
    asked(full, "06 00 00 12 34")
    assert events(full) == "44 80"


def test_a_broadcast_is_logged_as_one_and_its_exception_as_not_sent(server: Server) -> None:
    asked(server, "06 00 00 12 34", broadcast=True)
    assert events(server) == "40 C0"
    asked(server, "06 FF FF 12 34", broadcast=True)
    assert events(server) == "40 C0 40 80 40 C0"


def test_listening_only_is_in_the_log_from_its_beginning_to_its_end(listening: Server, line: LineDiagnostics) -> None:
    asked(listening, "07")
    asked(listening, "06 FF FF 12 34", broadcast=True)
    line.heard_damaged()
    asked(listening, RESTART)
    told = """
        00       # restarted
        60 A0    # the restart, while listening only: sent (nothing), received
        A2       # damaged
        60 E0    # the broadcast
        60 A0    # function 7
        04       # entered listen only mode
        40 80    # the request to enter it
    """
    assert events(listening) == wire(told).hex(" ").upper()


def test_a_restart_keeps_the_log_and_adds_to_it(server: Server) -> None:
    asked(server, "41")
    asked(server, RESTART)
    assert events(server) == "00 40 80 41 80"


def test_a_restart_with_ff00_leaves_nothing_in_the_log_but_itself(server: Server) -> None:
    asked(server, "41")
    asked(server, RESTART_AND_CLEAR_LOG)
    assert events(server) == "00"


def test_clearing_the_counters_leaves_the_log(server: Server) -> None:
    asked(server, "41")
    asked(server, CLEAR)
    assert events(server) == "40 80 41 80"


def test_the_log_keeps_the_newest_64_events(server: Server, line: LineDiagnostics) -> None:
    for _ in range(10):
        line.heard_damaged()
    for _ in range(27):
        asked(server, "07")
    #  10 + 2 x 27 are 64; the request that asks pushes the oldest out
    reply = asked(server, EVENT_LOG)
    assert reply == "0C 46 00 00 00 1B 00 1C 80" + " 40 80" * 27 + " 82" * 9
    assert len(bytes.fromhex(reply)) == 8 + 64
    for _ in range(40):
        asked(server, "41")
    assert asked(server, EVENT_LOG) == "0C 46 00 00 00 1C 00 45 80" + " 41 80" * 31 + " 41"
