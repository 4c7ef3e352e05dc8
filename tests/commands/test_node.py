"""`rosafe process` and the running node return the same numbers for the same samples, bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rosafe.interface import CORE_REPRESENTATIONS
from tests.commands.command import rosafe, write
from tests.harness import Graph
from tests.ros1.afe.session import RATE, assert_holds, noise, own_node, windowed

BLOCK, BLOCKS = 1600, 5
VALUES = {"pp_bNormalizeRMS": True, "pp_intTimeSecRMS": 0.1, "fb_nERBs": 3.0, "ihc_method": "bernstein"}


def test_same_numbers_as_the_node(graph: Graph, tmp_path: Path) -> None:
    signal = noise(BLOCK * BLOCKS)
    path = write(tmp_path / "in.wav", signal, RATE, "PCM_32")
    settings = [f"{name}={str(value).lower()}" for name, value in VALUES.items()]
    done = rosafe(
        "process", path, "--block", str(BLOCK), "--outputs", ",".join(CORE_REPRESENTATIONS), "--set", *settings
    )
    assert done.returncode == 0, done
    with np.load(tmp_path / "in.npz") as loaded, own_node(graph, name="besides") as node:
        seconds = BLOCK * BLOCKS / RATE
        requests = [kind.request for kind in CORE_REPRESENTATIONS.values() if kind.parent]
        microphone = node.build(*requests, block=BLOCK, bufferSize_s_port=seconds, **VALUES)
        microphone.play(signal)
        for kind in CORE_REPRESENTATIONS:
            rate = float(loaded[f"{kind}_frameRate"]) if f"{kind}_frameRate" in loaded else RATE
            message = node.read(kind, index=BLOCK * BLOCKS + 1)  # index of the frame after the last
            assert_holds(message, kind, windowed(loaded[kind], seconds, rate))
