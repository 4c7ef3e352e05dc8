"""Scripts in the folder of the original's examples, whose functions are first on the path."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.matlab import octave
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

# The files of the original's folder: acquireAudio returns nothing, and initRosAFE adds the MATLAB Auditory Front-End
# at the front of the path.
FUNCTIONS = {
    "initRosAFE": """
        function [bass, rosAFE, client] = initRosAFE(openRobotsMatlabPath, twoEarsPath, rosAFEPath)
        addpath(genpath(fullfile(pwd, 'AuditoryFrontEnd')));
        startTwoEars;
        startAuditoryFrontEnd;
        startRosAFE;
        client = genomix.client;
        bass = client.load('bass');
        rosAFE = client.load('rosAFE');
        end
    """,
    "acquireAudio": """
        function acquireAudio(bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice)
        error('folder:called', 'acquireAudio of the folder was called');
        end
    """,
    "stopAndKill": "function stopAndKill(bass, rosAFE, client)\nerror('folder:called', 'stopAndKill');\nend\n",
    "adaptTFS": "function adaptTFS(varargin)\nerror('folder:called', 'adaptTFS of the folder was called');\nend\n",
    "verifyParameters": "function verifyParameters(varargin)\nerror('folder:called', 'verifyParameters');\nend\n",
}
# The constructors of the MATLAB Auditory Front-End have other arguments: a processor instead of a rate.
SIGNALS = ("TimeDomainSignal", "TimeFrequencySignal", "FeatureSignal", "CorrelationSignal", "ModulationSignal")
FRONT_END = """
classdef NAME < handle
    methods
        function obj = NAME(procHandle, bufferSize, channel, data)
            if nargin ~= 4
                error('frontEnd:called', 'NAME of the MATLAB Auditory Front-End was constructed');
            end
        end
    end
end
"""


def _lines(text: str) -> str:
    return "\n".join(line.strip() for line in text.strip().splitlines()) + "\n"


@pytest.mark.exploration
@pytest.mark.parametrize("front_end", [False, True], ids=["alone", "MATLAB front-end first"])
def test_a_client_script_in_the_original_folder(world: World, tmp_path: Path, front_end: bool) -> None:
    for name, text in FUNCTIONS.items():
        (tmp_path / f"{name}.m").write_text(_lines(text), "utf-8")
    folder = tmp_path / "AuditoryFrontEnd"
    folder.mkdir()
    (folder / "startAuditoryFrontEnd.m").write_text("function startAuditoryFrontEnd()\nend\n", "utf-8")
    if front_end:
        for name in SIGNALS:
            (folder / f"{name}.m").write_text(FRONT_END.replace("NAME", name).lstrip(), "utf-8")
    # startRosAFE, which initRosAFE calls last, moves our folder to the front of the path
    first = "initRosAFE( );" + (" addpath(fullfile(pwd, 'AuditoryFrontEnd'));" if front_end else "")
    shown = octave.run_and_parse(
        world, octave.script("client_in_the_original_folder").replace("initRosAFE( );", first), folder=tmp_path
    )
    assert shown["columns"] == [31, 3]
    assert shown["class"] == ("rosafe.FeatureSignal" if front_end else "FeatureSignal")
    assert shown["left"] == 0


@pytest.mark.exploration
def test_functions_that_start_two_ears(world: World, tmp_path: Path) -> None:
    folder = tmp_path / "TwoEars"
    folder.mkdir()
    for name in ("startTwoEars", "startAuditoryFrontEnd"):
        text = (
            f"function {name}(varargin)\nif isequal(varargin, {{'missing.xml'}}), error('two:ears', 'no file'); end\n"
            f"show('{name}_', varargin);\nend\n"
        )
        (folder / f"{name}.m").write_text(text, "utf-8")
    output = octave.run(world, octave.script("starts_of_two_ears"), folder=tmp_path)
    assert [line for line in output.splitlines() if "_=" in line] == [
        "startTwoEars_=[]",
        'startTwoEars_=["Config.xml"]',
        'startAuditoryFrontEnd_=["all"]',
    ]
    shown = octave.values(output)
    assert shown["unchanged"] and shown["still"]
    assert shown["first"].endswith("matlab")
    assert shown["wrong"] == "two:ears no file"
