"""The streams of sources and their probability of speech, on real nodes: samples compared with the truth and offline."""

from __future__ import annotations

import importlib
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal
import soundfile

import rosafe
from rosafe.localization.head import Head
from tests.harness import Graph, wait_for
from tests.localization.sounds import music
from tests.localization.test_enhancement import RECORDINGS, si_sdr
from tests.ros1.localizer.conftest import RATE
from tests.ros1.localizer.session import Localizer, acquire, running_localizer

SECONDS = 6.0
TALKER, MUSIC = 30.0, -40.0  # degrees


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Return a recording of a talker and music, and both parts of it (2, 2, N)."""
    paths = sorted(RECORDINGS.glob("*_*.wav"))
    if not paths:
        pytest.skip("Debian's alsa-utils is not installed")
    speech = np.concatenate(
        [scipy.signal.resample_poly(sound, RATE, rate) for sound, rate in map(soundfile.read, paths)]
    )
    speech = np.resize(speech, round(SECONDS * RATE))
    tune = music(SECONDS, 4)
    head = Head.sphere()
    sources = (0.08 * speech / np.std(speech), TALKER), (0.04 * tune / np.std(tune), MUSIC)
    parts = [head.render(dry, RATE, azimuth) for dry, azimuth in sources]
    path = tmp_path_factory.mktemp("take") / "take.wav"
    soundfile.write(path, np.sum(parts, axis=0).T, RATE, subtype="PCM_32")
    return path, np.array(parts)


def joined(messages: list[Any], id_: int) -> np.ndarray:
    """Return the samples of a source, whose parts must follow one another, with the times of their numbers."""
    own = [message for message in messages if message.id == id_]
    for before, after in zip(own, own[1:], strict=False):
        assert after.first_sample == before.first_sample + len(before.samples)
        step = (after.header.stamp - before.header.stamp).to_sec()
        assert abs(step - len(before.samples) / 16000) < 2e-3
    assert {(m.sample_rate, m.header.frame_id) for m in own} == {(16000, "head")}
    return np.concatenate([message.samples for message in own])


def test_streams_are_those_of_the_file(
    graph: Graph, localizer: Localizer, take: tuple[Path, np.ndarray], sphere_model: Path
) -> None:
    audio_class = importlib.import_module("rosAFE.msg").SourceAudio
    sound, rate = soundfile.read(take[0])
    expected = rosafe.localize(sound, rate, str(sphere_model), streams=True)["tracks"]
    print([(t["id"], np.median(t["azimuth"]), len(t["stream"])) for t in expected])
    with graph.collect("/localizer/streams", audio_class) as parts, localizer.collect() as sources:
        acquire(graph, f"file:{take[0]}")
        localizer.wait_present(TALKER)
        wait_for(lambda: parts and parts[-1].header.stamp.to_sec() + 1.5 < time.time(), what="the end of the streams")
        found = {message.id for message in parts}
        truths = {TALKER: take[1][0], MUSIC: take[1][1]}
        for azimuth, truth in truths.items():
            near = [m for m in parts if abs(math.degrees(m.azimuth) - azimuth) < 8]
            stream = joined(list(parts), near[-1].id)
            offline = next(t for t in expected if abs(np.median(t["azimuth"]) - azimuth) < 8)
            print(azimuth, near[-1].id, len(stream), len(offline["stream"]), offline["stream_time"], found)
            np.save(f"/tmp/voice/live{azimuth}.npy", stream)
            np.save(f"/tmp/voice/off{azimuth}.npy", offline["stream"])
        for m in sources[::5]:
            print([(s.id, round(math.degrees(s.azimuth)), round(s.speech, 2)) for s in m.sources])
