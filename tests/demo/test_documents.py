"""Documents that must agree with the code."""

from __future__ import annotations

import dataclasses

from rosafe.ros1.component.audio import RING_SECONDS, Counters
from tests.harness import ROOT

DOCS = ROOT / "docs"


def test_the_audio_counters_are_documented() -> None:
    text = (DOCS / "audio-stream.md").read_text("utf-8")
    for counter in dataclasses.fields(Counters):
        if counter.name not in ("messages", "last_loss"):
            assert f"`{counter.name}`" in text, counter.name
    assert f"a ring of {RING_SECONDS:g} s" in text
