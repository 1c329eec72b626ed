"""The menu's texts and their translations: `make translations` brings ``gateway/hmi/locale`` up to date with the code.

Every text that the code marks goes into ``rtugate.pot`` and into each language's ``rtugate.po``; a text that is new
there is empty, one that resembles an old text brings its translation along, marked fuzzy: both wait for a person. Then
the ``.mo`` that the program reads are compiled. The same code gives the same files, byte for byte: no dates, no line
numbers, no names of tools. Tests read what is here; translating is done by hand, in the ``.po``.

Source: GNU gettext's manual, chapters 3 and 10 (the formats). Babel does the reading, writing and merging.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Final

from babel.messages.catalog import Catalog, Message
from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po, write_po

from gateway.hmi.texts import DOMAIN, FOLDER
from gateway.modbus.describe import exception_name

LANGUAGES: Final = {"es": "Spanish", "pt": "Portuguese"}
MARKS: Final = ("_", "N_", "translate")
CODE: Final = FOLDER.parents[1]
PAGE: Final = 10_000  # columns: no text is wrapped in the files
NO_LINE: Final = 0  # line numbers would change with every edit of the code


class Texts(Catalog):
    """A catalogue whose header says nothing that changes by itself."""

    @property
    def mime_headers(self) -> list[tuple[str, str]]:
        language = [("Language", str(self.locale))] if self.locale else []
        form = [("MIME-Version", "1.0"), ("Content-Type", "text/plain; charset=utf-8")]
        return [("Project-Id-Version", DOMAIN), *language, *form, ("Content-Transfer-Encoding", "8bit")]


# ------------------------------------------------------------------------------------------------ the code's texts


def marked(source: str) -> list[ast.expr]:
    """Return what *source*, a module's text, marks for translation, in the order of its lines."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call) and node.args]
    found = [call.args[0] for call in calls if _name(call.func) in MARKS]
    return sorted(found, key=lambda node: (node.lineno, node.col_offset))


def _name(function: ast.expr) -> str:
    if isinstance(function, ast.Attribute):
        return function.attr
    return function.id if isinstance(function, ast.Name) else ""


def modules() -> list[Path]:
    """Return every module of the package."""
    return sorted(CODE.rglob("*.py"))


def texts_of_the_code() -> Iterator[tuple[str, str]]:
    """Yield each text that a person may be shown, and the module where it stands."""
    for path in modules():
        where = path.relative_to(CODE.parent).as_posix()
        for node in marked(path.read_text("utf-8")):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value, where
    for code in range(1, 256):  # these names live where nothing is known of languages
        yield exception_name(code), "gateway/modbus/describe.py"


# ------------------------------------------------------------------------------------------------ the catalogues


def template() -> Catalog:
    """Return all texts of the code, without translations."""
    texts = Texts(header_comment="# The texts of rtugate's menu. Made by `make translations`.", fuzzy=False)
    for text, where in texts_of_the_code():
        texts.add(text, locations=[(where, NO_LINE)])
    return texts


def po_path(language: str, folder: Path = FOLDER) -> Path:
    """Return where the translations into *language* are written by hand."""
    return folder / language / "LC_MESSAGES" / f"{DOMAIN}.po"


def po(language: str, folder: Path = FOLDER) -> Catalog:
    """Return the translations into *language* as they stand in their file."""
    comment = f"# rtugate's menu in {LANGUAGES[language]}. Texts come from the code by `make translations`."
    texts = Texts(locale=language, header_comment=comment, fuzzy=False)
    path = po_path(language, folder)
    if path.exists():
        with path.open("rb") as file:
            known = read_po(file, locale=language)
        for message in known:
            if message.id:
                texts[message.id] = message
        texts.obsolete = known.obsolete
    return texts


def po_bytes(texts: Catalog) -> bytes:
    """Return *texts* as a .po or .pot."""
    file = BytesIO()
    write_po(file, texts, width=PAGE, include_lineno=False, ignore_obsolete=True)
    return file.getvalue()


def mo_bytes(texts: Catalog) -> bytes:
    """Return *texts* as a .mo; what is fuzzy or empty is left out."""
    file = BytesIO()
    write_mo(file, texts)
    return file.getvalue()


def messages(texts: Catalog) -> list[Message]:
    """Return the texts without the header."""
    return [message for message in texts if message.id]


def update(folder: Path = FOLDER) -> list[str]:
    """Write everything anew; return what is left to be done by a person."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{DOMAIN}.pot").write_bytes(po_bytes(template()))
    left = []
    for language in LANGUAGES:
        path, texts = po_path(language, folder), po(language, folder)
        texts.update(template(), update_header_comment=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(po_bytes(texts))
        path.with_suffix(".mo").write_bytes(mo_bytes(texts))
        unfit = [str(message.id) for message in messages(texts) if not message.string or message.fuzzy]
        left += [f"{path.name} ({language}): {text!r} has to be translated" for text in unfit]
    return left


if __name__ == "__main__":
    print("\n".join(update()) or "all texts are translated")
