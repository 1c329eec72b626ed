"""What the program logs: made safe, kept from flooding a flash card, worded for the journal, and the newest lines kept.

Whatever a person or a device can put into a name or a line is logged with its control characters escaped (spec section
5); a traceback keeps its line ends.

``RateLimited`` stands between the root logger and the handlers that write. Ten lines of one cause go through, then one
in ten minutes; of all causes together 200, then one a minute. Of what is held back the newest line of each cause is
told late, once that has been quiet for ten minutes, with the time it happened, and how many more there were: in a storm
one a minute, after it all. So the log ends with how things are. That holds for each cause: lines of different wording
that tell one state, be it in two modules, say that they are about the same (``extra={"about": "field: unit 5"}``), and
are one cause. A count behind a name ("field: 3 writes are lost") would make each line a cause of its own, as a unit
does: such a line says what it is about as well. ``extra={"is_unlimited": True}`` is for what must never wait.

Measured with a day of a real master of 1000 requests on 200 units (0.1 s to wait for a reply) whose wire breaks and
heals every 30 s, repeated for a month: 230,000 lines and 7.4 megabytes a day without the limits; with them 2900 lines
and a quarter of a megabyte, and 20 minutes after the end the last line of each request and unit was true. A wire that
breaks once and stays broken is some 600 lines and then none, whether for a month or a year.

What it refuses: waiting for anything, or keeping anybody from logging; an exception from a handler stays here.
Source: specification of rtugate, section 5, last rule; sd-daemon(3) for the journal's prefixes; systemd.exec(5) for
JOURNAL_STREAM.
Threads: any thread logs; ``lines`` may be read by any; ``flush_due`` is the main thread's. The limiter's lock is held
for a look at its table only, never while a line is worded or written.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final, Protocol

from gateway.clock import Clock
from gateway.plain_text import printable

KEPT: Final = 300  # lines that the menu can show
LONGEST: Final = 2000  # characters of one message, of a traceback's line, and of one line that is kept
TRACEBACK_LONGEST: Final = 8000  # characters; its end, which names the error, is the part that stays

BURST, AGAIN_S = 10, 600.0  # lines of one cause at once; then one in so many seconds
ALL_BURST, ALL_AGAIN_S = 200, 60.0  # the same for all causes together
SETTLED_S: Final = 600.0  # a line held back is told late once its cause has been quiet for so long
LATE_BURST, LATE_AGAIN_S = 200, 60.0  # late lines at once, then one in so many seconds; a budget of their own
STORM, STORM_S = 60, 600.0  # so many lines held back in so short a time; after it all that waits is told
LATE_AT_ONCE, LATE_PAUSE_S = 20, 1.0  # in one call of ``flush_due``: the main thread has other work
REST_MOST: Final = 50  # late lines told when the program ends
CAUSES_MOST: Final = 2000  # known one by one: 1000 requests and their units
WORDINGS_MOST: Final = 200  # known beyond that
CAUSE_LONGEST: Final = 100  # characters of a name by which causes are told apart
SUFFIX_LONGEST: Final = 200


def moment(wall_s: float) -> str:
    """Return the time of day and the date of *wall_s*, for people, as this machine believes them to be."""
    return datetime.fromtimestamp(wall_s).strftime("%m-%d %H:%M:%S")


class SafeFormatter(logging.Formatter):
    """LEVEL and message; nothing in them moves a cursor or makes a second line."""

    def __init__(self, form: str = "%(levelname)s %(message)s") -> None:
        super().__init__(form)

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the name is logging's
        """Return the first line, without a traceback."""
        return printable(super().formatMessage(record)[:LONGEST])

    def formatException(self, ei: Any) -> str:  # noqa: N802 - the name is logging's, as is what stands in *ei*
        """Return a traceback; what its error tells of a name or a line is made safe as well."""
        lines = printable(super().formatException(ei), kept="\n").split("\n")
        text = "\n".join(line[:LONGEST] for line in lines)
        return text if len(text) <= TRACEBACK_LONGEST else "[...]" + text[-TRACEBACK_LONGEST:]


class JournalFormatter(SafeFormatter):
    """The message with its level as the journal reads it: ``<4>`` and the like, on every line of a traceback too."""

    PRIORITIES: Final = (  # sd-daemon(3), from the highest level on
        (logging.CRITICAL, "<2>"),
        (logging.ERROR, "<3>"),
        (logging.WARNING, "<4>"),
        (logging.INFO, "<6>"),
    )
    LEAST: Final = "<7>"  # debug

    def __init__(self) -> None:
        super().__init__("%(message)s")

    def format(self, record: logging.LogRecord) -> str:
        """Return all lines of *record*, each with its prefix."""
        prefix = next((prefix for level, prefix in self.PRIORITIES if record.levelno >= level), self.LEAST)
        return "\n".join(prefix + line for line in super().format(record).split("\n"))


class OpenFile(Protocol):
    """What ``os.fstat`` tells of an open file, as far as it is of interest here."""

    @property
    def st_dev(self) -> int:
        """Its device."""
        ...

    @property
    def st_ino(self) -> int:
        """Its inode."""
        ...


def console_formatter(journal_stream: str, console: OpenFile | None) -> SafeFormatter:
    """Return how to word what is written to *console*: for the journal if it is that, else for people.

    journal_stream: JOURNAL_STREAM of the environment, "" without it; it names the journal's device and inode, and is
    inherited also by programs whose stderr goes elsewhere, hence the comparison (systemd.exec(5)).
    """
    is_journal = console is not None and journal_stream == f"{console.st_dev}:{console.st_ino}"
    return JournalFormatter() if is_journal else SafeFormatter()


class LogRing(logging.Handler):
    """The newest lines, each with its time."""

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(SafeFormatter())
        self._lines: deque[str] = deque(maxlen=KEPT)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep *record*, every line of it on its own; one that cannot be worded is logging's to complain of."""
        try:
            lines = self.format(record).split("\n")
        except Exception:  # noqa: BLE001 - as in logging's own handlers: whoever logs must not suffer
            self.handleError(record)
            return
        when = moment(record.created)
        self._lines.extend(f"{when} {line[:LONGEST]}" for line in lines)

    def lines(self) -> list[str]:
        """Return the lines, oldest first."""
        self.acquire()
        try:
            return list(self._lines)
        finally:
            self.release()


