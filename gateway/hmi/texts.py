"""The menu's languages: gettext catalogues, made from ``locale/*/LC_MESSAGES/rtugate.po`` by `make translations`
(spec section 5).

A language is read once, at its first use. One that cannot be read is logged and shown in English: the menu is what a
person needs then. What it refuses: log lines, and words of the configuration file; they are English everywhere.
Threads: any.
"""

from __future__ import annotations

import gettext
import logging
import struct
from functools import cache
from pathlib import Path
from typing import Final

from gateway.hmi.wording import Translate, without_accents

DOMAIN: Final = "rtugate"
FOLDER: Final = Path(__file__).parent / "locale"

log = logging.getLogger(__name__)


@cache
def translation(language: str, is_ascii: bool = False) -> Translate:
    """Return what turns an English text of the menu into *language*: "en", "es", "pt"; *is_ascii*: without accents."""
    translate = str if language == "en" else translation_in(FOLDER, language)
    return (lambda text: without_accents(translate(text))) if is_ascii else translate


def translation_in(folder: Path, language: str) -> Translate:
    """Return the translation into *language* that the catalogues of *folder* give; of "" it makes nothing."""
    try:
        found = gettext.translation(DOMAIN, folder, [language]).gettext
    except (OSError, ValueError, struct.error) as error:  # missing, or damaged
        log.error("the menu is in English: its texts in %r cannot be read: %s", language, error)
        return str
    return lambda text: found(text) if text else ""  # gettext keeps the catalogue's own header under ""
