"""The password and the lock-out; the hash against OpenSSL's own command, the lock-out with a clock that jumps."""

from __future__ import annotations

import hashlib
import sys
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.hmi.access import ADDRESSES_MAX, Lockout, check_password, hash_password, is_hash, password_problem
from tests.fakes import JumpingClock

# openssl kdf -keylen 32 -kdfopt pass:opensesame -kdfopt hexsalt:00...0f -kdfopt n:16384 -kdfopt r:8 -kdfopt p:5 SCRYPT
BY_OPENSSL = (
    "scrypt$16384$8$5$000102030405060708090a0b0c0d0e0f$db7c9bd1d4bf37d607708b15f78f71b2f6eb2f21ef9c42c97d96c25c4c816533"
)
SALT, DIGEST = BY_OPENSSL.split("$")[4:]
HOST, OTHER = "192.168.1.7", "fe80::1"


def stored(text: str, n: int, r: int, p: int) -> str:
    """Return a hash of *text* by other parameters than ours, most of them cheaper."""
    digest = hashlib.scrypt(text.encode(), salt=bytes(16), n=n, r=r, p=p, dklen=32, maxmem=2**27)
    return f"scrypt${n}${r}${p}${bytes(16).hex()}${digest.hex()}"


CHEAP = stored("opensesame", 2, 1, 1)

# ------------------------------------------------------------------------------------------------ the password


def test_a_password_is_known_again_by_its_hash_and_no_other_is() -> None:
    kept = hash_password("contraseña 1")
    assert kept.startswith("scrypt$16384$8$5$")
    assert "contrase" not in kept
    assert is_hash(kept)
    assert check_password("contraseña 1", kept)
    assert not check_password("contraseña 2", kept)


def test_the_same_password_is_stored_differently_each_time() -> None:
    assert hash_password("opensesame") != hash_password("opensesame")


def test_a_hash_made_by_openssl_is_understood() -> None:
    assert check_password("opensesame", BY_OPENSSL)
    assert not check_password("opensesamf", BY_OPENSSL)


@pytest.mark.parametrize(
    "text", ["", "opensesam", "opensesame ", "Opensesame", "opensesame\t", "\ud800", "x" * 100_000]
)
def test_a_wrong_password_is_wrong_however_strange(text: str) -> None:
    assert not check_password(text, CHEAP)
    assert check_password("opensesame", CHEAP)


def test_an_accent_may_be_typed_in_either_way() -> None:
    assert check_password("contrasen\u0303a", stored("contrase\u00f1a", 2, 1, 1))


@pytest.mark.parametrize(
    "kept",
    [
        "",
        "opensesame",
        "scrypt$",
        "scrypt$16384$8$5",
        f"scrypt$16384$8$5${SALT}",
        f"scrypt$16384$8$5${SALT}$",
        f"scrypt$16384$8$5${SALT}${DIGEST[:-2]}",
        f"scrypt$16384$8$5${SALT}${DIGEST}00",
        f"scrypt$16384$8$5${SALT[:-1]}g${DIGEST}",
        f"scrypt$16384$8$5${SALT}${DIGEST}$",
        f"scrypt$16384$8$5${SALT}${DIGEST}\n",
        f" scrypt$16384$8$5${SALT}${DIGEST}",
        f"bcrypt$16384$8$5${SALT}${DIGEST}",
        f"scrypt$016384$8$5${SALT}${DIGEST}",
        f"scrypt$-16384$8$5${SALT}${DIGEST}",
        f"scrypt$١٦٣٨٤$8$5${SALT}${DIGEST}",  # digits, but not ours
        f"scrypt$0$8$5${SALT}${DIGEST}",
        f"scrypt$1$8$5${SALT}${DIGEST}",  # N must be more than 1
        f"scrypt$16383$8$5${SALT}${DIGEST}",  # and a power of two
        f"scrypt$65536$1$1${SALT}${DIGEST}",  # and less than 2 to the 16 r
        f"scrypt$16384$0$5${SALT}${DIGEST}",
        f"scrypt$16384$8$0${SALT}${DIGEST}",
        f"scrypt$2$17$1${SALT}${DIGEST}",
        f"scrypt$2$1$11${SALT}${DIGEST}",
        f"scrypt$262144$8$1${SALT}${DIGEST}",  # 256 MiB
        f"scrypt$131072$16$1${SALT}${DIGEST}",
        f"scrypt$131072$8$10${SALT}${DIGEST}",  # ten times too long
        f"scrypt$1048576$1$1${SALT}${DIGEST}",
        f"scrypt${'9' * 5000}$8$5${SALT}${DIGEST}",
        "scrypt$" + "0" * 1_000_000,
        "\0",
        "\ud800",
    ],
)
def test_a_stored_text_that_is_no_hash_or_too_costly_fits_no_password(kept: str) -> None:
    assert not is_hash(kept)
    assert check_password("opensesame", kept) is False


