"""A change of configuration on the running station, with real lines: it acts at once, and only where it has to."""

from __future__ import annotations

import random
import termios
import threading
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from gateway.register import Quality
from gateway.simulator import Device, Simulator
from tests.changing import (
    HOLDING,
    changing_station,
    descriptors,
    descriptors_on,
    master,
    read,
    section,
    serial_master,
    serial_slave,
    slave,
    write,
)
from tests.lines import PATIENCE_S, RawClient, pty_pair, raw_client, rtu_frame, tcp_frame
from tests.peers import free_port

READ_ONE = "03 0000 0001"
NOT_HERE = "83 0B"  # exception 0x0B: another unit, or old data


@pytest.fixture
def simulator() -> Iterator[Simulator]:
    with Simulator() as simulator:
        yield simulator


def a_device(unit: int, *values: int) -> Device:
    device = Device(f"device {unit}", unit)
    device.set(HOLDING, 107, values)
    return device


def ask(client: RawClient, pdu: str, answer: str, unit: int = 1) -> bool:
    """Ask on a connection; return whether *answer* came."""
    expected = tcp_frame(7, answer, unit)
    return client.ask(tcp_frame(7, pdu, unit), len(expected)) == expected


# ------------------------------------------------------------------------------------------------ masters


def test_a_new_request_is_polled_and_one_taken_away_is_not(simulator: Simulator) -> None:
    device, port = a_device(17, 555, 556), free_port()
    line, scada = simulator.add_serial([device]), slave("scada", port)
    with changing_station(serial_master("field", line, read(0)), scada) as station, raw_client(port) as client:
        station.wait_for_value(0, 555)
        assert station.sample(1).quality is Quality.NEVER
        station.change(serial_master("field", line, read(0), read(1, address=108)), scada)
        station.wait_for_value(1, 556)
        assert ask(client, "03 0000 0002", "03 04 022B 022C")
        station.change(serial_master("field", line, read(1, address=108)), scada)
        device.set(HOLDING, 107, [777, 778])
        station.wait_for_value(1, 778)
        assert station.value(0) == 555
        assert ask(client, "03 0000 0002", "03 04 022B 030A")  # on the same connection all the time


def test_another_unit_address_and_place_are_polled_at_once(simulator: Simulator) -> None:
    line = simulator.add_serial([a_device(17, 1, 2), a_device(18, 3, 4)])
    with changing_station(serial_master("field", line, read(0))) as station:
        station.wait_for_value(0, 1)
        station.change(serial_master("field", line, read(5, unit=18, address=108)))
        station.wait_for_value(5, 4)


def speed(descriptor: int) -> int:
    code: int = termios.tcgetattr(descriptor)[4]
    return code


def test_a_speed_reopens_its_port_and_leaves_the_other_line_alone(simulator: Simulator) -> None:
    touched, other = simulator.add_serial([a_device(17, 1)]), simulator.add_serial([a_device(17, 2)])
    there = {path: descriptors_on(path) for path in (touched, other)}

    def port_of(path: str) -> set[int]:
        return descriptors_on(path) - there[path]

    with changing_station(
        serial_master("touched", touched, read(0)), serial_master("other", other, read(1))
    ) as station:
        station.wait_for_value(0, 1)
        station.wait_for_polls("other")
        before, task, old = port_of(other), station.master("other"), station.master("touched")
        assert [speed(descriptor) for descriptor in port_of(touched)] == [termios.B19200]
        polls = task.counters.good
        station.change(
            serial_master("touched", touched, read(0), baudrate=115200), serial_master("other", other, read(1))
        )
        assert [speed(descriptor) for descriptor in port_of(touched)] == [termios.B115200]
        assert station.master("touched") is not old
        station.wait_for_polls("touched")
        assert (station.master("other"), port_of(other)) == (task, before)
        assert [speed(descriptor) for descriptor in before] == [termios.B19200]
        assert task.counters.good >= polls > 0


