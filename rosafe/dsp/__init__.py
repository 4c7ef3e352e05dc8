"""Streaming numerics of the auditory front-end: one class per kind of processor, block in, block out.

Needs numpy and scipy only. Every stage is made as ``Stage(sample_rate, **parameters)`` with the original's parameter
names, takes blocks of any length through ``process``, and gives the same numbers however the signal is cut into
blocks (1e-12; where gain control starts is the one exception). Finite input gives finite output.

Modules here `import scipy`, which loads `scipy.signal` at its first use: that takes longer than all the rest.
"""

from __future__ import annotations

from .crosscorrelation import CrossCorrelation
from .filterbank import Filterbank
from .haircell import InnerHairCell
from .ild import Ild
from .input import Input
from .preproc import PreProc
from .ratemap import Ratemap
from .stage import Stage

STAGES: dict[str, type[Stage]] = {
    "input": Input,
    "preProc": PreProc,
    "gammatone": Filterbank,
    "ihc": InnerHairCell,
    "ild": Ild,
    "ratemap": Ratemap,
    "crossCorrelation": CrossCorrelation,
}

__all__ = ["STAGES", "CrossCorrelation", "Filterbank", "Ild", "InnerHairCell", "Input", "PreProc", "Ratemap", "Stage"]
