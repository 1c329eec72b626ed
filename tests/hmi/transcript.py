"""Transcripts of the menu: text files that a person reads and edits, and a test plays (``test_transcripts.py``).

    # what a person may want to know
    station: boiler                       the configuration, stations/boiler.toml
    terminal: 40 columns                  (also: 10 rows; whole lines: it sends each line as a whole)
    -- unit 17: holding 107 = 642 630     what happens before the menu begins; see HAPPENINGS

    >> d 3 107<Enter> 1<Enter>            keys; spaces are nothing, <Space> is one; <Enter> <Esc> <Erase>
    rtugate> d                            below: what the terminal shows from the line on where the cursor stood
    ...
    -- wait 2 s                           something happens; below: what the terminal shows then
    [12 blank lines]                      stands for so many of them

">>" without keys shows all from the start of the menu on. A block without lines below: nothing new is shown.
Spaces at the end of a line, and blank lines at the end of a block, are nothing.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Final

from gateway.hmi.station import Told
from gateway.modbus.pdu import Span, Table, pack_bits, pack_words
from tests.fakes import SCADA, FakeField
from tests.hmi.desk import STATIONS as STATIONS  # other tests have it from here
from tests.hmi.desk import AClient, Desk, DeskStation

FOLDER: Final = Path(__file__).parent / "transcripts"
KEYS: Final = {"<Enter>": "\r", "<Esc>": "\x1b", "<Erase>": "\x7f", "<Space>": " "}
BLANKS_SHOWN: Final = 2  # in a row; more are told by their number
TABLES: Final = {
    "coil": Table.COILS,
    "discrete": Table.DISCRETE_INPUTS,
    "holding": Table.HOLDING_REGISTERS,
    "input": Table.INPUT_REGISTERS,
}


@dataclass
class Block:
    """Keys (">> ...") or something that happens ("-- ..."), the remarks above, and what the terminal shows then."""

    cause: str
    remarks: list[str] = field(default_factory=list)
    shown: list[str] = field(default_factory=list)

    def text(self) -> str:
        return "\n".join([*self.remarks, self.cause, *self.shown])


@dataclass
class Transcript:
    """A file, as parts."""

    head: list[str]
    blocks: list[Block]

    def text(self) -> str:
        return "\n\n".join(["\n".join(self.head).strip(), *(block.text() for block in self.blocks)]) + "\n"


def parse(text: str) -> Transcript:
    """Return *text* as parts; each line before the first ">>" is the head's."""
    head: list[str] = []
    blocks: list[Block] = []
    remarks: list[str] = []
    for line in map(str.rstrip, text.splitlines()):
        if line.startswith((">>", "-- ")) and (blocks or line.startswith(">>")):
            blocks.append(Block(line, remarks))
            remarks = []
        elif line.startswith("# ") and blocks:
            remarks.append(line)
        elif blocks:
            blocks[-1].shown.append(line)
        else:
            head.append(line)
    for block in blocks:
        block.shown = _without_end(block.shown)
    return Transcript(head, blocks)


class Terminal:
    """What a terminal shows of a text: the lines; erasing works."""

    def __init__(self) -> None:
        self.lines = [""]
        self._column = 0

    def show(self, text: str) -> None:
        for character in text:
            if character == "\n":
                self.lines.append("")
                self._column = 0
            elif character == "\b":
                self._column = max(0, self._column - 1)
            else:
                line = self.lines[-1]
                self.lines[-1] = line[: self._column] + character + line[self._column + 1 :]
                self._column += 1


