"""manager_RosAFE and dataObject_RosAFE in Octave: requests of trees, gapless chunks, changes, errors."""

from __future__ import annotations

import pytest

from tests.matlab import octave
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros


def test_representations_and_their_data(world: World) -> None:
    results = octave.run_and_parse(world, octave.script("representations_and_their_data"))
    *samples, frames = results["seconds"]
    assert min(samples) >= 0.6 and max(samples) - min(samples) <= 0.5
    assert abs(frames - samples[2]) <= 0.5


def test_reuse_changes_and_errors(world: World) -> None:
    results = octave.run_and_parse(world, octave.script("reuse_changes_and_errors"))
    for name, beginning in {
        "bad value": "manager_RosAFE:refused Error::rosAFE::e_badNewValue: ild_wSizeSec: exp",
        "bad name": "manager_RosAFE:refused Error::genom::serialization: ",
        "bad parameter": "manager_RosAFE:refused Error::rosAFE::e_noSuchParameter: ",
        "bad processor": "manager_RosAFE:refused Error::rosAFE::e_noSuchProcessor: ",
        "bad type": "manager_RosAFE:type",
        "bad number": "manager_RosAFE:number number: expected 1 to 3 for type 'ild', got 99",
        "two": "manager_RosAFE:arguments p: expected one structure of parameters, got 2",
        "bad count": "manager_RosAFE:arguments",
        "bad device": "acquireAudio:refused Error::bass::e_device",
        "few": "dataObject_RosAFE:arguments",
    }.items():
        assert results[name].startswith(beginning), (name, results[name])
