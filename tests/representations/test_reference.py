"""The reference vectors of later representations, through the tree, with changes of parameters."""

from __future__ import annotations

import numpy as np
import pytest

from .chain import reference
from .test_spectralfeatures import WORDS

# Relative to the largest number along the named axes, or (None) absolute
VECTORS: list[tuple[str, dict[str, float], tuple[int, ...] | None]] = [
    ("Q01_itd_ic", {"itd": 1e-14, "ic": 1e-12}, None),
    ("Q02_onset_offset", {"onsetStrength": 1e-10, "offsetStrength": 1e-10}, None),
    ("Q03_adaptation", {"adaptation": 1e-12}, (-1,)),
    ("Q04_autocorrelation", {"autocorrelation": 1e-12}, None),
    ("Q05_spectralFeatures", {"spectralFeatures": 1e-12}, (0, 2)),
    ("Q06_amsFeatures_log", {"amsFeatures": 1e-11}, (0, 1, 2, 3)),
    ("Q07_pitch", {"pitch": 1e-12}, (-1,)),
    ("Q08_precedence", {"precedence_itd": 0.0, "precedence_ild": 1e-10, "precedence_cc": 1e-12}, None),
    ("Q09_onsetMap_offsetMap", {"onsetMap": 0.0, "offsetMap": 0.0}, None),
    ("Q10_gabor", {"gabor": 1e-9}, None),
    ("Q11_moc", {"moc": 1e-9}, None),
]


@pytest.mark.parametrize(("name", "tolerances", "axes"), VECTORS, ids=[name for name, *_ in VECTORS])
def test_reference_vectors(name: str, tolerances: dict[str, float], axes: tuple[int, ...] | None) -> None:
    expected, got = reference(name)
    assert expected.keys() == tolerances.keys()
    for output, tolerance in tolerances.items():
        np.testing.assert_array_equal(np.isnan(got[output]), np.isnan(expected[output]))
        scale = 1.0 if axes is None else np.nanmax(np.abs(expected[output]), axis=axes, keepdims=True)
        assert (np.nan_to_num(np.abs(got[output] - expected[output])) <= tolerance * scale).all(), output
        assert np.nanmax(np.abs(expected[output])) > 0, output
    assert name != "Q05_spectralFeatures" or got["sf_requests"] == WORDS
