"""Write docs/reference: a page and a picture for each representation, from its declaration and docs/reference_pages.py.

python3 docs/reference.py [KIND ...]
"""

from __future__ import annotations

import contextlib
import io
import runpy
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib.pyplot
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from reference_pages import PAGES

import rosafe
from rosafe.declarations.parameter import format_value
from rosafe.declarations.reference import Citation
from rosafe.declarations.representation import Representation
from rosafe.interface.citing import condition
from rosafe.representations.registry import builtin_stages
from rosafe.results.view.axes import style

FOLDER = Path(__file__).resolve().parent / "reference"
KINDS = {kind: stage.REPRESENTATION for kind, stage in builtin_stages().items()}
_AXES = {"ear": "ears", "channel": "channels", "lag": "lags", "filter": "modulation filters", "feature": "features"}


def example(kind: str) -> str:
    """Return the Python code of an example."""
    page, name = PAGES[kind], next(iter(KINDS[kind].outputs))
    also = ', "itd"' if kind == "precedence" else ""
    parameters = f"parameters = {page.parameters}\n" if page.parameters else ""
    given = ", parameters=parameters" if page.parameters else ""
    return (
        "import numpy as np\nimport rosafe\n\nrate = 16000\ntime = np.arange(rate) / rate\n"
        f'{page.sound}\n{parameters}result = rosafe.process(sound, rate{given}, outputs=["{kind}"{also}])\n'
        f'{page.use}\nfigure = rosafe.plot(result, "{name}")\n'
    )


def run(kind: str) -> tuple[str, dict[str, Any]]:
    """Run an example; return its output and its variables."""
    with tempfile.NamedTemporaryFile("w", suffix=".py") as file, contextlib.redirect_stdout(io.StringIO()) as printed:
        file.write(example(kind))
        file.flush()
        variables = runpy.run_path(file.name)
    matplotlib.pyplot.close("all")
    return printed.getvalue(), variables


def text(kind: str, printed: str) -> str:
    """Return the page of a representation."""
    page, declared = PAGES[kind], KINDS[kind]
    return "\n".join(
        [
            f"# {page.title}: `{kind}`\n",
            f"{declared.doc}.\n",
            f"![{page.title} of the example]({kind}.png)\n",
            *_facts(declared),
            f"\n## Equations\n\n{page.equations}\n",
            *_parameters(declared),
            f"## Example\n\n```python\n{example(kind)}```\n",
            f"It prints\n\n```\n{printed}```\n\nand plots the picture above.\n",
            *_references(declared),
        ]
    )


def _facts(declared: Representation) -> list[str]:
    lines = ["| output | axes | unit |", "|---|---|---|"]
    for name, part in declared.outputs.items():
        axes = " x ".join([_AXES.get(axis, axis) for axis in part.axes[:-1]] + ["time"])
        lines.append(f"| `{name}` | {axes} | {part.unit} |")
    parent = f"Computed from [`{declared.parent}`]({declared.parent}.md). " if declared.parent else ""
    return [*lines, f"\n{parent}Request of the node: `{declared.request}`; port: `{declared.port}`."]


def _parameters(declared: Representation) -> list[str]:
    if not declared.parameters:
        return ["## Parameters\n\nIt has no parameters of its own.\n"]
    lines = ["## Parameters\n", "| name | default | unit | allowed | meaning |", "|---|---|---|---|---|"]
    for one in declared.parameters:
        value = format_value(one.default).replace("|", r"\|")
        default = f"`{value}`" if value else "empty"
        lines.append(f"| `{one.name}` | {default} | {one.unit} | {one.range_text} | {one.doc} |")
    return [*lines, ""]


def _references(declared: Representation) -> list[str]:
    lines = ["## References\n"]
    lines += [f"* {citation.reference.text}{_condition(citation)}" for citation in declared.references]
    return [*lines, "\n[All representations](../representations.md), [citing rosAFE](../citing.md)\n"]


def _condition(citation: Citation) -> str:
    when = f"if {condition(citation)}" if citation.when else ""
    about = "; ".join(part for part in (citation.subject, when) if part)
    return f" ({about})" if about else ""


def draw(kind: str, result: Any) -> None:
    """Write the picture: one panel for each part of the output."""
    names = list(KINDS[kind].outputs)
    with style():
        figure = Figure(figsize=(6.4, 0.4 + 2.0 * len(names)), dpi=72, layout="constrained")
        for number, name in enumerate(names):
            rosafe.plot(result, name, figure.add_subplot(len(names), 1, number + 1))
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    picture = picture.quantize(64, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    picture.save(FOLDER / f"{kind}.png", optimize=True)


def main(kinds: list[str]) -> None:
    for kind in kinds or KINDS:
        printed, variables = run(kind)
        (FOLDER / f"{kind}.md").write_text(text(kind, printed), "utf-8")
        draw(kind, variables["result"])
        print(kind, printed.strip(), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
