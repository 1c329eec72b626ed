"""Sealed texts in the state directory: the last good configuration, and a save that waits for its confirmation.

Each is a TOML text behind one line with its checksum: whatever was flipped, cut off or added is noticed, and what is
damaged is never trusted. They are written for good (``files``), one at a time.

Source: specification of rtugate, section 6. Any thread; nothing is shared.
"""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path
from typing import Final

from gateway import files
from gateway.config import Config
from gateway.errors import SaveError
from gateway.save import text_for
from gateway.store import load_text

HEADER: Final = b"# rtugate snapshot, sha256 "
LAST_GOOD: Final = "last-good.toml"
UNCONFIRMED: Final = "unconfirmed.toml"  # what the file said before a save that is not confirmed yet


def sealed(content: bytes) -> bytes:
    """Return *content* behind the line that proves it whole."""
    return HEADER + hashlib.sha256(content).hexdigest().encode() + b"\n" + content


def unsealed(content: bytes) -> bytes | None:
    """Return what was sealed, or None if it is not whole."""
    rest = content.partition(b"\n")[2]
    return rest if content == sealed(rest) else None


class Snapshot:
    """One sealed text in the state directory, which need not be there yet."""

    def __init__(self, folder: Path, name: str) -> None:
        self.path = folder / name

    def write(self, text: str) -> None:
        """Replace what there is by *text*; raises SaveError."""
        try:
            self.path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
        except OSError as error:
            raise SaveError(f"{self.path.name}: {files.in_words(error, self.path)}") from error
        files.write_atomically(self.path, sealed(text.encode()))

    def text(self) -> str | None:
        """Return what was written last; None where there is nothing. Raises SaveError if it is damaged."""
        try:
            content = self.path.read_bytes()  # with its seal it may be larger than a configuration file may be
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise SaveError(f"{self.path.name} cannot be read: {files.in_words(error, self.path)}") from error
        with contextlib.suppress(UnicodeDecodeError):  # nothing that was ever written here
            if (whole := unsealed(content)) is not None:
                return whole.decode()
        raise SaveError(f"{self.path.name} is damaged: its checksum does not fit; it is not used")

    def remove(self) -> None:
        """There is nothing to keep any more; raises SaveError."""
        files.remove_durably(self.path)


def write_last_good(folder: Path, config: Config) -> None:
    """Keep *config*, which has proved good, unless it is kept already: flash wears out. Raises SaveError."""
    snapshot, text = Snapshot(folder, LAST_GOOD), text_for("", config, LAST_GOOD).text
    try:
        is_kept = snapshot.text() == text
    except SaveError:  # damaged: a good one takes its place
        is_kept = False
    if not is_kept:
        snapshot.write(text)


def read_last_good(folder: Path) -> Config | None:
    """Return the configuration that proved good last; None where there is none. Raises SaveError, ConfigError."""
    text = Snapshot(folder, LAST_GOOD).text()
    return None if text is None else load_text(text, LAST_GOOD).config