# ------------------------------------------------------------------------------------------------ what is limited


class _Budget:
    """So many lines at once, then one each *every_s* seconds; times are monotonic."""

    __slots__ = ("_every_s", "_most_s", "full_s")

    def __init__(self, burst: int, every_s: float) -> None:
        self._every_s = every_s
        self._most_s = burst * every_s
        self.full_s = -math.inf  # from when on nothing of it is spent

    def wait_s(self, now_s: float, kept: int = 0) -> float:
        """Return how long there is nothing to spend, if *kept* lines are to be left; 0 if there is something."""
        return max(0.0, self.full_s + (1 + kept) * self._every_s - self._most_s - now_s)

    def spend(self, now_s: float) -> None:
        """One line is told."""
        self.full_s = max(self.full_s, now_s) + self._every_s


@dataclass(frozen=True, slots=True)
class _Line:
    """A record in words: it holds on to no frame, socket or register, and says how things were when it was logged."""

    name: str
    level: int
    created: float  # wall time
    text: str
    traceback: str

    def record(self, remarks: Sequence[str], created: float) -> logging.LogRecord:
        """Return it as logging knows it, with *remarks* in brackets behind its text."""
        text = f"{self.text} ({'; '.join(remarks)})" if remarks else self.text
        made = logging.LogRecord(self.name, self.level, "", 0, text, None, None)
        made.created = created
        made.exc_text = self.traceback or None
        return made


def _line_of(record: logging.LogRecord, formatter: SafeFormatter) -> _Line:
    try:
        message = record.getMessage()
    except Exception as error:  # noqa: BLE001 - a bug in the words of a line must not cost the line
        where = f"{record.filename}, line {record.lineno}"
        message = f"{record.msg!r} cannot be worded: {type(error).__name__} ({where})"
    most = LONGEST - SUFFIX_LONGEST
    traceback = record.exc_text or (formatter.formatException(record.exc_info) if record.exc_info else "")
    return _Line(record.name, record.levelno, record.created, printable(message[:most])[:most], traceback)


