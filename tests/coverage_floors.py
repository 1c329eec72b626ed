"""Part of `make check`: how much of each part the tests have run through, branches included, and the least allowed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

FLOORS: list[tuple[str, float, Callable[[str], bool]]] = [
    ("gateway/", 90.0, lambda name: name.startswith("gateway/")),
    ("gateway/modbus/", 95.0, lambda name: name.startswith("gateway/modbus/")),
    *(
        (f"gateway/{module}.py", 95.0, lambda name, module=module: name == f"gateway/{module}.py")
        for module in ("register", "master", "slave", "slave_tcp", "store")
    ),
]


def main() -> int:
    with TemporaryDirectory() as folder:
        report = Path(folder) / "coverage.json"
        subprocess.run([sys.executable, "-m", "coverage", "json", "-q", "-o", str(report)], check=True)
        files = json.loads(report.read_text())["files"]
    failed = False
    for label, least, belongs in FLOORS:
        summaries = [file["summary"] for name, file in files.items() if belongs(name)]
        run = sum(s["covered_lines"] + s["covered_branches"] for s in summaries)
        all_of_it = sum(s["num_statements"] + s["num_branches"] for s in summaries)
        percent = 100.0 * run / all_of_it if all_of_it else 0.0
        print(f"{label:24} {percent:6.2f} %  (at least {least:.0f} %)")
        failed |= percent < least
    for name, file in sorted(files.items(), key=lambda item: item[1]["summary"]["percent_covered"])[:8]:
        print(f"    {file['summary']['percent_covered']:6.2f} %  {name}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
