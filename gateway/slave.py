"""The slave (server) on a serial line: requests to ``modbus/server.py``, and replies back (spec section 3).

It knows units, broadcasts and silences, and nothing of what a request means. On a shared pair of wires it hears
everything, and never speaks out of turn. TCP clients are served by ``slave_tcp``.

Threads: one for each ``[[slave]]``. ``wake`` and ``set_enabled`` may be called from any thread.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Never

from gateway.clock import Clock
from gateway.config import SlaveConfig
from gateway.counters import ServeCounters
from gateway.errors import LinkError
from gateway.link import Link, Waker, silence_s
from gateway.modbus.framing import Frame, request_framer
from gateway.modbus.pdu import BROADCAST
from gateway.modbus.server import answer
from gateway.opening import Opening, Start, at_once
from gateway.register import DataRegister
from gateway.serving import STATION_ALONE, Station, count_traffic, frames_in, server_of
from gateway.traffic import Tap

log = logging.getLogger(__name__)


class SerialSlave:
    """One ``[[slave]]`` on a serial line; a ``Task``."""

    def __init__(
        self,
        config: SlaveConfig,
        register: DataRegister,
        clock: Clock,
        waker: Waker,
        open_link: Callable[[], Link],
        wait_limit_s: float = 3.0,
        station: Station = STATION_ALONE,
        start: Start = at_once,
    ) -> None:
        """*open_link* opens the port or raises LinkError; *start* has that done, here or in another thread."""
        self.name = config.name
        self.config = config
        self.enabled = config.enabled
        self.ready = threading.Event()
        self.server = server_of(config, register, station)
        self.traffic = Tap(config.framing_used, clock, config.character_timeout_used, config.unit)
        self._clock = clock
        self._waker = waker
        self._wait_limit_s = wait_limit_s
        self._framer = request_framer(config.framing_used)
        self._link: Link | None = None
        self._opening = Opening(config.name, clock, open_link, waker, start)
        self._silence_s = 0.0
        self._heard_s = 0.0
        self._is_talk = False  # bytes came that silence has not ended yet

    @property
    def counters(self) -> ServeCounters:
        """What was asked and answered."""
        return self.server.counters

    @property
    def clients(self) -> dict[int, Never]:
        """TCP clients: there are none on a serial line."""
        return {}

    @property
    def trouble(self) -> str:
        """Why the line cannot be used, for people; "" while it can."""
        return self._opening.trouble

    def wake(self) -> None:
        """End any wait of this slave's thread."""
        self._waker.wake()

    def set_enabled(self, enabled: bool) -> None:
        """False: maintenance, everything is ignored."""
        self.enabled = enabled
        self.wake()

    def run(self, stop: threading.Event, alive: Callable[[], None]) -> None:
        """Answer until *stop*; *alive* is called whenever something has been got on with."""
        try:
            while not stop.is_set():
                if self.step():
                    alive()
        finally:
            self._let_go()
            self._opening.close()

    def step(self) -> bool:
        """Wait for bytes or for the end of a silence, and do what follows; False if there was nothing to do."""
        if not self.enabled:
            self.ready.set()
            self._let_go()
            self._waker.wait(self._wait_limit_s)
            return True
        if self._link is None:
            self._open()
            return True
        try:
            return self._listen(self._link)
        except LinkError as error:
            self._let_go()
            self._opening.failed(str(error))
            return True

    def _open(self) -> None:
        wait_s = self._opening.wait_s()
        if wait_s:
            self._waker.wait(min(wait_s, self._wait_limit_s))
            return
        self._link = self._opening.attempt(self.ready)
        if self._link is None:
            return
        self._silence_s = silence_s(self.config.baudrate, self._link.character_s)
        self._framer.reset()
        log.info("%s: listening on %s", self.name, self.config.line, extra={"about": self.name})

    def _let_go(self) -> None:
        if self._link is not None:
            self._link.close()
            self.traffic.ended()
        self._link, self._is_talk = None, False

    def _listen(self, link: Link) -> bool:
        """Return whether something came, a wake included, or the wait has run its time."""
        now_s, wakes = self._clock.monotonic(), self._waker.wakes
        due_s = self._due_s(now_s)
        wait_s = max(0.0, due_s - now_s)
        data = self._read(link, wait_s)
        if self._opening.trouble:
            self._opening.worked()  # a port that opens has to be read from once before it counts
        now_s = self._clock.monotonic()
        if data:
            self._heard_s, self._is_talk = now_s, True
            if self.config.framing_used == "ascii":
                self._read(link, 0.0)  # after a wait for the processor, what was read may be stale
                self._answer_burst(link)
        elif self._is_talk and now_s >= self._heard_s + self._silence_s:
            self._is_talk = False
            self._framer.silence()
            self._answer_burst(link)
        if self._framer.pending and now_s >= self._heard_s + self.config.character_timeout_used:
            self._framer.reset()
        self.counters.damaged = self._framer.damaged
        return bool(data) or self._waker.wakes > wakes or (wait_s > 0.0 and now_s >= due_s)

    def _read(self, link: Link, timeout_s: float) -> bytes:
        data = link.read(timeout_s)
        self._framer.receive_data(data)
        self.traffic.tell(False, data)
        return data

    def _due_s(self, now_s: float) -> float:
        if self._is_talk:
            return self._heard_s + self._silence_s
        limit_s = now_s + self._wait_limit_s
        if self._framer.pending:
            return min(limit_s, self._heard_s + self.config.character_timeout_used)
        return limit_s

    def _answer_burst(self, link: Link) -> None:
        """Answer the last frame that came, if it is for us: an earlier one is too late, others have spoken since."""
        frames = frames_in(self._framer)
        count_traffic(self.server, frames, 0)
        for place, frame in enumerate(frames):
            is_last = place == len(frames) - 1 and not self._framer.pending
            if frame.unit == BROADCAST:
                self.counters.broadcasts += 1
                answer(frame.pdu, self.server, broadcast=True)
            elif frame.unit != self.config.unit:
                self.counters.foreign += 1
            elif not is_last:
                self.counters.unanswered += 1
            elif reply := answer(frame.pdu, self.server):
                data = self._framer.encode(Frame(frame.unit, reply))
                link.write(data)
                self.traffic.tell(True, data)
