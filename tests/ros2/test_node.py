"""The node with a plain rclpy program: values, services, parameters, setups, start and end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

import rosafe
from rosafe.interface import KINDS

from .client import Client, joined
from .network import Network

RATE = 16000


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds of noise from different sides."""
    path = tmp_path_factory.mktemp("sound") / "noise.wav"
    noise = np.random.default_rng(1).normal(0, 0.05, (6 * RATE, 2))
    soundfile.write(path, np.cumsum(noise, axis=0) * 0.02 + noise, RATE, subtype="PCM_16")
    return path


PARTS = {"precedence": "precedence_itd", "precedence/ild": "precedence_ild"}  # the results of `rosafe.process`


def test_each_frame_once_with_the_values_of_process(ros2: Network, tmp_path: Path, sound: Path) -> None:
    kinds = ["ild", "precedence", "itd", "onsetMap", "gabor", "pitch", "preProc", "spectralFeatures", "amsFeatures"]
    ros2.node(f"representations:=[{', '.join(kinds)}]", "frames_per_block:=441")
    client = Client(ros2, tmp_path)
    topics = [*kinds, "precedence/ild"]
    for topic in topics:
        client.subscribe(topic, reliable=topic != "ild")
    assert client.call("acquire", device=f"file:{sound}") == {"success": True, "message": ""}
    expected = rosafe.process(soundfile.read(sound)[0].T, RATE, outputs=kinds)
    assert len(client.call("get_tree")["processors"]) == 13
    for topic in topics:
        result = expected[PARTS.get(topic, topic)]
        messages: list[Any] = client.take(topic)
        while messages[-1]["first_frame"] + messages[-1]["shape"][-1] < result.shape[-1]:
            messages += client.take(topic)  # the last chunk is padded
        found, first = joined(messages), messages[0]["first_frame"]  # a subscription may be later than the first block
        assert first < result.shape[-1] / 2
        assert np.array_equal(found[..., : result.shape[-1] - first], result[..., first:], equal_nan=True)
        kind = KINDS[topic.partition("/")[0]]
        assert messages[0]["axes"] == list(kind.parts["/" in topic].axes) and messages[0]["kind"] == kind.kind
        begin = messages[0]["header"]["stamp"]
        assert abs(begin["sec"] - messages[0]["arrived"]) < 60
        for axis in messages[0]["coordinates"]:
            if axis["name"] == "channel":
                assert axis["unit"] == "Hz" and np.array_equal(axis["values"], expected["fb_cfHz"])
