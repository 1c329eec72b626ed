"""One terminal's life: the password, the wait for the seat, the menu, and again (spec section 5).

What it is: typed bytes in, bytes to show out, due times; the same for the serial console, telnet and `rtugate menu`.
``receive`` what was typed, call ``turn`` when something came, was sent, was woken for or is due; then send ``output``.
What it refuses: I/O, telnet's commands, the serial line's marks, anything that the menu is about.
Who reads slowly waits for himself alone: while much is unsent no key is taken, while anything is no live display runs.
Threads: the one that carries the bytes; *wake* (the seat, a menu's job, a password check) may be called from any.
"""

from __future__ import annotations

import logging
import math
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from gateway.clock import Clock
from gateway.config import HmiConfig
from gateway.hmi.access import Lockout
from gateway.hmi.background import Background
from gateway.hmi.keys import KeyDecoder
from gateway.hmi.login import Login
from gateway.hmi.seat import Person, Rank, Seat, Standing
from gateway.hmi.wording import Translate

PAUSE_S: Final = 0.05  # so long nothing typed: an Esc is the key Esc
WAITING_TOLD_S: Final = 10.0  # who waits is told so again
TICK_LEAST_S: Final = 0.1  # between two ticks that the menu asks for by itself
KEYS_A_TURN: Final = 64  # then others have their turn
KEYS_UNSENT_MOST: Final = 4096  # bytes unsent with which keys are still taken
UNSENT_MOST: Final = 65536  # bytes unsent with which a terminal is given up
ENDED_INPUT_S: Final = 5.0  # so long a menu may still work on what was typed when nothing more can be
UNREAD_S: Final = 30.0  # a terminal that takes nothing for so long is given up

log = logging.getLogger(__name__)


class Menu(Protocol):
    """What a session knows of a menu (``menu.Menu``)."""

    has_left: bool
    echoes: bool
    ends_keys_with_enter: bool
    rows: int
    columns: int

    def start(self) -> str:
        """Begin at the main menu; return its text."""
        ...

    def key(self, key: str) -> str:
        """Take one key of a ``KeyDecoder``; return the text to show."""
        ...

    def pause(self) -> str:
        """Nothing was typed for 50 ms; return the text to show."""
        ...

    def tick(self) -> str:
        """Do what is due; return the text to show."""
        ...

    def due_s(self) -> float | None:
        """Return when ``tick`` wants to be called (monotonic), or None."""
        ...

    def close(self) -> None:
        """Let go of everything; what was half done is dropped."""
        ...


MakeMenu = Callable[[str, Callable[[], None]], Menu]  # who has it; what makes his thread call ``tick`` soon


@dataclass(frozen=True)
class Shared:
    """What all terminals of the station have in common; *hmi* and *translation* are asked anew each time."""

    clock: Clock
    seat: Seat
    make_menu: MakeMenu
    hmi: Callable[[], HmiConfig]
    lockout: Lockout
    passwords: Background
    translation: Callable[[], Translate]


