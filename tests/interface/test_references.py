"""References: the declarations of publications, and the texts made from them."""

from __future__ import annotations

import re

import pytest
import yaml

from rosafe import plugin
from rosafe.declarations.reference import LITERATURE, Citation, Reference
from rosafe.interface import KINDS, citing
from rosafe.representations import BUILTIN
from rosafe.system.version import AUTHORS, VERSION
from tests.harness import ROOT

DEFAULTS = {p.name: p.default for kind in KINDS.values() for p in kind.parameters}
ENTRY = re.compile(r"@(\w+)\{(\w+),\n((?:  \w+ = \{.*\},?\n)+)\}")


@pytest.mark.parametrize("kind", sorted(BUILTIN))
def test_every_representation_has_references_with_valid_conditions(kind: str) -> None:
    citations = KINDS[kind].references
    assert citations
    for citation in citations:
        assert LITERATURE[citation.reference.key] is citation.reference
        for name, value in citation.when:
            choices = next(p.choices for k in KINDS.values() for p in k.parameters if p.name == name)
            for one in value if isinstance(value, tuple) else (value,):
                assert one in choices if choices else isinstance(one, type(DEFAULTS[name])), citation


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("package.xml", r'<maintainer email="[^"]+">{}</maintainer>'),
        ("bass/package.xml", r'<maintainer email="[^"]+">{}</maintainer>'),
        ("ros2/rosafe_msgs/package.xml", r'<maintainer email="[^"]+">{}</maintainer>'),
        ("pyproject.toml", r'authors = \[{{ name = "{}", email = "[^"]+" }}\]'),
        ("debian/control", r"Maintainer: {} <[^>]+>"),
        ("debian/copyright", r"Copyright: the {}"),
        ("LICENSE", r"Copyright \(c\) the {}"),
        ("docs/conf.py", r'copyright = "the {}"'),
        ("CITATION.cff", r"- name: The {}"),
        ("docs/citing.md", r"  author = {{{{The {}}}}},"),
    ],
)
def test_all_files_name_the_authors_of_the_citation(file: str, line: str) -> None:
    assert re.search(f"^ *{line.format(re.escape(AUTHORS))}$", (ROOT / file).read_text("utf-8"), re.MULTILINE)


@pytest.mark.parametrize("method", ["dau", "dau1996", "breebart", "bernstein", "joergensen"])
def test_every_published_hair_cell_has_its_own_reference(method: str) -> None:
    labels = {one.label for one in citing.references([KINDS["ihc"]], {**DEFAULTS, "ihc_method": method})}
    others = {one.label for one in citing.references([KINDS["ihc"]], {**DEFAULTS, "ihc_method": "halfwave"})}
    assert labels > others


def test_citations_depend_on_all_conditions() -> None:
    both = Citation(LITERATURE["dau1996"], "subject", (("a", 1), ("b", ("x", "y"))))
    assert both.applies({"a": 1, "b": "x"})
    assert both.applies({"b": "y"})
    assert not both.applies({"a": 2, "b": "x"})
    assert not both.applies({"a": 1, "b": "z"})


def test_texts() -> None:
    assert LITERATURE["dau1996"].label == "Dau et al. (1996)"
    assert LITERATURE["dau1996"].bracketed == "Dau et al., 1996"
    assert LITERATURE["dau1996"].text.startswith("Dau, T., Püschel, D., Kohlrausch, A. (1996). A quantitative model of")
    assert LITERATURE["dau1996"].text.endswith(
        "Acoustical Society of America 99, 3615-3622. https://doi.org/10.1121/1.414959"
    )
    assert LITERATURE["young2006"].text.startswith("Young, S. et al. (2006). The HTK book.")
    assert LITERATURE["stern1988"].label == "Stern et al. (1988)"
    assert LITERATURE["kollmeier1994"].label == "Kollmeier and Koch (1994)"


def test_the_literature_is_read_and_written_without_a_change() -> None:
    file = (ROOT / "rosafe" / "declarations" / "literature.bib").read_text("utf-8")
    assert citing.bibtex(LITERATURE[key] for key in sorted(LITERATURE)) == file
    assert len(LITERATURE) == file.count("@") > 40
    assert LITERATURE["dau1996"].title.endswith("processing in the auditory system. I. Model structure")
    assert LITERATURE["dau1996"].pages == "3615-3622"
    for one in LITERATURE.values():
        assert one.kind != "article" or (one.published_in and one.volume and one.pages)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("kind", "web", "reference a2000: kind: expected one of article, .*, got 'web'"),
        ("doi", "https://doi.org/10.1/1", "reference a2000: doi: expected a DOI"),
        ("key", "a b", "reference 'a b': key: expected a name"),
        ("title", "", "reference 'a2000': title: expected one line of text"),
    ],
)
def test_invalid_references_are_refused(field: str, value: str, message: str) -> None:
    fields = {"key": "a2000", "kind": "article", "authors": "A, B.", "year": 2000, "title": "T", "published_in": "J"}
    Reference(**fields)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=message):
        Reference(**{**fields, field: value})  # type: ignore[arg-type]


def test_plugins_declare_references() -> None:
    work = plugin.Reference("key2026", "article", "Author, A. and Author, B.", 2026, "Title", "Journal", "1", "1-10")
    declared = plugin.Representation(
        "zeroCrossings", "Zero crossings", "gammatone", ("ear", "channel", "time"), references=(plugin.Citation(work),)
    )
    text = " ".join(citing.paragraph([declared], {}).split())
    assert "The steps were: zero crossings (Author and Author, 2026)." in text
    assert "Author, A., Author, B. (2026). Title. Journal 1, 1-10." in text
    with pytest.raises(ValueError, match="references: expected a tuple of Citation, got"):
        plugin.Representation("zeroCrossings", "Zero crossings", references=(work,))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="citation: expected a Reference, got 'key2026'"):
        plugin.Citation("key2026")  # type: ignore[arg-type]


def test_citation_file_is_complete() -> None:
    found = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert (found["version"], found["title"]) == (VERSION, citing.TITLE)
    assert {"cff-version", "message", "authors", "abstract", "keywords", "license", "type"} <= found.keys()
    cited = citing.references([KINDS[kind] for kind in BUILTIN], {})
    listed = [(one["title"], one["year"], one.get("doi", "")) for one in found["references"][1:]]
    assert listed == [(one.title, one.year, one.doi) for one in cited]
    assert all(one["authors"] for one in found["references"][1:])


def test_page_lists_every_representation_and_entry() -> None:
    page = (ROOT / "docs" / "citing.md").read_text("utf-8")
    assert all(f"| `{kind}` |" in page for kind in BUILTIN)
    assert {key for _, key, _ in ENTRY.findall(page)} == {
        "rosafe",
        *(one.key for one in citing.references([KINDS[kind] for kind in BUILTIN], {})),
    }
