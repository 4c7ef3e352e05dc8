"""The curl lines of docs/genomixd.md do what the page says."""

from __future__ import annotations

import re
import shutil

import pytest

from tests import harness
from tests.genomix.world import World

pytestmark = pytest.mark.ros


def test_the_session_of_the_page(world: World) -> None:
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    page = (harness.ROOT / "docs" / "genomixd.md").read_text("utf-8")
    session = page.split("```")[1]
    steps = re.findall(r"^\$ (curl .*)\n((?:[^$\n].*\n)*)", session, re.MULTILINE)
    assert len(steps) == session.count("$ curl") > 15
    for command, shown in steps:
        command = command.replace(":8080/", f":{world.port}/").replace("curl ", "curl -sS --noproxy '*' ", 1)
        told = world.graph.run("sh", "-c", command).stdout
        pattern = ".*".join(map(re.escape, shown.strip().split("...")))
        assert re.fullmatch(pattern, told.strip(), re.DOTALL), f"{command}\n{told[:1000]}"


def test_the_page_names_every_url(world: World) -> None:
    page = (harness.ROOT / "docs" / "genomixd.md").read_text("utf-8")
    status, told = world.http.raw("/")
    assert status == 200
    for path in set(re.findall(r"/(?:session|request)/[a-z]+|/[a-z]+(?=/[A-Z]|\?|\n)", told)):
        assert path in page
