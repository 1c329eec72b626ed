"""Whether a build of the package can run the tests: prints what they lack here, nothing if they can be run.

The gateway's own dependencies must be as new as pyproject.toml says; Debian 12's are not. The tests' tools only have to
be there. Debian's packages are what counts, so this runs on the system's interpreter.
"""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any, Final

PROJECT: Final = Path(__file__).parent.parent / "pyproject.toml"


def lacks(project: dict[str, Any]) -> list[str]:
    """Return in words what is missing here or too old. *project*: the table of that name in pyproject.toml."""
    tools = [_name(requirement) for requirement in project["optional-dependencies"]["test"]]
    found = [_lack(requirement) for requirement in [*project["dependencies"], *tools]]
    return [words for words in found if words]


def _lack(requirement: str) -> str:
    name, (_, _, least) = _name(requirement), requirement.partition(",")[0].partition(">=")
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return f"{name} is missing"
    return f"{name} is {version}, not {least}" if _numbers(version) < _numbers(least) else ""


def _name(requirement: str) -> str:
    return re.split("[<>=!~ ]", requirement, maxsplit=1)[0]


def _numbers(version: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", version)]


if __name__ == "__main__":
    print(", ".join(lacks(tomllib.loads(PROJECT.read_text())["project"])))
