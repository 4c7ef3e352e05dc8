"""Citations of rosAFE and of publications behind the representations: `rosafe cite`, docs/citing.md."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rosafe.declarations.parameter import format_value
from rosafe.declarations.reference import LITERATURE, Citation, Reference, applicable
from rosafe.declarations.representation import Representation
from rosafe.system.version import AUTHORS, VERSION

FRONT_END = LITERATURE["twoears2018"]
_WIDTH = 100  # characters of a line

TITLE = "rosAFE in Python: the Two!Ears auditory front-end"


def software(version: str = VERSION) -> Reference:
    """Return the reference of this software in a version."""
    return Reference(
        "rosafe",
        "software",
        f"{{The {AUTHORS}}}",
        2026,
        f"{TITLE}, version {version}",
        "Python package and ROS nodes",
    )


def references(kinds: Iterable[Representation], parameters: Mapping[str, Any]) -> list[Reference]:
    """Return the publications of some representations with these parameters, each once, in the order of the names."""
    found = {c.reference.key: c.reference for kind in kinds for c in applicable(kind.references, parameters)}
    found[FRONT_END.key] = FRONT_END
    return sorted(found.values(), key=lambda one: (one.names[0].lower(), one.year, one.key))


def paragraph(
    kinds: Sequence[Representation],
    parameters: Mapping[str, Any],
    sample_rate: float | None = None,
    version: str = VERSION,
) -> str:
    """Return text for a methods section.

    Parameters
    ----------
    kinds : sequence of Representation
        The representations in use and their parents, parents first.
    parameters : mapping
        Values in effect; those that are missing have their defaults.
    sample_rate : float, optional
        Of the sound, in Hz.
    version : str
        Of rosAFE.

    Returns
    -------
    str
        The paragraph, and below it the list of references.
    """
    at = f" at a sample rate of {sample_rate:g} Hz" if sample_rate else ""
    text = (
        f"Auditory representations were computed{at} with rosAFE, version {version} ({software().bracketed}), a "
        f"Python implementation of the Two!Ears auditory front-end ({FRONT_END.bracketed})."
    )
    steps = list(filter(None, (_step(kind, parameters) for kind in kinds if kind.parent)))
    if steps:
        text += f" The steps were: {'; '.join(steps)}. All other parameters had the defaults of this version."
    entries = [software(version), *references(kinds, parameters)]
    listed = "\n".join(textwrap.fill(e.text, _WIDTH, subsequent_indent="    ", **_UNBROKEN) for e in entries)
    return f"{textwrap.fill(text, _WIDTH, **_UNBROKEN)}\n\nReferences\n\n{listed}\n"


_UNBROKEN: dict[str, Any] = {"break_long_words": False, "break_on_hyphens": False}  # DOIs stay on one line


def _step(kind: Representation, parameters: Mapping[str, Any]) -> str:
    """Return the description of one representation, with its publications and the parameters that were changed."""
    changed = [
        f"{p.name} = {_shown(parameters[p.name])}{f' {p.unit}' if p.unit else ''}"
        for p in kind.parameters
        if p.name in parameters and (p.follows_rate or not _equal(parameters[p.name], p.default))
    ]
    if kind.kind == "preProc" and not changed:  # then its output is its input
        return ""
    labels = dict.fromkeys(c.reference.bracketed for c in applicable(kind.references, parameters))
    text = kind.doc.partition(":")[0]  # behind it, preProc lists steps, most of which may be off
    text = text[:1].lower() + text[1:]
    text += f" ({'; '.join(labels)})" if labels else ""
    return f"{text} with {', '.join(changed)}" if changed else text


def _shown(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else format_value(value)


def _equal(value: Any, default: Any) -> bool:
    return bool(list(value) == list(default) if isinstance(default, tuple) else value == default)


def bibtex(entries: Iterable[Reference]) -> str:
    """Return the BibTeX entries."""
    return "\n\n".join(entry.bibtex for entry in entries) + "\n"


def markdown(kinds: Mapping[str, Representation]) -> str:
    """Return docs/citing.md."""
    entries = [software(), *references(kinds.values(), {})]
    template = Path(__file__).with_name("citing_template.md").read_text("utf-8")
    return template.format(
        software="\n".join(f"* {entry.text}" for entry in (software(), FRONT_END)),
        rows="\n".join(row for kind in kinds.values() for row in _rows(kind)),
        bibtex=bibtex(entries).rstrip(),
    )


def _rows(kind: Representation) -> Iterator[str]:
    for citation in kind.references:
        label = citation.reference.label
        doi = citation.reference.doi
        linked = f"[{label}](https://doi.org/{doi})" if doi else label
        yield f"| `{kind.kind}` | {linked} | {citation.subject} | {condition(citation)} |"


def condition(citation: Citation) -> str:
    """Return the parameters with which a publication applies, as Markdown."""
    parts = []
    for name, value in citation.when:
        values = value if isinstance(value, tuple) else (value,)
        parts.append(f"`{name}` is " + " or ".join(f"`{_shown(one)}`" if one != "" else "empty" for one in values))
    return " and ".join(parts) or "always"