class Player:
    """Plays a transcript on its ``terminal``; ``most_at_once``: the most lines that one key has brought."""

    def __init__(self, head: list[str], language: str = "en", is_ascii: bool = False) -> None:
        settings = dict(line.split(": ", 1) for line in head if line and not line.startswith(("#", "-- ")))
        self.station = DeskStation((STATIONS / f"{settings.pop('station')}.toml").read_text())
        for line in head:
            if line.startswith("-- "):
                happen(self.station, line.removeprefix("-- "))
        terminal = settings.pop("terminal", "")
        assert not re.sub(r"whole lines|\d+ (rows|columns)|, ", "", terminal), f"not known of a terminal: {terminal}"
        sizes = {what: int(number) for number, what in re.findall(r"(\d+) (rows|columns)", terminal)}
        self.desk = Desk(self.station, language, is_ascii, **sizes)
        if "whole lines" in terminal:
            self.desk.menu.ends_keys_with_enter, self.desk.menu.echoes = True, False
        self.terminal = Terminal()
        self.most_at_once = 0
        self._show(self.desk.screen)
        assert not settings, f"not known in the head of a transcript: {settings}"

    def _show(self, text: str) -> None:
        self.terminal.show(text)

    def play(self, block: Block) -> list[str]:
        """Do what *block* says; return what the terminal shows then, from the line on where the cursor stood."""
        start = len(self.terminal.lines) - 1 if block.cause != ">>" else 0
        before = len(self.desk.screen)
        what = block.cause[2:].strip()
        if block.cause.startswith(">>"):
            for typed in keys(what) if self.desk.menu.echoes else lines(what):
                text = self.desk.type(typed)
                brought = text.partition("\n")[2].lstrip("\n")  # the key itself stands in the line above
                self.most_at_once = max(self.most_at_once, brought.count("\n") + 1)
                self._show(text)
        elif waited := re.fullmatch(r"wait (\S+) s", what):
            self._show(self.desk.wait(float(waited[1])))
        elif what == "everything stands still":
            self.desk.is_working = False
        elif what == "everything goes on":
            self.desk.is_working = True
            self._work()
        else:
            happen(self.station, what)
            self._work()
        if start and len(self.desk.screen) == before:
            return []
        return _folded(_without_end([line.rstrip() for line in self.terminal.lines[start:]]))

    def _work(self) -> None:
        before = len(self.desk.screen)
        self.desk.work()
        self._show(self.desk.screen[before:])


def played(text: str, language: str = "en", is_ascii: bool = False) -> tuple[Transcript, Player]:
    """Return the transcript *text* as it comes out today, and who has played it."""
    transcript = parse(text)
    player = Player(transcript.head, language, is_ascii)
    for block in transcript.blocks:
        block.shown = player.play(block)
    return transcript, player


def keys(text: str) -> list[str]:
    """Return the keys of ">> d 3 107<Enter>", one by one; a word too long for its prompt stays in one piece."""
    parts = re.findall(r"<\w+>|[^\s<]+|<", text)
    return [KEYS.get(part, part) if part in KEYS or part.startswith("<") else part for part in parts]


def lines(text: str) -> list[str]:
    """Return what is typed line by line, each with its Enter."""
    return re.findall(r"[^\r]*\r|[^\r]+", "".join(keys(text)))


def _without_end(lines: list[str]) -> list[str]:
    while lines and not lines[-1]:
        lines = lines[:-1]
    return lines


def _folded(lines: list[str]) -> list[str]:
    folded: list[str] = []
    for is_blank, run in groupby(lines, lambda line: not line):
        same = list(run)
        folded += [f"[{len(same)} blank lines]"] if is_blank and len(same) > BLANKS_SHOWN else same
    return folded


# ------------------------------------------------------------------------------------------------ what may happen


def happen(station: DeskStation, what: str) -> None:
    """Have *what* a transcript says happen."""
    for pattern, do in HAPPENINGS.items():
        found = re.fullmatch(pattern, what)
        if found:
            do(station, **found.groupdict())
            return
    raise AssertionError(f"a transcript says what nobody knows: {what}")


def _field(station: DeskStation, line: str | None) -> FakeField:
    return station.fields[line or next(iter(station.fields))]


def _numbers(values: str) -> list[int]:
    return [int(value, 0) for value in values.split()]


def _device_has(station: DeskStation, line: str | None, unit: str, table: str, address: str, values: str) -> None:
    device = _field(station, line)
    kept = device.coils if TABLES[table].is_bits else device.registers
    kept.update({(int(unit), int(address) + n): value for n, value in enumerate(_numbers(values))})


