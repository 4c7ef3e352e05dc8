"""All representations in Octave, including a plugin, with names and parameters of the MATLAB Auditory Front-End."""

from __future__ import annotations

import os
import re
import wave
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from rosafe.interface import KINDS
from tests import harness
from tests.matlab import octave
from tests.web.genomix import world as worlds
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

RATE = 8000
DELAY = 3  # of the right ear, samples
PITCH = 200.0  # Hz


@pytest.fixture(scope="module")
def shared_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Start nodes with the plugin of the documentation."""
    octave.require_program()
    folder = tmp_path_factory.mktemp("plugins")
    document = (harness.ROOT / "docs" / "own-representation.md").read_text("utf-8")
    plugin = re.search(r"^```python\n(.*?)^```$", document, re.MULTILINE | re.DOTALL)
    assert plugin is not None
    (folder / "zerocrossings.py").write_text(plugin[1])
    with (
        mock.patch.dict(os.environ, ROSAFE_PLUGINS=str(folder)),
        worlds.world(tmp_path_factory.mktemp("world")) as world,
    ):
        yield world


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    """Write a file with one second of a harmonic tone from the left and one second of silence."""
    t = np.arange(RATE) / RATE
    left = sum(np.cos(2 * np.pi * PITCH * k * t) for k in range(1, 15)) / 20
    ears = np.zeros((2 * RATE, 2))
    ears[:RATE, 0] = left
    ears[DELAY:RATE, 1] = left[:-DELAY]
    path = tmp_path / "tone.wav"
    with wave.open(str(path), "wb") as file:
        file.setparams((2, 2, RATE, 0, "NONE", ""))
        file.writeframes((ears * 20000).astype("<i2").tobytes())
    return path


def begin(sound: Path, port: float = 0.2) -> str:
    """Return the start of a script: a manager for the sound file, with ports of `port` seconds."""
    return f"""
        startRosAFE;
        client = genomix.client;
        bass = client.load('bass');
        rosAFE = client.load('rosAFE');
        dObj = dataObject_RosAFE(bass, rosAFE, 'file:{sound}?loop=1', {RATE}, {RATE // 10}, 1, {port}, 3, 3);
        mObj = manager_RosAFE(dObj);
        below = genParStruct('fb_highFreqHz', 3000);
        par = genParStruct('fb_nChannels', 4, 'fb_highFreqHz', 3000);
    """


CLASSES = {
    ("time",): "TimeDomainSignal",
    ("channel", "time"): "TimeFrequencySignal",
    ("feature", "time"): "FeatureSignal",
    ("channel", "lag", "time"): "CorrelationSignal",
    ("channel", "filter", "time"): "ModulationSignal",
}


@pytest.mark.exploration
def test_all_representations_are_equal_to_their_ports(world: World, sound: Path) -> None:
    results = octave.run_and_parse(world, begin(sound) + octave.script("all_representations"))
    kinds = {kind.word: kind for kind in KINDS.values()}
    assert results["words"] == [*kinds, "zeroCrossings"]
    assert results["counts"] == [1] * (len(kinds) + 1)
    for word, kind in kinds.items():
        label, classes, channels, names = results[f"of {word}"]
        assert label == f"{word}_0"
        expected = []
        for part in kind.parts:
            name = word if len(kind.parts) == 1 else f"{word}_{part.name}"
            rows = tuple(axis for axis in part.axes if axis != "ear")
            for channel in ("left", "right") if "ear" in part.axes else ("mono",):
                expected.append((CLASSES[rows], channel, name))
        assert list(zip(classes, channels, names, strict=True)) == expected, word
        assert results[kind.kind][0] == pytest.approx(0.2, abs=0.01), word
        assert results[kind.kind][1:2] == [{"channel": 4}.get(rows[0], results[kind.kind][1])], word
    assert results["zeroCrossings"][1:] == [4]
    assert results["fList"][0] == ["pitch", "rawPitch", "confidence"]
    assert len(results["fList"][1]) == 14 and results["fList"][1][:2] == ["centroid", "crest"]
    assert results["alike"] and results["lags"] == [1 / RATE, -9 / RATE]
    assert all(results["figures"])
    assert results["clean"] == [1] + [0] * len(kinds)


def test_pitch_and_time_differences_of_a_tone_and_of_silence(world: World, sound: Path) -> None:
    """NaN is NaN in MATLAB and Tcl, and null in JSON."""
    results = octave.run_and_parse(world, begin(sound, port=3) + octave.script("pitch_and_time_differences"))
    assert results["pitch"] == pytest.approx(PITCH, rel=0.01)
    assert results["finite"]
    assert abs(results["itd"]) == pytest.approx(DELAY / RATE, rel=0.1)
    (part,) = world.http.call("rosAFE/getRepresentation", {"name": "pitch_0"})["parts"]
    ears, features, frames = part["shape"]
    assert part["axes"] == ["ear", "feature", "time"] and (ears, features) == (2, 3)
    assert len(part["data"]) == 6 * frames
    over_http = world.http.get("/call/rosAFE/pitchPort/pitch_0")["pitchPort"]["left"]["dataN"][0]["data"]
    assert None in over_http
    assert np.median([value for value in over_http if value]) == pytest.approx(PITCH, rel=0.01)
    (line,) = world.lines("""
        set g [::genomix::connect $address]
        $g load rosAFE
        show {*}[lsort -unique [dict values [dict get [::rosAFE::pitchPort pitch_0] pitchPort left dataN 0 data]]]
    """)
    values = line.split("|")
    assert "NaN" in values and "null" not in values
    assert np.median([float(value) for value in values if float(value) > 0]) == pytest.approx(PITCH, rel=0.01)


@pytest.mark.exploration
def test_names_and_parameters_of_the_matlab_front_end(world: World, sound: Path) -> None:
    results = octave.run_and_parse(world, begin(sound) + octave.script("names_and_parameters"))
    frequencies, modulations, same = results["modulations"]
    assert len(frequencies) == 4 and len(modulations) == 3 and same and modulations[0] == 8
    assert results["precedence"][0] == frequencies and results["precedence"][1] % 2 == 1 and results["precedence"][2]
    assert results["gabor"][0] == int(results["gabor"][1]) > 1
    assert results["changed"] == [["rolloff", "crest", "flux"], [90, 310.5]]
    assert results["none of it"].startswith("manager_RosAFE:refused Error::rosAFE::e_badNewValue: pi_rangeHz")
    assert "fb_nERB" in results["not there"]
    assert "e_badNewValue: sf_requests" in results["bad word"]
    assert results["no type"].startswith("manager_RosAFE:type type: expected one of input, ")
    assert "spikes" in results["no name"] and results["read only"]


def test_plots_of_features(world: World) -> None:
    """The pitch is plotted over the raw pitch, in Hz; other features are scaled to their own range."""
    results = octave.run_and_parse(world, octave.script("plots_of_features"))
    on_top, under, times = results["pitch"]
    assert on_top == [None, 120, 125, None] and under == [None, 120, 125, 300]
    assert times == pytest.approx([0, 0.1, 0.2, 0.3]) and results["unit"] == "Hz"
    assert results["confidence"] == [pytest.approx([0.1, 0.9, 0.8, 0.2]), "confidence"]
    assert results["ranges"] == [[0, 1, 0.5], [0, 1, 0.5], [0, 0, 0]]
    assert results["features"] == ["flux", "hfc", "crest"]
