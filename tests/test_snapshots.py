"""Sealed texts: what is damaged in any way is noticed; the last good configuration comes back as it was."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.config import Config, factory
from gateway.errors import SaveError
from gateway.snapshots import LAST_GOOD, Snapshot, read_last_good, sealed, unsealed, write_last_good
from gateway.store import LARGEST_FILE_BYTES, load_text

STATION = """
[[master]]
name = "field"
line = "/dev/ttyS2"

[[master.request]]
name = "boiler"
unit = 17
function = "read-holding-registers"
address = {address}
count = 3
point = 0

[hmi.wifly]
ssid = "käsekuchen"
"""


@pytest.fixture
def snapshot(tmp_path: Path) -> Snapshot:
    return Snapshot(tmp_path, "kept.toml")


def a_config(address: str = "107") -> Config:
    return load_text(STATION.format(address=address), "test.toml").config


# ------------------------------------------------------------------------------------------------ the seal


@pytest.mark.parametrize("content", [b"", b"\n", b"\n\n", b"x = 1\n", "name = 'Zähler'".encode(), bytes(range(256))])
def test_what_was_sealed_comes_back(content: bytes) -> None:
    assert unsealed(sealed(content)) == content


def test_every_flipped_bit_is_noticed() -> None:
    whole = sealed(STATION.encode())
    for at in range(len(whole)):
        for bit in range(8):
            damaged = whole[:at] + bytes([whole[at] ^ 1 << bit]) + whole[at + 1 :]
            assert unsealed(damaged) is None, (at, bit)


def test_a_file_cut_off_anywhere_is_noticed() -> None:
    whole = sealed(STATION.encode())
    assert [length for length in range(len(whole)) if unsealed(whole[:length]) is not None] == []


def test_whatever_is_added_doubled_or_moved_is_noticed() -> None:
    whole, other = sealed(STATION.encode()), sealed(b"x = 1\n")
    added = [whole + b"\n", whole + b"\0", b"\n" + whole, whole + whole, whole + other, b" " + whole]
    for at in range(1, len(whole)):
        added += [whole[:at] + b"a" + whole[at:], whole[:at] + whole[at + 1 :], whole[at:] + whole[:at]]
    assert [content for content in added if unsealed(content) is not None] == []


def test_a_text_under_the_seal_of_another_is_noticed() -> None:
    head, _, _ = sealed(b"x = 1\n").partition(b"\n")
    assert unsealed(head + b"\nx = 2\n") is None


@pytest.mark.parametrize("content", [b"", b"\n", b"x = 1\n", b"\0" * 4096, b"# rtugate snapshot, sha256 \n"])
def test_what_was_never_sealed_is_not_trusted(content: bytes) -> None:
    assert unsealed(content) is None


# ------------------------------------------------------------------------------------------------ in a folder


def test_a_text_comes_back_letter_for_letter(snapshot: Snapshot) -> None:
    for text in ("", "x = 1\n", "name = 'Zähler'\r\n", "y" * LARGEST_FILE_BYTES):
        snapshot.write(text)
        assert snapshot.text() == text


def test_where_nothing_was_written_there_is_nothing(snapshot: Snapshot, tmp_path: Path) -> None:
    assert snapshot.text() is None
    assert Snapshot(tmp_path / "nowhere", "kept.toml").text() is None
    snapshot.remove()  # twice is no harm
    Snapshot(tmp_path / "nowhere", "kept.toml").remove()


def test_what_was_removed_is_gone(snapshot: Snapshot) -> None:
    snapshot.write("x = 1\n")
    snapshot.remove()
    assert snapshot.text() is None
    assert list(snapshot.path.parent.iterdir()) == []


def test_the_folder_is_made_and_nobody_else_may_read_what_may_hold_secrets(tmp_path: Path) -> None:
    snapshot = Snapshot(tmp_path / "state" / "rtugate", "kept.toml")
    snapshot.write("x = 1\n")
    assert snapshot.path.stat().st_mode & 0o777 == 0o640
    assert snapshot.path.parent.stat().st_mode & 0o007 == 0


def test_a_damaged_file_says_so_and_a_new_one_takes_its_place(snapshot: Snapshot) -> None:
    snapshot.path.write_bytes(sealed(b"x = 1\n")[:-1])
    with pytest.raises(SaveError, match=r"^kept\.toml is damaged: its checksum does not fit; it is not used$"):
        snapshot.text()
    snapshot.write("x = 2\n")
    assert snapshot.text() == "x = 2\n"


def test_bytes_that_are_no_text_are_damaged_even_under_a_seal(snapshot: Snapshot) -> None:
    snapshot.path.write_bytes(sealed(b"\xff\xfe"))
    with pytest.raises(SaveError, match="is damaged"):
        snapshot.text()


def test_what_stands_in_the_way_is_told_in_words(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file, not a folder")
    snapshot = Snapshot(tmp_path / "state", "kept.toml")
    with pytest.raises(SaveError, match=r"^kept\.toml: "):
        snapshot.write("x = 1\n")
    assert snapshot.text() is None
    snapshot.remove()  # nothing can be there
    folder = Snapshot(tmp_path, "folder")
    folder.path.mkdir()
    with pytest.raises(SaveError, match=r"^folder cannot be read: Is a directory$"):
        folder.text()
    with pytest.raises(SaveError, match=r"^folder cannot be removed: "):
        folder.remove()


# ------------------------------------------------------------------------------------------------ the last good one


@pytest.mark.parametrize("config", [a_config(), factory(), Config()], ids=["a station", "factory", "empty"])
def test_the_last_good_configuration_comes_back_as_it_was(tmp_path: Path, config: Config) -> None:
    write_last_good(tmp_path, config)
    assert read_last_good(tmp_path) == config


def test_an_address_that_looks_like_a_reference_number_comes_back(tmp_path: Path) -> None:
    """Such an address has to be spelled 0x9CAC; in decimals a file with it is refused."""
    config = a_config("0x9CAC")
    write_last_good(tmp_path, config)
    assert read_last_good(tmp_path) == config


def test_without_a_last_good_configuration_there_is_none(tmp_path: Path) -> None:
    assert read_last_good(tmp_path) is None


def test_the_same_configuration_is_not_written_again(tmp_path: Path) -> None:
    write_last_good(tmp_path, a_config())
    written = (tmp_path / LAST_GOOD).stat()
    write_last_good(tmp_path, a_config())
    assert (tmp_path / LAST_GOOD).stat().st_ino == written.st_ino  # a write makes a new file
    write_last_good(tmp_path, a_config("108"))
    assert (tmp_path / LAST_GOOD).stat().st_ino != written.st_ino
    assert read_last_good(tmp_path) == a_config("108")


def test_a_damaged_last_good_configuration_is_never_trusted_and_replaced_by_the_next(tmp_path: Path) -> None:
    write_last_good(tmp_path, a_config())
    path = tmp_path / LAST_GOOD
    path.write_bytes(path.read_bytes().replace(b"count = 3", b"count = 4"))
    with pytest.raises(SaveError, match="is damaged"):
        read_last_good(tmp_path)
    write_last_good(tmp_path, a_config())
    assert read_last_good(tmp_path) == a_config()
