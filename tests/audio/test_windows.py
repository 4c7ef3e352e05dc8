"""Streams that are joined from overlapping windows: which messages continue a stream."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rosafe.audio.files.windows import MAX_JUMP_SECONDS, WindowStream

RATE, WINDOW = 1000, 200


def message(index: int) -> SimpleNamespace:
    return SimpleNamespace(
        sampleRate=RATE, lastFrameIndex=index, left=np.zeros(WINDOW, np.int32), right=np.zeros(WINDOW, np.int32)
    )


@pytest.mark.parametrize(("jump", "continues"), [(3_600_200, True), (3_600_201, False)])
def test_a_jump_of_more_than_an_hour_starts_a_new_stream(jump: int, continues: bool) -> None:
    assert MAX_JUMP_SECONDS * RATE + WINDOW == 3_600_200
    stream = WindowStream(with_first=True)
    stream.advance(message(500))
    assert (stream.mismatch(message(500 + jump)) == "") == continues
