"""The packed format: decoded values are those that were encoded, in Python and Octave, and invalid data are errors.

Octave reports each invalid answer immediately, whatever sizes it contains.
"""

from __future__ import annotations

import http.client
import json
import math
import shutil
import struct
from pathlib import Path
from typing import Any

import genomix
import numpy as np
import pytest
from genomix import packed
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosafe import interface
from rosafe.web.genomix import formats
from rosafe.web.genomix.formats import PACKED
from tests.harness import PATIENCE, ROOT, proc, run_program
from tests.matlab.octave import script
from tests.web.genomix.world import World

SPECTRUM = "::rosAFE::TimeFrequencySignalPortStruct"


read = packed.decode


leaves = st.one_of(st.floats(allow_nan=False), st.booleans(), st.text(st.characters(blacklist_categories=["Cs"])))
values = st.recursive(leaves, lambda inner: st.lists(inner) | st.dictionaries(st.text("ab_:"), inner), max_leaves=20)


def same(found: Any, value: Any) -> bool:
    """Return whether values are equal: sequences of numbers are arrays, booleans are numbers."""
    if isinstance(value, dict):
        return list(found) == list(value) and all(same(found[k], v) for k, v in value.items())
    if isinstance(value, list):
        return len(found) == len(value) and all(map(same, found, value))
    return bool(found == value)


@settings(max_examples=20, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(values)
def test_plain_values_read_back(value: Any) -> None:
    assert same(read(PACKED.plain(value)), value)


@settings(max_examples=30, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.lists(st.floats(allow_nan=False), max_size=4), max_size=4), st.booleans())
def test_signals_read_back(channels: list[list[float]], alike: bool) -> None:
    """One array if all channels have the same number of frames, otherwise nested structures."""
    if alike:
        channels = [(channel + [0.0] * 4)[:3] for channel in channels]
    arrays = [np.array(channel) for channel in channels]
    port = {"sampleRate": 1, "lastFrameIndex": 2**53, "framesOnPort": 3, "numberOfChannels": 4, "left": arrays}
    data = b"".join(PACKED.pieces(interface.ROSAFE, SPECTRUM, {**port, "right": []}))
    found = read(data)
    assert list(found) == [name for name, _ in interface.ROSAFE.structs[SPECTRUM]]
    assert found["lastFrameIndex"] == 2**53
    assert [one["data"] for one in found["left"]["dataN"]] == channels
    one_array = len({len(channel) for channel in channels}) <= 1
    assert data.count(formats.SIGNAL + struct.pack("<I", 2)) == 1 + one_array  # otherwise nested structures
    assert found["right"] == {"dataN": []}


def test_special_numbers_and_texts() -> None:
    assert math.isnan(read(PACKED.plain(None)))
    assert math.isnan(read(PACKED.plain(math.nan)))
    assert read(PACKED.plain([math.inf, 1])) == [math.inf, 1]
    assert read(PACKED.plain("\ud800")) == "\\ud800"
    with pytest.raises(genomix.GenoMError) as caught:
        read(PACKED.error({"ex": "::genom::syserr", "detail": {"code": 11}}))
    assert (caught.value.ex, caught.value.detail) == ("::genom::syserr", {"code": 11})
    huge = 10**4000  # a component's error may hold any number that JSON has
    assert PACKED.plain([huge, -huge, 1]) == PACKED.plain([math.inf, -math.inf, 1])
    assert PACKED.plain(huge) == PACKED.plain(math.inf)


