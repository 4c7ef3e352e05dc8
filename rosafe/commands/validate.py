"""Compare each representation with publications, closed forms, a measured head and other toolboxes.

One line is printed for each comparison: the deviation, its tolerance and the source of the reference values; known
limitations are reported without a tolerance. Toolboxes that are not installed are skipped. Nothing is installed, and no
network is needed. docs/validation.md is the page that -o writes.

exit status: 0 if all comparisons passed (with --self-test: if all disturbances were detected), 1 if not

examples:
  rosafe validate
  rosafe validate --self-test
  rosafe validate -o validation.md
  rosafe validate --figures ."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from rosafe.commands import CommandError
from rosafe.system.missing import require
from rosafe.system.output import check_target

if TYPE_CHECKING:
    from rosafe.validation.report import Row


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = "rosafe validate [--short] [--self-test] [-o FILE.md]\n       rosafe validate --figures FOLDER"
    parser.add_argument("--short", action="store_true", help="without other toolboxes")
    parser.add_argument(
        "--self-test",
        action="store_true",
        help="disturb each representation a little; each comparison has to detect it",
    )
    parser.add_argument(
        "-o",
        "--to",
        dest="to",
        metavar="FILE.md",
        help="write a page with a table, and pictures beside it; they are replaced if they exist",
    )
    parser.add_argument(
        "--figures",
        metavar="FOLDER",
        help="only write published curves with those of rosAFE: figures.md and pictures; existing files are replaced",
    )


def run(options: argparse.Namespace) -> int:
    """Run the comparisons and print or write their results."""
    if options.figures:
        return _write_figures(options)
    target = _target(options)
    from rosafe.validation import report

    begin, disturbed = time.monotonic(), options.self_test
    comparisons = [row for row in report.comparisons(options.short) if row.disturbance or not disturbed]
    rows = report.run(comparisons, disturbed, lambda row: print(report.line(row, disturbed), flush=True))
    computed = [row for row in rows if not row.skipped and row.comparison.disturbance]
    good = sum(row.passed is not disturbed for row in computed)
    word = "disturbances detected" if disturbed else "comparisons passed"
    skipped, seconds = sum(row.skipped for row in rows), time.monotonic() - begin
    print(f"{good} of {len(computed)} {word}, {skipped} skipped, in {seconds:.0f} s")
    if target:
        _write(target, rows, report.run((row for row in comparisons if row.disturbance), disturbed=True))
    return 0 if good == len(computed) else 1


def _target(options: argparse.Namespace) -> Path | None:
    """Return the checked path of the page, or None."""
    if not options.to:
        return None
    target = Path(options.to)
    if options.self_test:
        options.usage_error("-o: expected without --self-test, whose results the page contains as well, got both")
    if target.suffix.lower() != ".md":
        raise CommandError(f"-o: expected a name ending in .md, got {target}")
    if not target.parent.is_dir():
        raise CommandError(f"{target}: expected an existing folder {target.parent}")
    check_target(target, True)
    require("matplotlib", "pictures")
    return target


def _write_figures(options: argparse.Namespace) -> int:
    """Write the published figures."""
    if options.to or options.self_test or options.short:
        options.usage_error("--figures: expected without other options")
    folder = Path(options.figures)
    if not folder.is_dir():
        raise CommandError(f"--figures: expected an existing folder, got {folder}")
    require("matplotlib", "pictures")
    from rosafe.validation import figures, report

    for path in figures.write_published(folder, report.compute):
        print(path)
    return 0


def _write(target: Path, rows: list[Row], disturbed: list[Row]) -> None:
    """Write the page, and a picture for each group of comparisons that has curves."""
    from rosafe.system.output import write_whole
    from rosafe.validation import figures, report

    pictures = {}
    for group in dict.fromkeys(row.comparison.group for row in rows):
        members = [row for row in rows if row.comparison.group == group]
        if any(row.curve for row in members):
            picture = target.with_name(f"{target.stem}-{group}.png")
            figures.draw(members, picture)
            pictures[f"Reference values and measured values: {group}"] = picture.name
    write_whole(target, report.markdown(rows, disturbed, pictures).encode())
