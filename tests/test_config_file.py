"""The configuration file of a gateway that runs: starts, saves, confirmations, edits by hand, power cuts, bad disks."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway import save as save_module
from gateway.config import factory
from gateway.errors import ConfigError, FileChanged, SaveError
from gateway.history import KEPT
from gateway.snapshots import LAST_GOOD, Snapshot, write_last_good
from tests.config_files import BAD, EDITED, GOOD, Place, config_of, counting, save, text_counting, told
from tests.fakes import JumpingClock
from tests.test_files import as_a_user

GOOD_RUNS = "rtugate.toml cannot be used (L shows why): the last good configuration runs"
FACTORY_RUNS = "rtugate.toml cannot be used (L shows why): factory settings run"
IS_BACK = "the last save to rtugate.toml was never confirmed: the previous file is back"
GARBAGE = [BAD.encode(), b"[[[", b"\xff\xfe\x00", b"\0" * 4096, b"x = " + b"[" * 5000, b"#" * (1024 * 1024 + 1)]


@pytest.fixture
def place(tmp_path: Path, clock: JumpingClock) -> Place:
    return Place(tmp_path, clock)


@pytest.fixture
def open_place(clock: JumpingClock) -> Iterator[Place]:
    """A place that any user can reach; pytest's own are for one user only."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield Place(folder, clock)
    shutil.rmtree(folder)


# ------------------------------------------------------------------------------------------------ starting


