"""`rtugate passwd` on a file that is refused for nothing but the password that it lacks: the way out that it names."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest

from gateway.edits import set_password
from gateway.errors import ConfigError
from gateway.hmi.access import check_password
from gateway.save import loaded_with
from gateway.store import load, load_text

PASSWORD = "open sesame"  # noqa: S105 - opens nothing but these tests
BEYOND = '# for the WiFi\n[hmi.telnet]\nlisten = "0.0.0.0:2323"  # all of it\n'


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(sys, "stdin", io.StringIO(f"{PASSWORD}\n"))
    return tmp_path / "rtugate.toml"


@pytest.mark.parametrize(
    "text",
    [
        BEYOND,
        '[hmi.wifly]\nline = "/dev/ttyS0"\n',
        '[hmi.serial]\nline = "/dev/ttyS3"\npassword_required = true\n',
        f'[hmi]\nlanguage = "es"\n{BEYOND}',
        f"hmi.language = 'es'\n{BEYOND.replace('[hmi.telnet]', '').replace('listen', 'hmi.telnet.listen')}",
    ],
)
def test_the_password_that_a_file_lacks_can_be_set(path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match="rtugate passwd"):
        load_text(text, "rtugate.toml")
    path.write_text(text)
    assert set_password(path, path.with_name("control"))[0] == f"{path}: saved"
    assert check_password(PASSWORD, load(path).config.hmi.password)
    assert [line for line in text.splitlines() if line not in path.read_text().splitlines()] == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{BEYOND}[[slave]]\nunit = 300\n", "unit 300"),
        (f"{BEYOND}[[slave]\n", "not TOML"),
        ("hmi = 3\n", "hmi must be a table"),
        ('[hmi]\ntelnet = "x"\npassword = "x"\n', "telnet must be a table"),
        ("x = " + 5000 * "9", "thousands of digits"),
    ],
)
def test_whatever_else_is_wrong_is_told_before_anybody_types(path: Path, text: str, said: str) -> None:
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        set_password(path, path.with_name("control"))
    assert path.read_text() == text
    assert sys.stdin.read() == f"{PASSWORD}\n"


def test_a_key_is_put_in_place_with_all_comments_kept() -> None:
    loaded = loaded_with(BEYOND, ("hmi", "password"), "scrypt$", "rtugate.toml")
    assert loaded.config.hmi.password.startswith("scrypt")
    assert "# for the WiFi\n" in loaded.text
    assert "# all of it" in loaded.text
