"""`rtugate passwd`, `history` and `rollback`: what they write, what they tell, and the gateway that they ask."""

from __future__ import annotations

import errno
import io
import os
import signal
import socket
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway import cli
from gateway import save as save_module
from gateway.edits import Refused, ask_gateway, ask_reload, history, rollback, set_password
from gateway.errors import ConfigError, FileChanged, GatewayError, HistoryError, SaveError
from gateway.files import as_owner_of
from gateway.history import KEPT, History
from gateway.hmi.access import check_password
from tests.config_files import BAD, EDITED, GOOD, Place, config_of, text_counting
from tests.fakes import JumpingClock
from tests.lines import PATIENCE_S, Pty, pty_pair
from tests.test_files import as_a_user

NOBODY_RUNS = "no gateway runs here: the change counts from its next start"
PASSWORD = "open sesame"  # noqa: S105 - opens nothing but these tests
HERE = Path(__file__).parent.parent
SOMEBODY = 4_000_000  # a user that no machine has


@pytest.fixture
def place(tmp_path: Path, clock: JumpingClock) -> Place:
    return Place(tmp_path, clock)


@pytest.fixture
def control(tmp_path: Path) -> Path:
    return tmp_path / "control"


@contextmanager
def a_gateway(path: Path, answer: bytes) -> Iterator[list[bytes]]:
    """Something that takes one line at the control socket and gives *answer*; gives the lines that came."""
    asked: list[bytes] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                asked.append(connection.recv(4096))
                connection.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        yield asked
        thread.join()


def typing(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    """What comes through a pipe."""
    monkeypatch.setattr(sys, "stdin", io.StringIO(text))


# ------------------------------------------------------------------------------------------------ asking the gateway


def test_the_gateway_that_runs_is_asked_to_load_its_file(control: Path) -> None:
    with a_gateway(control, b"reloaded\n") as asked:
        assert ask_reload(control) == ["reloaded"]
    assert asked == [b"reload\n"]


def test_a_gateway_that_refuses_says_why_and_the_file_is_saved_all_the_same(control: Path) -> None:
    with (
        a_gateway(control, b"error: not reloaded, nothing has changed: rtugate.toml:3: no\n"),
        pytest.raises(Refused) as told,
    ):
        ask_reload(control)
    assert str(told.value) == (
        "saved, but the gateway that runs did not take it: not reloaded, nothing has changed: rtugate.toml:3: no"
    )


def test_a_gateway_that_ends_before_it_answers_is_no_success(control: Path) -> None:
    with a_gateway(control, b""), pytest.raises(Refused, match="the gateway ended before it answered"):
        ask_reload(control)


def test_where_no_gateway_runs_nobody_is_asked(control: Path) -> None:
    assert ask_gateway(control, "reload") is None
    assert ask_reload(control) == [NOBODY_RUNS]
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stale:
        stale.bind(str(control))
    assert ask_reload(control) == [NOBODY_RUNS]
    assert ask_reload(control / "control") == [NOBODY_RUNS]


def test_a_gateway_that_cannot_be_asked_is_told_of_as_such(control: Path) -> None:
    with pytest.raises(Refused, match=r"^saved, but the gateway cannot be asked to take it: .*too long"):
        ask_reload(control.parent / ("x" * 200))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
def test_who_may_not_ask_is_told_that_the_file_is_saved(control: Path) -> None:
    with a_gateway(control, b"reloaded\n"):
        with as_a_user(), pytest.raises(Refused, match=r"^saved, but .*: Permission denied$"):
            ask_reload(control)
        ask_reload(control)


# ------------------------------------------------------------------------------------------------ passwd


def test_a_password_is_written_as_a_hash_and_the_rest_stays(
    place: Place, control: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    typing(monkeypatch, f"{PASSWORD}\n")
    with a_gateway(control, b"reloaded\n"):
        assert set_password(place.path, control) == [f"{place.path}: saved", "reloaded"]
    hashed = config_of(place.text).hmi.password
    assert check_password(PASSWORD, hashed)
    assert place.text.replace(f'password = "{hashed}"\n', "").split() == [
        *GOOD.split()[:-4],
        "[hmi]",
        *GOOD.split()[-4:],
    ]
    assert PASSWORD not in place.text


@pytest.mark.parametrize(
    ("typed", "problem"),
    [
        ("", "a password has at least 8 characters"),
        ("seven77\n", "a password has at least 8 characters"),
        ("x" * 65 + "\n", "a password has at most 64 characters"),
        ("open\x1bsesame\n", "a password has only characters that can be typed and shown"),
        ("open sesame\udc80\n", "a password has only characters that can be typed and shown"),
        ("open sesame\r\n", "a password has only characters that can be typed and shown"),
    ],
)
def test_what_is_no_password_is_refused_and_the_file_stays(
    place: Place, control: Path, monkeypatch: pytest.MonkeyPatch, typed: str, problem: str
) -> None:
    typing(monkeypatch, typed)
    with pytest.raises(Refused, match=problem):
        set_password(place.path, control)
    assert place.text == GOOD


def test_bytes_that_are_no_text_are_no_password(place: Place, control: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"open sesame\xff\n"), encoding="utf-8"))
    with pytest.raises(Refused, match="no password was given"):
        set_password(place.path, control)


