"""Capture through the real libasound from a PulseAudio server: exact samples, and the server killed on the way."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from rosafe.ros import paths, wire
from tests.bass.pulse import PulseServer
from tests.harness import Graph, wait_for


@pytest.fixture
def pulse(tmp_path: Path) -> Iterator[PulseServer]:
    if not (paths.PYPI_DIR / "pyalsaaudio-0.11.0.dist-info").is_dir():
        pytest.skip("pyalsaaudio is not here: scripts/install brings it")
    server = PulseServer(tmp_path)
    server.start()
    yield server
    server.kill()


def test_captured_is_what_was_played_and_the_plug_may_be_pulled(graph: Graph, pulse: PulseServer) -> None:
    samples = np.random.default_rng(4).integers(-(2**30), 2**30, (2, 44100)).astype(np.int32)
    soundfile.write(pulse.folder / "noise.wav", samples.T, 44100, subtype="PCM_32")
    audio = wire.message_class("bass", "::binaudio::portStruct")
    with graph.node("bass-ros", **pulse.env) as bass, graph.collect("/bass/Audio", audio) as messages:
        assert graph.call("/bass/Acquire", device="pulse", sampleRate=44100, nChunksOnPort=60).genom_success
        wait_for(lambda: messages and messages[-1].lastFrameIndex > 0, 20, lambda: str(bass))
        with pulse.play(pulse.folder / "noise.wav"):
            # The first 40 ms are not exact: PulseAudio rewinds what it had mixed before.
            marker = samples[0, 10000]
            heard: Any = wait_for(
                lambda: next((m for m in messages[-3:] if marker in m.left[:-36000]), None), 20, lambda: str(bass)
            )
        begin = int(np.flatnonzero(heard.left == marker)[0]) - 10000
        assert np.array_equal(heard.left[begin + 3000 : begin + 44100], samples[0, 3000:])
        assert np.array_equal(heard.right[begin + 3000 : begin + 44100], samples[1, 3000:])

        pulse.kill()
        wait_for(lambda: "given up after 5 attempts" in bass.err, 20, lambda: str(bass))
        assert "the acquisition has ended: pulse: " in bass.err
        assert not graph.call("/bass/Acquire", device="pulse", sampleRate=44100).genom_success
        pulse.start()
        assert graph.call("/bass/Acquire", device="pulse", sampleRate=44100, nChunksOnPort=10).genom_success
        wait_for(lambda: messages[-1].nChunksOnPort == 10 and messages[-1].lastFrameIndex > 0, 20, lambda: str(bass))
        assert "ALSA lib" not in bass.err
