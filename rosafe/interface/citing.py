"""Citations of rosAFE and of publications behind the representations: `rosafe cite`, docs/citing.md, CITATION.cff."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rosafe.declarations.parameter import format_value
from rosafe.declarations.reference import LITERATURE, Citation, Reference, applicable
from rosafe.declarations.representation import Representation
from rosafe.system.version import AUTHORS, RELEASED, VERSION

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


# --- CITATION.cff --------------------------------------------------------------------------------------------------

_TYPES = {
    "article": "article",
    "inproceedings": "conference-paper",
    "incollection": "book",
    "book": "book",
    "phdthesis": "thesis",
    "techreport": "report",
    "software": "software",
}
_PUBLISHED_IN = {
    "article": "journal",
    "inproceedings": "collection-title",
    "incollection": "collection-title",
    "book": "publisher",
    "software": "publisher",
}


def citation_file(publications: Iterable[Reference]) -> str:
    """Return CITATION.cff, in the Citation File Format 1.2.0, with the publications in this order."""
    import yaml  # not installed by pip

    contents = {
        "cff-version": "1.2.0",
        "message": "If you use this software, please cite it, and the publications of the representations that you use "
        "(docs/citing.md; the command rosafe cite prints those of a result).",
        "title": TITLE,
        "type": "software",
        "version": VERSION,
        "date-released": RELEASED,
        "license": "BSD-3-Clause",
        "authors": _authors(software()),
        "abstract": "Binaural auditory representations (gammatone and DRNL filterbanks, inner hair cells, interaural "
        "differences, cross-correlation, ratemaps and representations derived from them) as nodes for ROS 1 and "
        "ROS 2 and as a Python package, with localization of sound sources.",
        "keywords": [
            "binaural hearing",
            "auditory models",
            "computational auditory scene analysis",
            "sound localization",
            "robot audition",
            "ROS",
        ],
        "references": [
            {
                "type": "software",
                "title": "openAFE and rosAFE, the C++ original for GenoM3",
                "authors": [{"name": "The Two!Ears project"}],
            },
            *map(_reference, publications),
        ],
    }
    return str(yaml.safe_dump(contents, sort_keys=False, allow_unicode=True, width=110))


def _reference(one: Reference) -> dict[str, Any]:
    field = _PUBLISHED_IN.get(one.kind, "institution")
    entry: dict[str, Any] = {
        "type": _TYPES[one.kind],
        "title": one.title,
        "authors": _authors(one),
        "year": one.year,
        field: one.published_in if field in ("journal", "collection-title") else {"name": one.published_in},
    }
    first, _, last = one.pages.partition("-")
    for name, value in {"volume": one.volume, "start": first, "end": last, "doi": one.doi, "notes": one.note}.items():
        if value:
            entry[name] = value
    return entry


def _authors(one: Reference) -> list[dict[str, str]]:
    people = [author.strip("{}").partition(", ") for author in one.authors.split(" and ") if author != "others"]
    return [{"family-names": name, "given-names": given} if given else {"name": name} for name, _, given in people]
