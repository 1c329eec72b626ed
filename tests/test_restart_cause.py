"""Why the gateway was started last, over runs that end well, badly and in a power cut."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from gateway.restart_cause import FILE, LastRun


def a_run(state: Path, boot: str = "boot 1") -> LastRun:
    boot_id = state / "boot_id"
    boot_id.write_text(f"{boot}\n")
    return LastRun(state, boot_id)


def test_the_first_run_of_all_says_so(tmp_path: Path) -> None:
    assert a_run(tmp_path).begin() == "first start"


@pytest.mark.parametrize("how", ["clean stop", "restart by the menu"])
@pytest.mark.parametrize("boot", ["boot 1", "boot 2"])
def test_a_run_that_ended_well_is_told_as_it_ended_whatever_became_of_the_machine(
    tmp_path: Path, how: str, boot: str
) -> None:
    run = a_run(tmp_path)
    run.begin()
    run.end(how)
    assert a_run(tmp_path, boot).begin() == how


def test_a_run_without_an_end_was_a_crash_if_the_machine_went_on(tmp_path: Path) -> None:
    a_run(tmp_path).begin()
    assert a_run(tmp_path).begin() == "crash"


def test_a_run_without_an_end_was_ended_by_the_power_if_the_machine_was_started_anew(tmp_path: Path) -> None:
    a_run(tmp_path).begin()
    assert a_run(tmp_path, "boot 2").begin() == "power"


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"ended": ""}', b"\xff\xfe", b"null"])
def test_a_damaged_file_counts_as_a_crash(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE).write_bytes(content)
    assert a_run(tmp_path).begin() == "crash"
    assert a_run(tmp_path, "boot 2").begin() == "power"  # it has been written anew


def test_a_state_directory_that_is_not_there_is_told_and_lived_without(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        assert LastRun(tmp_path / "nowhere").begin() == "first start"
    assert "cannot be kept" in caplog.text
