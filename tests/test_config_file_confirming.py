"""A save that waits for its confirmation: whatever happens, nothing unconfirmed stays and no edit is lost."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from gateway.config import factory
from gateway.errors import ConfigError, SaveError
from gateway.snapshots import UNCONFIRMED, Snapshot
from tests.config_files import (
    BAD,
    EDITED,
    GOOD,
    Place,
    config_of,
    counting,
    disk_full,
    power_cut,
    raising,
    save,
    text_counting,
    told,
)
from tests.fakes import JumpingClock

GOOD_RUNS = "rtugate.toml cannot be used (L shows why): the last good configuration runs"
FACTORY_RUNS = "rtugate.toml cannot be used (L shows why): factory settings run"
IS_BACK = "the last save to rtugate.toml was never confirmed: the previous file is back"
GARBAGE = [BAD.encode(), b"[[[", b"\xff\xfe\x00", b"\0" * 4096, b"x = " + b"[" * 5000, b"#" * (1024 * 1024 + 1)]


@pytest.fixture
def place(tmp_path: Path, clock: JumpingClock) -> Place:
    return Place(tmp_path, clock)


# ------------------------------------------------------------------------------------------------ confirming


def test_a_save_waits_for_its_confirmation_and_is_kept_in_the_history_then(place: Place, clock: JumpingClock) -> None:
    file = place.started()
    config = counting(config_of(GOOD), 4)
    assert file.save(config, confirm_s=600.0) == []
    assert (place.text, file.saved, file.settled) == (text_counting(4), config, None)
    assert (place.history(), place.names()) == ([], [UNCONFIRMED])
    clock.pass_s(599.0)
    assert file.confirm_left_s == pytest.approx(1.0)
    assert file.confirm() == []
    assert (file.confirm_left_s, file.settled) == (None, config)
    assert (place.history(), place.names()) == ([GOOD, text_counting(4)], [])
    assert place.file().start() == config


def test_without_the_confirmation_the_previous_file_is_back_letter_for_letter(place: Place) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    assert file.revert() == config_of(GOOD)
    assert (place.text, file.saved, file.settled) == (GOOD, config_of(GOOD), config_of(GOOD))
    assert (file.confirm_left_s, file.is_edited(), told(file)) == (None, False, [])
    assert (place.history(), place.names()) == ([], [])
    assert file.revert() is None


def test_only_monotonic_time_counts_for_the_confirmation(place: Place, clock: JumpingClock) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    for jump_s in (1e9, -2e9, 86400.0):
        clock.jump_wall(jump_s)
        assert file.confirm_left_s == pytest.approx(600.0)
    clock.pass_s(1000.0)
    assert file.confirm_left_s == 0.0


def test_a_confirmation_that_comes_too_late_says_so(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    file.revert()
    with caplog.at_level(logging.INFO), pytest.raises(SaveError, match="no save waits for a confirmation any more"):
        file.confirm()
    assert "is confirmed" not in caplog.text
    assert place.text == GOOD


def test_while_a_save_waits_there_is_no_other_one(place: Place) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    for confirm_s in (None, 600.0):
        with pytest.raises(SaveError, match="the last save still waits for its confirmation"):
            save(file, 5, confirm_s, overwrite=True)
    assert file.revert() == config_of(GOOD)
    assert place.text == GOOD


def test_a_file_edited_while_its_save_waited_stays_and_the_previous_configuration_runs(place: Place) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    place.path.write_text(EDITED)
    assert file.revert() == config_of(GOOD)
    assert place.text == EDITED
    assert file.is_edited()  # W asks what to do
    assert file.saved == config_of(GOOD)  # U does not bring back what nobody confirmed
    assert place.names() == []
    assert place.file().start() == config_of(EDITED)


def test_a_reload_of_an_edited_file_overtakes_the_save_that_waits(place: Place) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    place.path.write_text(EDITED)
    assert file.reload() == config_of(EDITED)
    assert (file.confirm_left_s, place.names()) == (None, [])
    assert file.revert() is None
    assert place.text == EDITED


def test_a_reload_of_the_file_as_it_was_saved_confirms_nothing(place: Place) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    file.reload()
    assert file.confirm_left_s == pytest.approx(600.0)
    assert file.revert() == config_of(GOOD)
    assert place.text == GOOD


def test_a_bad_edit_that_is_refused_leaves_the_save_waiting(place: Place) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    place.path.write_text(BAD)
    with pytest.raises(ConfigError):
        file.reload()
    assert file.confirm_left_s == pytest.approx(600.0)
    assert file.revert() == config_of(GOOD)
    assert place.text == BAD  # a person's own words are never undone


def test_a_file_that_is_gone_when_nobody_confirmed_is_back(place: Place) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    place.path.unlink()
    assert file.revert() == config_of(GOOD)
    assert place.text == GOOD


def test_what_cannot_be_put_back_does_not_run_and_the_next_start_tries_again(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    with disk_full(monkeypatch):
        assert file.revert() == config_of(GOOD)
    assert place.text == text_counting(4)
    (alarm,) = told(file)
    assert alarm == (
        "the save that was not confirmed runs no longer, but is in the file still: "
        "rtugate.toml is not saved: no space left on the device"
    )
    with disk_full(monkeypatch):
        again = place.file()
        assert again.start() == config_of(GOOD)
    assert (place.text, again.saved == config_of(text_counting(4))) == (text_counting(4), True)
    assert told(again)[0].startswith("a save that nobody confirmed, if there was one, cannot be undone: rtugate.toml ")
    last = place.file()
    assert (last.start(), place.text, told(last)) == (config_of(GOOD), GOOD, [IS_BACK])


def test_what_cannot_be_put_back_can_be_written_over(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    with disk_full(monkeypatch):
        file.revert()
    assert file.is_edited()
    file.save(config_of(GOOD), overwrite=True)
    assert (place.text, told(file), place.names()) == (GOOD, [], [])


def test_a_confirmation_that_cannot_be_kept_is_none(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", raising(errno.EROFS))
        with pytest.raises(SaveError, match=r"unconfirmed\.toml cannot be removed: the file system is read-only"):
            file.confirm()
    assert file.confirm_left_s is not None  # else the next start would undo what was confirmed
    file.confirm()
    assert place.file().start() == config_of(text_counting(4))


def test_a_save_that_cannot_leave_its_mark_is_not_made(place: Place) -> None:
    file = place.started()
    place.state.write_text("a file")
    with pytest.raises(SaveError, match=r"^unconfirmed\.toml: "):
        save(file, 4, confirm_s=600.0)
    assert (place.text, file.confirm_left_s) == (GOOD, None)
    assert told(file)[0].startswith("unconfirmed.toml: ")


# ------------------------------------------------------------------------------------------------ starting again


def test_a_start_before_the_confirmation_puts_the_previous_file_back(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    save(place.started(), 4, confirm_s=600.0)
    file = place.file()
    assert file.start() == config_of(GOOD)
    assert (place.text, place.names(), told(file)) == (GOOD, [], [IS_BACK])
    assert (file.settled, file.confirm_left_s) == (config_of(GOOD), None)
    assert "was never confirmed: the previous file is back" in caplog.text
    assert told(place.started()) == []


def test_a_start_leaves_a_file_alone_that_was_edited_since(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    save(place.started(), 4, confirm_s=600.0)
    place.path.write_text(EDITED)
    file = place.file()
    assert file.start() == config_of(EDITED)
    assert (place.text, place.names(), told(file)) == (EDITED, [], [])
    assert "edited since a save that nobody confirmed" in caplog.text


def test_a_mark_that_nothing_followed_is_forgotten(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    save(place.started(), 4, confirm_s=600.0)
    place.path.write_text(GOOD)  # the power went between the mark and the save
    file = place.file()
    assert file.start() == config_of(GOOD)
    assert (place.names(), told(file), caplog.text) == ([], [], "")


def test_a_damaged_mark_is_an_alarm_at_each_start_until_the_next_save(place: Place) -> None:
    save(place.started(), 4, confirm_s=600.0)
    mark = place.state / UNCONFIRMED
    mark.write_bytes(mark.read_bytes()[:-1])
    for _ in range(2):
        file = place.file()
        assert file.start() == config_of(text_counting(4))
        assert told(file) == [
            "a save that nobody confirmed, if there was one, cannot be undone: "
            "unconfirmed.toml is damaged: its checksum does not fit; it is not used"
        ]
    save(file, 5)
    assert (told(file), place.names()) == ([], [])
    assert place.file().start() == config_of(text_counting(5))


def test_a_mark_that_could_not_be_used_never_undoes_a_later_save(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    save(place.started(), 4, confirm_s=600.0)
    with disk_full(monkeypatch):
        file = place.started()
    file.save(config_of(text_counting(4)))  # just what the mark is about
    assert place.file().start() == config_of(text_counting(4))


def test_a_mark_that_cannot_be_removed_is_told(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    save(place.started(), 4, confirm_s=600.0)
    with disk_full(monkeypatch):
        file = place.started()
    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", raising(errno.EROFS))
        assert save(file, 5) == ["unconfirmed.toml cannot be removed: the file system is read-only"]
    assert place.file().start() == config_of(text_counting(5))


def test_a_previous_file_that_this_version_refuses_is_not_put_back(place: Place) -> None:
    file = place.started()
    save(file, 4, confirm_s=600.0)
    mark = Snapshot(place.state, UNCONFIRMED)
    mark.write((mark.text() or "").replace("count = 3", "count = 126"))
    again = place.file()
    assert again.start() == config_of(text_counting(4))
    assert told(again)[0].startswith("a save that nobody confirmed, if there was one, cannot be undone: rtugate.toml:")


def test_a_file_that_cannot_be_read_keeps_the_mark_for_a_start_that_can(place: Place) -> None:
    save(place.started(), 4, confirm_s=600.0)
    hidden = place.path.rename(place.path.with_name("elsewhere"))
    place.started()
    hidden.rename(place.path)
    assert place.file().start() == config_of(GOOD)


def test_a_mark_beside_something_that_is_no_file_is_an_alarm(place: Place) -> None:
    save(place.started(), 4, confirm_s=600.0)
    place.path.unlink()
    place.path.mkdir()
    file = place.file()
    assert file.start() == factory()
    assert (
        "a save that nobody confirmed, if there was one, cannot be undone: rtugate.toml cannot be read" in told(file)[1]
    )
    assert place.names() == [UNCONFIRMED]


def test_a_save_that_was_written_but_may_be_lost_is_undone_by_the_next_start(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The new content is there, the flush of its folder has failed: nobody was told that it is saved."""
    file, flush, folder = place.started(), os.fsync, place.path.parent.stat().st_ino

    def failing(descriptor: int) -> None:
        if os.fstat(descriptor).st_ino == folder:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        flush(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", failing)
        with pytest.raises(SaveError, match="may lose it in a power cut"):
            save(file, 4, confirm_s=600.0)
    assert (place.text, place.names(), file.is_edited()) == (text_counting(4), [UNCONFIRMED], True)
    assert place.file().start() == config_of(GOOD)
    assert place.text == GOOD


@pytest.mark.parametrize("size", [1024 * 1024, 1024 * 1024 - 100])
def test_a_file_as_large_as_may_be_comes_back_as_well(tmp_path: Path, clock: JumpingClock, size: int) -> None:
    text = GOOD + "#" * (size - len(GOOD) - 1) + "\n"
    place = Place(tmp_path, clock, text)
    save(place.started(), 4, confirm_s=600.0)
    assert place.file().start() == config_of(GOOD)
    assert place.text == text


# ------------------------------------------------------------------------------------------------ power cuts


def _at_every_call(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, clock: JumpingClock) -> Iterator[Place]:
    """Places in which the power was cut while a save that waits was made, each a call later; the last: not at all."""
    for at in range(1000):
        folder = tmp_path / str(at)
        folder.mkdir()
        place = Place(folder, clock)
        file = place.started()
        with power_cut(monkeypatch, at) as calls:
            save(file, 4, confirm_s=600.0)
        yield place
        if len(calls) < at:
            return


def test_the_power_may_go_at_any_moment_of_a_save_that_waits(
    tmp_path: Path, clock: JumpingClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = []
    for place in _at_every_call(monkeypatch, tmp_path, clock):
        texts.append(place.text)
        file = place.file()
        assert file.start() == config_of(GOOD)
        assert place.text == GOOD
        assert file.confirm_left_s is None
    assert set(texts) == {GOOD, text_counting(4)}
    assert len(texts) > 10


@pytest.mark.parametrize("step", ["confirm", "revert", "start", "save"])
def test_the_power_may_go_at_any_moment_of_what_follows(
    tmp_path: Path, clock: JumpingClock, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """Then the file is the old one or the new one as a whole, and a third start finds what the second one found."""
    found = []
    for at in range(1000):
        folder = tmp_path / str(at)
        folder.mkdir()
        place = Place(folder, clock)
        file = place.started()
        save(file, 4, confirm_s=None if step == "save" else 600.0)
        steps: dict[str, Callable[[], object]] = {
            "confirm": file.confirm,
            "revert": file.revert,
            "start": place.file().start,
            "save": partial(save, file, 5),
        }
        with power_cut(monkeypatch, at) as calls:
            steps[step]()
        second = place.file().start()
        assert place.file().start() == second == config_of(place.text)
        found.append(place.text)
        if len(calls) < at:
            break
    before, after = {
        "confirm": (GOOD, text_counting(4)),
        "revert": (GOOD, GOOD),
        "start": (GOOD, GOOD),
        "save": (text_counting(4), text_counting(5)),
    }[step]
    assert (found[0], found[-1]) == (before, after)
    assert set(found) == {before, after}
