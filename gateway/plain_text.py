"""Text made fit for a terminal and a log: nothing in it moves a cursor, and it is no longer than there is room.

Pure. Source: specification of rtugate, section 5, last rule.
"""

from __future__ import annotations


def printable(text: str, kept: str = "") -> str:
    """Return *text* with whatever cannot be printed escaped, but for the characters *kept*."""
    if text.isprintable():  # as nearly all is
        return text
    return "".join(c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text)


def cut(text: str, width: int) -> str:
    """Return *text*, or as much of its start as fits in *width* characters together with '..'."""
    return text if len(text) <= width else (text[: max(0, width - 2)] + "..")[: max(0, width)]
