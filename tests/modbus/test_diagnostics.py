"""What a serial line counts, logs and tells: functions 7, 8, 11, 12 and 17, request and reply byte for byte.

Requests and replies are written out of the application protocol V1.1b3, sections 6.7 to 6.10 and 6.13, the counters'
meanings out of the serial line guide V1.02, appendix A. What its examples leave to the device is said at each test.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, replace

import pytest
from pymodbus.pdu import DecodePDU

from gateway.modbus.diagnostics import LineDiagnostics
from gateway.modbus.identification import Identity
from gateway.modbus.server import Server, answer
from gateway.register import DataRegister
from tests.fakes import JumpingClock
from tests.modbus import wire
from tests.modbus.line_server import (
    CLEAR,
    COUNTERS,
    EVENT_COUNTER,
    KNOWN_SUBS,
    LISTEN_ONLY,
    QUERY,
    REQUEST_OF_EACH,
    RESTART,
    RESTART_AND_CLEAR_LOG,
    a_server,
    asked,
    counter,
    everything,
    no_room,
)


@pytest.fixture
def line() -> LineDiagnostics:
    return LineDiagnostics()


@pytest.fixture
def server(register: DataRegister, line: LineDiagnostics) -> Server:
    return a_server(register, line)


# ------------------------------------------------------------------------------------------------ as printed


def test_the_exception_status_is_told_as_in_section_6_7(server: Server) -> None:
    assert asked(server, "07") == "07 6D"


def test_the_exception_status_is_asked_for_anew_each_time(server: Server) -> None:
    outputs = iter([0x00, 0xFF, 0x80])
    changing = replace(server, exception_status=lambda: next(outputs))
    assert [asked(changing, "07") for _ in range(3)] == ["07 00", "07 FF", "07 80"]


def test_query_data_comes_back_as_in_section_6_8(server: Server) -> None:
    assert asked(server, "08 00 00 A5 37") == "08 00 00 A5 37"


def test_query_data_may_fill_a_whole_pdu(server: Server) -> None:
    longest = "08 00 00" + " A5 37" * 125  # 253 bytes
    assert asked(server, longest) == longest


def test_the_diagnostic_register_has_no_bit_set(server: Server) -> None:
    assert asked(server, "08 00 02 00 00") == "08 00 02 00 00"


def test_the_event_counter_is_told_as_in_section_6_9(server: Server, line: LineDiagnostics) -> None:
    line.events = 264
    #  The example's status FF FF says that a program function runs; there are none here.
    assert asked(server, "0B") == "0B 00 00 01 08"


def test_the_event_log_is_told_as_in_section_6_10(server: Server, line: LineDiagnostics) -> None:
    line.events, line.bus_messages, line.log = 264, 288, deque([0x20, 0x00], maxlen=64)
    reply = """
        0C
        09       # byte count: the example's 8, and 1 for the event of this request
        00 00    # status: nothing in progress
        01 08    # 264 events
        01 21    # 289 messages, this one included
        80       # received: this request
        20 00    # what the example has
    """
    assert asked(server, "0C") == wire(reply).hex(" ").upper()


def test_the_server_id_is_told_as_in_section_6_13(server: Server) -> None:
    reply = """
        11
        10                               # byte count
        01                               # server ID: what it is, is the device's own choice
        FF                               # run indicator: on
        41 63 6D 65                      # additional data: Acme
        20 47 57 2D 31 20 32 2E 31 31    #  GW-1 2.11
    """
    assert asked(server, "11") == wire(reply).hex(" ").upper()


def test_the_longest_server_id_that_a_configuration_can_have_fits_a_pdu(server: Server) -> None:
    longest = replace(server, identity=Identity("V" * 64, "P" * 64, "R" * 64))
    reply = bytes.fromhex(asked(longest, "11"))
    assert reply == b"\x11\xc4\x01\xff" + b"V" * 64 + b" " + b"P" * 64 + b" " + b"R" * 64


# ------------------------------------------------------------------------------------------------ what is refused


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("07 00", "87 03"),
        ("0B 00", "8B 03"),
        ("0C 00 00", "8C 03"),
        ("11 00", "91 03"),
        ("08", "88 03"),
        ("08 00", "88 03"),
        ("08 00 00  # no data to bring back", "88 03"),
        ("08 00 00 A5", "88 03"),
        ("08 00 00 A5 37 A5", "88 03"),
        ("08 00 01", "88 03"),
        ("08 00 01 FF", "88 03"),
        ("08 00 01 FF 01", "88 03"),
        ("08 00 01 00 FF", "88 03"),
        ("08 00 01 FF 00 00", "88 03"),
        ("08 00 01 00 00 00 00", "88 03"),
        ("08 00 02 00 01", "88 03"),
        ("08 00 04 00", "88 03"),
        ("08 00 04 FF 00", "88 03"),
        ("08 00 04 00 00 00", "88 03"),
        ("08 00 0A FF 00", "88 03"),
        ("08 00 0A 00", "88 03"),
        *((f"08 00 {sub:02X} 00 01", "88 03") for sub in COUNTERS),
        *((f"08 00 {sub:02X} FF 00", "88 03") for sub in COUNTERS),
        *((f"08 00 {sub:02X}", "88 03") for sub in COUNTERS),
        *((f"08 00 {sub:02X} 00", "88 03") for sub in COUNTERS),
        *((f"08 00 {sub:02X} 00 00 00", "88 03") for sub in COUNTERS),
        ("08 00 03 0A 00  # change ASCII input delimiter", "88 01"),
        ("08 00 14 00 00  # clear overrun counter", "88 01"),
        ("08 01 00 A5 37  # the low byte alone would be known", "88 01"),
        ("08 00 13  # unknown, and the length would be wrong too", "88 01"),
    ],
    ids=lambda text: text.partition("#")[0].strip(),
)
def test_what_is_refused_changes_no_mode_no_log_and_only_the_two_counters_it_has_to(
    server: Server, line: LineDiagnostics, request_: str, reply: str
) -> None:
    for name in COUNTERS.values():
        setattr(line, name, 7)
    line.events, line.log = 7, deque([0x04, 0x00], maxlen=64)
    before = replace(line, log=line.log.copy())
    assert asked(server, request_) == reply
    #                               newest first: sent, read exception; received
    assert line == replace(before, bus_messages=8, messages=8, exceptions=8, log=deque([0x41, 0x80, 0x04, 0x00]))


def test_every_other_sub_function_is_unknown(server: Server) -> None:
    unknown = [sub for sub in range(65536) if sub not in KNOWN_SUBS]
    assert len(unknown) == 65536 - 13
    assert {answer(b"\x08" + sub.to_bytes(2, "big") + b"\0\0", server) for sub in unknown} == {b"\x88\x01"}


@pytest.mark.parametrize("request_", ["07", QUERY, RESTART, "0B", "0C", "11", "07 00", "08", "0B 00"])
def test_without_a_serial_line_they_are_unknown(server: Server, request_: str) -> None:
    on_tcp = replace(server, line=None)
    reply = answer(wire(request_), on_tcp)
    assert reply == bytes([int(request_[:2], 16) | 0x80, 1])
    opened = replace(on_tcp, functions=frozenset({7, 8, 11, 12, 17}))
    assert answer(wire(request_), opened) == reply


@pytest.mark.parametrize("function", [7, 8, 11, 12, 17])
def test_functions_narrows_what_the_line_answers(server: Server, function: int) -> None:
    def served(functions: set[int]) -> list[int]:
        narrowed = replace(server, functions=frozenset(functions))
        replies = {each: asked(narrowed, REQUEST_OF_EACH[each]) for each in (7, 8, 11, 12, 17)}
        return [each for each, reply in replies.items() if reply != f"{each | 0x80:02X} 01"]

    assert served(set()) == [7, 8, 11, 12, 17]
    assert served({3, function}) == [function]
    assert served({7, 8, 11, 12, 17} - {function}) == [each for each in (7, 8, 11, 12, 17) if each != function]


def test_a_restart_that_is_closed_restarts_nothing(server: Server, line: LineDiagnostics) -> None:
    narrowed = replace(server, functions=frozenset({3}))
    line.bus_errors = 5
    assert asked(narrowed, RESTART_AND_CLEAR_LOG) == "88 01"
    assert asked(narrowed, LISTEN_ONLY) == "88 01"
    assert (line.bus_errors, list(line.log), line.listen_only) == (5, [0x41, 0x80, 0x41, 0x80], False)


def test_a_slave_that_is_not_writable_answers_them(server: Server) -> None:
    assert asked(replace(server, writable=False), "07") == "07 6D"


# ------------------------------------------------------------------------------------------------ listening only


@pytest.fixture
def listening(server: Server) -> Server:
    assert asked(server, LISTEN_ONLY) == ""
    return server


@pytest.mark.parametrize("broadcast", [False, True], ids=["to us", "broadcast"])
def test_listening_only_answers_nothing_and_does_nothing(listening: Server, broadcast: bool) -> None:
    queue = [1, 2, 3]
    eager = replace(listening, read_fifo=lambda address: [queue.pop()])
    before = everything(listening.register)
    for function, request in REQUEST_OF_EACH.items():
        assert asked(eager, request, broadcast) == "", f"function {function}"
    for sub in [0, 2, 4, *range(10, 19), 3, 20]:
        assert asked(eager, f"08 {sub:04X} 00 00", broadcast) == "", f"sub-function {sub}"
    assert asked(eager, "", broadcast) == ""
    assert everything(listening.register) == before
    assert queue == [1, 2, 3]


def test_without_listening_only_the_same_requests_are_answered(server: Server) -> None:
    replies = {function: asked(server, request) for function, request in REQUEST_OF_EACH.items()}
    refused = {24: "98 02", 65: "C1 01"}
    assert {function: reply for function, reply in replies.items() if int(reply[:2], 16) & 0x80} == refused


@pytest.mark.parametrize("broadcast", [False, True], ids=["to us", "broadcast"])
@pytest.mark.parametrize("restart", [RESTART, RESTART_AND_CLEAR_LOG])
def test_only_a_restart_ends_it_and_is_not_answered_itself(listening: Server, restart: str, broadcast: bool) -> None:
    assert asked(listening, "07") == ""
    assert asked(listening, restart, broadcast) == ""
    assert asked(listening, "07") == "07 6D"


@pytest.mark.parametrize("request_", ["08 00 01", "08 00 01 00", "08 00 01 00 01", "08 00 01 FF 00 00", "08 01 00 00"])
def test_a_restart_that_is_none_does_not_end_it_and_is_not_refused_aloud(listening: Server, request_: str) -> None:
    assert asked(listening, request_) == ""
    assert asked(listening, "07") == ""


def test_a_broadcast_puts_the_line_into_listening_only(server: Server) -> None:
    asked(server, LISTEN_ONLY, broadcast=True)
    assert asked(server, "07") == ""


def test_a_restart_while_not_listening_only_is_answered(server: Server) -> None:
    assert asked(server, RESTART) == RESTART
    assert asked(server, RESTART_AND_CLEAR_LOG) == RESTART_AND_CLEAR_LOG


def test_what_was_ignored_was_no_good_request(listening: Server) -> None:
    good = listening.counters.good
    asked(listening, "06 00 00 12 34")
    assert (listening.counters.good, listening.counters.requests) == (good, 2)


# ------------------------------------------------------------------------------------------------ counters


def test_cpt1_counts_all_undamaged_messages_whoever_they_are_for(server: Server, line: LineDiagnostics) -> None:
    for _ in range(3):
        line.heard()  # for others
    line.heard_damaged()
    asked(server, "07")
    asked(server, "06 00 00 12 34", broadcast=True)
    assert counter(server, 0x0B) == 3 + 2 + 1


def test_cpt2_counts_damaged_messages(server: Server, line: LineDiagnostics) -> None:
    line.heard_damaged()
    asked(server, "07 00")
    line.heard_damaged()
    assert counter(server, 0x0C) == 2


def test_cpt3_counts_exceptions_also_those_of_broadcasts_that_nobody_is_told_of(server: Server) -> None:
    asked(server, "03 FF FF 00 01  # exception 2")
    asked(server, "06 FF FF 12 34  # exception 2, told to nobody", broadcast=True)
    asked(server, "41              # exception 1")
    asked(server, "08 00 0A FF 00  # exception 3")
    asked(server, "07              # none")
    assert counter(server, 0x0D) == 4


def test_cpt4_counts_messages_for_us_and_broadcasts_but_not_those_for_others(
    server: Server, line: LineDiagnostics
) -> None:
    line.heard()  # for others
    line.heard_damaged()
    asked(server, "07")
    asked(server, "41  # refused")
    asked(server, "06 00 00 12 34", broadcast=True)
    assert counter(server, 0x0E) == 3 + 1


def test_cpt5_counts_broadcasts_refused_ones_too_as_messages_without_an_answer(server: Server) -> None:
    asked(server, "07")
    asked(server, "41  # an exception is an answer")
    asked(server, "06 00 00 12 34", broadcast=True)
    asked(server, "06 FF FF 12 34", broadcast=True)
    assert counter(server, 0x0F) == 2


def test_cpt5_counts_what_listening_only_leaves_unanswered(listening: Server, line: LineDiagnostics) -> None:
    asked(listening, "07")
    asked(listening, "06 00 00 12 34", broadcast=True)
    asked(listening, "08 00 01 12 34  # a restart refused in silence")
    assert line.unanswered == 1 + 3


def test_listening_only_goes_on_counting_messages(listening: Server, line: LineDiagnostics) -> None:
    asked(listening, "07")
    line.heard()  # for others
    line.heard_damaged()
    assert (line.bus_messages, line.messages, line.bus_errors) == (3, 2, 1)


@pytest.mark.parametrize(("answered", "naks"), [(True, 1), (False, 0)])
def test_cpt6_counts_exception_7_where_it_was_answered(line: LineDiagnostics, answered: bool, naks: int) -> None:
    line.carried_out(13, 7, answered)  # a program function: nothing that is served here answers 7
    line.carried_out(13, 6, answered)
    assert line.naks == naks


@pytest.fixture
def full(server: Server, clock: JumpingClock) -> Iterator[Server]:
    with no_room(server, clock) as without_room:
        yield without_room


def test_cpt7_counts_busy_answers_and_not_what_a_broadcast_is_not_told(full: Server) -> None:
    assert asked(full, "06 00 00 12 34") == "86 06"
    asked(full, "06 00 00 12 34", broadcast=True)
    asked(full, "06 FF FF 12 34  # exception 2")
    assert counter(full, 0x11) == 1
    assert counter(full, 0x0D) == 3


def test_cpt6_and_cpt8_stay_0_whatever_comes(server: Server, line: LineDiagnostics) -> None:
    for request in REQUEST_OF_EACH.values():
        asked(server, request)
        line.heard_damaged()
    assert [counter(server, 0x10), counter(server, 0x12)] == [0, 0]


@pytest.mark.parametrize(("sub", "name"), COUNTERS.items())
def test_each_counter_is_told_by_its_own_sub_function_and_by_no_other(
    server: Server, line: LineDiagnostics, sub: int, name: str
) -> None:
    setattr(line, name, 0x1200)
    told = {each: counter(server, each) >= 0x1200 for each in COUNTERS}
    assert told == {each: each == sub for each in COUNTERS}


def test_every_counter_wraps_after_65535(line: LineDiagnostics) -> None:
    names = [*COUNTERS.values(), "events"]
    for name in names:
        setattr(line, name, 65535)
    line.heard()
    line.heard_damaged()
    line.received(broadcast=False)
    line.carried_out(6, 6, answered=True)
    line.carried_out(13, 7, answered=True)
    line.carried_out(6, 0, answered=False)
    assert {name: getattr(line, name) for name in names} == {
        **dict.fromkeys(names, 0),
        "exceptions": 1,  # two of them
        "overruns": 65535,  # nothing tells of one
    }


def test_a_counter_of_65535_is_told_whole(server: Server, line: LineDiagnostics) -> None:
    line.busy = 0xFFFF
    assert asked(server, "08 00 11 00 00") == "08 00 11 FF FF"
    line.bus_messages = line.events = 0xFFFF
    assert asked(server, "0C")[:23] == "0C 09 00 00 FF FF 00 00"  # this request was message 65536


@pytest.mark.parametrize("request_", [CLEAR, RESTART, RESTART_AND_CLEAR_LOG])
def test_clear_and_restart_set_every_counter_to_0_and_answer_first(
    server: Server, line: LineDiagnostics, request_: str
) -> None:
    for name in [*COUNTERS.values(), "events"]:
        setattr(line, name, 500)
    assert asked(server, request_) == request_
    told = asdict(line)
    assert {name: told[name] for name in [*COUNTERS.values(), "events"]} == dict.fromkeys(
        [*COUNTERS.values(), "events"], 0
    )
    assert asked(server, EVENT_COUNTER) == "0B 00 00 00 00"
    assert counter(server, 0x0E) == 2  # function 11 before, and this one


# ------------------------------------------------------------------------------------------------ another's reading


def decoded_by_pymodbus(server: Server, request: str) -> dict[str, object]:
    """What pymodbus's client makes of the reply to *request*."""
    pdu = DecodePDU(is_server=False).decode(bytes.fromhex(asked(server, request)))
    assert pdu is not None
    assert not pdu.isError()
    return {name: value for name, value in vars(pdu).items() if name in PYMODBUS_NAMES}


