"""Retained values on a disk that really does not answer: an alarm, no hang, and in the end the newest values."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.modbus.pdu import Table
from gateway.register import DataRegister
from gateway.retained import (
    ANSWER_LIMIT_S,
    EVERY_S,
    FORGET_LIMIT_S,
    STOP_LIMIT_S,
    TASK_NAME,
    Points,
    RetainedFile,
    Retainer,
    decode,
)
from tests.fakes import JumpingClock, JumpingWaker, words
from tests.lines import PATIENCE_S
from tests.points import scada

HOLDING: Points = {Table.HOLDING_REGISTERS: frozenset()}
SLOW = "retained.bin is not saved: the disk does not answer"


class Disk:
    """A disk on which nothing is flushed until the test has it ``answers``."""

    def __init__(self) -> None:
        self.asked, self.answers = threading.Semaphore(0), threading.Event()
        self._fsync = os.fsync

    def fsync(self, descriptor: int) -> None:
        self.asked.release()
        assert self.answers.wait(PATIENCE_S)
        self._fsync(descriptor)

    def is_asked(self) -> bool:
        """Wait until somebody waits for it."""
        return self.asked.acquire(timeout=PATIENCE_S)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    disk = Disk()
    monkeypatch.setattr(os, "fsync", disk.fsync)
    yield disk
    disk.answers.set()
    all_written()


@pytest.fixture
def file(tmp_path: Path) -> RetainedFile:
    return RetainedFile(tmp_path / "retained.bin")


def all_written() -> None:
    """Wait for whatever waits for the disk."""
    for thread in threading.enumerate():
        if thread.name == TASK_NAME:
            thread.join(PATIENCE_S)
            assert not thread.is_alive()


def saved(file: RetainedFile) -> list[bytes]:
    return [block.values for block in decode(file.path.read_bytes()).blocks]


class Turns:
    """A task on a fake clock: its waits pass at once, its writes are real."""

    def __init__(self, file: RetainedFile, register: DataRegister, clock: JumpingClock) -> None:
        self.task = Retainer(file, register, HOLDING, clock, JumpingWaker(clock))
        self.clock = clock
        self.stop = threading.Event()
        self.flags_s: list[float] = []

    def run_s(self, seconds: float) -> None:
        until_s = self.clock.monotonic() + seconds
        while self.clock.monotonic() < until_s:
            self.task.step()

    def run_until_s(self, seconds: float) -> None:
        """Run as in its thread; it is told to stop after *seconds*."""
        until_s = self.clock.monotonic() + seconds

        def alive() -> None:
            self.flags_s.append(self.clock.monotonic())
            if self.flags_s[-1] >= until_s:
                self.stop.set()

        self.task.run(self.stop, alive)


@pytest.fixture
def turns(file: RetainedFile, register: DataRegister, clock: JumpingClock) -> Turns:
    return Turns(file, register, clock)


def test_a_write_that_is_stuck_is_told_after_its_limit_and_the_flag_goes_on_being_raised(
    turns: Turns, register: DataRegister, disk: Disk, caplog: pytest.LogCaptureFixture
) -> None:
    scada(register, 5, 7)
    turns.run_s(EVERY_S + ANSWER_LIMIT_S - 3)
    assert disk.is_asked()
    assert turns.task.trouble == ""
    turns.run_until_s(3600.0)
    assert turns.task.trouble == SLOW
    assert caplog.messages == [f"retained values: {SLOW}"]
    assert len(turns.flags_s) > 1000
    assert max(after - before for before, after in zip(turns.flags_s, turns.flags_s[1:], strict=False)) <= 3.0


def test_the_end_does_not_wait_for_a_disk_that_has_not_answered_for_a_minute(
    turns: Turns, register: DataRegister, disk: Disk
) -> None:
    scada(register, 5, 7)
    turns.run_s(EVERY_S + 2 * ANSWER_LIMIT_S)
    assert turns.task.trouble == SLOW
    began_s = time.monotonic()
    turns.run_until_s(0.0)
    turns.task.save_last()
    assert time.monotonic() - began_s < STOP_LIMIT_S / 2


def test_the_end_waits_for_a_disk_once_and_not_again(
    turns: Turns, register: DataRegister, disk: Disk, caplog: pytest.LogCaptureFixture
) -> None:
    scada(register, 5, 7)
    began_s = time.monotonic()
    turns.run_until_s(0.0)
    turns.task.save_last()
    assert STOP_LIMIT_S <= time.monotonic() - began_s < 1.3 * STOP_LIMIT_S
    assert caplog.messages == [f"retained values: {SLOW}"]


def test_a_write_that_ends_after_all_is_good_and_what_is_newer_follows(
    turns: Turns, register: DataRegister, disk: Disk, file: RetainedFile, caplog: pytest.LogCaptureFixture
) -> None:
    scada(register, 5, 7)
    turns.run_s(EVERY_S + 2 * ANSWER_LIMIT_S)
    scada(register, 5, 8)
    disk.answers.set()
    all_written()
    assert saved(file) == [words(7)]
    turns.run_s(4)
    assert turns.task.trouble == ""
    turns.run_until_s(0.0)
    assert saved(file) == [words(8)]
    assert caplog.messages == [f"retained values: {SLOW}", "retained values: saved again"]


def test_a_write_that_was_held_up_never_replaces_a_newer_one_of_another_task(
    turns: Turns, register: DataRegister, clock: JumpingClock, disk: Disk, file: RetainedFile
) -> None:
    scada(register, 5, 7)
    turns.run_s(EVERY_S + 2 * ANSWER_LIMIT_S)
    assert disk.is_asked()
    turns.run_until_s(0.0)  # a reload makes the task anew
    scada(register, 5, 8)
    newer = Turns(file, register, clock)
    newer.run_s(2 * EVERY_S)
    assert not disk.asked.acquire(blocking=False)  # the newer one waits for its turn
    disk.answers.set()
    all_written()
    assert saved(file) == [words(8)]


def test_forgetting_does_not_wait_for_a_disk_that_does_not_answer_and_is_done_when_it_does(
    file: RetainedFile, disk: Disk, caplog: pytest.LogCaptureFixture
) -> None:
    file.path.write_bytes(b"old values")
    began_s = time.monotonic()
    file.forget()
    assert time.monotonic() - began_s < 3 * FORGET_LIMIT_S
    assert caplog.messages == ["retained values: retained.bin is still there: the disk does not answer"]
    assert disk.is_asked()
    disk.answers.set()
    all_written()
    assert not file.path.exists()


def test_what_is_forgotten_while_it_is_being_written_does_not_come_back(
    turns: Turns, register: DataRegister, disk: Disk, file: RetainedFile
) -> None:
    scada(register, 5, 7)
    turns.run_s(EVERY_S + 2 * ANSWER_LIMIT_S)
    assert disk.is_asked()
    turns.run_until_s(0.0)
    file.forget()
    disk.answers.set()
    all_written()
    assert not file.path.exists()