class _Cause:
    """How much may still be told of one cause, and what was not."""

    __slots__ = ("budget", "left_out", "settles_s")

    def __init__(self) -> None:
        self.budget = _Budget(BURST, AGAIN_S)
        self.left_out = 0  # lines since the last that was told; the newest of them waits
        self.settles_s = 0.0  # when it may be told, monotonic


_Key = tuple[str, ...]


def _keys(record: logging.LogRecord) -> tuple[_Key, _Key, _Key]:
    """Return what *record* is about, then what stands for it where too much is known already: its wording; anything.

    Our lines begin with the name of what they are about ("field", "field/boiler", "10.0.0.5"), some go on with a unit
    or point; whatever else stands in them belongs to no cause, or each line would be one of its own.
    """
    wording = (record.name, _word(record.msg))
    about = getattr(record, "about", None)
    if about is not None:
        return ("", "about", _word(about)), wording, ()  # whichever module tells it
    args = record.args if isinstance(record.args, tuple) else ()
    named = [_word(arg) for arg in args[:1] if not isinstance(arg, int | float)]
    numbered = [str(arg) for arg in args[1:2] if named and isinstance(arg, int)]
    return (*wording, *named, *numbered), wording, ()


def _word(value: object) -> str:
    """Return *value* in words, or of what kind it is."""
    try:
        return str(value)[:CAUSE_LONGEST]
    except Exception:  # noqa: BLE001 - a bug in its own words; the line says so
        return type(value).__name__


# ------------------------------------------------------------------------------------------------ the limiter


