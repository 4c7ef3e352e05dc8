"""Bibliographic references, and the citations by which declarations refer to them.

`literature.bib` contains the publications that the built-in representations and their validation cite.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosafe.declarations.checks import bad_name, bad_optional_text, bad_text, field_problems
from rosafe.declarations.text import short_repr

# The BibTeX field that names the publication, by type of entry
_PUBLISHED_IN = {
    "article": "journal",
    "inproceedings": "booktitle",
    "incollection": "booktitle",
    "book": "publisher",
    "phdthesis": "school",
    "techreport": "institution",
    "software": "publisher",
}
_ISSUED = ("phdthesis", "techreport")  # entries whose `note` belongs to the name of the publication


@dataclass(frozen=True)
class Reference:
    """A publication.

    Attributes
    ----------
    key : str
        The key of its BibTeX entry.
    kind : str
        The type of its BibTeX entry: article, inproceedings, incollection, book, phdthesis, techreport or software.
    authors : str
        Separated by `` and ``, each as ``Dau, T.``; the last may be ``others``.
    year : int
        Of the publication.
    title : str
        In sentence case.
    published_in : str
        The journal, proceedings, publisher or institution.
    volume, pages, doi, note : str
        Empty if there is none. Pages are separated by a hyphen. The DOI is without a resolver's address.
    """

    key: str
    kind: str
    authors: str
    year: int
    title: str
    published_in: str
    volume: str = ""
    pages: str = ""
    doi: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        checks = {"key": bad_name, **dict.fromkeys(("authors", "title", "published_in"), bad_text)}
        checks |= dict.fromkeys(("volume", "pages", "doi", "note"), bad_optional_text)
        for problem in field_problems(self, checks):
            raise ValueError(f"reference {short_repr(self.key)}: {problem}")
        if self.kind not in _PUBLISHED_IN:
            raise ValueError(
                f"reference {self.key}: kind: expected one of {', '.join(_PUBLISHED_IN)}, got {short_repr(self.kind)}"
            )
        if not re.fullmatch(r"(10\.\d{4,}/\S+)?", self.doi):
            raise ValueError(
                f"reference {self.key}: doi: expected a DOI (10.1121/1.414959), got {short_repr(self.doi)}"
            )

    @property
    def names(self) -> list[str]:
        """The authors' family names."""
        return [author.partition(",")[0].strip("{}") for author in self.authors.split(" and ")]

    @property
    def label(self) -> str:
        """The citation within a sentence, such as `Dau et al. (1996)`."""
        return f"{self._short} ({self.year})"

    @property
    def bracketed(self) -> str:
        """The citation within brackets, such as `Dau et al., 1996`."""
        return f"{self._short}, {self.year}"

    @property
    def _short(self) -> str:
        names = self.names
        return f"{names[0]} et al." if len(names) > 2 or "others" in names else " and ".join(names)

    @property
    def text(self) -> str:
        """The entry of a list of references."""
        authors = self.authors.strip("{}").replace(" and others", " et al.").replace(" and ", ", ")
        ending = "" if self.title.endswith(("?", "!")) else "."
        text = f"{authors} ({self.year}). {self.title}{ending} {self.published_in}"
        if self.note and self.kind in _ISSUED:
            text += f", {self.note}"
        if self.volume:
            text += f" {self.volume}"
        if self.pages:
            text += f", {self.pages}"
        if self.note and self.kind not in _ISSUED:
            text += f". {self.note}"
        return f"{text}." + (f" https://doi.org/{self.doi}" if self.doi else "")

    @property
    def bibtex(self) -> str:
        """The BibTeX entry. Words with capitals are protected from styles that change the case."""
        first, *others = self.title.split(" ")
        title = " ".join([first, *(f"{{{word}}}" if re.search("[A-Z]", word) else word for word in others)])
        fields = {
            "author": self.authors,
            "title": title,
            _PUBLISHED_IN[self.kind]: self.published_in,
            "year": str(self.year),
            "volume": self.volume,
            "pages": self.pages.replace("-", "--"),
            "number" if self.kind == "techreport" else "note": self.note,
            "doi": self.doi,
        }
        lines = ",\n".join(f"  {name} = {{{value}}}" for name, value in fields.items() if value)
        return f"@{self.kind}{{{self.key},\n{lines}\n}}"


_ENTRY = re.compile(r"@(\w+)\{(\w+),\n(.*?)\n\}", re.DOTALL)
_FIELD = re.compile(r"^  (\w+) = \{(.*)\},?$", re.MULTILINE)


def from_bibtex(text: str) -> Iterator[Reference]:
    """Yield the entries of a text in the form of `Reference.bibtex`: one field on each line, its value in braces."""
    for kind, key, body in _ENTRY.findall(text):
        fields = dict(_FIELD.findall(body))
        yield Reference(
            key,
            kind,
            fields["author"],
            int(fields["year"]),
            re.sub("[{}]", "", fields["title"]),
            fields[_PUBLISHED_IN[kind]],
            fields.get("volume", ""),
            fields.get("pages", "").replace("--", "-"),
            fields.get("doi", ""),
            fields.get("number" if kind == "techreport" else "note", ""),
        )


LITERATURE = {one.key: one for one in from_bibtex(Path(__file__).with_name("literature.bib").read_text("utf-8"))}


@dataclass(frozen=True)
class Citation:
    """A reference of a representation.

    Attributes
    ----------
    reference : Reference
        The publication.
    subject : str
        The contents that the representation takes from it, as a noun phrase; empty for the representation as a whole.
    when : tuple of (str, object)
        Parameters and their values for which the publication applies, all of them; several values as a tuple.
        Empty: always.
    """

    reference: Reference
    subject: str = ""
    when: tuple[tuple[str, Any], ...] = ()

    def __post_init__(self) -> None:
        for problem in field_problems(self, {"subject": bad_optional_text}):
            raise ValueError(f"citation of {short_repr(self.reference)}: {problem}")
        if not isinstance(self.reference, Reference):
            raise ValueError(f"citation: expected a Reference, got {short_repr(self.reference)}")

    def applies(self, parameters: Mapping[str, Any]) -> bool:
        """Return whether it applies with these parameters; parameters that are missing do not exclude it."""
        return all(_matches(parameters.get(name, value), value) for name, value in self.when)


def cite(key: str, subject: str = "", **when: Any) -> Citation:
    """Return a citation of an entry of `literature.bib`, which applies if parameters have these values."""
    return Citation(LITERATURE[key], subject, tuple(when.items()))


def _matches(value: Any, expected: Any) -> bool:
    return value == expected or (isinstance(expected, tuple) and value in expected)


def applicable(citations: tuple[Citation, ...], parameters: Mapping[str, Any]) -> Iterator[Citation]:
    """Yield the citations that apply with these parameters."""
    return (citation for citation in citations if citation.applies(parameters))