PYMODBUS_NAMES = {"status", "message", "count", "event_count", "message_count", "events", "identifier", "byte_count"}


def test_pymodbus_reads_what_was_told(server: Server, line: LineDiagnostics) -> None:
    assert decoded_by_pymodbus(server, "07")["status"] == 0x6D
    assert decoded_by_pymodbus(server, QUERY)["message"] == b"\xa5\x37"
    line.busy = 0x1234
    assert decoded_by_pymodbus(server, "08 00 11 00 00")["message"] == 0x1234
    line.events = 264
    found = decoded_by_pymodbus(server, "0B")
    assert (found["count"], found["status"]) == (264, True)  # ready


def test_pymodbus_reads_the_event_log(server: Server, line: LineDiagnostics) -> None:
    line.events, line.bus_messages, line.log = 264, 288, deque([0x20, 0x00], maxlen=64)
    found = decoded_by_pymodbus(server, "0C")
    assert (found["event_count"], found["message_count"], found["events"]) == (264, 289, [0x80, 0x20, 0x00])


def test_pymodbus_reads_the_server_id_but_looks_for_the_run_indicator_at_its_end(server: Server) -> None:
    #  Section 6.13: server ID, run indicator, additional data. pymodbus knows of no additional data, and takes the last
    #  byte for the indicator; pymodbus 3.8 also counts it to the identifier.
    found = decoded_by_pymodbus(server, "11")
    assert found["byte_count"] == 16
    assert str(found["identifier"]).startswith(str(b"\x01\xffAcme GW-1 2.1")[:-1])
    without_data = decoded_by_pymodbus(replace(server, identity=Identity("", "", "")), "11")
    assert (without_data["byte_count"], without_data["status"]) == (2, True)