def test_a_line_switched_off_and_on_keeps_its_task_and_its_counters_and_lets_go_of_its_port(
    simulator: Simulator,
) -> None:
    device = a_device(17, 1)
    line = simulator.add_serial([device])
    there = descriptors_on(line)
    with changing_station(serial_master("field", line, read(0, stale_after=60.0))) as station:
        station.wait_for_value(0, 1)
        task, polls = station.master("field"), station.master("field").counters.good
        station.change(serial_master("field", line, read(0, stale_after=60.0), enabled=False))
        station.wait_until(lambda: descriptors_on(line) == there)
        assert station.master("field") is task
        assert task.state() == "maintenance"
        served, polls = device.served, task.counters.good
        device.set(HOLDING, 107, [2])
        station.change(serial_master("field", line, read(0, stale_after=60.0)))
        station.wait_for_value(0, 2)
        assert station.master("field") is task
        assert task.counters.good > polls > 0
        assert device.served > served


def test_a_line_that_is_off_is_changed_and_stays_off_until_it_is_switched_on(simulator: Simulator) -> None:
    device = a_device(17, 1, 2)
    line = simulator.add_serial([device])
    with changing_station(serial_master("field", line, read(0), enabled=False)) as station:
        task = station.master("field")
        station.change(serial_master("field", line, read(0, address=108), enabled=False))
        assert station.master("field") is not task
        assert (device.served, station.master("field").enabled) == (0, False)
        station.change(serial_master("field", line, read(0, address=108)))
        station.wait_for_value(0, 2)


def test_a_deleted_master_lets_go_of_its_port_and_its_points(simulator: Simulator) -> None:
    """Its points count as old while it cannot fill them, and are anybody's once it is gone."""
    device, port = a_device(17, 1), free_port()
    line = simulator.add_serial([device])
    there, scada = descriptors_on(line), slave("scada", port, stale="exception")
    with (
        changing_station(serial_master("field", line, read(0), write(9)), scada) as station,
        raw_client(port) as client,
    ):
        station.wait_for_value(0, 1)
        device.silent = True
        station.wait_until(lambda: station.sample(0).quality is Quality.BAD)
        assert ask(client, READ_ONE, NOT_HERE)
        assert ask(client, "06 0009 0007", "06 0009 0007")  # waits for the silent device
        station.change(scada)
        assert descriptors_on(line) == there
        assert list(station.station.masters) == []
        assert ask(client, READ_ONE, "03 02 0001")
        assert station.sample(9).quality is Quality.BAD  # what SCADA wrote was not delivered, and says so
        for number in range(200):  # more than a queue of commands holds
            assert ask(client, f"06 0009 {number:04X}", f"06 0009 {number:04X}")
        assert station.sample(9).quality is Quality.GOOD
        device.silent = False
        station.change(serial_master("field", line, read(9)), scada)
        station.wait_for_value(9, 1)  # no command of the old one holds the point
    assert list(device.writes) == []


def test_two_masters_change_places_in_one_step(simulator: Simulator, caplog: pytest.LogCaptureFixture) -> None:
    """Ports are opened exclusively: both have to be let go before either is opened again."""
    left, right = simulator.add_serial([a_device(17, 1)]), simulator.add_serial([a_device(18, 2)])
    with changing_station(serial_master("a", left, read(0)), serial_master("b", right, read(1, unit=18))) as station:
        for _ in range(5):
            station.wait_for_polls("a")
            station.wait_for_polls("b")
            station.change(serial_master("a", right, read(0, unit=18)), serial_master("b", left, read(1)))
            station.wait_for_value(0, 2)
            station.wait_for_value(1, 1)
            station.change(serial_master("a", left, read(0)), serial_master("b", right, read(1, unit=18)))
            station.wait_for_value(0, 1)
            station.wait_for_value(1, 2)
    assert "is used by another program" not in caplog.text


def test_a_line_that_could_not_be_opened_is_opened_at_once_after_a_change(simulator: Simulator) -> None:
    with changing_station(serial_master("field", "/dev/no-such-port", read(0))) as station:
        station.wait_until(lambda: "is not there" in station.master("field").trouble)
        station.change(master("field", f"tcp://127.0.0.1:{simulator.add_tcp([a_device(17, 1)])}", read(0)))
        station.wait_for_value(0, 1)
        assert station.master("field").trouble == ""


def test_a_setpoint_written_after_the_change_goes_where_the_new_request_says(simulator: Simulator) -> None:
    old, new, port = a_device(17, 1), a_device(18, 1), free_port()
    line, scada = simulator.add_serial([old, new]), slave("scada", port)
    with changing_station(serial_master("field", line, write(0)), scada) as station, raw_client(port) as client:
        assert ask(client, "06 0000 0005", "06 0000 0005")
        station.wait_until(lambda: list(old.writes) == [(HOLDING, 107, [5])])
        station.change(serial_master("field", line, write(0, unit=18)), scada)
        assert ask(client, "06 0000 0006", "06 0000 0006")
        station.wait_until(lambda: list(new.writes) == [(HOLDING, 107, [6])])
    assert len(old.writes) == 1


