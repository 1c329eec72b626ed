"""The file of retained values: its format, the ages in it, and what becomes of one that is damaged or missing."""

from __future__ import annotations

import logging
import os
import random
import struct
from dataclasses import replace
from pathlib import Path

import pytest

from gateway.errors import SaveError
from gateway.modbus.pdu import Span, Table
from gateway.register import RESTORED, DataRegister, Kept, Quality, Sample
from gateway.retained import (
    BLOCK,
    CLOCK_SET_S,
    HEADER,
    MAGIC,
    RetainedFile,
    Snapshot,
    age_after,
    decode,
    encode,
    kept,
    without_ages,
)
from gateway.snapshots import sealed
from tests.fakes import SCADA, JumpingClock, words
from tests.points import POLL, coils, holding, values

HOLDING = Table.HOLDING_REGISTERS
NOW_S = 1_700_000_000
BLOCKS = [
    Kept(coils(3, 5), b"10110", 12.0, True),
    Kept(holding(0, 2), words(555, 65535), 0.0, False),
    Kept(holding(2, 1), words(7), None, True),
    Kept(holding(65535, 1), words(1), 4294967294.0, False),
]
CONTENT = encode(Snapshot(NOW_S, BLOCKS))


def restored(register: DataRegister, *blocks: Kept) -> DataRegister:
    register.restore(blocks)
    return register


def samples(register: DataRegister, start: int, count: int = 1) -> list[Sample]:
    return register.samples(holding(start, count))


# ------------------------------------------------------------------------------------------------ the format


def test_what_was_encoded_is_decoded() -> None:
    assert decode(CONTENT) == Snapshot(NOW_S, BLOCKS)
    assert decode(encode(Snapshot(0, []))) == Snapshot(0, [])


def test_a_block_is_table_point_count_age_command_and_values() -> None:
    body = CONTENT[CONTENT.index(b"\n") + 1 :]
    assert body.startswith(
        b"rtugate values\0\1"
        b"\0\0\0\0\x65\x53\xf1\x00"  # 1700000000 s since 1970
        b"\0\0\0\x04"  # four blocks
        b"\1\0\3\0\0\0\5\0\0\0\x0c\1" + b"10110"  # coils from 3 on, five, 12 s old, once a command
        b"\3\0\0\0\0\0\2\0\0\0\0\0" + b"\x02\x2b\xff\xff"  # holding registers 0 and 1, new, only ever read
    )


def test_ages_are_rounded_up_to_whole_seconds_and_one_that_does_not_fit_is_not_known() -> None:
    ages = [0.0, 0.25, 1.0, 1.001, -0.5, 4294967294.0, 4294967295.0, 1e12]
    blocks = [Kept(holding(n), words(n), age_s, True) for n, age_s in enumerate(ages)]
    assert [block.age_s for block in decode(encode(Snapshot(0, blocks))).blocks] == [
        0,
        1,
        1,
        2,
        0,
        4294967294,
        None,
        None,
    ]