class RateLimited(logging.Handler):
    """Hands on to *handlers* what is news, and of what repeats as much as is worth its place; see the module.

    Not limited: DEBUG (a person has asked for it), CRITICAL, and what says ``extra={"is_unlimited": True}``.
    """

    def __init__(self, clock: Clock, handlers: Sequence[logging.Handler]) -> None:
        super().__init__()
        self._clock = clock
        self._handlers = tuple(handlers)
        self._formatter = SafeFormatter()
        self._lock = threading.RLock()  # a finalizer may log in the thread that holds it
        self._causes: OrderedDict[_Key, _Cause] = OrderedDict()  # the one that was longest quiet is the first
        self._held: OrderedDict[_Cause, _Line] = OrderedDict()  # the newest line of each, in the order they happened
        self._all = _Budget(ALL_BURST, ALL_AGAIN_S)
        self._late = _Budget(LATE_BURST + CAUSES_MOST, LATE_AGAIN_S)  # what is kept is for the end of a storm
        self._held_s: deque[float] = deque(maxlen=STORM)  # when lines were held back
        self._telling: _Cause | None = None  # whose late line is being written: a newer one must not overtake it

    def handle(self, record: logging.LogRecord) -> bool:
        """As any handler, but without the lock in which logging would have us write."""
        is_wanted = bool(self.filter(record))
        if is_wanted:
            self.emit(record)
        return is_wanted

    def emit(self, record: logging.LogRecord) -> None:
        """Tell *record*, or hold it back."""
        try:
            told = record if _is_unlimited(record) else self._judged(_keys(record), _line_of(record, self._formatter))
        except Exception:  # noqa: BLE001 - as in logging's own handlers: whoever logs must not suffer
            self.handleError(record)
            return
        if told is not None:
            self._tell(told)

    def flush_due(self) -> float:
        """Tell late what was held back and has settled; return after how many seconds to come again.

        In the main thread only, as a chore: it tells a few lines at a time.
        """
        for _turn in range(LATE_AT_ONCE):
            record, wait_s = self._next_late()
            if record is None:
                return wait_s
            self._tell(record)
            self._telling = None
        return LATE_PAUSE_S

    def tell_rest(self) -> None:
        """The program ends: tell the newest of what waits, and how many lines are lost with the rest."""
        with self._lock:
            newest = list(self._held)[-REST_MOST:]
            records = [self._released(cause, self._held[cause], is_late=True) for cause in newest]
            lost = sum(cause.left_out for cause in self._held)
            self._held.clear()
        for record in records:
            self._tell(record)
        if lost:
            text = f"{lost} lines of the log were held back and are left out: the program ends"
            self._tell(logging.LogRecord(__name__, logging.WARNING, "", 0, text, None, None))

    def close(self) -> None:
        """Logging itself ends."""
        self.tell_rest()
        super().close()

    # -------------------------------------------------------------------------------------------- inside

    def _tell(self, record: logging.LogRecord) -> None:
        for handler in self._handlers:
            if record.levelno >= handler.level:
                try:
                    handler.handle(record)
                except Exception:  # noqa: BLE001 - what fails with one is still the others' to tell
                    self.handleError(record)

    def _judged(self, keys: Sequence[_Key], line: _Line) -> logging.LogRecord | None:
        """Return what to tell of *line* now; None: it is held back."""
        with self._lock:
            now_s = self._clock.monotonic()
            cause = self._cause(keys, now_s)
            if cause is self._telling or cause.budget.wait_s(now_s) or self._all.wait_s(now_s):
                cause.left_out += 1
                cause.settles_s = now_s + SETTLED_S
                self._held_s.append(now_s)
                self._held[cause] = line
                self._held.move_to_end(cause)
                return None
            cause.budget.spend(now_s)
            self._all.spend(now_s)
            return self._released(cause, line, is_late=False)

    def _cause(self, keys: Sequence[_Key], now_s: float) -> _Cause:
        """Return the first of *keys* that is known already, or can be from now on."""
        key = next(
            key
            for key, most in zip(keys, (CAUSES_MOST, CAUSES_MOST + WORDINGS_MOST, math.inf), strict=True)
            if key in self._causes or self._has_room(most, now_s)
        )
        cause = self._causes.get(key) or _Cause()
        self._causes[key] = cause
        self._causes.move_to_end(key)
        return cause

    def _has_room(self, most: float, now_s: float) -> bool:
        """Whether fewer than *most* causes are known; for that, one that gets its whole burst anew may be forgotten."""
        if len(self._causes) >= most:
            key, cause = next(iter(self._causes.items()))
            if cause.budget.full_s <= now_s and cause not in self._held:
                del self._causes[key]
        return len(self._causes) < most

    def _next_late(self) -> tuple[logging.LogRecord | None, float]:
        """Return the late line whose turn it is; or None, and how long it is nobody's."""
        with self._lock:
            if not self._held:
                return None, SETTLED_S
            now_s = self._clock.monotonic()
            cause, line = next(iter(self._held.items()))
            wait_s = max(cause.settles_s - now_s, self._late_wait_s(now_s))
            if wait_s > 0:
                return None, wait_s
            self._late.spend(now_s)
            cause.budget.spend(now_s)
            self._telling = cause
            return self._released(cause, line, is_late=True), 0.0

    def _late_wait_s(self, now_s: float) -> float:
        """Return how long no late line may be told: in a storm one a minute, after it all that wait."""
        storm_s = self._held_s[0] + STORM_S - now_s if len(self._held_s) == STORM else 0.0
        return min(self._late.wait_s(now_s, kept=CAUSES_MOST), max(self._late.wait_s(now_s), storm_s))

    def _released(self, cause: _Cause, line: _Line, is_late: bool) -> logging.LogRecord:
        """Return what to tell of *line*, which is the newest of *cause*: whatever else waits of it is old now."""
        self._held.pop(cause, None)
        left_out, cause.left_out = cause.left_out - is_late, 0
        remarks = [f"told late, this was at {moment(line.created)}"] if is_late else []
        if left_out:
            remarks.append(f"{left_out} more like it {'was' if left_out == 1 else 'were'} left out")
        return line.record(remarks, self._clock.wall() if is_late else line.created)


def _is_unlimited(record: logging.LogRecord) -> bool:
    if record.levelno <= logging.DEBUG or record.levelno >= logging.CRITICAL:
        return True
    return bool(getattr(record, "is_unlimited", False))
