"""The configuration file as the gateway that runs sees it, and what is kept of it in the state directory.

What it is: what the file said when it was read or written last; where a start takes its configuration from (the file,
else the last good one, else the factory settings); saves, with their history; a save that waits for its confirmation.
What it refuses: running anything. Whoever runs the gateway asks, and puts to work what he is given.

A save that waits for its confirmation leaves what the file said before in the state directory, first of all. So the
previous file comes back whatever happens: a start that finds it there puts it back at once, since nobody confirmed. A
person's own edit of the file is never undone: who edits it meanwhile has seen it.

Source: specification of rtugate, section 6.
Threads: ``reload``, ``save``, ``confirm``, ``revert`` and ``keep_good`` take their time and one thread at a time; all
else may be asked by any: what is known of the file is one value, replaced as a whole.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

from gateway import files
from gateway.clock import Clock
from gateway.config import Config, factory
from gateway.difference import difference
from gateway.errors import ConfigError, FileChanged, SaveError
from gateway.history import History
from gateway.hmi.station import Told
from gateway.hmi.wording import N_
from gateway.save import Rendered, keep_beside, save, text_for
from gateway.snapshots import UNCONFIRMED, Snapshot, read_last_good, write_last_good
from gateway.store import Loaded, load, load_text, read

HISTORY: Final = "history"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Unconfirmed:
    """A save that waits: what the file said before, what runs then again, and until when (monotonic seconds)."""

    before: Loaded
    until_s: float


@dataclass(frozen=True)
class _Known:
    """What is known of the file.

    content: what it said when it was read or written last, usable or not; None: it could not even be read.
    loaded:  what that means; None: it cannot be used.
    waits:   set while it was saved and that is not confirmed.
    """

    content: bytes | None = None
    loaded: Loaded | None = None
    waits: _Unconfirmed | None = None


class ConfigFile:
    """One configuration file; see the module."""

    def __init__(self, path: Path, state: Path, clock: Clock) -> None:
        """*state*: the state directory, which need not be there, nor be writable."""
        self.path = path
        self._state = state
        self._clock = clock
        self._history = History(state / HISTORY)
        self._marker = Snapshot(state, UNCONFIRMED)
        self._known = _Known()
        self._alarm: Told | None = None  # how the start went, or the last reload
        self._trouble = ""  # why the file cannot be read or written

    @property
    def alarms(self) -> list[Told]:
        """What a person should know of the file."""
        trouble = Told("{trouble}", {"trouble": self._trouble}) if self._trouble else None
        return [alarm for alarm in (self._alarm, trouble) if alarm is not None]

    @property
    def saved(self) -> Config | None:
        """What the file says, as it was read or written last; None: it cannot be used."""
        loaded = self._known.loaded
        return None if loaded is None else loaded.config

    @property
    def settled(self) -> Config | None:
        """What the file says for good: None also while a save waits for its confirmation."""
        known = self._known
        return None if known.loaded is None or known.waits is not None else known.loaded.config

    # -------------------------------------------------------------------------------------------- reading

    def start(self) -> Config:
        """Return what is to run: the file, else the last good configuration, else the factory settings. Never fails.

        After a save that nobody confirmed it is what the file said before, whether that can be put back or not.
        """
        before, trouble = None, ""
        try:
            before = self._before_unconfirmed()
            if before is not None:
                self._put_back(before.text)
        except (SaveError, ConfigError) as error:
            trouble = f"a save that nobody confirmed, if there was one, cannot be undone: {error}"
        config = self._first_usable()
        if trouble:
            self._complain(trouble)
        elif before is not None:
            log.warning("%s: the last save was never confirmed: the previous file is back", self.path.name)
            self._alarm = self._told(N_("the last save to {file} was never confirmed: the previous file is back"))
        return config if before is None else before.config

    def _before_unconfirmed(self) -> Loaded | None:
        """Return what the file said before a save that nobody confirmed until the program ended; None: there is none.

        raises: SaveError, ConfigError, if that cannot be known.
        """
        marked = self._marker.text()
        if marked is None:
            return None
        try:
            content = read(self.path)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise SaveError(f"{self.path.name} cannot be read: {files.in_words(error, self.path)}") from error
        digest, _, text = marked.partition("\n")
        if _digest(content) == digest:
            return load_text(text, self.path.name)  # it was good once
        if content != text.encode():  # else the save itself never came to pass
            log.warning("%s: edited since a save that nobody confirmed: it stays as it is", self.path.name)
        self._forget_marker()
        return None

    def _first_usable(self) -> Config:
        try:
            return self.reload()
        except ConfigError as error:
            log_findings(error)
            self._known = _Known(content=self._content())
            if isinstance(error.__cause__, OSError):
                self._complain(f"{self.path.name} cannot be read: {files.in_words(error.__cause__, self.path)}")
        config = self._last_good()
        if config is not None:
            log.error("%s cannot be used: running with the last good configuration", self.path)
            self._alarm = self._told(N_("{file} cannot be used (L shows why): the last good configuration runs"))
            return config
        log.error("%s cannot be used: running with factory settings, no line is polled or served", self.path)
        self._alarm = self._told(N_("{file} cannot be used (L shows why): factory settings run"))
        return factory()

    def reload(self) -> Config:
        """Read the file anew and return what it says; raises ConfigError, and nothing has changed then.

        A save that waited for its confirmation is overtaken by whoever has edited the file since.
        """
        loaded, known = load(self.path), self._known
        for finding in loaded.findings:
            log.log(logging.INFO if finding.severity == "note" else logging.WARNING, "%s", finding)
        waits = known.waits
        if waits is not None and loaded.text.encode() != known.content:
            log.warning("%s: edited while its last save waited for a confirmation, which is void", self.path.name)
            self._forget_marker()
            waits = None
        self._adopt(loaded, waits)
        return loaded.config

    def refused(self, error: ConfigError) -> None:
        """The file as it is now cannot be used: an alarm, since the next start will not find what runs in it."""
        self._trouble = ""
        if isinstance(error.__cause__, PermissionError):
            self._complain(f"{self.path.name} cannot be read: {files.in_words(error.__cause__, self.path)}")
        if self._known.loaded is not None:  # else there is such an alarm already
            self._alarm = self._told(N_("{file} was edited and cannot be used (L shows why): what ran before goes on"))

    def _adopt(self, loaded: Loaded, waits: _Unconfirmed | None = None) -> None:
        self._known = _Known(loaded.text.encode(), loaded, waits)
        self._alarm, self._trouble = None, ""

    def _last_good(self) -> Config | None:
        try:
            return read_last_good(self._state)
        except (SaveError, ConfigError) as error:
            log.error("%s", error)
            return None

    def _content(self) -> bytes | None:
        """Return what the file says now; None where it cannot be read."""
        try:
            return read(self.path)
        except (OSError, ConfigError):
            return None

    def _told(self, text: str) -> Told:
        return Told(text, {"file": self.path.name})

    def _complain(self, trouble: str) -> None:
        """Raise an alarm that lasts until the file is read or written without trouble."""
        log.error("%s", trouble)
        self._trouble = trouble

    # -------------------------------------------------------------------------------------------- saving

    @property
    def _text(self) -> str | None:
        loaded = self._known.loaded
        return None if loaded is None else loaded.text

    def rendered(self, config: Config) -> Rendered:
        """Return the text that says what *config* says. Raises SaveError."""
        return text_for(self._text or "", config, self.path.name)

    def difference(self, config: Config) -> list[str]:
        """Return what saving *config* would change in the file as it is now, for a person. Raises SaveError."""
        content = self._content()
        now = self._text or "" if content is None else content.decode(errors="replace")
        return difference(now, self.rendered(config).text)

    def is_edited(self) -> bool:
        """Whether somebody has changed the file since it was read or written, or tried to be read."""
        content = self._content()
        return content is not None and content != self._known.content  # None: gone, or not to be read: saving tells

    def save(self, config: Config, overwrite: bool = False, confirm_s: float | None = None) -> list[str]:
        """Write *config* into the file; return what there is to tell besides. Raises SaveError, FileChanged.

        overwrite: whatever the file says now.
        confirm_s: without ``confirm`` within so many seconds, ``revert`` is to be called.
        """
        known = self._known
        if known.waits is not None:
            raise SaveError("the last save still waits for its confirmation: confirm or undo that first")
        if confirm_s is not None and known.loaded is None:
            raise SaveError("there is no previous file to come back to: save without a confirmation")
        if known.loaded is None and not overwrite and self.is_edited():  # else ``save.save`` looks
            raise FileChanged(f"{self.path.name} is not saved: somebody has changed it since it was read")
        rendered = self.rendered(config)
        try:
            remarks = [self._kept_if_lost(rendered)]
            waits = self._marked(rendered.text, known.loaded, confirm_s)
            self._write(rendered.text, overwrite, waits is not None)
        except FileChanged:
            raise
        except SaveError as error:
            self._complain(str(error))
            raise
        self._adopt(Loaded(config, rendered.text, []), waits)
        if waits is None:
            remarks.append(self._forget_marker())  # of an earlier run, whose save could not be undone
            remarks += self._kept_in_history(None if known.loaded is None else known.loaded.text, rendered.text)
        log.info("%s: saved by the menu%s", self.path.name, "" if waits is None else ", not confirmed yet")
        return [remark for remark in remarks if remark]

    def _kept_if_lost(self, rendered: Rendered) -> str:
        """Keep the old file beside, if nothing of it will be in the new one; return what to tell."""
        if self._known.loaded is None:
            return self._kept_beside("rejected")
        if rendered.is_whole:
            log.error("%s: written anew, without its comments: %s", self.path.name, rendered.reason)
            return self._kept_beside("replaced")
        return ""

    def _kept_beside(self, word: Literal["rejected", "replaced"]) -> str:
        if self._content() is None:  # there is none, or it cannot be read, and the save says why
            return ""
        kept = keep_beside(self.path, word, self._clock.wall())
        return f"the old file is kept as {kept.name}"

    def _marked(self, text: str, before: Loaded | None, confirm_s: float | None) -> _Unconfirmed | None:
        """Leave what the file said *before* for a start that finds *text* in it, which nobody has confirmed then."""
        if before is None or confirm_s is None:
            return None
        self._marker.write(f"{_digest(text.encode())}\n{before.text}")
        return _Unconfirmed(before, self._clock.monotonic() + confirm_s)

    def _write(self, text: str, overwrite: bool, is_marked: bool) -> None:
        try:
            save(self.path, text, None if overwrite else self._text)
        except SaveError:
            if is_marked and self._content() not in (None, text.encode()):  # else a start may have to undo it
                self._forget_marker()
            raise

    def _forget_marker(self) -> str:
        """No save waits for a confirmation; return what there is to tell."""
        try:
            self._marker.remove()
        except SaveError as error:
            log.warning("%s", error)
            return str(error)
        return ""

    def _kept_in_history(self, *texts: str | None) -> list[str]:
        """Keep what the file said, as a person may have written it, and what it says now."""
        problems = [self._history.keep(text) for text in texts if text is not None]
        problem = next(filter(None, problems), None)
        if problem:
            log.warning("%s", problem)
        return [problem] if problem else []

    # -------------------------------------------------------------------------------------------- confirming

    @property
    def confirm_left_s(self) -> float | None:
        """How long the last save still waits for its confirmation; None: it does not."""
        waits = self._known.waits
        return None if waits is None else max(0.0, waits.until_s - self._clock.monotonic())

    def confirm(self) -> list[str]:
        """The last save is good: keep it; return what there is to tell besides. Raises SaveError."""
        known = self._known
        if known.waits is None:
            raise SaveError("no save waits for a confirmation any more")
        self._marker.remove()
        self._known = replace(known, waits=None)
        log.info("%s: the save is confirmed", self.path.name)
        return self._kept_in_history(known.waits.before.text, self._text)

    def revert(self) -> Config | None:
        """Nobody confirmed: put the previous file back, and return what is to run again; None if nothing waits.

        A file that was edited since stays as it is. One that cannot be put back is an alarm, and the next start tries
        again: what is to run again is returned in any case.
        """
        known = self._known
        if known.waits is None:
            return None
        before, is_edited = known.waits.before, self.is_edited()
        self._adopt(before)
        if is_edited:
            log.warning("%s: the save was not confirmed, but the file was edited since: it stays", self.path.name)
            self._forget_marker()
            return before.config
        try:
            self._put_back(before.text)
            log.warning("%s: the save was not confirmed: the previous file is back", self.path.name)
        except SaveError as error:
            self._complain(f"the save that was not confirmed runs no longer, but is in the file still: {error}")
        return before.config

    def _put_back(self, text: str) -> None:
        files.write_atomically(self.path, text.encode())
        self._forget_marker()

    # -------------------------------------------------------------------------------------------- proved good

    def keep_good(self, config: Config) -> None:
        """Keep *config*, which has run well, for a start that finds the file unusable. Raises SaveError."""
        write_last_good(self._state, config)


def log_findings(error: ConfigError) -> None:
    """Log everything that is wrong with a file."""
    for finding in error.findings:
        log.error("%s", finding)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
