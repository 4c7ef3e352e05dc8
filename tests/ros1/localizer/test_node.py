"""The topics of the localizer, the end of a sound, and the same numbers as offline."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from rosafe.localization import angles, cues
from rosafe.localization.head import Head
from rosafe.localization.localize import localize
from rosafe.localization.localizer import Localizer as Offline
from rosafe.localization.scene import SceneRenderer
from rosafe.localization.scene_file import read_scene
from rosafe.processing.stream import Stream
from tests import models
from tests.harness import Graph, Process, wait_for
from tests.localization.conftest import KEMAR, RATE, modulated
from tests.localization.test_sofa import Laboratory
from tests.ros1.localizer.session import (
    Localizer,
    acquire,
    present,
    running_localizer,
    scene_file,
)

ONE = (
    "sample_rate: 16000\nsources:\n  - {{name: talker, file: {file}, loop: true, level_db: -25, azimuth: {azimuth}}}\n"
)


@pytest.fixture
def talking(graph: Graph, localizer: Localizer, talker: Path, tmp_path: Path) -> Localizer:
    """Provide a localizer that has found a talker at 40 degrees."""
    acquire(graph, scene_file(tmp_path, ONE.format(file=talker, azimuth=40)))
    localizer.wait_present(40)
    return localizer


def test_topics(graph: Graph, talking: Localizer) -> None:
    from geometry_msgs.msg import PoseArray
    from rosAFE.msg import DirectionPosterior

    with (
        talking.collect() as sources,
        graph.collect("/localizer/poses", PoseArray) as poses,
        graph.collect("/localizer/posterior", DirectionPosterior) as posteriors,
    ):
        wait_for(lambda: all(len(messages) > 20 for messages in (sources, poses, posteriors)))
    stamped = {message.header.stamp.to_nsec(): message for message in poses}
    posterior = {message.header.stamp.to_nsec(): message for message in posteriors}
    common = [message for message in sources if message.header.stamp.to_nsec() in stamped.keys() & posterior.keys()]
    assert len(common) > 10, "the topics have one stamp"
    message = next(message for message in reversed(common) if present(message))
    (source,) = [source for source in message.sources if source.probability > 0.5]
    assert message.header.frame_id == "head" and source.id > 0
    assert abs(np.degrees(source.azimuth) - 40) < 6 and 0 < np.degrees(source.azimuth_std) < 15
    assert abs(source.level - -25) < 6  # at the ears, and with pauses
    assert source.first_seen < source.last_seen <= message.header.stamp
    pose = stamped[message.header.stamp.to_nsec()].poses[0]
    assert math.isclose(2 * math.atan2(pose.orientation.z, pose.orientation.w), source.azimuth, abs_tol=1e-9)
    directions = posterior[message.header.stamp.to_nsec()]
    assert math.isclose(sum(directions.probability), 1, abs_tol=1e-9)
    best = math.degrees(directions.azimuths[int(np.argmax(directions.probability))])
    assert abs(best - 40) <= 10 or abs(best - 140) <= 10  # the sphere is symmetric
    steps = np.diff([message.header.stamp.to_sec() for message in sources])
    assert (steps >= 0).all() and 0.08 < np.median(steps) < 0.15, "10 Hz"


def test_a_head_with_wrong_labels(graph: Graph, tmp_path: Path) -> None:
    """One warning in the log, and none with ~mirror."""
    laboratory = Laboratory()
    laboratory.variables["ReceiverPosition"] = laboratory.variables["ReceiverPosition"][::-1]
    path = str(laboratory.write(tmp_path / "mirrored.sofa"))
    for mirror, count in ((None, 1), (True, 0)):
        if mirror is not None:
            graph.run("rosparam", "set", "/labels/mirror", str(mirror).lower())
        with running_localizer(graph, "--head", path, name="labels") as labels:
            assert labels.process.err.count("the ears are exchanged") == count, labels.process.err
    graph.run("rosparam", "delete", "/labels")


def test_tools_understand_the_messages(graph: Graph, talking: Localizer, tmp_path: Path) -> None:
    shown = graph.run("rostopic", "echo", "-n", "1", "/localizer/sources").stdout
    assert 'frame_id: "head"' in shown and "sources:" in shown
    assert "geometry_msgs/PoseArray" in graph.run("rostopic", "type", "/localizer/poses").stdout
    bag = tmp_path / "found.bag"
    topics = [f"/localizer/{topic}" for topic in ("sources", "poses", "posterior")]
    graph.run("rosbag", "record", "-l", "5", "-O", str(bag), *topics)
    recorded = graph.run("rosbag", "info", "-y", str(bag)).stdout
    assert all(topic in recorded for topic in topics) and "messages: 15" in recorded


def test_the_end_of_the_sound(graph: Graph, localizer: Localizer, talker: Path, tmp_path: Path) -> None:
    """One second after the last sound no source is present: in silence, and without further blocks."""
    scene = ONE.format(file=talker, azimuth=-50).replace("azimuth", "end: 3, azimuth")
    with localizer.collect() as messages:
        acquire(graph, scene_file(tmp_path, scene))
        localizer.wait_present(-50)
        first = next(m for m in messages if any(abs(a + 50) < 10 for a in present(m)))
        localizer.wait_silent()
        last = max(m.header.stamp.to_sec() for m in list(messages) if present(m))
        begin = first.sources[0].first_seen.to_sec()
        assert begin < first.header.stamp.to_sec() and last - begin < 3 + 1.0
        count = len(messages)
        wait_for(lambda: len(messages) > count + 20)  # empty messages continue
        assert not any(present(m) for m in messages[-10:])
        acquire(graph, scene_file(tmp_path, ONE.format(file=talker, azimuth=-50)))
        localizer.wait_present(-50)
        graph.call("/bass/Stop")
        stopped = len(messages)
        localizer.wait_silent()
        state = localizer.state(lambda entries: "waiting for sound" in entries["message"])
        assert state["level"] == "1"
        silent = next(k for k, m in enumerate(messages[stopped:]) if not present(m))
        assert silent <= 12, "10 messages are a second"
    ids = [source.id for message in messages for source in message.sources]
    assert ids == sorted(ids), "ids are not used again"


def _has_played(end: int, frames: list[int]) -> bool:
    """Return whether a second stream, whose index begins again, has passed frame `end`."""
    begun = any(later < earlier for earlier, later in itertools.pairwise(frames))
    return begun and frames[-1] > end


def _frame(message: Any, clock: Any) -> float:
    """Return the frame of the present stream at the time of a message."""
    seconds = message.header.stamp.to_sec() - clock.stamp.to_sec()
    return float(clock.frameIndex + seconds * clock.sampleRate)


@pytest.mark.parametrize(
    ("rate", "block", "created"),
    [
        pytest.param(16000, 1600, False, marks=pytest.mark.exploration),
        (22050, 1105, True),
        (16000, 2048, False),
    ],
)
def test_offline_and_live_agree(
    graph: Graph,
    bass: Process,
    tmp_path_factory: pytest.TempPathFactory,
    tmp_path: Path,
    rate: int,
    block: int,
    created: bool,
) -> None:
    """The posterior of each frame is that of rosafe.Localizer for the same sound.

    If the block is a multiple of the hop, as that of an input that the localizer creates, all frames begin at the same
    samples. Otherwise only the sources are the same. The sound is long, because a localizer that is late
    publishes once for all frames that wait.
    """
    import rosAFE.msg

    model = tmp_path / "sphere.head"
    models.learn(tmp_path_factory, rate, None if rate == RATE else 40.0).save(model)
    silence, sound = np.zeros((20 * block, 2), np.int32), two_talkers(12.0, rate)
    for name, samples in (("silence", silence), ("sound", sound)):
        soundfile.write(tmp_path / f"{name}.wav", samples, rate, subtype="PCM_32")
    options = ("--head", str(model), "--rosafe", "exact")
    with graph.node("rosAFE-ros", "-i", "exact"):
        acquire(graph, f"file:{tmp_path / 'silence.wav'}?loop=1", chunk=block)
        if not created:
            parameters = f"nFramesPerBlock: {block}"
            made = graph.call("/exact/request", representation="input", parameters=parameters, connect="")
            assert made.genom_success, made.genom_exdetail
        with running_localizer(graph, *options, name="exact_localizer") as localizer:
            localizer.log("localizing with")
            localizer.state(lambda entries: entries["level"] == "0" and "localizing" in entries["message"])
            assert localizer.block() == block
            with (
                graph.collect("/exact_localizer/posterior", rosAFE.msg.DirectionPosterior) as live,
                graph.collect("/exact/frameTime", rosAFE.msg.rosAFE_frameTime) as times,
                localizer.collect() as tracked,
            ):
                wait_for(lambda: live and times)
                acquire(graph, f"file:{tmp_path / 'sound.wav'}", chunk=block)
                # The last block is filled up with zeros, so that its index may exceed the length of the sound.
                wait_for(lambda: _has_played(len(sound) - 2 * block, [time.frameIndex for time in times]))
                wait_for(lambda: _frame(tracked[-1], times[-1]) > len(sound) - 3 * block - rate / 5)
    offline = Offline(rate, str(model))
    features = Stream(rate, offline.model.parameters, list(cues.KINDS)).process(np.concatenate((silence, sound)).T)
    # The localizer begins again after the first block of a new stream.
    new = features["itd_time"] > (len(silence) + block) / rate - offline.hop / 2
    features = {name: features[name][..., new] for name in (*cues.KINDS, "itd_time")}
    found = offline.update(features, features["itd_time"])
    clock, hop = times[-1], offline.hop * rate
    compared, certain = [], []
    for message in live:
        end = (_frame(message, clock) + len(silence)) / hop
        nearest = int(np.abs(found["time"] / offline.hop - end).argmin())
        if end > len(silence) / hop + 100 and abs(found["time"][nearest] / offline.hop - end) < 0.2:
            compared.append(np.abs(found["posterior"][nearest] - np.array(message.probability)).max())
            certain.append(found["posterior"][nearest].max())
    if block % round(hop) == 0:
        assert len(compared) >= 20 and min(certain) < 0.9
        assert np.max(compared) < 1e-6, (np.median(compared), np.max(compared))
    near = []
    for message in tracked:
        if not -9 * rate < _frame(message, clock) - len(sound) < 0:
            continue
        at = (_frame(message, clock) + len(silence)) / rate
        sources = [t["azimuth"][int(np.abs(t["time"] - at).argmin())] for t in offline.tracks if t["first_time"] < at]
        near += [min(abs(azimuth - other) for other in sources) < 5 for azimuth in present(message)]
    assert len(near) > 10 and np.mean(near) > 0.9, near


def two_talkers(seconds: float, rate: int) -> np.ndarray:
    """Return talkers at 50 and -30 degrees and some noise as int32, (n, 2)."""
    head = Head.sphere()
    sound = head.render(modulated(seconds, 5, rate), rate, azimuth=50.0) + head.render(
        np.roll(modulated(seconds, 6, rate), rate), rate, azimuth=-30.0
    )
    sound += 3e-3 * np.random.default_rng(1).standard_normal(sound.shape)
    return np.round(sound.T * 2**30).astype(np.int32)


TURNS = [[0, 0], *([2 + 3 * turn, -30 if turn % 2 else 30] for turn in range(30))]  # s, degrees
SCENE = """
sample_rate: 16000
seed: 2
head: {head}
head_yaw: {yaw}
noise: {{snr_db: 25}}
sources:
  - {{name: one, file: {one}, loop: true, level_db: -28, azimuth: 45}}
  - {{name: two, file: {two}, loop: true, level_db: -28, azimuth: -40}}
