"""The m-code uses only syntax and functions that MATLAB R2015a and Octave 7 have in common."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.harness import ROOT

FILES = sorted((ROOT / "matlab").rglob("*.m"))
OCTAVE_ONLY = (
    r"\b(end(if|for|while|function|switch|_try_catch)|unwind_protect|printf|puts|until)\b",
    r"[+*/-]=|\+\+|!=|^\s*#|!\s*\w",
    r'"',  # another class in MATLAB since R2017a, other escapes in Octave
)
SINCE_R2015B = (
    r"\b(jsondecode|jsonencode|contains|startsWith|endsWith|newline|isstring|strlength|erase|extractBefore|extractAfter"
    r"|strip|join|split|rmmissing|isfile|isfolder|convertStringsToChars|matlab\.net|base64decode|vecnorm|sgtitle)\s*\("
)
TEXTS = r"(?<![\w\])}'.])'(?:[^'\n]|'')*'"


def code(path: Path) -> list[str]:
    """Return the lines without texts and comments."""
    lines = path.read_text("utf-8").splitlines()
    return [re.sub(r"%.*", "", re.sub(TEXTS, "''", line)) for line in lines]


def test_files_are_found() -> None:
    assert len(FILES) > 20


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT / "matlab")))
def test_common_subset(path: Path) -> None:
    for number, line in enumerate(code(path), 1):
        for pattern in (*OCTAVE_ONLY, SINCE_R2015B):
            found = re.search(pattern, line)
            assert found is None, f"{path.name}:{number}: {found and found[0]}: {line}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT / "matlab")))
def test_layout(path: Path) -> None:
    """The first comment starts with the name of the file, and lines are not too long."""
    lines = path.read_text("utf-8").splitlines()
    assert re.match(rf"(classdef|function) .*\b{path.stem}\b", lines[0])
    assert lines[1].startswith(f"%{path.stem.upper()}  ")
    assert max(map(len, lines)) <= 120
    assert not [line for line in lines if line != line.rstrip() or "\t" in line]
