"""Pitch and modulations with one request, through every interface: built, read, changed, plotted."""

from __future__ import annotations

import functools
from pathlib import Path

import matplotlib.image
import numpy as np

import rosafe
from rosafe.audio.devices.scene import Scene
from tests.harness import wait_for
from tests.web.genomix.world import World

CHAINS = {
    "pitch": ["time_0", "filterbank_0", "innerhaircell_0", "autocorrelation_0", "pitch_0"],
    "amsFeatures": ["time_0", "filterbank_0", "innerhaircell_0", "amsFeatures_0"],
}


def picture(path: Path) -> np.ndarray:
    """Check that a picture is not empty."""
    pixels = matplotlib.image.imread(path)
    assert min(pixels.shape[:2]) > 200 and len(np.unique(pixels.reshape(-1, pixels.shape[-1]), axis=0)) > 50
    return pixels


def test_at_a_shell(world: World, tmp_path: Path) -> None:
    def run(*words: str) -> str:
        return world.graph.run(*words).stdout

    def frames(kind: str, name: str) -> int:
        return int(world.http.call(f"rosAFE/{kind}Port/{name}")[f"{kind}Port"]["lastFrameIndex"])

    run("rosservice", "call", "/bass/Acquire", "{device: 'scene:', sampleRate: 8000}")
    for kind, chain in CHAINS.items():
        lines = [line.split() for line in run("rosafe", "request", kind).splitlines()]
        assert [words[1] for words in lines][1:] == chain
        name = chain[-1]
        wait_for(functools.partial(frames, kind, name))
        answer = run("rosservice", "call", "/rosAFE/getRepresentation", f"{{name: {name}}}")
        assert "genom_success: True" in answer and "lastFrameIndex" in answer
    change = "{nameProc: pitch_0, nameParam: pi_confThres, newValue: '0.5'}"
    assert "genom_success: True" in run("rosservice", "call", "/rosAFE/modifyParameter", change)
    assert 'name: "pi_confThres"\n        value: "0.5"' in run("rosservice", "call", "/rosAFE/getProcessors")
    sound = str(tmp_path / "take.wav")
    run("rosafe", "record", sound, "--device", "scene:", "--rate", "8000", "--seconds", "0.5", "--quiet")
    run("rosafe", "plot", sound, "-o", str(tmp_path / "take.png"), "--outputs", "pitch,amsFeatures")
    picture(tmp_path / "take.png")


def test_in_eltclsh(world: World) -> None:
    script = """
        set g [::genomix::connect $address]
        $g load bass; $g load rosAFE
        ::bass::Acquire {device scene: sampleRate 16000}
        show {*}[dict values [dict get [::rosAFE::request pitch] dependencies]]
        show [dict get [::rosAFE::request amsFeatures {ams_nFilters 9}] name]
        while 1 {
            set port [dict get [::rosAFE::amsFeaturesPort amsFeatures_0] amsFeaturesPort]
            if {[dict get $port lastFrameIndex]} break
            after 50
        }
        show [dict size [dict get $port left dataNxN]] [dict size [dict get $port left dataNxN 0 dataN]]
        set part [dict get [::rosAFE::getRepresentation pitch_0] parts 0]
        show {*}[dict values [dict get $part axes]]
        ::rosAFE::modifyParameter {nameProc pitch_0 nameParam pi_confThres newValue 0.5}
        show [catch {::rosAFE::modifyParameter {nameProc pitch_0 nameParam pi_confThres newValue 5}} message]
        show [dict get $message detail what]
    """
    lines = world.lines(script, shell="eltclsh")
    assert lines[0].split("|")[1:] == CHAINS["pitch"]
    assert lines[1] == "amsFeatures_0"
    assert lines[3] == "ear|feature|time"
    assert lines[4] == "1" and lines[5].startswith("pi_confThres: expected a number from 0 to 1, got 5")
    assert lines[2] == "9|31"


def test_in_python(tmp_path: Path) -> None:
    sound, wanted = Scene(16000).frames(8000), ["pitch", "amsFeatures"]
    result = rosafe.process(sound, 16000, block_frames=4000, outputs=wanted)
    change = [(1, "pi_confThres", 0.9)]
    changed = rosafe.process(sound, 16000, block_frames=4000, outputs=wanted, modifications=change)
    voiced, less = (np.isfinite(one["pitch"][:, 0]).sum() for one in (result, changed))
    assert 0 < less < voiced
    assert result["pitch"].shape[:2] == (2, 3) and result["amsFeatures"].ndim == 4
    rosafe.plot(result).savefig(tmp_path / "both.png")
    picture(tmp_path / "both.png")
