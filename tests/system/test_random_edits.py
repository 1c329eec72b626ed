"""10,000 random edits on random files, by menu and by hand, saved and reloaded; see ``tests.random_edits``."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.random_edits import live

FILES, SAVES = 1000, 10


def test_10000_random_edits_lose_move_and_double_no_comment(record_property: Callable[[str, object], None]) -> None:
    comments = 0
    for seed in range(1_000_000, 1_000_000 + FILES):
        try:
            comments += live(seed, SAVES)
        except AssertionError as error:
            pytest.fail(f"seed {seed}: {error}")
    record_property("files", FILES)
    record_property("saves", FILES * SAVES)
    record_property("comments looked at", comments)
