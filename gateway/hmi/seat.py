"""The seat at the menu: one person at a time has it, the others wait (spec section 5, "two ways in, one menu").

What it is: who has the menu, who waits, in which order, and since when the serial console has been silent.
What it refuses: terminals, texts, threads of its own. Time alone may change hands: whoever asks settles it.
Ranks: the serial console takes the menu with any character; `rtugate menu` takes it from telnet; both of these wait
until the serial console has been silent for ``serial_hold`` seconds. Within a rank, first come first served; whoever
loses the menu keeps his place in the queue.
Threads: any. One lock, a leaf; the others are woken after it has been let go of.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from gateway.clock import Clock

SERIAL_LEAST_S: Final = 5.0  # so long a serial person keeps what he took where serial_hold is 0: he must get to type


class Rank(IntEnum):
    """Who goes before whom."""

    TELNET = 1
    LOCAL = 2
    SERIAL = 3


@dataclass(eq=False)
class Person:
    """Somebody at a terminal; the same object from his first to his last moment there."""

    who: str  # "192.168.1.7 (telnet)"
    rank: Rank
    wake: Callable[[], None]  # makes his thread ask for his standing soon


@dataclass(frozen=True)
class Standing:
    """What the seat has to say to one person."""

    turn: int  # the number of his turn, never the same twice; 0: he does not have the menu
    holder: Person | None  # who has it
    wait_s: float | None  # until the serial console has been silent for long enough; None: it is not that he waits for
    ahead: int  # how many others go before him, the holder not counted

    @property
    def has_menu(self) -> bool:
        return self.turn > 0


class Seat:
    """Who has the menu."""

    def __init__(self, clock: Clock, serial_hold_s: Callable[[], float]) -> None:
        """*serial_hold_s*: how long the serial console has to be silent; 0 where there is none."""
        self._clock = clock
        self._serial_hold_s = serial_hold_s
        self._lock = threading.Lock()
        self._serial_s = clock.monotonic()  # its last character; at first, the start of the program
        self._present: list[Person] = []  # everybody but the serial console, in the order of coming
        self._holder: Person | None = None
        self._turn = 0

    @property
    def holder(self) -> Person | None:
        """Who has the menu now."""
        return self._holder

    def enter(self, person: Person) -> None:
        """*person* (not the serial console) wants the menu."""
        self._change(person, lambda: self._present.append(person))

    def take(self, person: Person) -> None:
        """*person*, at the serial console, has typed a character: the menu is his."""

        def take() -> None:
            self._serial_s = self._clock.monotonic()
            if self._holder is not person:
                self._give(person)

        self._change(person, take)

    def leave(self, person: Person) -> None:
        """*person* wants the menu no longer; also when he never had it."""

        def leave() -> None:
            if person in self._present:
                self._present.remove(person)
            if self._holder is person:
                self._holder = None

        self._change(person, leave)

    def standing(self, person: Person) -> Standing:
        """Return where *person* stands now, after what time has changed by itself."""
        hold_s = self._change(person, lambda: None)
        with self._lock:
            holder = self._holder
            if holder is person:
                return Standing(self._turn, holder, None, 0)
            is_serials = holder is None or holder.rank is Rank.SERIAL
            wait_s = max(0.0, self._quiet_at_s(hold_s) - self._clock.monotonic()) if is_serials else None
            queue = [waiting for waiting in self._queue() if waiting is not holder]
            return Standing(0, holder, wait_s, queue.index(person) if person in queue else 0)

    # ------------------------------------------------------------------------------------------------ inside

    def _change(self, person: Person, step: Callable[[], None]) -> float:
        """Do *step*, settle what follows, and wake the others if the menu has changed hands or the queue has moved."""
        hold_s = self._serial_hold_s()
        with self._lock:
            before = (self._holder, self._turn, list(self._present))
            step()
            self._settle(hold_s)
            is_news = before != (self._holder, self._turn, self._present)
            others = {*before[2], *self._present, before[0], self._holder} - {None, person} if is_news else set()
        for other in others:
            if other is not None:
                other.wake()
        return hold_s

    def _settle(self, hold_s: float) -> None:
        """Give the menu to the first in the queue once the serial console is silent.

        Whoever has it is the first of his rank: only a higher one can come to stand before him.
        """
        queue = self._queue()
        if queue and queue[0] is not self._holder and self._clock.monotonic() >= self._quiet_at_s(hold_s):
            self._give(queue[0])

    def _queue(self) -> list[Person]:
        return sorted(self._present, key=lambda person: -person.rank)  # sorting keeps the order of coming

    def _quiet_at_s(self, hold_s: float) -> float:
        """When the serial console will have been silent for long enough."""
        is_serials = self._holder is not None and self._holder.rank is Rank.SERIAL
        return self._serial_s + ((hold_s or SERIAL_LEAST_S) if is_serials else hold_s)

    def _give(self, person: Person) -> None:
        self._holder = person
        self._turn += 1
