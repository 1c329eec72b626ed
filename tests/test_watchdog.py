"""The hardware watchdog: on a fake kernel that resets a fake machine."""

from __future__ import annotations

import errno
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway import watchdog
from gateway.watchdog import WatchdogDevice
from tests import watchdogs
from tests.fakes import JumpingClock
from tests.watchdogs import ALARM_ONLY, CARD_RESET, MAGIC_CLOSE, PING, TAKES_TIMEOUT, USUAL, KernelWatchdog

PATH = Path("/dev/watchdog")
TAKEN = "i6300ESB timer, resets the machine when not fed for 30 s"


@pytest.fixture
def kernel(clock: JumpingClock) -> KernelWatchdog:
    return KernelWatchdog(clock)


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture) -> Callable[[], list[str]]:
    """What was logged since it was asked last, without debug lines."""
    caplog.set_level("INFO")

    def take() -> list[str]:
        lines = [f"{record.levelname} {record.getMessage()}" for record in caplog.records]
        caplog.clear()
        return lines

    return take


def a_device(kernel: KernelWatchdog, tmp_path: Path = Path("/nowhere"), timeout_s: int = 30) -> WatchdogDevice:
    return WatchdogDevice(PATH, timeout_s, kernel.clock, kernel, classes=tmp_path)


def test_the_requests_are_those_of_linux_watchdog_h() -> None:
    ours = [watchdog.reading(number, size, "aarch64") for number, size in ((0, 40), (2, 4), (5, 4), (7, 4))]
    assert ours == [
        watchdogs.GET_SUPPORT,
        watchdogs.GET_BOOT_STATUS,
        watchdogs.KEEP_ALIVE,
        watchdogs.GET_TIMEOUT,
    ]
    assert [watchdog.reading(0, 40, machine) for machine in ("mips", "ppc64le")] == [0x40285700] * 2
    assert watchdog.SET_TIMEOUT == watchdogs.SET_TIMEOUT == 0xC0000000 | watchdog.reading(6, 4, "mips")


def test_nothing_is_opened_before_the_first_feeding(kernel: KernelWatchdog) -> None:
    device = a_device(kernel)
    device.close(clean=True)
    assert (kernel.opens, device.trouble, device.reset_machine) == ([], "", False)


