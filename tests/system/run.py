"""`make system-test`: runs what takes minutes, and writes what came of it to LAST.md beside this file.

A test here fails where a tool is missing; it never skips. Figures come from pytest's ``record_property``.
"""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

HERE = Path(__file__).parent
LAST = HERE / "LAST.md"


class Outcomes:
    """A pytest plugin that keeps each test's outcome, duration and figures."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.failed = False

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when != "call" and report.passed:
            return
        self.failed |= not report.passed
        name = report.nodeid.rpartition("/")[2]
        self.lines.append(f"- {name}: **{report.outcome}** in {report.duration:.0f} s")
        self.lines += [f"  - {figure}: {value}" for figure, value in report.user_properties]


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=HERE, capture_output=True, text=True, check=True).stdout.strip()


def main() -> int:
    commit = git("rev-parse", "HEAD")
    changed = [line for line in git("status", "--porcelain").splitlines() if not line.endswith("LAST.md")]
    outcomes = Outcomes()
    code = pytest.main(["-x" if "-x" in sys.argv else "-q", str(HERE), "-s"], plugins=[outcomes])
    failed = outcomes.failed or code != pytest.ExitCode.OK
    head = [
        "# The last system test",
        "",
        "Written by `make system-test`.",
        "",
        f"- commit: {commit}{' with uncommitted changes' if changed else ''}",
        f"- date: {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        f"- outcome: {'FAILED' if failed else 'passed'}",
        "",
    ]
    LAST.write_text("\n".join(head + outcomes.lines) + "\n")
    print(LAST.read_text())
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
