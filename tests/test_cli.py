"""The `rtugate` command as a person types it: real processes, exit codes, what goes where."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway import __version__
from gateway.cli import main
from gateway.modbus.pdu import Table
from gateway.simulator import Device, Simulator
from tests.peers import client_tcp, free_port, unit_kwargs

GOOD = """\
[[master]]
name = "field"
line = "/dev/ttyS2"

[[master.request]]
name = "boiler"
unit = 17
function = 3
address = 107
count = 100
every = 1
point = 0

[[slave]]
name = "scada"
line = "tcp://127.0.0.1:{port}"
unit = 1
"""


HERE = Path(__file__).parent.parent


def rtugate(
    *arguments: str, timeout_s: float = 30.0, cwd: Path = HERE, **environment: str
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gateway", *arguments]
    known = os.environ | {"PYTHONPATH": str(HERE)} | environment
    return subprocess.run(
        command, capture_output=True, text=True, timeout=timeout_s, check=False, cwd=cwd, env=known, errors="replace"
    )


def shell(arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `rtugate` with a shell's redirections."""
    command, known = f"{sys.executable} -m gateway {arguments}", os.environ | environment
    return subprocess.run(command, shell=True, capture_output=True, text=True, timeout=30, check=False, env=known)  # noqa: S602 - redirections are what is tested


