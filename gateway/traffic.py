"""What a line sends and hears, for a person who watches it: the menu's traffic view (spec sections 4 and 5).

The line's thread only hands its bytes to a ``Tap``; while nobody watches that costs it the look at one attribute, and
while somebody does, it never waits: what finds no room is dropped and counted. Decoding is done by whoever watches. All
that was said is shown, also what the drivers reject, with the reason where it can be told.

On a shared pair of wires others' requests and replies are heard alike. Most differ in length; of those that do not
(functions 5 and 6, most of all) the second of two is taken for the reply: a request repeated because nobody answered
looks like one, too.

Threads: ``tell`` and ``ended`` belong to the line's; ``watch``, its undo and ``take`` to any. The lock is a leaf, and
the line's thread never takes it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from typing import Final, NamedTuple

from gateway.clock import Clock
from gateway.modbus.describe import describe_reply, describe_request
from gateway.modbus.framing import Frame, Framing
from gateway.modbus.pdu import BROADCAST, EXCEPTION_BIT, REPLY_SHAPES, pdu_length
from gateway.modbus.pieces import BOTH, CUTTERS, REPLIES, REQUESTS, Piece
from gateway.plain_text import cut

CHUNKS_MAX: Final = 500  # told and not taken yet
BYTES_MAX: Final = 32768  # the same, in bytes
REST_MAX: Final = 1024  # bytes of one side that do not become a frame
OWN_TCP_UNITS: Final = (0, 255)  # on Modbus TCP: "this gateway"


@dataclass(frozen=True, slots=True)
class Seen:
    """One frame, or bytes that are none.

    when:   wall time in seconds, of its first byte.
    sent:   by us; else heard.
    client: whose connection, on a slave on TCP; else "".
    text:   in words.
    """

    when: float
    sent: bool
    client: str
    text: str
    raw: bytes

    def line(self, columns: int) -> str:
        """Return local time, direction, words and bytes, at most *columns* characters of plain ASCII."""
        time = f"{datetime.fromtimestamp(self.when):%H:%M:%S.%f}"[:-3]
        who = f"{self.client} " if self.client else ""
        return cut(f"{time} {'>' if self.sent else '<'} {who}{self.text}  | {self._shown}", columns)

    @property
    def _shown(self) -> str:
        """The bytes: an ASCII frame as it stands, all else in hexadecimal."""
        text = self.raw.removesuffix(b"\r\n")
        is_text = text[:1] == b":" and len(text) > 1 and all(32 <= byte < 127 for byte in text)
        return text.decode("ascii") if is_text else self.raw.hex(" ").upper()


class _Chunk(NamedTuple):
    """What was told at once. *lost*: how much had been dropped by then; no *data*: the connection has ended."""

    when_s: float
    sent: bool
    client: str
    data: bytes
    lost: int


class Tap:
    """The traffic of one line, or of all clients of a slave on TCP."""

    def __init__(self, framing: Framing, clock: Clock, gap_s: float, unit: int | None = None) -> None:
        """*gap_s*: a silence that ends a frame, whole or not; *unit*: of a slave, its own; of a master, None."""
        self.is_watched = False
        self.dropped = 0  # since somebody began to watch: pieces that found no room
        self._clock = clock
        self._make_ear = partial(_Ear, framing, gap_s, unit)
        self._ear = self._make_ear()
        self._chunks: deque[_Chunk] = deque()
        self._told_bytes = 0  # written by the line's thread alone
        self._taken_bytes = 0  # written by the watcher's
        self._is_woken = False
        self._wakes: tuple[Callable[[], None], ...] = ()
        self._lock = threading.Lock()

    # -------------------------------------------------------------------------------------------- the line's thread

    def tell(self, sent: bool, data: bytes, client: str = "") -> None:
        """Hand over what was sent or heard; never waits."""
        if self.is_watched and data:
            self._keep(sent, data, client)

    def ended(self, client: str = "") -> None:
        """Say that the line or connection is closed: what comes next is no part of what came last."""
        if self.is_watched:
            self._keep(False, b"", client)

    def _keep(self, sent: bool, data: bytes, client: str) -> None:
        held = self._told_bytes - self._taken_bytes
        if len(self._chunks) >= CHUNKS_MAX or held + len(data) > BYTES_MAX:
            self.dropped += 1
            return
        self._told_bytes += len(data)
        self._chunks.append(_Chunk(self._clock.monotonic(), sent, client, data, self.dropped))
        if not self._is_woken:
            self._is_woken = True
            for wake in self._wakes:
                wake()

    # -------------------------------------------------------------------------------------------- who watches

    def watch(self, wake: Callable[[], None] | None = None) -> Callable[[], None]:
        """Begin to watch; return what ends it.

        wake: called from the line's thread when there is something to take, once until it is taken; it must only
              wake. What is not whole yet is given when it is, or when it is over: look again after a second anyhow.
        Two who watch at the same time share what there is.
        """

        def mine() -> None:
            if wake is not None:
                wake()

        with self._lock:
            if not self._wakes:
                self._drain()
                self._ear, self.dropped, self._is_woken = self._make_ear(), 0, False
            self._wakes += (mine,)
            self.is_watched = True

        def undo() -> None:
            with self._lock:
                self._wakes = tuple(each for each in self._wakes if each is not mine)
                self.is_watched = bool(self._wakes)
                if not self.is_watched:
                    self._drain()

        return undo

    def take(self) -> list[Seen]:
        """Return what has been seen since the last time, oldest first."""
        with self._lock:
            self._is_woken = False
            now_s = self._clock.monotonic()
            seen = [one for chunk in self._drain() for one in self._ear.hear(chunk)]
            seen += self._ear.settle(now_s)
            wall_s = self._clock.wall() - now_s
        return [replace(one, when=wall_s + one.when) for one in seen]

    def _drain(self) -> list[_Chunk]:
        """Take out what is there now, and no more: the line may go on telling for ever."""
        chunks = [self._chunks.popleft() for _ in range(len(self._chunks))]
        self._taken_bytes += sum(len(chunk.data) for chunk in chunks)
        return chunks


# ------------------------------------------------------------------------------------------------ decoding


@dataclass
class _Side:
    """What one side has said that is not cut yet."""

    held: bytes = b""
    since_s: float = 0.0  # when its first byte came
    last_s: float = 0.0  # when its last byte came


@dataclass
class _Talk:
    """What passes between us and one other: the whole line, or one client of a slave on TCP."""

    ours: _Side = field(default_factory=_Side)
    theirs: _Side = field(default_factory=_Side)
    asked: Frame | None = None  # the last request, while it is not answered
    is_known: bool = False  # whether anything was asked: not yet when somebody begins to watch

    def side(self, sent: bool) -> _Side:
        return self.ours if sent else self.theirs


class _Ear:
    """Makes frames and words of chunks. What it has ``Seen`` it tells by the monotonic clock."""

    def __init__(self, framing: Framing, gap_s: float, unit: int | None) -> None:
        self._cut = CUTTERS[framing]
        self._is_tcp = framing == "tcp"
        self._gap_s = gap_s
        self._unit = unit
        self._shapes = {True: REQUESTS if unit is None else REPLIES, False: BOTH}  # who hears may hear an echo
        self._lost = 0
        self._talks: dict[str, _Talk] = {}

    def hear(self, chunk: _Chunk) -> list[Seen]:
        """Return what *chunk* makes whole, or brings to an end."""
        seen: list[Seen] = []
        if chunk.lost != self._lost:  # who knows what is missing
            self._lost = chunk.lost
            for client in list(self._talks):
                seen += self._end(client)
        if not chunk.data:
            return seen + self._end(chunk.client)
        talk = self._talks.setdefault(chunk.client, _Talk())
        side = talk.side(chunk.sent)
        if not self._is_tcp:  # on a pair of wires one speaks at a time
            seen += self._take(chunk.client, not chunk.sent, is_over=True)
            if chunk.when_s - side.last_s >= self._gap_s:
                seen += self._take(chunk.client, chunk.sent, is_over=True)
        if not side.held:
            side.since_s = chunk.when_s
        side.held += chunk.data
        side.last_s = chunk.when_s
        seen += self._take(chunk.client, chunk.sent, is_over=False)
        if len(side.held) > REST_MAX:
            seen += self._take(chunk.client, chunk.sent, is_over=True)
        return seen

    def settle(self, now_s: float) -> list[Seen]:
        """Return what a silence has brought to an end."""
        seen: list[Seen] = []
        for client, talk in self._talks.items():
            for sent in (True, False):
                if not self._is_tcp and now_s - talk.side(sent).last_s >= self._gap_s:
                    seen += self._take(client, sent, is_over=True)
        return seen

    def _end(self, client: str) -> list[Seen]:
        """The connection has ended: so has all that was said on it."""
        if client not in self._talks:
            return []
        seen = self._take(client, True, is_over=True) + self._take(client, False, is_over=True)
        del self._talks[client]
        return seen

    def _take(self, client: str, sent: bool, is_over: bool) -> list[Seen]:
        talk = self._talks[client]
        side = talk.side(sent)
        seen: list[Seen] = []
        for piece in self._cut(side.held, self._shapes[sent], is_over):
            seen.append(Seen(side.since_s, sent, client, self._text(talk, sent, piece), piece.raw))
            side.since_s = side.last_s  # what follows in the same chunk came with its end
        side.held = side.held[sum(len(one.raw) for one in seen) :]
        return seen

    # -------------------------------------------------------------------------------------------- words

    def _text(self, talk: _Talk, sent: bool, piece: Piece) -> str:
        frame = piece.frame
        if frame is None:
            return f"{len(piece.raw)} byte{'s' * (len(piece.raw) != 1)}, {piece.reason}"
        if self._unit is not None:
            words = self._slave_words(talk, sent, frame, self._unit)
        elif sent:
            talk.asked, talk.is_known, words = frame, True, describe_request(frame.pdu)
        else:
            words = self._reply_words(talk, frame)
        return f"unit {frame.unit}: {words}"

    def _reply_words(self, talk: _Talk, frame: Frame) -> str:
        """What a master has heard."""
        asked, words = talk.asked, describe_reply(frame.pdu)
        if frame == asked and len(frame.pdu) != pdu_length(REPLY_SHAPES, frame.pdu):
            return f"{describe_request(frame.pdu)}, our own echo"
        if not talk.is_known:
            return words
        if asked is None or not self._is_answer(asked, frame):
            return f"{words}, not asked for"
        talk.asked = None
        return words

    def _is_answer(self, asked: Frame, frame: Frame) -> bool:
        is_of_unit = frame.unit == asked.unit and frame.pdu[0] & ~EXCEPTION_BIT == asked.pdu[0]
        return is_of_unit and frame.transaction == asked.transaction

    def _slave_words(self, talk: _Talk, sent: bool, frame: Frame, unit: int) -> str:
        """What a slave has sent; or heard, where others may be asked and answer."""
        is_ours = frame.unit in ((unit, *OWN_TCP_UNITS) if self._is_tcp else (unit, BROADCAST))
        if sent or self._is_reply(talk, frame, is_ours):
            talk.asked = None
            return describe_reply(frame.pdu) + ("" if sent or not is_ours else ", another of our unit, or our echo")
        talk.asked = frame
        return describe_request(frame.pdu) + ("" if is_ours else ", not for us")

    def _is_reply(self, talk: _Talk, frame: Frame, is_ours: bool) -> bool:
        if self._is_tcp:
            return False
        can_ask, can_answer = (len(frame.pdu) == pdu_length(shapes, frame.pdu) for shapes in BOTH)
        if can_ask and can_answer:
            asked = talk.asked
            return not is_ours and asked is not None and self._is_answer(asked, frame)
        return can_answer
