"""All tests of stages run with compiled kernels, and again without."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from .implementations import NUMPY, levels, using


@pytest.fixture(params=["kernels", "numpy"], scope="module", autouse=True)
def implementation(request: pytest.FixtureRequest) -> Iterator[None]:
    """Select the implementation."""
    available = levels()
    if request.param == "kernels" and not available:
        pytest.skip("the kernels cannot be built here")
    with using(available[-1] if request.param == "kernels" else NUMPY):
        yield
