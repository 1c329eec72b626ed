"""The task that writes retained values: when it writes, when it does not, and what it says of a disk that fails."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.errors import SaveError
from gateway.link import Waker
from gateway.modbus.pdu import Table
from gateway.register import DataRegister, Kept, Quality
from gateway.retained import ANSWER_LIMIT_S, EVERY_S, Points, RetainedFile, Retainer, Snapshot, decode, encode
from gateway.supervisor import Plan, Supervisor
from tests.fakes import JumpingClock, JumpingWaker, words
from tests.lines import PATIENCE_S
from tests.points import POLL, coils, holding, poll, scada
from tests.tasks import running

HOLDING: Points = {Table.HOLDING_REGISTERS: frozenset()}


class CountingFile(RetainedFile):
    """The real file, which counts what is written; *failing*: why it cannot be."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.written: list[bytes] = []
        self.tries = 0
        self.failing = ""

    def write(self, content: bytes) -> None:
        self.tries += 1
        if self.failing:
            raise SaveError(self.failing)
        super().write(content)
        self.written.append(content)

    def values(self) -> dict[int, bytes]:
        """First points of the blocks in the file, and their values."""
        return {block.span.start: block.values for block in decode(self.path.read_bytes()).blocks}


class Bench:
    """A retainer on a fake clock, whose writes are done at once, or when the test says so."""

    def __init__(self, folder: Path, clock: JumpingClock, points: Points = HOLDING) -> None:
        self.clock = clock
        self.register = DataRegister(clock)
        self.file = CountingFile(folder / "retained.bin")
        self.waker = JumpingWaker(clock)
        self.is_disk_slow = False
        self.held_back: list[Callable[[], None]] = []
        self.task = self.made(points)

    def made(self, points: Points = HOLDING) -> Retainer:
        return Retainer(self.file, self.register, points, self.clock, self.waker, 5.0, self._start)

    def _start(self, work: Callable[[], None]) -> None:
        if self.is_disk_slow:
            self.held_back.append(work)
        else:
            work()

    def run_s(self, seconds: float, meanwhile: Callable[[], None] = lambda: None) -> None:
        until_s, steps = self.clock.monotonic() + seconds, 0
        while self.clock.monotonic() < until_s:
            meanwhile()
            self.task.step()
            steps += 1
            assert steps < 10 + 2 * seconds, "it turns without waiting"

    def stop(self) -> None:
        stop = threading.Event()
        stop.set()
        self.task.run(stop, lambda: None)


@pytest.fixture
def bench(tmp_path: Path, clock: JumpingClock) -> Bench:
    return Bench(tmp_path, clock)


# ------------------------------------------------------------------------------------------------ when


def test_what_was_written_is_in_the_file_within_a_minute(bench: Bench) -> None:
    scada(bench.register, 5, 7, 8)
    bench.run_s(EVERY_S - 1)
    assert bench.file.written == []
    bench.run_s(2)
    assert bench.file.values() == {5: words(7, 8)}
    assert bench.task.trouble == ""


def test_after_a_quiet_minute_a_change_is_written_within_seconds(bench: Bench) -> None:
    bench.run_s(10 * EVERY_S)
    scada(bench.register, 5, 7)
    bench.run_s(3)
    assert bench.file.values() == {5: words(7)}


def test_values_that_change_all_the_time_are_written_once_a_minute(bench: Bench) -> None:
    numbers = iter(range(10**6))
    bench.run_s(60 * EVERY_S, lambda: scada(bench.register, 5, next(numbers) & 0xFFFF))
    assert 58 <= len(bench.file.written) <= 60


def test_a_file_that_cannot_be_written_is_tried_once_a_minute(bench: Bench) -> None:
    bench.file.failing = "the disk is full"
    scada(bench.register, 5, 7)
    bench.run_s(60 * EVERY_S)
    assert 58 <= bench.file.tries <= 60


def test_a_value_written_again_unchanged_is_no_change(bench: Bench) -> None:
    bench.run_s(60 * EVERY_S, lambda: scada(bench.register, 5, 7))
    assert len(bench.file.written) == 1


