"""The menu machine: one key in, text out (spec section 5). It knows dialogues, and nothing of what they are about.

A dialogue is a generator. It says things through its ``Ui`` and yields what it wants next: a key, a line, or to be
called again when a job is done. The machine collects keys into answers, keeps what must be the same everywhere (Esc
goes back, more than 8 characters lead to the main menu, a wrong key is told, ? helps), and throws ``Back`` or
``ToMainMenu`` into the dialogue. So a half-typed dialogue dies with its generator, and has changed nothing.

Pure: no clock but the one handed in, no terminal. One thread uses a Menu; *wake* may be called by any.
"""

from __future__ import annotations

import re
import textwrap
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

from gateway.clock import Clock
from gateway.hmi.keys import ENTER, ESC, LineEditor, Outcome
from gateway.hmi.wording import without_accents
from gateway.plain_text import cut, printable

LINE_LIMIT: Final = 8  # characters; more of them lead back to the main menu (original)
TYPED_AHEAD_MOST: Final = 100  # keys kept while a job runs
HELP: Final = "?"
SIGNS: Final = "123456789abcdefghijklmnopqrstuvwxyz"  # of the entries of a list

T = TypeVar("T")


class Back(Exception):
    """The person pressed Esc."""


class ToMainMenu(Exception):
    """The person typed more than there is room for: the way out of everything."""


@dataclass(frozen=True)
class AskKey:
    """One key out of *keys* (lower case), without Enter.

    takes_enter: Enter alone is an answer too: "\\r".
    any_key:     every key is an answer.
    every_s:     answer None after so long, and after a wake: a live display.
    is_quiet:    the prompt is part of what was shown already.
    wrong:       what is told of another key; "": the keys that there are.
    """

    prompt: str
    keys: str
    takes_enter: bool = False
    any_key: bool = False
    every_s: float | None = None
    is_quiet: bool = False
    wrong: str = ""


@dataclass(frozen=True)
class AskLine:
    """A number or a text, ended with Enter; the answer is the text."""

    prompt: str
    limit: int = LINE_LIMIT
    is_hidden: bool = False


@dataclass(frozen=True)
class Await:
    """Go on when *is_done* says so, or at *until_s* (monotonic seconds); the answer is None."""

    is_done: Callable[[], bool]
    until_s: float


Wish = AskKey | AskLine | Await
Dialogue = Generator[Wish, str | None, T]


