"""Edits of a TOML text: what changes, what stays, and where new things go; ``tomllib`` is the judge of what it says."""

from __future__ import annotations

import random
import tomllib
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from gateway.toml_edit import edited, key_text, rendered
from gateway.toml_layout import cut, joined
from gateway.toml_pairs import paired, same
from tests.random_configs import RandomConfig
from tests.random_texts import RandomText

FILE = """\
# The gateway in the cellar.

# Sizes.
[register]
coils = 100      # many
# few
retain = [ "coils" ]

# The meters.
[[master]] # RS-485
name = "field"
# Not faster: the cable is long.
baudrate = 9600
line = "/dev/ttyS2"

# ---- what it polls ----

# In the cellar.
[[master.request]]
name = "boiler"
unit = 17

[[master.request]]
name = "fan"
unit = 18
# speed = 3

# ---- upper side ----

[[slave]]
name = "scada"
"""
SAID = tomllib.loads(FILE)


def after(**changes: Any) -> str:
    """FILE with *changes* of its tables; "master__name" is a key of the first entry."""
    wanted = tomllib.loads(FILE)
    for place, value in changes.items():
        *outer, key = place.split("__")
        table: Any = wanted
        for part in outer:
            table = table[part]
            table = table[0] if isinstance(table, list) else table
        if value is None:
            del table[key]
        else:
            table[key] = value
    text = edited(FILE, wanted)
    assert same(tomllib.loads(text), wanted)
    return text


def replaced(old: str, new: str) -> str:
    assert FILE.count(old) == 1
    return FILE.replace(old, new)


REQUESTS = SAID["master"][0]["request"]
BOILER, FAN = REQUESTS
LAMP = {"name": "lamp", "unit": 19}


# --- what is there


def test_what_says_the_same_is_not_touched() -> None:
    assert edited(FILE, SAID) == FILE
    assert edited("a = 0x10 # hex\nb = [\n 1.0, ]\n", {"b": [1], "a": 16}) == "a = 0x10 # hex\nb = [\n 1.0, ]\n"


def test_a_value_is_replaced_and_its_comments_stay() -> None:
    assert after(register__coils=200) == replaced("100", "200")
    assert after(master__baudrate=19200) == replaced("9600", "19200")


def test_a_key_goes_with_the_comments_directly_above_and_behind_it() -> None:
    assert after(register__coils=None) == replaced("coils = 100      # many\n", "")
    assert after(master__baudrate=None) == replaced("# Not faster: the cable is long.\nbaudrate = 9600\n", "")


def test_an_entry_goes_with_the_comments_directly_above_it_and_free_ones_stay() -> None:
    gone = '# In the cellar.\n[[master.request]]\nname = "boiler"\nunit = 17\n\n'
    assert after(master__request=[FAN]) == replaced(gone, "")


def test_an_entry_goes_with_the_comments_directly_below_its_last_key() -> None:
    gone = '[[master.request]]\nname = "fan"\nunit = 18\n# speed = 3\n\n'
    assert after(master__request=[BOILER]) == replaced(gone, "")


def test_a_table_goes_with_all_tables_in_it_and_with_what_is_between_them() -> None:
    gone = FILE[FILE.index("# The meters") : FILE.index("# ---- upper")]
    assert after(master=None) == replaced(gone, "")


def test_the_last_table_leaves_no_blank_lines_at_the_end() -> None:
    text = after(slave=None)
    assert text.endswith("# speed = 3\n\n# ---- upper side ----\n")
    assert edited("a = 1\n\n[b]\nc = 2\n", {"a": 1}) == "a = 1\n"
    assert edited("[b]\nc = 2\n", {}) == ""


def test_no_two_runs_of_blank_lines_are_left_where_a_key_was() -> None:
    text = "a = 1\n\n# b\nb = 2\n\nc = 3\n"
    assert edited(text, {"a": 1, "c": 3}) == "a = 1\n\nc = 3\n"
    assert edited(text, {"a": 1, "b": 2}) == "a = 1\n\n# b\nb = 2\n"
    assert edited("# head\n\na = 1\n\n[b]\n", {}) == "# head\n\n[b]\n"


