"""What a gateway keeps as its last good configuration, and a gateway to which everything happens at once."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.config import Config
from gateway.config_file import ConfigFile
from gateway.errors import ConfigError
from gateway.running import GOOD_AFTER_S
from gateway.snapshots import LAST_GOOD, UNCONFIRMED
from tests.changing import slave
from tests.config_files import BAD, EDITED, GOOD, Place, config_of, counting
from tests.fakes import JumpingClock
from tests.gateways import Bench, Live, done, live, nobody
from tests.lines import PATIENCE_S
from tests.peers import free_port
from tests.tasks import Crashing

BASE = config_of(GOOD)
STALE = "the configuration was changed from elsewhere meanwhile: nothing was done, please look again"
REVERTED = "The last save was not confirmed: what was saved before runs again."
RELOADED = "The file has been reloaded."
DROPPED = "The file has been reloaded; unsaved changes of this menu are gone."


@pytest.fixture
def place(tmp_path: Path, clock: JumpingClock) -> Place:
    return Place(tmp_path, clock)


@pytest.fixture
def bench(place: Place) -> Bench:
    return Bench(place)


# ------------------------------------------------------------------------------------------------ what has proved good


def test_after_a_minute_of_good_running_the_configuration_is_kept(bench: Bench) -> None:
    bench.run_s(GOOD_AFTER_S - 1.0)
    assert bench.last_good() is None
    assert bench.look() == pytest.approx(1.0)
    bench.run_s(1.0)
    assert bench.last_good() == BASE


def test_it_is_written_once_and_again_only_after_a_later_save(bench: Bench) -> None:
    bench.run_s(61.0)
    kept = bench.place.state / LAST_GOOD
    kept.unlink()  # whoever writes again is found out
    bench.run_s(1000.0)
    assert not kept.exists()
    bench.change(4)
    bench.save()
    bench.run_s(61.0)
    assert bench.last_good() == counting(BASE, 4)


def test_a_reload_or_a_restart_of_the_same_configuration_writes_nothing(bench: Bench) -> None:
    bench.run_s(61.0)
    written = (bench.place.state / LAST_GOOD).stat().st_ino
    bench.gateway.reload()
    bench.finish()
    bench.run_s(100.0)
    Bench(bench.place).run_s(100.0)
    assert (bench.place.state / LAST_GOOD).stat().st_ino == written


def test_a_task_that_failed_begins_the_minute_anew(bench: Bench) -> None:
    for _ in range(10):
        bench.run_s(50.0)
        bench.gateway.supervisor.failed_s = bench.clock.monotonic()
    assert bench.last_good() is None
    bench.run_s(61.0)
    assert bench.last_good() == BASE


def test_unsaved_changes_are_never_kept(bench: Bench) -> None:
    bench.change(4)
    bench.run_s(1000.0)
    assert bench.last_good() is None
    bench.save()
    bench.look()
    assert bench.last_good() == counting(BASE, 4)  # it has run for more than a minute


def test_going_back_to_what_is_saved_begins_the_minute_anew(bench: Bench) -> None:
    bench.change(4)
    bench.run_s(100.0)
    bench.gateway.undo(nobody)
    bench.run_s(50.0)
    assert bench.last_good() is None
    bench.run_s(11.0)
    assert bench.last_good() == BASE


def test_changing_back_by_hand_is_as_good_as_undoing(bench: Bench) -> None:
    bench.change(4)
    bench.change(3)
    bench.run_s(61.0)
    assert bench.last_good() == BASE


def test_a_reloaded_configuration_has_to_prove_good_itself(bench: Bench) -> None:
    bench.run_s(100.0)
    bench.place.path.write_text(EDITED)
    bench.gateway.reload()
    bench.finish()
    bench.run_s(50.0)
    assert bench.last_good() == BASE
    bench.run_s(11.0)
    assert bench.last_good() == config_of(EDITED)


def test_an_unconfirmed_save_is_never_kept(bench: Bench) -> None:
    bench.change(4)
    bench.save(confirm_s=600.0)
    bench.run_s(590.0)
    assert bench.last_good() is None
    done(bench.gateway.confirm(nobody))
    bench.look()
    assert bench.last_good() == counting(BASE, 4)


class LateSave(ConfigFile):
    """Somebody saves just when it was found that no save waits for its confirmation."""

    late: Config | None = None

    @property
    def confirm_left_s(self) -> float | None:
        left_s = super().confirm_left_s
        if self.late is not None:
            late, self.late = self.late, None
            self.save(late, confirm_s=600.0)
        return left_s


def test_a_save_in_the_very_moment_of_looking_is_not_kept_unconfirmed(place: Place) -> None:
    bench = Bench(place, LateSave)
    bench.change(4)
    bench.run_s(61.0)
    assert isinstance(bench.gateway.file, LateSave)
    bench.gateway.file.late = bench.config
    bench.look()
    assert bench.gateway.confirm_left_s is not None
    assert bench.last_good() is None


def test_what_comes_back_unconfirmed_has_to_prove_good_itself(bench: Bench) -> None:
    bench.change(4)
    bench.save(confirm_s=600.0)
    bench.run_s(630.0)
    assert (bench.config, bench.last_good()) == (BASE, None)
    bench.run_s(61.0)
    assert bench.last_good() == BASE


def test_a_fallback_is_never_kept(place: Place) -> None:
    place.path.write_text(BAD)
    bench = Bench(place)
    bench.run_s(1000.0)
    assert bench.last_good() is None


def test_a_clock_that_is_set_proves_nothing(bench: Bench) -> None:
    bench.clock.jump_wall(1e9)
    bench.look()
    assert bench.last_good() is None


def test_where_it_cannot_be_kept_the_log_says_so_once(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench.place.state.write_text("no folder")
    bench.run_s(1000.0)
    assert [record.message for record in caplog.records if "last good" in record.message] == [
        f"the last good configuration is not kept: {LAST_GOOD}: File exists"
    ]


def test_a_task_that_crashes_in_a_real_run_is_seen(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    run = Live(place, SystemClock())
    run.gateway.terminal_plans = lambda config: [run.tasks.plan("menu", kind=Crashing)]
    run.start()
    assert run.tasks.made[0].ready.wait(PATIENCE_S)
    run.stop()
    assert run.gateway.supervisor.failed_s is not None
    assert "ended with an error" in caplog.text


# ------------------------------------------------------------------------------------------------ all at once


def hammer(steps: list[Callable[[], object]], rounds: int, seed: int) -> None:
    """Take *steps* in threads of their own, each a number of times, in any order."""

    def work(step: Callable[[], object]) -> None:
        for _ in range(rounds):
            step()

    order = random.Random(seed).sample(steps, len(steps))
    threads = [threading.Thread(target=work, args=(step,)) for step in order]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


@pytest.mark.parametrize("seed", range(3))
def test_whatever_meets_the_newest_configuration_runs_and_the_file_is_never_a_mixture(
    tmp_path: Path, seed: int, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port()
    text = GOOD + slave("scada", port)
    place = Place(tmp_path, JumpingClock(), text)
    rng = random.Random(seed)
    editions = [text.replace("count = 3", f"count = {count}") for count in range(20, 40)]
    problems: set[str] = set()

    def change() -> None:
        old = run.gateway.config
        try:
            done(run.gateway.change(old, counting(old, rng.randrange(1, 20)), nobody))
        except ConfigError as error:
            problems.add(str(error))

    def edit() -> None:
        place.path.write_text(rng.choice(editions))
        problems.add(done(run.gateway.reload()).problem)

    def save() -> None:
        problems.add(done(run.gateway.save(False, rng.choice([None, 600.0]), nobody)).problem)

    def settle() -> None:
        problems.add(done(rng.choice([run.gateway.confirm, run.gateway.revert])(nobody)).problem)

    with live(place) as run:
        serving = run.gateway.slave("scada")
        hammer([change, change, edit, save, settle], 15, seed)
        assert run.gateway.finish_work(PATIENCE_S)
        done(run.gateway.change(run.gateway.config, run.gateway.config.model_copy(), nobody))
        assert run.station_config is run.gateway.config
        assert run.gateway.station.masters["field"].config == run.gateway.config.master[0]
        assert run.gateway.slave("scada") is serving  # none of this was about it
        final = config_of(place.text)
        assert final == run.gateway.file.saved or run.gateway.is_file_changed()
    assert "Traceback" not in caplog.text
    assert {problem.partition(":")[0] for problem in problems} <= {
        "",
        "the configuration was changed from elsewhere meanwhile",
        "rtugate.toml is not saved",
        "the last save still waits for its confirmation",
        "no save waits for a confirmation any more",
        "not reloaded, nothing has changed",  # the file was read while the test wrote it
    }
    assert (place.state / UNCONFIRMED).exists() == (run.gateway.confirm_left_s is not None)
