"""A few hangs in the real process, as a sample: the whole table is `tests/system/test_hangs.py`."""

from __future__ import annotations

from pathlib import Path

from gateway.wiring import TELNET
from tests.hanging.bench import MASTER, TCP_SLAVE, plants
from tests.hanging.table import Case, assert_all_well, provoke_all

TIMEOUT_S = 1.0
ALLOWED_S = 1.5  # the machine may be busy with other tests; how soon it is exactly, the whole table tells


def test_a_hang_ends_the_process_in_time_the_next_start_knows_why_and_a_dead_thread_is_made_anew(
    tmp_path: Path,
) -> None:
    cases = [Case(MASTER, "deadlock"), Case(TCP_SLAVE, "interpreter"), Case(TELNET, "leave")]
    with plants(len(cases)) as wired:
        outcomes = provoke_all(cases, wired, tmp_path, TIMEOUT_S, ALLOWED_S)
    assert_all_well(outcomes)
