"""Who may use the menu: the password, and who is locked out after wrong ones (spec section 5, "Access").

Pure but for hashing and chance. Only a scrypt hash of the password is stored, and a stored text that would cost more
memory or time than the machine has is no hash. Hashing takes a good part of a second and 16 MiB: whoever calls it sees
to it that it happens one at a time, and in no thread that others wait for.

Source: RFC 7914 (scrypt); RFC 8265, section 4.2 (letters of a password in one form, NFC).
Threads: the functions may be called by any; ``Lockout`` has one lock, a leaf.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import threading
import unicodedata
from dataclasses import dataclass
from typing import Final

from gateway.clock import Clock
from gateway.hmi.wording import N_

PASSWORD_MIN, PASSWORD_MAX = 8, 64  # characters

SCRYPT_N, SCRYPT_R, SCRYPT_P = 2**14, 8, 5
SALT_SIZE, HASH_SIZE = 16, 32  # bytes
R_MAX, P_MAX = 16, 10
WORK_MAX: Final = 2**20  # N x r x p: 1.6 times our own time, and with p = 1 at most 128 MiB

FAILURES_MAX: Final = 5  # in a row; with the last one the address is locked out
LOCKED_S: Final = 300.0
REMEMBERED_S: Final = 900.0  # a failure counts that long
DELAY_FIRST_S, DELAY_MOST_S = 1.0, 8.0
ADDRESSES_MAX: Final = 1000

_STORED: Final = re.compile(
    rf"scrypt\$([1-9][0-9]{{0,6}})\$([1-9][0-9]?)\$([1-9][0-9]?)"
    rf"\$([0-9a-fA-F]{{{2 * SALT_SIZE}}})\$([0-9a-fA-F]{{{2 * HASH_SIZE}}})"
)


@dataclass(frozen=True, slots=True)
class _StoredHash:
    """What is stored of a password: scrypt's parameters (RFC 7914, section 2), 16 bytes of salt, 32 of hash."""

    n: int
    r: int
    p: int
    salt: bytes
    digest: bytes


def hash_password(text: str) -> str:
    """Return what to store of the password *text*: ``scrypt$16384$8$5$SALT$HASH``, both in hexadecimal."""
    salt = secrets.token_bytes(SALT_SIZE)
    digest = _scrypt(text, salt, SCRYPT_N, SCRYPT_R, SCRYPT_P)
    return f"scrypt${SCRYPT_N}${SCRYPT_R}${SCRYPT_P}${salt.hex()}${digest.hex()}"


def check_password(text: str, stored: str) -> bool:
    """Return whether *text* is the password of which *stored* is kept; False if that is no hash of ours."""
    found = _parsed(stored)
    if found is None:
        return False
    return hmac.compare_digest(_scrypt(text, found.salt, found.n, found.r, found.p), found.digest)


def is_hash(stored: str) -> bool:
    """Return whether *stored* can be checked against: of the right form, and not too costly."""
    return _parsed(stored) is not None


def password_problem(text: str) -> str | None:
    """Return what is wrong with *text* as a new password, in English, to be translated; None if nothing is."""
    if len(text) < PASSWORD_MIN:
        return N_("a password has at least 8 characters")
    if len(text) > PASSWORD_MAX:
        return N_("a password has at most 64 characters")
    if not text.isprintable():  # it could not be typed
        return N_("a password has only characters that can be typed and shown")
    return None


def _parsed(stored: str) -> _StoredHash | None:
    found = _STORED.fullmatch(stored)
    if found is None:
        return None
    n, r, p = int(found[1]), int(found[2]), int(found[3])
    is_power_of_two = n > 1 and n & (n - 1) == 0
    if not is_power_of_two or n >= 1 << 16 * r:  # RFC 7914, section 2
        return None
    if r > R_MAX or p > P_MAX or n * r * p > WORK_MAX:
        return None
    return _StoredHash(n, r, p, bytes.fromhex(found[4]), bytes.fromhex(found[5]))


def _scrypt(text: str, salt: bytes, n: int, r: int, p: int) -> bytes:
    memory = 128 * r * (n + p + 2)  # what OpenSSL counts: its table of N + 2 blocks, and one block for each p
    data = unicodedata.normalize("NFC", text).encode("utf-8", "surrogatepass")  # one letter, however it was typed
    return hashlib.scrypt(data, salt=salt, n=n, r=r, p=p, maxmem=memory, dklen=HASH_SIZE)


# ------------------------------------------------------------------------------------------------ who is locked out


class Lockout:
    """Failures of each address (or of "serial", or a module): how long an answer waits, and who is locked out.

    At most ``ADDRESSES_MAX`` addresses are known. The one longest without a failure is forgotten first, but one that
    is locked out only when all are: many addresses, each with one failure, set nobody free.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._failures: dict[str, list[float]] = {}  # when, by address; the address that failed last is the last

    def failed(self, address: str) -> bool:
        """Somebody at *address* gave a wrong password. Returns True if that locks it out; once for each lock-out."""
        now_s = self._clock.monotonic()
        with self._lock:
            counted = self._counted(address, now_s)
            if len(counted) >= FAILURES_MAX:
                return False  # it was asked before it was locked out
            self._failures.pop(address, None)
            if len(self._failures) >= ADDRESSES_MAX:
                self._forget_one(now_s)
            self._failures[address] = [*counted, now_s]
            return len(counted) + 1 == FAILURES_MAX

    def succeeded(self, address: str) -> None:
        """Somebody at *address* gave the right password: its failures are forgotten."""
        with self._lock:
            self._failures.pop(address, None)

    def delay_s(self, address: str) -> float:
        """Return how long the answer to the last failure is held back: 1 s, 2 s, 4 s, then 8 s; 0 without failures."""
        now_s = self._clock.monotonic()
        with self._lock:
            count = len(self._counted(address, now_s))
        return min(DELAY_MOST_S, DELAY_FIRST_S * 2 ** (count - 1)) if count else 0.0

    def locked_s(self, address: str) -> float:
        """Return how long *address* is still locked out; 0 when it is not."""
        now_s = self._clock.monotonic()
        with self._lock:
            counted = self._counted(address, now_s)
        return counted[-1] + LOCKED_S - now_s if len(counted) >= FAILURES_MAX else 0.0

    def _counted(self, address: str, now_s: float) -> list[float]:
        """Return the failures that still count: those of a lock-out until it is over, else those of 15 minutes."""
        failures = self._failures.get(address, [])
        if len(failures) >= FAILURES_MAX:
            return failures if now_s < failures[-1] + LOCKED_S else []
        return [failed_s for failed_s in failures if now_s < failed_s + REMEMBERED_S]

    def _forget_one(self, now_s: float) -> None:
        free = (known for known in self._failures if len(self._counted(known, now_s)) < FAILURES_MAX)
        del self._failures[next(free, next(iter(self._failures)))]