class Session:
    """One terminal, from its first to its last moment; the serial console's has no last one."""

    def __init__(self, shared: Shared, who: str, rank: Rank, address: str, wake: Callable[[], None]) -> None:
        """*who*: as the others are told; *address*: whose wrong passwords are counted, and who is logged."""
        self.who = who
        self.echoes = True
        self.ends_keys_with_enter = False
        self.rows, self.columns = 24, 80
        self.output = bytearray()  # to be sent; ``sent`` says how much of it was
        self.is_over = False  # once its output is sent the terminal is to be closed
        self._shared, self._rank, self._address = shared, rank, address
        self._clock, self._seat = shared.clock, shared.seat
        self._wake_thread = wake
        self._person = Person(who, rank, wake)
        self._keys = KeyDecoder()
        self._translate = shared.translation()
        self._login: Login | None = None
        self._menu: Menu | None = None
        self._is_known = False  # has given the password, or needs none
        self._turn = 0  # of the seat; 0 while others have it
        self._is_woken = False  # set by other threads
        self._told: object = None  # what he was told about waiting, and when
        self._told_s = self._typed_s = self._sent_s = self._ticked_s = self._clock.monotonic()
        self._login_s = 0.0  # when the login has to be done
        self._pause_s: float | None = None
        self._has_more_keys = self._has_ended_input = self._is_first_key = False

    @property
    def has_menu(self) -> bool:
        """Whether the menu is at this terminal now."""
        return self._menu is not None

    # ------------------------------------------------------------------------------------------------ the carrier's

    def start(self) -> None:
        """The terminal is there."""
        if self._rank is Rank.SERIAL:
            self._say("\nrtugate\n")
            self._rest()
        elif self._needs_password():
            self._ask_password()
        else:
            self._enter()
        self.turn()

    def receive(self, data: bytes) -> None:
        """*data* was typed: what it does, ``turn`` does."""
        if self.is_over or not data:
            return
        self._typed_s = self._clock.monotonic()
        self._pause_s = self._typed_s + PAUSE_S
        if self._rank is Rank.SERIAL:
            self._is_first_key |= self._turn == 0
            self._seat.take(self._person)
        self._keys.receive(data)

    def end_input(self) -> None:
        """Nothing more will be typed; what was typed is still carried out if the menu is here."""
        self._has_ended_input = True

    def turn(self) -> None:
        """Do what typing, time, the seat and other threads ask for."""
        if not self.is_over:
            self._follow_seat()
            self._ask_login()
            self._take_keys()
            self._after_pause()
            self._follow_seat()
            self._tick()
            self._leave_if_due()

    def sent(self, count: int) -> None:
        """The first *count* bytes of ``output`` were sent."""
        if count:
            del self.output[:count]
            self._sent_s = self._clock.monotonic()

    def due_s(self) -> float | None:
        """When ``turn`` wants to be called by itself, monotonic; None: only after something has happened."""
        if self.is_over:
            return None
        now_s = self._clock.monotonic()
        pause_s = None if self._has_more_keys else self._pause_s  # it comes after them
        due_s = [pause_s, self._idle_at_s(), self._login.due_s() if self._login else None]
        if self._has_more_keys and self._may_take_keys():
            due_s.append(now_s)
        if self._has_ended_input and not self._has_more_keys:
            due_s.append(self._typed_s + ENDED_INPUT_S)
        if self.output and self._rank is not Rank.SERIAL:
            due_s.append(self._sent_s + UNREAD_S)
        if self._menu and not self.output:
            due_s.append(now_s if self._is_woken else self._tick_at_s(self._menu))
        if self._is_waiting():
            standing = self._seat.standing(self._person)  # which may give him the menu, by the time that has passed
            wait_s = 0.0 if standing.has_menu else standing.wait_s
            due_s += [self._told_s + WAITING_TOLD_S, None if wait_s is None else now_s + wait_s]
        return min((moment_s for moment_s in due_s if moment_s is not None), default=None)

    def end(self, told: str = "") -> None:
        """Let the person go; *told*: why."""
        if not self.is_over:
            self._let_go()
            self._say(f"\n{told}\n" if told else "")
            self.is_over = True

    def stop(self) -> None:
        """The way to the menu is closed."""
        _ = self._translate
        self.end(_("The menu is closed: rtugate stops, or is configured anew."))

    def hang_up(self) -> None:
        """The terminal is gone: so is everything here."""
        self._let_go()
        self.is_over = True

    # ------------------------------------------------------------------------------------------------ the way in

    def _needs_password(self) -> bool:
        hmi = self._shared.hmi()
        if self._is_known or not hmi.password or self._rank is Rank.LOCAL:
            return False
        return self._rank is not Rank.SERIAL or hmi.serial.password_required

    def _ask_password(self) -> None:
        shared, is_serial = self._shared, self._rank is Rank.SERIAL
        self._login = Login(
            self._address,
            self._clock,
            shared.lockout,
            shared.passwords,
            stored=lambda: shared.hmi().password,
            wake=self._wake_thread,
            translate=self._translate,
            is_ever_locked_out=not is_serial,
        )
        self._typed_s = self._clock.monotonic() if is_serial else self._typed_s
        self._login_s = self._clock.monotonic() + shared.hmi().login_timeout
        self._say(self._login.start())

    def _ask_login(self) -> None:
        """Look how far the login is."""
        if self._login is None:
            return
        self._say(self._login.turn())
        if self._login.is_refused:
            log.debug("menu: %s is locked out and was closed", self.who)  # the lock-out itself was told
            self.end()
        elif self._login.is_done:
            self._login, self._is_known = None, True
            self._keys.clear()
            self._say("\n")
            log.info("menu: %s has logged in", self.who)
            if self._rank is Rank.SERIAL:
                self._start_menu()
            else:
                self._enter()

    def _enter(self) -> None:
        self._typed_s = self._clock.monotonic()
        self._seat.enter(self._person)

    # ------------------------------------------------------------------------------------------------ the seat

    def _is_waiting(self) -> bool:
        return self._rank is not Rank.SERIAL and self._login is None and self._menu is None

    def _follow_seat(self) -> None:
        """Get the menu, lose it, or be told who has it."""
        if self.is_over or (self._login is not None and self._rank is not Rank.SERIAL):
            return
        standing = self._seat.standing(self._person)
        if standing.turn != self._turn:
            has_lost = self._turn > 0 and not standing.has_menu
            self._drop()
            self._turn = standing.turn
            if has_lost:
                self._tell_loss(standing)
            elif self._needs_password():  # at the serial console; the others gave it before they waited
                self._ask_password()
            else:
                self._start_menu()
        if self._is_waiting():
            self._tell_waiting(standing)

    def _start_menu(self) -> None:
        if self._rank is not Rank.SERIAL:
            self._keys.clear()  # what was typed while waiting
        log.info("menu: %s has the menu", self.who)
        self._translate = self._shared.translation()
        self._typed_s = self._ticked_s = self._clock.monotonic()
        self._is_woken = False
        self._menu = self._shared.make_menu(self.who, self._wake_menu)
        self._set_up(self._menu)
        self._say("\n" + self._menu.start())

    def _tell_loss(self, standing: Standing) -> None:
        _ = self._translate
        self._keys.clear()
        self._told = None
        holder = standing.holder
        if self._rank is Rank.SERIAL:
            told = _("The menu is now with {who}. Press any key to take it back.")
            self._say("\n\n" + told.format(who=holder.who if holder else "-") + "\n")
        elif holder is None or holder.rank is Rank.SERIAL:
            self._say("\n\n" + _("The serial console has taken the menu.") + "\n")
        else:
            self._say("\n\n" + _("{who} has taken the menu.").format(who=holder.who) + "\n")
        log.info("menu: %s has lost it", self.who)

    def _tell_waiting(self, standing: Standing) -> None:
        """Why and how long: at first, when that changes, and every 10 s."""
        now_s = self._clock.monotonic()
        reason = (standing.holder, standing.ahead, standing.wait_s is None)
        if reason == self._told and now_s < self._told_s + WAITING_TOLD_S:
            return
        self._told, self._told_s = reason, now_s
        self._say(textwrap.fill(self._why_waiting(standing), self.columns - 1) + "\n")

    def _why_waiting(self, standing: Standing) -> str:
        _ = self._translate
        seconds = math.ceil(standing.wait_s or 0.0)
        if standing.holder is None:
            told = _("The serial console goes first: the menu is free in {seconds} s if nobody types there.")
        elif standing.holder.rank is Rank.SERIAL:
            told = _("The serial console has the menu: it is free in {seconds} s if nobody types there.")
        else:
            told = _("{who} has the menu.")
        text = told.format(seconds=seconds, who=standing.holder.who if standing.holder else "")
        if standing.ahead:
            text += " " + _("{count} before you.").format(count=standing.ahead)
        return text

    # ------------------------------------------------------------------------------------------------ keys

    def _may_take_keys(self) -> bool:
        return len(self.output) < KEYS_UNSENT_MOST

    def _take_keys(self) -> None:
        """Hand on what was typed, some keys at a time."""
        self._has_more_keys = False
        for _turn in range(KEYS_A_TURN):
            if self.is_over or not self._may_take_keys():
                break
            key = self._keys.next_key()
            if key is None:
                self._is_first_key &= self._keys.has_part
                return
            self._take_key(key)
        self._has_more_keys = True

    def _take_key(self, key: str) -> None:
        if self._is_first_key:  # the one that was pressed to get here
            self._is_first_key = False
        elif self._login is not None:
            self._say(self._login.key(key))
        elif self._menu is not None:
            self._set_up(self._menu)
            self._say(self._menu.key(key))
            self._leave_menu_if_left()

    def _set_up(self, menu: Menu) -> None:
        menu.echoes, menu.ends_keys_with_enter = self.echoes, self.ends_keys_with_enter
        menu.rows, menu.columns = self.rows, self.columns

    def _after_pause(self) -> None:
        if self._pause_s is None or self._has_more_keys or self._clock.monotonic() < self._pause_s:
            return
        self._pause_s = None
        self._keys.pause()
        self._take_keys()
        self._is_first_key = False
        if self._menu is not None:
            self._say(self._menu.pause())

    def _leave_menu_if_left(self) -> None:
        if self._menu is not None and self._menu.has_left:
            if self._rank is Rank.SERIAL:
                self._log_out()
            else:
                self.end()

    # ------------------------------------------------------------------------------------------------ time

    def _wake_menu(self) -> None:
        self._is_woken = True
        self._wake_thread()

    def _tick_at_s(self, menu: Menu) -> float | None:
        due_s = menu.due_s()
        return None if due_s is None else max(due_s, self._ticked_s + TICK_LEAST_S)

    def _tick(self) -> None:
        """Let the menu refresh what it shows, once the last picture is sent."""
        if self._menu is None or self.output:
            return
        now_s = self._clock.monotonic()
        due_s = self._tick_at_s(self._menu)
        if self._is_woken or (due_s is not None and now_s >= due_s):
            self._is_woken = False  # before the call: what wakes during it counts for the next
            self._ticked_s = now_s
            self._set_up(self._menu)
            self._say(self._menu.tick())
            self._leave_menu_if_left()

    def _idle_at_s(self) -> float | None:
        """When the person has been silent for too long."""
        if self._login is not None:
            return self._login_s
        if self._rank is Rank.SERIAL and not (self._menu or self._is_known):
            return None
        return self._typed_s + self._shared.hmi().idle_timeout

    def _leave_if_due(self) -> None:
        now_s, idle_s = self._clock.monotonic(), self._idle_at_s()
        if self.is_over:
            return
        if len(self.output) > UNSENT_MOST or (self._is_unread(now_s) and self._rank is not Rank.SERIAL):
            log.warning("menu: %s does not read what it is sent", self.who)
            self.output.clear()
            self.end()
        elif idle_s is not None and now_s >= idle_s:
            self._leave_idle()
        elif self._has_ended_input and self._is_done_with_input(now_s):
            self.end()

    def _is_done_with_input(self, now_s: float) -> bool:
        """Whether all that was typed is carried out, as far as anybody can wait for it."""
        if self._menu is None:
            return True
        if self._has_more_keys or self._pause_s is not None:
            return False
        return self._menu.due_s() is None or now_s >= self._typed_s + ENDED_INPUT_S

    def _is_unread(self, now_s: float) -> bool:
        return bool(self.output) and now_s >= self._sent_s + UNREAD_S

    def _leave_idle(self) -> None:
        _ = self._translate
        told = (
            _("Too long without a key: the menu is closed.") if self._login is None else _("Too long without a login.")
        )
        log.info("menu: %s: %s", self.who, "idle" if self._login is None else "no login in time")
        if self._rank is not Rank.SERIAL:
            self.end(told)
            return
        if self._turn:
            self._say(f"\n{told}\n")
            self._log_out()
        self._is_known = False

    def _log_out(self) -> None:
        """The serial console's end: others may have the menu, and any key brings it back."""
        self._let_go()
        self._is_known = False
        self._rest()

    def _rest(self) -> None:
        _ = self._translate = self._shared.translation()
        self._say("\n" + _("Press any key for the menu.") + "\n")

    # ------------------------------------------------------------------------------------------------ ends

    def _drop(self) -> None:
        """Close what is open here; a half-typed dialogue dies with it."""
        menu, self._menu = self._menu, None
        login, self._login = self._login, None
        if login is not None:
            login.close()
        if menu is not None:
            menu.close()

    def _let_go(self) -> None:
        if self._turn:
            log.info("menu: %s has left it", self.who)
        self._seat.leave(self._person)  # first: whatever else fails, the others get their turn
        self._turn = 0
        self._keys.clear()
        self._drop()

    def _say(self, text: str) -> None:
        if text and not self.output:
            self._sent_s = self._clock.monotonic()  # from now on it can be late
        self.output += text.replace("\r\n", "\n").replace("\n", "\r\n").encode("utf-8", "replace")