"""


@pytest.mark.exploration
def test_two_talkers_and_a_turning_head(
    graph: Graph, afe: Process, kemar_model: Path, talker: Path, other_talker: Path, tmp_path: Path
) -> None:
    """The sources agree with the truth of the scene, in coordinates of the world."""
    from bass.msg import SceneTruth

    device = scene_file(tmp_path, SCENE.format(head=KEMAR, one=talker, two=other_talker, yaw=TURNS))
    options = ("--head", str(kemar_model), "--world-frame", "world")
    with (
        running_localizer(graph, *options, name="turning") as localizer,
        localizer.collect() as messages,
        graph.collect("/bass/sceneTruth", SceneTruth) as truths,
    ):
        acquire(graph, device)
        first = localizer.sources(lambda message: bool(present(message))).header.stamp.to_sec()
        begin = first + 3  # certain after a turn of the head
        wait_for(lambda: sum(message.header.stamp.to_sec() > begin for message in messages) > 25)
        wait_for(lambda: messages[-1].header.stamp.to_sec() > first + 10)
        state = localizer.state(lambda entries: True)
    assert {message.header.frame_id for message in messages} == {"world"}
    received = [message for message in messages if begin < message.header.stamp.to_sec()]
    assert len(received) > 25
    time = np.array([truth.stamp.to_sec() for truth in truths])
    at, errors = [], []
    both = 0
    for message in received:
        nearest_truth = int(np.abs(time - message.header.stamp.to_sec()).argmin())
        truth = truths[nearest_truth]
        at.append(truth.frameIndex / RATE)
        found = [_distance(present(message), np.degrees(azimuth + truth.head_yaw)) for azimuth in truth.azimuths]
        errors += [error for error in found if error < 15]
        both += max(found) < 10
    false = np.mean([len(present(message)) > 2 for message in received])
    # The same offline: the talkers pause at the same times.
    scene = read_scene(device.removeprefix("scene:"))
    sound = SceneRenderer(scene).frames(truths[-1].frameIndex)
    tracks = localize(sound, RATE, str(kemar_model), head_yaw=TURNS)["tracks"]
    expected = 0
    for moment in at:
        sources = [
            azimuth
            for track in tracks
            for t, azimuth, probability in zip(track["time"], track["azimuth"], track["probability"], strict=True)
            if abs(t - moment) <= 0.05 and probability > 0.5
        ]
        expected += max(_distance(sources, 45.0), _distance(sources, -40.0)) < 10
    assert both >= expected - 0.1 * len(received), (both, expected, len(received), state)
    assert both > 0.3 * len(received) and np.median(errors) < 4 and false < 0.1, (both, np.median(errors), false)


def _distance(azimuths: list[float], azimuth: float) -> float:
    """Return the distance to the nearest one of several azimuths, 180 if there is none."""
    return min((abs(float(angles.difference(other, azimuth))) for other in azimuths), default=180.0)
