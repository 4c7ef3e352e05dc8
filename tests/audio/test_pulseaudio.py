"""Capture with the real libasound from a PulseAudio server: exact samples, and loss of the server."""

from __future__ import annotations

from typing import Any

import numpy as np
import soundfile

from rosafe.ros1.component import serialization
from tests.audio.pulseaudio import PulseServer
from tests.harness import Graph, Process, wait_for


def is_captured_exactly(pulse: PulseServer, messages: list[Any], samples: np.ndarray, bass: Process) -> bool:
    """Play `noise.wav`, find it in a window of the port, and compare the samples."""
    marker = samples[0, 10000]
    wait_for(lambda: marker not in messages[-1].left, what="the end of an earlier attempt in the window")
    seen = len(messages)
    with pulse.play(pulse.folder / "noise.wav"):
        # The window must contain everything from 10000 frames before the marker to 34100 frames after it.
        found: Any = wait_for(
            lambda: next((m for m in messages[seen:][-3:] if marker in m.left[10000:-36000]), None),
            20,
            lambda: str(bass),
        )
    begin = int(np.flatnonzero(found.left == marker)[-1]) - 10000
    captured = np.stack((found.left, found.right))[:, begin : begin + samples.shape[1]]
    return np.array_equal(captured[:, 3000:], samples[:, 3000:])  # PulseAudio still adapts its mixing at first


def test_samples_are_exact_and_the_device_can_be_unplugged(graph: Graph, pulse: PulseServer) -> None:
    samples = np.random.default_rng(4).integers(-(2**30), 2**30, (2, 44100)).astype(np.int32)
    soundfile.write(pulse.folder / "noise.wav", samples.T, 44100, subtype="PCM_32")
    audio = serialization.message_class("bass", "::binaudio::portStruct")
    with graph.node("bass-ros", **pulse.env) as bass, graph.collect("/bass/Audio", audio) as messages:
        assert graph.call("/bass/Acquire", device="pulse", sampleRate=44100, nChunksOnPort=60).genom_success
        wait_for(lambda: messages and messages[-1].lastFrameIndex > 0, what=lambda: str(bass))
        # On a busy machine PulseAudio itself sometimes drops or repeats samples.
        assert any(is_captured_exactly(pulse, messages, samples, bass) for _ in range(4)), str(bass)

        pulse.kill()
        wait_for(lambda: "gave up after 5 attempts" in bass.err, what=lambda: str(bass))
        assert "the acquisition has ended: pulse: " in bass.err
        assert not graph.call("/bass/Acquire", device="pulse", sampleRate=44100).genom_success
        pulse.start()
        assert graph.call("/bass/Acquire", device="pulse", sampleRate=44100, nChunksOnPort=10).genom_success
        wait_for(lambda: messages[-1].nChunksOnPort == 10 and messages[-1].lastFrameIndex > 0, what=lambda: str(bass))
        assert "ALSA lib" not in bass.err
