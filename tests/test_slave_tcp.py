"""What a TCP slave answers, on real sockets of this machine (spec sections 3, 4); its clients: test_slave_tcp_clients.

Requests and replies are literal bytes. That a client gets no answer is shown by the answer to its next request, which
comes first. Pauses are made with short settings, never with sleeps.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterator

import pytest

from gateway.commands import CommandQueue, Outlet
from gateway.modbus.pdu import Span, Table
from gateway.register import Source, SourceKind
from tests.lines import (
    CLOCK,
    EXAMPLES,
    FOUND,
    FOUND_PDU,
    PATIENCE_S,
    READ,
    READ_PDU,
    RawClient,
    ServedTcp,
    a_register,
    ascii_frame,
    holding,
    raw_client,
    rtu_frame,
    serving_tcp,
    tcp_config,
    tcp_frame,
    values,
)

SHORT_S = 0.05  # a timeout that a test waits for
NEVER_S = 60.0  # a turn that no test waits for
ENCODE: dict[str, Callable[[str, int], bytes]] = {"rtu": rtu_frame, "ascii": ascii_frame}


@pytest.fixture
def slave() -> Iterator[ServedTcp]:
    with serving_tcp(tcp_config()) as made:
        yield made


@pytest.fixture
def client(slave: ServedTcp) -> Iterator[RawClient]:
    with slave.client() as made:
        yield made


def pipelined(count: int) -> tuple[bytes, bytes]:
    """Return *count* reads of different lengths in one, and their replies."""
    requests, replies = b"", b""
    for number in range(count):
        quantity = 1 + number % 3
        requests += tcp_frame(number, f"03 00 6B 00 {quantity:02X}")
        replies += tcp_frame(number, f"03 {2 * quantity:02X} " + "02 2B 00 00 00 64"[: 6 * quantity])
    return requests, replies


# ------------------------------------------------------------------------------------------------ requests


def test_the_example_of_the_standard_is_answered_byte_for_byte(client: RawClient) -> None:
    assert client.ask(READ, len(FOUND)) == FOUND


@pytest.mark.parametrize(("request_pdu", "reply_pdu"), EXAMPLES.values(), ids=EXAMPLES)
def test_each_request_gets_the_reply_of_the_standard(client: RawClient, request_pdu: str, reply_pdu: str) -> None:
    reply = tcp_frame(0xFFFF, reply_pdu)
    assert client.ask(tcp_frame(0xFFFF, request_pdu) + READ, len(reply + FOUND)) == reply + FOUND


def test_what_is_written_is_in_the_register_with_its_client_as_the_source(slave: ServedTcp, client: RawClient) -> None:
    host, port = client.socket.getsockname()
    client.ask(tcp_frame(1, "10 00 01 00 02 04 00 0A 01 02"), 12)
    samples = slave.register.samples(Span(Table.HOLDING_REGISTERS, 1, 2))
    assert [sample.value for sample in samples] == [0x000A, 0x0102]
    assert {str(sample.source) for sample in samples} == {f"scada {host}:{port}"}


def test_two_hundred_requests_in_one_piece_are_answered_in_order(client: RawClient) -> None:
    requests, replies = pipelined(200)
    assert client.ask(requests, len(replies)) == replies


@pytest.mark.parametrize("size", [1, 2, 5, 6, 7, 11, 12, 13, 17, 1001])
def test_requests_cut_anywhere_are_answered_in_order(client: RawClient, size: int) -> None:
    requests, replies = pipelined(200 if size > 10 else 20)
    for start in range(0, len(requests), size):
        client.send(requests[start : start + size])
    assert client.receive(len(replies)) == replies


@pytest.mark.parametrize("unit", [0, 255, 17])
def test_a_unit_that_means_this_gateway_is_answered_and_echoed(client: RawClient, unit: int) -> None:
    reply = tcp_frame(7, FOUND_PDU, unit)
    assert client.ask(tcp_frame(7, READ_PDU, unit), len(reply)) == reply


@pytest.mark.parametrize("unit", [1, 16, 18, 254])
def test_a_foreign_unit_is_answered_with_exception_11_and_echoed(
    slave: ServedTcp, client: RawClient, unit: int
) -> None:
    refusal = tcp_frame(0xABCD, "86 0B", unit)
    assert client.ask(tcp_frame(0xABCD, "06 00 01 00 03", unit), len(refusal)) == refusal
    assert holding(slave.register, 1) == [0]


# ------------------------------------------------------------------------------------------------ damage


def test_a_frame_of_another_protocol_is_discarded_and_the_next_answered(slave: ServedTcp, client: RawClient) -> None:
    other = bytes.fromhex("0001 0001 0006 11 06 0001 0003")  # protocol 1: would write register 1
    assert client.ask(other + READ, len(FOUND)) == FOUND
    assert holding(slave.register, 1) == [0]


@pytest.mark.parametrize("length", [0, 1, 255, 65535])
def test_an_impossible_length_closes_that_connection_alone(slave: ServedTcp, client: RawClient, length: int) -> None:
    with slave.client() as other:
        client.send(READ + struct.pack(">HHH", 2, 0, length) + READ[6:] + READ)
        assert client.receive(len(FOUND)) == FOUND  # what came before is answered
        assert client.is_closed()
        assert other.ask(READ, len(FOUND)) == FOUND


def test_the_greatest_length_is_answered(client: RawClient) -> None:
    longest = tcp_frame(1, "10 00 00 00 7B F6" + 246 * "00")  # 123 registers, length 253
    over_by_one = tcp_frame(2, "10 00 00 00 7B F6" + 247 * "00")  # length 254 is allowed, its content is not
    replies = tcp_frame(1, "10 00 00 00 7B") + tcp_frame(2, "90 03")
    assert client.ask(longest + over_by_one, len(replies)) == replies


# ------------------------------------------------------------------------------------------------ what is served


def test_without_writable_every_write_is_refused_with_exception_1() -> None:
    writes = [(request, reply) for name, (request, reply) in EXAMPLES.items() if "write" in name]
    with serving_tcp(tcp_config(writable=False)) as slave, slave.client() as client:
        for request, reply in writes:
            refusal = tcp_frame(3, f"{int(reply[:2], 16) | 0x80:02X} 01")
            assert client.ask(tcp_frame(3, request), len(refusal)) == refusal
        assert client.ask(READ, len(FOUND)) == FOUND
        assert len(writes) == 6
        assert holding(slave.register, 0, 20) == [0, 0, 0, 0, 0x12, 0, 0, 0, 0x0A, *[0] * 11]
        assert values(slave.register, Table.COILS, 172) == [0]


def test_functions_narrow_what_is_answered() -> None:
    with serving_tcp(tcp_config(functions=["read-holding-registers", 6])) as slave, slave.client() as client:
        assert client.ask(READ, len(FOUND)) == FOUND
        assert client.ask(tcp_frame(1, "06 00 01 00 03"), 12) == tcp_frame(1, "06 00 01 00 03")
        assert client.ask(tcp_frame(1, "01 00 13 00 13"), 9) == tcp_frame(1, "81 01")
        assert client.ask(tcp_frame(1, "10 00 01 00 01 02 00 09"), 9) == tcp_frame(1, "90 01")
        assert holding(slave.register, 1) == [3]


@pytest.mark.parametrize(
    ("address", "quantity", "is_served"),
    [(107, 3, True), (106, 1, False), (106, 2, False), (109, 2, False), (110, 1, False), (109, 1, True)],
)
def test_first_and_count_narrow_the_points_served(address: int, quantity: int, is_served: bool) -> None:
    with serving_tcp(tcp_config(first=107, count=3)) as slave, slave.client() as client:
        client.send(tcp_frame(1, f"03 {address:04X} {quantity:04X}"))
        assert client.receive(9)[7:] == (bytes([3, 2 * quantity]) if is_served else b"\x83\x02")


def test_stale_points_are_refused_with_exception_11_where_that_is_configured() -> None:
    register = a_register()
    register.claim(Span(Table.HOLDING_REGISTERS, 0, 2), Source(SourceKind.REQUEST, "field/boiler"), 10.0)
    with serving_tcp(tcp_config(stale="exception"), register) as slave, slave.client() as client:
        refusal = tcp_frame(1, "83 0B")
        assert client.ask(tcp_frame(1, "03 00 01 00 02"), 9) == refusal
        assert client.ask(READ, len(FOUND)) == FOUND  # nobody fills these


def test_a_write_that_meets_a_full_command_queue_is_refused_with_exception_6_and_stores_nothing(
    slave: ServedTcp, client: RawClient
) -> None:
    span = Span(Table.HOLDING_REGISTERS, 1, 2)
    queue = CommandQueue(slave.register, CLOCK, wake=lambda: None, limit=1)
    queue.add(Outlet(span, Source(SourceKind.REQUEST, "field/setpoint")))
    assert client.ask(tcp_frame(1, "06 00 01 00 03"), 12) == tcp_frame(1, "06 00 01 00 03")  # fills the queue
    assert client.ask(tcp_frame(2, "06 00 02 00 04"), 9) == tcp_frame(2, "86 06")
    assert client.ask(tcp_frame(3, "10 00 02 00 02 04 0005 0006"), 9) == tcp_frame(3, "90 06")
    assert holding(slave.register, 1, 3) == [3, 0, 0]
    assert client.ask(tcp_frame(4, "06 00 03 00 07"), 12) == tcp_frame(4, "06 00 03 00 07")  # concerns no device
    queue.close()


def test_requests_are_counted_for_the_slave_and_for_each_client(slave: ServedTcp, client: RawClient) -> None:
    client.ask(READ + tcp_frame(2, "03 FF FF 00 02") + tcp_frame(3, READ_PDU, unit=9) + READ, 2 * len(FOUND) + 18)
    with slave.client() as other:
        other.ask(bytes.fromhex("0001 0001 0002 11 03") + READ, len(FOUND))
        counted = {known.name: known.server.counters for known in slave.task.clients.values()}
        mine = counted["{}:{}".format(*client.socket.getsockname())]
        theirs = counted["{}:{}".format(*other.socket.getsockname())]
    total = slave.task.counters
    assert (mine.requests, mine.good, mine.exceptions, mine.foreign, mine.damaged) == (3, 2, {2: 1}, 1, 0)
    assert (theirs.requests, theirs.good, theirs.exceptions, theirs.foreign, theirs.damaged) == (1, 1, {}, 0, 1)
    assert (total.requests, total.good, total.exceptions, total.foreign, total.damaged) == (4, 3, {2: 1}, 1, 1)


# ------------------------------------------------------------------------------------------------ RTU, ASCII over TCP


@pytest.mark.parametrize("framing", ENCODE)
@pytest.mark.parametrize(("request_pdu", "reply_pdu"), EXAMPLES.values(), ids=EXAMPLES)
def test_serial_frames_over_tcp_get_the_replies_of_the_standard(framing: str, request_pdu: str, reply_pdu: str) -> None:
    reply = ENCODE[framing](reply_pdu, 17)
    with serving_tcp(tcp_config(framing=framing)) as slave, slave.client() as client:
        assert client.ask(ENCODE[framing](request_pdu, 17), len(reply)) == reply


def test_the_examples_of_rtu_and_ascii_over_tcp_are_answered_byte_for_byte() -> None:
    with serving_tcp(tcp_config(framing="rtu", unit=1)) as slave, slave.client() as client:
        reply = bytes.fromhex("01 03 06 02 2B 00 00 00 64 05 7A")
        assert client.ask(bytes.fromhex("01 03 00 6B 00 03 74 17"), len(reply)) == reply
    with serving_tcp(tcp_config(framing="ascii", unit=1)) as slave, slave.client() as client:
        answer = b":010306022B0000006465\r\n"
        assert client.ask(b":0103006B00038E\r\n", len(answer)) == answer


@pytest.mark.parametrize("framing", ENCODE)
def test_serial_frames_over_tcp_know_one_unit_and_broadcasts(framing: str) -> None:
    encode = ENCODE[framing]
    with serving_tcp(tcp_config(framing=framing)) as slave, slave.client() as client:
        reply = encode(FOUND_PDU, 17)
        for unit in (18, 255):
            client.send(encode("06 00 01 00 03", unit))  # a foreign request
            client.send(encode("06 00 01 00 03", unit))  # and its reply
        client.send(encode("06 00 02 00 04", 0))
        assert client.ask(encode(READ_PDU, 17), len(reply)) == reply
        (known,) = slave.task.clients.values()
        for counters in (known.server.counters, slave.task.counters):
            assert (counters.foreign, counters.broadcasts) == (4, 1)
        assert holding(slave.register, 1, 2) == [0, 4]


@pytest.mark.parametrize("framing", ENCODE)
def test_serial_frames_over_tcp_may_come_in_pieces(framing: str) -> None:
    request, reply = ENCODE[framing](READ_PDU, 17), ENCODE[framing](FOUND_PDU, 17)
    with serving_tcp(tcp_config(framing=framing, character_timeout=PATIENCE_S)) as slave, slave.client() as client:
        (known,) = slave.task.clients.values()
        for cut in range(1, len(request)):
            client.send(request[:cut])
            slave.run.wait_until(lambda cut=cut: known.framer.pending == cut)  # type: ignore[misc]
            client.send(request[cut:])
            assert client.receive(len(reply)) == reply


@pytest.mark.parametrize("framing", ENCODE)
def test_a_part_of_a_serial_frame_over_tcp_is_forgotten_and_counted_after_the_character_timeout(framing: str) -> None:
    request, reply = ENCODE[framing](READ_PDU, 17), ENCODE[framing](FOUND_PDU, 17)
    config = tcp_config(framing=framing, character_timeout=SHORT_S)
    with serving_tcp(config, wait_limit_s=NEVER_S) as slave, slave.client() as client:
        client.send(request[:4])
        slave.run.wait_until(lambda: slave.task.counters.damaged)
        (known,) = slave.task.clients.values()
        assert (known.framer.pending, known.server.counters.damaged) == (0, 1)
        assert client.ask(request, len(reply)) == reply
        assert (slave.task.counters.damaged, slave.task.counters.requests) == (1, 1)


def test_a_part_of_a_tcp_frame_is_never_forgotten() -> None:
    with serving_tcp(tcp_config(character_timeout=1e-6)) as slave, slave.client() as client:
        client.send(READ[:4])
        (known,) = slave.task.clients.values()
        slave.run.wait_until(lambda: known.framer.pending == 4)
        slave.run.come_round()
        slave.run.come_round()
        assert client.ask(READ[4:], len(FOUND)) == FOUND


@pytest.mark.parametrize(
    ("framing", "damaged"),
    [("rtu", rtu_frame("06 00 01 00 03")[:-1] + b"\x00"), ("ascii", b":110600010003E4\r\n")],
)
def test_a_damaged_serial_frame_over_tcp_gets_no_answer(framing: str, damaged: bytes) -> None:
    request, reply = ENCODE[framing](READ_PDU, 17), ENCODE[framing](FOUND_PDU, 17)
    with serving_tcp(tcp_config(framing=framing)) as slave, slave.client() as client:
        client.send(damaged)
        slave.run.wait_until(lambda: slave.task.counters.damaged == 1)
        assert client.ask(request, len(reply)) == reply
        assert holding(slave.register, 1) == [0]


# ------------------------------------------------------------------------------------------------ several threads


def test_a_32_bit_value_written_by_one_client_never_tears_for_another() -> None:
    register = a_register()
    torn: list[bytes] = []
    seen: set[bytes] = set()
    done = threading.Event()

    def read_on(port: int) -> None:
        with raw_client(port) as reader:
            while not done.is_set():
                pair = reader.ask(tcp_frame(1, "03 00 0A 00 02"), 13)[9:]
                seen.add(pair)
                if pair[:2] != pair[2:]:
                    torn.append(pair)

    with (
        serving_tcp(tcp_config(), register) as one,
        serving_tcp(tcp_config(name="plc"), register) as two,
        one.client() as writer,
    ):
        readers = [threading.Thread(target=read_on, args=(slave.port,)) for slave in (one, two, two)]
        for reader in readers:
            reader.start()
        for number in range(2000):
            word = f"{number:04X}"
            assert len(writer.ask(tcp_frame(number, f"10 00 0A 00 02 04 {word} {word}"), 12)) == 12
        done.set()
        for reader in readers:
            reader.join()
    assert not torn
    assert len(seen) > 100  # the readers did look in between
