"""Three slaves of ours, foreign slaves and a foreign master on one pair of wires: nobody of ours speaks out of turn.

The claim is proved on the transcript of the line, byte for byte: it has to be what the script of the foreigners and the
answers of our units make, and nothing else. Our units hold different words, so that an answer of the wrong one, or with
old data, differs. Ptys are real; what each station says reaches all others. Frames and checksums come from
``tests.lines``, and no limit or length from the gateway.

Silences are those of the protocol, at 9600 baud: 3.5 characters are 3.6 ms; the foreign master keeps them 2 to 6 times
that long, and never cuts a frame by a pause near the character timeout. Whatever else is waited for is an event.
"""

from __future__ import annotations

import contextlib
import itertools
import random
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from gateway.config import SlaveConfig
from gateway.modbus.pdu import Span, Table
from gateway.register import DataRegister, Source, SourceKind
from tests.lines import CLOCK, ascii_frame, holding, rtu_frame
from tests.shared_line import Foreigner, OurSlave, Said, SharedLine, in_runs, keep_silence, slaves_on

BAUD = 9600
CHARACTER_S = 10 / BAUD
SILENCE_S = 3.5 * CHARACTER_S
CHARACTER_TIMEOUT_S = 0.15  # what a pause within a frame may last on the slowest machine, and longer
OUR_UNITS = (1, 17, 16)  # 16 and 3 are function codes, too: a framer that slips by a byte takes them for such
FOREIGN_UNITS = (3, 40)
ABSENT_UNIT = 44
BROADCAST = 0
UNKNOWN = 0x41  # a function that nobody but its maker knows
LENGTH_UNKNOWN = ("C1 01", "83 03")  # the answers to a function nobody knows, and to a byte missing
WORDS = 8
MENU = Source(SourceKind.MENU, "menu")
ENCODE: dict[str, Callable[[str, int], bytes]] = {"rtu": rtu_frame, "ascii": ascii_frame}

both_framings = pytest.mark.parametrize("framing", ["rtu", "ascii"])


def words_text(words: list[int]) -> str:
    return struct.pack(f">{len(words)}H", *words).hex()


class Scene:
    """Everybody on the line, what our units ought to hold, and what ought to have been said."""

    def __init__(self, framing: str, line: SharedLine, seed: int) -> None:
        self.framing, self.line, self.rng = framing, line, random.Random(seed)
        self.words = {unit: [0x1000 * place + address for address in range(WORDS)]
                      for place, unit in enumerate(OUR_UNITS, 1)}  # fmt: skip
        self.master = Foreigner(line, "master")
        self.others = {unit: Foreigner(line, f"foreign {unit}") for unit in FOREIGN_UNITS}
        self.ours: dict[int, OurSlave] = {}
        self.expected: Said = []
        self._answered = dict.fromkeys(OUR_UNITS, 0)

    def frame(self, pdu: str, unit: int) -> bytes:
        return ENCODE[self.framing](pdu, unit)

    def say(self, station: Foreigner, data: bytes, whole: int = 0) -> None:
        """Let *station* say *data*, sometimes in slices, of which the first has *whole* bytes or more."""
        places = range(max(1, whole), len(data))
        cuts = tuple(sorted(self.rng.sample(places, min(len(places), self.rng.choice([0, 0, 1, 2, 5])))))
        self.expected.append((station.who, data))
        station.say(data, cuts, self.rng.choice([0.0, 2 * SILENCE_S]))

    def tell(self, station: Foreigner, pdu: str, unit: int) -> None:
        """Let *station* say a frame in one piece."""
        data = self.frame(pdu, unit)
        self.expected.append((station.who, data))
        station.say(data)

    def is_answered(self, unit: int, reply_pdu: str) -> None:
        """Wait for our unit's reply, which is the next to be said."""
        slave, reply = self.ours[unit], self.frame(reply_pdu, unit)
        self._answered[unit] += len(reply)
        self.expected.append((slave.who, reply))
        self.line.wait_until(lambda: slave.has_said(self._answered[unit]), f"the answer {reply.hex(' ')} of {unit}")

    def rest(self) -> None:
        """Wait until nobody of ours has anything more to say, or to forget; compare what was said."""
        self.line.wait_until(lambda: all(slave.is_at_rest() for slave in self.ours.values()), "all are at rest")
        said, expected = in_runs(self.line.said), in_runs(self.expected)
        assert said == expected, self.line.lately()

    def let_silence_be_heard(self) -> None:
        """Wait until each of ours has noticed the end of what was said, however late it got the processor."""
        ears = [slave.ear for slave in self.ours.values()]
        self.line.wait_until(lambda: all(ear.has_heard_silence() for ear in ears), "silence is heard")

    def pause(self) -> None:
        """Let the next frame begin soon, or once everybody is at rest."""
        if self.rng.random() < 0.3:
            self.rest()
        else:
            keep_silence(self.rng.uniform(2, 6) * SILENCE_S)

    def ask(self, unit: int, request_pdu: str, reply_pdu: str) -> None:
        """Ask one of ours; if the request does not say how long it is, silence has to, before and after."""
        request, is_unknown = self.frame(request_pdu, unit), reply_pdu in LENGTH_UNKNOWN
        if is_unknown:
            self.let_silence_be_heard()
        self.say(self.master, request, whole=len(request) if is_unknown else 0)
        self.is_answered(unit, reply_pdu)

    def ask_for_all(self, unit: int) -> None:
        """Read every word of *unit*."""
        self.ask(unit, f"03 0000 {WORDS:04X}", f"03 {2 * WORDS:02X} {words_text(self.words[unit])}")


