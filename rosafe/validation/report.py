"""Runs the comparisons, and writes their results as text and Markdown."""

from __future__ import annotations

import math
import re
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.processing.process import process
from rosafe.results.result import Result
from rosafe.system.version import VERSION
from rosafe.validation import binaural, kemar, monaural, peers, periphery, systems, transients
from rosafe.validation.comparison import (
    DEFINITION,
    INDEPENDENT,
    LIMITATION,
    STAGE,
    Comparison,
    Curve,
    Measured,
    Process,
)


def comparisons(short: bool = False) -> list[Comparison]:
    """Return all comparisons, or those of the short form, by the order of the chain."""
    modules = (periphery, monaural, transients, binaural, kemar, systems, peers)
    return [row for module in modules for row in module.ROWS.comparisons if row.short or not short]


@dataclass(frozen=True)
class Row:
    """The result of one comparison; `parameters` is the text of those with which the function under test was called."""

    comparison: Comparison
    deviation: float = math.nan
    curve: Curve | None = None
    seconds: float = 0.0
    parameters: str = ""

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
    calls: list[tuple[float, Mapping[str, Any]]] = []
    under_test = recorded(comparison.under_test or compute, calls)
    if disturbed and comparison.disturbance:
        under_test = comparison.disturbance.change(under_test)
    measured = comparison.measure(under_test)
    if not isinstance(measured, Measured):
        measured = Measured(measured)
    seconds = time.monotonic() - begin
    return Row(comparison, float(measured.deviation), measured.curve, seconds, parameters_text(calls))


def recorded(under_test: Process, calls: list[tuple[float, Mapping[str, Any]]]) -> Process:
    """Return a function that appends the sample rate and the parameters of each call to `calls`."""

    def run(signal: Any, rate: float, parameters: Mapping[str, Any], outputs: Sequence[str]) -> Any:
        calls.append((rate, parameters))
        return under_test(signal, rate, parameters, outputs)

    return run


def parameters_text(calls: Sequence[tuple[float, Mapping[str, Any]]]) -> str:
    """Return the sample rates and parameters of calls as Markdown: `name` = value; of several values the extremes."""
    rates = sorted({f"{rate / 1000:g} kHz" for rate, _ in calls})
    names = list(dict.fromkeys(name for _, parameters in calls for name in parameters))
    texts = [
        f"`{name}` = {_values([parameters[name] for _, parameters in calls if name in parameters])}" for name in names
    ]
    return "; ".join([" or ".join(rates), *(texts or ["defaults"])])


def _values(values: Sequence[Any]) -> str:
    texts = list(dict.fromkeys(_value(value) for value in values))
    return texts[0] if len(texts) == 1 else f"{texts[0]} ... {texts[-1]}"


def _value(value: Any) -> str:
    if isinstance(value, list | tuple):
        items = [_value(item) for item in value]
        return ", ".join(items if len(items) < 6 else [*items[:2], "...", items[-1]])
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def line(row: Row, disturbed: bool = False) -> str:
    """Return one line about a result."""
    comparison = row.comparison
    name = f"{comparison.kind}: {comparison.subject}"
    if row.skipped:
        return f"{'skipped':12}{name}: {comparison.missing}"
    if not comparison.disturbance:
        return f"{'reported':12}{name}: {_amount(row)}"
    verdict = "detected" if disturbed else "pass"
    if row.passed is disturbed:
        verdict = "NOT DETECTED" if disturbed else "FAIL"
    about = f" ({comparison.disturbance.text})" if disturbed else ""
    return f"{verdict:12}{name}{about}: {_amount(row)}, tolerance {comparison.tolerance:g}; {comparison.source}"


_HEAD, *_SECTIONS = re.split(
    "^(?=## )", Path(__file__).with_name("validation_template.md").read_text("utf-8"), flags=re.M
)
SECTIONS = dict(zip((INDEPENDENT, STAGE, DEFINITION, LIMITATION), _SECTIONS, strict=True))  # text and head of the table


def markdown(rows: Sequence[Row], disturbed: Sequence[Row], pictures: Mapping[str, str]) -> str:
    """Return the page.

    Parameters
    ----------
    rows, disturbed : sequence of Row
        The results without disturbances, and those with them.
    pictures : mapping of str to str
        The names of the pictures by their descriptions.
    """
    errors = {row.comparison: row for row in disturbed}
    lines = [_HEAD + f"Version {VERSION}: {_summary(rows)}\n"]
    for evidence, section in SECTIONS.items():
        if members := [row for row in rows if row.comparison.evidence == evidence]:
            table = "\n".join(_markdown_row(row, errors.get(row.comparison)) for row in members)
            lines.append(f"{section.rstrip()}\n{table}\n")
    lines += ["## Pictures\n", *(f"![{text}]({name})\n" for text, name in pictures.items())]
    return "\n".join(lines).rstrip() + "\n"


def _summary(rows: Sequence[Row]) -> str:
    parts = []
    for evidence, name in {INDEPENDENT: "independent", STAGE: "single stages", DEFINITION: "own definitions"}.items():
        members = [row for row in rows if row.comparison.evidence == evidence and not row.skipped]
        parts.append(f"{sum(row.passed for row in members)} of {len(members)} {name}")
    checked = [row for row in rows if row.comparison.disturbance and not row.skipped]
    total = f"{sum(row.passed for row in checked)} of {len(checked)} comparisons passed"
    return f"{total} ({', '.join(parts)}); {sum(row.skipped for row in rows)} were skipped."


def _amount(row: Row) -> str:
    return f"{row.deviation:.2g} {row.comparison.unit}".rstrip()


def _markdown_row(row: Row, disturbed: Row | None) -> str:
    comparison = row.comparison
    cells = [
        f"`{comparison.kind}`",
        comparison.subject,
        comparison.source.markdown,
        row.parameters,
        comparison.criterion,
        "skipped" if row.skipped else _amount(row),
    ]
    if comparison.disturbance:
        verdict = "" if row.skipped else "yes" if row.passed else "**no**"
        error = "" if disturbed is None or disturbed.skipped else f": {disturbed.deviation:.2g}"
        cells += [f"{comparison.tolerance:g}", verdict, comparison.disturbance.text + error]
    return f"| {' | '.join(cells)} |"