def test_quality_and_age_alone_are_no_change(bench: Bench) -> None:
    scada(bench.register, 5, 7, 8)
    bench.run_s(2 * EVERY_S)
    for quality in Quality:
        bench.register.mark(holding(5), quality, POLL)
        poll(bench.register, 6, 8)  # its source and its time are others now
        bench.run_s(2 * EVERY_S)
    assert len(bench.file.written) == 1


def test_that_a_point_is_known_or_a_command_is_a_change(bench: Bench) -> None:
    poll(bench.register, 5, 0)
    bench.run_s(2 * EVERY_S)
    scada(bench.register, 5, 0)
    bench.run_s(2 * EVERY_S)
    blocks = [decode(content).blocks[0] for content in bench.file.written]
    assert [(block.values, block.is_commanded) for block in blocks] == [(words(0), False), (words(0), True)]


def test_other_tables_and_points_left_out_are_no_change(tmp_path: Path, clock: JumpingClock) -> None:
    bench = Bench(tmp_path, clock, {Table.HOLDING_REGISTERS: frozenset({5}), Table.DISCRETE_INPUTS: frozenset()})
    bench.register.write(coils(0, 8), b"\xff", POLL)
    scada(bench.register, 5, 7)
    bench.run_s(2 * EVERY_S)
    assert bench.file.tries == 0
    scada(bench.register, 4, 6, 7, 8)
    bench.run_s(2 * EVERY_S)
    assert bench.file.values() == {4: words(6), 6: words(8)}


def test_nothing_is_written_while_nobody_writes(bench: Bench) -> None:
    bench.run_s(60 * EVERY_S)
    bench.stop()
    assert bench.file.tries == 0
    assert not bench.file.path.exists()


