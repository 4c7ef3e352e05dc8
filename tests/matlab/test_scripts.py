"""The MATLAB code in the user guide and in the documentation, and a script like the examples of the original."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import pytest

from tests import harness
from tests.matlab import octave
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

DOCUMENT = harness.ROOT / "docs" / "matlab.md"
REQUESTS = ("inputProc", "preProc", "gammatone", "ihc", "ild", "ratemap", "crossCorrelation")


def blocks(document: Path, rate: int = 22050) -> list[str]:
    """Return the blocks of m-code in a document, with a lower sample rate for less computation."""
    found: list[str] = re.findall(r"^```matlab\n(.*?)^```$", document.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    lower = (("'scene:')", f"'scene:', {rate})"), ("44100, 12000", f"{rate}, {rate // 4}"))
    return [functools.reduce(lambda text, pair: text.replace(*pair), lower, block) for block in found]


def test_the_block_of_the_guide(world: World) -> None:
    """The code is unchanged except for the device and its sample rate."""
    guide = harness.shared("spec", "original-user-guide.txt").read_text("utf-8")
    block = guide.partition("\naddpath(genpath(")
    text = block[1] + block[2]
    code = [line for line in text.splitlines() if not re.match(r"[A-Z].*[.:]$|Note$|\w+ \w+ \w+ ", line)]
    script = "\n".join(code).replace("bass.Acquire('-a')", "bass.Acquire('-a', 'scene:', 22050)")
    assert script.count("rosAFE.") == 20
    names = [f"{name}Request" for name in REQUESTS if name != "inputProc"]
    checks = "".join(f"show('{name}', {name}.status)\n" for name in ["inputProcRequest", *names])
    checks += "".join(
        f"show('{name}', {{getfield(fieldnames({name}), {{1}}){{1}}, {name}.(fieldnames({name}){{1}}).sampleRate}})\n"
        for name in ("inputProcOut", "preProcOut", "gammatoneProcOut", "ihcProcOut", "ildProcOut", "ratemapProcOut")
    )
    checks += "show('types', fieldnames(getParameters.result.parameters))\n"
    checks += "show('frames', numel(getSignals.result.signals.ild))\n"
    # without a name, these request a processor that does not exist
    checks += "show('refused', {getDependencies.exception.ex, removeProcessor.exception.ex})\n"
    results = octave.run_and_parse(world, script + "\n" + checks)
    assert {results[name] for name in ["inputProcRequest", *names]} == {"sent"}
    assert results["ratemapProcOut"] == ["ratemapPort", 100]
    assert results["gammatoneProcOut"] == ["gammatonePort", 22050]
    assert results["types"] == ["input", "preProc", "gammatone", "ihc", "ild", "ratemap", "crossCorrelation"]
    assert results["frames"] == 1
    assert results["refused"] == ["::rosAFE::e_noSuchProcessor"] * 2


def test_the_first_block_of_the_document(world: World) -> None:
    results = octave.run_and_parse(world, blocks(DOCUMENT)[0] + "\nshow('cfHz', cfHz); show('rate', rate)")
    assert len(results["cfHz"]) == 31 and results["cfHz"][0] == 80
    assert results["rate"] == 100


def test_the_plot_of_the_document(world: World, tmp_path: Path) -> None:
    octave.require_program("gs")
    octave.require_program("gnuplot")
    script = blocks(DOCUMENT)[1]
    assert len(script.splitlines()) == 10
    for long, short in (("port', 8)", "port', 1)"), ("pause(9)", "pause(1.5)"), ("1:800", "1:100")):
        assert long in script
        script = script.replace(long, short)
    octave.run(world, script, folder=tmp_path)
    assert (tmp_path / "ild.png").read_bytes()[:4] == b"\x89PNG"
    picture = harness.ROOT / "docs" / "ild-octave.png"
    assert 10_000 < picture.stat().st_size < 100_000


def test_the_manager_in_the_document(world: World) -> None:
    script = blocks(DOCUMENT)[2].replace("pause(0.5)", "pause(0.2)")
    results = octave.run_and_parse(world, script + "\nshow('sizes', {size(levels), size(right)})")
    (frames, channels), right = results["sizes"]
    assert channels == 16 and frames > 20 and right[1] == 16
    assert not world.http.call("rosAFE/getParameters")["parameters"]["preProc"]


def test_pitch_and_modulations_in_the_document(world: World) -> None:
    script = blocks(DOCUMENT)[3] + "\n" + octave.script("pitch_and_modulations_of_the_document")
    results = octave.run_and_parse(world, script)
    assert results["kinds"] == [1, True]
    assert results["changed"] == [0.5, [80, 300]]
    assert results["size"] == [31, 9]
    assert results["frames"] == [0, 0, 0, 1]


def test_the_code_in_the_readme(world: World) -> None:
    (block,) = blocks(harness.ROOT / "README.md", rate=16000)
    results = octave.run_and_parse(
        world, block.replace("pause(2)", "pause(0.5)") + "\nshow('size', size(out.ildPort.left))"
    )
    assert results["size"] == [100, 16]


def test_a_script_like_the_examples_reads_ports(shared_world: World) -> None:
    """New frames by lastFrameIndex, `adaptTFS` in its old order, shutdown. It is the last test of the module."""
    results = octave.run_and_parse(shared_world, octave.script("reader"))
    got, left, right, lost = results["frames"]
    assert got == left == right > 0
    assert (got + lost) % 1600 == 0
    assert results["same"] and results["alive"]
    assert results["ratemap"][0] % 10 == 0 and results["ratemap"][1:] == [100, 8, 100, 8, 1]
    assert results["input"] == [16000, 2, 1]
    assert results["audio"] == [1, 16000, 1]
    assert results["status"] == ["done", "done", "done"]
    harness.wait_for(
        lambda: not {"/bass/kill", "/rosAFE/kill"} & shared_world.graph.services(), what="end of the nodes"
    )