def test_a_free_comment_above_what_goes_stays_free() -> None:
    assert edited("a = 1\n\n# free\n\n# b\nb = 2\nc = 3\n", {"a": 1, "c": 3}) == "a = 1\n\n# free\n\nc = 3\n"


def test_a_comment_in_a_text_of_several_lines_is_none() -> None:
    text = 'a = """\n# not a comment"""\nb = 1\n'
    assert edited(text, {"a": "# not a comment"}) == text.replace("b = 1\n", "")


# --- what comes


def test_a_new_key_comes_behind_the_last_of_its_table() -> None:
    assert after(register__holding_registers=7) == replaced(
        'retain = [ "coils" ]\n', 'retain = [ "coils" ]\nholding_registers = 7\n'
    )
    text = after(master__request=[BOILER, FAN | {"count": 2}])
    assert text == replaced(
        "unit = 18\n", "unit = 18\ncount = 2\n"
    )  # not below the comment, which would become its own


def test_a_new_request_comes_behind_the_last_of_its_master() -> None:
    new = '# speed = 3\n\n[[master.request]]\nname = "lamp"\nunit = 19\n'
    assert after(master__request=[*REQUESTS, LAMP]) == replaced("# speed = 3\n", new)


def test_a_new_request_can_come_first_or_between() -> None:
    new = '[[master.request]]\nname = "lamp"\nunit = 19\n\n'
    assert after(master__request=[LAMP, *REQUESTS]) == replaced("# In the cellar.\n", new + "# In the cellar.\n")
    between = '[[master.request]]\nname = "fan"'
    assert after(master__request=[BOILER, LAMP, FAN]) == replaced(between, new + between)


def test_a_new_master_comes_behind_all_requests_of_the_one_before() -> None:
    new = [*SAID["master"], {"name": "roof", "request": [LAMP]}]
    header = '\n\n[[master]]\nname = "roof"\n\n[[master.request]]\nname = "lamp"\nunit = 19\n'
    assert after(master=new) == replaced("# speed = 3\n", "# speed = 3" + header)


def test_a_new_table_comes_behind_the_tables_of_its_kind_or_at_the_end() -> None:
    assert after(log={"level": "info"}) == FILE + '\n[log]\nlevel = "info"\n'
    text = '[hmi]\na = 1\n\n[log]\nlevel = "info"\n'
    wanted = {"hmi": {"a": 1, "serial": {"line": ""}}, "log": {"level": "info"}}
    assert edited(text, wanted) == text.replace("\n[log]", '\n[hmi.serial]\nline = ""\n\n[log]')


def test_a_table_known_by_what_is_in_it_gets_its_header_when_it_has_a_key() -> None:
    text = "[log]\nx = 1\n\n# The port.\n[hmi.serial]\ny = 1\n"
    wanted = {"log": {"x": 1}, "hmi": {"serial": {"y": 1}, "ascii": True}}
    assert edited(text, wanted) == text.replace("# The port.", "[hmi]\nascii = true\n\n# The port.")


def test_new_things_follow_the_layout_of_their_neighbours() -> None:
    text = '[[m]]\nn = 1\n  [[m.r]]\n    name = "a"\n  [[m.r]]\n    name = "b"\n[x]\n\ty = 1\n'
    wanted = {"m": [{"n": 1, "r": [{"name": "a"}, {"name": "b", "u": 1}, {"name": "c"}]}], "x": {"y": 1, "z": 2}}
    assert edited(text, wanted) == text.replace('"b"\n', '"b"\n    u = 1\n  [[m.r]]\n    name = "c"\n').replace(
        "y = 1\n", "y = 1\n\tz = 2\n"
    )


def test_the_first_key_of_a_file_comes_below_the_comment_on_the_file() -> None:
    assert edited("# head\n# of it\n\n[b]\n", {"a": 1, "b": {}}) == "# head\n# of it\n\na = 1\n\n[b]\n"
    assert edited("# head", {"a": 1}) == "# head\n\na = 1\n"
    assert edited("# head", {"a": {"b": 1}}) == "# head\n\n[a]\nb = 1\n"
    assert edited("", {"a": 1}) == "a = 1\n"
    assert edited("", {"a": {"b": 1}, "c": [{"d": {"e": 1}}]}) == "[a]\nb = 1\n\n[[c]]\n\n[c.d]\ne = 1\n"


