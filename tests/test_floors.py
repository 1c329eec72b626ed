"""The house's walls: a module imports only what stands above it in this list (README, map of the code)."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import gateway

ROOT = Path(gateway.__file__).parent

FLOORS = [  # from the ground up; within a floor, in the order they may build on each other
    [
        "errors",
        "clock",
        "plain_text",
        "counters",
        "schedule",
        "modbus.pdu",
        "modbus.framing",
        "modbus.describe",
        "modbus.pieces",
        "modbus.diagnostics",
        "modbus.identification",
        "logs",
    ],
    [
        "register",
        "toml_text",
        "toml_layout",
        "toml_pairs",
        "toml_edit",
        "config_fields",
        "config",
        "line_load",
        "config_checks",
        "hmi.wording",
        "hmi.telnet",
        "hmi.keys",
        "hmi.access",
        "hmi.seat",
        "hmi.menu",
    ],
    [
        "commands",
        "events",
        "modbus.server",
        "transaction",
        "link",
        "link_tcp",
        "opening",
        "polls",
        "tickets",
        "traffic",
        "serving",
        "files",
        "store",
        "difference",
        "save",
        "history",
        "snapshots",
        "retained",
        "documents",
        "hmi.background",
        "hmi.login",
        "hmi.session",
        "hmi.texts",
        "hmi.station",
        "hmi.screens.changes",
        "hmi.screens.data",
        "hmi.screens.command",
        "hmi.screens.writes",
        "hmi.screens.settings",
        "hmi.screens.requests",
        "hmi.screens.lines",
        "hmi.screens.status",
        "hmi.screens.file",
        "hmi.screens.main",
        "status",
        "hmi.client",
        "config_file",
        "stacks",
        "restart_cause",
        "watchdog",
        "systemd",
        "safe_mode",
    ],
    [
        "master",
        "slave",
        "slave_tcp",
        "hmi.console",
        "hmi.terminals",
        "hmi.control",
        "supervisor",
        "guard",
        "simulator",
    ],
    [
        "wiring",
        "running",
        "service",
        "edits",
    ],
    [
        "demo",
        "cli",
    ],
]
TASKS = {"master", "slave", "slave_tcp", "hmi.console", "hmi.terminals"}
PURE = {name for floor in FLOORS[:2] for name in floor} - {"clock"}
OUTSIDE = {"os", "socket", "serial", "time", "select", "selectors", "subprocess"}
PYMODBUS_USERS = {"simulator", "demo"}


def module_names() -> list[str]:
    paths = (path.relative_to(ROOT).with_suffix("") for path in ROOT.rglob("*.py"))
    return sorted(".".join(p.parts) for p in paths if p.name not in ("__init__", "__main__"))


def imports_of(name: str) -> set[str]:
    """Every module that *name* imports, anywhere in its text."""
    tree = ast.parse((ROOT / Path(*name.split("."))).with_suffix(".py").read_text())
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def test_every_module_has_its_floor() -> None:
    assert sorted(name for floor in FLOORS for name in floor) == module_names()


@pytest.mark.parametrize("name", module_names())
def test_a_module_imports_only_what_stands_below_it(name: str) -> None:
    order = [module for floor in FLOORS for module in floor]
    below = set(order[: order.index(name)])
    ours = {i.removeprefix("gateway.") for i in imports_of(name) if i.startswith("gateway.")} & set(order)
    assert ours <= below, f"{name} must not import {sorted(ours - below)}"


@pytest.mark.parametrize("name", sorted(TASKS))
def test_tasks_never_import_each_other(name: str) -> None:
    assert not {f"gateway.{other}" for other in TASKS - {name}} & imports_of(name)


@pytest.mark.parametrize("name", sorted(PURE))
def test_the_lower_floors_touch_no_port_no_file_and_no_clock(name: str) -> None:
    assert not {i.partition(".")[0] for i in imports_of(name)} & OUTSIDE


@pytest.mark.parametrize("name", sorted(set(module_names()) - PYMODBUS_USERS))
def test_pymodbus_is_nowhere_near_the_drivers(name: str) -> None:
    assert "pymodbus" not in {i.partition(".")[0] for i in imports_of(name)}


@pytest.mark.parametrize("name", module_names())
def test_a_module_says_what_it_is_and_stays_readable(name: str) -> None:
    text = (ROOT / Path(*name.split("."))).with_suffix(".py").read_text()
    assert ast.get_docstring(ast.parse(text))
    assert len(text.splitlines()) <= 500


def functions_of(name: str) -> list[tuple[str, int]]:
    tree = ast.parse((ROOT / Path(*name.split("."))).with_suffix(".py").read_text())
    functions = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))
    return [(node.name, (node.end_lineno or 0) - node.lineno + 1) for node in functions]


@pytest.mark.parametrize("name", module_names())
def test_no_function_hides_two_ideas(name: str) -> None:
    assert [function for function, lines in functions_of(name) if lines > 60] == []


def test_only_the_clock_asks_for_the_time() -> None:
    users = {name for name in module_names() if "time" in imports_of(name)}
    assert users <= {"clock", "demo", "simulator"}