@settings(derandomize=True, deadline=None, max_examples=100)
@given(st.integers(1, 8), st.integers(1, 16), st.integers(1, 10))
def test_whatever_is_a_hash_can_be_checked(log_n: int, r: int, p: int) -> None:
    kept = stored("opensesame", 2**log_n, r, p)
    assert is_hash(kept)
    assert check_password("opensesame", kept)
    assert not check_password("opensesamf", kept)


@pytest.mark.parametrize(("n", "r", "p"), [(2**15, 1, 1), (2**12, 16, 10), (2**16, 8, 1)])
def test_hashes_of_other_strengths_can_be_checked(n: int, r: int, p: int) -> None:
    assert check_password("opensesame", stored("opensesame", n, r, p))


@pytest.mark.parametrize(("n", "p"), [(2**17, 1), (2**16, 2), (2**15, 3), (2**14, 5), (2**13, 10)])
def test_every_strength_that_is_recommended_for_scrypt_is_accepted(n: int, p: int) -> None:
    assert is_hash(f"scrypt${n}$8${p}${SALT}${DIGEST}")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "8"),
        ("1234567", "8"),
        ("12345678", None),
        ("contraseña larga", None),
        ("x" * 64, None),
        ("x" * 65, "64"),
        ("1234567\t", "typed"),
        ("12345678\x7f", "typed"),
        ("12345678\u200b", "typed"),
        ("12345678\ud800", "typed"),
    ],
)
def test_a_new_password_has_8_to_64_characters_that_can_be_typed(text: str, problem: str | None) -> None:
    found = password_problem(text)
    assert found is None if problem is None else problem in str(found)


# ------------------------------------------------------------------------------------------------ the lock-out


@pytest.fixture
def lockout(clock: JumpingClock) -> Lockout:
    return Lockout(clock)


def test_five_failures_in_a_row_lock_an_address_out_for_five_minutes(lockout: Lockout, clock: JumpingClock) -> None:
    assert [lockout.failed(HOST) for _ in range(5)] == [False, False, False, False, True]
    assert lockout.locked_s(HOST) == 300.0
    assert lockout.locked_s(OTHER) == 0.0
    clock.pass_s(299.5)
    assert lockout.locked_s(HOST) == 0.5
    clock.pass_s(0.5)
    assert lockout.locked_s(HOST) == 0.0


def test_four_failures_lock_nobody_out(lockout: Lockout) -> None:
    for _ in range(4):
        lockout.failed(HOST)
    assert lockout.locked_s(HOST) == 0.0


def test_after_a_lock_out_five_more_failures_are_needed_for_the_next(lockout: Lockout, clock: JumpingClock) -> None:
    for _ in range(5):
        lockout.failed(HOST)
    clock.pass_s(300.0)
    assert lockout.delay_s(HOST) == 0.0
    assert [lockout.failed(HOST) for _ in range(5)] == [False, False, False, False, True]


