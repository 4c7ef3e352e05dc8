"""All tests of representations run with compiled kernels, and again without."""

from __future__ import annotations

from tests.dsp.conftest import implementation

__all__ = ["implementation"]
