"""`python3 -m rosafe.interface`: write all files that come from the interface table anew."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rosafe.representations.registry import builtin_stages

from . import BASS, files, reference
from .rosafe import derive

ROOT = Path(__file__).parents[2]


def main(argv: list[str] | None = None) -> int:
    """Write them, or say which are stale; 1 where some are."""
    parser = argparse.ArgumentParser(
        prog="python3 -m rosafe.interface",
        description="Write .msg, .srv and .action files, their lists in CMakeLists.txt and docs/parameters.md anew.",
        epilog="example: python3 -m rosafe.interface --check",
    )
    parser.add_argument("--check", action="store_true", help="write nothing, only name what is stale")
    options = parser.parse_args(argv)
    kinds = {kind: stage.REPRESENTATION for kind, stage in builtin_stages().items()}  # no plugins of whoever runs this
    components = (derive(kinds), BASS)
    wanted = files.all_files(ROOT, components)
    wanted[ROOT / "docs" / "parameters.md"] = reference.markdown(components, kinds)
    stale = files.stale(wanted)
    for path in stale:
        print(path.relative_to(ROOT))
    if options.check:
        return 1 if stale else 0
    files.write(wanted)
    return 0


if __name__ == "__main__":
    sys.exit(main())
