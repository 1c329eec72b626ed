"""Any keys at all, sensible ones most of the time: the menu goes on working, and nothing comes to harm."""

from __future__ import annotations

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from gateway.config import Config
from gateway.config_checks import cross_check
from gateway.hmi.keys import ENTER, ERASE, ESC
from gateway.hmi.screens.changes import given as keys_given
from gateway.modbus.pdu import Table
from tests.hmi.desk import PROMPTS, Desk, desk_of
from tests.hmi.transcript import Terminal

PHRASES = [
    *"mdzcrvbaskenwuitlfx?0123456789ynS+- \r\b\x1b",
    "d3107\r5\r",
    "d20\r100\r",
    "f",
    "z3110\r650\r",
    "z3200\rl\r17\r",
    "z10\r1\r",
    "c17\r310\r5\ry",
    "c0\r110\r1\ry",
    "rn18\r3\r0\r2\r\r300\r",
    "rm\r16\r\r\r\r120\r\r",
    "rby",
    "rxy",
    "v3\r2",
    "nn1new\r/dev/ttyS7\r" + ENTER * 9,
    "nn2plc\rtcp://0.0.0.0:1502\r" + ENTER * 5,
    "nm1" + ENTER * 9,
    "nb1y",
    "nb2y",
    "fy",
    "a/dev/ttyS2\r\r\r\r",
    "wy",
    "k7\r",
    "40108\r",
    "123456789",
    ESC * 3,
]
typed = st.lists(
    st.one_of(st.sampled_from(PHRASES), st.text(max_size=3), st.sampled_from(["\x00", "\x1b[A", "\u00e9", "\u4e2d"])),
    max_size=25,
)


@given(typed, st.booleans())
@example(["nb2y", "nb1y", "nb", "rxy", "f"], False)
@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
def test_any_keys_leave_the_menu_working(phrases: list[str], in_line_mode: bool) -> None:
    desk = desk_of("boiler")
    desk.menu.echoes = desk.echoes = False  # only what the menu itself says is looked at
    desk.menu.ends_keys_with_enter = in_line_mode
    terminal = Terminal()
    sizes = {table: desk.station.register.size(table) for table in Table}
    for phrase in phrases:
        before = len(desk.screen)
        desk.type(phrase.encode("utf-8", "ignore").decode())
        desk.wait(0.3)
        terminal.show(desk.screen[before:])
    desk.menu.pause()
    if not desk.menu.has_left:
        desk.type(ENTER + ESC * 8)
        assert desk.screen.endswith(PROMPTS)
    said = [] if in_line_mode else terminal.lines  # there the line end of what is typed comes from the terminal
    assert all(len(line) < 80 and line.isprintable() for line in said)
    config = desk.station.config
    assert [finding for finding in cross_check(config) if finding.severity == "error"] == []
    assert Config.model_validate(keys_given(config)) == config
    assert {table: desk.station.register.size(table) for table in Table} == sizes
    for master in desk.station.masters.values():
        master.close()


def test_erasing_is_possible_everywhere(boiler: Desk) -> None:
    for key in "dzcrvknfpx":
        boiler.type(key + ERASE * 3 + ESC * 3)
        assert boiler.screen.endswith(PROMPTS), key
