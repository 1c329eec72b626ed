"""The data register: sizes, blocks on the wire, quality, age and source, mask writes, watchers."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gateway.commands import CommandQueue, Outlet
from gateway.errors import PointsOutOfRange, PointUnknown, RequestInvalid
from gateway.modbus.pdu import Span, Table
from gateway.modbus.server import Server, answer
from gateway.register import DataRegister, Quality, Sample, Source, SourceKind, Written, runs
from tests.fakes import SCADA, JumpingClock, words
from tests.points import MENU, POLL, RETAINED, coils, holding

OTHER_POLL = Source(SourceKind.REQUEST, "field/pump")


def quality_of(register: DataRegister, span: Span) -> list[Quality]:
    return [sample.quality for sample in register.samples(span)]


# ------------------------------------------------------------------------------------------------ sizes and ranges


def test_every_table_has_2000_points_of_value_0_and_quality_never(register: DataRegister) -> None:
    for table in Table:
        span = Span(table, 0, 2000)
        assert register.size(table) == 2000
        assert register.read(span) == bytes(span.size)
        assert set(register.samples(span)) == {Sample(0, Quality.NEVER, None, None)}


@pytest.mark.parametrize("size", [1, 9, 65535, 65536])
@pytest.mark.parametrize("table", Table)
def test_a_table_may_have_1_to_65536_points_and_keeps_all_of_them(clock: JumpingClock, table: Table, size: int) -> None:
    register = DataRegister(clock, {table: size})
    span = Span(table, 0, size)
    pattern = bytes((7 * i + 13) & 0xFF for i in range(span.size))
    if table.is_bits and size % 8:  # bits beyond the last point are 0 on the wire
        pattern = pattern[:-1] + bytes([pattern[-1] & (1 << size % 8) - 1])
    register.write(span, pattern, POLL)
    assert register.read(span) == pattern
    assert register.size(table) == size


@pytest.mark.parametrize("size", [0, -1, 65537])
def test_a_table_of_another_size_is_refused(clock: JumpingClock, size: int) -> None:
    with pytest.raises(RequestInvalid):
        DataRegister(clock, {Table.COILS: size})


def ways_in(register: DataRegister) -> list[Callable[[Span], object]]:
    return [
        register.read,
        register.read_fresh,
        register.samples,
        register.known,
        lambda span: register.write(span, bytes(max(0, span.size)), POLL),
        lambda span: register.mask_write(span, 0, 0, SCADA),
        lambda span: register.mark(span, Quality.BAD, POLL),
        lambda span: register.claim(span, POLL, 1.0),
    ]


@pytest.mark.parametrize("span", [holding(2000), holding(1999, 2), holding(-1), holding(0, 0), holding(5, -1)])
def test_points_outside_the_table_are_refused_whichever_way_they_are_reached(
    register: DataRegister, span: Span
) -> None:
    for way_in in ways_in(register):
        with pytest.raises(PointsOutOfRange):
            way_in(span)
    assert set(quality_of(register, holding(0, 2000))) == {Quality.NEVER}


@pytest.mark.parametrize("data", [b"", b"\x00", b"\x00\x01\x02", b"\x00\x01\x02\x03\x04"])
def test_data_of_another_size_than_the_span_is_refused_and_nothing_stored(register: DataRegister, data: bytes) -> None:
    with pytest.raises(RequestInvalid):
        register.write(holding(10, 2), data, POLL)
    assert register.samples(holding(10)) == [Sample(0, Quality.NEVER, None, None)]


# ------------------------------------------------------------------------------------------------ on the wire


def test_registers_are_big_endian_words_and_a_read_is_any_slice_of_them(register: DataRegister) -> None:
    register.write(holding(100, 3), bytes.fromhex("022B 0000 0064"), POLL)  # 555, 0, 100: specification 6.3
    assert [sample.value for sample in register.samples(holding(100, 3))] == [555, 0, 100]
    assert register.read(holding(101, 2)) == bytes.fromhex("0000 0064")
    assert register.read(holding(99, 2)) == bytes.fromhex("0000 022B")


def test_bits_are_packed_with_the_first_point_lowest(register: DataRegister) -> None:
    register.write(coils(19, 19), bytes.fromhex("CD 6B 05"), POLL)  # specification 6.1: coils 20 to 38
    values = [sample.value for sample in register.samples(coils(19, 19))]
    assert values == [1, 0, 1, 1, 0, 0, 1, 1, 1, 1, 0, 1, 0, 1, 1, 0, 1, 0, 1]
    assert register.read(coils(19, 19)) == bytes.fromhex("CD 6B 05")
    assert register.read(coils(20, 8)) == bytes([0xCD >> 1 | (0x6B & 1) << 7])


def test_bits_beyond_the_span_are_neither_stored_nor_read(register: DataRegister) -> None:
    register.write(coils(0, 3), b"\xff", POLL)
    assert register.read(coils(0, 8)) == b"\x07"
    assert quality_of(register, coils(2, 2)) == [Quality.GOOD, Quality.NEVER]


@pytest.mark.parametrize("first", range(9))
def test_a_bit_block_at_any_offset_leaves_its_neighbours_alone(clock: JumpingClock, first: int) -> None:
    register = DataRegister(clock, {Table.COILS: 21})
    register.write(coils(0, 21), b"\xff\xff\x1f", POLL)
    register.write(coils(first, 11), b"\x00\x00", POLL)
    bits = int.from_bytes(register.read(coils(0, 21)), "little")
    assert bits == 0x1FFFFF & ~(0x7FF << first)


def test_the_tables_do_not_share_points(register: DataRegister) -> None:
    for table in Table:
        register.write(Span(table, 7, 1), b"\x01" if table.is_bits else words(table), POLL)
    assert register.read(Span(Table.COILS, 7, 1)) == b"\x01"
    assert register.read(Span(Table.HOLDING_REGISTERS, 7, 1)) == words(3)
    assert register.read(Span(Table.INPUT_REGISTERS, 7, 1)) == words(4)


def test_points_become_contiguous_runs() -> None:
    assert runs([]) == []
    assert runs([4]) == [(4, 5)]
    assert runs([1, 2, 3, 7, 9, 10]) == [(1, 4), (7, 8), (9, 11)]


# ------------------------------------------------------------------------------------------------ quality, age, source


def test_a_sample_tells_value_quality_age_and_source(register: DataRegister, clock: JumpingClock) -> None:
    register.write(holding(5), words(555), POLL)
    clock.pass_s(2.5)
    register.write(holding(6), words(7), MENU, Quality.MANUAL)
    assert register.samples(holding(5, 3)) == [
        Sample(555, Quality.GOOD, 2.5, POLL),
        Sample(7, Quality.MANUAL, 0.0, MENU),
        Sample(0, Quality.NEVER, None, None),
    ]


def test_a_wall_clock_that_jumps_changes_no_age(register: DataRegister, clock: JumpingClock) -> None:
    register.write(holding(5), words(1), POLL)
    clock.jump_wall(-1e6)
    assert register.samples(holding(5))[0].age_s == 0.0


def test_marking_keeps_value_age_and_source(register: DataRegister, clock: JumpingClock) -> None:
    register.write(holding(5, 2), words(1, 2), POLL)
    clock.pass_s(4.0)
    register.mark(holding(6, 2), Quality.BAD, OTHER_POLL)
    assert register.samples(holding(5, 3)) == [
        Sample(1, Quality.GOOD, 4.0, POLL),
        Sample(2, Quality.BAD, 4.0, POLL),
        Sample(0, Quality.BAD, None, None),
    ]


@pytest.mark.parametrize(
    ("age_s", "told"), [(0.0, Quality.GOOD), (3.0, Quality.GOOD), (3.25, Quality.STALE)], ids=["new", "limit", "older"]
)
def test_a_value_is_stale_once_it_is_older_than_the_limit(
    register: DataRegister, clock: JumpingClock, age_s: float, told: Quality
) -> None:
    register.claim(holding(10, 2), POLL, stale_after_s=3.0)
    register.write(holding(10, 3), words(1, 2, 3), POLL)
    clock.pass_s(age_s)
    assert quality_of(register, holding(10, 3)) == [told, told, Quality.GOOD]  # 12 is claimed by nobody
    fresh = register.read_fresh(holding(10, 3))
    assert fresh == (words(1, 2, 3) if told is Quality.GOOD else None)


def test_fresh_and_stale_are_decided_alike_at_any_limit(clock: JumpingClock) -> None:
    for tenth in range(1, 400):
        register = DataRegister(clock)
        register.claim(holding(0), POLL, stale_after_s=tenth / 10)
        register.write(holding(0), words(1), POLL)
        clock.pass_s(tenth / 10)
        is_fresh = register.read_fresh(holding(0)) is not None
        assert is_fresh == (quality_of(register, holding(0)) == [Quality.GOOD]), tenth


def test_a_manual_value_becomes_stale_and_a_bad_one_stays_bad(register: DataRegister, clock: JumpingClock) -> None:
    register.claim(holding(0, 3), POLL, stale_after_s=1.0)
    register.write(holding(0), words(1), MENU, Quality.MANUAL)
    register.write(holding(1), words(1), POLL)
    register.mark(holding(1), Quality.BAD, POLL)
    clock.pass_s(60.0)
    assert quality_of(register, holding(0, 3)) == [Quality.STALE, Quality.BAD, Quality.NEVER]


def test_a_new_value_is_good_again(register: DataRegister, clock: JumpingClock) -> None:
    register.claim(holding(0), POLL, stale_after_s=1.0)
    register.write(holding(0), words(1), POLL)
    clock.pass_s(60.0)
    register.write(holding(0), words(2), POLL)
    assert register.samples(holding(0)) == [Sample(2, Quality.GOOD, 0.0, POLL)]


def test_a_claimed_point_that_is_bad_or_never_read_is_not_fresh(register: DataRegister) -> None:
    register.claim(holding(10, 4), POLL, stale_after_s=9.0)
    assert register.read_fresh(holding(13, 5)) is None  # never read
    assert register.read_fresh(holding(14, 5)) == bytes(10)  # filled by no request: always served
    register.write(holding(10, 4), words(1, 2, 3, 4), POLL)
    assert register.read_fresh(holding(8, 9)) == words(0, 0, 1, 2, 3, 4, 0, 0, 0)
    register.mark(holding(11), Quality.BAD, POLL)
    assert register.read_fresh(holding(8, 9)) is None
    assert register.read_fresh(holding(12, 2)) == words(3, 4)


def test_a_claim_ends_with_its_undo(register: DataRegister, clock: JumpingClock) -> None:
    undo = register.claim(holding(0), POLL, stale_after_s=1.0)
    kept = register.claim(holding(5), POLL, stale_after_s=1.0)
    undo()
    clock.pass_s(9.0)
    assert register.read_fresh(holding(0)) == words(0)
    assert register.read_fresh(holding(5)) is None
    kept()


def test_a_block_is_known_once_every_point_was_written_by_someone(register: DataRegister) -> None:
    assert register.known(holding(0, 2)) is None
    register.write(holding(0), words(1), POLL)
    assert register.known(holding(0, 2)) is None
    register.write(holding(1), words(2), SCADA)
    assert register.known(holding(0, 2)) == words(1, 2)
    register.mark(holding(0, 2), Quality.BAD, POLL)
    assert register.known(holding(0, 2)) == words(1, 2)


def test_a_mark_makes_nothing_known(register: DataRegister) -> None:
    register.mark(holding(0), Quality.BAD, POLL)
    assert register.known(holding(0)) is None


def test_one_point_that_others_wrote_makes_a_known_block_a_command(register: DataRegister) -> None:
    register.write(holding(0, 2), words(1, 2), POLL)
    assert register.known(holding(0, 2), commanded=True) is None
    register.write(holding(1), words(5), SCADA)
    assert register.known(holding(0, 2), commanded=True) == words(1, 5)
    assert register.known(holding(1, 2), commanded=True) is None  # nobody knows point 2


@pytest.mark.parametrize("source", [SCADA, MENU, RETAINED], ids=lambda source: str(source.kind.value))
def test_what_a_request_read_is_no_command_but_what_others_wrote_is(register: DataRegister, source: Source) -> None:
    register.write(holding(0), words(1), POLL)
    assert register.known(holding(0), commanded=True) is None
    register.write(holding(0), words(2), source)
    assert register.known(holding(0), commanded=True) == words(2)


def test_a_source_shows_its_name_and_whether_it_commands() -> None:
    assert str(SCADA) == "scada 10.0.0.5:40232"
    assert [source.commands for source in (POLL, SCADA, MENU, RETAINED)] == [False, True, True, False]


# ------------------------------------------------------------------------------------------------ mask write


@pytest.mark.parametrize(
    ("old", "and_mask", "or_mask", "new"),
    [
        (0x12, 0xF2, 0x25, 0x17),  # the example of section 6.16
        (0xABCD, 0xFFFF, 0xFFFF, 0xABCD),
        (0xABCD, 0x0000, 0x1234, 0x1234),
        (0xABCD, 0x00FF, 0xFF00, 0xFFCD),
    ],
)
def test_a_mask_write_changes_the_masked_bits(
    register: DataRegister, old: int, and_mask: int, or_mask: int, new: int
) -> None:
    register.write(holding(4), words(old), POLL)
    register.mask_write(holding(4), and_mask, or_mask, SCADA)
    assert register.samples(holding(4)) == [Sample(new, Quality.GOOD, 0.0, SCADA)]


@pytest.mark.parametrize("filled", ["never", "zeros for a failed poll"])
def test_a_mask_write_to_a_point_nobody_knows_is_refused_where_it_would_go_to_a_device(
    register: DataRegister, filled: str
) -> None:
    """Function 22 changes some bits: the others would be zeros that nobody wanted."""
    queue = CommandQueue(register, JumpingClock(), wake=lambda: None)
    queue.add(Outlet(holding(4), POLL))
    if filled != "never":
        register.write(holding(4), words(0x1234), POLL)
        register.write(holding(4), words(0), POLL, Quality.BAD)
    before = register.samples(holding(4))
    told: list[Written] = []
    register.watch(told.append)
    with pytest.raises(PointUnknown):
        register.mask_write(holding(4), 0xFFFE, 0x0001, SCADA)
    assert (register.samples(holding(4)), told, len(queue)) == (before, [], 0)
    assert answer(bytes.fromhex("16 0004 FFFE 0001"), Server(register, SCADA)) == b"\x96\x04"
    register.mask_write(holding(5), 0xFFFE, 0x0001, SCADA)  # no device is to get it
    assert register.read(holding(5)) == words(1)
    register.write(holding(4), words(0x1234), POLL)
    register.mask_write(holding(4), 0xFFFE, 0x0001, SCADA)
    assert register.read(holding(4)) == words(0x1235)


# ------------------------------------------------------------------------------------------------ zeros for a failure


def test_zeros_for_a_failed_poll_keep_what_is_known_and_make_nothing_known(
    register: DataRegister, clock: JumpingClock
) -> None:
    register.write(holding(0), words(7), SCADA)
    clock.pass_s(5.0)
    register.write(holding(0, 2), words(0, 0), POLL, Quality.BAD)
    assert register.samples(holding(0, 2)) == [Sample(0, Quality.BAD, 0.0, POLL), Sample(0, Quality.BAD, None, POLL)]
    assert register.known(holding(0)) == words(0)
    assert register.known(holding(1)) is None


def test_zeros_for_a_failed_poll_are_no_command_not_even_beside_one(register: DataRegister) -> None:
    register.write(holding(0, 2), words(7, 8), SCADA)
    register.write(holding(0, 2), words(0, 0), POLL, Quality.BAD)
    assert register.known(holding(0, 2), commanded=True) is None
    register.write(holding(0), words(9), SCADA)
    assert register.known(holding(0), commanded=True) == words(9)
    assert register.known(holding(0, 2), commanded=True) is None
    register.write(holding(1), words(8), POLL)  # read again: that is what the device has
    assert register.known(holding(0, 2), commanded=True) == words(9, 8)


def test_a_mark_of_unfilled_points_leaves_alone_what_a_request_fills(register: DataRegister) -> None:
    register.claim(holding(1, 2), POLL, stale_after_s=9.0)
    register.write(holding(0, 4), words(1, 2, 3, 4), SCADA)
    register.mark_unfilled(holding(0, 4), Quality.BAD)
    assert quality_of(register, holding(0, 4)) == [Quality.BAD, Quality.GOOD, Quality.GOOD, Quality.BAD]


# ------------------------------------------------------------------------------------------------ watchers


def test_a_watcher_is_told_of_each_block_as_written(register: DataRegister) -> None:
    told: list[Written] = []
    register.watch(told.append)
    register.write(coils(3, 10), b"\xff\x03", SCADA)
    register.write(holding(0, 2), words(1, 2), MENU, Quality.MANUAL)
    register.mask_write(holding(0), 0, 9, SCADA)
    assert told == [
        Written(coils(3, 10), b"\xff\x03", SCADA, Quality.GOOD),
        Written(holding(0, 2), words(1, 2), MENU, Quality.MANUAL),
        Written(holding(0), words(9), SCADA, Quality.GOOD),
    ]


def test_a_refused_write_and_a_mark_are_not_told(register: DataRegister) -> None:
    told: list[Written] = []
    register.watch(told.append)
    with pytest.raises(RequestInvalid):
        register.write(holding(0), b"", POLL)
    register.mark(holding(0), Quality.BAD, POLL)
    assert told == []


def test_a_watcher_is_told_nothing_after_its_undo(register: DataRegister) -> None:
    told: list[str] = []
    undo = register.watch(lambda written: told.append("first"))
    register.watch(lambda written: told.append("second"))
    register.write(holding(0), words(1), POLL)
    undo()
    register.write(holding(0), words(1), POLL)
    assert told == ["first", "second", "second"]


def test_a_watcher_may_read_and_write_the_register_and_order_is_kept(register: DataRegister) -> None:
    told: list[tuple[int, bytes]] = []

    def copy_up(written: Written) -> None:
        told.append((written.span.start, register.read(written.span)))
        if written.span.start < 3:
            register.write(holding(written.span.start + 1), written.data, POLL)

    register.watch(copy_up)
    register.watch(lambda written: told.append((-written.span.start, b"")))
    register.write(holding(0), words(9), POLL)
    nine = words(9)
    assert told == [(0, nine), (0, b""), (1, nine), (-1, b""), (2, nine), (-2, b""), (3, nine), (-3, b"")]


def test_a_watcher_that_raises_blocks_no_later_telling(register: DataRegister) -> None:
    told: list[bytes] = []

    def break_once(written: Written) -> None:
        if not told:
            told.append(b"broken")
            raise ZeroDivisionError

    register.watch(break_once)
    register.watch(lambda written: told.append(written.data))
    with pytest.raises(ZeroDivisionError):
        register.write(holding(0), words(1), POLL)
    register.write(holding(0), words(2), POLL)
    assert told == [b"broken", words(2)]
    assert register.read(holding(0)) == words(2)
