"""A person at a menu of one little dialogue, on a clock that jumps."""

from __future__ import annotations

from collections.abc import Callable

from gateway.hmi.menu import Back, Dialogue, Menu, ToMainMenu, Ui
from tests.fakes import JumpingClock

Main = Callable[[Ui], Dialogue[None]]


class Person:
    """A person at a menu of one dialogue; ``screen`` is all that was shown."""

    def __init__(self, main: Main, translate: Callable[[str], str] = str, rows: int = 24, columns: int = 80) -> None:
        self.clock = JumpingClock()
        self.ui = Ui(self.clock, translate)
        self.menu = Menu(main, self.ui)
        self.menu.rows, self.menu.columns = rows, columns
        self.screen = self.menu.start()

    def type(self, keys: str) -> str:
        shown = "".join(self.menu.key(key) for key in keys)
        self.screen += shown
        return shown

    def pass_s(self, seconds: float) -> str:
        self.clock.pass_s(seconds)
        shown = self.menu.tick()
        self.screen += shown
        return shown


def asking(ask: Callable[[Ui], Dialogue[object]], answers: list[object]) -> Main:
    """A dialogue that asks one thing again and again; *answers* are what it got."""

    def main(ui: Ui) -> Dialogue[None]:
        while True:
            try:
                answers.append((yield from ask(ui)))
            except (Back, ToMainMenu) as way_out:
                answers.append(type(way_out))

    return main


def person_asked(
    ask: Callable[[Ui], Dialogue[object]], rows: int = 24, columns: int = 80
) -> tuple[Person, list[object]]:
    answers: list[object] = []
    return Person(asking(ask, answers), rows=rows, columns=columns), answers
