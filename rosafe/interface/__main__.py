"""`python3 -m rosafe.interface`: write all files that are derived from the interface table."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import rosafe
from rosafe.representations.registry import builtin_stages

from . import BASS, citing, files, functions, reference
from .rosafe import derive

ROOT = Path(__file__).parents[2]


def main(argv: list[str] | None = None) -> int:
    """Write the files and list those that changed; with ``--check`` only list them, and return 1 if there are any."""
    parser = argparse.ArgumentParser(
        prog="python3 -m rosafe.interface",
        description="Write the .msg, .srv and .action files of ROS 1, their lists in CMakeLists.txt, "
        "docs/parameters.md, docs/citing.md and rosafe/__init__.pyi.",
        epilog="example: python3 -m rosafe.interface --check",
    )
    parser.add_argument("--check", action="store_true", help="write nothing, only list the files that are out of date")
    options = parser.parse_args(argv)
    kinds = {kind: stage.REPRESENTATION for kind, stage in builtin_stages().items()}  # without the user's plugins
    components = (derive(kinds), BASS)
    expected = files.all_files(ROOT, components)
    expected[ROOT / "docs" / "parameters.md"] = reference.markdown(components, kinds)
    expected[ROOT / "docs" / "citing.md"] = citing.markdown(kinds)
    expected[ROOT / "rosafe" / "__init__.pyi"] = functions.stub(kinds, rosafe._MODULES, rosafe.__all__)
    stale = files.stale(expected)
    for path in stale:
        print(path.relative_to(ROOT))
    if options.check:
        return 1 if stale else 0
    files.write(expected)
    return 0


if __name__ == "__main__":
    sys.exit(main())
