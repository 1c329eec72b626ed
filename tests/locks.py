"""A lock for tests of races: what another thread might do just before the lock is got, it certainly does."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable


class LateLock:
    """A lock that is got late: each time it is asked for, the first of *meanwhile* is done before it is taken."""

    def __init__(self, *meanwhile: Callable[[], None]) -> None:
        self._lock = threading.Lock()
        self._meanwhile = deque(meanwhile)

    def __enter__(self) -> None:
        if self._meanwhile:
            self._meanwhile.popleft()()
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()
