"""The node with a plain rclpy program: values, services, parameters, setups, start and end."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from rosafe.interface import KINDS
from tests.harness import PATIENCE, ROOT, wait_for

from .client import Client
from .network import Network

RATE = 16000


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds of noise from different sides."""
    path = tmp_path_factory.mktemp("sound") / "noise.wav"
    noise = np.random.default_rng(1).normal(0, 0.05, (4 * RATE, 2))
    soundfile.write(path, np.cumsum(noise, axis=0) * 0.02 + noise, RATE, subtype="PCM_16")
    return path


NODE = ["device", "frame_id", "frames_per_block", "head", "keep", "localize", "representations", "sample_rate", "setup"]
NODE += ["speech_only", "start_type_description_service", "use_sim_time", "world_frame"]
EVERY = [kind.kind for kind in KINDS.values() if kind.parent]
OTHERS = {
    "gammatone.fb_type": "drnl",
    "preProc.pp_bMiddleEarFiltering": True,
    "adaptation.adpt_model": "adt_puschel",
    "amsFeatures.ams_fbType": "lin",
    "ratemap.rm_wname": "blackman",
}


PROCESS = """
import json, sys, numpy, rosafe
folder, options = sys.argv[1:]
rosafe.process(numpy.load(f"{folder}/sound.npy"), **json.loads(options)).save(f"{folder}/result.npz")
"""


@pytest.mark.parametrize(
    ("kinds", "parameters"),
    [
        (EVERY, {"gammatone.fb_nChannels": 5}),
        (["adaptation", "amsFeatures", "moc", "offsetMap"], {"gammatone.fb_nChannels": 4, **OTHERS}),
    ],
    ids=["all", "other-parameters"],
)
def test_each_frame_once_with_the_values_of_process(
    ros2: Network, tmp_path: Path, sound: Path, kinds: list[str], parameters: dict[str, Any]
) -> None:
    """`rosafe.process` has the versions of numpy and scipy that the node has: others may round differently."""
    given = [f"{name}:={str(value).lower()}" for name, value in parameters.items()]
    ros2.node(f"representations:=[{', '.join(kinds)}]", "frames_per_block:=441", *given)
    client = Client(ros2, tmp_path)
    parts = {
        "/".join((KINDS[kind].name, *[part.name][:number])): (kind, number)
        for kind in kinds
        for number, part in enumerate(KINDS[kind].parts)
    }
    for topic in parts:
        client.subscribe(topic, reliable=topic != "ild")
    assert client.call("acquire", device=f"file:{sound}") == {"success": True, "message": ""}
    np.save(tmp_path / "sound.npy", soundfile.read(sound, dtype="int32")[0].T)
    values = {name.partition(".")[2]: value for name, value in parameters.items()}
    options = {"sample_rate": RATE, "outputs": kinds, "parameters": values}
    process = ros2.python(PROCESS, str(tmp_path), json.dumps(options), PYTHONPATH=f"{ros2.env['PYTHONPATH']}:{ROOT}")
    assert process.wait() == 0, process
    expected = np.load(tmp_path / "result.npz")
    assert {one["name"] for one in client.call("get_tree")["processors"]} >= {KINDS[kind].name for kind in kinds}
    for topic, (kind, number) in parts.items():
        part = KINDS[kind].parts[number]
        result = expected[f"{kind}_{part.name}" if len(KINDS[kind].parts) > 1 else kind]
        end = 0  # a subscription may be later than the first block, and a busy machine loses messages
        messages: list[Any] = []
        while end < 0.8 * result.shape[-1]:
            messages += client.take(topic)
            end = messages[-1]["first_frame"] + messages[-1]["shape"][-1]
        frames = [(one["first_frame"], np.array(one["data"], np.float64).reshape(one["shape"])) for one in messages]
        for first, found in frames:
            part_of_result = result[..., first : first + found.shape[-1]]  # the last chunk is padded
            assert np.array_equal(found[..., : part_of_result.shape[-1]], part_of_result, equal_nan=True), topic
        ends = [first + found.shape[-1] for first, found in frames]
        assert all(begin >= end for (begin, _), end in zip(frames[1:], ends, strict=False))
        assert sum(found.shape[-1] for _, found in frames) > result.shape[-1] / 3
        assert not any(one["lost_frames"] for one in messages)
        assert messages[0]["axes"] == list(part.axes) and messages[0]["kind"] == kind
        begin = messages[0]["header"]["stamp"]
        assert abs(begin["sec"] - messages[0]["arrived"]) < 60
        for axis in messages[0]["coordinates"]:
            if axis["name"] == "channel":
                assert axis["unit"] == "Hz" and np.array_equal(axis["values"], expected["fb_cfHz"])


