"""The gateway as a whole: changes, saves, reloads and confirmations that meet, and what has proved good."""

from __future__ import annotations

import logging
import threading
from functools import partial
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.config import Config, LogConfig, factory
from gateway.errors import ConfigError, GatewayError
from gateway.logs import LogRing
from gateway.retained import FILE_NAME, RetainedFile
from gateway.running import NOTICES_KEPT, Gateway
from gateway.snapshots import LAST_GOOD
from gateway.supervisor import Plan
from tests.changing import read, serial_master
from tests.config_files import BAD, EDITED, GOOD, Place, config_of, counting, text_counting
from tests.fakes import JumpingClock
from tests.gateways import Bench, Live, done, live, nobody
from tests.lines import PATIENCE_S

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


# ------------------------------------------------------------------------------------------------ looking


def test_what_runs_is_what_the_file_says_and_nothing_is_unsaved(bench: Bench) -> None:
    gateway = bench.gateway
    assert (gateway.config, gateway.is_unsaved, gateway.confirm_left_s) == (BASE, False, None)
    assert (gateway.path, gateway.wants_restart) == (bench.place.path, False)
    assert (gateway.alarms(), gateway.notices(0), gateway.difference()) == ([], (0, []), [])
    assert (gateway.master("field"), gateway.slave("field")) == (None, None)  # not made yet


def test_alarms_are_told_worst_first(place: Place) -> None:
    place.path.write_text(BAD)
    with live(place) as run:
        gone = serial_master("gone", "/dev/rtugate-is-not-there", read(0))
        run.gateway.change(run.gateway.config, config_of(gone + '[hmi.telnet]\nlisten = ""\n'), nobody)
        done(run.gateway.change(run.gateway.config, run.gateway.config.model_copy(), nobody))
        master = run.gateway.master("gone")
        assert master is not None
        assert master.ready.wait(PATIENCE_S)
        master.devices[17].is_offline = True
        told = [alarm.words(str) for alarm in run.gateway.alarms()]
    assert told[0] == "rtugate.toml cannot be used (L shows why): factory settings run"
    assert told[1].startswith("gone: /dev/rtugate-is-not-there")
    assert told[2:] == ["gone: offline: unit 17"]


def test_notices_are_told_once_and_only_the_newest_are_kept(bench: Bench) -> None:
    seen, told = bench.gateway.notices(0)
    assert (seen, told) == (0, [])
    done_jobs = [bench.gateway.reload() for _ in range(2)]
    bench.finish()
    seen, told = bench.gateway.notices(0)
    assert (seen, [one.text for one in told]) == (2, [RELOADED] * 2)
    assert bench.gateway.notices(seen) == (2, [])
    bench.change(4)
    bench.gateway.reload()
    bench.finish()
    assert [one.text for one in bench.gateway.notices(seen)[1]] == [DROPPED]
    for _ in range(NOTICES_KEPT):
        bench.gateway.reload()
    bench.finish()
    assert (bench.gateway.notices(0)[0], len(bench.gateway.notices(0)[1])) == (3 + NOTICES_KEPT, NOTICES_KEPT)
    assert len(done_jobs) == 2


def test_the_log_is_there_for_the_menu(place: Place) -> None:
    ring = LogRing()
    gateway = Gateway(place.file(), place.clock, ring)
    ring.handle(logging.LogRecord("gateway", logging.INFO, "", 0, "rtugate runs", None, None))
    assert [line.split(" ", 2)[2] for line in gateway.log_lines()] == ["INFO rtugate runs"]


def test_retained_values_are_forgotten_where_the_file_wants_none_but_not_on_a_fallback(
    place: Place, clock: JumpingClock
) -> None:
    place.state.mkdir()
    kept = place.state / FILE_NAME
    for text, is_kept in ((BAD, True), (GOOD, False)):
        kept.write_bytes(b"values")
        place.path.write_text(text)
        Gateway(place.file(), clock, LogRing(), RetainedFile(kept))
        assert kept.exists() is is_kept


