"""Fakes that tests hand in: a clock that jumps, and a link on which a scripted device answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field


class JumpingClock:
    """A clock that stands still until it is told otherwise."""

    def __init__(self, monotonic_s: float = 1000.0, wall_s: float = 1_700_000_000.0) -> None:
        self._monotonic_s = monotonic_s
        self._wall_s = wall_s

    def monotonic(self) -> float:
        return self._monotonic_s

    def wall(self) -> float:
        return self._wall_s

    def pass_s(self, seconds: float) -> None:
        self._monotonic_s += seconds
        self._wall_s += seconds

    def jump_wall(self, seconds: float) -> None:
        self._wall_s += seconds


@dataclass
class ScriptedLink:
    """A link whose other end is a function: it is given each frame written, and says what comes back, and when.

    device: frame -> list of (seconds after the frame, bytes). Reading advances the clock, to the next arrival or by
    the whole timeout: no test ever waits.
    """

    clock: JumpingClock
    device: Callable[[bytes], list[tuple[float, bytes]]]
    character_s: float = 0.0
    written: list[tuple[float, bytes]] = field(default_factory=list)
    arriving: list[tuple[float, bytes]] = field(default_factory=list)
    closed: bool = False

    def write(self, data: bytes) -> None:
        now_s = self.clock.monotonic()
        self.written.append((now_s, data))
        self.arriving += [(now_s + after_s, answer) for after_s, answer in self.device(data)]
        self.arriving.sort(key=lambda arrival: arrival[0])

    def read(self, timeout_s: float) -> bytes:
        now_s = self.clock.monotonic()
        if self.arriving and self.arriving[0][0] <= now_s + timeout_s:
            when_s, data = self.arriving.pop(0)
            self.clock.pass_s(max(0.0, when_s - now_s))
            return data
        self.clock.pass_s(timeout_s)
        return b""

    def discard(self) -> int:
        count = sum(len(data) for _, data in self.arriving)
        self.arriving.clear()
        return count

    def close(self) -> None:
        self.closed = True
