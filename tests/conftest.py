"""What every test gets: a clock that jumps, a register, and the proof that no thread was left behind."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from gateway.register import DataRegister
from tests.fakes import JumpingClock


@pytest.fixture(autouse=True)
def no_thread_is_left_behind() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    for thread in set(threading.enumerate()) - before:
        thread.join(timeout=2.0)
    left = [thread.name for thread in set(threading.enumerate()) - before]
    assert not left, f"threads left running: {left}"


@pytest.fixture
def clock() -> JumpingClock:
    return JumpingClock()


@pytest.fixture
def register(clock: JumpingClock) -> DataRegister:
    return DataRegister(clock)