def octave(folder: Path, text: str) -> list[str]:
    """Run a script in `folder` and return the lines that it prints."""
    if shutil.which("octave-cli") is None:
        pytest.skip("octave-cli is not installed; scripts/install --tests brings it")
    (folder / "check.m").write_text(f"1;\n{text}", "utf-8")
    done = run_program(
        ["timeout", "150", "octave-cli", "--norc", "--quiet", "--no-history", "check.m"],
        cwd=folder,
        env={"PATH": "/usr/bin:/bin", "HOME": str(folder), "OCTAVE_PATH": str(ROOT / "matlab"), "LANG": "C.UTF-8"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.splitlines()


def test_octave_reads_the_same(tmp_path: Path) -> None:
    """The decoder of matlab/ returns cells, or matrices on request."""
    lags = [[np.arange(3.0) + 10 * channel + 100 * lag for channel in range(2)] for lag in range(4)]
    correlation = b"".join(PACKED.pieces(interface.ROSAFE, "::rosAFE::signalNxND", lags))
    documents = {
        "plain": PACKED.plain({"a": [1, 2.5, math.nan], "b": ["x", "äß€", ""], "c": [], "d": {"::e": True}, "e": []}),
        "lags": correlation,
        "ragged": b"".join(PACKED.pieces(interface.ROSAFE, "::rosAFE::signalND", [np.ones(2), np.zeros(3)])),
        "error": PACKED.error({"ex": "x"}),
        "empty": b"".join(PACKED.pieces(interface.ROSAFE, "::rosAFE::signalNxND", [[np.empty(0), np.empty(0)]])),
    }
    for name, data in documents.items():
        (tmp_path / name).write_bytes(data)
    sent, text, quoted, refused = octave(tmp_path, script("packed_values"))
    wanted = [1, -0.1, 1 / 3, 1, 7, 'a"\\', [], [], [1, ["x"]], [1, 3, 2, 4], {"a": []}]
    *most, nan, infinite, large = json.loads(sent)
    assert most == wanted and math.isnan(nan) and infinite == -math.inf and large == 1e300
    assert json.loads(text) == "a\tb\nc"
    assert quoted == "%C3%A4%20b%26c%2Fd%25_-.~"
    assert refused == "genomix:argument"


@pytest.mark.ros
def test_the_server_answers_packed(world: World) -> None:
    """The same as in JSON; errors with HTTP status 200, marked."""

    def get(url: str) -> Any:
        connection = http.client.HTTPConnection("127.0.0.1", world.port, timeout=PATIENCE)
        connection.request("GET", url)
        response = connection.getresponse()
        assert response.status == 200
        assert response.getheader("Content-Type") == "application/octet-stream"
        return read(response.read())

    about = get("/load/rosAFE?syntax=packed&s=p")
    wanted = world.http.get("/load/rosAFE")
    assert list(about["services"]) == list(wanted["services"]) and about["doc"] == wanted["doc"]
    with pytest.raises(
        genomix.GenoMError, match="::rosAFE::e_noSuchProcessor: there is no processor 'x'; there are: none"
    ):
        get("/call/rosAFE/removeProcessor?syntax=packed&input=[%22x%22]")
    with pytest.raises(genomix.GenoMError, match="::genomix::e_url"):
        get("/nowhere?syntax=packed")
    world.http.call("bass/Acquire", ["scene:"])
    sent = get("/send/rosAFE/getParameters?syntax=packed&s=p&ack=1")
    assert get(f"/request/wait?syntax=packed&s=p&id={sent['id']}")["output"]["parameters"]["ild"] == []
    world.http.call("bass/Stop")
    audio, as_json = get("/call/bass/Audio?syntax=packed")["Audio"], world.http.call("bass/Audio")["Audio"]
    assert audio["left"] == as_json["left"] and len(as_json["left"]) == 44100
    assert audio["stamp"] == as_json["stamp"]


# --- invalid answers ---------------------------------------------------------------------------------------------


def signal(*levels: tuple[str, int], data: bytes = b"") -> bytes:
    """A signal that claims these levels."""
    sizes = b"".join(formats.packed_text(name) + struct.pack("<I", size) for name, size in levels)
    return formats.SIGNAL + struct.pack("<I", len(levels)) + sizes + data


def documents() -> list[bytes]:
    """Answers of all kinds."""
    lags = [[np.arange(3.0) + 10 * channel for channel in range(2)] for _ in range(4)]
    port = {
        "sampleRate": 1,
        "lastFrameIndex": 2,
        "framesOnPort": 3,
        "numberOfChannels": 2,
        "left": lags[0],
        "right": [],
    }
    return [
        PACKED.plain({"a": [1, 2.5], "b": ["x", "ä€", ""], "c": [], "d": {"::e": True}, "e": {"f": {"g": None}}}),
        PACKED.error({"ex": "::genom::mwerr", "detail": {"what": "no answer"}}),
        b"".join(PACKED.pieces(interface.ROSAFE, "::rosAFE::signalNxND", lags)),
        b"".join(PACKED.pieces(interface.ROSAFE, "::rosAFE::signalND", [np.ones(2), np.zeros(3)])),
        b"".join(PACKED.pieces(interface.ROSAFE, SPECTRUM, port)),
    ]


CRAFTED = [
    # 52 bytes that asked for 4 billion cells
    signal(("dataNxN", 2**32 - 1), ("dataN", 1), ("data", 0)),
    signal(("dataNxN", 0), ("dataN", 2**32 - 1), ("data", 2**32 - 1)),
    signal(("dataN", 2**31), ("data", 2**31), data=bytes(8)),
    signal(("dataN", 2**32 - 1), ("data", 0)),
    signal(("data", 2**32 - 1)),
    signal(*[("a", 1000)] * 7, ("b", 0)),
    signal(*[("a", 0)] * 9),
    signal(),
    signal(("not a name", 1), data=bytes(8)),
    signal(("", 1), data=bytes(8)),
    formats.SIGNAL + struct.pack("<I", 2**32 - 1),
    formats.NUMBERS + struct.pack("<I", 2**32 - 1) + bytes(16),
    formats.NUMBERS + struct.pack("<I", 2**29) + bytes(16),
    formats.TEXT + struct.pack("<I", 2**32 - 1) + b"abc",
    formats.TEXT + struct.pack("<I", 3) + b"\xff\xfe\xed",
    formats.STRUCTURE + b"d" + bytes(8) + formats.END,
    formats.STRUCTURE + PACKED.string("a"),
    formats.STRUCTURE,
    formats.SEQUENCE,
    formats.SEQUENCE * 1_000,
    formats.STRUCTURE + PACKED.string("a") + (formats.STRUCTURE + PACKED.string("a")) * 1_000,
    formats.SEQUENCE + (formats.STRUCTURE + formats.END) * 20_100 + formats.END,
    formats.STRUCTURE + b"".join(PACKED.string(f"a{i}") + PACKED.plain(1) for i in range(20_100)) + formats.END,
    formats.ERROR,
    formats.ERROR + PACKED.plain(1),
    formats.ERROR + PACKED.plain({"what": "x"}),
    formats.ERROR + PACKED.plain({"ex": 7}),
    formats.ERROR * 3,
    PACKED.plain({"a": 1}) + b"x",
    b"x",
    b"\0" * 100,
    b"HTTP/1.1 200 OK\r\n\r\n",
    b"<html><body>no</body></html>",
]
GOOD = [signal(("dataN", 31), ("data", 0)), signal(("dataNxN", 1000), ("dataN", 1000), ("data", 0)), *documents()]


@pytest.mark.parametrize(
    ("answers", "expected"),
    [(CRAFTED, {"genomix:connection"}), (GOOD, {"good"})],
    ids=["crafted", "good"],
)
def test_answers(tmp_path: Path, answers: list[bytes], expected: set[str]) -> None:
    """Each, as cells and as matrices, has the expected result, quickly and without much memory."""
    proc("self", "status")  # the script reads it
    with (tmp_path / "documents").open("wb") as out:
        for number, answer in enumerate(answers):
            out.write(struct.pack("<II", len(answer), 1 + number % 2) + answer)
    *lines, last = octave(tmp_path, script("packed_answers"))
    seconds, kilobytes = map(float, last.split())
    assert len(lines) == 2 * len(answers)
    for number, line in enumerate(lines):
        assert line in expected, (line, answers[number // 2][:200])
    assert seconds < 20  # of processor time
    assert kilobytes < 500 * 1024