# ------------------------------------------------------------------------------------------------ slaves


def test_a_slave_answers_to_its_new_unit_while_clients_of_the_other_stay_connected() -> None:
    moved, other = free_port(), free_port()
    with (
        changing_station(slave("moved", moved), slave("other", other)) as station,
        raw_client(moved) as old,
        raw_client(other) as client,
    ):
        assert ask(old, READ_ONE, "03 02 0000")
        assert ask(client, READ_ONE, "03 02 0000")
        task = station.tcp_slave("other")
        station.change(slave("moved", moved, unit=2), slave("other", other))
        assert old.is_closed()
        with raw_client(moved) as new:
            assert ask(new, READ_ONE, "03 02 0000", unit=2)
            assert ask(new, READ_ONE, NOT_HERE, unit=1)
        assert ask(client, READ_ONE, "03 02 0000")
        assert station.tcp_slave("other") is task
        assert task.counters.requests == 2


def test_a_serial_slave_answers_to_its_new_unit_and_not_to_the_old() -> None:
    with pty_pair() as line, changing_station(serial_slave("plc", line.device)) as station:
        line.send(rtu_frame("03 0000 0001", unit=1))
        assert line.receive(7) == rtu_frame("03 02 0000", unit=1)
        station.change(serial_slave("plc", line.device, unit=2))
        line.send(rtu_frame("03 0000 0001", unit=1))
        task = station.serial_slave("plc")
        station.wait_until(lambda: task.counters.foreign == 1)
        line.send(rtu_frame("03 0000 0001", unit=2))
        assert line.receive(7) == rtu_frame("03 02 0000", unit=2)


def test_two_slaves_change_ports_in_one_step(caplog: pytest.LogCaptureFixture) -> None:
    first, second = free_port(), free_port()
    with changing_station(slave("a", first), slave("b", second, unit=2)) as station, raw_client(first) as old:
        assert ask(old, READ_ONE, "03 02 0000", unit=1)
        station.change(slave("a", second), slave("b", first, unit=2))
        with raw_client(first) as now_b, raw_client(second) as now_a:
            assert ask(now_a, READ_ONE, "03 02 0000", unit=1)
            assert ask(now_b, READ_ONE, "03 02 0000", unit=2)
    assert caplog.messages == []


def test_a_slave_switched_off_and_on_keeps_its_counters_and_lets_its_clients_go_meanwhile() -> None:
    port = free_port()
    with changing_station(slave("scada", port)) as station:
        task = station.tcp_slave("scada")
        with raw_client(port) as client:
            assert ask(client, READ_ONE, "03 02 0000")
            station.change(slave("scada", port, enabled=False))
            assert client.is_closed()
        station.wait_until(lambda: task.port is None)
        station.change(slave("scada", port))
        station.wait_until(lambda: task.port == port)
        with raw_client(port) as client:
            assert ask(client, READ_ONE, "03 02 0000")
        assert station.tcp_slave("scada") is task
        assert task.counters.requests == 2


def test_the_exception_status_follows_the_masters_of_the_present_configuration() -> None:
    broken, well = serial_master("broken", "/dev/no-such-port", read(0)), serial_master("off", "", enabled=False)
    with pty_pair() as line:
        plc = serial_slave("plc", line.device)

        def status() -> int:
            line.send(rtu_frame("07", unit=1))
            reply = line.receive(5)
            assert reply[:2] == b"\x01\x07"
            return reply[2]

        with changing_station(well, broken, plc) as station:
            station.wait_until(lambda: bool(station.master("broken").trouble))
            task = station.serial_slave("plc")
            assert status() == 0b10
            station.change(broken, well, plc)
            assert status() == 0b01
            station.change(well, plc)
            assert status() == 0
            assert station.serial_slave("plc") is task


# ------------------------------------------------------------------------------------------------ the register


