"""Loading the file: every message with its line and its subject, and nothing but ConfigError whatever the bytes."""

from __future__ import annotations

import os
import socket
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from gateway.config import Config
from gateway.config_checks import validate
from gateway.errors import ConfigError
from gateway.store import LARGEST_FILE_BYTES, LocatedFinding, load, load_text

FULL = (Path(__file__).parent / "data" / "full.toml").read_text(encoding="utf-8")

BROKEN = """\
[register]
holding_registers = 500

[[master]]
name = "field"
line = "/dev/ttyS2"
bauderate = 9600            # line 7

[[master.request]]          # line 9: no unit
name = "boiler"
function = "read-holding-registers"
address = 107
count = 3
point = 0

[[master]]
name = "roof"
line = "/dev/ttyS3"
parity = "none"             # line 19

[[master.request]]
name = "fan"
unit = 248                  # line 23
function = 3
address = 40001             # line 25
count = 126                 # line 26
point = 10

[[master]]
name = "three words here"   # line 30
line = "/dev/ttyS4"
request = [
  {unit = 1, function = 3, address = 0, count = 1, point = 0},
  {unit = 1, function = 3, address = 0, point = 0},
  {unit = 1, function = 3, address = 0, count = 1, point = 70000},
]

[[slave]]
name = "scada"
line = "tcp://0.0.0.0:502"
unit = 1
allow = [
  "10.0.0.0/8",
  "192.168.1.5/24",         # line 44
]

[hmi.telnet]
listen = "here"             # line 48

[log]
level = "loud"              # line 51

[colour]                    # line 53
red = 1
"""

SAID = """\
rtugate.toml:7: master "field": unknown key "bauderate"; did you mean "baudrate"?
rtugate.toml:9: master "field", request "boiler": unit is missing: 1 to 247
rtugate.toml:19: note: master "roof": 8N1 is accepted; without parity the standard asks for stop_bits = 2
rtugate.toml:23: master "roof", request "fan": unit 248 is more than 247
rtugate.toml:25: master "roof", request "fan": address 40001 looks like a reference number: \
for holding register 40001 type address = 0; if PDU address 40001 is really meant, type 0x9C41
rtugate.toml:26: master "roof", request "fan": count 126 is more than 125
rtugate.toml:30: master 3: name "three words here" is no name: 1 to 32 letters, digits, - and _
rtugate.toml:33: master 3, request 1: \
point 0: point 0 of holding-registers is already filled by master "field", request "boiler"
rtugate.toml:34: master 3, request 2: count is missing: how many, 1 to the function's limit
rtugate.toml:34: master 3, request 2: another request is called "u1-f3-0" too: give one of them a name
rtugate.toml:34: master 3, request 2: \
point 0: point 0 of holding-registers is already filled by master "field", request "boiler"
rtugate.toml:35: master 3, request 3: point 70000 is more than 65535
rtugate.toml:35: master 3, request 3: another request is called "u1-f3-0" too: give one of them a name
rtugate.toml:44: slave "scada": allow "192.168.1.5/24" is an address inside a network: the network is 192.168.1.0/24
rtugate.toml:48: [hmi.telnet]: listen "here" is not host:port, with a port from 1 to 65535
rtugate.toml:51: [log]: level "loud" is not one of "debug", "info", "warning", "error"
rtugate.toml:53: unknown key "colour"
"""


def errors_of(text: str | bytes) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load_text(text, "rtugate.toml")
    assert str(caught.value).splitlines() == [str(finding) for finding in caught.value.findings]
    return str(caught.value).splitlines()


def test_all_that_is_wrong_is_said_at_once_each_with_its_line() -> None:
    assert errors_of(BROKEN) == SAID.splitlines()


def test_lines_are_the_same_with_carriage_returns() -> None:
    assert errors_of(BROKEN.replace("\n", "\r\n").encode()) == SAID.splitlines()


def test_a_finding_is_a_value_for_programs_too() -> None:
    with pytest.raises(ConfigError) as caught:
        load_text('[log]\nlevel = "loud"', "a.toml")
    message = 'level "loud" is not one of "debug", "info", "warning", "error"'
    assert caught.value.findings == (LocatedFinding("a.toml", 2, "[log]", message, "error"),)


def test_the_full_file_loads_with_its_text_and_what_is_not_carried_out_yet() -> None:
    loaded = load_text(FULL, "full.toml")
    assert loaded.config == Config.model_validate(tomllib.loads(FULL))
    assert loaded.text == FULL
    assert [(one.subject, one.severity) for one in loaded.findings] == [('io "door"', "warning")]


