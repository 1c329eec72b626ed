"""Which entry of one list an entry of another is, when both are states of the same list.

A name says it; entries whose name changed are known by their place between others, or by what they say. Nothing is
compared with everything: lists of thousands pass in no time.

Source: specification of rtugate, section 6. Pure.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any, Final

Title = Callable[[Mapping[str, Any]], Hashable]

ALIKE: Final = 2 / 3  # of what two entries say, for the second to be the first under a new name
CANDIDATES: Final = 16  # that are looked at for each entry with a new name


def name(entry: Mapping[str, Any]) -> Hashable:
    """What *entry* is called, None if nothing."""
    return entry.get("name")


def same(one: Any, other: Any) -> bool:
    """Whether two values say the same; none at all says as much as an empty list or table does."""
    if isinstance(one, Mapping | None) and isinstance(other, Mapping | None):
        one, other = one or {}, other or {}
        return all(same(one.get(key), other.get(key)) for key in one.keys() | other.keys())
    if isinstance(one, list | None) and isinstance(other, list | None):
        one, other = one or [], other or []
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, bool) is not isinstance(other, bool):
        return False
    return bool(one == other) or (one != one and other != other)  # two nan


def paired(old: Sequence[Any], new: Sequence[Any], title: Title = name) -> list[int | None]:
    """Return for each of *new* the index of the one of *old* that it is, None for one that is really new.

    Values that are no tables are known by what they are.
    """
    waiting: dict[Hashable, list[int]] = {}
    for i in reversed(range(len(old))):
        waiting.setdefault(_identity(old[i], title), []).append(i)
    pairs = [_next(waiting, _identity(entry, title)) for entry in new]
    free = set(range(len(old))) - set(pairs)
    for start, end in list(_runs(pairs)):
        first = (pairs[start - 1] or 0) + 1 if start else 0
        limit = pairs[end] if end < len(new) else None
        gap = [i for i in range(first, len(old) if limit is None else limit) if i in free]
        is_between = limit is not None and len(gap) == end - start and isinstance(new[start], Mapping)
        pairs[start:end] = gap if is_between else _alike(old, gap, new[start:end], title)
    return pairs


def _identity(entry: Any, title: Title) -> Hashable:
    if isinstance(entry, Mapping):
        called = title(entry)
        return None if called is None else ("table", called)
    if isinstance(entry, int | float) and not isinstance(entry, bool) and entry == entry:  # not nan
        return entry  # 1 is 1.0
    return (type(entry), repr(entry))


def _next(waiting: dict[Hashable, list[int]], identity: Hashable) -> int | None:
    known = waiting.get(identity) if identity is not None else None
    return known.pop() if known else None


def _runs(pairs: list[int | None]) -> Iterator[tuple[int, int]]:
    """Where runs of None start and end."""
    start = 0
    for end, pair in enumerate([*pairs, -1]):
        if pair is not None:
            if start < end:
                yield start, end
            start = end + 1


def _alike(old: Sequence[Any], gap: list[int], new: Sequence[Any], title: Title) -> list[int | None]:
    """For each of *new* the one of *old* in *gap* that it is most like, in order."""
    found: list[int | None] = []
    start = 0
    for entry in new:
        likeness = {i: _likeness(old[i], entry, title) for i in gap[start : start + CANDIDATES]}
        best = max(likeness, key=likeness.__getitem__, default=None)
        if best is not None and likeness[best] < ALIKE:
            best = None
        found.append(best)
        start = start if best is None else gap.index(best, start) + 1
    return found


def _likeness(one: Any, other: Any, title: Title) -> float:
    """How much of what the shorter one of two entries says the other says too, from 0 to 1, but for their names."""
    if not isinstance(one, Mapping) or not isinstance(other, Mapping):
        return 0.0
    mine = Counter(_said({key: value for key, value in one.items() if key != "name"}, (), title))
    others = Counter(_said({key: value for key, value in other.items() if key != "name"}, (), title))
    return (mine & others).total() / (min(mine.total(), others.total()) or 1)


def _said(value: Any, path: tuple[Hashable, ...], title: Title) -> Iterator[Hashable]:
    """Each single thing that *value* says, with the names that lead to it."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _said(inner, (*path, key), title)
    elif isinstance(value, list):
        for inner in value:
            yield from _said(inner, (*path, _identity(inner, title)), title)
    else:
        yield (*path, _identity(value, title))