def test_no_flipped_bit_goes_unnoticed() -> None:
    for place in range(8 * len(CONTENT)):
        damaged = bytearray(CONTENT)
        damaged[place // 8] ^= 1 << place % 8
        with pytest.raises(SaveError, match="its checksum does not fit"):
            decode(bytes(damaged))


def test_nothing_cut_off_goes_unnoticed() -> None:
    for length in range(len(CONTENT)):
        with pytest.raises(SaveError, match="its checksum does not fit"):
            decode(CONTENT[:length])


@pytest.mark.parametrize("more", [b"\0", b"\n", CONTENT], ids=["a NUL", "a line end", "the same again"])
def test_nothing_added_goes_unnoticed(more: bytes) -> None:
    with pytest.raises(SaveError, match="its checksum does not fit"):
        decode(CONTENT + more)
    with pytest.raises(SaveError, match="its checksum does not fit"):
        decode(more + CONTENT)


def a_body(*parts: bytes, count: int = 1) -> bytes:
    return sealed(MAGIC + HEADER.pack(NOW_S, count) + b"".join(parts))


@pytest.mark.parametrize(
    "content",
    [
        a_body(BLOCK.pack(3, 0, 1, 0, False) + words(7), count=2),
        a_body(BLOCK.pack(3, 0, 1, 0, False) + words(7), count=0),
        a_body(BLOCK.pack(3, 0, 2, 0, False) + words(7)),
        a_body(BLOCK.pack(3, 0, 1, 0, False) + words(7) + b"\0"),
        a_body(BLOCK.pack(3, 0, 0, 0, False)),
        a_body(BLOCK.pack(3, 65535, 2, 0, False) + words(7, 8)),
        a_body(BLOCK.pack(3, 0, 0xFFFFFFFF, 0, False) + words(7)),
        a_body(BLOCK.pack(0, 0, 1, 0, False) + words(7)),
        a_body(BLOCK.pack(5, 0, 1, 0, False) + words(7)),
        a_body(BLOCK.pack(1, 0, 2, 0, False) + b"02"),
        a_body(BLOCK.pack(3, 0, 1, 0, False)[:-1]),
        sealed(MAGIC),
        sealed(MAGIC + HEADER.pack(NOW_S, 0)[:-1]),
    ],
    ids=[
        "a block missing",
        "a block too many",
        "values missing",
        "a byte left over",
        "a block of no points",
        "beyond the last point",
        "more points than there are",
        "no table 0",
        "no table 5",
        "a bit that is 2",
        "half a block",
        "no header",
        "half a header",
    ],
)
def test_what_makes_no_sense_is_not_used_even_with_a_right_checksum(content: bytes) -> None:
    with pytest.raises(SaveError, match="it makes no sense"):
        decode(content)


@pytest.mark.parametrize("body", [b"", b"rtugate values\0\2" + HEADER.pack(0, 0), b"other"])
def test_a_format_of_another_version_is_not_guessed_at(body: bytes) -> None:
    with pytest.raises(SaveError, match="it is not of this version of rtugate"):
        decode(sealed(body))


def test_no_bytes_behind_a_right_checksum_raise_anything_else() -> None:
    chance = random.Random(7)
    outcomes = set()
    for _ in range(3000):
        body = bytearray(MAGIC + HEADER.pack(NOW_S, 1) + BLOCK.pack(3, 0, 2, 0, True) + words(7, 8))
        for _ in range(chance.randint(0, 2)):
            body[chance.randrange(len(MAGIC), len(body))] = chance.choice([0, 1, 2, 3, 255])
        try:
            decode(sealed(bytes(body[: chance.choice([len(body), chance.randrange(len(body))])])))
            outcomes.add("decoded")
        except SaveError as error:
            outcomes.add(str(error))
    assert outcomes == {"decoded", "it makes no sense", "it is not of this version of rtugate"}


# ------------------------------------------------------------------------------------------------ the age


@pytest.mark.parametrize(
    ("age_s", "saved_s", "now_s", "after_s"),
    [
        (5.0, NOW_S, NOW_S + 100.0, 105.0),
        (5.0, NOW_S, NOW_S + 0.0, 5.0),
        (5.0, NOW_S, NOW_S - 0.5, None),
        (5.0, NOW_S, 100.0, None),
        (5.0, 100.0, 200.0, None),
        (5.0, 100.0, NOW_S, None),
        (5.0, CLOCK_SET_S, CLOCK_SET_S + 1.0, 6.0),
        (None, NOW_S, NOW_S + 100.0, None),
    ],
    ids=["a while", "at once", "set back", "not set now", "never set", "not set then", "just set", "not known before"],
)
def test_the_age_counts_the_time_the_program_did_not_run_if_the_clock_can_tell(
    age_s: float | None, saved_s: float, now_s: float, after_s: float | None
) -> None:
    assert age_after(age_s, saved_s, now_s) == after_s


# ------------------------------------------------------------------------------------------------ the file


@pytest.fixture
def file(tmp_path: Path) -> RetainedFile:
    return RetainedFile(tmp_path / "state" / "retained.bin")


def test_values_come_back_from_the_file_with_their_age(
    file: RetainedFile, register: DataRegister, clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    block = Kept(holding(5, 2), words(7, 8), 2.0, True)
    file.write(encode(Snapshot(int(clock.wall()), [block, Kept(coils(0), b"1", 2.0, True)])))
    clock.jump_wall(100.5)
    with caplog.at_level(logging.INFO):
        file.restore(register, clock, [HOLDING])
    assert samples(register, 5, 2) == [Sample(n, Quality.STALE, 102.5, RESTORED) for n in (7, 8)]
    assert register.known(coils(0)) is None  # not one of the tables
    assert file.trouble == ""
    assert [record.getMessage() for record in caplog.records] == ["retained values: 2 points are back"]


def test_a_file_from_a_time_before_the_clock_was_set_gives_values_without_ages(
    file: RetainedFile, register: DataRegister, clock: JumpingClock
) -> None:
    file.write(encode(Snapshot(60, [Kept(holding(5), words(7), 2.0, True)])))
    file.restore(register, clock, [HOLDING])
    assert samples(register, 5) == [Sample(7, Quality.STALE, None, RESTORED)]


def test_without_a_file_there_are_no_values_and_no_trouble(
    file: RetainedFile, register: DataRegister, clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    file.restore(register, clock, list(Table))
    assert (file.trouble, file.said, caplog.text) == ("", [], "")


def test_a_damaged_file_is_told_of_and_gives_nothing(
    file: RetainedFile, register: DataRegister, clock: JumpingClock, caplog: pytest.LogCaptureFixture
) -> None:
    chance = random.Random(3)
    for _ in range(50):
        damaged = bytearray(CONTENT)
        damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
        file.write(bytes(damaged))
        file.restore(register, clock, list(Table))
        assert all(not kept(register, table, (), clock.monotonic()) for table in Table)
    assert file.trouble == "retained.bin is not used: its checksum does not fit"
    assert file.said is None
    text = f"retained values: {file.trouble}; the values from before the restart are lost"
    assert {record.getMessage() for record in caplog.records} == {text}


def empty(path: Path) -> None:
    path.write_bytes(b"")


def huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 33)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (empty, "its checksum does not fit"),
        (huge, "its checksum does not fit"),
        (Path.mkdir, "it is not a regular file"),
        (os.mkfifo, "it is not a regular file"),
        (lambda path: path.symlink_to(path.name), "Too many levels of symbolic links"),
    ],
    ids=["empty", "8 GiB", "a folder", "a FIFO", "a link to itself"],
)
def test_what_cannot_be_read_is_told_of_and_gives_nothing(
    file: RetainedFile, register: DataRegister, clock: JumpingClock, make: object, reason: str
) -> None:
    file.path.parent.mkdir()
    assert callable(make)
    make(file.path)
    file.restore(register, clock, list(Table))
    assert file.trouble == f"retained.bin is not used: {reason}"
    assert file.said is None


