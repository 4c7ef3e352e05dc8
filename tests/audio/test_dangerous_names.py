"""A device name that would run a command is rejected by each interface that leads to bass, and nothing is run."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from rosafe.ros1.component import serialization
from tests.commands.command import refused, rosafe
from tests.harness import Graph, Process

pytestmark = pytest.mark.ros
ATTACK = "tee:null,'|touch MARK',raw"
WHY = "expected the name of a PCM"


def test_through_the_command(tmp_path: Path) -> None:
    """test_pcmname.py has all names."""
    refused(rosafe("record", "--device", ATTACK, "--seconds", "1", cwd=tmp_path), WHY)
    refused(rosafe("record", "a.wav", "--device", ATTACK, "--seconds", "1", cwd=tmp_path), WHY)
    assert os.listdir(tmp_path) == []


def test_the_reason_is_returned_and_the_acquisition_continues(graph: Graph, bass_node: Process) -> None:
    assert graph.call("/bass/Acquire", device="scene:", sampleRate=8000, nFramesPerChunk=400).genom_success
    answer = graph.call("/bass/Acquire", device=ATTACK)
    error = json.loads(answer.genom_exdetail)
    assert error["ex"] == "::bass::e_device"
    audio = serialization.message_class("bass", "::binaudio::portStruct")
    newest = graph.message("/bass/Audio", audio).lastFrameIndex
    graph.message("/bass/Audio", audio, accept=lambda message: message.lastFrameIndex > newest + 800)
    assert WHY in bass_node.err and bass_node.err.count("tee:null") == 1


def test_almost_correct_names_get_a_hint(graph: Graph, bass_node: Process) -> None:
    listed = "see ListDevices and `arecord -L` for the available devices)"
    for name, hint in {
        "scen:": "; did you mean scene:?",
        "Scene:?seconds=3": "; did you mean scene:?",
        "scene": "; did you mean scene:?",
        "'scene:'": "; did you mean scene:?",
        "File:/tmp/a.wav": "; did you mean file:?",
        "bags:/tmp/a.bag": "; did you mean bag:?",
        "hw:1.0": listed,
        "no_such_pcm": listed,
    }.items():
        error = json.loads(graph.call("/bass/Acquire", device=name).genom_exdetail)
        assert error["ex"] == "::bass::e_device" and error["what"].endswith(hint), (name, error)
