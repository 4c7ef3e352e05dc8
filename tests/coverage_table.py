"""Coverage of rosafe by folder: python3 -m tests.coverage_table COVERAGE.json, from `scripts/test --coverage`."""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path

COUNTED = ("covered_lines", "num_statements", "covered_branches", "num_branches")


def folder_of(path: str) -> str:
    """Return the folder of a file in rosafe/; `rosafe` for the files of rosafe/ itself."""
    parts = Path(path).parts
    below = parts[parts.index("rosafe") + 1 : -1]
    return "/".join(below[: 2 if below[:1] in (("audio",), ("ros1",), ("web",)) else 1]) or "rosafe"


def percent(part: int, whole: int) -> str:
    """Return a percentage, rounded down; 100 if there is nothing to cover."""
    return f"{100 * part // whole if whole else 100} %"


def table(report: dict[str, dict[str, dict[str, dict[str, int]]]]) -> str:
    """Return the figures of each folder and of all, as a Markdown table."""
    folders: dict[str, Counter[str]] = {}
    for path, file in sorted(report["files"].items()):
        summary = {name: file["summary"][name] for name in COUNTED}
        for name in (folder_of(path), "all"):
            folders.setdefault(name, Counter()).update(summary)
    rows = ["| folder | statements | lines | branches |", "|---|---|---|---|"]
    for folder, counts in sorted(folders.items(), key=lambda item: (item[0] == "all", item[0])):
        covered, statements, covered_branches, branches = (counts[name] for name in COUNTED)
        figures = f"{statements} | {percent(covered, statements)} | {percent(covered_branches, branches)}"
        rows.append(f"| {folder} | {figures} |")
    return "\n".join(rows)


if __name__ == "__main__":
    print(table(json.loads(Path(sys.argv[1]).read_text("utf-8"))))
