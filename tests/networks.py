"""Network namespaces: hosts of a test's own, with cables between them."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def networks(commands: list[str], *names: str) -> Iterator[None]:
    """Run commands of ``ip`` that make the namespaces of these names; the test is skipped where that is not allowed."""
    try:
        for command in commands:
            done = subprocess.run(["ip", *command.split()], capture_output=True, text=True, check=False)
            if done.returncode:
                pytest.skip(f"no network namespaces here: ip {command}: {done.stderr.strip()}")
        yield
    finally:
        for name in names:  # the cables go with them
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)
