"""`rtugate run` as systemd and a person meet it: real processes, signals, sockets, bad files and bad disks."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.errors import LinkUnavailable
from gateway.hmi.control import AlreadyRunning, open_control
from gateway.modbus.pdu import Table
from gateway.service import _control_listener, _make_state
from gateway.simulator import Device, Simulator
from gateway.snapshots import LAST_GOOD, UNCONFIRMED, write_last_good
from tests.changing import read, section, serial_master, slave
from tests.config_files import BAD, GOOD, config_of, counting, text_counting
from tests.hmi.terminals import tcp_client
from tests.lines import raw_client
from tests.peers import client_tcp, free_port, unit_kwargs
from tests.programs import SOON_S, STOP_LIMIT_S, Program, is_listening, program, until
from tests.test_files import NOBODY

PROMPT = "rtugate> "
UNSAVED = "rtugate*> "
ASK = bytes.fromhex("0001 0000 0006 01 03 0000 0001")  # read holding register 0 of unit 1
ANSWER_SIZE = 11
FACTORY_RUNS = "ALARM: rtugate.toml cannot be used (L shows why): factory settings run"
GOOD_RUNS = "ALARM: rtugate.toml cannot be used (L shows why): the last good configuration runs"
RUNS = "INFO rtugate "  # version runs: ...
SLOW_DISK = """
import os, sys, time
flush = os.fsync
os.fsync = lambda descriptor: (time.sleep(0.5), flush(descriptor))[1]
from gateway.cli import main
sys.exit(main())
"""
STUCK_DISK = """
import os, sys, time
flush = os.fsync

def wait_and_flush(descriptor):
    while os.path.exists("stuck"):
        time.sleep(0.01)
    flush(descriptor)