def test_errors_have_the_texts_of_ros_1(ros2: Network, tmp_path: Path) -> None:
    ros2.node("device:=scene:", "representations:=[ild]")
    client = Client(ros2, tmp_path)
    client.subscribe("ild")
    client.take("ild")
    assert client.set(
        ild__ild_wSizeSec=-1.0,
        ild__ild_wname="hun",
        ild__ild_hSizeSec="x",
        gammatone__fb_nChannels=True,
        ild__foo=1.0,
        itd__cc_wSizeSec=1.0,
        devise="scene:",
    ) == [
        "ild_wSizeSec: expected a number above 0, at most 60, got -1",
        "ild_wname: expected one of hamming, hanning, hann, blackman, triang, sqrt_win, got 'hun'",
        "ild_hSizeSec: expected a number, got 'x'",
        "fb_nChannels: expected a whole number (unsigned long), got 'true'",
        "processors of kind ild have no 'foo'; they have: ild_wname, ild_wSizeSec, ild_hSizeSec",
        "there is no processor 'itd'; there are: input, preProc, gammatone, ihc, ild",
        f"devise: expected one of {', '.join(NODE)}, or PROCESSOR.PARAMETER, got an unknown name; did you mean device?",
    ]
    assert client.get("ild.ild_wSizeSec") == 0.02
    for service, fields, message in (
        ("request", {"representation": "ild", "name": "sources"}, "name: expected another name than those of the"),
        ("request", {"representation": "ild", "name": "a__b"}, "name: expected a letter, then letters, digits and"),
        ("request", {"representation": "ild", "parameters": "ild_wSizeSec: -1"}, "line 1: parameters: ild_wSizeSec: "),
        ("add_processor", {"kind": "itd"}, "there is no processor 'crosscorrelation'"),
        ("add_processor", {"kind": "ild"}, "'ild' exists already"),
        ("add_processor", {"kind": "ild", "name": "b", "parameters": "rm_wSizeSec: 1"}, "processors of kind ild have"),
        ("remove_processor", {"name": "nobody"}, "there is no processor 'nobody'; there are: input, preProc"),
        ("remove_processor", {"name": "input"}, "'input' is the input, which cannot be removed"),
        ("acquire", {"device": "file:/missing.wav"}, "/missing.wav: No such file or directory"),
        ("acquire", {"device": "scene:", "sample_rate": 48000}, "the tree runs at 44100 Hz, Audio is at 48000 Hz"),
        ("load_setup", {"setup": "x: 1"}, "line 1: a setup: unknown 'x'"),
    ):
        answer = client.call(service, **fields)
        assert not answer["success"] and answer["message"].startswith(message), answer
    assert len(client.call("get_tree")["processors"]) == 5
    client.take("ild", 5)


def test_parameters_follow_the_processors(ros2: Network, tmp_path: Path) -> None:
    ros2.node("device:=scene:", "representations:=[ild]", "ild.ild_wSizeSec:=0.03")
    client = Client(ros2, tmp_path)
    wait_for(lambda: client.get("ild.ild_wSizeSec") == 0.03)
    assert client.set(ild__ild_wSizeSec=1, gammatone__fb_nChannels=8) == ["", ""]
    assert client.get("ild.ild_wSizeSec") == 1.0
    wait_for(lambda: isinstance(client.get("ild.ild_wSizeSec"), float), what="the declared type of a whole number")
    wait_for(lambda: len(client.get("gammatone.fb_cfHz")) == 8)
    client.subscribe("ild")
    wait_for(lambda: client.take("ild")[-1]["shape"][0] == 8)
    assert client.call("request", representation="itd")["processors"][-1] == "itd"
    assert client.get("crosscorrelation.cc_wSizeSec") == 0.02
    assert client.call("remove_processor", name="crosscorrelation")["removed"] == ["itd", "crosscorrelation"]
    assert client.get("crosscorrelation.cc_wSizeSec") is None
    wait_for(lambda: "/rosafe/itd" not in client.ask("topics"))
    assert client.call("stop")["success"] and client.get("ild.ild_wSizeSec") is None
    assert client.call("get_tree")["processors"] == []


def test_setups_are_saved_and_loaded_and_kept(ros2: Network, tmp_path: Path) -> None:
    kept = tmp_path / "kept.yaml"
    node = ros2.node("device:=scene:", "representations:=[ild]", f"keep:={kept}")
    client = Client(ros2, tmp_path)
    assert client.call("request", representation="ild", name="fine", parameters="ild_wSizeSec: 0.01")["success"]
    setup = client.call("save_setup")["setup"]
    tree = client.call("get_tree")
    assert "device: 'scene:'" in setup and "  fine:\n    kind: ild\n" in setup
    assert client.call("stop")["success"]
    assert client.call("load_setup", setup=setup) == {"success": True, "message": ""}
    assert client.call("get_tree") == tree
    client.subscribe("fine")
    client.take("fine")
    began = time.monotonic()
    assert node.stop(signal.SIGTERM) == 0
    assert time.monotonic() - began < PATIENCE
    ros2.node(f"keep:={kept}")
    wait_for(lambda: client.call("get_tree") == tree)
    client.take("fine")


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        (["frames_per_block:=x"], "rosafe: frames_per_block: expected a int, got 'x'"),
        (["frames_per_block:=0"], "rosafe: nFramesPerBlock: expected a number from 1 to"),
        (["device:=scene:", "representations:=[foo]"], "rosafe: representation: expected one of input, time,"),
        (["setup:=/missing.yaml"], "rosafe: [Errno 2] No such file or directory: '/missing.yaml'"),
        (["device:=scene:", "world_frame:=head"], "rosafe: world_frame: expected another frame than head_frame"),
    ],
)
def test_unsuitable_parameters_end_the_start(ros2: Network, parameters: list[str], line: str) -> None:
    node = ros2.node(*parameters)
    assert node.wait() == 1 and node.err.startswith(line), node
