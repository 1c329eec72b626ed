"""What the menu's tests get: two stations with a person at the menu; times of day as in UTC."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from tests.hmi.desk import Desk, desk_of


@pytest.fixture(autouse=True)
def times_are_utc(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "UTC")
        time.tzset()
        yield
    time.tzset()


@pytest.fixture
def boiler() -> Desk:
    return desk_of("boiler")


@pytest.fixture
def plant() -> Desk:
    return desk_of("plant")
