"""Values that survive a restart: the file they are in, and the task that writes it (spec section 6, ``retain``).

The file, behind the line that seals it (``snapshots``): a header with the number of this format and the wall time of
the save; then blocks of points that are alike, each with its values, their age at the time of the save, and whether
they were ever a command. Points that nobody has written are not in it, nor are zeros that stand for a failed poll. What
is damaged or not understood is never trusted, not even in part.

Ages: while the program runs they are measured by the monotonic clock; only how long it did not run is told by the wall
clock, where that can be (``age_after``). A value that is written again unchanged wears no flash: after a restart its
age may be told as more than it is.

Flash: one write a minute at most, and one at the end; none in the first minute, so that a program that crashes again
and again writes nothing; none while the values are what the file says. A power cut costs the changes of a minute.

What it refuses: choosing the tables and the points that are left out (``wiring``).

Threads: ``restore`` and ``forget`` belong to the main thread, while no task runs; the ``Retainer`` has one of its own.
Whatever waits for the disk is done in yet another: a card that takes its time must not look like a thread that hangs.
The watcher runs in the threads that write the register, and only leaves a mark.
"""

from __future__ import annotations

import contextlib
import logging
import math
import struct
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Final

from gateway import files
from gateway.clock import Clock
from gateway.errors import SaveError
from gateway.link import Waker
from gateway.modbus.pdu import Span, Table
from gateway.register import COMMANDED, NEVER_S, SIZE_MAX, STAND_IN, DataRegister, Kept, Written, age_s_of
from gateway.snapshots import sealed, unsealed

FILE_NAME: Final = "retained.bin"
TASK_NAME: Final = "retained values"  # no line can be called that
EVERY_S: Final = 60.0
LOOK_EVERY_S: Final = 3.0
ANSWER_LIMIT_S: Final = 60.0  # of the disk, then it is an alarm (spec section 7)
STOP_LIMIT_S: Final = 1.5  # for the last write; a clean stop takes under 2 s (spec section 7)
FORGET_LIMIT_S: Final = 0.5  # the main thread has others to look after

MAGIC: Final = b"rtugate values\0\1"  # the last byte: number of the format
HEADER: Final = struct.Struct(">QI")  # wall time of the save in whole seconds since 1970; number of blocks
BLOCK: Final = struct.Struct(">BHII?")  # table, first point, points, age in seconds, were they a command; then values
AGE_UNKNOWN: Final = 0xFFFFFFFF
LARGEST_FILE: Final = 4 * SIZE_MAX * (BLOCK.size + 2) + 4096  # each point a block
CLOCK_SET_S: Final = 1_577_836_800  # 2020: a clock that stands before was never set

log = logging.getLogger(__name__)

Values = list[tuple[Table, int, bool, bytearray]]
Points = dict[Table, frozenset[int]]


# ------------------------------------------------------------------------------------------------ the format


@dataclass(frozen=True)
class Snapshot:
    """What was known at the wall time *saved_s*, in whole seconds since 1970."""

    saved_s: int
    blocks: list[Kept]


def encode(snapshot: Snapshot) -> bytes:
    """Return the file of *snapshot*; ages are rounded up to whole seconds."""
    parts = [MAGIC, HEADER.pack(snapshot.saved_s, len(snapshot.blocks))]
    for block in snapshot.blocks:
        age_s = AGE_UNKNOWN if block.age_s is None else min(math.ceil(max(0.0, block.age_s)), AGE_UNKNOWN)
        span = block.span
        parts += [BLOCK.pack(span.table, span.start, span.count, age_s, block.is_commanded), block.values]
    return sealed(b"".join(parts))


def decode(content: bytes) -> Snapshot:
    """Return what ``encode`` was given; raises SaveError if that is not certain."""
    body = unsealed(content)
    if body is None:
        raise SaveError("its checksum does not fit")
    if body[: len(MAGIC)] != MAGIC:
        raise SaveError("it is not of this version of rtugate")
    try:
        saved_s, count = HEADER.unpack_from(body, len(MAGIC))
        blocks = list(_blocks(body, len(MAGIC) + HEADER.size))
    except (struct.error, ValueError) as error:
        raise SaveError("it makes no sense") from error
    if count != len(blocks):
        raise SaveError("it makes no sense")
    return Snapshot(saved_s, blocks)


def _blocks(body: bytes, at: int) -> Iterator[Kept]:
    """The blocks of *body* from *at* on; raises struct.error or ValueError if they are none."""
    while at < len(body):
        number, start, count, age_s, is_commanded = BLOCK.unpack_from(body, at)
        table = Table(number)
        at += BLOCK.size
        values = body[at : at + count * (1 if table.is_bits else 2)]
        at += count * (1 if table.is_bits else 2)
        if not count or at > len(body) or start + count > SIZE_MAX or (table.is_bits and values.strip(b"01")):
            raise ValueError(number, start, count)
        yield Kept(Span(table, start, count), values, None if age_s == AGE_UNKNOWN else age_s, is_commanded)