os.fsync = wait_and_flush
from gateway.cli import main
sys.exit(main())
"""
AS_NOBODY = f"""
import encodings.idna, os, sys
import gateway.cli, gateway.service  # now: nobody may not be allowed to read them
os.setgroups([])
os.setegid({NOBODY})
os.seteuid({NOBODY})
code = gateway.cli.main()
os.seteuid(0)  # what measures the tests may write again
sys.exit(code)
"""


def telnet(port: int | None = None) -> str:
    return section("[hmi.telnet]", listen="" if port is None else f"127.0.0.1:{port}")


@pytest.fixture
def good(tmp_path: Path) -> Iterator[Program]:
    """A gateway on the file ``GOOD``, at work."""
    with program(tmp_path, GOOD) as made:
        yield made.started()


# ------------------------------------------------------------------------------------------------ reloading


def test_a_reload_restarts_only_what_changed_and_everybody_else_stays(tmp_path: Path) -> None:
    first, second, third, menu = (free_port() for _ in range(4))
    device = Device("boiler", 17)
    device.set(Table.HOLDING_REGISTERS, 107, [555])
    with Simulator() as simulator, program(tmp_path, "") as gateway:
        field = serial_master("field", simulator.add_serial([device]), read(0))
        gateway.path.write_text(field + slave("scada", first) + slave("plc", second) + telnet(menu))
        gateway.started()
        gateway.wait_for("telnet server: listening")
        until(lambda: is_listening(first) and is_listening(second))
        with raw_client(first) as scada, raw_client(second) as plc, tcp_client(menu) as person:
            until(lambda: scada.ask(ASK, ANSWER_SIZE)[-2:] == b"\x02\x2b")  # polled
            assert plc.ask(ASK, ANSWER_SIZE)[-2:] == b"\x02\x2b"
            person.read_until(PROMPT)
            gateway.reload(field + slave("scada", first) + slave("plc", third) + telnet(menu))
            person.read_until("The file has been reloaded.")  # without a key
            assert plc.is_closed()
            until(lambda: is_listening(third))
            assert not is_listening(second)
            assert scada.ask(ASK, ANSWER_SIZE)[-2:] == b"\x02\x2b"
            person.read_until(PROMPT)
            person.send(b"i")
            person.read_until("scada")
        assert gateway.stop() == 0


def test_a_bad_file_changes_nothing_and_everything_wrong_is_logged(tmp_path: Path) -> None:
    port, menu = free_port(), free_port()
    text = GOOD.partition("[hmi.telnet]")[0] + slave("scada", port) + telnet(menu)
    with program(tmp_path, text) as gateway:
        gateway.started()
        gateway.wait_for("telnet server: listening")
        until(lambda: is_listening(port))
        with raw_client(port) as scada, tcp_client(menu) as person:
            person.read_until(PROMPT)
            gateway.reload(text.replace("count = 3", "count = 126").replace("every = 1.0", "every = 0"))
            gateway.wait_for("ERROR rtugate.toml: not reloaded, nothing has changed")
            assert "ERROR rtugate.toml:11: " in gateway.said
            assert "count 126 is more than 125" in gateway.said
            assert len(scada.ask(ASK, ANSWER_SIZE)) == ANSWER_SIZE
            person.send(b"w")
            person.read_until("The file has been edited since it was loaded.")
            answer = gateway.ask("reload")
            assert answer is not None
            assert answer.startswith("error: not reloaded, nothing has changed: rtugate.toml:")
        assert gateway.stop() == 0


def test_a_reload_drops_what_is_unsaved_and_whoever_has_the_menu_is_told(good: Program) -> None:
    with good.menu() as person:
        person.read_until(PROMPT)
        person.send(b"fy")
        person.read_until(UNSAVED)
        good.reload()
        person.read_until("The file has been reloaded; unsaved changes of this menu are gone.")
        person.read_until(PROMPT)
    assert "unsaved changes of the menu are dropped" in good.said


def test_many_reloads_at_once_are_no_harm(good: Program) -> None:
    for _ in range(30):
        good.reload()
    assert good.ask("reload") == "reloaded"
    assert good.stop() == 0
    assert "Traceback" not in good.said


def test_rollback_and_passwd_change_the_file_and_the_gateway_that_runs(good: Program) -> None:
    with good.menu() as person:
        person.read_until(PROMPT)
        person.send(b"fyw")
        person.read_until("(y/n/c)")
        person.send(b"y")
        person.read_until("Saved.")
    assert good.command("history")[1].split()[0] == "2"
    assert good.command("rollback", "1") == (0, f"{good.path}: is version 1 again\nreloaded\n")
    assert good.path.read_text() == GOOD
    with good.menu() as person:
        person.read_until(PROMPT)  # nothing is unsaved
    code, told = good.command("rollback", "9")
    assert (code, told) == (1, "there is no version 9: `rtugate history` lists what there is\n")
    code, told = good.command("passwd")
    assert (code, told) == (1, "a password has at least 8 characters\n")


# ------------------------------------------------------------------------------------------------ one at a time


def test_a_second_gateway_is_refused_with_exit_code_1_and_the_first_goes_on(good: Program) -> None:
    mark = good.said
    good.start()
    assert good.run.wait(10.0) == 1
    assert good.said.removeprefix(mark) == f"ERROR rtugate runs already (control socket {good.control})\n"
    good.runs.pop()
    assert good.ask("reload") == "reloaded"
    assert good.stop() == 0


def test_a_second_gateway_with_another_socket_leaves_the_firsts_state_alone(good: Program) -> None:
    elsewhere = good.folder / "elsewhere"
    elsewhere.mkdir()
    kept = state_of(good)
    good.start(environment={"RUNTIME_DIRECTORY": str(elsewhere)})
    second = good.runs.pop()
    assert second.wait(SOON_S) == 1
    assert f"rtugate runs already (state directory {good.state})" in good.said
    assert state_of(good) == kept
    assert list(elsewhere.iterdir()) == []


def state_of(run: Program) -> dict[Path, bytes]:
    """Return what is kept; of the stacks whose process they are of, since its list of threads changes by itself."""
    kept = {path: path.read_bytes() for path in run.state.iterdir() if path.is_file()}
    return {path: data.split(b" ")[0] if path.name == "stacks.txt" else data for path, data in kept.items()}


def test_a_disk_that_does_not_answer_holds_up_no_stop(tmp_path: Path) -> None:
    with program(tmp_path, GOOD) as stuck:
        stuck.started(["-c", STUCK_DISK])
        (tmp_path / "stuck").touch()
        stuck.run.send_signal(signal.SIGTERM)
        assert stuck.run.wait(STOP_LIMIT_S) == 0
        assert "why the gateway was started cannot be kept: the disk does not answer" in stuck.said


def test_a_control_socket_left_by_a_crash_is_replaced(good: Program) -> None:
    good.run.kill()
    good.run.wait()
    assert good.control.is_socket()
    good.started()
    assert good.ask("reload") == "reloaded"
    assert "last restart: crash" in good.said
    assert good.stop() == 0


def test_a_socket_that_no_task_came_to_use_is_not_left_behind(tmp_path: Path) -> None:
    path = tmp_path / "control"
    with _control_listener(path):
        assert path.is_socket()
    assert not path.exists()
    with _control_listener(path) as listen:
        listener = listen()
        assert listener.getsockname() == str(path)
    assert path.exists()  # it belongs to its task now
    listener.close()
    with _control_listener(tmp_path / "nowhere" / "control") as listen, pytest.raises(LinkUnavailable):
        listen()
    with open_control(path), pytest.raises(AlreadyRunning), _control_listener(path):
        pytest.fail("there are two")


# ------------------------------------------------------------------------------------------------ starting anew


def test_x_in_the_menu_begins_anew_in_the_same_process(tmp_path: Path) -> None:
    port = free_port()
    with program(tmp_path, GOOD + slave("scada", port)) as gateway:
        gateway.started()
        with gateway.menu() as person:
            person.read_until(PROMPT)
            person.send(b"xy")
            person.read_until("Restarting.")
        gateway.wait_for("control socket: listening", 2)
        until(lambda: is_listening(port), lambda: gateway.said)
        assert gateway.run.poll() is None
        assert gateway.said.count(" runs: 1 masters, 1 slaves") == 2
        assert "last restart: restart by the menu" in gateway.said
        with raw_client(port) as scada:
            assert len(scada.ask(ASK, ANSWER_SIZE)) == ANSWER_SIZE
        assert gateway.stop() == 0
        assert not gateway.control.exists()


def test_a_save_that_nobody_waited_for_is_finished_before_the_program_begins_anew(tmp_path: Path) -> None:
    with program(tmp_path, GOOD) as gateway:
        gateway.started(("-c", SLOW_DISK))
        with gateway.menu() as person:
            person.read_until(PROMPT)
            person.send(b"fyw")
            person.read_until("(y/n/c)")
            person.send(b"y\x1b")
            person.read_until("It goes on by itself")
            person.send(b"xy")
            person.read_until("Restarting.")
        gateway.wait_for("control socket: listening", 2)
        with gateway.menu() as person:
            person.read_until(PROMPT)  # what was saved is what runs
        assert config_of(gateway.path.read_text()).master[0].request == []
        assert gateway.said.count("saved by the menu") == 1
        assert list(tmp_path.glob(".*")) == []  # no half of a file
        gateway.run.terminate()
        assert gateway.run.wait(10.0) == 0


def test_a_save_that_waits_for_its_confirmation_does_not_survive_a_crash(good: Program) -> None:
    with good.menu() as person:
        person.read_until(PROMPT)
        person.send(b"fyw")
        person.read_until("(y/n/c)")
        person.send(b"c")
        person.read_until("W confirms it within 10 min")
    assert good.path.read_text() != GOOD
    assert (good.state / UNCONFIRMED).exists()
    good.run.kill()
    good.run.wait()
    good.started()
    assert good.path.read_text() == GOOD
    with good.menu() as person:
        person.read_until("ALARM: the last save to rtugate.toml was never confirmed: the previous file is back")
        person.read_until(PROMPT)
    assert good.stop() == 0


# ------------------------------------------------------------------------------------------------ stopping


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stop_takes_less_than_two_seconds_and_leaves_nothing_behind(tmp_path: Path, number: int) -> None:
    port, menu = free_port(), free_port()
    text = serial_master("gone", "/dev/rtugate-is-not-there", read(0)) + slave("scada", port) + telnet(menu)
    with program(tmp_path, text) as gateway:
        gateway.started()
        gateway.wait_for("telnet server: listening")
        until(lambda: is_listening(port))
        with raw_client(port) as scada, tcp_client(menu) as waiting, gateway.menu() as person:
            scada.ask(ASK, ANSWER_SIZE)
            person.read_until(PROMPT)
            waiting.read_until("has the menu")
            assert gateway.stop(number) == 0
            assert "rtugate stops" in person.read_all()
            assert scada.is_closed()
        assert not is_listening(port)
        assert not is_listening(menu)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["log", "rtugate.toml", "state"]
        assert [path.name for path in gateway.state.iterdir()] == ["last-run.json"]
        assert gateway.said.endswith("INFO stopped\n")


def test_a_stop_that_comes_before_anything_runs_is_a_clean_one(tmp_path: Path) -> None:
    def stop_early() -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # it is delivered once the program allows it
        os.kill(os.getpid(), signal.SIGTERM)

    with program(tmp_path, GOOD) as gateway:
        gateway.start(before=stop_early)
        assert gateway.run.wait(10.0) == 0
        assert gateway.said.endswith("INFO stopped\n")
        assert not gateway.control.exists()


def test_a_command_that_the_stop_comes_before_keeps_nobody_waiting(tmp_path: Path) -> None:
    """Reloads queue up behind one another; a stop in the middle of them is as quick as any."""
    with program(tmp_path, GOOD) as gateway:
        gateway.started()
        clients = [socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for _ in range(20)]
        for client in clients:
            client.connect(str(gateway.control))
            client.sendall(b"reload\n")
        assert gateway.stop() == 0
        for client in clients:
            client.close()


# ------------------------------------------------------------------------------------------------ bad files


@pytest.mark.parametrize("content", [BAD.encode(), b"\xff\xfe", b"[[["])
def test_a_file_that_cannot_be_used_leads_to_factory_settings_and_an_alarm_in_the_menu(
    tmp_path: Path, content: bytes
) -> None:
    with program(tmp_path, content) as gateway:
        gateway.started()
        with gateway.menu() as person:
            person.read_until(FACTORY_RUNS)
            person.read_until(UNSAVED)
        assert FACTORY_RUNS in gateway.command("status")[1]
        assert "running with factory settings, no line is polled or served" in gateway.said
        assert "ERROR rtugate.toml:" in gateway.said
        assert gateway.path.read_bytes() == content
        gateway.reload(GOOD)
        gateway.wait_for("rtugate.toml: reloaded")
        with gateway.menu() as person:
            assert "ALARM" not in person.read_until(PROMPT)
        assert gateway.stop() == 0


def test_a_file_that_cannot_be_used_leads_to_the_last_good_configuration(tmp_path: Path) -> None:
    port = free_port()
    text = GOOD + slave("scada", port)
    with program(tmp_path, text.replace("count = 3", "count = 126")) as gateway:
        write_last_good(gateway.state, counting(config_of(text), 4))
        gateway.started()
        with gateway.menu() as person:
            person.read_until(GOOD_RUNS)
            person.read_until(UNSAVED)
            until(lambda: is_listening(port))
            with client_tcp(port) as scada:
                assert not scada.read_holding_registers(0, count=1, **unit_kwargs(1)).isError()
            for answer, told in ((b"c", "there is no previous file to come back to"), (b"y", "the old file is kept")):
                person.send(b"w")
                person.read_until("(y/n/c)")
                person.send(answer)
                person.read_until(told)
            person.read_until(PROMPT)
        (kept,) = tmp_path.glob("rtugate.toml.rejected-*")
        assert "count = 126" in kept.read_text()
        assert config_of(gateway.path.read_text()) == counting(config_of(text), 4)
        assert gateway.stop() == 0


# ------------------------------------------------------------------------------------------------ bad disks


def serves_and_stops(gateway: Program, port: int) -> None:
    """It does its work, and ends as it should."""
    until(lambda: is_listening(port), lambda: gateway.said)
    with client_tcp(port) as scada:
        assert not scada.read_holding_registers(0, count=1, **unit_kwargs(1)).isError()
    gateway.reload()
    gateway.wait_for("rtugate.toml: reloaded")
    assert gateway.stop() == 0
    assert "Traceback" not in gateway.said


def test_a_state_directory_that_cannot_be_is_complained_of_and_lived_without(tmp_path: Path) -> None:
    port, runtime = free_port(), tmp_path / "runtime"
    runtime.mkdir()
    (tmp_path / "state").write_text("a file")
    with program(tmp_path, GOOD + slave("scada", port)) as gateway:
        gateway.control = runtime / "control"
        gateway.started(environment={"RUNTIME_DIRECTORY": str(runtime)})
        assert gateway.ask("reload") == "reloaded"
        serves_and_stops(gateway, port)
    _make_state(tmp_path / "state" / "inside")  # no error either


def test_without_a_place_for_its_control_socket_it_does_its_work(tmp_path: Path) -> None:
    port = free_port()
    (tmp_path / "state").write_text("a file")
    with program(tmp_path, GOOD + slave("scada", port)) as gateway:
        gateway.start()
        gateway.wait_for("control socket")
        assert "ERROR control socket: " in gateway.said
        serves_and_stops(gateway, port)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
@pytest.mark.parametrize("mode", [0o755, 0o700, 0o000])
def test_a_state_directory_of_somebody_else_is_no_reason_not_to_run(mode: int) -> None:
    port = free_port()
    with tempfile.TemporaryDirectory() as name, program(Path(name), GOOD + slave("scada", port)) as gateway:
        Path(name).chmod(0o755)
        gateway.path.chmod(0o644)
        gateway.state.mkdir()
        gateway.state.chmod(mode)
        gateway.start(("-c", AS_NOBODY))
        serves_and_stops(gateway, port)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a file system")
def test_a_state_directory_on_a_read_only_disk_is_no_reason_not_to_run(tmp_path: Path) -> None:
    port, state, runtime = free_port(), tmp_path / "state", tmp_path / "runtime"
    state.mkdir()
    runtime.mkdir()
    write_last_good(state, config_of(GOOD))
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "ro", "none", state], capture_output=True, check=False).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        with program(tmp_path, GOOD + slave("scada", port)) as gateway:
            gateway.control = runtime / "control"
            gateway.started(environment={"RUNTIME_DIRECTORY": str(runtime)})
            serves_and_stops(gateway, port)
    finally:
        subprocess.run(["umount", state], check=True)
    assert [path.name for path in state.iterdir()] == [LAST_GOOD]


def test_what_is_saved_last_is_what_runs_after_a_stop(good: Program) -> None:
    good.path.write_text(text_counting(7))
    assert good.ask("reload") == "reloaded"
    assert good.stop() == 0
    good.started()
    with good.menu() as person:
        person.read_until(PROMPT)
        person.send(b"r")
        person.read_until("7")
    assert good.stop() == 0
    assert good.said.count("last restart: clean stop") == 1