def test_a_finding_about_what_is_not_in_the_file_has_no_line() -> None:
    text = '[[slave]]\nname = "scada"\nunit = 1\nline = "tcp://0.0.0.0:2323"\n'
    assert errors_of(text) == [
        'rtugate.toml: [hmi.telnet]: listen 127.0.0.1:2323 is already used by slave "scada"',
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = 1\n\na = 2\nb = 3", ":3: not TOML: this key is given twice (column 6)"),
        ("[log]\n[log]\n", ":2: not TOML: this table is given twice (column 5)"),
        ("[log]\nlevel = debug\n", ":2: not TOML: this is no value: a text stands in quotes (column 9)"),
        ('[log]\nlevel = "info\n', ":2: not TOML: the quotes of this text are not closed (column 14)"),
        ("[log]\nlevel\n", ":2: not TOML: a key is followed by = and a value (column 6)"),
        ("a = [1,\n2\n\n", ":2: not TOML: Unclosed array, at the end of the file"),
        ("a = 2021-02-30", ":1: not TOML: Invalid date or datetime (column 5)"),
        ("a = 1\0", ":1: not TOML: the line goes on behind its value (column 6)"),
        ("\ufeffa = 1", ":1: the file starts with a byte order mark: save it as UTF-8 without one"),
        (b"\xef\xbb\xbfa = 1", ":1: the file starts with a byte order mark: save it as UTF-8 without one"),
        (b"a = 1\nb = '\xe9'", ":2: this is not UTF-8: save the file in that encoding"),
        ("a = 1\n".encode("utf-16"), ":1: this is not UTF-8: save the file in that encoding"),
        ("a = 1\n\nb = " + "9" * 5000, ":3: a number of thousands of digits"),
        ("b = " + "9_" * 5000 + "9", ":1: a number of thousands of digits"),
        ("\na = " + "[" * 500 + "]" * 500, ":2: nested more than 16 deep"),
        ("a = 1\n" + ".".join("b" * 5000) + " = 1", ":2: nested more than 16 deep"),
        (" " * (LARGEST_FILE_BYTES + 1), ": is larger than 1 MiB"),
    ],
)
def test_what_is_no_toml_is_an_error_like_any_other(text: str | bytes, message: str) -> None:
    assert errors_of(text) == ["rtugate.toml" + message]


def test_nesting_that_exhausts_the_parser_is_an_error_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.toml_text.DEEPEST", 10_000)
    assert errors_of("a = " + "[" * 5000 + "]" * 5000) == ["rtugate.toml: nested too deep"]


# --- reference numbers


def with_address(address: str, function: object = 3, more: str = "") -> str:
    return (
        "[[master]]\nname = 'field'\nline = '/dev/ttyS2'\n[[master.request]]\nunit = 17\n"
        f"address = {address}  # 40001 to 49999 is a handbook's way to count\n"
        f"function = {function!r}\ncount = 1\npoint = 0\n{more}"
    )


def confused(number: int, kind: str, address: int, spelled: str) -> str:
    return (
        f'rtugate.toml:6: master "field", request 1: address {number} looks like a reference number: '
        f"for {kind} {number} type address = {address}; if PDU address {number} is really meant, type {spelled}"
    )


@pytest.mark.parametrize(
    ("spelling", "function", "message"),
    [
        ("40108", 3, confused(40108, "holding register", 107, "0x9CAC")),
        ("40_108", "read_holding_registers", confused(40108, "holding register", 107, "0x9CAC")),
        ("+40001", 6, confused(40001, "holding register", 0, "0x9C41")),
        ("49999", "write-multiple-registers", confused(49999, "holding register", 9998, "0xC34F")),
        ("30010", 4, confused(30010, "input register", 9, "0x753A")),
        ("10001", 2, confused(10001, "discrete input", 0, "0x2711")),
    ],
)
def test_an_address_spelled_like_a_reference_number_is_an_error(spelling: str, function: object, message: str) -> None:
    assert errors_of(with_address(spelling, function)) == [message]


@pytest.mark.parametrize(
    ("spelling", "function"),
    [
        ("0x9CAC", 3),  # as devices with SunSpec's registers have it
        ("0x9c_ac", 3),
        ("0o116254", 3),
        ("0b1001110010101100", 16),
        ("40000", 3),
        ("50000", 3),
        ("30001", 3),
        ("40001", 4),
        ("10001", 1),
        ("10001", 15),
        ("10000", 2),
        ("20000", 2),
    ],
)
def test_any_other_spelling_or_number_is_taken_as_it_is(spelling: str, function: object) -> None:
    loaded = load_text(with_address(spelling, function), "rtugate.toml")
    assert loaded.config.master[0].request[0].address == int(spelling, 0)
    assert loaded.findings == []