# ------------------------------------------------------------------------------------------------ changing


def test_a_change_runs_when_its_job_is_done_and_the_others_stay(place: Place) -> None:
    with live(place) as run:
        master, (menu,) = run.gateway.master("field"), run.tasks.made
        told = threading.Event()
        new = counting(BASE, 4)
        job = run.gateway.change(run.gateway.config, new, told.set)
        assert done(job).problem == ""
        assert told.wait(PATIENCE_S)
        assert run.station_config is new is run.gateway.config
        assert run.gateway.is_unsaved
        assert run.gateway.master("field") is not master
        assert run.tasks.made == [menu]
        assert done(run.gateway.undo(nobody)).problem == ""
        assert (run.gateway.config, run.gateway.is_unsaved) == (BASE, False)
    assert place.text == GOOD


def test_a_change_with_errors_tells_them_all_and_changes_nothing(bench: Bench) -> None:
    twice = BASE.model_copy(update={"master": [*BASE.master, *BASE.master]})
    with pytest.raises(ConfigError) as told:
        bench.gateway.change(bench.config, twice, nobody)
    assert len(told.value.findings) >= 2  # the name, the port
    assert bench.config == BASE
    assert not bench.gateway.is_unsaved


def test_a_change_of_what_runs_no_longer_is_refused(bench: Bench) -> None:
    before = bench.config
    after = bench.change(4)
    with pytest.raises(ConfigError, match=STALE):
        bench.gateway.change(before, counting(before, 5), nobody)
    assert bench.config is after


def noting(seen: list[Config], plans: list[Plan], config: Config) -> list[Plan]:
    """Plans of the terminals, which note what configuration they were asked for."""
    seen.append(config)
    return plans


def test_a_change_that_is_overtaken_is_done_and_only_the_newest_is_put_to_work(place: Place) -> None:
    with live(place) as run:
        made: list[Config] = []
        put_to_work: list[Config] = []
        with run.held():
            run.gateway.terminal_plans = partial(noting, put_to_work, run.tasks.plans("menu"))
            jobs = []
            for count in (4, 5, 6):
                new = counting(BASE, count)
                jobs.append(run.gateway.change(run.gateway.config, new, nobody))
                made.append(new)
            assert not any(job.is_done for job in jobs)
        assert [done(job).problem for job in jobs] == ["", "", ""]
        assert put_to_work == made[-1:]
        assert run.station_config is made[-1]
        assert run.gateway.station.masters["field"].config == made[-1].master[0]


def test_the_log_level_follows_the_configuration(place: Place) -> None:
    with live(place) as run:
        quiet = BASE.model_copy(update={"log": LogConfig(level="error")})
        done(run.gateway.change(run.gateway.config, quiet, nobody))
        assert logging.getLogger("gateway").level == logging.ERROR


def test_on_a_fallback_there_is_nothing_to_go_back_to(place: Place) -> None:
    place.path.write_text(BAD)
    bench = Bench(place)
    assert bench.gateway.is_unsaved
    assert done(bench.gateway.undo(nobody)).problem == "there is nothing to go back to"
    assert bench.config == factory()


def test_a_gateway_that_stops_leaves_nobody_waiting(place: Place) -> None:
    told: list[str] = []
    with live(place) as run:
        with run.held():
            waiting = run.gateway.change(run.gateway.config, counting(BASE, 4), partial(told.append, "told"))
            run.gateway.stop()
            assert not waiting.is_done
        run.thread.join()
        assert done(waiting).problem == "rtugate stops"
        late = done(run.gateway.reload())
        assert late.problem == "rtugate stops"
    assert told == []


def test_a_restart_is_a_stop_with_a_wish_and_a_stop_forgets_the_wish(place: Place) -> None:
    with live(place) as run:
        run.gateway.restart()
        run.thread.join()
        assert run.gateway.wants_restart
    assert not run.gateway.wants_restart  # ``live`` has stopped it, as a signal would


