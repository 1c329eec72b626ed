"""What each task depends on: a change of anything else leaves it at work. And the ways to the menu as tasks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gateway.clock import SystemClock
from gateway.config import Config
from gateway.config_checks import validate
from gateway.hmi.control import open_control
from gateway.supervisor import Plan, Supervisor
from gateway.wiring import CONTROL, SERIAL_CONSOLE, TELNET, build, control_plan, terminal_plans
from tests.configs import MASTER, REQUEST, SLAVE
from tests.hmi.terminals import MAIN_MENU, House, tcp_client, unix_client
from tests.lines import PATIENCE_S, Pty, pty_pair
from tests.peers import free_port
from tests.programs import until
from tests.tasks import RunningSupervisor, running

CLOCK = SystemClock()
FILE: dict[str, Any] = {
    "master": [
        MASTER | {"request": [REQUEST, REQUEST | {"point": 100, "unit": 18}]},
        MASTER | {"name": "plant", "line": "tcp://192.168.1.20:502"},
    ],
    "slave": [SLAVE, SLAVE | {"name": "plc", "line": "/dev/ttyS3"}],
    "hmi": {"serial": {"line": "/dev/ttyS0"}},
}
FIELD, SCADA, TERMINALS = {"field"}, {"scada"}, {SERIAL_CONSOLE, TELNET}
SLAVES = {"scada", "plc"}
LINES = {"field", "plant"} | SLAVES


def a_config(data: dict[str, Any]) -> Config:
    config, findings = validate(data)
    assert config is not None, findings
    return config


def entry(place: int, **keys: Any) -> dict[str, Any]:
    """Return the file with other keys in one master (0, 1) or slave (2, 3)."""
    kind, number = ("master", place) if place < 2 else ("slave", place - 2)
    entries = [line | keys if i == number else line for i, line in enumerate(FILE[kind])]
    return FILE | {kind: entries}


def request(**keys: Any) -> dict[str, Any]:
    """Return the file with other keys in the first request of the first master."""
    first, second = FILE["master"][0]["request"]
    return entry(0, request=[first | keys, second])


def plans_of(data: dict[str, Any]) -> dict[str, Plan]:
    config = a_config(data)
    plans = build(config, CLOCK).plans + terminal_plans(config, House(CLOCK).shared, None)
    return {plan.name: plan for plan in plans}


CHANGES: dict[str, tuple[dict[str, Any], set[str]]] = {
    "nothing": (FILE, set()),
    "what is the default anyway": (entry(0, parity="even", enabled=True), set()),
    "a speed": (entry(0, baudrate=9600), FIELD),
    "a port": (entry(0, line="/dev/ttyS1"), FIELD),
    "a line off": (entry(0, enabled=False), set()),
    "a line off and its speed": (entry(0, enabled=False, baudrate=9600), FIELD),
    "a request": (request(address=1), FIELD),
    "a request off": (request(enabled=False), FIELD),
    "a request less": (entry(0, request=FILE["master"][0]["request"][:1]), FIELD),
    "requests in another order": (entry(0, request=FILE["master"][0]["request"][::-1]), FIELD),
    "masters in another order": (FILE | {"master": FILE["master"][::-1]}, set()),
    "a slave's unit": (entry(2, unit=2), SCADA),
    "who may come to a slave": (entry(2, allow=["10.0.0.0/8"]), SCADA),
    "a slave off": (entry(2, enabled=False), set()),
    "identity": (FILE | {"identity": {"vendor": "somebody"}}, SLAVES),
    "size of a table": (FILE | {"register": {"coils": 3000}}, LINES),
    "tables that outlive a restart": (FILE | {"register": {"retain": ["coils"]}}, set()),
    "the event queue": (FILE | {"events": {"fifo_point": 1, "size": 5, "block_point": 1000}}, set()),
    "the watchdog's timeout": (FILE | {"watchdog": {"timeout": 20.0}}, LINES | TERMINALS),
    "the watchdog's device": (FILE | {"watchdog": {"device": "/dev/watchdog"}}, set()),
    "the log": (FILE | {"log": {"level": "debug"}}, set()),
    "the menu's language": (FILE | {"hmi": FILE["hmi"] | {"language": "es"}}, set()),
    "the console's port": (FILE | {"hmi": {"serial": {"line": "/dev/ttyS1"}}}, {SERIAL_CONSOLE}),
    "the console's speed": (FILE | {"hmi": {"serial": {"line": "/dev/ttyS0", "baudrate": 9600}}}, {SERIAL_CONSOLE}),
    "where telnet listens": (FILE | {"hmi": FILE["hmi"] | {"telnet": {"listen": "127.0.0.1:23"}}}, {TELNET}),
    "who may come by telnet": (FILE | {"hmi": FILE["hmi"] | {"telnet": {"allow": ["10.0.0.0/8"]}}}, set()),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_touches_only_the_tasks_that_depend_on_it(change: str) -> None:
    data, touched = CHANGES[change]
    before, after = plans_of(FILE), plans_of(data)
    assert sorted(before) == sorted(after)
    assert {name for name, plan in after.items() if plan.basis != before[name].basis} == touched


def test_a_plan_says_whether_its_line_is_on() -> None:
    assert {name for name, plan in plans_of(entry(0, enabled=False)).items() if not plan.enabled} == FIELD
    assert {name for name, plan in plans_of(entry(3, enabled=False)).items() if not plan.enabled} == {"plc"}


def test_a_master_and_a_slave_that_exchange_their_names_are_both_made_anew() -> None:
    before = plans_of(FILE)
    after = plans_of(FILE | {"master": entry(0, name="plc")["master"], "slave": entry(3, name="field")["slave"]})
    assert {name for name in before if before[name].basis != after[name].basis} == {"plc", "field"}


def test_the_register_has_the_sizes_of_the_configuration_adopted() -> None:
    station = build(a_config(FILE), CLOCK)
    config = a_config(FILE | {"register": {"holding_registers": 5000, "coils": 1}})
    station.adopt(config)
    assert station.config is config
    assert [station.register.size(table) for table in config.register_.sizes] == list(config.register_.sizes.values())


# ------------------------------------------------------------------------------------------------ ways to the menu


def menu_config(**hmi: Any) -> Config:
    return a_config({"hmi": hmi})


class Ways:
    """The ways to the menu of a configuration, and of others after it."""

    def __init__(self, **hmi: Any) -> None:
        self.house = House(CLOCK)
        self.first = self.plans(**hmi)

    def plans(self, **hmi: Any) -> list[Plan]:
        self.house.configure(**hmi)
        return terminal_plans(menu_config(**hmi), self.house.shared, None)


def test_there_are_as_many_ways_to_the_menu_as_are_configured() -> None:
    ways = Ways()
    off, on = {"telnet": {"listen": ""}}, {"serial": {"line": "/dev/ttyS0"}}
    assert [plan.name for plan in ways.plans()] == [TELNET]
    assert ways.plans(**off) == []
    assert [plan.name for plan in ways.plans(**on)] == [SERIAL_CONSOLE, TELNET]
    control = Plan(CONTROL, ways.first[0].make)
    all_three = terminal_plans(menu_config(**on), ways.house.shared, control)
    assert [plan.name for plan in all_three] == [CONTROL, SERIAL_CONSOLE, TELNET]
    assert all_three[0] is control


def test_telnet_moves_to_another_port_and_whoever_is_there_is_let_go() -> None:
    first, second = ({"telnet": {"listen": f"127.0.0.1:{free_port()}"}} for _ in range(2))
    ways = Ways(**first)
    with running(Supervisor(ways.first, CLOCK)) as run:
        old = wait_for_port(run)
        with tcp_client(old) as client:
            client.read_until(MAIN_MENU.strip())
            run.change(ways.plans(**first))
            run.change(ways.plans(**first, language="es"))
            client.send(b"z")
            client.read_until("[")  # still there
            run.change(ways.plans(**second))
            client.read_all()
        assert wait_for_port(run) != old
        with tcp_client(wait_for_port(run)) as client:
            client.read_until(MAIN_MENU.strip())
    assert run.was_clean


def wait_for_port(run: RunningSupervisor) -> int:
    telnet: Any = run.supervisor.tasks[TELNET]
    until(lambda: telnet.port is not None)
    assert isinstance(telnet.port, int)
    return telnet.port


def test_the_serial_console_moves_to_another_port() -> None:
    with pty_pair() as first, pty_pair() as second:
        no_telnet = {"telnet": {"listen": ""}, "serial_hold": 0.0}
        ways = Ways(**no_telnet, serial={"line": first.device})
        with running(Supervisor(ways.first, CLOCK)) as run:
            wait_for_greeting(first)
            run.change(ways.plans(**no_telnet, serial={"line": second.device}))
            wait_for_greeting(second)
            run.change(ways.plans(**no_telnet))
            assert run.supervisor.tasks == {}
        assert run.was_clean


def wait_for_greeting(line: Pty) -> None:
    came = b""
    while b"Press any key" not in came:
        more = line.receive(1)
        assert more, f"no greeting comes, but {came!r}"
        came += more


def test_the_control_socket_stays_whatever_changes(tmp_path: Path) -> None:
    ways = Ways(telnet={"listen": ""})
    control = control_plan(ways.house.shared, lambda: open_control(tmp_path / "control"), {"hello": lambda _: "hello"})
    with running(Supervisor([control], CLOCK)) as run:
        task = run.supervisor.tasks[CONTROL]
        assert task.ready.wait(PATIENCE_S)
        with unix_client(tmp_path / "control") as client:
            run.change([control, *ways.plans(telnet={"listen": f"127.0.0.1:{free_port()}"})])
            run.change([control])
            client.send(b"hello\n")
            assert "hello" in client.read_all()
        assert run.supervisor.tasks == {CONTROL: task}
    assert run.was_clean
