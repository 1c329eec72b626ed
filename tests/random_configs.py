"""Random sound configurations and random edits of them, as a person at the menu could make."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from typing import Any

Random = random.Random
Make = Callable[[Random], Any]


class Item(dict[str, Any]):
    """An entry of a list of tables that stays the same one whatever it is called and wherever it stands."""

    _uids = itertools.count()

    def __init__(self, *keys: Any, **more: Any) -> None:
        super().__init__(*keys, **more)
        self.uid = f"uid{next(self._uids)}"


def one_of(*values: Any) -> Make:
    return lambda rng: rng.choice(values)


def number(low: int, high: int) -> Make:
    return lambda rng: rng.randint(low, high)


def seconds(rng: Random) -> float:
    return rng.choice([1, 2.0, 0.25, 1e-2, 100.5, rng.randint(1, 900) / 8])


def words(rng: Random) -> str:
    letters = "abc 'é\"\\#=[]{}~ü€,.\U0001f600"
    return "".join(rng.choice(letters) for _ in range(rng.randint(0, 12)))


def networks(rng: Random) -> list[str]:
    return [f"10.{n}.0.0/16" for n in rng.sample(range(256), rng.randint(0, 5))]


def some_of(*values: Any) -> Make:
    return lambda rng: rng.sample(values, rng.randint(0, len(values)))


LINE = {
    "enabled": one_of(True, False),
    "baudrate": one_of(9600, 19200, 38400),
    "parity": one_of("even", "odd"),
    "stop_bits": one_of(1, 2),
    "rts_before": seconds,
    "discard_echo": one_of(True, False),
    "character_timeout": seconds,
}
OPTIONAL: dict[str, dict[str, Make]] = {
    "register": {"retain": some_of("coils", "discrete-inputs", "holding_registers", "input_registers")},
    "master": LINE | {"response_timeout": seconds, "delay": seconds, "retries": number(0, 9)},
    "read": {
        "enabled": one_of(True, False),
        "every": seconds,
        "response_timeout": seconds,
        "on_failure": one_of("hold", "zero"),
        "stale_after": seconds,
        "events": one_of(True, False),
    },
    "write": {"enabled": one_of(True, False), "every": seconds, "expire": seconds, "whole": one_of(True, False)},
    "slave": LINE
    | {
        "writable": one_of(True, False),
        "stale": one_of("serve", "exception"),
        "functions": some_of(1, 2, 3, "read-input-registers", 5, "write_single_register", 43),
        "first": number(0, 100),
        "allow": networks,
        "max_clients": number(1, 99),
    },
    "io": {"every": seconds, "scale": one_of(1, 2.5, -1e-3, 1e12), "offset": one_of(0, -0.5)},
    "identity": {"vendor": words, "product": words, "revision": words},
    "events": {"size": number(1, 999), "fifo_point": number(-1, 9)},
    "hmi": {
        "language": one_of("en", "es", "pt"),
        "ascii": one_of(True, False),
        "serial_hold": seconds,
        "password": one_of("", "scrypt$16384$8$5$c2FsdA$aGFzaA"),
        "confirm_minutes": number(1, 99),
    },
    "serial": {"line": one_of("", "/dev/console1"), "baudrate": one_of(9600, 38400)},
    "telnet": {"listen": one_of("", "127.0.0.1:23", "[::1]:2323"), "allow": networks},
    "wifly": {"baudrate": one_of(9600, 38400), "ssid": words, "passphrase": words, "retries": number(0, 9)},
    "watchdog": {"timeout": number(1, 99)},
    "log": {"level": one_of("debug", "info", "error")},
}
SIZES = {"coils": 65536, "discrete_inputs": 65536, "holding_registers": 65536, "input_registers": 65536}
TABLES = ("identity", "events", "hmi", "watchdog", "log")
INNER = ("serial", "telnet", "wifly")


class RandomConfig:
    """A sound configuration, as the ``data`` of a file, that can be changed at random and stays sound."""

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        self._numbers = itertools.count(1)
        self._points = itertools.count(100, 4)
        self.data: dict[str, Any] = {"register": SIZES | self._some("register")}
        for kind, make in (("master", self.master), ("slave", self.slave), ("io", self.io)):
            if rng.random() < 0.8:
                self.data[kind] = [make() for _ in range(rng.randint(1, 3))]
        for table in TABLES:
            if rng.random() < 0.5:
                self.data[table] = self._some(table)
        if "hmi" in self.data:
            for inner in INNER:
                if rng.random() < 0.5:
                    self.data["hmi"][inner] = self._some(inner)

    def _some(self, kind: str) -> dict[str, Any]:
        return {key: make(self._rng) for key, make in OPTIONAL[kind].items() if self._rng.random() < 0.4}

    def _line(self) -> str:
        n = next(self._numbers)
        return self._rng.choice([f"/dev/ttyX{n}", f"tcp://10.9.{n // 250}.{n % 250 + 1}:{5000 + n}"])

    def _shuffled(self, keys: dict[str, Any]) -> Item:
        return Item(self._rng.sample(list(keys.items()), len(keys)))

    def master(self) -> Item:
        keys = {"name": f"m{next(self._numbers)}", "line": self._line()} | self._some("master")
        if self._rng.random() < 0.8:
            keys["request"] = [self.request() for _ in range(self._rng.randint(1, 4))]
        return self._shuffled(keys)

    def request(self) -> Item:
        n = next(self._numbers)
        function = self._rng.choice([1, 2, 3, 4, "read-holding-registers", "read_input_registers", 6])
        asked = {"unit": n % 247 + 1, "function": function, "address": self._address(), "count": 1}
        keys = asked | {"point": next(self._points)} | self._some("write" if function == 6 else "read")
        if function == 6:
            keys["trigger"] = "change"
        if self._rng.random() < 0.7:
            keys["name"] = f"r{n}"
        return self._shuffled(keys)

    def _address(self) -> int:
        return next(self._numbers) + self._rng.choice([0, 10_000, 30_000, 40_000, 50_000])

    def slave(self) -> Item:
        keys = {"name": f"s{next(self._numbers)}", "line": self._line(), "unit": self._rng.randint(1, 247)}
        return self._shuffled(keys | self._some("slave"))

    def io(self) -> Item:
        n = next(self._numbers)
        keys = {"name": f"i{n}", "kind": "iio", "chip": f"/dev/iio{n}", "line": f"ch {n}", "point": next(self._points)}
        return self._shuffled(keys | self._some("io"))

    # --- edits

    def edit(self) -> None:
        """What a person may do between two saves: a few edits, or one entry under a new name or address."""
        if self._rng.random() < 0.3:
            self._rng.choice([self._rename, self._rename, self._readdress])()
            return
        edits = [self._set, self._set, self._set, self._unset, self._add, self._delete, self._swap, self._drop_table]
        for _ in range(self._rng.randint(1, 4)):
            self._rng.choice(edits)()

    def _tables(self) -> list[tuple[str, dict[str, Any]]]:
        """Every table with the name of its kind."""
        found = [("register", self.data["register"])]
        found += [(kind, self.data.setdefault(kind, {})) for kind in TABLES]
        found += [(kind, self.data["hmi"].setdefault(kind, {})) for kind in INNER]
        for kind in ("master", "slave", "io"):
            found += [(kind, entry) for entry in self.data.get(kind, [])]
        return found + [("write" if request["function"] == 6 else "read", request) for request in self._requests()]

    def _requests(self) -> list[Item]:
        return [request for master in self.data.get("master", []) for request in master.get("request", [])]

    def _lists(self) -> list[tuple[list[Item], Callable[[], Item]]]:
        found: list[tuple[list[Item], Callable[[], Item]]] = [
            (self.data.setdefault("master", []), self.master),
            (self.data.setdefault("slave", []), self.slave),
            (self.data.setdefault("io", []), self.io),
        ]
        return found + [(master.setdefault("request", []), self.request) for master in self.data["master"] * 2]

    def _set(self) -> None:
        kind, table = self._rng.choice(self._tables())
        key = self._rng.choice(list(OPTIONAL[kind]))
        table[key] = OPTIONAL[kind][key](self._rng)

    def _unset(self) -> None:
        kind, table = self._rng.choice(self._tables())
        given = [key for key in OPTIONAL[kind] if key in table]
        if given:
            del table[self._rng.choice(given)]

    def _add(self) -> None:
        entries, make = self._rng.choice(self._lists())
        entries.insert(len(entries) if self._rng.random() < 0.7 else self._rng.randint(0, len(entries)), make())

    def _delete(self) -> None:
        entries, _ = self._rng.choice(self._lists())
        if entries:
            del entries[self._rng.randrange(len(entries))]

    def _swap(self) -> None:
        entries, _ = self._rng.choice(self._lists())
        if len(entries) > 1:
            a, b = self._rng.sample(range(len(entries)), 2)
            entries[a], entries[b] = entries[b], entries[a]

    def _drop_table(self) -> None:
        self.data.pop(self._rng.choice(TABLES), None)
        self.data.get("hmi", {}).pop(self._rng.choice(INNER), None)

    def _rename(self) -> None:
        entries, _ = self._rng.choice(self._lists())
        if entries:
            self._rng.choice(entries)["name"] = f"n{next(self._numbers)}"

    def _readdress(self) -> None:
        requests = self._requests()
        if requests:
            self._rng.choice(requests)["address"] = self._address()