def test_the_first_key_of_a_table_comes_above_the_comments_in_it() -> None:
    assert edited("[log]\n# loud\n", {"log": {"level": "x"}}) == '[log]\nlevel = "x"\n# loud\n'


def test_a_comment_below_a_table_does_not_become_that_of_the_next_one() -> None:
    text = edited("[a]\nx = 1\n# about a", {"a": {"x": 1}, "b": {"y": 2}})
    assert text == "[a]\nx = 1\n# about a\n\n[b]\ny = 2\n"


def test_a_file_without_newline_at_its_end_grows_line_by_line() -> None:
    assert edited("a = 1", {"a": 1, "b": 2}) == "a = 1\nb = 2\n"
    assert edited("[t]\na = 1", {"t": {"a": 1}, "u": {"b": 2}}) == "[t]\na = 1\n\n[u]\nb = 2\n"


def test_a_file_with_carriage_returns_keeps_them_on_every_line() -> None:
    wanted = tomllib.loads(FILE)
    wanted["master"][0]["request"].append(LAMP | {"allow": ["a"], "sub": [{"x": 1}]})
    wanted["register"]["retain"] = [{"x": 1}, {"y": 2}]
    text = edited(FILE.replace("\n", "\r\n"), wanted)
    assert text.count("\r\n") == text.count("\n") == edited(FILE, wanted).count("\n")
    assert tomllib.loads(text) == wanted


# --- entries


def test_a_renamed_entry_keeps_its_place_and_its_comments() -> None:
    assert after(master__name="roof") == replaced('"field"', '"roof"')
    assert after(master__request=[BOILER | {"name": "oven"}, FAN]) == replaced('"boiler"', '"oven"')
    assert after(master__request=[BOILER, FAN | {"name": "oven"}]) == replaced('"fan"', '"oven"')


def test_entries_in_another_order_take_their_comments_along_and_free_ones_stay() -> None:
    boiler = '# In the cellar.\n[[master.request]]\nname = "boiler"\nunit = 17\n'
    fan = '[[master.request]]\nname = "fan"\nunit = 18\n# speed = 3\n'
    assert after(master__request=[FAN, BOILER]) == replaced(f"{boiler}\n{fan}", f"{fan}\n{boiler}")


def test_requests_that_stand_apart_from_their_master_go_and_come_with_it() -> None:
    text = "[[m]]\nname = 1\n[x]\ny = 1\n[[m.r]]\nname = 2\n[[m]]\nname = 3\n[[m.r]]\nname = 4\n"
    said = tomllib.loads(text)
    assert tomllib.loads(edited(text, said | {"m": said["m"][1:]})) == said | {"m": said["m"][1:]}
    assert tomllib.loads(edited(text, said | {"m": said["m"][::-1]})) == said | {"m": said["m"][::-1]}


@pytest.mark.parametrize(
    ("old", "new", "pairs"),
    [
        ("ab", "ab", [0, 1]),
        ("abc", "ac", [0, 2]),
        ("ab", "ba", [1, 0]),
        ("ab", "xb", [0, 1]),  # in the place of one that was there
        ("ab", "bx", [1, None]),  # behind all: a new one
        ("a", "", []),
        ("", "a", [None]),
        ("aa", "aaa", [0, 1, None]),
    ],
)
def test_entries_are_known_by_name_else_by_their_place_between_others(
    old: str, new: str, pairs: list[int | None]
) -> None:
    olds = [{"name": letter, "x": i} for i, letter in enumerate(old)]
    news = [{"name": letter, "x": i + 100} for i, letter in enumerate(new)]
    assert paired(olds, news) == pairs


def test_an_entry_with_a_new_name_is_known_by_what_else_it_says() -> None:
    old = [{"name": "a", "unit": 1, "at": 1, "n": 1}, {"name": "b", "unit": 2, "at": 2, "n": 1}]
    assert paired(old, [{"name": "c", "unit": 2, "at": 2, "n": 9}]) == [1]
    assert paired(old, [{"name": "c", "unit": 1, "at": 9, "n": 9}]) == [None]
    assert paired([{"name": "a", "every": 1, "is": 1}], [{"name": "c", "every": 1.0, "is": 1}]) == [0]
    masters = [{"name": "m", "line": "/dev/a", "request": [{"name": "r", "unit": 1}, {"name": "s", "unit": 1}]}]
    assert paired(masters, [masters[0] | {"name": "n", "line": "/dev/b"}]) == [0]