def test_a_task_that_does_not_end_is_told(place: Place) -> None:
    run = Live(place, SystemClock())
    run.gateway.supervisor.run = run.does_not_end  # type: ignore[assignment,method-assign] # as after 1.8 s
    run.thread.start()
    run.thread.join()
    assert run.was_clean is False


def test_whoever_must_not_cut_off_a_save_can_wait_for_it(bench: Bench) -> None:
    with bench.busy():
        job = bench.save_soon()
        assert not bench.gateway.finish_work(0.0)
    assert bench.gateway.finish_work(PATIENCE_S)
    assert job.is_done


def test_who_waits_for_slow_work_does_something_else_meanwhile(bench: Bench) -> None:
    times: list[float] = []

    def meanwhile() -> float:
        times.append(0.01)
        return 0.01

    with bench.busy():
        assert not bench.gateway.finish_work(0.045, meanwhile)
    assert len(times) == 5
    assert bench.gateway.finish_work(PATIENCE_S)


def test_what_goes_wrong_in_the_background_is_the_jobs_problem(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    told = threading.Event()

    def refuse() -> None:
        raise GatewayError("no, because")

    def fail() -> None:
        raise ZeroDivisionError("a bug")

    assert done(bench.gateway.in_background(refuse, nobody)).problem == "no, because"
    assert done(bench.gateway.in_background(fail, told.set)).problem == "it failed; the log says why"
    assert told.wait(PATIENCE_S)
    bench.finish()
    assert "a bug" in caplog.text


# ------------------------------------------------------------------------------------------------ saving


def test_a_save_writes_what_runs_and_tells_what_there_is_to_tell(bench: Bench) -> None:
    bench.place.state.write_text("no folder")
    new, told = bench.change(4), threading.Event()
    assert bench.gateway.difference() == ['master "field", request 1', "- count = 3", "+ count = 4"]
    job = done(bench.gateway.save(False, None, told.set))
    assert (job.problem, len(job.remarks)) == ("", 1)
    assert told.wait(PATIENCE_S)
    assert (bench.place.text, bench.gateway.is_unsaved) == (text_counting(4), False)
    assert bench.gateway.file.saved is new


def test_what_is_changed_while_it_is_saved_stays_unsaved(bench: Bench) -> None:
    with bench.busy():
        bench.change(4)
        job = bench.save_soon()
        bench.change(5)
    assert done(job).problem == ""
    assert (bench.place.text, bench.gateway.is_unsaved) == (text_counting(4), True)


def test_a_file_edited_by_somebody_is_not_written_over_unless_asked(bench: Bench) -> None:
    bench.change(4)
    assert not bench.gateway.is_file_changed()
    bench.place.path.write_text(EDITED)
    assert bench.gateway.is_file_changed()
    assert "somebody has changed it" in bench.save().problem
    assert bench.place.text == EDITED
    assert bench.save(overwrite=True).problem == ""
    assert bench.place.text == text_counting(4)


def test_a_save_that_a_reload_comes_before_does_not_undo_what_was_edited(bench: Bench) -> None:
    """W was pressed, its save waits for a password hash; meanwhile somebody edits the file and has it loaded."""
    with bench.busy():
        bench.change(4)
        bench.place.path.write_text(EDITED)
        bench.gateway.reload()
        job = bench.save_soon()
        overwriting = bench.gateway.save(True, None, nobody)
    assert (done(job).problem, done(overwriting).problem) == (STALE, STALE)
    assert bench.place.text == EDITED
    assert bench.config == config_of(EDITED)


def test_two_saves_at_once_are_one(bench: Bench) -> None:
    bench.change(4)
    jobs = [bench.gateway.save(False, confirm_s, nobody) for confirm_s in (600.0, None)]
    assert [done(job).problem for job in jobs] == ["", STALE]
    assert bench.gateway.confirm_left_s == pytest.approx(600.0)  # the second did not confirm the first


# ------------------------------------------------------------------------------------------------ confirming


def test_without_its_confirmation_a_save_is_undone_when_its_time_is_over(bench: Bench) -> None:
    bench.change(4)
    bench.save(confirm_s=600.0)
    assert bench.look() == pytest.approx(600.0)
    bench.run_s(599.0)
    assert (bench.place.text, bench.config) == (text_counting(4), counting(BASE, 4))
    bench.run_s(3.0)
    assert (bench.place.text, bench.config, bench.gateway.is_unsaved) == (GOOD, BASE, False)
    assert bench.told() == [REVERTED]
    assert bench.gateway.confirm_left_s is None


def test_only_monotonic_time_undoes_a_save(bench: Bench) -> None:
    bench.change(4)
    bench.save(confirm_s=600.0)
    for jump_s in (1e9, -2e9):
        bench.clock.jump_wall(jump_s)
        bench.run_s(10.0)
    assert bench.place.text == text_counting(4)


def test_a_confirmed_save_stays(bench: Bench) -> None:
    bench.change(4)
    bench.save(confirm_s=600.0)
    bench.run_s(599.0)
    assert done(bench.gateway.confirm(nobody)).problem == ""
    bench.run_s(100.0)
    assert (bench.place.text, bench.config, bench.told()) == (text_counting(4), counting(BASE, 4), [])


def test_a_confirmation_beyond_its_time_counts_if_nothing_was_undone_yet_and_says_so_if_it_was(bench: Bench) -> None:
    bench.change(4)
    bench.save(confirm_s=600.0)
    bench.clock.pass_s(601.0)
    assert done(bench.gateway.confirm(nobody)).problem == ""
    bench.look()
    assert bench.place.text == text_counting(4)
    bench.change(5)
    bench.save(confirm_s=600.0)
    bench.run_s(601.0)
    assert done(bench.gateway.confirm(nobody)).problem == "no save waits for a confirmation any more"
    assert bench.place.text == text_counting(4)


def test_what_was_changed_while_a_save_waited_is_undone_with_it(bench: Bench) -> None:
    """Whoever saved is cut off by what he did since: nothing of it may stay."""
    bench.change(4)
    bench.save(confirm_s=600.0)
    bench.change(5)
    bench.run_s(601.0)
    assert (bench.place.text, bench.config) == (GOOD, BASE)


def test_a_save_can_be_undone_at_once(place: Place) -> None:
    with live(place) as run:
        done(run.gateway.change(run.gateway.config, counting(BASE, 4), nobody))
        assert done(run.gateway.save(False, 600.0, nobody)).problem == ""
        assert run.gateway.confirm_left_s is not None
        told = threading.Event()
        assert done(run.gateway.revert(told.set)).problem == ""
        assert told.wait(PATIENCE_S)
        assert run.station_config == BASE  # it runs when the job is done
        assert done(run.gateway.revert()).problem == ""  # nothing waits any more
        assert [one.text for one in run.gateway.notices(0)[1]] == [REVERTED]
    assert place.text == GOOD


def test_the_previous_configuration_runs_again_even_if_the_file_cannot_be_put_back(bench: Bench) -> None:
    bench.change(4)
    bench.save(confirm_s=600.0)
    bench.place.path.unlink()
    bench.place.path.mkdir()
    bench.run_s(700.0)
    assert bench.config == BASE
    assert bench.told() == [REVERTED]  # once
    assert [alarm.words(str).partition(":")[0] for alarm in bench.gateway.alarms()] == [
        "the save that was not confirmed runs no longer, but is in the file still"
    ]
    bench.change(6)
    bench.run_s(700.0)
    assert bench.config == counting(BASE, 6)  # and it is not undone again and again


def test_somebody_who_edits_the_file_meanwhile_is_not_undone(bench: Bench) -> None:
    bench.change(4)
    bench.save(confirm_s=600.0)
    bench.place.path.write_text(EDITED)
    bench.run_s(601.0)
    assert (bench.place.text, bench.config, bench.gateway.is_file_changed()) == (EDITED, BASE, True)


def test_a_reload_of_an_edited_file_ends_the_wait(bench: Bench) -> None:
    bench.change(4)
    bench.save(confirm_s=600.0)
    bench.place.path.write_text(EDITED)
    bench.gateway.reload()
    bench.finish()
    bench.run_s(700.0)
    assert (bench.place.text, bench.config) == (EDITED, config_of(EDITED))
    assert bench.place.names() == [LAST_GOOD]


def test_a_start_before_the_confirmation_runs_the_previous_configuration(bench: Bench) -> None:
    bench.change(4)
    bench.save(confirm_s=600.0)
    again = Bench(bench.place)
    assert (again.config, again.place.text, again.gateway.is_unsaved) == (BASE, GOOD, False)
    assert "never confirmed" in again.gateway.alarms()[0].text


# ------------------------------------------------------------------------------------------------ reloading


def test_a_reload_has_the_file_run_and_drops_what_is_unsaved(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    with live(place) as run:
        done(run.gateway.change(run.gateway.config, counting(BASE, 4), nobody))
        place.path.write_text(EDITED)
        assert done(run.gateway.reload()).problem == ""
        assert run.station_config == config_of(EDITED)
        assert [one.text for one in run.gateway.notices(0)[1]] == [DROPPED]
        assert "unsaved changes of the menu are dropped" in caplog.text
        caplog.clear()
        assert done(run.gateway.reload()).problem == ""
        assert run.gateway.notices(1)[1][0].text == RELOADED
        assert "dropped" not in caplog.text


def test_a_reload_of_a_bad_file_changes_nothing_and_logs_everything(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    new = bench.change(4)
    bench.place.path.write_text(BAD.replace("every = 1.0", "every = 0"))
    problem = done(bench.gateway.reload()).problem
    assert problem.startswith("not reloaded, nothing has changed: rtugate.toml:11: ")
    assert bench.config is new
    assert bench.gateway.is_unsaved
    assert bench.told() == []
    assert "count 126" in caplog.text
    assert "rtugate.toml:12: " in caplog.text


def test_a_file_that_a_reload_refused_is_an_alarm_until_it_is_mended(bench: Bench) -> None:
    before = bench.place.path.read_text()
    bench.place.path.write_text(BAD)
    for _ in range(2):
        assert done(bench.gateway.reload()).problem
    told = [alarm.words(str) for alarm in bench.gateway.alarms()]
    assert told == ["rtugate.toml was edited and cannot be used (L shows why): what ran before goes on"]
    bench.place.path.write_text(before)
    bench.gateway.reload()
    bench.finish()
    assert bench.gateway.alarms() == []


def test_where_factory_settings_run_a_file_that_is_still_bad_is_the_same_alarm(place: Place) -> None:
    place.path.write_text(BAD)
    bench = Bench(place)
    before = bench.gateway.alarms()
    assert done(bench.gateway.reload()).problem
    assert bench.gateway.alarms() == before != []


def test_on_a_fallback_a_reload_of_the_mended_file_drops_nothing(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    place.path.write_text(BAD)
    bench = Bench(place)
    place.path.write_text(GOOD)
    bench.gateway.reload()
    bench.finish()
    assert (bench.config, bench.gateway.alarms(), bench.told()) == (BASE, [], [RELOADED])
    assert "dropped" not in caplog.text


def test_on_a_fallback_a_save_keeps_the_unusable_file(place: Place) -> None:
    place.path.write_text(BAD)
    bench = Bench(place)
    assert bench.save().remarks == ["the old file is kept as rtugate.toml.rejected-20231114-221320"]
    assert (bench.gateway.is_unsaved, bench.gateway.alarms()) == (False, [])
    assert config_of(place.text) == factory()
