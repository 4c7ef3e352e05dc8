"""Fixtures for tests with a real ROS 2, which scripts/install --tests installs; without it they skip."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.localization.conftest import sphere_model

from .network import Network, network, variables

__all__ = ["sphere_model"]


@pytest.fixture(scope="session")
def ros2_env() -> dict[str, str]:
    """The environment variables of ROS 2."""
    found = variables()
    if isinstance(found, str):
        pytest.skip(found)
    return found


@pytest.fixture
def ros2(ros2_env: dict[str, str], tmp_path: Path) -> Iterator[Network]:
    """A network of its own for the ROS 2 programs of the test."""
    with network(ros2_env, tmp_path) as created:
        yield created