def test_new_sizes_keep_the_values_of_the_points_that_remain(simulator: Simulator) -> None:
    port, line = free_port(), f"tcp://127.0.0.1:{simulator.add_tcp([a_device(17, 1)])}"
    lines = master("field", line, read(0)) + slave("scada", port)
    with changing_station(section("[register]", holding_registers=100), lines) as station:
        with raw_client(port) as client:
            station.wait_for_value(0, 1)
            assert ask(client, "06 0031 0007", "06 0031 0007")
            assert ask(client, "06 0063 0008", "06 0063 0008")
            assert ask(client, "03 0064 0001", "83 02")
        for size, found in ((50, "83 02"), (2000, "03 02 0000")):
            station.change(section("[register]", holding_registers=size), lines)
            with raw_client(port) as client:
                assert ask(client, "03 0031 0001", "03 02 0007")
                assert ask(client, "03 0063 0001", found)
                assert ask(client, "03 0000 0001", "03 02 0001")
            station.wait_for_polls("field")


def test_other_sizes_and_requests_at_the_new_end_come_in_one_step(simulator: Simulator) -> None:
    line = f"tcp://127.0.0.1:{simulator.add_tcp([a_device(17, 1)])}"
    with changing_station(master("field", line, read(1999))) as station:
        station.wait_for_value(1999, 1)
        station.change(section("[register]", holding_registers=10), master("field", line, read(9)))
        station.wait_for_value(9, 1)
        station.change(section("[register]", holding_registers=65536), master("field", line, read(65535)))
        station.wait_for_value(65535, 1)


# ------------------------------------------------------------------------------------------------ events


def test_events_that_wait_stay_when_requests_change_and_new_ones_are_watched(simulator: Simulator) -> None:
    device, port = a_device(17, 1, 1), free_port()
    line, events = f"tcp://127.0.0.1:{simulator.add_tcp([device])}", section("[events]", fifo_point=9)
    scada = slave("scada", port)
    with (
        changing_station(events, master("field", line, read(0, events=True)), scada) as station,
        raw_client(port) as client,
    ):
        station.wait_for_value(0, 1)
        device.set(HOLDING, 107, [2])
        station.wait_until(lambda: station.station.events.waiting == 1)
        station.change(events, master("field", line, read(0), read(1, address=108, events=True)), scada)
        station.wait_for_value(1, 1)
        device.set(HOLDING, 107, [3, 3])
        station.wait_until(lambda: station.station.events.waiting == 2)
        client.send(tcp_frame(1, "18 0009", unit=1))
        head, first, second = client.receive(16), client.receive(14), client.receive(14)
        assert head[-4:] == bytes.fromhex("0002 0000")  # 2 wait, none was lost
        assert first[:8] == bytes.fromhex("0001 0003 0000 0002")
        assert second[:8] == bytes.fromhex("0002 0003 0001 0003")


def test_the_event_block_moves_with_the_size_of_its_table(simulator: Simulator) -> None:
    device, port = a_device(17, 1), free_port()
    line = f"tcp://127.0.0.1:{simulator.add_tcp([device])}"
    lines = master("field", line, read(0, events=True)) + slave("scada", port)
    with changing_station(section("[events]", block_point=1800), lines) as station:
        station.wait_for_value(0, 1)
        device.set(HOLDING, 107, [2])
        station.wait_until(lambda: station.value(1801) == 1)
        small = section("[register]", holding_registers=30) + section("[events]", block_point=10)
        station.change(small, lines)  # room for two changes
        assert [station.value(point) for point in range(10, 17)] == [0, 1, 0, 1, 3, 0, 2]
        station.change(section("[register]", holding_registers=5000), section("[events]", block_point=4000), lines)
        assert [station.value(point) for point in range(4000, 4007)] == [0, 1, 0, 1, 3, 0, 2]
        station.change(lines)
        assert station.station.events.waiting == 1


# ------------------------------------------------------------------------------------------------ many changes


