"""Network namespaces: simulated hosts and cables for tests."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def networks(commands: list[str], *names: str) -> Iterator[None]:
    """Run ``ip`` commands that create the namespaces `names`; skip the test if this is not permitted."""
    try:
        for command in commands:
            done = subprocess.run(["ip", *command.split()], capture_output=True, text=True, check=False)
            if done.returncode:
                pytest.skip(f"network namespaces are not available: ip {command}: {done.stderr.strip()}")
        yield
    finally:
        for name in names:  # this also removes the cables
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)
