"""CITATION.cff, in the Citation File Format 1.2.0, from the declarations of the representations."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import yaml

from rosafe.declarations.reference import Reference
from rosafe.interface.citing import TITLE, software
from rosafe.system.version import VERSION

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


def text(publications: Iterable[Reference]) -> str:
    """Return the file, with the publications in this order."""
    contents = {
        "cff-version": "1.2.0",
        "message": "If you use this software, please cite it, and the publications of the representations that you use "
        "(docs/citing.md; the command rosafe cite prints those of a result).",
        "title": TITLE,
        "type": "software",
        "version": VERSION,
        "license": "BSD-3-Clause",
        "authors": _authors(software()),
        "abstract": "Binaural auditory representations (gammatone and DRNL filterbanks, inner hair cells, interaural "
        "differences, cross-correlation, ratemaps and representations derived from them) as a ROS 1 node and as a "
        "Python package, with localization of sound sources.",
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