def age_after(age_s: float | None, saved_s: float, now_s: float) -> float | None:
    """Return the age at the wall time *now_s* of what was *age_s* old at *saved_s*; None: nobody knows.

    Boards have no clock of their own: one that stands before 2020 was never set, and one that stands before the save
    was set back. Neither says how long the power was off.
    """
    if age_s is None or saved_s < CLOCK_SET_S or now_s < saved_s:
        return None
    return age_s + now_s - saved_s


def kept(register: DataRegister, table: Table, without: Iterable[int], now_s: float) -> list[Kept]:
    """Return what is known of *table*, but for the points *without*, in blocks of points that are alike.

    now_s: monotonic, for the ages.
    """
    points = register.copy_of_known(table)
    for point in without:
        if point < points.size:
            points.time_s[point] = NEVER_S
    found, start = [], 0
    for (time_s, mark), alike in groupby(zip(points.time_s, points.commanded, strict=True)):
        count = len(list(alike))
        if time_s > NEVER_S and mark != STAND_IN:
            values = bytes(points.values[start * points.width : (start + count) * points.width])
            found.append(Kept(Span(table, start, count), values, age_s_of(time_s, now_s), mark == COMMANDED))
        start += count
    return found


def without_ages(blocks: Sequence[Kept]) -> Values:
    """Return what *blocks* say but for the ages: the same, however those have cut them."""
    found: Values = []
    stop = 0
    for block in blocks:
        span = block.span
        if found and stop == span.start and (found[-1][0], found[-1][2]) == (span.table, block.is_commanded):
            found[-1][3].extend(block.values)
        else:
            found.append((span.table, span.start, block.is_commanded, bytearray(block.values)))
        stop = span.stop
    return found


# ------------------------------------------------------------------------------------------------ the file