@contextmanager
def shared(framing: str, seed: int = 0, character_s: float = 0.0) -> Iterator[Scene]:
    """Give a scene with our slaves listening; in the end all is at rest, and compared once more."""
    with contextlib.ExitStack() as stack:
        line = stack.enter_context(contextlib.closing(SharedLine(character_s)))
        scene = Scene(framing, line, seed)
        for station in (scene.master, *scene.others.values()):
            stack.callback(station.close)
        plain = {"line": "/dev/ttyS2", "parity": "none", "data_bits": 8, "baudrate": BAUD, "framing": framing}
        configs, registers = [], []
        for unit in OUR_UNITS:
            own = {"name": f"ours {unit}".replace(" ", "-"), "unit": unit, "character_timeout": CHARACTER_TIMEOUT_S}
            configs.append(SlaveConfig.model_validate(plain | own))
            registers.append(DataRegister(CLOCK))
            span = Span(Table.HOLDING_REGISTERS, 0, WORDS)
            registers[-1].write(span, bytes.fromhex(words_text(scene.words[unit])), MENU)
        slaves = stack.enter_context(slaves_on(line, configs, registers))
        scene.ours = {slave.unit: slave for slave in slaves}
        yield scene
        scene.rest()
        for unit, slave in scene.ours.items():
            assert holding(slave.register, 0, WORDS) == scene.words[unit]
            assert framing == "ascii" or all(pause_s >= SILENCE_S for pause_s in line.pauses_before(slave.who))


# ------------------------------------------------------------------------------------------------ what is said


@dataclass(frozen=True)
class Exchange:
    """A request to one of our units, its reply, and the words afterwards."""

    request_pdu: str
    reply_pdu: str
    words: list[int]


def a_request(rng: random.Random, words: list[int]) -> Exchange:
    """Return anything that a master may ask a unit that holds *words*."""
    first = rng.randrange(WORDS)
    count = rng.randint(1, WORDS - first)
    kind = rng.choice(["read", "read", "write", "write one", "read and write", "loop", "unknown", "beyond", "missing"])
    part = words_text(words[first : first + count])
    new = [rng.randrange(0x10000) for _ in range(count)]
    if kind == "read":
        return Exchange(f"03 {first:04X}{count:04X}", f"03 {2 * count:02X}{part}", words)
    if kind in ("write", "read and write"):
        after = words[:first] + new + words[first + count :]
        data = f"{first:04X}{count:04X}{2 * count:02X}{words_text(new)}"
        if kind == "write":
            return Exchange(f"10 {data}", f"10 {first:04X}{count:04X}", after)
        return Exchange(f"17 0000 0008 {data}", f"17 10 {words_text(after)}", after)
    if kind == "write one":
        return Exchange(*2 * (f"06 {first:04X}{new[0]:04X}",), words[:first] + new[:1] + words[first + 1 :])
    if kind == "loop":
        return Exchange(*2 * (f"08 0000 {new[0]:04X}",), words)
    if kind == "unknown":
        return Exchange("41" + rng.randbytes(rng.randint(0, 9)).hex(), "C1 01", words)
    return Exchange("03 FFFF 0002", "83 02", words) if kind == "beyond" else Exchange("03 0000 00", "83 03", words)


