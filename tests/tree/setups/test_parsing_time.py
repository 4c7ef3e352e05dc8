"""The time for parsing is bounded, and grows linearly with the length of any text."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable

import pytest

from rosafe.interface import KINDS, MAX_ACTIVITIES, MAX_SETUP
from rosafe.interface.rosafe import MAX_PARAMETERS
from rosafe.tree.setups import SetupError, markup, read, read_parameters

SECONDS = 4.0  # of processor time for a text of maximum length; an idle machine needs less than 1 s
ATTEMPTS = 5


def filled(unit: str, size: int, before: str = "", after: str = "") -> str:
    return before + unit * ((size - len(before) - len(after)) // len(unit)) + after


def numbered(unit: str, size: int, before: str = "", after: str = "") -> str:
    width = len(unit.format(10**6))
    return before + "".join(map(unit.format, range((size - len(before) - len(after)) // width))) + after


def growing(line: str, size: int) -> str:
    """Return lines with increasing indents."""
    lines = (" " * indent + line for indent in range(int((2 * size) ** 0.5) - len(line)))
    return "".join(lines)


WORST: dict[str, Callable[[int], str]] = {
    "tag directives": lambda n: numbered("%TAG !t{}! tag:x\n", n, after="---\na: 1\n"),
    "tag directives behind": lambda n: "a: 1\n...\n" + numbered("%TAG !t{}! tag:x\n", n - 30, after="---\na: 1\n"),
    "nested lists": lambda n: "[" * n,
    "nested maps": lambda n: filled("{a: ", n),
    "nested blocks": lambda n: growing("a:\n", n),
    "question marks": lambda n: filled("?\n", n),
    "pairs in a list": lambda n: filled("a: b,", n, "[", "]"),
    "indents back and forth": lambda n: filled("a:\n a:\n  a:\n   a:\n    a: 1\n", n),
    "many keys": lambda n: numbered("k{}: 1\n", n),
    "a long key": lambda n: "a" * (n - 3) + ": 1",
    "a key of many lines": lambda n: filled("a\n", n, "{", ": 1}"),
    "comments": lambda n: filled("#c\n", n, after="a: 1\n"),
    "breaks": lambda n: "\n" * n,
    "plain lines": lambda n: filled("b\n ", n, "a: ", "b"),
    "folded quotes": lambda n: filled("b\n ", n, 'a: "', '"'),
    "escapes": lambda n: filled("\\u00e9", n, 'a: "', '"'),
    "a literal": lambda n: filled(" b\n", n, "a: |\n"),
    "growing indents of a literal": lambda n: "a: |\n" + growing("\n", n - 9000) + " " * 5000 + "b\n",
    "literals": lambda n: filled("- |9\n\n", n),
    "documents": lambda n: filled("---\n", n),
    "anchors": lambda n: numbered("- &a{} x\n", n),
    "a long list": lambda n: filled("1,", n, "processors:\n  g: {kind: gammatone, fb_cfHz: [", "1]}\n"),
    "words": lambda n: filled("a,", n, "processors:\n  s: {kind: spectralFeatures, sf_requests: [", "a]}\n"),
    "digits": lambda n: filled("9", n, "processors:\n  g: {kind: gammatone, fb_nChannels: ", "}\n"),
    "processors": lambda n: numbered("  p{}: {{kind: ihc}}\n", n, "processors:\n"),
}


def seconds(work: Callable[[str], object], text: str) -> float:
    gc.collect()
    begun = time.thread_time()
    try:
        work(text)
    except SetupError as problem:
        assert "\n" not in str(problem) and len(str(problem)) < 2000
    return time.thread_time() - begun


def takes_less(work: Callable[[str], object], text: str, limit: float) -> bool:
    """Return whether one of several attempts takes less: on a busy machine, caches and cores are shared."""
    return any(seconds(work, text) < limit for _ in range(ATTEMPTS))


@pytest.mark.parametrize("name", WORST)
def test_time_is_linear(name: str) -> None:
    """Eight times the text takes eight times as long, not 64 times. The machine is equally busy for both."""
    part, whole = (WORST[name](2**size) for size in (14, 17))
    gc.disable()  # a collection takes a time for all objects of the process, and happens for `whole` more often
    try:
        assert any(seconds(read, whole) < 32 * max(seconds(read, part), 0.002) for _ in range(ATTEMPTS))
    finally:
        gc.enable()


@pytest.mark.parametrize("name", ["tag directives behind", "indents back and forth", "folded quotes", "processors"])
def test_time_is_bounded(name: str) -> None:
    assert takes_less(read, WORST[name](MAX_SETUP), SECONDS)
    assert takes_less(read_parameters, WORST[name](MAX_PARAMETERS), SECONDS / 8)


def test_values_are_bounded() -> None:
    """A setup can contain as many processors as a node can run, with all their parameters."""
    with pytest.raises(SetupError, match=f"expected at most {markup.MAX_VALUES} values"):
        read(filled("- a\n", MAX_SETUP))
    with pytest.raises(SetupError, match="expected at most"):
        read_parameters(filled("1,", MAX_PARAMETERS, "fb_cfHz: [", "1]"))
    most = (MAX_ACTIVITIES - 1) * len(KINDS)
    many = "".join(f"  p{i}:\n" + "".join(f"    name_{j}: 1\n" for j in range(20)) for i in range(most))
    assert len(markup.parse(f"processors:\n{many}").members("a setup")[0][2].members("processors")) == most


@pytest.mark.parametrize("version", ["%YAML 1.1", "%YAML 1.2", "%YAML  1.2 # the newest", "# first\n%YAML 1.1"])
def test_a_version_is_allowed_once(version: str) -> None:
    assert read(f"{version}\n---\nconnections: {{Audio: a}}\n").connections == {"Audio": "a"}
    with pytest.raises(SetupError, match="expected no directive except one"):
        read(f"{version}\n%YAML 1.1\n---\na: b\n")


@pytest.mark.parametrize("directive", ["%TAG ! tag:x", "%YAML 1.3", "%YAML 2.0", "%YAML", "%foo bar", "%"])
@pytest.mark.parametrize("before", ["", "\ufeff", "# c\n", "\n\r\n", "a: 1\n...\n", "a: 1\r", "a: 1\x85", "a: 1\u2028"])
def test_other_directives_are_rejected(directive: str, before: str) -> None:
    with pytest.raises(SetupError, match="expected no directive except one"):
        read(f"{before}{directive}\n---\nb: 1\n")


def test_a_percent_sign_elsewhere_is_text() -> None:
    assert markup.parse("a: |\n %TAG\n 50%\n").pairs[0][1].text == "%TAG\n50%\n"  # type: ignore[index]