def test_without_an_input_there_is_no_password(place: Place, control: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)  # as where it was closed before the program began
    with pytest.raises(Refused, match="at least 8 characters"):
        set_password(place.path, control)


def test_a_bad_file_gets_no_password_and_nobody_is_asked_for_one(
    place: Place, control: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place.path.write_text(BAD)
    typing(monkeypatch, f"{PASSWORD}\n")
    with pytest.raises(ConfigError):
        set_password(place.path, control)
    assert sys.stdin.read() == f"{PASSWORD}\n"
    assert place.text == BAD


def test_a_file_that_changes_while_somebody_thinks_of_a_password_is_not_written_over(
    place: Place, control: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Thinking:
        def isatty(self) -> bool:
            return False

        def readline(self) -> str:
            place.path.write_text(EDITED)
            return f"{PASSWORD}\n"

    monkeypatch.setattr(sys, "stdin", Thinking())
    with pytest.raises(FileChanged):
        set_password(place.path, control)
    assert place.text == EDITED


def test_a_password_that_costs_the_comments_keeps_the_old_file(
    place: Place, control: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def faulty(*_: object) -> str:
        raise ZeroDivisionError("a bug")

    typing(monkeypatch, f"{PASSWORD}\n")
    monkeypatch.setattr(save_module, "edited", faulty)
    saved, told, _ = set_password(place.path, control)
    assert saved == f"{place.path}: saved"
    assert told.startswith("it is written anew, without its comments; the old file is kept as rtugate.toml.replaced-")
    assert place.path.with_name(told.rpartition(" ")[2]).read_text() == GOOD
    assert check_password(PASSWORD, config_of(place.text).hmi.password)


class Terminal:
    """`rtugate passwd` in a terminal of its own."""

    def __init__(self, pty: Pty, place: Place) -> None:
        self.pty = pty
        arguments = ["passwd", "-c", str(place.path), "--state", str(place.state)]
        terminal = os.open(pty.device, os.O_RDWR | os.O_NOCTTY)
        as_a_shell_leaves_it = termios.tcgetattr(terminal)
        as_a_shell_leaves_it[0] |= termios.ICRNL
        as_a_shell_leaves_it[3] |= termios.ICANON | termios.ECHO | termios.ISIG
        termios.tcsetattr(terminal, termios.TCSANOW, as_a_shell_leaves_it)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "gateway", *arguments],
            stdin=terminal,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=HERE,
            start_new_session=True,  # without the terminal in which the tests may run
        )
        os.close(terminal)

    def answer(self, prompt: str, typed: str) -> None:
        """Wait for *prompt*, then type."""
        assert self.process.stderr is not None
        assert self.process.stderr.read(len(prompt)) == prompt.encode()
        self.pty.send(typed.encode())

    def end(self) -> tuple[int, str, str]:
        """Return exit code, output and complaints."""
        output, complaints = self.process.communicate(timeout=2 * PATIENCE_S)
        return self.process.returncode, output.decode(), complaints.decode()


@contextmanager
def terminal(place: Place) -> Iterator[Terminal]:
    with pty_pair() as pty:
        before = signal.signal(
            signal.SIGINT, signal.default_int_handler
        )  # tests in the background ignore it: inherited
        made = Terminal(pty, place)
        try:
            yield made
        finally:
            signal.signal(signal.SIGINT, before)
            made.process.kill()
            made.process.communicate()


def test_in_a_terminal_the_password_is_asked_twice_and_never_shown(place: Place) -> None:
    with terminal(place) as here:
        here.answer("New password: ", f"{PASSWORD}\n")
        here.answer("\nThe same again: ", f"{PASSWORD}\n")
        code, output, complaints = here.end()
        assert here.pty.is_silent()
    assert (code, output) == (0, f"{place.path}: saved\n{NOBODY_RUNS}\n")
    assert PASSWORD not in complaints
    assert check_password(PASSWORD, config_of(place.text).hmi.password)


def test_in_a_terminal_two_that_differ_change_nothing(place: Place) -> None:
    with terminal(place) as here:
        here.answer("New password: ", f"{PASSWORD}\n")
        here.answer("\nThe same again: ", "open barley\n")
        code, _, complaints = here.end()
    assert (code, complaints.strip()) == (1, "these two differ: the password stays as it was")
    assert place.text == GOOD


@pytest.mark.parametrize("how", ["Ctrl-D", "SIGINT"])
def test_who_gives_up_at_the_prompt_changes_nothing_and_sees_one_line(place: Place, how: str) -> None:
    with terminal(place) as here:
        here.answer("New password: ", "\x04" if how == "Ctrl-D" else "")
        if how == "SIGINT":
            here.process.send_signal(signal.SIGINT)
        code, _, complaints = here.end()
    assert (code, complaints.strip()) == (1, "no password was given: it stays as it was")
    assert place.text == GOOD


# ------------------------------------------------------------------------------------------------ history


@pytest.fixture
def in_india(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Five and a half hours before Greenwich."""
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "IST-5:30")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.usefixtures("in_india")
def test_the_history_is_listed_newest_first_with_number_local_time_and_size(place: Place) -> None:
    kept = History(place.state / "history")
    for number, (text, when_s) in enumerate([(GOOD, 1_700_000_000), ("# nothing\n", 1_700_086_400)], 1):
        kept.keep(text)
        os.utime(place.state / "history" / f"000{number}.toml", (when_s, when_s))
    assert history(place.state) == [
        "   2  2023-11-16 03:43:20  10 bytes",
        f"   1  2023-11-15 03:43:20  {len(GOOD)} bytes",
    ]


def test_an_empty_history_says_so(tmp_path: Path) -> None:
    assert history(tmp_path / "nowhere") == ["nothing has been saved yet"]


def test_a_history_that_cannot_be_read_says_why(tmp_path: Path) -> None:
    (tmp_path / "history").write_text("a file")
    with pytest.raises(HistoryError, match="the history cannot be read"):
        history(tmp_path)


# ------------------------------------------------------------------------------------------------ rollback


def versions(place: Place, *counts: int) -> History:
    """Keep versions with these counts of registers."""
    kept = History(place.state / "history")
    for count in counts:
        assert kept.keep(text_counting(count)) is None
    return kept


def test_a_rollback_writes_the_version_and_keeps_what_was_there(place: Place, control: Path) -> None:
    versions(place, 4, 5)
    with a_gateway(control, b"reloaded\n"):
        assert rollback(place.path, place.state, control, 1) == [f"{place.path}: is version 1 again", "reloaded"]
    assert place.text == text_counting(4)
    assert place.history() == [text_counting(4), text_counting(5), GOOD, text_counting(4)]
    assert rollback(place.path, place.state, control, 3) == [f"{place.path}: is version 3 again", NOBODY_RUNS]
    assert place.text == GOOD


def test_a_rollback_to_what_is_there_changes_nothing(place: Place, control: Path) -> None:
    versions(place, 4, 3)
    assert rollback(place.path, place.state, control, 2) == [f"{place.path}: is version 2 already"]
    assert place.history() == [text_counting(4), GOOD]


def test_the_oldest_version_can_be_had_although_it_is_forgotten_by_that(place: Place, control: Path) -> None:
    versions(place, *range(11, 11 + KEPT))
    rollback(place.path, place.state, control, 1)
    assert place.text == text_counting(11)
    assert place.history() == [*(text_counting(count) for count in range(13, 11 + KEPT)), GOOD, text_counting(11)]


@pytest.mark.parametrize("laid", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
def test_a_version_that_is_no_file_is_not_waited_for(
    place: Place, control: Path, laid: Callable[[Path], object]
) -> None:
    versions(place, 4)
    (place.state / "history/0001.toml").unlink()
    laid(place.state / "history/0001.toml")
    with pytest.raises(HistoryError, match="version 1 is no file"):
        rollback(place.path, place.state, control, 1)


def test_a_version_that_is_not_there_or_damaged_is_refused_and_the_file_stays(place: Place, control: Path) -> None:
    versions(place, 4, 126)
    for number, error in ((3, HistoryError), (2, ConfigError)):
        with pytest.raises(error, match=r"version \d"):
            rollback(place.path, place.state, control, number)
    assert place.text == GOOD
    assert place.history() == [text_counting(4), text_counting(126)]


@pytest.mark.parametrize("content", [BAD.encode(), b"\xff\xfe", b"", b"[" * 10])
def test_a_file_that_cannot_be_used_is_kept_beside_by_a_rollback(place: Place, control: Path, content: bytes) -> None:
    versions(place, 4)
    place.path.write_bytes(content)
    told = rollback(place.path, place.state, control, 1)
    assert place.text == text_counting(4)
    if not content:  # which is a configuration like any other
        assert place.history() == [text_counting(4), "", text_counting(4)]
        return
    assert told[1].startswith("what was there cannot be used and is kept as rtugate.toml.rejected-")
    assert place.path.with_name(told[1].rpartition(" ")[2]).read_bytes() == content
    assert place.history() == [text_counting(4)]


def test_a_rollback_brings_a_file_back_that_is_gone(place: Place, control: Path) -> None:
    versions(place, 4)
    place.path.unlink()
    rollback(place.path, place.state, control, 1)
    assert place.text == text_counting(4)
    assert place.history() == [text_counting(4)]


def test_a_rollback_where_no_file_can_be_says_why(place: Place, control: Path) -> None:
    versions(place, 4)
    place.path.unlink()
    place.path.mkdir()
    with pytest.raises(GatewayError, match="Is a directory"):
        rollback(place.path, place.state, control, 1)
    place.path.rmdir()
    os.mkfifo(place.path)
    with pytest.raises(ConfigError, match="is not a regular file"):
        rollback(place.path, place.state, control, 1)
    with pytest.raises(SaveError, match="its folder does not exist"):
        rollback(place.path.parent / "no" / "file.toml", place.state, control, 1)


def test_a_file_that_changes_in_the_middle_of_a_rollback_is_not_written_over(
    place: Place, control: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions(place, 4)
    flush = os.fsync

    def edited_meanwhile(descriptor: int) -> None:
        place.path.write_text(EDITED)
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", edited_meanwhile)
    with pytest.raises(FileChanged):
        rollback(place.path, place.state, control, 1)
    assert place.text == EDITED


def test_a_history_that_cannot_take_the_old_version_does_not_stop_a_rollback(
    place: Place, control: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions(place, 4)
    (place.state / "history" / "0002.toml").mkdir()  # where the next version should go
    told = rollback(place.path, place.state, control, 1)
    assert place.text == text_counting(4)
    assert any("not kept in the history" in line for line in told)


# ------------------------------------------------------------------------------------------------ root, elsewhere


@pytest.mark.skipif(os.geteuid() != 0, reason="only root works in another user's folder")
@pytest.mark.parametrize("command", [["rollback", "1"], ["init", "--force"], ["passwd"]])
def test_root_follows_no_link_that_the_folders_owner_has_laid(command: list[str]) -> None:
    with tempfile.TemporaryDirectory(prefix="rtugate-") as scratch:  # pytest's own folders let nobody else pass
        top = Path(scratch)
        top.chmod(0o755)
        secret = top / "secret.toml"
        secret.write_text("[log]\n")
        secret.chmod(0o600)
        for folder in ("etc", "state/history"):
            (top / folder).mkdir(parents=True)
        (top / "state/history/0001.toml").write_text(GOOD)
        (top / "etc/rtugate.toml").symlink_to(secret)
        for path in (top / "etc", top / "state", top / "state/history"):
            os.chown(path, SOMEBODY, SOMEBODY)
        told = _as_root(top, command)
        assert (told.returncode, told.stdout) == (1, "")
        assert "permission denied" in told.stderr.lower()
        assert secret.read_text() == "[log]\n"
        assert [path.name for path in (top / "etc").iterdir()] == ["rtugate.toml"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root works in another user's folder")
def test_a_root_without_its_rights_is_told_so_and_has_them_as_before() -> None:
    with tempfile.TemporaryDirectory(prefix="rtugate-") as scratch:
        os.chown(scratch, 2**32 - 2, SOMEBODY)
        before = (os.getgroups(), os.getegid(), os.geteuid())

        def refuse(_: int) -> None:
            raise PermissionError(errno.EPERM, "Operation not permitted")

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "seteuid", refuse)
            with pytest.raises(SaveError, match="is another user's"), as_owner_of(Path(scratch)):
                raise AssertionError
        assert (os.getgroups(), os.getegid(), os.geteuid()) == before


@pytest.mark.skipif(os.geteuid() != 0, reason="only root works in another user's folder")
def test_what_root_does_in_anothers_folder_belongs_to_that_user() -> None:
    with tempfile.TemporaryDirectory(prefix="rtugate-") as scratch:
        top = Path(scratch)
        top.chmod(0o755)
        (top / "etc").mkdir()
        os.chown(top / "etc", SOMEBODY, SOMEBODY)
        assert _as_root(top, ["init"]).returncode == 0
        assert _as_root(top, ["passwd"]).returncode == 0
        assert {path.stat().st_uid for path in (top / "etc").iterdir()} == {SOMEBODY}


def _as_root(top: Path, command: list[str]) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "gateway", "-c", str(top / "etc/rtugate.toml"), "--state", str(top / "state")]
    environment = os.environ | {"PYTHONPATH": str(HERE), "RUNTIME_DIRECTORY": ""}
    return subprocess.run(
        [*words, *command],
        input=f"{PASSWORD}\n",
        capture_output=True,
        text=True,
        env=environment,
        timeout=PATIENCE_S,
        check=False,
    )


def test_what_the_gateway_says_moves_no_cursor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with a_gateway(tmp_path / "control", b"hello\x1b]0;evil\x07\nworld\n"):
        assert cli.main(["--state", str(tmp_path), "status"]) == 0
    assert capsys.readouterr().out == "hello\\x1b]0;evil\\x07\nworld\n"
