"""Stages in all relevant modes, small enough for property tests, and blocks for them."""

from __future__ import annotations

from typing import Any

import numpy as np

from rosafe.dsp.stage import Stage
from rosafe.representations import STAGES
from rosafe.representations.gammatone import Filterbank
from rosafe.representations.haircell import METHODS, InnerHairCell

from .bare import FloatArray

RATE = 16000.0
CHANNELS = 3

_FRAMED = {
    "hann": {"wname": "hann", "wSizeSec": 0.004, "hSizeSec": 0.002},
    "hop-longer": {"wname": "hamming", "wSizeSec": 0.002, "hSizeSec": 0.0051},
    "uneven": {"wname": "blackman", "wSizeSec": 0.0066, "hSizeSec": 0.0011},
}


def _framed(prefix: str, **more: Any) -> list[dict[str, Any]]:
    return [{f"{prefix}_{name}": value for name, value in modes.items()} | more for modes in _FRAMED.values()]


# (kind, parameters) of each stage
MODES: list[tuple[str, dict[str, Any]]] = [
    ("input", {}),
    ("input", {"in_doNormalize": False}),
    ("preProc", {}),
    ("preProc", {"pp_bRemoveDC": True, "pp_bPreEmphasis": True, "pp_bLevelScaling": True, "pp_refSPLdB": 60.0}),
    ("preProc", {"pp_bMiddleEarFiltering": True}),
    ("preProc", {"pp_bMiddleEarFiltering": True, "pp_middleEarModel": "lopezpoveda", "pp_bUnityComp": True}),
    ("preProc", {"pp_bNormalizeRMS": True, "pp_intTimeSecRMS": 0.001}),
    ("gammatone", {"fb_cfHz": [4000.0, 100.0, 700.0]}),
    ("gammatone", {"fb_cfHz": [4000.0, 100.0, 700.0], "fb_nGamma": 1, "fb_bwERBs": 3.0}),
    ("gammatone", {"fb_nChannels": 1}),
    ("gammatone", {"fb_cfHz": [4000.0, 100.0, 700.0], "fb_type": "drnl"}),
    *(("ihc", {"ihc_method": method}) for method in METHODS),
    *(("ild", modes) for modes in _framed("ild")),
    *(("ratemap", modes) for modes in _framed("rm")),
    *(("ratemap", modes) for modes in _framed("rm", rm_scaling="magnitude", rm_decaySec=0.05)),
    *(("crossCorrelation", modes) for modes in _framed("cc", cc_maxDelaySec=0.0003)),
    *(("crossCorrelation", modes) for modes in _framed("cc", cc_maxDelaySec=0.01)),
]
NAMES = [f"{kind}-{'-'.join(str(v) for v in parameters.values())}" for kind, parameters in MODES]


class WithEnvelope(Stage):
    """A filterbank with its envelope appended to the output, or a hair cell with an envelope from its input."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        if isinstance(self.stage, Filterbank):
            self.stage.provide = frozenset({"envelope"})
            output = self.stage.process(block)
            assert self.stage.provided["envelope"] is not None
            return np.concatenate([output, self.stage.provided["envelope"]])
        assert isinstance(self.stage, InnerHairCell)
        return self.stage.process(block, np.abs(block) + 0.5)


def make(kind: str, parameters: dict[str, Any], rate: float = RATE) -> Stage:
    """Create a stage of this kind; filterbanks and hair cells as `WithEnvelope`."""
    stage = STAGES[kind](rate, **parameters)
    return WithEnvelope(stage) if kind in ("gammatone", "ihc") else stage


def rows(kind: str, channels: int = CHANNELS) -> tuple[int, ...]:
    """Return the shape of the input of `kind` without the time axis."""
    return (2,) if kind in ("input", "preProc", "gammatone") else (2, channels)


def noise(kind: str, samples: int, seed: int = 1, channels: int = CHANNELS) -> FloatArray:
    """Return a block of noise for a stage of this kind, with the right ear quieter."""
    block = np.random.default_rng(seed).standard_normal((*rows(kind, channels), samples))
    block[1] *= 0.3
    return block * (2**31 - 1) / 8 if kind == "input" else block
