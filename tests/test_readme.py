"""README tells the truth: its program runs, its configuration loads, its map has every file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gateway.line_load import line_load
from gateway.modbus.pdu import Table
from gateway.simulator import Device, Simulator
from gateway.store import load_text
from tests.test_floors import module_names

README = (Path(__file__).parent.parent / "README.md").read_text()


def block(language: str) -> str:
    found = re.search(rf"^```{language}\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
    assert found
    return found[1]


def test_the_program_reads_five_holding_registers(capsys: pytest.CaptureFixture[str]) -> None:
    device = Device("device", 0x10)
    device.set(Table.HOLDING_REGISTERS, 0x24, [11, 22, 33, 44, 65535])
    with Simulator() as simulator:
        path = simulator.add_serial([device])
        program = block("python").replace("/dev/ttyUSB0", path)
        assert path in program
        exec(compile(program, "README.md", "exec"), {})  # noqa: S102 - README's own text is what is tested
    assert capsys.readouterr().out == "[11, 22, 33, 44, 65535]\n"


def test_the_program_tells_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    device = Device("device", 0x10)
    device.set(Table.HOLDING_REGISTERS, 0, [0])  # nothing at 0x24: exception 2
    with Simulator() as simulator:
        program = block("python").replace("/dev/ttyUSB0", simulator.add_serial([device]))
        exec(compile(program, "README.md", "exec"), {})  # noqa: S102 - README's own text is what is tested
    assert capsys.readouterr().out == "error 2\n"


def test_the_smallest_file_is_valid_and_its_load_is_as_shown() -> None:
    loaded = load_text(block("toml"), "rtugate.toml")
    load = line_load(loaded.config.master[0])
    shown = f"field: {load.percent:.0f} % of 19200 baud, slowest cycle {load.slowest_cycle_s:.1f} s"
    assert loaded.findings == []
    assert shown in README


def test_the_two_commands_come_first() -> None:
    assert README.index("make demo") < README.index("make test") < README.index("## ")


def test_the_map_has_every_file() -> None:
    map_of_the_code = README.partition("## Map of the code")[2]
    missing = [name for name in module_names() if f"`{name.replace('.', '/')}.py`" not in map_of_the_code]
    assert missing == []
