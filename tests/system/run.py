"""`make system-test`: runs what takes minutes, and writes what came of it to LAST.md beside this file.

A test here fails where a tool is missing; it never skips. Figures come from pytest's ``record_property``. With names of
test files as arguments only those run: their entries in LAST.md are made anew, the others keep theirs, commit and all.
"""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

HERE = Path(__file__).parent
LAST = HERE / "LAST.md"
HEAD = """\
# The last system test

Written by `make system-test`: each test with its outcome, the commit and time it ran at, and its figures.

"""


class Outcomes:
    """A pytest plugin that keeps each test's outcome and figures, as an entry of LAST.md by name."""

    def __init__(self, stamp: str) -> None:
        self.entries: dict[str, str] = {}
        self._stamp = stamp

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when != "call" and report.passed:
            return
        path, _, test = report.nodeid.partition("::")
        name = f"{Path(path).name}::{test}"
        lines = [f"- {name}: **{report.outcome}** in {report.duration:.0f} s, {self._stamp}"]
        lines += [f"  - {figure}: {value}" for figure, value in report.user_properties]
        self.entries[name] = "\n".join(lines)


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=HERE, capture_output=True, text=True, check=True).stdout.strip()


def stamp() -> str:
    """Return the commit and the time of this run."""
    changed = [line for line in git("status", "--porcelain").splitlines() if not line.endswith("LAST.md")]
    changes = " with uncommitted changes" if changed else ""
    return f"commit {git('rev-parse', '--short=12', 'HEAD')}{changes}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC"


def kept_entries(ran: set[str]) -> dict[str, str]:
    """Return the entries of LAST.md of the test files that did not run now."""
    text = LAST.read_text() if LAST.exists() else ""
    entries = ["- " + entry.rstrip() for entry in ("\n" + text).split("\n- ")[1:]]
    by_name = {entry[2:].partition(": **")[0]: entry for entry in entries if ": **" in entry}
    return {name: entry for name, entry in by_name.items() if name.partition("::")[0] not in ran}


def main() -> int:
    outcomes = Outcomes(stamp())
    files = sys.argv[1:]
    code = pytest.main(["-q", *(files or [str(HERE)])], plugins=[outcomes])
    ran = {Path(file).name for file in files} or {path.name for path in HERE.glob("test_*.py")}
    entries = kept_entries(ran) | outcomes.entries
    failed = [name for name, entry in entries.items() if "**passed**" not in entry]
    verdict = f"FAILED: {', '.join(failed)}" if failed else f"All {len(entries)} tests passed."
    LAST.write_text(HEAD + verdict + "\n\n" + "\n".join(entries[name] for name in sorted(entries)) + "\n")
    print(LAST.read_text())
    return int(bool(failed) or code != pytest.ExitCode.OK)


if __name__ == "__main__":
    sys.exit(main())