def test_a_file_is_not_for_everybody_to_read(file: RetainedFile) -> None:
    file.write(CONTENT)
    assert file.path.stat().st_mode & 0o777 == 0o640
    assert file.path.parent.stat().st_mode & 0o027 == 0


def test_where_no_folder_can_be_made_the_write_fails_in_words(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file")
    for folder in (tmp_path / "state", tmp_path / "state" / "deeper"):
        with pytest.raises(SaveError, match=r"retained\.bin is not saved: .*(folder|File exists)"):
            RetainedFile(folder / "retained.bin").write(CONTENT)


def test_what_is_forgotten_does_not_come_back(file: RetainedFile, register: DataRegister, clock: JumpingClock) -> None:
    file.write(CONTENT)
    file.restore(register, clock, [])
    file.forget()
    assert not file.path.exists()
    assert file.said == []
    file.forget()  # there is nothing any more


def test_a_file_that_cannot_be_forgotten_is_a_warning(file: RetainedFile, caplog: pytest.LogCaptureFixture) -> None:
    file.path.mkdir(parents=True)
    file.forget()
    assert "retained values: retained.bin cannot be removed" in caplog.text


def test_a_register_goes_through_the_file_unharmed_whatever_is_in_it(tmp_path: Path, clock: JumpingClock) -> None:
    chance = random.Random(11)
    for turn in range(30):
        register, again = (DataRegister(clock, dict.fromkeys(Table, 300)) for _ in range(2))
        for _ in range(chance.randint(0, 40)):
            table = chance.choice(list(Table))
            start = chance.randrange(300)
            span = Span(table, start, chance.randint(1, min(100, 300 - start)))
            quality, source = chance.choice([(Quality.GOOD, SCADA), (Quality.GOOD, POLL), (Quality.BAD, POLL)])
            register.write(span, masked(chance.randbytes(span.size), span), source, quality)
            clock.pass_s(chance.choice([0.0, 1.0]))
        blocks = [b for table in Table for b in kept(register, table, (), clock.monotonic())]
        file = RetainedFile(tmp_path / f"{turn}.bin")
        file.write(encode(Snapshot(int(clock.wall()), blocks)))
        file.restore(again, clock, list(Table))
        back = [b for table in Table for b in kept(again, table, (), clock.monotonic())]
        assert back == blocks
        assert file.said == without_ages(blocks)


def masked(data: bytes, span: Span) -> bytes:
    """*data* without the bits behind the last point."""
    if not span.table.is_bits:
        return data
    return (int.from_bytes(data, "little") & (1 << span.count) - 1).to_bytes(span.size, "little")


def test_the_largest_register_fits(tmp_path: Path, clock: JumpingClock) -> None:
    blocks = [
        Kept(Span(table, point, 1), b"1" if table.is_bits else b"\xff\xff", float(point % 2), True)
        for table in Table
        for point in range(65536)
    ]
    file = RetainedFile(tmp_path / "retained.bin")
    file.write(encode(Snapshot(int(clock.wall()), blocks)))
    register = DataRegister(clock, dict.fromkeys(Table, 65536))
    file.restore(register, clock, list(Table))
    assert file.trouble == ""
    assert register.read(Span(HOLDING, 65535, 1)) == b"\xff\xff"


def test_blocks_are_restored_in_any_order_and_cut_in_any_way(clock: JumpingClock) -> None:
    chance = random.Random(5)
    whole = Kept(holding(0, 50), words(*range(50)), 3.0, True)
    parts = [replace(whole, span=holding(n), values=struct.pack(">H", n)) for n in range(50)]
    chance.shuffle(parts)
    assert values(restored(DataRegister(clock), *parts), 0, 50) == values(restored(DataRegister(clock), whole), 0, 50)
