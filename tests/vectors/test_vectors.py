"""`rosafe.process` reproduces the reference vectors for any block sizes."""

from __future__ import annotations

import numpy as np
import pytest

import rosafe

from . import make

# relative to the largest number of an output; itd in seconds and levels in dB are absolute
TOLERANCES = {"itd": 1e-8, "ild": 1e-6, "onsetStrength": 1e-6, "offsetStrength": 1e-6, "ic": 1e-8}
ABSOLUTE = ("itd", "ild", "onsetStrength", "offsetStrength")


@pytest.mark.parametrize("name", make.CASES)
@pytest.mark.parametrize("block_frames", [12000, [1, 777, 64]], ids=["one block", "many blocks"])
def test_vectors(name: str, block_frames: int | list[int]) -> None:
    case = make.CASES[name]
    with np.load(make.HERE / f"{name}.npz") as stored:
        expected = dict(stored)
    signal = expected.pop("signal")
    parameters = {"fb_cfHz": case["cf"], **case.get("parameters", {})}
    got = rosafe.process(signal, case["rate"], parameters=parameters, block_frames=block_frames, outputs=list(expected))
    for output, reference in expected.items():
        found = make.kept(output, got[output])
        assert found.shape == reference.shape, output
        assert np.abs(reference).max() > 0, output
        scale = 1.0 if output in ABSOLUTE else np.abs(reference).max()
        error = np.abs(found - reference).max() / scale
        assert error <= TOLERANCES.get(output, 1e-10), (output, error)


def test_the_script_reproduces_the_files() -> None:
    """The smaller case is generated again."""
    name = "noise_conditioned"
    made = make.compute(make.CASES[name])
    with np.load(make.HERE / f"{name}.npz") as stored:
        assert set(stored) == set(made)
        for output in stored:
            np.testing.assert_allclose(make.kept(output, made[output]), stored[output], rtol=1e-9, atol=1e-12)