def test_a_reference_number_is_found_next_to_other_errors_and_in_inline_tables() -> None:
    assert errors_of(with_address("40108", more="every = 0\n"))[0] == confused(40108, "holding register", 107, "0x9CAC")
    request = "{unit = 1, function = 3, 'address' = 40108, count = 1, point = 0}"
    inline = f"master = [{{name = 'a', line = '/dev/ttyS2', request = [\n{request}]}}]"
    assert [line.partition(" looks")[0] for line in errors_of(inline)] == [
        'rtugate.toml:2: master "a", request 1: address 40108'
    ]


@pytest.mark.parametrize("function", ["none", [3], True, 3.0, 7])
def test_without_a_function_a_reference_number_cannot_be_told(function: object) -> None:
    text = with_address("40108", function).replace("True", "true")
    assert not any("reference" in line for line in errors_of(text))


@pytest.mark.parametrize(
    "text",
    [
        "[master.a.request.b]\naddress = 40108\n",
        "[[master]]\n[[master.request]]\naddress.x = 40108\n",
        "[[master]]\n[[master.request]]\naddress = [40108]\n",
        "[[master]]\n[[master.request]]\naddress = 40108-01-01\n",
        "[[master.request]]\naddress = 40108\nfunction = 3\n",
        "master = [[{request = [{address = 40108}]}]]\n",
    ],
)
def test_an_address_in_a_wrong_place_is_an_error_like_any_other(text: str) -> None:
    assert not any("reference" in line for line in errors_of(text))


# --- files