@contextmanager
def running(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run `rtugate`, with a state directory of its own, until the block ends."""
    command = [sys.executable, "-m", "gateway", *arguments]
    with tempfile.TemporaryDirectory() as state:
        environment = {**os.environ, "STATE_DIRECTORY": state, "RUNTIME_DIRECTORY": state}
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        )
        try:
            yield process
        finally:
            if process.poll() is None:
                process.kill()
            process.communicate()


def wait_for_line(process: subprocess.Popen[str], words: str) -> str:
    assert process.stdout is not None
    said = ""
    for line in process.stdout:
        said += line
        if words in line:
            return said
    pytest.fail(f"it ended without saying {words!r}: {said}")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "rtugate.toml"
    path.write_text(GOOD.format(port=free_port()))
    return path


# ------------------------------------------------------------------------------------------------ check


def test_check_prints_the_load_of_each_line(file: Path) -> None:
    checked = rtugate("check", str(file))
    assert checked.returncode == 0
    assert checked.stderr == ""
    assert checked.stdout == f"{file}: valid\nfield: 13 % of 19200 baud, slowest cycle 1.0 s\n"


def test_check_takes_the_file_of_c_as_well(file: Path) -> None:
    assert rtugate("check", "-c", str(file)).stdout == rtugate("check", str(file)).stdout


def test_check_names_every_error_with_file_line_and_key(file: Path) -> None:
    file.write_text(GOOD.format(port=99999).replace("count = 100", "count = 126").replace("unit = 17", "unit = 248"))
    checked = rtugate("check", str(file))
    assert checked.returncode == 1
    assert checked.stdout == ""
    lines = checked.stderr.splitlines()
    assert 'rtugate.toml:10: master "field", request "boiler": count 126 is more than 125' in lines
    assert any(line.startswith("rtugate.toml:7: ") and "unit 248" in line and "247" in line for line in lines)
    assert any(line.startswith("rtugate.toml:16: ") and "99999" in line for line in lines)
    assert len(lines) == 3


def test_check_of_a_missing_file_is_wrong_usage(tmp_path: Path) -> None:
    checked = rtugate("check", str(tmp_path / "no.toml"))
    assert checked.returncode == 2
    assert checked.stderr == f"rtugate: {tmp_path / 'no.toml'}: no such file\n"


def test_check_warns_of_a_line_that_cannot_keep_up(file: Path) -> None:
    file.write_text(file.read_text().replace("every = 1\n", "every = 0.05\n"))
    checked = rtugate("check", str(file))
    assert checked.returncode == 0
    assert "warning" in checked.stdout
    assert "% of the line" in checked.stdout


def test_a_file_that_may_not_be_looked_at_is_no_usage_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(self: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "stat", refused)  # as root, nothing would refuse
    assert main(["check", "/secret/a.toml"]) == 1
    assert capsys.readouterr().err == "a.toml: cannot be read: Permission denied\n"


def test_check_never_shows_a_traceback_whatever_the_file_is_called(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    said = {name: rtugate("check", name, cwd=tmp_path) for name in ("x" * 300, "fifo", "/dev/zero", ".", "")}
    assert [ended.returncode for ended in said.values()] == [1] * 5
    assert [ended.stderr for ended in said.values()] == [
        f"{'x' * 255}...: cannot be read: File name too long\n",
        "fifo: is not a regular file\n",
        "zero: is not a regular file\n",
        ".: cannot be read: Is a directory\n",
        ".: cannot be read: Is a directory\n",
    ]
    assert main(["check", "a\0b"]) == 2


def test_file_names_are_shown_without_control_characters(tmp_path: Path) -> None:
    name = b"a\x1b[31m\n\xff"
    for content, code in (("", 0), ("x = 1", 1)):
        Path(os.fsdecode(bytes(tmp_path) + b"/" + name)).write_text(content)
        ended = rtugate("check", os.fsdecode(name), cwd=tmp_path)
        assert ended.returncode == code
        assert (ended.stdout + ended.stderr).startswith("a\\x1b[31m\\n\\udcff:")
    assert rtugate("check", "no\x1b", cwd=tmp_path).stderr == "rtugate: no\\x1b: no such file\n"


def test_a_letter_that_the_terminal_does_not_know_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "é.toml").touch()
    ended = rtugate("check", "é.toml", cwd=tmp_path, PYTHONIOENCODING="ascii")
    assert (ended.returncode, ended.stdout) == (0, "\\xe9.toml: valid\n")


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_full_disk_behind_the_output_is_one_line(file: Path, unbuffered: str) -> None:
    ended = shell(f"check {file} >/dev/full", PYTHONUNBUFFERED=unbuffered)
    assert ended.returncode == 1
    assert ended.stderr == "rtugate: the output cannot be written: No space left on device\n"


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ("check {} 2>/dev/full", 0),
        ("check {} >/dev/full 2>/dev/full", 1),
        ("check {}.no 2>/dev/full", 2),
        ("run -c {}.no 2>/dev/full", 2),
        ("check {} >&-", 0),
        ("check {}.no >&- 2>&-", 2),
    ],
)
def test_where_nothing_can_be_written_the_exit_code_says_it(file: Path, arguments: str, code: int) -> None:
    ended = shell(arguments.format(file))
    assert (ended.returncode, ended.stderr) == (code, "")


def test_output_into_a_closed_pipe_is_no_traceback(file: Path) -> None:
    ended = shell(f"check {file} | true")
    assert "Traceback" not in ended.stderr


# ------------------------------------------------------------------------------------------------ init, show, schema


def test_init_writes_a_file_that_check_finds_valid_and_the_schema_that_it_names(tmp_path: Path) -> None:
    ended = rtugate("-c", "new.toml", "init", cwd=tmp_path)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.splitlines()[:1] == ["new.toml: written"]
    assert rtugate("check", "new.toml", cwd=tmp_path).stdout.splitlines()[0] == "new.toml: valid"
    named = (tmp_path / "new.toml").read_text().splitlines()[0].removeprefix("#:schema ")
    assert json.loads((tmp_path / named).read_text())["properties"]["master"]["type"] == "array"
    assert {path.name: oct(path.stat().st_mode & 0o777) for path in tmp_path.iterdir()} == {
        "new.toml": "0o640",  # it will hold secrets
        "rtugate.schema.json": "0o644",
    }


def test_init_takes_a_file_of_its_own_as_well(tmp_path: Path) -> None:
    assert rtugate("-c", "no.toml", "init", "b.toml", cwd=tmp_path).returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.toml", "rtugate.schema.json"]


def test_init_leaves_a_file_that_exists_alone_and_says_what_to_do(file: Path) -> None:
    old = file.read_text()
    ended = rtugate("init", str(file))
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr == (
        f"rtugate: {file}: this file exists: --force keeps it under another name and writes a new one\n"
    )
    assert file.read_text() == old
    assert list(file.parent.iterdir()) == [file]


def test_init_by_force_keeps_the_old_file_beside(file: Path) -> None:
    old = file.read_text()
    ended = rtugate("init", "--force", str(file))
    assert ended.returncode == 0
    (kept,) = file.parent.glob("rtugate.toml.replaced-*")
    assert ended.stdout.splitlines()[0] == f"{file}: written; what was there is now {kept.name}"
    assert kept.read_text() == old
    assert file.read_text().startswith("#:schema ")


def test_init_by_force_keeps_nothing_that_it_writes_again(file: Path) -> None:
    file.unlink()
    for _ in range(2):
        assert rtugate("init", "--force", str(file)).stdout.splitlines()[0] == f"{file}: written"
    assert sorted(path.name for path in file.parent.iterdir()) == ["rtugate.schema.json", "rtugate.toml"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("no/new.toml", "rtugate: no/new.toml: its folder does not exist"),
        ("rtugate.toml/new.toml", "rtugate: rtugate.toml/new.toml: its folder is no folder"),
        ("fifo", "fifo: is not a regular file"),
        (".", "rtugate: .: Is a directory"),
        ("", "rtugate: .: Is a directory"),
        ("rtugate.schema.json", "rtugate: rtugate.schema.json: the schema is called so: take another name"),
    ],
)
def test_init_where_no_file_can_be_is_one_line(file: Path, name: str, said: str) -> None:
    os.mkfifo(file.parent / "fifo")
    ended = rtugate("init", "--force", name, cwd=file.parent)
    assert (ended.returncode, ended.stdout, ended.stderr) == (1, "", f"{said}\n")
    assert sorted(path.name for path in file.parent.iterdir()) == ["fifo", "rtugate.toml"]


def test_show_prints_what_is_in_effect_and_check_finds_it_valid(file: Path) -> None:
    ended = rtugate("show", str(file))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert 'name = "boiler"\nenabled = true\nunit = 17\nfunction = "read-holding-registers"\n' in ended.stdout
    assert rtugate("show", "-c", str(file)).stdout == ended.stdout
    file.write_text(ended.stdout)
    assert rtugate("check", str(file)).stdout.splitlines()[0] == f"{file}: valid"


def test_show_of_what_cannot_be_used_tells_every_finding_and_shows_nothing(file: Path) -> None:
    file.write_text(file.read_text().replace("count = 100", "count = 126\nbogus = 1"))
    ended = rtugate("show", str(file))
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr.splitlines() == [
        'rtugate.toml:10: master "field", request "boiler": count 126 is more than 125',
        'rtugate.toml:11: master "field", request "boiler": unknown key "bogus"',
    ]
    assert rtugate("show", str(file) + ".no").returncode == 2


def test_show_shows_no_secret(file: Path) -> None:
    file.write_text(file.read_text() + '[hmi.wifly]\npassphrase = "correct horse"\n')
    shown = rtugate("show", str(file)).stdout
    assert 'passphrase = "***"' in shown
    assert "horse" not in shown


def test_show_is_utf_8_whatever_the_terminal_speaks(file: Path) -> None:
    file.write_text(file.read_text() + '[identity]\nvendor = "Señal"\n', encoding="utf-8")
    out = file.with_name("shown.toml")
    assert shell(f"show {file} >{out}", PYTHONIOENCODING="ascii").returncode == 0
    assert tomllib.loads(out.read_text(encoding="utf-8"))["identity"]["vendor"] == "Señal"


def test_schema_prints_what_init_writes(tmp_path: Path) -> None:
    rtugate("init", "a.toml", cwd=tmp_path)
    ended = rtugate("schema")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == (tmp_path / "rtugate.schema.json").read_text()


# ------------------------------------------------------------------------------------------------ usage


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("nonsense",),
        ("demo", "--seconds", "0"),
        ("demo", "--seconds", "x"),
        ("demo", "--port", "70000"),
        ("demo", "--silent", "nobody"),
        ("run", "extra"),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments: tuple[str, ...]) -> None:
    ended = rtugate(*arguments)
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("rollback", "0"), "argument N: '0' is not a number that `rtugate history` shows"),
        (("demo", "--seconds", "nan"), "argument --seconds: 'nan' is not a number of seconds above 0"),
        (("demo", "--port", "65535"), "argument --port: '65535' is not a port from 1 to 65534"),  # telnet is one above
    ],
)
def test_a_number_that_is_none_is_told_in_words(arguments: tuple[str, ...], told: str) -> None:
    assert rtugate(*arguments).stderr.splitlines()[-1].endswith(told)


@pytest.mark.parametrize(
    "arguments",
    [
        ("-c", "{}", "check"),
        ("check", "-c", "{}"),
        ("-c", "no.toml", "check", "-c", "{}"),
        ("-c", "no.toml", "-c", "{}", "--state", "a", "check", "--state", "b"),
        ("check", "-c", "no.toml", "-c", "{}"),
        ("-c", "no.toml", "check", "{}"),
    ],
)
def test_file_and_state_stand_before_or_behind_the_command_and_the_last_counts(
    file: Path, arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([argument.format(file) for argument in arguments]) == 0
    assert capsys.readouterr().out.startswith(f"{file}: valid\n")


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"rtugate {__version__}\n"
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    assert "demo" in capsys.readouterr().out


# ------------------------------------------------------------------------------------------------ run


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_run_polls_serves_and_stops_cleanly_on_a_signal(tmp_path: Path, number: signal.Signals) -> None:
    device, port = Device("device", 17), free_port()
    device.set(Table.HOLDING_REGISTERS, 107, [555, 0, 100])
    file = tmp_path / "rtugate.toml"
    with Simulator() as simulator:
        text = GOOD.format(port=port).replace("count = 100", "count = 3").replace("every = 1\n", "every = 0.05\n")
        line = f'"{simulator.add_serial([device])}"\nparity = "none"'
        file.write_text(text.replace('"/dev/ttyS2"', line))
        with running("run", "-c", str(file)) as process:
            wait_for_line(process, "scada: listening on")
            with client_tcp(port) as scada:
                while (reply := scada.read_holding_registers(0, count=3, **unit_kwargs(1))).isError() or not any(
                    reply.registers
                ):
                    assert process.poll() is None
            process.send_signal(number)
            assert process.wait(timeout=2.0) == 0
    assert reply.registers == [555, 0, 100]


def test_run_of_a_missing_file_is_exit_code_2(tmp_path: Path) -> None:
    ended = rtugate("run", "-c", str(tmp_path / "no.toml"))
    assert ended.returncode == 2
    assert ended.stderr == f"rtugate: {tmp_path / 'no.toml'}: no such file\n"


def test_run_never_refuses_to_start_because_of_a_bad_file(file: Path) -> None:
    file.write_text("[[master]]\nname = \n")
    with running("run", "-c", str(file)) as process:
        said = wait_for_line(process, "factory settings")
        assert "rtugate.toml:2:" in said
        process.terminate()
        assert process.wait(timeout=2.0) == 0


@pytest.mark.parametrize("name", ["fifo", ".", "x" * 300])
def test_run_goes_on_without_what_is_no_file(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "fifo")
    with running("run", "-c", str(tmp_path / name)) as process:
        wait_for_line(process, "factory settings")
        wait_for_line(process, "runs:")
        process.terminate()
        assert process.wait(timeout=2.0) == 0


def test_run_reports_a_missing_port_once_and_goes_on(file: Path) -> None:
    file.write_text(file.read_text().replace("/dev/ttyS2", "/dev/rtugate-is-not-there"))
    with running("run", "-c", str(file)) as process:
        said = wait_for_line(process, "/dev/rtugate-is-not-there")
        assert "ERROR field: /dev/rtugate-is-not-there" in said
        process.terminate()
        assert process.wait(timeout=2.0) == 0


def test_a_hang_up_loads_the_file_anew(file: Path) -> None:
    with running("run", "-c", str(file)) as process:
        wait_for_line(process, "runs:")
        process.send_signal(signal.SIGHUP)
        wait_for_line(process, "rtugate.toml: reloaded")
        process.terminate()
        assert process.wait(timeout=2.0) == 0


# ------------------------------------------------------------------------------------------------ demo


def test_the_demo_passes_when_all_devices_answer() -> None:
    ended = rtugate("demo", "--seconds", "5", "--port", str(free_port()))
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "demo: passed" in ended.stdout
    assert "arrived in the boiler" in ended.stdout
    assert "mbpoll -m tcp" in ended.stdout


def test_the_demo_fails_when_a_device_is_silent() -> None:
    with contextlib.ExitStack() as stack:  # all at once: it takes seconds
        command = ("demo", "--seconds", "5", "--silent")
        demos = {
            silent: stack.enter_context(running(*command, silent, "--port", str(free_port())))
            for silent in ("meter", "boiler", "io")
        }
        for silent, process in demos.items():
            assert process.stdout is not None
            said = process.stdout.read()
            assert process.wait() == 1
            assert "demo: FAILED" in said
            lines = [line for line in said.splitlines() if line.startswith(f"{silent} ")]
            assert "changed 0 times" in lines[-1]


def test_the_demo_says_when_its_port_is_taken() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        ended = rtugate("demo", "--seconds", "5", "--port", str(taken.getsockname()[1]))
    assert ended.returncode == 1
    assert "already in use" in ended.stderr
    assert len(ended.stderr.splitlines()) == 1


def test_the_demo_without_an_end_stops_on_a_signal() -> None:
    with running("demo", "--port", str(free_port())) as process:
        wait_for_line(process, "s  meter:")
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=4.0) == 0
