"""The node that the tests of a module share, and the class of its messages."""

from __future__ import annotations

from tests.ros1.localizer.conftest import bass

__all__ = ["bass"]
