"""The paper: structure as JOSS expects it, references that exist, and figures that agree with the measurements."""

from __future__ import annotations

import json
import re

import pytest
import yaml

from rosafe.declarations.reference import LITERATURE
from tests.harness import ROOT

PAPER = (ROOT / "paper" / "paper.md").read_text("utf-8")
BIB = (ROOT / "paper" / "paper.bib").read_text("utf-8")
_, HEADER, BODY = PAPER.split("---\n", 2)


def test_the_header() -> None:
    header = yaml.safe_load(HEADER)
    assert {"title", "tags", "authors", "affiliations", "date", "bibliography"} <= header.keys()
    assert header["bibliography"] == "paper.bib" and len(header["tags"]) >= 3
    known = {affiliation["index"] for affiliation in header["affiliations"]}
    assert all(author["affiliation"] in known and author["name"] for author in header["authors"])


def test_sections_and_length() -> None:
    sections = re.findall(r"^# (.*)$", BODY, re.MULTILINE)
    required = ["Summary", "Statement of need", "State of the field", "Software design", "Research impact statement"]
    assert sections == [*required, "AI usage disclosure", "Acknowledgements", "References"]
    assert 750 <= len(re.sub(r"^\|.*$", "", BODY, flags=re.MULTILINE).split()) <= 1750  # without tables


def test_cited_keys_exist_and_are_used() -> None:
    cited = set(re.findall(r"@([A-Za-z][\w-]*)", BODY))
    entries = re.findall(r"^@\w+\{([\w-]+),$", BIB, re.MULTILINE)
    assert len(entries) == len(set(entries)) and cited == set(entries)
    assert BIB.count("{") == BIB.count("}")


def test_publications_of_representations_are_those_of_the_declarations() -> None:
    shared = [key for key in re.findall(r"^@\w+\{([\w-]+),$", BIB, re.MULTILINE) if key in LITERATURE]
    assert len(shared) >= 6 and all(LITERATURE[key].bibtex in BIB for key in shared)


def test_only_names_are_placeholders() -> None:
    assert BODY.count("AI TOOL NAMES") == 1
    assert not re.search(r"TODO|FIXME|XXX|MEASURED|RESTORED|CAUSAL|ESTIMATED|IDEAL|STATEMENT", BODY)
    assert set(re.findall(r"\b[A-Z]{6,}(?: [A-Z]+)?\b", HEADER)) == {"AUTHOR NAME", "AFFILIATION"}


def test_pictures_exist() -> None:
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", BODY)
    assert pictures and all((ROOT / "paper" / picture).is_file() for picture in pictures)


def test_figures_are_those_of_the_measurements() -> None:
    validation = (ROOT / "docs" / "validation.md").read_text("utf-8")
    passed = re.search(r"(\d+ of \d+ comparisons) passed", validation)
    assert passed and f"{passed[1]} pass" in BODY
    table = re.findall(r"^\| [^|]* \| [^|]* \| ([^|]*) \|$", BODY, re.MULTILINE)[1:]
    assert len(table) == 7
    for value in table:
        number = re.search(r"[\d.]+(?:e-\d+)?$", value.split(" ")[-1]) or re.search(r"[\d.]+(?:e-\d+)?", value)
        assert number and f"| {number[0].replace('e-7', 'e-07')}" in validation, value
    known = json.loads((ROOT / "benchmarks" / "results" / "resynthesis.json").read_text("utf-8"))
    talkers = known["talkers"]["figures"]
    for mask in ("estimated, matched head", "ideal ratio mask"):
        assert f"{talkers[f'{mask}, 0 and 60']:.1f} dB" in " ".join(BODY.split())
    assert f"{known['error']['figures']['1 ERB (default), 44100 Hz']:.0f} dB" in BODY


@pytest.mark.parametrize(
    ("text", "section", "column"),
    [
        ("within 5 degrees in a share of {} of 360 trials", "Speech, matched head", 1),
        ("At 0 dB the share is {};", "Speech, matched head", 4),
        ("direct-to-reverberant ratio of 0 dB it is {}.", "Rooms: one talker, matched head", 1),
    ],
)
def test_localization_figures(text: str, section: str, column: int) -> None:
    measured = (ROOT / "benchmarks" / "results" / "localization.md").read_text("utf-8")
    part = measured.split(f"## {section}\n")[1]
    row = re.search(r"^\| within 5 degrees \| (.*) \|$", part, re.MULTILINE)
    assert row and text.format(row[1].split(" | ")[column]) in " ".join(BODY.split())
