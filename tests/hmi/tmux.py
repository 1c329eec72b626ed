"""Programs in a terminal of 80 x 24, and what stands on its screen: tmux, whose server is the test's own."""

from __future__ import annotations

import difflib
import os
import subprocess
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.hmi.real_station import eventually

UPDATES = "UPDATE_SCREENS" in os.environ  # write the screens anew, and fail, so that somebody looks at them
SETTLED_LOOKS = 80  # that are the same: then a screen that is to be kept stands still
DIFFERENT_S = 10.0  # a screen that does not come to look as it should by then is another one
SETTINGS = ["set", "-g", "remain-on-exit", "on", ";", "set", "-g", "status", "off", ";"]


class Terminal:
    """One terminal in which one program runs; keys by tmux's names (Enter, Escape), texts as they are."""

    def __init__(self, tmux: Callable[..., str], name: str) -> None:
        self._tmux, self._name = tmux, name

    def type(self, *keys: str) -> None:
        self._tmux("send-keys", "-t", self._name, *keys)

    def resize(self, columns: int, rows: int) -> None:
        self._tmux("resize-window", "-t", self._name, "-x", str(columns), "-y", str(rows))

    def screen(self) -> str:
        """What stands on the screen now, without the blank lines after the last one."""
        lines = self._tmux("capture-pane", "-p", "-t", self._name).split("\n")
        return "\n".join(line.rstrip() for line in lines).rstrip("\n")

    def sees(self, words: str) -> str:
        """Wait until *words* are on the screen; return it."""
        return eventually(self.screen, lambda screen: words in screen)

    def ends_with(self, words: str) -> str:
        """Wait until the last line on the screen ends with *words*, at which the cursor waits; return the screen."""
        return eventually(self.screen, lambda screen: screen.endswith(words.rstrip()))


@contextmanager
def tmux(folder: Path) -> Iterator[Callable[..., Terminal]]:
    """Give what opens a terminal: ``terminal("telnet", "127.0.0.1", "2323")``."""
    names = iter("abcdefgh")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("TMUX", "LC_"))}
    environment |= {"LANG": "C.UTF-8", "TERM": "screen", "SHELL": "/bin/sh"}

    def run(*arguments: str) -> str:
        command = ["tmux", "-u", "-S", str(folder / "tmux"), "-f", "/dev/null", *arguments]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=20).stdout

    def opened(*command: str, columns: int = 80, rows: int = 24) -> Terminal:
        name = next(names)
        size = ["-x", str(columns), "-y", str(rows)]
        run("start-server", ";", *SETTINGS, "new-session", "-d", *size, "-s", name, *command)
        return Terminal(run, name)

    try:
        yield opened
    finally:
        subprocess.run(["tmux", "-S", str(folder / "tmux"), "kill-server"], capture_output=True, check=False)


def matches(kept: Path, look: Callable[[], str]) -> None:
    """Look until what is seen is what the file *kept* says; the error shows how they differ."""
    if UPDATES:
        kept.write_text(_settled(look) + "\n")
        return
    wanted = kept.read_text().rstrip("\n") if kept.exists() else ""
    try:
        eventually(look, lambda seen: seen == wanted, limit_s=DIFFERENT_S)
    except AssertionError:
        seen = look()
        difference = difflib.unified_diff(wanted.split("\n"), seen.split("\n"), kept.name, "seen", lineterm="")
        raise AssertionError("\n".join(difference) or f"{kept.name} was seen only after {DIFFERENT_S:g} s") from None


def _settled(look: Callable[[], str]) -> str:
    """Return what is seen once it has stayed the same for a while."""
    seen: deque[str] = deque(maxlen=SETTLED_LOOKS)

    def again() -> str:
        seen.append(look())
        return seen[-1]

    return eventually(again, lambda _last: len(seen) == SETTLED_LOOKS and len(set(seen)) == 1)