def test_while_nothing_is_touched_the_register_is_not_even_looked_at(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[Table] = []
    look = bench.register.copy_of_known

    def counted(table: Table) -> object:
        looks.append(table)
        return look(table)

    monkeypatch.setattr(bench.register, "copy_of_known", counted)
    bench.run_s(60 * EVERY_S)
    assert len(looks) == 1  # at its start it cannot know
    bench.run_s(60 * EVERY_S, lambda: scada(bench.register, 5, 7))
    assert 50 <= len(looks) <= 62  # once a minute, however often a value is written


# ------------------------------------------------------------------------------------------------ at the end


def test_at_the_end_the_last_values_are_written_at_once(bench: Bench) -> None:
    scada(bench.register, 5, 7)
    bench.stop()
    assert bench.task.ready.is_set()
    assert bench.file.values() == {5: words(7)}


def test_at_the_end_nothing_is_written_that_the_file_says_already(bench: Bench) -> None:
    scada(bench.register, 5, 7)
    bench.run_s(2 * EVERY_S)
    scada(bench.register, 5, 7)
    bench.stop()
    bench.task.save_last()
    assert len(bench.file.written) == 1


def test_what_is_written_after_the_task_has_ended_can_still_be_saved(bench: Bench) -> None:
    scada(bench.register, 5, 7)
    bench.stop()
    scada(bench.register, 5, 8)
    bench.task.save_last()
    assert bench.file.values() == {5: words(8)}


def test_after_its_end_it_watches_nothing(bench: Bench) -> None:
    bench.stop()
    bench.waker.waits_s.clear()
    scada(bench.register, 5, 7)
    bench.run_s(2 * EVERY_S)
    assert bench.file.tries == 0


def test_it_waits_no_longer_than_it_is_told_and_raises_its_flag(bench: Bench) -> None:
    stop, flags = threading.Event(), []

    def alive() -> None:
        flags.append(bench.clock.monotonic())
        scada(bench.register, 5, len(flags))
        if len(flags) == 200:
            stop.set()

    bench.task.run(stop, alive)
    assert max(bench.waker.waits_s) <= 3.0
    assert max(after - before for before, after in pairwise(flags)) <= 3.0


# ------------------------------------------------------------------------------------------------ over a restart


def test_what_came_back_from_the_file_is_not_written_again(bench: Bench) -> None:
    bench.file.path.write_bytes(
        encode(Snapshot(int(bench.clock.wall()), [Kept(holding(5, 2), words(7, 8), 9.0, True)]))
    )
    bench.file.restore(bench.register, bench.clock, [Table.HOLDING_REGISTERS])
    bench.run_s(2 * EVERY_S, lambda: poll(bench.register, 6, 8))
    bench.stop()
    assert bench.file.tries == 0


def test_points_that_the_register_has_no_more_leave_the_file(bench: Bench) -> None:
    kept = [Kept(holding(1999, 2), words(7, 8), 9.0, True), Kept(coils(0), b"1", 9.0, True)]
    bench.file.path.write_bytes(encode(Snapshot(int(bench.clock.wall()), kept)))
    bench.file.restore(bench.register, bench.clock, [Table.HOLDING_REGISTERS])
    bench.stop()
    assert [block.span for block in decode(bench.file.path.read_bytes()).blocks] == [holding(1999)]


def test_ages_go_on_over_restarts(bench: Bench) -> None:
    scada(bench.register, 5, 7)
    bench.clock.pass_s(10.0)
    bench.stop()
    for restart in range(1, 4):
        bench.clock.pass_s(100.0)
        bench.register = DataRegister(bench.clock)
        bench.file.restore(bench.register, bench.clock, [Table.HOLDING_REGISTERS])
        bench.task = bench.made()
        scada(bench.register, 9, restart)  # so that the file is written
        bench.clock.pass_s(10.0)
        bench.stop()
        assert bench.register.samples(holding(5))[0].age_s == 10.0 + 110.0 * restart


def test_a_damaged_file_is_an_alarm_until_a_sound_one_takes_its_place(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    bench.file.path.write_bytes(b"damaged")
    bench.file.restore(bench.register, bench.clock, [Table.HOLDING_REGISTERS])
    assert bench.task.trouble == "retained.bin is not used: its checksum does not fit"
    bench.run_s(EVERY_S - 1)
    assert bench.task.trouble != ""
    bench.run_s(2)
    assert bench.task.trouble == ""
    assert decode(bench.file.path.read_bytes()).blocks == []
    assert caplog.messages[-1] == "retained values: saved again"


# ------------------------------------------------------------------------------------------------ a disk that fails


def test_a_disk_that_fails_is_told_of_once_and_so_is_its_recovery(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    bench.file.failing = "no space left on the device"
    scada(bench.register, 5, 7)
    bench.run_s(10 * EVERY_S)
    assert bench.task.trouble == "no space left on the device"
    bench.file.failing = "the file system is read-only"
    bench.run_s(10 * EVERY_S)
    bench.file.failing = ""
    bench.run_s(2 * EVERY_S)
    assert bench.task.trouble == ""
    assert bench.file.values() == {5: words(7)}
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ("ERROR", "retained values: no space left on the device"),
        ("ERROR", "retained values: the file system is read-only"),
        ("WARNING", "retained values: saved again"),
    ]


def test_what_could_not_be_written_is_tried_at_the_end(bench: Bench) -> None:
    bench.file.failing = "no space left on the device"
    scada(bench.register, 5, 7)
    bench.run_s(2 * EVERY_S)
    bench.file.failing = ""
    bench.stop()
    assert bench.file.values() == {5: words(7)}


def test_after_a_failure_values_are_written_even_if_they_are_what_they_were_before_it(
    bench: Bench,
) -> None:
    scada(bench.register, 5, 7)
    bench.run_s(2 * EVERY_S)
    bench.file.failing = "may lose it in a power cut"
    scada(bench.register, 5, 8)
    bench.run_s(2 * EVERY_S)
    bench.file.failing = ""
    scada(bench.register, 5, 7)
    bench.run_s(2 * EVERY_S)
    assert len(bench.file.written) == 2


def test_a_slow_disk_is_an_alarm_and_no_hang(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench.is_disk_slow = True
    scada(bench.register, 5, 7)
    bench.run_s(EVERY_S + ANSWER_LIMIT_S - 2)
    assert (len(bench.held_back), bench.task.trouble) == (1, "")
    bench.run_s(5 * ANSWER_LIMIT_S, lambda: scada(bench.register, 5, 8))
    assert bench.task.trouble == "retained.bin is not saved: the disk does not answer"
    assert len(bench.held_back) == 1  # one at a time
    bench.held_back.pop()()
    assert bench.file.values() == {5: words(7)}
    bench.is_disk_slow = False
    bench.run_s(1)
    assert bench.task.trouble == ""
    bench.run_s(EVERY_S)
    assert bench.file.values() == {5: words(8)}
    assert [record.getMessage() for record in caplog.records] == [
        "retained values: retained.bin is not saved: the disk does not answer",
        "retained values: saved again",
    ]


def test_the_end_does_not_wait_for_a_disk_that_does_not_answer(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.retained.STOP_LIMIT_S", 0.01)
    bench.is_disk_slow = True
    scada(bench.register, 5, 7)
    bench.stop()
    assert bench.task.trouble == "retained.bin is not saved: the disk does not answer"
    assert len(bench.held_back) == 1
    bench.task.save_last()
    assert len(bench.held_back) == 1


def test_the_end_waits_for_the_write_on_its_way_and_writes_what_is_newer(bench: Bench) -> None:
    bench.is_disk_slow = True
    scada(bench.register, 5, 7)
    bench.run_s(EVERY_S + 1)
    scada(bench.register, 5, 8)
    bench.is_disk_slow = False
    threading.Thread(target=bench.held_back.pop()).start()
    bench.stop()
    assert [decode(content).blocks[0].values for content in bench.file.written] == [words(7), words(8)]
    assert bench.task.trouble == ""


# ------------------------------------------------------------------------------------------------ the real thing


def test_in_its_own_thread_with_a_real_disk(tmp_path: Path) -> None:
    clock, file = SystemClock(), RetainedFile(tmp_path / "state" / "retained.bin")
    register = DataRegister(clock)

    def make(waker: Waker) -> Retainer:
        return Retainer(file, register, HOLDING, clock, waker)

    with running(Supervisor([Plan("retained values", make)], clock)) as run:
        assert run.supervisor.tasks["retained values"].ready.wait(PATIENCE_S)
        run.supervisor.tasks["retained values"].set_enabled(False)  # it is never in maintenance
        run.supervisor.tasks["retained values"].wake()
        scada(register, 5, 7)
    assert run.was_clean
    assert [block.values for block in decode(file.path.read_bytes()).blocks] == [words(7)]


class ListeningWaker(Waker):
    """A real waker that knows whether its last wait was ended by a wake."""

    was_woken = False

    def wait(self, timeout_s: float | None) -> bool:
        self.was_woken = super().wait(timeout_s)
        return self.was_woken


def test_a_write_wakes_the_task_when_it_is_done(tmp_path: Path, clock: JumpingClock) -> None:
    waker, register, file = ListeningWaker(), DataRegister(clock), RetainedFile(tmp_path / "retained.bin")
    task = Retainer(file, register, HOLDING, clock, waker)
    scada(register, 5, 7)
    clock.pass_s(EVERY_S)
    task.step()  # begins the write, and waits for its end
    assert waker.was_woken
    assert file.path.exists()
    task.save_last()
    waker.close()
    assert file.said == [(Table.HOLDING_REGISTERS, 5, True, bytearray(words(7)))]


def test_a_bug_in_a_write_is_no_success(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(content: bytes) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(bench.file, "write", broken)
    scada(bench.register, 5, 7)
    bench.clock.pass_s(EVERY_S)
    with pytest.raises(ZeroDivisionError):
        bench.task.step()  # here the write runs in the same thread
    bench.task.step()
    assert bench.task.trouble == "it failed; the log says why"
    assert bench.file.said is None
    assert caplog.messages == ["retained values: it failed; the log says why"]


def test_changes_by_many_threads_are_all_in_the_file_at_the_end(tmp_path: Path) -> None:
    clock, waker = SystemClock(), Waker()
    register, file = DataRegister(clock), RetainedFile(tmp_path / "retained.bin")
    task = Retainer(file, register, HOLDING, clock, waker)
    stop = threading.Event()

    def write(point: int) -> None:
        for value in range(300):
            scada(register, point, value)

    writers = [threading.Thread(target=write, args=(point,)) for point in range(4)]
    runner = threading.Thread(target=task.run, args=(stop, lambda: None))
    for thread in [runner, *writers]:
        thread.start()
    for thread in writers:
        thread.join()
    stop.set()
    waker.end()
    runner.join()
    waker.close()
    assert file.said == [(Table.HOLDING_REGISTERS, 0, True, bytearray(words(299, 299, 299, 299)))]


def test_a_good_write_is_no_line_in_the_log(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        scada(bench.register, 5, 7)
        bench.run_s(2 * EVERY_S)
    assert caplog.text == ""
