"""All tests of the numerics run on the compiled kernels, and again on their twins."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from .implementations import TWINS, levels, using


@pytest.fixture(params=["kernels", "twins"], scope="module", autouse=True)
def implementation(request: pytest.FixtureRequest) -> Iterator[None]:
    """What the stages run on."""
    available = levels()
    if request.param == "kernels" and not available:
        pytest.skip("the kernels cannot be built here")
    with using(available[-1] if request.param == "kernels" else TWINS):
        yield
