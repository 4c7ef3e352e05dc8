"""Values as JSON and as Tcl: written values are read back unchanged, and so are words in Tcl."""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosafe import interface
from rosafe.web.genomix import formats
from rosafe.web.genomix.formats import JSON, TCL

READER = r"""
fconfigure stdin -encoding utf-8
fconfigure stdout -encoding utf-8
proc hex {text} {binary encode hex [encoding convertto utf-8 $text]}
while {[gets stdin line] >= 0} {
    set text [encoding convertfrom utf-8 [binary decode hex $line]]
    puts [lmap word $text {string cat x [hex $word]}]
    flush stdout
}
"""


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Return a function that splits a list with Tcl."""
    script = tmp_path_factory.mktemp("tcl") / "reader.tcl"
    script.write_text(READER)
    with subprocess.Popen(
        ["tclsh", str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None

        def words(text: str) -> list[str]:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(text.encode().hex() + "\n")
            return [bytes.fromhex(word[1:]).decode() for word in process.stdout.readline().split()]

        yield words
        process.stdin.close()


# Tcl 8.6 holds no characters beyond the basic plane.
texts = st.text(st.characters(max_codepoint=0xFFFF, blacklist_categories=["Cs"]))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(texts, max_size=8))
def test_tcl_reads_words_as_they_were(split: Any, words: list[str]) -> None:
    assert split(" ".join(map(formats.tcl_word, words))) == words


@pytest.mark.parametrize(
    "word", ["", "{", "}", "a b", "\\", "$x", "[exit]", '"', "#", "a\nb", "{a", "a}", ";", "\x00", "é\\"]
)
def test_tcl_reads_awkward_words_as_they_were(split: Any, word: str) -> None:
    text = formats.tcl_word(word)
    assert split(f"{text} next") == [word, "next"]
    assert "\n" not in text


def text_of(form: formats.Syntax, idl: str, value: Any) -> str:
    return "".join(form.pieces(interface.ROSAFE, idl, value))


bits = st.binary(min_size=8, max_size=8).map(lambda raw: float(np.frombuffer(raw, "<f8")[0]))


@given(st.lists(st.one_of(bits, st.floats(), st.integers(-5, 5).map(float)), max_size=30))
def test_numbers_come_back_the_same_in_json(numbers: list[float]) -> None:
    text = text_of(JSON, "sequence<double>", np.array(numbers, float))
    back = json.loads(text)
    assert len(back) == len(numbers)
    for number, read in zip(numbers, back, strict=True):
        if math.isfinite(number):
            assert np.float64(read).tobytes() == np.float64(number).tobytes()
        else:
            assert read is None


@pytest.mark.parametrize("length", [0, 1, formats.STEP - 1, formats.STEP, formats.STEP + 1, 5 * formats.STEP + 7])
def test_long_arrays_come_back_the_same(split: Any, length: int) -> None:
    numbers = np.random.default_rng(length).standard_normal(length)
    assert json.loads(text_of(JSON, "sequence<double>", numbers)) == numbers.tolist()
    (word,) = split(text_of(TCL, "sequence<double>", numbers)) or [""]
    words = split(word)
    assert words[0::2] == [str(i) for i in range(length)]
    assert [float(w) for w in words[1::2]] == numbers.tolist()


def test_non_finite_numbers_are_null_but_nan_is_nan_in_tcl() -> None:
    values = np.array([1.5, math.nan, math.inf, -math.inf])
    assert text_of(JSON, "sequence<double>", values) == "[1.5,null,null,null]"
    assert text_of(TCL, "sequence<double>", values) == "{0 1.5 1 NaN 2 null 3 null}"
    assert text_of(JSON, "double", math.nan) == "null"
    assert text_of(TCL, "double", math.nan) == "NaN"
    assert TCL.plain({"a": math.nan, "b": None}) == "{a NaN b null}"


def test_signals_are_nested_as_in_the_messages() -> None:
    value = np.arange(12.0).reshape(2, 3, 2)
    text = text_of(JSON, "::rosAFE::signalNxND", value)
    rows = [[entry["data"] for entry in lag["dataN"]] for lag in json.loads(text)["dataNxN"]]
    assert rows == value.tolist()
    text = text_of(TCL, "::rosAFE::signalND", value[0])
    assert text == "{dataN {0 {data {0 0.0 1 1.0}} 1 {data {0 2.0 1 3.0}} 2 {data {0 4.0 1 5.0}}}}"


def test_scalars() -> None:
    assert text_of(JSON, "boolean", True) == "1"
    assert text_of(JSON, "unsigned long long", 2**64 - 1) == "18446744073709551615"
    assert text_of(JSON, "float", np.float32(0.1).item()) == "0.100000001"
    assert text_of(JSON, "double", 0.1) == "0.1"
    assert text_of(JSON, "string", 'a"b\\\n') == '"a\\"b\\\\\\n"'


def test_empty_signals() -> None:
    assert text_of(JSON, "::rosAFE::signalND", np.zeros((0, 0))) == '{"dataN":[]}'
    assert text_of(TCL, "::rosAFE::signalND", []) == "{dataN {}}"
