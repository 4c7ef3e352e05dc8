"""All tests of the representations run on the compiled kernels, and again on their twins."""

from __future__ import annotations

from tests.dsp.conftest import implementation

__all__ = ["implementation"]
