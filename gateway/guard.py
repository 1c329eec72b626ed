"""What proves to the world that the gateway is alive, and what is done when it is not (spec section 7).

Each tick, after the flags were looked at: the backstop is armed anew, the hardware watchdog is fed, systemd is told. A
task that hangs: its name and all stacks are logged, the cause is kept, nothing is fed any more, and the process ends.
If nothing starts it again, the hardware resets the machine.

What it refuses: deciding what hangs (``supervisor``), and what a device or systemd is like (``watchdog``, ``systemd``).
Threads: the main one, but for what says so.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NoReturn

from gateway.clock import Clock
from gateway.config import WatchdogConfig
from gateway.hmi.station import Told
from gateway.hmi.wording import N_
from gateway.restart_cause import LastRun
from gateway.stacks import Backstop, stack_lines
from gateway.supervisor import STOP_LIMIT_S, Supervisor
from gateway.systemd import Systemd
from gateway.watchdog import WatchdogDevice

HUNG_EXIT: Final = 1
SLOW_STOP_S: Final = 60.0  # what is saved at the end may take as long on a slow card
LONG_S: Final = 3600.0

log = logging.getLogger(__name__)


class Guard:
    """The watch over one supervisor."""

    def __init__(
        self,
        supervisor: Supervisor,
        clock: Clock,
        last_run: LastRun,
        backstop: Backstop,
        systemd: Systemd,
        is_restart: Callable[[], bool] = bool,
        leave: Callable[[int], NoReturn] = os._exit,
    ) -> None:
        """*is_restart*: whether a stop is one, in which the program takes its own place; *leave* ends it at once."""
        self.systemd = systemd
        self.status: Callable[[], str] = str  # a line for systemd
        self.has_reset: Callable[[Told], None] = lambda cause: None  # noqa: ARG005 - told why the gateway was started
        self._supervisor = supervisor
        self._clock = clock
        self._last_run = last_run
        self._backstop = backstop
        self._is_restart = is_restart
        self._leave = leave
        self._settings: tuple[str, int] = ("", 0)
        self._device: WatchdogDevice | None = None
        self._is_fed = self._is_ready = self._is_over = self._has_told_reset = False
        supervisor.hung = self.hung
        supervisor.before_stops = self._before_stops
        supervisor.chores.append(self.tick)

    def configure(self, config: WatchdogConfig) -> None:
        """Go by *config* from now on; a device that was used until now, and is not any more, is stopped."""
        self._supervisor.timeout_s = config.timeout
        settings = (config.device, config.device_timeout)
        if settings == self._settings:
            return
        if self._device is not None:
            self._device.close(clean=True)
        self._settings, self._is_fed = settings, False
        path, timeout_s = settings
        self._device = WatchdogDevice(Path(path), timeout_s, self._clock) if path else None

    def tick(self) -> float:
        """Show that all is well; return after how long to do so again."""
        if self._is_over:
            return LONG_S
        self._backstop.name_threads()
        self._backstop.arm(self._supervisor.timeout_s)
        if self._device is not None and self._supervisor.are_flags_up:
            self._feed(self._device)
        if not self._is_ready and self._supervisor.are_ready:
            self._is_ready = True
            self.systemd.ready()
        self.systemd.status(self.status())  # also where nobody listens: who looks for alarms has slow work logged
        return self.systemd.feed()

    def _feed(self, device: WatchdogDevice) -> None:
        device.feed()
        self._is_fed = True
        if device.reset_machine and not self._has_told_reset:
            self._has_told_reset = True
            self.has_reset(self._last_run.reset_by_watchdog())

    def hung(self, names: Sequence[str]) -> None:
        """End the process because the tasks of these *names* hang."""
        self._is_over = True
        self._last_run.hung(names, lambda: self._tell_hang(names))
        self._leave(HUNG_EXIT)

    def _tell_hang(self, names: Sequence[str]) -> None:
        timeout_s = self._supervisor.timeout_s
        log.critical("%s: got on with nothing for %g s: ending the process", ", ".join(names), timeout_s)
        for line in stack_lines(names):
            log.critical("%s", line)

    def did_not_stop(self) -> None:
        """End the process because tasks have not stopped in time."""
        self.hung(self._supervisor.leaving)

    def close(self) -> None:
        """All tasks have ended as they should: whoever watches is told that this is no hang."""
        self._is_over = True
        if self._device is not None:
            self._device.close(clean=True)
        self._backstop.close()
        self.systemd.close()

    def _before_stops(self) -> None:
        """Tasks are stopped now, and nothing else is done meanwhile. A restart is no end, as systemd sees it."""
        if not self._supervisor.is_stopping:
            self._backstop.arm(self._supervisor.timeout_s + STOP_LIMIT_S)
            return
        self._backstop.arm(SLOW_STOP_S + STOP_LIMIT_S)
        if self._is_restart():
            self.systemd.reloading()
        else:
            self.systemd.stopping()

    # -------------------------------------------------------------------------------------------- from any thread

    def alarms(self) -> list[Told]:
        """Return what is wrong with the device, and which tasks end by themselves."""
        device = self._device
        trouble = device.trouble if device is not None else ""
        found = [Told(N_("hardware watchdog: {trouble}"), {"trouble": trouble})] if trouble else []
        text = N_("{name}: ends with errors, {count} so far; made anew each time")
        return found + [Told(text, {"name": name, "count": n}) for name, n in self._supervisor.crashes.items()]

    def device_state(self) -> Told | None:
        """Return how the hardware watchdog fares; None if there is to be none."""
        device, path = self._device, self._settings[0]
        if device is None:
            return None
        if device.trouble:
            return Told(N_("{name}: {trouble}"), {"name": path, "trouble": device.trouble.removeprefix(f"{path}: ")})
        if not self._is_fed:
            return Told(N_("{device}: not opened yet; that comes when all lines have begun"), {"device": path})
        text = N_("{device}: well; without us it resets the machine after {seconds} s")
        return Told(text, {"device": path, "seconds": f"{device.counts_s:.0f}"})