def test_pairing_thousands_of_new_names_takes_no_time() -> None:
    old = [{"name": f"a{i}", "unit": i, "at": i} for i in range(3000)]
    new = [{"name": f"b{i}", "unit": i, "at": i} for i in range(3001)]
    assert paired(old, new) == [*range(3000), None]


def test_a_title_says_what_entries_without_name_are_called() -> None:
    old, new = [{"at": 1, "n": 1}, {"at": 2, "n": 1}], [{"at": 2, "n": 9}, {"at": 3, "n": 9}]
    assert paired(old, new, lambda entry: entry["at"]) == [1, None]


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        (1, 1.0, True),
        (True, 1, False),
        (float("nan"), float("nan"), True),
        ({}, None, True),
        ([], None, True),
        ({"a": {"b": []}}, {}, True),
        ({"a": 0}, {}, False),
        ([{}], [], False),
        ([], {}, False),
        ([1, 2], [2, 1], False),
    ],
)
def test_what_says_the_same(one: Any, other: Any, is_same: bool) -> None:
    assert same(one, other) is is_same is same(other, one)


# --- other ways to write the same


@pytest.mark.parametrize(
    ("text", "wanted", "result"),
    [
        # dotted keys
        ("t.a = 1\nz = 9\n", {"t": {"a": 1, "b": 2}, "z": 9}, "t.a = 1\nt.b = 2\nz = 9\n"),
        ("[h]\ns . 'a' = 1 # c\n", {"h": {"s": {"a": 2}}}, "[h]\ns . 'a' = 2 # c\n"),
        ("[h]\ns.a = 1\nb = 2\n", {"h": {"b": 2}}, "[h]\nb = 2\n"),
        ("h.s.a = 1\nz = 1\n", {"h": {"s": {"a": 1}, "t": {"b": 2}}, "z": 1}, "h.s.a = 1\nh.t.b = 2\nz = 1\n"),
        ("h.a = 1\n[h.s]\nb = 1\n", {"h": {"a": 1}}, "h.a = 1\n"),
        ('"q r"."" = 1\n', {"q r": {"": 1, "b.c": 2}}, '"q r"."" = 1\n"q r"."b.c" = 2\n'),
        ("[a.b.c]\nx = 1\n[a]\nb.y = 1\n", {"a": {"b": {"c": {"x": 1}, "y": 1, "z": 2}}}, None),
        # inline tables
        ("t = {a = 1}\n", {"t": {"a": 2, "b": 3}}, "t = {a = 2, b = 3}\n"),
        ("t = { a = 1 }\n", {"t": {"a": 1, "b": 3}}, "t = { a = 1, b = 3 }\n"),
        ("t = {a = 1, b = 2 } # c\n", {"t": {"a": 1}}, "t = {a = 1 } # c\n"),
        ("t = {a = 1, b = 2}\n", {"t": {"b": 2, "c": {"d": []}}}, "t = { b = 2}\n"),
        ("t = { }\n", {"t": {"a": {"b": [{}]}}}, "t = { a = { b = [{}] } }\n"),
        ("t = {s.a = 1}\n", {"t": {"s": {"a": 1, "b": 2}}}, "t = {s.a = 1, s.b = 2}\n"),
        # arrays
        ("a = [1, 2, 3]\n", {"a": [1, 3]}, "a = [1, 3]\n"),
        ("a = [1, 2]\n", {"a": [1]}, "a = [1]\n"),
        ("a = [1]\n", {"a": [0, 1, 2]}, "a = [0, 1, 2]\n"),
        ("a = []\n", {"a": [1, 2]}, "a = [1, 2]\n"),
        ("a = [ 1, 2 ] # c\n", {"a": []}, "a = [ ] # c\n"),
        ("a = [ # c\n]\n", {"a": [1]}, "a = [ # c\n    1\n]\n"),
        ("a = [\n  1, # one\n  2 # two\n]\n", {"a": [1, 2, 3]}, "a = [\n  1, # one\n  2, # two\n  3\n]\n"),
        ("a = [\n  1, # one\n  2 # two\n]\n", {"a": [1]}, "a = [\n  1 # one\n]\n"),
        ("a = [\n  1, # one\n  2, # two\n]\n", {"a": [0, 2]}, "a = [\n  0,\n  2, # two\n]\n"),
        ("a = [\n  1 # one\n  , 2\n]\n", {"a": [1]}, "a = [\n  1 # one\n  ]\n"),
        ("a = [1, 2,\n # three\n 3]\n", {"a": [1, 3]}, "a = [1,\n # three\n 3]\n"),
        ("a = [1, 2,\n # end\n]\n", {"a": [1]}, "a = [1,\n # end\n]\n"),
        ("a = [\n # x\n\n # one\n 1,\n 2]\n", {"a": [2]}, "a = [\n # x\n\n 2]\n"),
        ("a = [\n # one\n 1, 2]\n", {"a": [0, 1, 2]}, "a = [\n 0,\n # one\n 1, 2]\n"),
        ("a = [\n 1, # one\n]\n", {"a": [1.0, 2.0]}, "a = [\n 1, # one\n 2.0,\n]\n"),
        ("a = [\n 1, # one\n]\n", {"a": [True]}, "a = [\n    true,\n]\n"),
        ("a = [[1], [2]]\n", {"a": [[1], [2, 3]]}, "a = [[1], [2, 3]]\n"),
        ("a = [ # c\n  {x = 1}, # one\n]\n", {"a": [{"x": 1}, {"x": 2}]}, None),
        ("a = [1, 2]\n", {"a": [2, 1]}, "a = [ 2,1]\n"),
        # another kind of value
        ("a = 1 # c\n", {"a": {"b": 1}}, "a = { b = 1 } # c\n"),
        ("a = []\n", {"a": [{"b": 1}]}, "a = [\n    { b = 1 },\n]\n"),
        ("[a]\nb = 1\n", {"a": 2}, "a = 2\n"),
        ("[[a]]\nb = 1\n[c]\nd = 1\n", {"a": {"b": 1}, "c": {"d": 1}}, "[c]\nd = 1\n[a]\nb = 1\n"),
        # nothing says nothing
        ("[a]\nb = []\n", {}, "[a]\nb = []\n"),
        ("x = 1\n", {"x": 1, "a": {"b": []}}, "x = 1\n"),
        ("[a]\nb = 1\n", {"a": {}}, "[a]\n"),
        ("[[a]]\nb = 1\n", {"a": []}, ""),
    ],
)
def test_every_way_to_write_it_is_edited_as_it_is_written(
    text: str, wanted: dict[str, Any], result: str | None
) -> None:
    new = edited(text, wanted)
    assert same(tomllib.loads(new), wanted)
    assert result is None or new == result