def test_a_failure_during_a_lock_out_does_not_lengthen_it(lockout: Lockout, clock: JumpingClock) -> None:
    for _ in range(5):
        lockout.failed(HOST)
    clock.pass_s(100.0)
    assert lockout.failed(HOST) is False  # a second session of the same address had asked before
    assert lockout.locked_s(HOST) == 200.0


def test_a_success_begins_the_row_anew(lockout: Lockout) -> None:
    for _ in range(4):
        lockout.failed(HOST)
    lockout.succeeded(HOST)
    lockout.succeeded(OTHER)  # of which nothing was known
    assert [lockout.failed(HOST) for _ in range(4)] == [False] * 4


def test_each_failure_is_answered_later_than_the_one_before_up_to_8_seconds(lockout: Lockout) -> None:
    delays_s = [lockout.delay_s(HOST)]
    for _ in range(5):
        lockout.failed(HOST)
        delays_s.append(lockout.delay_s(HOST))
    assert delays_s == [0.0, 1.0, 2.0, 4.0, 8.0, 8.0]
    assert lockout.delay_s(OTHER) == 0.0


def test_a_failure_counts_for_15_minutes(lockout: Lockout, clock: JumpingClock) -> None:
    lockout.failed(HOST)
    clock.pass_s(300.0)
    for _ in range(3):
        lockout.failed(HOST)
    clock.pass_s(599.0)
    assert lockout.delay_s(HOST) == 8.0
    clock.pass_s(1.0)
    assert lockout.delay_s(HOST) == 4.0  # the first is 15 minutes old
    assert lockout.failed(HOST) is False
    assert lockout.failed(HOST) is True


def test_many_addresses_do_not_set_one_free_that_is_locked_out(lockout: Lockout) -> None:
    for _ in range(5):
        lockout.failed(HOST)
    for number in range(5 * ADDRESSES_MAX):
        lockout.failed(f"fe80::{number:x}")
    assert lockout.locked_s(HOST) == 300.0


def test_of_too_many_addresses_the_one_longest_without_a_failure_is_forgotten(lockout: Lockout) -> None:
    for address in (HOST, OTHER, HOST):
        lockout.failed(address)
    for number in range(ADDRESSES_MAX - 1):
        lockout.failed(f"fe80::{number + 2:x}")
    assert lockout.delay_s(OTHER) == 0.0
    assert lockout.delay_s(HOST) == 2.0


def test_an_address_whose_lock_out_is_over_is_forgotten_like_any_other(lockout: Lockout, clock: JumpingClock) -> None:
    for _ in range(5):
        lockout.failed(OTHER)
    clock.pass_s(299.0)
    for _ in range(5):
        lockout.failed(HOST)
    clock.pass_s(1.0)
    for number in range(ADDRESSES_MAX - 1):
        lockout.failed(f"fe80::{number + 2:x}")
    assert lockout.locked_s(HOST) == 299.0
    assert lockout.delay_s("fe80::2") == 1.0  # it was OTHER that went


def test_when_all_are_locked_out_the_one_that_is_free_soonest_makes_room(lockout: Lockout, clock: JumpingClock) -> None:
    for number in range(ADDRESSES_MAX):
        for _ in range(5):
            lockout.failed(f"10.0.{number // 256}.{number % 256}")
        clock.pass_s(0.1)
    lockout.failed(HOST)
    assert lockout.delay_s(HOST) == 1.0
    assert lockout.locked_s("10.0.0.0") == 0.0
    assert lockout.locked_s("10.0.0.1") > 0.0


def test_of_failures_at_once_every_one_is_counted_and_one_locks_the_address_out(lockout: Lockout) -> None:
    hosts = [f"fe80::{number:x}" for number in range(ADDRESSES_MAX)]
    start, locked_out = threading.Barrier(5), []

    def fail() -> None:
        start.wait()
        for host in hosts:
            if lockout.failed(host):
                locked_out.append(host)

    threads = [threading.Thread(target=fail) for _ in range(5)]
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval_s)
    assert sorted(locked_out) == sorted(hosts)