def errors_of_file(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        load(path)
    return str(caught.value)


def test_a_file_is_loaded_and_called_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "station.toml"
    path.write_text("[log]\nlevel = 'debug'\n", encoding="utf-8")
    assert load(path).config.log.level == "debug"
    path.write_text("[log]\n\nlevel = 1\n", encoding="utf-8")
    assert errors_of_file(path).startswith("station.toml:3: [log]: level 1 ")


def test_a_file_that_cannot_be_read_says_why(tmp_path: Path) -> None:
    assert errors_of_file(tmp_path / "none.toml") == "none.toml: cannot be read: No such file or directory"
    assert errors_of_file(tmp_path) == f"{tmp_path.name}: cannot be read: Is a directory"
    assert errors_of_file(tmp_path / "x" / "none.toml") == "none.toml: cannot be read: No such file or directory"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission_says_so(tmp_path: Path) -> None:
    path = tmp_path / "secret.toml"
    path.touch(mode=0)
    assert errors_of_file(path) == "secret.toml: cannot be read: Permission denied"


def test_a_file_that_is_too_large_is_not_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "large.toml"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # a hole: takes no room
    assert errors_of_file(path) == "large.toml: is larger than 1 MiB"


def test_what_is_no_file_is_refused_unopened(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo.toml"
    os.mkfifo(fifo)  # to open it would wait for a writer
    assert errors_of_file(fifo) == "fifo.toml: is not a regular file"
    assert errors_of_file(Path("/dev/zero")) == "zero: is not a regular file"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        assert errors_of_file(tmp_path / "s") == "s: is not a regular file"


def test_a_name_that_is_too_long_says_so() -> None:
    assert errors_of_file(Path("x" * 300)) == f"{'x' * 255}...: cannot be read: File name too long"


def test_a_folder_without_a_name_is_named() -> None:
    assert errors_of_file(Path()) == ".: cannot be read: Is a directory"


def test_a_file_name_is_shown_without_control_characters() -> None:
    assert str(LocatedFinding("a\x1b[31m\n\udcff.toml", 2, "", "is wrong")) == "a\\x1b[31m\\n\\udcff.toml:2: is wrong"


# --- whatever stands in it


def loads_or_says_why(text: str | bytes) -> None:
    """Whatever else is raised fails the test."""
    refusal: ConfigError | None = None
    try:
        load_text(text, "any.toml")
    except ConfigError as error:
        refusal = error
    if refusal is not None:
        assert any(isinstance(one, LocatedFinding) and one.severity == "error" for one in refusal.findings)
        assert str(refusal).replace("\n", "").isprintable()


words = sorted(set(FULL.replace("[", " ").replace("]", " ").replace(".", " ").split()))
keys = st.sampled_from(words) | st.text(max_size=3)
anything = st.recursive(
    st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=12)
    | st.datetimes()
    | st.sampled_from(["/dev/ttyS2", "tcp://[::1]:502", "rtu", "ascii", "read-coils", "coils", 3, 16, 0, 1, 10**25]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=4),
    max_leaves=10,
)


@given(st.text() | st.binary() | st.text(alphabet="a1.=,[]{}\"'\\# \r\n\0\ufeff"))
def test_any_text_loads_or_says_why_not(text: str | bytes) -> None:
    loads_or_says_why(text)


@given(st.integers(0, len(FULL)), st.integers(0, 30), st.text(max_size=5))
def test_a_damaged_file_loads_or_says_why_not(at: int, lost: int, put: str) -> None:
    loads_or_says_why(FULL[:at] + put + FULL[at + lost :])


@given(st.dictionaries(keys, anything, max_size=6))
def test_any_document_loads_or_says_why_not(document: dict[str, Any]) -> None:
    loads_or_says_why(tomli_w.dumps(document))


@given(st.data())
def test_any_value_in_any_place_loads_or_says_why_not(data: st.DataObject) -> None:
    document = tomllib.loads(FULL)
    node: Any = document
    while True:
        part = data.draw(st.sampled_from(sorted(node) if isinstance(node, dict) else range(len(node))))
        if not isinstance(node[part], dict | list) or not node[part] or data.draw(st.booleans()):
            break
        node = node[part]
    node[part] = data.draw(anything)
    loads_or_says_why(tomli_w.dumps(document))


@st.composite
def stations(draw: st.DrawFn) -> dict[str, Any]:
    """A valid configuration: lines, requests and points are dealt out one after the other."""
    points = {1: 0, 2: 0, 3: 0, 4: 0}
    masters = [draw(a_line("m", n)) | {"request": draw(some_requests(points))} for n in range(draw(st.integers(0, 3)))]
    slaves = [draw(a_line("s", n)) | {"unit": draw(st.integers(1, 247))} for n in range(draw(st.integers(0, 3)))]
    return {
        "register": {"coils": draw(st.integers(30_000, 65536)), "holding_registers": 65536, "retain": ["coils"]},
        "master": masters,
        "slave": slaves,
        "log": draw(st.fixed_dictionaries({}, optional={"level": st.sampled_from(["debug", "error"])})),
        "hmi": {"password": draw(st.sampled_from(["", "scrypt$é\"'\\"])), "serial": {"line": "/dev/ttyS99"}},
    }


def a_line(kind: str, number: int) -> st.SearchStrategy[dict[str, Any]]:
    line = [f"/dev/tty{kind}{number}", f"tcp://10.0.0.{number + 1}:50{2 + (kind == 's')}"]
    return st.fixed_dictionaries(
        {"name": st.just(f"{kind}{number}"), "line": st.sampled_from(line)},
        optional={
            "enabled": st.booleans(),
            "framing": st.sampled_from(["rtu", "ascii"]),
            "baudrate": st.sampled_from([1200, 115200]),
            "character_timeout": st.floats(0.001, 60.0) | st.integers(1, 60),
            "parity": st.sampled_from(["none", "odd"]),
        },
    )


@st.composite
def some_requests(draw: st.DrawFn, points: dict[int, int]) -> list[dict[str, Any]]:
    found = []
    for address in range(draw(st.integers(0, 4))):
        function = draw(st.sampled_from([1, 2, 3, 4]))
        count = draw(st.integers(1, 125))
        every = draw(st.floats(0.01, 86400.0))
        unit = draw(st.integers(1, 247))
        found.append({"unit": unit, "function": function, "address": address, "count": count, "every": every})
        found[-1]["point"] = points[function]
        points[function] += count
    return found


@given(stations())
def test_a_valid_configuration_written_as_toml_loads_as_itself(station: dict[str, Any]) -> None:
    text = tomli_w.dumps(station)
    loaded = load_text(text.encode(), "station.toml")
    assert loaded.config == validate(station)[0]
    assert loaded.text == text


def a_file_of_requests(count: int) -> str:
    request = "[[master.request]]\nname = 'r{0}'\nunit = 17\nfunction = 3\naddress = {0}\ncount = 3\npoint = {1}\n"
    head = "[register]\nholding_registers = 65536\n[[master]]\nname = 'field'\nline = '/dev/ttyS2'\n"
    return head + "".join(request.format(n, 3 * n) for n in range(count))


def test_a_thousand_requests_load_in_well_under_a_second() -> None:
    text = a_file_of_requests(1000)
    started = time.process_time()
    assert len(load_text(text, "big.toml").config.master[0].request) == 1000
    assert time.process_time() - started < 1.0


@pytest.mark.parametrize("entry", ["[[master]]\n", "x{0} = 1\n", "[x.y{0}]\n", "[[slave]]\nunit = 0\n"])
def test_a_file_full_of_errors_takes_time_in_proportion(entry: str) -> None:
    text = "".join(entry.format(n) for n in range(10_000))
    started = time.process_time()
    loads_or_says_why(text)
    assert time.process_time() - started < 10.0  # the square of it would take minutes