class RetainedFile:
    """The file, and what it says. *said*: its values, None where that is not known; *trouble*: for people, or ""."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.said: Values | None = []
        self.trouble = ""
        self._turn = threading.Lock()  # a write that the disk holds up must not come after a newer one

    def restore(self, register: DataRegister, clock: Clock, tables: Sequence[Table]) -> None:
        """Bring the values of *tables* back; where the file cannot be used, say so and bring back none."""
        try:
            snapshot = self._read()
        except SaveError as error:
            self.trouble = f"{self.path.name} is not used: {error}"
            log.error("%s: %s; the values from before the restart are lost", TASK_NAME, self.trouble)
            self.said = None
            return
        now_s = clock.wall()
        blocks = [block for block in snapshot.blocks if block.span.table in tables]
        register.restore([replace(b, age_s=age_after(b.age_s, snapshot.saved_s, now_s)) for b in blocks])
        self.said = without_ages(snapshot.blocks)
        log.info("%s: %d points are back", TASK_NAME, sum(block.span.count for block in blocks))

    def forget(self) -> None:
        """Nothing is to be retained: should that change one day, nothing old is to come back then."""
        self.said = []
        is_done = threading.Event()

        def work() -> None:
            try:
                self._remove()
            finally:
                is_done.set()

        in_thread(work)
        if not is_done.wait(FORGET_LIMIT_S):
            log.warning("%s: %s is still there: the disk does not answer", TASK_NAME, self.path.name)

    def write(self, content: bytes) -> None:
        """Replace what there is, after any other write has come to its end; raises SaveError."""
        with self._turn:
            try:
                self.path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
            except OSError as error:
                raise SaveError(f"{self.path.name} is not saved: {files.in_words(error, self.path)}") from error
            files.write_atomically(self.path, content)

    def _remove(self) -> None:
        with self._turn, contextlib.suppress(PermissionError):  # what we cannot see, we could not read then either
            try:
                if self.path.exists():
                    files.remove_durably(self.path)
            except SaveError as error:
                log.warning("%s: %s", TASK_NAME, error)

    def _read(self) -> Snapshot:
        """Raises SaveError; where there is no file there are no values."""
        try:
            content = files.read_start(self.path, LARGEST_FILE + 1)
        except FileNotFoundError:
            return Snapshot(0, [])
        except OSError as error:
            raise SaveError(files.in_words(error, self.path)) from error
        if content is None:
            raise SaveError("it is not a regular file")
        return decode(content)


# ------------------------------------------------------------------------------------------------ the task


@dataclass
class _Writing:
    """One write on its way: *values* without their ages, since when, and what becomes of it.

    is_given_up: it has taken too long, and the end does not wait for it.
    """

    values: Values
    began_s: float
    problem: str = "it failed; the log says why"
    done: threading.Event = field(default_factory=threading.Event)
    is_given_up: bool = False


def in_thread(work: Callable[[], None]) -> None:
    """Have *work* done in a thread that nobody waits for longer than he wants to."""
    threading.Thread(target=work, name=TASK_NAME, daemon=True).start()


class Retainer:
    """Writes the values of *points* into *file* when they have changed; a ``Task``."""

    def __init__(
        self,
        file: RetainedFile,
        register: DataRegister,
        points: Points,
        clock: Clock,
        waker: Waker,
        wait_limit_s: float = LOOK_EVERY_S,
        start: Callable[[Callable[[], None]], None] = in_thread,
    ) -> None:
        """*points*: of each table to retain those that are left out. *start*: has a write done elsewhere."""
        self.name = TASK_NAME
        self.ready = threading.Event()
        self._file = file
        self._register = register
        self._points = points
        self._clock = clock
        self._waker = waker
        self._wait_limit_s = min(wait_limit_s, LOOK_EVERY_S)
        self._start = start
        self._due_s = clock.monotonic() + EVERY_S
        self._is_touched = True  # something was written since the last look at all values
        self._writing: _Writing | None = None
        self._unwatch = register.watch(self._written)

    @property
    def trouble(self) -> str:
        """Why values would be lost; "" while all is well."""
        return self._file.trouble

    def wake(self) -> None:
        """End any wait of this task's thread."""
        self._waker.wake()

    def set_enabled(self, enabled: bool) -> None:
        """It is never in maintenance."""

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        """Keep the file up to date until *stop*, and once more then."""
        self.ready.set()
        try:
            while not stop.is_set():
                alive()
                self.step()
        finally:
            self._unwatch()
            self.save_last()

    def step(self) -> None:
        """Begin a write if there is need and time for one, see how it goes, and wait."""
        now_s = self._clock.monotonic()
        if self._writing is None and self._is_touched and now_s >= self._due_s:
            self._begin()
        elif self._writing is not None and now_s - self._writing.began_s >= ANSWER_LIMIT_S:
            self._give_up(self._writing)
        self._settle()
        is_soon = self._writing is None and self._is_touched
        due_s = self._due_s - self._clock.monotonic() if is_soon else self._wait_limit_s
        self._waker.wait(max(0.0, min(due_s, self._wait_limit_s)))

    def save_last(self) -> None:
        """Write what is not written yet, and see to its end; by whoever is the last to know of the register.

        It takes STOP_LIMIT_S at most, and no time at all once the disk has not answered.
        """
        until_s = self._clock.monotonic() + STOP_LIMIT_S
        if self._is_written(until_s) and self._begin():
            self._is_written(until_s)

    def _is_written(self, until_s: float) -> bool:
        """Wait for a write on its way; False if it does not come to an end."""
        writing = self._writing
        if writing is not None and not writing.is_given_up:
            writing.done.wait(max(0.0, until_s - self._clock.monotonic()))
        self._settle()
        if self._writing is not None:
            self._give_up(self._writing)
        return self._writing is None

    def _give_up(self, writing: _Writing) -> None:
        """Say that *writing* takes too long; should it end nevertheless, that is taken note of."""
        writing.is_given_up = True
        self._tell(f"{self._file.path.name} is not saved: the disk does not answer")

    def _written(self, written: Written) -> None:
        if written.span.table in self._points:
            self._is_touched = True

    def _begin(self) -> bool:
        """Have the values written, unless they are what the file says; return whether they are."""
        self._is_touched = False  # before the look: what is written from here on is seen again
        now_s, saved_s = self._clock.monotonic(), max(0, int(self._clock.wall()))
        self._due_s = now_s + EVERY_S
        tables = self._points.items()
        blocks = [block for table, without in tables for block in kept(self._register, table, without, now_s)]
        values = without_ages(blocks)
        if values == self._file.said:
            return False
        writing = self._writing = _Writing(values, now_s)

        def work() -> None:
            try:
                self._file.write(encode(Snapshot(saved_s, blocks)))
                writing.problem = ""
            except SaveError as error:
                writing.problem = str(error)
            finally:
                writing.done.set()
                self._waker.wake()

        self._start(work)
        return True

    def _settle(self) -> None:
        """Take note of a write that has come to its end."""
        writing = self._writing
        if writing is None or not writing.done.is_set():
            return
        self._writing = None
        if writing.problem:
            self._is_touched = True
            self._file.said = None  # it may be the old file or, after a failed flush, the new one
        else:
            self._file.said = writing.values
        self._tell(writing.problem)

    def _tell(self, problem: str) -> None:
        """Log what has changed, once."""
        if problem and problem != self._file.trouble:
            log.error("%s: %s", self.name, problem, extra={"about": self.name})
        elif not problem and self._file.trouble:
            log.warning("%s: saved again", self.name, extra={"about": self.name})
        self._file.trouble = problem