class Ui:
    """What a dialogue has of its terminal: it says, asks, shows."""

    def __init__(
        self, clock: Clock, translate: Callable[[str], str] = lambda text: text, wake: Callable[[], None] = lambda: None
    ) -> None:
        """*wake* has ``Menu.tick`` called soon; for whoever does something in another thread."""
        self.clock = clock
        self.translate = translate
        self.wake = wake
        self.rows, self.columns = 24, 80
        self.help = ""  # what ? tells, set by each screen
        self._out: list[str] = []

    def parts(self, text: str) -> list[str]:
        """Return *text* as lines that fit into the terminal; whatever cannot be printed is escaped."""
        width = self.columns - 1
        found: list[str] = []
        for line in map(printable, text.split("\n")):
            found += textwrap.wrap(line, width, break_on_hyphens=False) if len(line) > width else [line]
        return found

    def say(self, *lines: str) -> None:
        """Show *lines*, each on its own; what is wider than the terminal goes on below."""
        self._out += [f"{part}\n" for line in lines for part in self.parts(line)]

    def show(self, text: str) -> None:
        """Show *text*, line ends and all, and no line end after it."""
        self._out.append(text)

    def prompt(self, text: str) -> None:
        """Show *text* without a line end; what does not fit into the terminal's last line stands above."""
        *above, last = self.parts(text)
        self.say(*above)
        self.show(f"{last} " if above else last)

    def taken(self) -> str:
        """Return all that was said since."""
        text = "".join(self._out)
        self._out.clear()
        return text

    # -------------------------------------------------------------------------------------------- asking

    def key(self, prompt: str, keys: str, default: str = "") -> Dialogue[str]:
        """Ask for one of *keys*; Enter alone gives *default* where there is one."""
        shown = f"{prompt} [{default}]: " if default else f"{prompt}: "
        answer = yield AskKey(shown, keys, takes_enter=bool(default))
        return default if answer == ENTER else answer or ""

    def line(self, prompt: str, default: str = "", limit: int = LINE_LIMIT, is_hidden: bool = False) -> Dialogue[str]:
        """Ask for a text; Enter alone gives *default*, which stands in brackets."""
        shown = f"{prompt} [{default}]: " if default and not is_hidden else f"{prompt}: "
        answer = (yield AskLine(shown, limit, is_hidden)) or ""
        return answer if is_hidden else answer.strip() or default

    def value(self, prompt: str, judge: Callable[[str], T], default: str = "", limit: int = LINE_LIMIT) -> Dialogue[T]:
        """Ask until *judge* takes the text; what it raises as ValueError is told, and says what is allowed."""
        while True:
            text = yield from self.line(prompt, default, limit)
            try:
                return judge(text)
            except ValueError as error:
                self.say(str(error))

    def number(self, prompt: str, low: int, high: int, default: int | None = None) -> Dialogue[int]:
        """Ask for a whole number from *low* to *high*, decimal or 0x..."""
        _ = self.translate

        def judge(text: str) -> int:
            number = whole_number(text)
            if number is None or not low <= number <= high:
                raise ValueError(_("Please type a whole number from {low} to {high}.").format(low=low, high=high))
            return number

        return (yield from self.value(f"{prompt} ({low}-{high})", judge, "" if default is None else str(default)))

    def seconds(self, prompt: str, low: float, high: float, default: float | None = None) -> Dialogue[float]:
        """Ask for a time in seconds, from *low* to *high*; a comma is taken for a point."""
        _ = self.translate
        told = _("Please type seconds from {low:g} to {high:g}, such as 0.5.").format(low=low, high=high)

        def judge(text: str) -> float:
            try:
                number = float(text.replace(",", "."))
            except ValueError:
                number = float("nan")
            if not low <= number <= high:
                raise ValueError(told)
            return number

        return (yield from self.value(prompt, judge, "" if default is None else seconds_text(default)))

    def confirmed(self, question: str) -> Dialogue[bool]:
        """Ask y/n; the letter for yes in the person's language is taken, too."""
        _ = self.translate
        yes = _("y")
        answer = yield AskKey(f"{question} ({yes}/n): ", f"yn{yes}")
        return answer in ("y", yes)

    def choice(self, prompt: str, names: Sequence[str]) -> Dialogue[int]:
        """Have one of *names* chosen by one key, and return its place; a single one is no choice."""
        if len(names) == 1:
            return 0
        if len(names) > len(SIGNS):
            return (yield from self._choice_by_name(prompt, names))
        signs = SIGNS[: len(names)]
        yield from self.listed(self._in_columns([f"  {sign}  {name}" for sign, name in zip(signs, names, strict=True)]))
        answer = yield from self.key(prompt, signs)
        return signs.index(answer)

    def _choice_by_name(self, prompt: str, names: Sequence[str]) -> Dialogue[int]:
        """Have one chosen by the first word of its name: there are more than keys."""
        _ = self.translate
        words = [name.split(" ", 1)[0] for name in names]
        yield from self.listed(self._in_columns([f"  {name}" for name in names]))

        def judge(text: str) -> int:
            if text not in words:
                raise ValueError(_("There is none of that name."))
            return words.index(text)

        return (yield from self.value(_("{prompt}, its name").format(prompt=prompt), judge, limit=32))

    # -------------------------------------------------------------------------------------------- showing

    @property
    def room(self) -> int:
        """Lines that stand above a prompt and what is said with it."""
        return max(1, self.rows - 6)

    def help_lines(self) -> list[str]:
        """Return what ? tells on this screen."""
        _ = self.translate
        keys = _("Enter keeps what stands in brackets, Esc goes back, more than 8 characters lead to the main menu.")
        return [*filter(None, self.help.split("\n")), keys]

    def listed(self, lines: Sequence[str]) -> Dialogue[None]:
        """Show *lines*, a screenful at a time; Esc goes back."""
        _ = self.translate
        shown = [part for line in lines for part in self.parts(line)]
        for start in range(0, len(shown), self.room):
            if start:
                answer = yield AskKey(_("Any key: more. Esc: back."), "", any_key=True)
                self.show("\n")
                if answer == ESC:
                    raise Back
            self.say(*shown[start : start + self.room])

    def _in_columns(self, lines: list[str]) -> list[str]:
        """Return *lines* side by side where there are too many of them for one screenful."""
        if len(lines) <= self.room:
            return lines
        half, width = (len(lines) + 1) // 2, (self.columns - 1) // 2
        left, right = lines[:half], [*lines[half:], ""]
        return [f"{cut(a, width - 2):<{width}}{cut(b, width)}".rstrip() for a, b in zip(left, right, strict=False)]

    def pages(
        self, body: Callable[[], tuple[list[str], list[str]]], hint: str, keys: str = "", every_s: float = 1.0
    ) -> Dialogue[str]:
        """Show a head and rows, live, until a key that neither turns the pages nor asks for help; return it.

        body:  the head, which stands on every page, and the rows.
        Each picture is as tall as the terminal, so that it comes to stand where the last one stood, on any terminal.
        """
        _ = self.translate
        page, shown = 0, None
        while True:
            head, rows = body()
            room = max(1, self.rows - len(head) - 1)
            last = max(0, (len(rows) - 1) // room)
            page = min(page, last)
            now = [*head, *rows[page * room : (page + 1) * room]]
            if now != shown:
                self._show_page(now, hint if not last else f"{self._place(page, last)}  {hint}")
                shown = now
            answer = yield AskKey("", keys, any_key=True, every_s=every_s, is_quiet=True)
            if answer in (" ", "+", "-") and last:
                page = (page + (-1 if answer == "-" else 1)) % (last + 1)
            elif answer == HELP:
                self.say("", *self.help_lines())
                yield AskKey(_("Any key: back."), "", any_key=True)
                shown = None
            elif answer is not None:
                self.show("\n")
                return answer

    def _place(self, page: int, last: int) -> str:
        _ = self.translate
        return _("page {page} of {pages}, + and - turn.").format(page=page + 1, pages=last + 1)

    def _show_page(self, lines: list[str], hint: str) -> None:
        lines = [printable(line)[: self.columns - 1].rstrip() for line in lines]
        lines += [""] * (self.rows - 1 - len(lines))
        self.show("\n" + "\n".join(lines) + "\n" + hint[: self.columns - 1])

    def wait_for(self, is_done: Callable[[], bool], limit_s: float) -> Dialogue[bool]:
        """Wait until *is_done*; False when *limit_s* is over before."""
        if not is_done():
            yield Await(is_done, self.clock.monotonic() + limit_s)
        return is_done()


def seconds_text(seconds: float) -> str:
    """Return *seconds* as short as they can be typed without becoming others."""
    short = f"{seconds:g}"
    return short if float(short) == seconds else str(seconds)


def whole_number(text: str) -> int | None:
    """Return the number that a person typed, decimal or 0x..., or None."""
    typed = text.strip()
    if re.fullmatch(r"0[xX][0-9A-Fa-f]+", typed):
        return int(typed, 16)
    return int(typed) if re.fullmatch(r"[+-]?[0-9]+", typed) else None


class Menu:
    """One person's turn at the menu, from the main menu on. See ``Ui`` for what a dialogue can do."""

    def __init__(
        self, main: Callable[[Ui], Dialogue[None]], ui: Ui, is_ascii: Callable[[], bool] = lambda: False
    ) -> None:
        """*main*: the main menu's dialogue; it returns when the person leaves. *is_ascii*: show no accents."""
        self.echoes = True  # typed characters are shown by us
        self.ends_keys_with_enter = False  # the terminal sends whole lines only
        self.has_left = False
        self._ui = ui
        self._is_ascii = is_ascii
        self._dialogue = main(ui)
        self._ask: Wish | None = None
        self._editor = LineEditor()
        self._tick_s: float | None = None
        self._ahead: deque[str] = deque()
        self._skips = False  # what is left of a line that was too long

    @property
    def rows(self) -> int:
        """Lines of the terminal."""
        return self._ui.rows

    @rows.setter
    def rows(self, rows: int) -> None:
        self._ui.rows = rows

    @property
    def columns(self) -> int:
        """Characters in a line of the terminal."""
        return self._ui.columns

    @columns.setter
    def columns(self, columns: int) -> None:
        self._ui.columns = columns

    @property
    def is_busy(self) -> bool:
        """Whether it waits for a job, not for a person."""
        return isinstance(self._ask, Await)

    def start(self) -> str:
        """Begin at the main menu; return its text."""
        self._resume(None)
        return self._text()

    def key(self, key: str) -> str:
        """Take one key of a ``KeyDecoder``; return the text to show."""
        echo = "" if self.has_left else self._take(key)
        if not self.echoes:  # the terminal shows what is typed, but begins a new line only where Enter was typed
            echo = "\n" if "\n" in echo and not self.ends_keys_with_enter else ""
        return echo + self._text()

    def pause(self) -> str:
        """Nothing was typed for a moment: a line that was too long has come to its end."""
        self._skips = False
        return ""

    def tick(self) -> str:
        """Do what is due: refresh a live display, see whether a job is done; return the text to show."""
        ask, now_s = self._ask, self._ui.clock.monotonic()
        if isinstance(ask, Await) and (ask.is_done() or now_s >= ask.until_s):
            self._resume(None)
            return self._text() + self._replay()
        if isinstance(ask, AskKey) and self._tick_s is not None and now_s >= self._tick_s and not self._editor.text:
            self._resume(None)
        return self._text()

    def due_s(self) -> float | None:
        """Return when ``tick`` has something to do by itself (monotonic seconds), or None."""
        if isinstance(self._ask, Await):
            return self._ask.until_s
        return None if self._editor.text else self._tick_s  # what is half typed is not scrolled away

    def close(self) -> None:
        """Hands change, or the terminal is gone: what was half done is dropped."""
        self._dialogue.close()
        self.has_left, self._ask, self._tick_s = True, None, None

    # -------------------------------------------------------------------------------------------- keys to answers

    def _take(self, key: str) -> str:
        ask = self._ask
        if self._skips:
            self._skips = key != ENTER
            return ""
        if isinstance(ask, Await):
            return self._while_waiting(key)
        if isinstance(ask, AskLine):
            return self._edit(key, self._line_done)
        if isinstance(ask, AskKey) and self.ends_keys_with_enter:
            return self._edit(key, lambda text: self._key_done(ask, text.strip()[:1] or text[:1] or ENTER))
        if isinstance(ask, AskKey):
            echo = "" if ask.any_key or not key.isprintable() else key
            return echo + self._key_done(ask, key)
        return ""

    def _while_waiting(self, key: str) -> str:
        if key == ESC:
            self._ahead.clear()
            self._resume(None, Back())
        elif len(self._ahead) < TYPED_AHEAD_MOST:
            self._ahead.append(key)
        return ""

    def _replay(self) -> str:
        """Take the keys that were typed while a job ran; return the text to show."""
        text = ""
        while self._ahead and not isinstance(self._ask, Await) and not self.has_left:
            text += self.key(self._ahead.popleft())
        return text

    def _edit(self, key: str, done: Callable[[str], str]) -> str:
        echo, outcome = self._editor.key(key)
        echo = echo.replace("\r\n", "\n")
        if outcome is Outcome.DONE:
            return echo + done(self._editor.text)
        if outcome is Outcome.ESCAPE:
            self._skips = self.ends_keys_with_enter  # the Enter that sends an Esc is no answer to what comes next
            self._resume(None, Back())
            return "\n"
        if outcome is Outcome.OVERFLOW:
            self._skips = True
            self._resume(None, ToMainMenu())
            return "\n"
        return echo

    def _line_done(self, text: str) -> str:
        if text.strip() == HELP:
            self._help()
        else:
            self._resume(text)
        return ""

    def _key_done(self, ask: AskKey, key: str) -> str:
        answer = key.lower()
        if ask.any_key and (answer != HELP or ask.is_quiet):
            self._resume(answer)
            return ""
        if key == ESC:
            self._resume(None, Back())
        elif answer == HELP:
            self._help()
        elif ask.takes_enter if answer == ENTER else answer in ask.keys:
            self._resume(answer)
        else:
            self._wrong_key(ask, key)
        return "\n" if not self.ends_keys_with_enter else ""

    def _wrong_key(self, ask: AskKey, key: str) -> None:
        _ = self._ui.translate
        if key.isprintable():
            told = ask.wrong or _("{key} is no choice here; one of: {keys}. Esc goes back, ? helps.")
            keys = " ".join(dict.fromkeys(ask.keys.upper().strip()))
            self._ui.say(told.format(key=_("Space") if key == " " else key, keys=keys))
        self._begin_line(ask)
        self._ui.prompt(ask.prompt)

    def _help(self) -> None:
        self._ui.say(*self._ui.help_lines())
        if isinstance(self._ask, AskKey | AskLine):
            self._begin_line(self._ask)
            self._ui.prompt(self._ask.prompt)

    # -------------------------------------------------------------------------------------------- the dialogue

    def _resume(self, answer: str | None, thrown: Exception | None = None) -> None:
        """Let the dialogue go on until its next wish."""
        try:
            ask = self._dialogue.throw(thrown) if thrown else self._dialogue.send(answer)
        except StopIteration:
            self.close()
            return
        self._ask = ask
        every_s = ask.every_s if isinstance(ask, AskKey) else None
        self._tick_s = None if every_s is None else self._ui.clock.monotonic() + every_s
        self._prompt(ask)

    def _begin_line(self, ask: Wish) -> None:
        is_hidden = isinstance(ask, AskLine) and ask.is_hidden
        self._editor = LineEditor(ask.limit if isinstance(ask, AskLine) else LINE_LIMIT, hidden=is_hidden)

    def _prompt(self, ask: Wish) -> None:
        self._begin_line(ask)
        if isinstance(ask, AskLine) or (isinstance(ask, AskKey) and not ask.is_quiet):
            self._ui.prompt(ask.prompt)

    def _text(self) -> str:
        text = self._ui.taken()
        return without_accents(text) if self._is_ascii() else text
