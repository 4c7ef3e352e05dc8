"""The publications that the built-in representations and their validation cite: `literature.bib`.

An entry is a name of this module, made of its key: ``from rosafe.declarations.literature import DAU_1996``.
"""

from __future__ import annotations

import re
from pathlib import Path

from rosafe.declarations.reference import Reference, from_bibtex

LITERATURE = {one.key: one for one in from_bibtex(Path(__file__).with_suffix(".bib").read_text("utf-8"))}


def __getattr__(name: str) -> Reference:
    """Return the entry `dau1996` for the name `DAU_1996`."""
    key = name.replace("_", "").lower()
    if not re.fullmatch(r"[A-Z]+_\d{4}", name) or key not in LITERATURE:
        raise AttributeError(f"{__name__}: expected a key of literature.bib in the form DAU_1996, got {name}")
    return LITERATURE[key]
