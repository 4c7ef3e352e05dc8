"""`FramedStage.required_input`: no frame is output earlier, so that the tree may wait for this much input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.dsp.framing import FramedStage
from rosafe.dsp.stage import parts_of
from rosafe.representations import KINDS, STAGES

from .chain import Chain

RATE = 8000.0
PARAMETERS = {"fb_nChannels": 3, "fb_highFreqHz": 3000.0}
TIGHT = {kind for kind, stage in STAGES.items() if issubclass(stage, FramedStage)} - {"amsFeatures"}  # it decimates
HOPS: tuple[dict[str, float], ...] = (
    {},
    {"ild_hSizeSec": 0.03, "rm_hSizeSec": 0.03, "cc_hSizeSec": 0.03, "rm_wSizeSec": 0.011},
)


@pytest.mark.parametrize("kind", STAGES)
@settings(max_examples=3, database=None)
@given(
    sizes=st.lists(st.one_of(st.sampled_from([0, 1, 160]), st.integers(1, 400)), min_size=4, max_size=12),
    hops=st.sampled_from(HOPS),
)
def test_no_frame_is_output_earlier(kind: str, sizes: list[int], hops: dict[str, float]) -> None:
    chain = Chain(RATE, [kind], {**PARAMETERS, **{name: v for name, v in hops.items() if _is_used(kind, name)}})
    sound = np.random.default_rng(1).standard_normal((2, sum(sizes)))
    for block in np.split(sound, np.cumsum(sizes)[:-1], axis=-1):
        required = {
            name: [stage.required_input(frames) for frames in (1, 2, 3)]
            for name, stage in chain.stages.items()
            if isinstance(stage, FramedStage)
        }
        made = chain.process(block)
        for stage, output in made.items():
            parent = made.get(KINDS[stage].parent)
            arrived = (block if parent is None else parts_of(parent)[0]).shape[-1]
            frames = parts_of(output)[0].shape[-1]
            for number, needed in enumerate(required.get(stage, (1, 2, 3)), 1):  # others: a frame for each one
                assert needed >= 1
                assert frames < number or arrived >= needed, stage
                if stage in TIGHT:  # they output each frame as soon as its last sample has arrived
                    assert frames >= number or arrived < needed, stage


def _is_used(kind: str, name: str) -> bool:
    while kind:
        if any(name == parameter.name for parameter in KINDS[kind].parameters):
            return True
        kind = KINDS[kind].parent
    return False