def test_opening_sets_the_timeout_and_says_what_the_device_took(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    device = a_device(kernel)
    device.feed()
    assert kernel.timeout_s == 30
    assert (device.trouble, device.reset_machine) == ("", False)
    assert said() == [f"INFO watchdog: {PATH}: {TAKEN}"]


def test_the_timeout_is_set_before_the_device_is_asked_anything_else(kernel: KernelWatchdog) -> None:
    a_device(kernel).feed()
    assert kernel.requests[0] == watchdogs.SET_TIMEOUT


def test_fed_once_a_second_it_never_resets_the_machine_and_says_nothing(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    device = a_device(kernel)
    device.feed()
    said()
    kernel.pass_fed(3600, device.feed)
    assert (said(), len(kernel.opens), device.trouble) == ([], 1, "")


def test_without_feeding_it_resets_the_machine_after_the_timeout(kernel: KernelWatchdog) -> None:
    device = a_device(kernel)
    device.feed()
    kernel.pass_fed(100, device.feed)
    kernel.clock.pass_s(29.9)
    assert not kernel.has_reset_machine
    kernel.clock.pass_s(0.1)
    assert kernel.has_reset_machine


@pytest.mark.parametrize(("options", "by_ioctl"), [(USUAL, True), (TAKES_TIMEOUT | MAGIC_CLOSE, False)])
def test_it_is_kept_alive_by_ioctl_where_the_driver_offers_that_and_else_by_a_byte(
    kernel: KernelWatchdog, options: int, by_ioctl: bool
) -> None:
    kernel.options = options
    device = a_device(kernel)
    device.feed()
    kernel.pass_fed(3, device.feed)
    assert (watchdogs.KEEP_ALIVE in kernel.requests, kernel.written) == (by_ioctl, b"" if by_ioctl else b"\0" * 4)


def test_a_clean_close_stops_it(kernel: KernelWatchdog) -> None:
    device = a_device(kernel)
    device.feed()
    device.close(clean=True)
    assert (kernel.is_counting, kernel.open_fds, kernel.written) == (False, set(), b"V")


def test_any_other_close_leaves_it_counting(kernel: KernelWatchdog) -> None:
    device = a_device(kernel)
    device.feed()
    device.close(clean=False)
    assert (kernel.is_counting, kernel.open_fds, kernel.written) == (True, set(), b"")


@pytest.mark.parametrize("clean", [True, False])
def test_closed_is_closed_for_good(kernel: KernelWatchdog, clean: bool) -> None:
    device = a_device(kernel)
    device.feed()
    device.close(clean)
    written = kernel.written
    device.close(clean=True)
    device.close(clean=False)
    kernel.clock.pass_s(100.0)
    device.feed()
    assert (len(kernel.opens), kernel.written) == (1, written)


def test_a_program_that_comes_back_in_time_goes_on_feeding_what_the_old_one_left_counting(
    kernel: KernelWatchdog,
) -> None:
    before = a_device(kernel)
    before.feed()
    before.close(clean=False)
    kernel.clock.pass_s(25.0)
    after = a_device(kernel)
    after.feed()
    kernel.pass_fed(60, after.feed)


@pytest.mark.parametrize(("boot_status", "reset"), [(CARD_RESET, True), (CARD_RESET | 1, True), (1, False), (0, False)])
def test_the_driver_tells_whether_the_watchdog_reset_the_machine(
    kernel: KernelWatchdog, boot_status: int, reset: bool
) -> None:
    kernel.boot_status = boot_status
    device = a_device(kernel)
    device.feed()
    assert device.reset_machine is reset


def test_a_timeout_that_the_hardware_rounds_up_is_told_and_no_trouble(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    kernel.step_s = 16
    device = a_device(kernel)
    device.feed()
    assert (device.trouble, said()) == ("", [f"INFO watchdog: {PATH}: {TAKEN.replace('30 s', '32 s')}"])


def test_a_timeout_out_of_its_range_leaves_the_device_its_own_and_is_told(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    kernel.least_s = 40
    device = a_device(kernel)
    device.feed()
    words = f"{TAKEN.replace('30 s', '60 s')}; it refuses 30 s (invalid argument)"
    assert (device.trouble, said()) == ("", [f"WARNING watchdog: {PATH}: {words}"])


def test_a_device_that_takes_no_timeout_is_used_with_its_own(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    kernel.options &= ~TAKES_TIMEOUT
    device = a_device(kernel)
    device.feed()
    assert device.trouble == ""
    assert said()[0].endswith("not fed for 60 s; it refuses 30 s (operation not supported)")


@pytest.mark.parametrize(
    ("own_s", "what_for"),
    [(10, "a restart of the program may take longer"), (4, "being fed once a second may be too late")],
)
def test_a_device_that_waits_less_than_asked_for_is_an_alarm_while_it_is_used(
    kernel: KernelWatchdog, said: Callable[[], list[str]], own_s: int, what_for: str
) -> None:
    kernel.most_s = kernel.timeout_s = own_s
    device = a_device(kernel)
    device.feed()
    kernel.pass_fed(60, device.feed)
    shortfall = f"waits for {own_s} s only, not 30 s: {what_for}"
    assert device.trouble == f"{PATH}: {shortfall}"
    (line,) = said()
    assert line.startswith("WARNING")
    assert line.endswith(f"it refuses 30 s (invalid argument); {shortfall}")


def test_a_device_that_does_not_know_its_timeout_is_used_all_the_same(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    kernel.knows_timeout = False
    device = a_device(kernel)
    device.feed()
    assert device.trouble == ""
    assert "when not fed for a time of its own" in said()[0]


def test_a_driver_that_cannot_tell_its_timeout_is_taken_by_what_setting_it_returned(
    kernel: KernelWatchdog, said: Callable[[], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    ioctl = kernel.ioctl

    def without_get_timeout(fd: int, request: int, argument: bytes) -> bytes:
        if request == watchdogs.GET_TIMEOUT:
            raise OSError(errno.ENOTTY, "")
        return ioctl(fd, request, argument)

    monkeypatch.setattr(kernel, "ioctl", without_get_timeout)
    kernel.step_s = 16
    a_device(kernel).feed()
    assert "when not fed for 32 s" in said()[0]


def test_a_driver_without_ioctls_is_fed_by_a_byte_that_is_not_magic_and_still_stopped_by_v(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    kernel.has_ioctls = False
    device = a_device(kernel)
    device.feed()
    kernel.pass_fed(3, device.feed)
    device.close(clean=True)
    assert (kernel.written, kernel.is_counting, device.trouble) == (b"\0\0\0\0V", False, "")
    refusal = "it refuses a watchdog's requests (is it one?)"
    words = f"opened, resets the machine when not fed for a time of its own; {refusal}"
    assert said() == [f"WARNING watchdog: {PATH}: {words}"]


def show_nowayout(classes: Path, name: str, text: str) -> None:
    (classes / name).mkdir()
    (classes / name / "nowayout").write_text(text)


@pytest.mark.parametrize("path", [PATH, Path("/dev/watchdog0")])
def test_a_device_that_nothing_stops_is_named_at_opening(
    kernel: KernelWatchdog, said: Callable[[], list[str]], tmp_path: Path, path: Path
) -> None:
    show_nowayout(tmp_path, "watchdog0", "1\n")
    kernel.nowayout = True
    device = WatchdogDevice(path, 30, kernel.clock, kernel, classes=tmp_path)
    device.feed()
    ignores = "it ignores V (nowayout): a clean stop of the program also resets the machine"
    assert said() == [f"WARNING watchdog: {path}: {TAKEN}; {ignores}"]
    device.close(clean=True)
    assert kernel.is_counting


@pytest.mark.parametrize(("name", "text"), [("watchdog0", "0\n"), ("watchdog1", "1\n"), ("watchdog0", "nonsense")])
def test_a_device_that_can_be_stopped_is_not_named(
    kernel: KernelWatchdog, said: Callable[[], list[str]], tmp_path: Path, name: str, text: str
) -> None:
    show_nowayout(tmp_path, name, text)
    a_device(kernel, tmp_path).feed()
    assert said() == [f"INFO watchdog: {PATH}: {TAKEN}"]


def test_a_device_that_stops_with_the_program_however_that_ends_is_named_at_opening(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    kernel.options = TAKES_TIMEOUT | PING
    device = a_device(kernel)
    device.feed()
    ignores = "it ignores V and stops whenever the program ends: a crash does not reset the machine"
    assert said() == [f"WARNING watchdog: {PATH}: {TAKEN}; {ignores}"]
    device.close(clean=False)
    assert not kernel.is_counting  # as it was told


def test_a_device_that_only_raises_an_alarm_is_named_at_opening(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    kernel.options |= ALARM_ONLY
    a_device(kernel).feed()
    assert said()[0].endswith("; it raises an alarm of its own instead of resetting the machine")


def test_what_a_driver_calls_itself_moves_no_cursor(kernel: KernelWatchdog, said: Callable[[], list[str]]) -> None:
    kernel.identity = b"\x1b[2J\xff\n" + bytes(3) + b"rest"
    a_device(kernel).feed()
    assert said()[0].startswith(f"INFO watchdog: {PATH}: \\x1b[2J\xff\\n, resets the machine")


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (errno.EBUSY, "another program has it (systemd, if its RuntimeWatchdogSec is set)"),
        (errno.ENOENT, "is not there (is its driver loaded?)"),
        (errno.ENXIO, "nobody is behind it (no driver, no reader)"),
        (
            errno.EACCES,
            "permission denied; it is root's until a udev rule gives it to a group that this program's user",
        ),
        (errno.EPERM, "not permitted: the service's unit has no DeviceAllow= for it"),
        (errno.EMFILE, "too many open files"),
    ],
)
def test_a_device_that_cannot_be_opened_is_an_alarm_with_its_reason_told_once(
    kernel: KernelWatchdog, said: Callable[[], list[str]], error: int, reason: str
) -> None:
    kernel.open_error = error
    device = a_device(kernel)
    for _ in range(1000):
        device.feed()
        kernel.clock.pass_s(1.0)
    assert device.trouble.startswith(f"{PATH}: {reason}")
    assert said() == [f"ERROR watchdog: {device.trouble}; trying again"]


def test_a_busy_device_is_tried_again_later_and_later_and_used_when_it_is_free(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    kernel.open_error = errno.EBUSY
    device = a_device(kernel)
    began_s = kernel.clock.monotonic()
    while kernel.clock.monotonic() < began_s + 250.0:
        device.feed()
        kernel.clock.pass_s(1.0)
    assert [at_s - began_s for at_s in kernel.opens] == [0, 1, 3, 7, 15, 31, 63, 123, 183, 243]
    kernel.open_error = 0
    said()
    kernel.pass_fed(60, device.feed)
    assert (device.trouble, kernel.is_counting) == ("", True)
    assert said() == [f"WARNING watchdog: {PATH}: {TAKEN}"]


def test_another_reason_is_told_as_well(kernel: KernelWatchdog, said: Callable[[], list[str]]) -> None:
    device = a_device(kernel)
    for error in (errno.ENOENT, errno.ENOENT, errno.EBUSY):
        kernel.open_error = error
        device.feed()
        kernel.clock.pass_s(60.0)
    assert [line.partition(" (")[0] for line in said()] == [
        f"ERROR watchdog: {PATH}: is not there",
        f"ERROR watchdog: {PATH}: another program has it",
    ]


def test_a_device_that_cannot_even_be_fed_once_is_told_once_and_never_called_opened(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    kernel.feed_error = errno.EIO
    device = a_device(kernel)
    for _ in range(20):
        device.feed()
        kernel.clock.pass_s(1.0)
    assert said() == [f"ERROR watchdog: {PATH}: input/output error; trying again"]


def test_a_device_that_is_unplugged_is_told_once_closed_and_used_again_when_it_is_back(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    device = a_device(kernel)
    device.feed()
    kernel.pass_fed(100, device.feed)
    said()
    kernel.feed_error = kernel.open_error = errno.ENODEV
    device.feed()
    assert (device.trouble, kernel.open_fds) == (f"{PATH}: is gone (unplugged?)", set())
    device.feed()  # not due
    kernel.clock.pass_s(1.0)
    kernel.feed_error = kernel.open_error = 0
    device.feed()
    assert (device.trouble, len(kernel.open_fds)) == ("", 1)
    assert said() == [
        f"ERROR watchdog: {PATH}: is gone (unplugged?); trying again",
        f"WARNING watchdog: {PATH}: {TAKEN}",
    ]


@pytest.mark.parametrize("outage_s", range(1, 23))
def test_a_device_that_fails_while_it_counts_is_found_again_before_it_resets_the_machine(
    kernel: KernelWatchdog, outage_s: int
) -> None:
    device = a_device(kernel)
    device.feed()
    kernel.pass_fed(10, device.feed)
    kernel.feed_error = errno.EIO
    kernel.pass_fed(outage_s, device.feed)
    kernel.feed_error = 0
    kernel.pass_fed(100, device.feed)
    assert device.trouble == ""


def test_a_device_that_fails_again_soon_is_not_tried_as_soon_again_until_it_was_well_for_a_minute(
    kernel: KernelWatchdog,
) -> None:
    device = a_device(kernel)

    def fails_after(seconds: int) -> float:
        device.feed()
        kernel.pass_fed(seconds, device.feed)
        tried = len(kernel.opens)
        kernel.feed_error = errno.EIO
        device.feed()
        kernel.feed_error, began_s = 0, kernel.clock.monotonic()
        while len(kernel.opens) == tried:
            kernel.clock.pass_s(0.5)
            device.feed()
        return kernel.clock.monotonic() - began_s

    assert [fails_after(10), fails_after(10), fails_after(10), fails_after(61)] == [1.0, 2.0, 4.0, 1.0]


def test_a_clean_stop_also_stops_a_device_that_failed_and_still_counts(
    kernel: KernelWatchdog, said: Callable[[], list[str]]
) -> None:
    device = a_device(kernel)
    device.feed()
    kernel.feed_error = errno.EIO
    device.feed()
    kernel.feed_error = 0
    said()
    device.close(clean=True)
    assert (kernel.is_counting, kernel.open_fds, said()) == (False, set(), [])


@pytest.mark.parametrize(("waited_s", "opens"), [(29.0, 2), (31.0, 1)])
def test_a_clean_stop_looks_for_a_lost_device_only_while_it_counts(
    kernel: KernelWatchdog, said: Callable[[], list[str]], waited_s: float, opens: int
) -> None:
    device = a_device(kernel)
    device.feed()
    kernel.feed_error = kernel.open_error = errno.ENODEV
    device.feed()
    kernel.clock.pass_s(waited_s)
    said()
    device.close(clean=True)
    assert len(kernel.opens) == opens
    assert len(said()) == opens - 1  # that it may reset the machine


def test_a_device_that_was_opened_but_never_fed_counts_and_is_stopped_by_a_clean_stop(kernel: KernelWatchdog) -> None:
    kernel.feed_error = errno.EIO
    device = a_device(kernel)
    device.feed()
    assert kernel.is_counting
    kernel.feed_error = 0
    device.close(clean=True)
    assert not kernel.is_counting


def test_a_device_that_refuses_v_is_named_and_closed(kernel: KernelWatchdog, said: Callable[[], list[str]]) -> None:
    device = a_device(kernel)
    device.feed()
    kernel.stop_error = errno.EIO
    said()
    device.close(clean=True)
    lines = [f"ERROR watchdog: {PATH}: input/output error; not stopped, it may reset the machine"]
    assert (said(), kernel.open_fds) == (lines, set())


@pytest.mark.parametrize("kind", [stat.S_IFREG, stat.S_IFBLK, stat.S_IFDIR, stat.S_IFSOCK])
def test_what_is_no_device_to_write_to_is_closed_without_a_byte(kernel: KernelWatchdog, kind: int) -> None:
    kernel.kind = kind
    device = a_device(kernel)
    device.feed()
    device.close(clean=True)
    assert device.trouble == f"{PATH}: is a file or a disk and no watchdog"
    assert (kernel.open_fds, kernel.written, kernel.requests) == (set(), b"", [])