def a_foreign_exchange(scene: Scene) -> tuple[str, str]:
    """Return a request to a foreign unit and its reply: tables, functions nobody knows, exceptions, and quotes.

    A quote is a whole valid request to one of our units within the data, as devices send that carry others' traffic.
    """
    rng = scene.rng
    victim = rng.choice(OUR_UNITS)
    quote = scene.frame(f"06 0001 {rng.randrange(0x10000):04X}", victim).hex()
    count = rng.randint(1, 60)
    padded = quote + "00" * (len(quote) // 2 % 2)
    size = len(padded) // 2
    return rng.choice(
        [
            (f"03 0000 {count:04X}", f"03 {2 * count:02X} {rng.randbytes(2 * count).hex()}"),
            (f"10 0000 {count:04X} {2 * count:02X} {rng.randbytes(2 * count).hex()}", f"10 0000 {count:04X}"),
            (f"41 {rng.randbytes(rng.randint(0, 30)).hex()}", f"41 {rng.randbytes(rng.randint(0, 200)).hex()}"),
            (f"41 {quote}", f"41 {quote} {rng.randbytes(3).hex()}"),
            ("03 0000 0010", "83 02"),
            ("41", "C1 01"),
            ("06 0001 0003", "06 0001 0003"),
            (f"03 0000 {size // 2:04X}", f"03 {size:02X} {padded}"),
            (f"10 0000 {size // 2:04X} {size:02X} {padded}", f"10 0000 {size // 2:04X}"),
            (f"03 0000 {size + 1:04X}", f"03 {2 * size + 2:02X} 0102 {padded} {padded}"),
        ]
    )


# ------------------------------------------------------------------------------------------------ who is asked


def ask_ours(scene: Scene) -> None:
    """One of ours is asked, sometimes twice or three times without delay."""
    unit = scene.rng.choice(OUR_UNITS)
    for _ in range(scene.rng.choice([1, 1, 1, 2, 3])):
        exchange = a_request(scene.rng, scene.words[unit])
        scene.words[unit] = exchange.words
        scene.ask(unit, exchange.request_pdu, exchange.reply_pdu)
        scene.pause()


def ask_others(scene: Scene) -> None:
    """A foreign unit is asked, and answers after a silence, or at once, or in one burst with the request."""
    unit = scene.rng.choice(FOREIGN_UNITS)
    request, reply = (scene.frame(pdu, unit) for pdu in a_foreign_exchange(scene))
    for station, frame in ((scene.master, request), (scene.others[unit], reply)):
        is_unknown = scene.framing == "rtu" and frame[1] == UNKNOWN  # ends with silence: nobody may pause in it
        scene.say(station, frame, len(frame) if is_unknown else 0)
        if station is scene.master and scene.rng.random() < 0.5:
            scene.pause()
    scene.pause()


def ask_nobody(scene: Scene) -> None:
    """A unit that is not there is asked: the master's timeout is over, and it asks again."""
    request = scene.frame(f"03 0000 {scene.rng.randint(1, 9):04X}", ABSENT_UNIT)
    for _ in range(scene.rng.randint(1, 3)):
        scene.say(scene.master, request)
        scene.pause()


def ask_everybody(scene: Scene) -> None:
    """A broadcast is carried out by all of ours; the master keeps its turnaround delay."""
    address, value = scene.rng.randrange(WORDS), scene.rng.randrange(0x10000)
    scene.rest()
    scene.say(scene.master, scene.frame(f"06 {address:04X}{value:04X}", BROADCAST))
    for words in scene.words.values():
        words[address] = value
    scene.rest()


def damage(scene: Scene) -> None:
    """A frame is damaged, whoever's it is; nobody of ours says anything, and after a silence each is there again."""
    unit = scene.rng.choice([*OUR_UNITS, *FOREIGN_UNITS, BROADCAST])
    pdu = a_request(scene.rng, [1] * WORDS).request_pdu if unit not in FOREIGN_UNITS else a_foreign_exchange(scene)[1]
    station = scene.others.get(unit, scene.master)
    kinds = DAMAGES[scene.framing]
    how = scene.rng.choice(kinds if unit else kinds[:3])  # a broadcast before noise is whole, and carried out
    damaged = how(scene.rng, scene.frame(pdu, unit))
    if is_request_to_us(damaged[-8:]):
        return  # the end of a quote, which nobody can tell from a request after noise
    scene.rest()
    scene.say(station, damaged, whole=len(damaged))
    scene.rest()  # the character timeout is over
    scene.ask_for_all(scene.rng.choice(OUR_UNITS))


def ask_with_noise(scene: Scene) -> None:
    """A byte or two of noise, as a driver makes that is switched on, come right before a request."""
    unit = scene.rng.choice(OUR_UNITS)
    noise = bytes(scene.rng.choice(NOISE) for _ in range(scene.rng.randint(1, 2)))
    exchange = a_request(scene.rng, scene.words[unit])
    if exchange.reply_pdu in LENGTH_UNKNOWN:
        return  # silence alone tells where such a request ends, and the noise where it begins
    scene.rest()
    scene.words[unit] = exchange.words
    data = noise + scene.frame(exchange.request_pdu, unit)
    scene.say(scene.master, data, whole=len(data))
    scene.is_answered(unit, exchange.reply_pdu)
    scene.rest()


def is_request_to_us(data: bytes) -> bool:
    """Tell whether *data* is a whole RTU frame of one of our units."""
    return data[0] in OUR_UNITS and data == rtu_frame(data[1:-2].hex(), data[0])


NOISE = b"\x00\xff\xfe\x80\x55\x7f"  # no colon


def with_a_bit_flipped(rng: random.Random, frame: bytes) -> bytes:
    """Return *frame* with one bit wrong; of a hexadecimal letter not the one that only makes it small."""
    place, bit = rng.randrange(len(frame)), rng.choice([0, 1, 2, 3, 4, 6, 7])
    return frame[:place] + bytes([frame[place] ^ 1 << bit]) + frame[place + 1 :]


def without_its_end(rng: random.Random, frame: bytes) -> bytes:
    return frame[: rng.randint(1, len(frame) - 1)]


def without_its_beginning(rng: random.Random, frame: bytes) -> bytes:
    return frame[rng.randint(1, len(frame) - 1) :]


def noise_alone(rng: random.Random, frame: bytes) -> bytes:
    return bytes(rng.choice(NOISE) for _ in range(rng.randint(1, 300)))


def with_noise_after(rng: random.Random, frame: bytes) -> bytes:
    """Return *frame* and some noise; not a zero, after which the CRC of all together is right, too."""
    return frame + bytes(rng.choice(NOISE[1:]) for _ in range(rng.randint(1, 5)))


Damage = Callable[[random.Random, bytes], bytes]
DAMAGES: dict[str, tuple[Damage, ...]] = {
    "rtu": (with_a_bit_flipped, without_its_end, without_its_beginning, with_noise_after),
    "ascii": (with_a_bit_flipped, without_its_end, without_its_beginning, noise_alone),  # CR LF ends it, noise or not
}

TALKS = (ask_ours, ask_ours, ask_ours, ask_others, ask_others, ask_others, ask_nobody, ask_everybody, damage,
         ask_with_noise)  # fmt: skip


def talk(scene: Scene, count: int) -> None:
    """Let the foreign master do *count* things in a random order; each of our units is asked in the end."""
    for _ in range(count):
        scene.rng.choice(TALKS)(scene)
    for unit in OUR_UNITS:
        scene.ask_for_all(unit)
        scene.pause()


# ------------------------------------------------------------------------------------------------ tests


@pytest.mark.parametrize(("framing", "seed"), [("rtu", 1), ("rtu", 2), ("ascii", 1), ("ascii", 2)])
def test_among_strangers_each_request_is_answered_once_by_its_unit_and_nothing_else_is_said(
    framing: str, seed: int
) -> None:
    with shared(framing, seed) as scene:
        talk(scene, 35)


@both_framings
def test_at_the_pace_of_the_wire_it_is_the_same(framing: str) -> None:
    with shared(framing, 3, CHARACTER_S) as scene:
        talk(scene, 10)


@pytest.mark.parametrize("how", ["together", "in hand"])
@pytest.mark.parametrize("follower", ["request", "exchange", "broadcast", "answered request", "part"])
@both_framings
def test_a_slave_that_was_kept_from_reading_answers_nothing_stale(framing: str, follower: str, how: str) -> None:
    """Its master has given up and asked others by the time it reads: several frames lie in its port."""
    late, other = OUR_UNITS[0], OUR_UNITS[1]
    with shared(framing) as scene:
        scene.ours[late].ear.hold(how)
        for value in (0x1111, 0x2222):
            scene.tell(scene.master, f"06 0002 {value:04X}", late)  # a write that comes too late is none
            keep_silence(3 * SILENCE_S)
        if follower == "request":
            scene.tell(scene.master, "03 0000 0001", ABSENT_UNIT)
        elif follower == "exchange":
            scene.tell(scene.master, "03 0000 0002", FOREIGN_UNITS[0])
            scene.tell(scene.others[FOREIGN_UNITS[0]], "03 04 0001 0002", FOREIGN_UNITS[0])
        elif follower == "broadcast":
            scene.tell(scene.master, "06 0003 0333", BROADCAST)
            for words in scene.words.values():
                words[3] = 0x0333
        elif follower == "answered request":
            scene.ask_for_all(other)
        else:
            scene.expected.append(("master", scene.frame("03 0000 0001", other)[:5]))
            scene.master.say(scene.expected[-1][1])
        keep_silence(3 * SILENCE_S)
        scene.ours[late].ear.release()
        scene.rest()
        scene.ask_for_all(late)


@pytest.mark.parametrize("how", ["together", "in hand"])
@both_framings
def test_a_slave_that_was_kept_from_reading_answers_the_last_request_alone(framing: str, how: str) -> None:
    late, other = OUR_UNITS[2], OUR_UNITS[0]
    with shared(framing) as scene:
        scene.ours[late].ear.hold(how)
        scene.tell(scene.master, "06 0002 1111", late)
        keep_silence(3 * SILENCE_S)
        scene.ask_for_all(other)
        keep_silence(3 * SILENCE_S)
        scene.tell(scene.master, "06 0002 2222", late)
        scene.ours[late].ear.release()
        scene.words[late][2] = 0x2222
        scene.is_answered(late, "06 0002 2222")
        scene.rest()
        scene.ask_for_all(late)


def test_a_request_with_any_one_digit_wrong_is_not_answered() -> None:
    """In ASCII, where the LRC is all that tells: each digit that one flipped bit turns into another."""
    with shared("ascii") as scene:
        request = scene.frame("06 0001 0003", OUR_UNITS[1])
        for place, bit in itertools.product(range(1, len(request) - 2), range(7)):
            damaged = request[:place] + bytes([request[place] ^ 1 << bit]) + request[place + 1 :]
            if damaged[place] in b"0123456789ABCDEF":
                scene.expected.append((scene.master.who, damaged))
                scene.master.say(damaged)
        scene.rest()
        scene.ask_for_all(OUR_UNITS[1])


@pytest.mark.parametrize("is_finished", [False, True], ids=["cut", "pause"])
@pytest.mark.parametrize("head", ["03 0B 00", "03 0D 00 00 00", "10 0000 0005 0A"])
def test_a_quote_right_before_a_pause_in_a_foreign_frame_is_not_answered(head: str, is_finished: bool) -> None:
    """The frame says how long it is, so its pause is none of a frame's end."""
    unit = FOREIGN_UNITS[1]
    with shared("rtu") as scene:
        quote = rtu_frame("06 0001 4444", OUR_UNITS[1])
        frame = rtu_frame(head + quote.hex() + "00 00", unit)
        stop = frame.index(quote) + len(quote)
        said = frame if is_finished else frame[:stop]
        scene.expected.append((scene.master.who, said))
        scene.master.say(said, (stop,) if is_finished else (), 3 * SILENCE_S)
        scene.rest()
        for ours in OUR_UNITS:
            scene.ask_for_all(ours)
            keep_silence(3 * SILENCE_S)


@pytest.mark.parametrize("request_pdu", ["41", "41 0102 03", "03 0000 00"])
def test_right_after_foreign_frames_of_a_length_nobody_knows_any_request_is_answered(request_pdu: str) -> None:
    """Two in a burst cannot be told apart; the silence after them ends them both, long before any timeout."""
    unit, reply_pdu = OUR_UNITS[0], "83 03" if request_pdu.startswith("03") else "C1 01"
    burst = rtu_frame("41 0102 03", FOREIGN_UNITS[0]) + rtu_frame("41 05", FOREIGN_UNITS[0])
    with shared("rtu") as scene:
        scene.expected.append((scene.master.who, burst))
        scene.master.say(burst)
        scene.let_silence_be_heard()
        scene.tell(scene.master, request_pdu, unit)
        scene.is_answered(unit, reply_pdu)
