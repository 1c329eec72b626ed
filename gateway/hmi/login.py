"""The question for the password, until it is right or the terminal has to go (spec section 5, "Access").

What it is: keys in, text out; the check itself runs in the background, and its answer is held back after a failure.
What it refuses: telling why (there is one password and no name), showing what is typed, logging it.
Threads: the session's; the check runs in ``Background``'s, counts its failure and leaves its result here.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

from gateway.clock import Clock
from gateway.hmi.access import PASSWORD_MAX, Lockout, check_password
from gateway.hmi.background import Background, Call
from gateway.hmi.keys import ENTER, LineEditor, Outcome
from gateway.hmi.wording import Translate

log = logging.getLogger(__name__)


class Login:
    """One terminal's way in."""

    def __init__(
        self,
        address: str,
        clock: Clock,
        lockout: Lockout,
        background: Background,
        stored: Callable[[], str],
        wake: Callable[[], None],
        translate: Translate,
        is_ever_locked_out: bool = True,
    ) -> None:
        """*address*: whose failures are counted; *stored* gives the hash as it is configured at that moment."""
        self.is_done = False  # the password was right
        self.is_refused = False  # this terminal has to go
        self._address = address
        self._clock = clock
        self._lockout = lockout
        self._background = background
        self._stored = stored
        self._wake = wake
        self._translate = translate
        self._is_ever_locked_out = is_ever_locked_out
        self._line = LineEditor(limit=PASSWORD_MAX, hidden=True)
        self._is_too_long = False
        self._check: Call | None = None
        self._result: bool | None = None  # set by the background's thread
        self._answer_s: float | None = None  # when a failure is told

    def start(self) -> str:
        """Ask for the password, or say why not."""
        if self._locked_s():
            return self._refuse()
        return self._prompt()

    def key(self, key: str) -> str:
        """One key; what is typed while an answer is awaited is ignored."""
        if self._check is not None or self._answer_s is not None:
            return ""
        if self._is_too_long:
            return self._too_long() if key == ENTER else ""
        text, outcome = self._line.key(key)
        if outcome is Outcome.OVERFLOW:
            self._is_too_long = True
        elif outcome is Outcome.ESCAPE:
            return "\n" + self._prompt()
        elif outcome is Outcome.DONE:
            return text + self._entered(self._line.text)
        return text

    def turn(self) -> str:
        """Look whether an answer has come, or its time."""
        if self._check is not None and self._result is not None:
            self._check = None
            if self._result:
                self.is_done = True
                return ""
            self._answer_s = self._clock.monotonic() + self._lockout.delay_s(self._address)
        if self._answer_s is not None and self._clock.monotonic() >= self._answer_s:
            return self._tell_failure()
        return ""

    def due_s(self) -> float | None:
        """When ``turn`` wants to be called by itself, monotonic."""
        return self._answer_s

    def close(self) -> None:
        """The terminal is gone; a check that runs already still counts."""
        if self._check is not None:
            self._check.cancel()
            self._check = None

    # ------------------------------------------------------------------------------------------------ inside

    def _prompt(self) -> str:
        _ = self._translate
        self._line = LineEditor(limit=PASSWORD_MAX, hidden=True)
        self._is_too_long = False
        return _("Password: ")

    def _too_long(self) -> str:
        _ = self._translate
        return "\n" + _("A password has {most} characters at most.").format(most=PASSWORD_MAX) + "\n" + self._prompt()

    def _entered(self, text: str) -> str:
        if not text:
            return self._prompt()
        if self._locked_s():  # by other terminals of this address, meanwhile
            return self._refuse()
        stored = self._stored()

        def check() -> None:
            self._result = self._is_right(text, stored)
            self._wake()

        self._result = None
        self._check = self._background.run(check)
        return ""

    def _is_right(self, text: str, stored: str) -> bool:
        """In the background's thread: counted before the next check begins, so that nobody gets a sixth guess."""
        if self._locked_s():
            return False
        if check_password(text, stored):
            self._lockout.succeeded(self._address)
            return True
        log.warning("menu: wrong password from %s", self._address)
        if self._lockout.failed(self._address) and self._is_ever_locked_out:
            log.warning("menu: too many wrong passwords: %s is locked out", self._address)
        return False

    def _tell_failure(self) -> str:
        _ = self._translate
        self._answer_s = None
        told = _("Wrong password.") + "\n"
        return told + (self._refuse() if self._locked_s() else self._prompt())

    def _locked_s(self) -> float:
        return self._lockout.locked_s(self._address) if self._is_ever_locked_out else 0.0

    def _refuse(self) -> str:
        _ = self._translate
        self.is_refused = True
        minutes = math.ceil(self._locked_s() / 60)
        return _("Too many wrong passwords: try again in {minutes} minutes.").format(minutes=minutes) + "\n"
