"""One file's life: saved and reloaded again and again, edited by menu and by hand, and looked at after each save."""

from __future__ import annotations

import copy
import random
from collections.abc import Mapping
from typing import Any, Final

from gateway import store
from gateway.config import Config
from gateway.config_checks import validate
from gateway.save import text_for
from gateway.toml_pairs import same
from gateway.toml_text import Path, scan
from tests.random_configs import Item, RandomConfig
from tests.random_texts import Comment, RandomText, doubled, identity, misplaced

MISSING: Final = object()


def live(seed: int, saves: int) -> int:
    """Begin with a random file and save it so many times, each time with other edits; return the comments looked at."""
    looked_at = 0
    rng = random.Random(seed)
    model = RandomConfig(rng)
    written = RandomText(model.data, rng)
    text, comments = written.text, written.comments
    assert text_for(text, sound(model.data), "file").text == text, "nothing was changed"
    for _ in range(saves):
        if rng.random() < 0.25:  # by hand, and the file is reloaded
            model.edit()
            written = RandomText(model.data, rng)
            text, comments = written.text, written.comments
        before = copy.deepcopy(model.data)
        model.edit()
        saved = text_for(text, sound(model.data), "file")
        assert not saved.is_whole, saved.reason
        assert store.load_text(saved.text, "file").config == sound(model.data)
        comments = checked_comments(saved.text, comments, before, model.data)
        assert saved.text.count("\r\n") in (0, saved.text.count("\n"))
        assert not respelled(text, before, saved.text, model.data)
        text = saved.text
        looked_at += len(comments)
    return looked_at


def sound(data: Mapping[str, Any]) -> Config:
    config, found = validate(data)
    assert config is not None, [one.message for one in found if one.severity == "error"]
    return config


def checked_comments(text: str, comments: list[Comment], before: Any, now: Any) -> list[Comment]:
    """Return the comments that are to be in *text*, and are; those of what is gone must be gone."""
    kept = [comment for comment in comments if at(now, comment.owner) is not MISSING]
    wrong = misplaced(text, now, kept) + doubled(text)
    assert not wrong, f"comments: {wrong}"
    gone = [one for one in comments if one not in kept and one.place != "free" and one.tag in text]
    left = [one for one in gone if not may_stay(one.owner, before, now)]
    assert not left, f"still there: {left}"
    return kept


def may_stay(owner: Path, before: Any, now: Any) -> bool:
    """Whether the text may still have *owner*, which *now* does not: it says nothing, or a new entry took its place."""
    if same(at(before, owner), None):
        return True
    outer = next(owner[:n] for n in range(len(owner)) if at(now, owner[: n + 1]) is MISSING)
    entries = at(now, outer)
    known = at(before, outer)
    return isinstance(entries, list) and any(
        isinstance(entry, Item) and entry.uid not in {one.uid for one in known} for entry in entries
    )


def at(data: Any, path: Path) -> Any:
    """What stands at *path*, in which entries are uids and items are values."""
    for part in path:
        if isinstance(data, list):
            named = {one.uid if isinstance(one, Item) else f"item {one!r}": one for one in data}
            data = named.get(str(part), MISSING)
        elif isinstance(data, Mapping):
            data = data.get(str(part), MISSING)
        if data is MISSING:
            break
    return data


def respelled(old_text: str, before: Any, new_text: str, now: Any) -> list[Path]:
    """What says the same as before, and is spelled otherwise."""
    old = {identity(one.path, before): old_text[one.start : one.end] for one in scan(old_text) if one.kind == "key"}
    new = {identity(one.path, now): new_text[one.start : one.end] for one in scan(new_text) if one.kind == "key"}
    return [path for path in old.keys() & new.keys() if at(before, path) == at(now, path) and old[path] != new[path]]
