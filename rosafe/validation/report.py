"""Runs the comparisons, and writes their results as text and Markdown."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.offline.process import process
from rosafe.offline.result import Result
from rosafe.validation import binaural, kemar, monaural, peers, periphery
from rosafe.validation.comparison import Comparison, Curve, Measured
from rosafe.version import VERSION


def comparisons(short: bool = False) -> list[Comparison]:
    """Return all comparisons, or those of the short form, by the order of the chain."""
    modules = (periphery, monaural, binaural, kemar, peers)
    return [row for module in modules for row in module.ROWS.comparisons if row.short or not short]


@dataclass(frozen=True)
class Row:
    """The result of one comparison."""

    comparison: Comparison
    deviation: float = math.nan
    curve: Curve | None = None
    seconds: float = 0.0

    @property
    def skipped(self) -> bool:
        """Whether a peer or a data set is missing."""
        return bool(self.comparison.missing)

    @property
    def passed(self) -> bool:
        """Whether the deviation is within the tolerance."""
        return self.deviation <= self.comparison.tolerance  # False for NaN


def compute(signal: FloatArray, rate: float, parameters: Mapping[str, Any], outputs: Sequence[str]) -> Result:
    """Compute representations; the function under test."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # remarks about short windows and sounds
        return process(signal, rate, parameters=dict(parameters), outputs=list(outputs))


def run(
    rows: Iterable[Comparison], disturbed: bool = False, report: Callable[[Row], None] = lambda row: None
) -> list[Row]:
    """Compute the comparisons.

    Parameters
    ----------
    rows : iterable of Comparison
        The comparisons.
    disturbed : bool
        Whether each representation is disturbed as its comparison declares.
    report : callable
        Called with each result.

    Returns
    -------
    list of Row
        The results, in the same order.
    """
    results = []
    for comparison in rows:
        row = _run_one(comparison, disturbed)
        report(row)
        results.append(row)
    return results


def _run_one(comparison: Comparison, disturbed: bool) -> Row:
    if comparison.missing:
        return Row(comparison)
    begin = time.monotonic()
    measured = comparison.measure(comparison.disturbance.change(compute) if disturbed else compute)
    if not isinstance(measured, Measured):
        measured = Measured(measured)
    return Row(comparison, float(measured.deviation), measured.curve, time.monotonic() - begin)


def line(row: Row, disturbed: bool = False) -> str:
    """Return one line about a result."""
    comparison = row.comparison
    name = f"{comparison.kind}: {comparison.subject}"
    if row.skipped:
        return f"{'skipped':12}{name}: {comparison.missing}"
    verdict = "detected" if disturbed else "pass"
    if row.passed is disturbed:
        verdict = "NOT DETECTED" if disturbed else "FAIL"
    about = f" ({comparison.disturbance.text})" if disturbed else ""
    return f"{verdict:12}{name}{about}: {_amount(row)}, tolerance {comparison.tolerance:g}; {comparison.source}"


HEAD = """# Validation

Each representation is compared with something that is not part of rosAFE: published formulas and values, closed forms,
the measured head KEMAR, and other toolboxes. This page is written by the last of these commands:

```sh
rosafe validate                        # a line for each comparison; without network
rosafe validate --short                # without other toolboxes
rosafe validate --self-test            # each comparison has to detect a small error of its representation
rosafe validate -o validation.md       # this page and its pictures
```

Comparisons with other toolboxes are skipped if these are not installed; `pip install gammatone pyfar librosa
python-auditory-toolbox` installs all of them. KEMAR needs Debian's libmysofa1 and h5py. "Disturbance" is the
error that `--self-test` introduces. The last column is the deviation with it, which has to exceed the tolerance.
"""


def markdown(rows: Sequence[Row], disturbed: Sequence[Row], pictures: Mapping[str, str]) -> str:
    """Return the page.

    Parameters
    ----------
    rows, disturbed : sequence of Row
        The results without and with disturbances.
    pictures : mapping of str to str
        The names of the pictures by their descriptions.
    """
    checked = [row for row in rows if not row.skipped]
    passed = sum(row.passed for row in checked)
    kinds = len({row.comparison.kind for row in checked})
    lines = [
        HEAD,
        f"Version {VERSION}: {passed} of {len(checked)} comparisons passed, of {kinds} representations; "
        f"{len(rows) - len(checked)} were skipped.\n",
        "| representation | quantity | reference | deviation | tolerance | passed | disturbance | deviation with it |",
        "|---|---|---|--:|--:|---|---|--:|",
        *(_markdown_row(*pair) for pair in zip(rows, disturbed, strict=True)),
        "",
        *(f"![{text}]({name})\n" for text, name in pictures.items()),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _amount(row: Row) -> str:
    return f"{row.deviation:.2g} {row.comparison.unit}".rstrip()


def _markdown_row(row: Row, disturbed: Row) -> str:
    comparison = row.comparison
    verdict = "" if row.skipped else "yes" if row.passed else "**no**"
    error = "" if disturbed.skipped else f"{disturbed.deviation:.2g}"
    cells = (
        f"`{comparison.kind}`",
        comparison.subject,
        comparison.source.markdown,
        "skipped" if row.skipped else _amount(row),
        f"{comparison.tolerance:g}",
        verdict,
        comparison.disturbance.text,
        error,
    )
    return f"| {' | '.join(cells)} |"