def test_new_values_are_rendered_as_toml() -> None:
    values = {"a": [{"b": "\\\n\x7f"}, {}], "c": [1e-05, 1e300, True, "é"], "d.e": {"f": [], "": {}}}
    text = "".join(f"{key_text(key)} = {rendered(value)}\n" for key, value in values.items())
    assert tomllib.loads(text) == values


# --- whatever there is


values = st.recursive(
    st.booleans() | st.integers(-99, 99) | st.text(max_size=3) | st.floats() | st.dates(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from("abc."), inner, max_size=4),
    max_leaves=10,
)
documents = st.dictionaries(st.sampled_from(["a", "b", "c d", "name"]), values, max_size=4)


@given(documents, documents)
def test_any_document_can_be_made_of_any_other(old: dict[str, Any], new: dict[str, Any]) -> None:
    text = tomli_w.dumps(old)
    assert same(tomllib.loads(edited(text, new)), new)


@given(documents)
def test_a_text_cut_and_joined_is_the_same_text(document: dict[str, Any]) -> None:
    text = tomli_w.dumps(document)
    assert joined(cut(text), "\n") == text


@pytest.mark.parametrize("seed", range(100))
def test_any_configuration_in_any_spelling_can_be_made_of_any_other(seed: int) -> None:
    rng = random.Random(seed)
    text = RandomText(RandomConfig(rng).data, rng).text
    wanted = RandomConfig(rng).data
    assert joined(cut(text), "\n") == text
    assert same(tomllib.loads(edited(text, wanted)), wanted)