def test_a_start_takes_what_the_file_says_and_logs_what_is_doubtful(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    place.path.write_text(GOOD.replace("every = 1.0", "every = 0.01").replace('"tcp://127.0.0.1:1"', '"/dev/x"'))
    file = place.file()
    with caplog.at_level(logging.INFO):
        config = file.start()
    assert config is file.saved is file.settled
    assert config == config_of(place.text)
    assert (told(file), file.is_edited(), file.confirm_left_s) == ([], False, None)
    (warning,) = caplog.records
    assert (warning.levelname, "of the line" in warning.message) == ("WARNING", True)
    assert place.names() == []


@pytest.mark.parametrize("content", GARBAGE)
def test_a_file_that_cannot_be_used_leads_to_the_last_good_configuration_else_to_factory_settings(
    tmp_path: Path, clock: JumpingClock, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    place = Place(tmp_path, clock, content)
    file = place.file()
    assert file.start() == factory()
    assert (file.saved, file.settled, told(file)) == (None, None, [FACTORY_RUNS])
    assert "running with factory settings, no line is polled or served" in caplog.text
    write_last_good(place.state, config_of(GOOD))
    file = place.file()
    assert file.start() == config_of(GOOD)
    assert (file.saved, file.settled, told(file)) == (None, None, [GOOD_RUNS])
    assert "running with the last good configuration" in caplog.text
    assert place.path.read_bytes() == content


def test_a_last_good_configuration_that_is_damaged_is_not_trusted(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    write_last_good(place.state, config_of(GOOD))
    kept = place.state / LAST_GOOD
    kept.write_bytes(kept.read_bytes().replace(b"count = 3", b"count = 4"))
    place.path.write_text(BAD)
    assert place.file().start() == factory()
    assert "last-good.toml is damaged" in caplog.text


def test_a_last_good_configuration_that_this_version_refuses_is_not_used(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    Snapshot(place.state, LAST_GOOD).write("no_such_key = 1\n")
    place.path.write_text(BAD)
    assert place.file().start() == factory()
    assert "last-good.toml:1" in caplog.text


def test_whatever_stands_where_the_file_should_be_the_start_goes_on(place: Place) -> None:
    place.path.unlink()
    assert place.file().start() == factory()
    place.path.mkdir()
    assert place.file().start() == factory()
    place.path.rmdir()
    os.mkfifo(place.path)
    file = place.file()
    assert (file.start(), told(file)) == (factory(), [FACTORY_RUNS])
    with pytest.raises(SaveError, match="is not a regular file"):
        file.save(config_of(GOOD))


def test_a_state_directory_that_is_none_is_no_reason_not_to_start(place: Place) -> None:
    place.state.write_text("a file")
    file = place.file()
    assert (file.start(), told(file)) == (config_of(GOOD), [])


def test_a_file_that_the_service_may_not_read_is_an_alarm_that_says_what_to_type(open_place: Place) -> None:
    open_place.path.chmod(0o600)
    with as_a_user() as name:
        if os.access(open_place.path, os.R_OK, effective_ids=True):
            pytest.skip("the tests run as the owner of all files, and not as root")
        file = open_place.file()
        assert file.start() == factory()
    assert told(file) == [
        FACTORY_RUNS,
        "rtugate.toml cannot be read: permission denied; what helps, typed as root: "
        f"chown {name} {open_place.path.parent}",
    ]


# ------------------------------------------------------------------------------------------------ reloading


def test_a_file_that_a_reload_may_not_read_is_an_alarm_that_says_what_to_type(open_place: Place) -> None:
    file = open_place.started()
    open_place.path.chmod(0)
    with as_a_user():
        with pytest.raises(ConfigError) as refused:
            file.reload()
        file.refused(refused.value)
    assert "rtugate.toml cannot be read: permission denied; what helps, typed as root: ch" in told(file)[1]
    open_place.path.chmod(0o640)
    open_place.path.write_text(BAD)
    with pytest.raises(ConfigError) as refused:
        file.reload()
    file.refused(refused.value)
    assert len(told(file)) == 1
    open_place.path.write_text(GOOD)
    file.reload()
    assert told(file) == []


def test_a_reload_reads_what_somebody_has_edited(place: Place) -> None:
    file = place.started()
    place.path.write_text(EDITED)
    assert file.is_edited()
    config = file.reload()
    assert config is file.saved
    assert config == config_of(EDITED)
    assert not file.is_edited()


@pytest.mark.parametrize("content", GARBAGE)
def test_a_reload_of_a_bad_file_changes_nothing(place: Place, content: bytes) -> None:
    file = place.started()
    before = file.saved
    place.path.write_bytes(content)
    with pytest.raises(ConfigError):
        file.reload()
    assert file.saved is before
    assert file.is_edited()


def test_a_reload_ends_the_alarm_of_a_bad_start(place: Place) -> None:
    place.path.write_text(BAD)
    file = place.started()
    place.path.write_text(GOOD)
    file.reload()
    assert told(file) == []


# ------------------------------------------------------------------------------------------------ saving


def test_a_save_edits_only_what_differs_and_both_versions_are_kept(place: Place) -> None:
    file = place.started()
    config = counting(config_of(GOOD), 4)
    assert file.difference(config) == ['master "field", request 1', "- count = 3", "+ count = 4"]
    assert file.save(config) == []
    assert place.text == text_counting(4)
    assert file.saved is config
    assert file.settled is config
    assert file.confirm_left_s is None
    assert not file.is_edited()
    assert place.history() == [GOOD, text_counting(4)]
    assert place.names() == []


def test_ten_versions_are_kept(place: Place) -> None:
    file = place.started()
    for count in range(1, 15):
        save(file, count)
    assert place.history() == [text_counting(count) for count in range(15 - KEPT, 15)]


def test_a_file_that_somebody_has_edited_is_not_written_over_unless_asked(place: Place) -> None:
    file = place.started()
    place.path.write_text(EDITED)
    for confirm_s in (None, 600.0):
        with pytest.raises(FileChanged):
            save(file, 4, confirm_s)
        assert (place.text, place.names(), told(file)) == (EDITED, [], [])
        assert file.confirm_left_s is None
    assert save(file, 4, overwrite=True) == []
    assert place.text == text_counting(4)


def test_a_file_that_is_gone_is_made_anew(place: Place) -> None:
    file = place.started()
    place.path.unlink()
    assert not file.is_edited()
    assert save(file, 4) == []
    assert place.text == text_counting(4)


def test_on_a_fallback_the_unusable_file_is_kept_before_the_save(place: Place) -> None:
    place.path.write_text(BAD)
    file = place.started()
    assert file.save(config_of(GOOD)) == ["the old file is kept as rtugate.toml.rejected-20231114-221320"]
    assert place.names() == ["rtugate.toml.rejected-20231114-221320"]
    assert place.path.with_name("rtugate.toml.rejected-20231114-221320").read_text() == BAD
    assert config_of(place.text) == config_of(GOOD)
    assert told(file) == []
    assert place.history() == [place.text]
    assert place.file().start() == config_of(GOOD)


def test_a_file_that_was_mended_while_a_fallback_runs_is_not_written_over_unless_asked(place: Place) -> None:
    place.path.write_text(BAD)
    file = place.started()
    assert not file.is_edited()
    place.path.write_text(EDITED)
    assert file.is_edited()
    with pytest.raises(FileChanged):
        file.save(config_of(GOOD))
    assert (place.text, place.names()) == (EDITED, [])
    (remark,) = file.save(config_of(GOOD), overwrite=True)
    assert place.path.with_name(remark.removeprefix("the old file is kept as ")).read_text() == EDITED


def test_on_a_fallback_there_is_no_previous_file_that_a_confirmation_could_be_about(place: Place) -> None:
    place.path.write_text(BAD)
    file = place.started()
    with pytest.raises(SaveError, match="there is no previous file to come back to"):
        file.save(config_of(GOOD), confirm_s=600.0)
    assert (place.text, place.names()) == (BAD, [])


def test_a_save_that_cannot_keep_the_comments_keeps_the_old_file(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    def faulty(*_: object) -> str:
        raise ZeroDivisionError("a bug")

    file = place.started()
    monkeypatch.setattr(save_module, "edited", faulty)
    assert save(file, 4) == ["the old file is kept as rtugate.toml.replaced-20231114-221320"]
    assert place.path.with_name("rtugate.toml.replaced-20231114-221320").read_text() == GOOD
    assert config_of(place.text) == counting(config_of(GOOD), 4)
    assert "boiler house" not in place.text


def test_a_history_that_cannot_be_kept_is_a_remark(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    place.state.write_text("a file")
    file = place.started()
    (remark,) = save(file, 4)
    assert place.text == text_counting(4)
    assert remark.startswith("this version is not kept in the history: ")
    assert "not kept in the history" in caplog.text


def test_a_file_that_the_service_may_not_replace_is_an_alarm_until_it_may(open_place: Place) -> None:
    file = open_place.started()
    with as_a_user() as name:
        folder = open_place.path.parent
        if os.access(folder, os.W_OK, effective_ids=True):
            pytest.skip("the tests run as the owner of all folders, and not as root")
        with pytest.raises(SaveError, match="permission denied"):
            save(file, 4)
    alarm = f"rtugate.toml is not saved: permission denied; what helps, typed as root: chown {name} {folder}"
    assert told(file) == [alarm]
    assert open_place.text == GOOD
    save(file, 4)
    assert told(file) == []


def test_a_configuration_that_cannot_be_written_is_refused_and_nothing_has_changed(place: Place) -> None:
    file = place.started()
    config = config_of(GOOD)
    with pytest.raises(SaveError, match="would not load"):
        file.save(config.model_copy(update={"master": config.master * 2}), confirm_s=60.0)
    assert (place.text, place.names(), file.saved) == (GOOD, [], config)


# ------------------------------------------------------------------------------------------------ proved good


def test_what_has_proved_good_is_there_for_a_start_that_finds_a_bad_file(place: Place) -> None:
    file = place.started()
    file.keep_good(config_of(EDITED))
    assert place.names() == [LAST_GOOD]
    place.path.write_text(BAD)
    assert place.file().start() == config_of(EDITED)


def test_what_has_proved_good_and_cannot_be_kept_says_so(place: Place) -> None:
    file = place.started()
    place.state.write_text("a file")
    with pytest.raises(SaveError, match=r"^last-good\.toml: "):
        file.keep_good(config_of(GOOD))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A state directory with room for a few KiB."""
    folder = tmp_path / "state"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8k", "none", folder], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("only root can mount a small file system")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_on_a_disk_that_is_full_a_save_that_waits_is_not_made_and_a_plain_one_is(
    small_disk: Path, tmp_path: Path, clock: JumpingClock
) -> None:
    place = Place(tmp_path, clock, GOOD + "#" * 10_000 + "\n")
    file = place.started()
    with pytest.raises(SaveError, match=r"unconfirmed\.toml is not saved: no space left on the device"):
        save(file, 4, confirm_s=600.0)
    assert (place.text.count("count = 3"), list(small_disk.iterdir())) == (1, [])
    (remark,) = save(file, 4)
    assert remark.startswith("this version is not kept in the history: 0001.toml is not saved: no space left")
    assert place.text.count("count = 4") == 1
    file.keep_good(config_of(GOOD))  # without its comments there is room for it


def test_on_a_disk_that_is_read_only_the_gateway_starts_and_says_what_it_cannot_do(
    small_disk: Path, tmp_path: Path, clock: JumpingClock
) -> None:
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    place = Place(tmp_path, clock)
    file = place.started()
    assert told(file) == []
    with pytest.raises(SaveError, match="the file system is read-only"):
        file.keep_good(config_of(GOOD))
    with pytest.raises(SaveError, match="the file system is read-only"):
        save(file, 4, confirm_s=600.0)
    assert save(file, 4) == ["this version is not kept in the history: the file system is read-only"]
    assert place.text == text_counting(4)


def test_what_a_save_would_change_is_told_of_the_file_as_it_is_now(place: Place) -> None:
    file = place.file()
    config = file.start()
    place.path.write_text(GOOD.replace("count = 3", "count = 5"))  # by hand, in the meantime
    assert file.difference(config) == ['master "field", request 1', "- count = 5", "+ count = 3"]
    place.path.write_bytes(b"\xff\xfe[[")
    assert file.difference(config)
    place.path.unlink()
    assert file.difference(config) == []
