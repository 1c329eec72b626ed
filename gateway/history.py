"""The versions of the configuration that were saved last, each as a file in the state directory.

They are numbered from 1 on, and a number is never used again while a later one is there. A version that is the same as
the newest is not kept again. Whoever saves is never stopped by this: what goes wrong is returned, for a warning.

Source: specification of rtugate, section 6. One thread at a time.
"""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gateway.errors import ConfigError, HistoryError, SaveError
from gateway.files import in_words, write_atomically
from gateway.store import read

KEPT: Final = 10
_NAME: Final = re.compile(r"([0-9]{4}|[1-9][0-9]{4,8})\.toml")


@dataclass(frozen=True, slots=True)
class Version:
    """One text that was saved.

    when: the wall time when it was saved, in seconds since 1970.
    size: in bytes.
    """

    number: int
    when: float
    size: int


class History:
    """The saved versions in one folder, which need not be there yet."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def keep(self, text: str) -> str | None:
        """Keep *text* as the newest version and forget the oldest; return what went wrong, None if nothing."""
        try:
            self._folder.mkdir(mode=0o750, parents=True, exist_ok=True)
            numbers = sorted(self._numbers())
            newest = numbers[-1] if numbers else 0
            if not newest or read(self._path(newest)) != text.encode():
                write_atomically(self._path(newest + 1), text.encode())
                numbers.append(newest + 1)
            for number in numbers[:-KEPT]:
                self._path(number).unlink(missing_ok=True)
        except OSError as error:
            return f"this version is not kept in the history: {in_words(error, self._path(1))}"
        except (SaveError, ConfigError) as error:
            return f"this version is not kept in the history: {error}"
        return None

    def versions(self) -> list[Version]:
        """Return what is kept, the newest first; raises HistoryError."""
        found = []
        try:
            for number in sorted(self._numbers(), reverse=True):
                with contextlib.suppress(FileNotFoundError):  # it has just been forgotten
                    status = self._path(number).stat()
                    found.append(Version(number, status.st_mtime, status.st_size))
        except FileNotFoundError:
            return []
        except OSError as error:
            raise HistoryError(f"the history cannot be read: {in_words(error, self._path(1))}") from error
        return found

    def text(self, number: int) -> str:
        """Return what version *number* says; raises HistoryError."""
        try:
            return read(self._path(number)).decode()
        except FileNotFoundError as error:
            raise HistoryError(f"there is no version {number}: `rtugate history` lists what there is") from error
        except UnicodeDecodeError as error:
            raise HistoryError(f"version {number} is damaged: it is not UTF-8") from error
        except ConfigError as error:
            raise HistoryError(f"version {number} is no file") from error
        except OSError as error:
            raise HistoryError(f"version {number} cannot be read: {in_words(error, self._path(number))}") from error

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:04}.toml"

    def _numbers(self) -> list[int]:
        names = (_NAME.fullmatch(path.name) for path in self._folder.iterdir())
        return [int(name[1]) for name in names if name]
