"""Every framing, what a slave answers and how a master reads a reply are fuzzed: nothing raises, is slow, or grows.

Both ways of ``fuzz_targets`` for each target, each in a process of its own, both at once. A finding fails the test with
the stream that leads to it. Longer than usual:

    RTUGATE_FUZZ_S=600 RTUGATE_FUZZ_INPUTS=10000000 python -m pytest tests/system/test_fuzz.py
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import pytest

from tests.system.fuzz_targets import SLOW_S, TARGETS, Figures, Target, feed, steps_in

GUIDED_S = float(os.environ.get("RTUGATE_FUZZ_S", "60"))
INPUTS = int(os.environ.get("RTUGATE_FUZZ_INPUTS", "1000000"))
PATIENCE_S = GUIDED_S + INPUTS / 10_000 + 120  # a process that has not ended by then hangs
# The allocator takes what the largest inputs need late; atheris keeps what reaches something new. Blocks are exact.
GROWTH_KIB = {"fast": 4096, "guided": 16384}
GROWTH_BLOCKS = 1000  # a hundredth of what the program is itself; an object left by every input would be thousands
ROOT = Path(__file__).parents[2]
GUIDED = """
import sys, atheris
with atheris.instrument_imports(include=["gateway"]):
    from tests.system import fuzz_targets
fuzz_targets.run_guided(atheris, sys.argv[1], float(sys.argv[2]), sys.argv[3])
"""


def start(way: str, arguments: list[str], where: Path) -> subprocess.Popen[str]:
    """Start a process that says its figures on standard output, and what it finds in a file."""
    with (where / way).open("w") as said:
        return subprocess.Popen(
            [sys.executable, *arguments], cwd=ROOT, stdout=subprocess.PIPE, stderr=said, text=True
        )  # fmt: skip


def figures_of(process: subprocess.Popen[str], said: Path) -> dict[str, Any]:
    """Wait for the process; fail with what it found, if anything."""
    out, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, f"{out}\n{said.read_text()[-20_000:]}"
    figures: dict[str, Any] = json.loads(out.splitlines()[-1])
    return figures


@pytest.mark.parametrize("target", TARGETS)
def test_no_input_raises_takes_10_ms_or_leaves_anything_behind(
    target: str, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    processes = {
        "fast": start("fast", ["-m", "tests.system.fuzz_targets", target, str(INPUTS)], tmp_path),
        "guided": start("guided", ["-c", GUIDED, target, str(GUIDED_S), str(corpus)], tmp_path),
    }
    try:
        found = {way: figures_of(process, tmp_path / way) for way, process in processes.items()}
    finally:
        for process in processes.values():
            process.kill()
            process.wait()
    for way, figures in found.items():
        record_property(f"{target}, {way}, inputs", f"{figures['inputs']:,} in {figures['seconds']} s")
        record_property(f"{target}, {way}, slowest", f"{figures['slowest_ms']} ms")
        record_property(f"{target}, {way}, KiB after warm-up and at the end", figures["rss_kib"])
        record_property(f"{target}, {way}, Python's blocks, the same", figures["blocks"])
    assert found["fast"]["inputs"] >= INPUTS
    assert found["guided"]["inputs"] >= 100 * GUIDED_S  # a tenth of what the slowest target does
    for way, figures in found.items():
        assert figures["rss_kib"][1] <= figures["rss_kib"][0] + GROWTH_KIB[way], way
        assert figures["blocks"][1] <= figures["blocks"][0] + GROWTH_BLOCKS, way


# ------------------------------------------------------------------------------------------------ the fuzzer itself


class Deaf:
    """An ear that breaks on one byte."""

    def take(self, how: int, data: bytes) -> None:
        assert b"\x83" not in data

    def finish(self) -> None:
        """Nothing more."""


class Slow(Deaf):
    """An ear that is slow every time."""

    def take(self, how: int, data: bytes) -> None:
        began_s = perf_counter()
        while perf_counter() < began_s + 1.5 * SLOW_S:
            pass


def test_what_breaks_an_ear_is_shown_with_its_stream() -> None:
    with pytest.raises(AssertionError, match=r"\[\(7, bytes.fromhex\('8302'\)\)\]"):
        feed(Target(Deaf, [], bytes), [(7, b"\x83\x02")], Figures())


def test_an_input_that_is_slow_every_time_is_a_finding() -> None:
    with pytest.raises(AssertionError, match="an input took"):
        feed(Target(Slow, [], bytes), [(0, b"\x03")], Figures())


def test_a_guided_input_is_cut_into_steps_and_sealed_where_it_says_so() -> None:
    steps = steps_in(b"\x07\x02\x01\x02" + b"\x83\x03\x01\x83\x02" + b"\x00\x09\x05", TARGETS["rtu_master"].seal)
    assert steps == [(7, b"\x01\x02"), (3, bytes.fromhex("01 83 02 C0 F1")), (0, b"\x05")]
