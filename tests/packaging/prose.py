"""Sentences of the project's prose, and the phrases in them that a reader from the field stumbles over.

Run as a program, it lists the sentences of the paths given: ``python3 -m tests.packaging.prose rosafe/tree docs``.
"""

from __future__ import annotations

import ast
import functools
import re
import sys
from collections.abc import Iterator
from pathlib import Path

_PATTERNS = {
    "'what' as a noun": r"\bwhat\b(?! (?:to|if)\b)",
    "a person instead of a role": r"\b(?:nobody|somebody|anybody|whoever|whom)\b|\bwho\b(?! am\b)",
    "tell": r"\b(?:tell(?:s|ing)?|told|untold)\b",
    "so many without a measure": r"\bso (?:many|much|long)\b(?! (?:that|as)\b)",
    "an archaic adverb": r"\b(?:anew|afresh|thereby|therein|thereof|whence|lest)\b",
    "goes on": r"\b(?:go(?:es)?|went|carr(?:y|ies|ied)) on\b",
    "hangs on": r"\bhang(?:s|ing)? (?:on|together)\b",
    "lets go, holds up": r"\b(?:let(?:s|ting)? go|(?:hold(?:s|ing)?|held) up)\b",
    "hears of": r"\bhear(?:s|d)? (?:of|about)\b",
    "wanted is": r"\bwanted (?:is|are)\b",
    "a sentence that begins with 'Of the ...'": r"^(?:that|those|as|of) (?:of|that|it|an?|the|each|all)\b",
    "is no": r"\b(?:is|are|be) no \w+",
    "but as 'except'": r"\bbut (?:for|one|by)\b",
    "else as 'otherwise'": r"[,;] else\b|^else\b",
    "'where' as 'if'": r"\bwhere (?:there|it|that|one|none|nothing|something|an?|the|they|this|what|no)\b",
    "beside each other": r"\b(?:beside|after) (?:each|the) other\b",
}
MARKERS = {name: re.compile(pattern, re.IGNORECASE) for name, pattern in _PATTERNS.items()}
_COMMENTS = {  # what a comment looks like, by suffix; one group is its text
    ".c": re.compile(r"//\s?(.*)|/\*\s?(.*?)\s*(?:\*/|$)|^\s*\*\s(.*?)\s*(?:\*/|$)"),
    ".h": re.compile(r"//\s?(.*)|/\*\s?(.*?)\s*(?:\*/|$)|^\s*\*\s(.*?)\s*(?:\*/|$)"),
    ".js": re.compile(r"(?:^|\s)//\s?(.*)|/\*\*?\s?(.*?)\s*(?:\*/|$)|^\s*\*\s(.*?)\s*(?:\*/|$)"),
    ".tcl": re.compile(r"(?:^|;)\s*#+\s?(.*)"),
    ".m": re.compile(r"(?:^|\s)%+\s?(.*)"),
    ".sh": re.compile(r"(?:^|\s)#+\s(.*)"),
}
SUFFIXES = {".py", ".md", *_COMMENTS}
# Strings are matched first, since they may contain "#"; the group is a comment. tokenize takes ten times as long.
_STRING_OR_COMMENT = re.compile(
    r'''"""(?:[^"\\]|\\.|"(?!""))*"""|\'{3}(?:[^'\\]|\\.|'(?!''))*\'{3}'''
    r"""|"(?:[^"\\\n]|\\.)*"|'(?:[^'\\\n]|\\.)*'|(#[^\n]*)""",
    re.DOTALL,
)
_MIN_WORDS = 4  # a shorter piece of text is a label and not a sentence


@functools.cache
def sentences(path: Path) -> list[str]:
    """Return the sentences of a document, or of the docstrings, comments and messages of a program."""
    return [
        " ".join(sentence.split())
        for text in _texts(path)
        for sentence in re.split(r"(?<=[.;:!?])\s+|\n\s*\n", text)
        if len(sentence.split()) >= _MIN_WORDS
    ]


def markers(sentence: str) -> list[str]:
    """Return the names of the markers that a sentence carries."""
    return [name for name, pattern in MARKERS.items() if pattern.search(sentence)]


def _texts(path: Path) -> Iterator[str]:
    source = path.read_text("utf-8")
    if path.suffix == ".py":
        yield from _python_texts(source)
    elif path.suffix == ".md":
        text = re.sub(r"```.*?```|`[^`]*`", " code ", source, flags=re.DOTALL)
        yield re.sub(r"^ {4}.*$", " code ", text, flags=re.MULTILINE)
    else:
        comment = _COMMENTS[path.suffix]
        block: list[str] = []
        for line in source.splitlines():
            found = comment.search(line)
            if found:
                block.append(next((group for group in found.groups() if group), ""))
            elif block:
                yield "\n".join(block)
                block = []
        yield "\n".join(block)


def _python_texts(source: str) -> Iterator[str]:
    """Docstrings, comments (lines that follow each other are one text) and string constants with several words."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(v.value) if isinstance(v, ast.Constant) else "X" for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
    block: list[str] = []
    row, counted, end = 0, 1, 0
    for found in _STRING_OR_COMMENT.finditer(source):
        if found[1] is not None:
            counted += source.count("\n", end, found.start())
            end = found.start()
            if counted != row + 1:
                yield "\n".join(block)
                block = []
            row = counted
            block.append(found[1].lstrip("# "))
    yield "\n".join(block)


def main(paths: list[str]) -> None:
    """List each sentence with a marker, and the share of such sentences."""
    total = marked = 0
    for folder in map(Path, paths):
        for path in [folder] if folder.is_file() else sorted(p for p in folder.rglob("*") if p.suffix in SUFFIXES):
            for sentence in sentences(path):
                total += 1
                if found := markers(sentence):
                    marked += 1
                    print(f"{path}: {sentence[:160]} ({', '.join(found)})")
    print(f"{marked} of {total} sentences have a marker: {100 * marked / max(total, 1):.1f} %")


if __name__ == "__main__":
    main(sys.argv[1:])
