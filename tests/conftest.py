"""What every test gets: a clock that jumps, a register, and the proof that no thread was left behind."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from gateway.register import DataRegister
from tests.fakes import JumpingClock

hypothesis.settings.register_profile("rtugate", deadline=None, derandomize=True)  # machines are noisy; fixed seeds
hypothesis.settings.load_profile("rtugate")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--allowed-skips", metavar="FILE", help="fail if a test is skipped that FILE does not list")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.getoption("--allowed-skips"):
        for name in _skips_not_allowed(terminalreporter, config):
            terminalreporter.write_line(f"SKIPPED but not listed in {config.getoption('--allowed-skips')}: {name}")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if session.config.getoption("--allowed-skips") and reporter and _skips_not_allowed(reporter, session.config):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def _skips_not_allowed(reporter: pytest.TerminalReporter, config: pytest.Config) -> list[str]:
    lines = Path(str(config.getoption("--allowed-skips"))).read_text().splitlines()
    allowed = {line.partition("#")[0].strip() for line in lines}
    return [report.nodeid for report in reporter.stats.get("skipped", []) if report.nodeid not in allowed]


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
