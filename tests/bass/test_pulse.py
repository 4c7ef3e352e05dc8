"""Capture through the real libasound from a PulseAudio server: exact samples, and the server killed on the way."""

from __future__ import annotations

from typing import Any

import numpy as np
import soundfile

from rosafe.component import serialization
from tests.bass.pulse import PulseServer
from tests.harness import Graph, Process, wait_for


def played_as_captured(pulse: PulseServer, messages: list[Any], samples: np.ndarray, bass: Process) -> bool:
    """Play `noise.wav`, find it in a window of the port, and compare."""
    marker = samples[0, 10000]
    wait_for(lambda: marker not in messages[-1].left, what="the end of an earlier attempt in the window")
    seen = len(messages)
    with pulse.play(pulse.folder / "noise.wav"):
        # Where a window is found, it must hold everything: from 10000 frames before the marker to 34100 after it.
        heard: Any = wait_for(
            lambda: next((m for m in messages[seen:][-3:] if marker in m.left[10000:-36000]), None),
            20,
            lambda: str(bass),
        )
    begin = int(np.flatnonzero(heard.left == marker)[-1]) - 10000
    captured = np.stack((heard.left, heard.right))[:, begin : begin + samples.shape[1]]
    return np.array_equal(captured[:, 3000:], samples[:, 3000:])  # at first, PulseAudio still mixes anew


def test_captured_is_what_was_played_and_the_plug_may_be_pulled(graph: Graph, pulse: PulseServer) -> None:
    samples = np.random.default_rng(4).integers(-(2**30), 2**30, (2, 44100)).astype(np.int32)
    soundfile.write(pulse.folder / "noise.wav", samples.T, 44100, subtype="PCM_32")
    audio = serialization.message_class("bass", "::binaudio::portStruct")
    with graph.node("bass-ros", **pulse.env) as bass, graph.collect("/bass/Audio", audio) as messages:
        assert graph.call("/bass/Acquire", device="pulse", sampleRate=44100, nChunksOnPort=60).genom_success
        wait_for(lambda: messages and messages[-1].lastFrameIndex > 0, what=lambda: str(bass))
        # On a busy machine PulseAudio itself drops or repeats something now and then; not every time.
        assert any(played_as_captured(pulse, messages, samples, bass) for _ in range(4)), str(bass)

        pulse.kill()
        wait_for(lambda: "given up after 5 attempts" in bass.err, what=lambda: str(bass))
        assert "the acquisition has ended: pulse: " in bass.err
        assert not graph.call("/bass/Acquire", device="pulse", sampleRate=44100).genom_success
        pulse.start()
        assert graph.call("/bass/Acquire", device="pulse", sampleRate=44100, nChunksOnPort=10).genom_success
        wait_for(lambda: messages[-1].nChunksOnPort == 10 and messages[-1].lastFrameIndex > 0, what=lambda: str(bass))
        assert "ALSA lib" not in bass.err