def _scada_writes(station: DeskStation, table: str, point: str, values: str) -> None:
    numbers = _numbers(values)
    data = pack_bits([bool(number) for number in numbers]) if TABLES[table].is_bits else pack_words(numbers)
    station.register.write(Span(TABLES[table], int(point), len(numbers)), data, SCADA)


def _silent(station: DeskStation, line: str | None, unit: str) -> None:
    _field(station, line).silent.add(int(unit))


def _damaging(station: DeskStation, line: str | None, unit: str) -> None:
    _field(station, line).damaging.add(int(unit))


def _well(station: DeskStation, line: str | None, unit: str) -> None:
    device = _field(station, line)
    device.silent.discard(int(unit))
    device.damaging.discard(int(unit))


def _refusing(station: DeskStation, line: str | None, unit: str, function: str, code: str) -> None:
    _field(station, line).refusing[int(unit), int(function)] = int(code)


def _client(station: DeskStation, slave: str, client: str, requests: str) -> None:
    now_s = station.clock.monotonic()
    served = AClient(client, active_s=now_s, since_s=now_s - 4000.0)
    served.counters.requests = served.counters.good = int(requests)
    station.slaves[slave].clients[len(station.slaves[slave].clients)] = served


def _broken(station: DeskStation, name: str, reason: str) -> None:
    if name in station.slaves:
        station.slaves[name].trouble = reason
    else:
        station.unplug(name, reason)


def _set(**values: object) -> Callable[[DeskStation], None]:
    def do(station: DeskStation) -> None:
        for name, value in values.items():
            setattr(station, name, value)

    return do


_UNIT: Final = r"(?:(?P<line>[\w-]+): )?unit (?P<unit>\d+)"
_POINTS: Final = r"(?P<table>coil|discrete|holding|input) {}(?P<{}>\d+) = (?P<values>.+)"
HAPPENINGS: Final[dict[str, Callable[..., None]]] = {
    r"wait (?P<seconds>\S+) s": lambda station, seconds: station.pass_s(float(seconds)),
    _UNIT + r": " + _POINTS.format("", "address"): _device_has,  # what a device has in its table, from address on
    _UNIT + r" is silent": _silent,
    _UNIT + r" answers damaged": _damaging,
    _UNIT + r" is well again": _well,
    _UNIT + r" refuses function (?P<function>\d+) with exception (?P<code>\d+)": _refusing,
    r"SCADA writes " + _POINTS.format("", "point"): _scada_writes,
    r"SCADA (?P<client>\S+) has asked (?P<slave>[\w-]+) (?P<requests>\d+) times": _client,
    r"(?P<name>[\w-]+) is broken: (?P<reason>.+)": _broken,
    r"alarm: (?P<text>.+)": lambda station, text: station.told_alarms.append(Told(text)),
    r"notice: (?P<text>.+)": lambda station, text: station.told_notices.append(Told(text)),
    r"safe mode for (?P<left_s>\d+) s more": lambda station, left_s: station.enter_safe_mode(float(left_s)),
    r"safe mode ends by itself": lambda station: station.leave_safe_mode(),
    r"hardware watchdog: (?P<text>.+)": lambda station, text: setattr(station, "told_watchdog", Told(text)),
    r"the last restart was (?P<text>.+)": lambda station, text: setattr(station, "last_restart", Told(text)),
    r"log: (?P<text>.+)": lambda station, text: station.logged.append(text),
    r"nothing is logged": lambda station: station.logged.clear(),
    r"the file is edited by somebody else": _set(file_is_edited=True),
    r"the file is reloaded": lambda station: station.reload_from_elsewhere(),
    r"saving fails: (?P<reason>.+)": lambda station, reason: setattr(station, "save_problem", reason),
    r"saving changes (?P<count>\d+) lines": lambda station, count: setattr(
        station, "changed_lines", [f"+ line {n}" for n in range(1, int(count) + 1)]
    ),
    r"work takes long": _set(is_slow=True),
    r"work is done": lambda station: station.finish_work(),
    r"work fails: (?P<reason>.+)": lambda station, reason: station.finish_work(reason),
}