class Field:
    """Lines with devices, ports for slaves, and random configurations of them; one master and one slave stay."""

    def __init__(self, simulator: Simulator, rng: random.Random) -> None:
        self.rng = rng
        self.devices = [a_device(unit, *range(unit, unit + 10)) for unit in (17, 18, 19)]
        self.paths = [simulator.add_serial(self.devices[:1]), simulator.add_serial(self.devices[1:2])]
        self.tcp = [f"tcp://127.0.0.1:{simulator.add_tcp(self.devices[2:])}"]
        self.steady_device = a_device(17, 4711)
        self.steady_line = f"tcp://127.0.0.1:{simulator.add_tcp([self.steady_device])}"
        self.steady_port, *self.ports = (free_port() for _ in range(4))

    def text(self) -> str:
        """Return a configuration: up to three masters on their lines, up to three slaves on their ports."""
        rng = self.rng
        parts = [section("[events]", fifo_point=9, block_point=rng.choice([-1, 1800, 1700]))]
        parts += [master("steady", self.steady_line, read(1000)), slave("scada", self.steady_port)]
        for number, line in enumerate(rng.sample(self.paths + self.tcp, rng.randrange(4))):
            unit = 17 + (self.paths + self.tcp).index(line)
            requests = [
                read(100 * number + i, unit, address=107 + i, events=rng.random() < 0.5)
                for i in range(rng.randrange(4))
            ]
            keys = {"enabled": rng.random() < 0.8, "baudrate": rng.choice([9600, 19200, 115200])}
            make = master if line.startswith("tcp") else serial_master
            parts.append(make(f"m{number}", line, *requests, write(50 + number, unit), **keys))
        for number, port in enumerate(rng.sample(self.ports, rng.randrange(4))):
            parts.append(slave(f"s{number}", port, unit=rng.randrange(1, 4), enabled=rng.random() < 0.8))
        return "".join(parts)


class Scada(threading.Thread):
    """A client that asks without a pause, on one connection; any answer but the right one ends it."""

    def __init__(self, port: int) -> None:
        super().__init__(name="scada of the test")
        self.answers = 0
        self.error = ""
        self._client = RawClient(port)
        self._ended = threading.Event()

    def run(self) -> None:
        while not self._ended.is_set() and not self.error:
            point = self.answers % 3
            if not ask(self._client, "03 03E8 0001", "03 02 1267"):
                self.error = f"after {self.answers} answers a wrong one, or none"
            if not ask(self._client, f"06 {50 + point:04X} 0001", f"06 {50 + point:04X} 0001"):
                self.error = f"after {self.answers} answers a write was refused"
            self.answers += 1

    def end(self) -> None:
        self._ended.set()
        self.join(PATIENCE_S)
        self._client.close()


def test_100_random_changes_under_load_leave_nothing_over_and_scada_notices_none(
    caplog: pytest.LogCaptureFixture,
) -> None:
    before = descriptors()
    with Simulator() as simulator:
        field = Field(simulator, random.Random(1))
        with changing_station(field.text()) as station, ExitStack() as at_the_end:
            station.wait_for_value(1000, 4711)
            steady = station.master("steady"), station.tcp_slave("scada")
            scada = Scada(field.steady_port)
            at_the_end.callback(scada.end)
            scada.start()
            for _ in range(100):
                answers = scada.answers
                station.change(field.text())
                wanted = {line.name for line in station.station.config.master + station.station.config.slave}
                assert set(station.supervisor.tasks) == wanted
                living = {thread.name for thread in threading.enumerate()}
                assert living >= wanted
                assert not {name for name in living - wanted if name[0] in "ms" and name[1:].isdigit()}
                station.wait_until(lambda answers=answers: scada.answers > answers or bool(scada.error))  # type: ignore[misc] # a default binds the loop's value
            assert (scada.error, scada.is_alive()) == ("", True)
            assert (station.master("steady"), station.tcp_slave("scada")) == steady
        assert [message for message in caplog.messages if "ended with an error" in message] == []
    assert sorted(descriptors().values()) == sorted(before.values())


def test_changes_that_come_faster_than_tasks_start_end_in_the_last_one_and_leave_nothing_over(
    caplog: pytest.LogCaptureFixture,
) -> None:
    before, rng = descriptors(), random.Random(2)
    with Simulator() as simulator:
        field = Field(simulator, rng)
        with changing_station(field.text()) as station:
            for _ in range(60):
                sizes = {"holding_registers": rng.choice([2000, 2001, 65536]), "coils": rng.choice([1, 2000])}
                station.submit(section("[register]", **sizes) + field.text())
            station.change(field.text())
            station.wait_for_value(1000, 4711)
            station.wait_for_polls("steady")
            assert station.register.size(HOLDING) == 2000
        assert [message for message in caplog.messages if "ended with an error" in message] == []
    assert sorted(descriptors().values()) == sorted(before.values())
