"""The curl lines of docs/genomixd.md and the commands of docs/request.md have the documented results."""

from __future__ import annotations

import json
import re
import shutil

import pytest

from tests import harness
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros


def at_low_rate(call: str) -> str:
    """Return a call of Acquire with a low sample rate: the computation takes a fifth of the time."""
    assert "'scene:'}" in call
    return call.replace("'scene:'}", "'scene:', sampleRate: 8000}")


def test_the_session_of_the_page(world: World) -> None:
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    page = (harness.ROOT / "docs" / "genomixd.md").read_text("utf-8")
    session = page.split("```")[1]
    steps = re.findall(r"^\$ (curl .*)\n((?:[^$\n].*\n)*)", session, re.MULTILINE)
    assert len(steps) == session.count("$ curl") > 15
    for command, shown in steps:
        command = command.replace(":8080/", f":{world.port}/").replace("curl ", "curl -sS --noproxy '*' ", 1)
        output = world.graph.run("sh", "-c", command).stdout
        pattern = ".*".join(map(re.escape, shown.strip().split("...")))
        assert re.fullmatch(pattern, output.strip(), re.DOTALL), f"{command}\n{output[:1000]}"


def test_the_page_names_every_url(world: World) -> None:
    page = (harness.ROOT / "docs" / "genomixd.md").read_text("utf-8")
    status, output = world.http.raw("/")
    assert status == 200
    for path in set(re.findall(r"/(?:session|request)/[a-z]+|/[a-z]+(?=/[A-Z]|\?|\n)", output)):
        assert path in page


def test_the_page_of_the_request(world: World) -> None:
    page = (harness.ROOT / "docs" / "request.md").read_text("utf-8")
    shell, plain = re.findall(r"^```sh\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    (shown,) = re.findall(r"\n\n```\n(created .*?)^```$", page, re.MULTILINE | re.DOTALL)
    (tcl,) = re.findall(r"^```tcl\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    acquire, ild, ratemap, rates = shell.splitlines()
    assert "genom_success: True" in world.graph.run("sh", "-c", at_low_rate(acquire)).stdout
    assert world.graph.run("sh", "-c", ild).stdout == shown
    assert json.loads(world.graph.run("sh", "-c", ratemap).stdout)["created"] == ["ratemap_0"]
    pitch, modulation = (world.graph.run("sh", "-c", command).stdout for command in plain.splitlines())
    assert 'name: "pitch_0"' in pitch and 'name: "amsfeatures_0"' in modulation.lower()
    assert rates.startswith("rostopic hz ") and rates.split()[2] in world.graph.topics()
    assert world.lines(f"set env(GENOMIXD) $address\n{tcl}") == ["/rosAFE/ildPort/ild_1", "16"]


@pytest.mark.exploration
def test_the_page_of_the_representations(world: World) -> None:
    page = (harness.ROOT / "docs" / "representations.md").read_text("utf-8")
    (shell,) = re.findall(r"^```sh\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    (tcl,) = re.findall(r"^```tcl\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    *calls, live = shell.splitlines()
    assert live.startswith("rosafe live ") and len(calls) == 5
    for call in [at_low_rate(calls[0]), *calls[1:]]:
        assert "genom_success: True" in world.graph.run("sh", "-c", call).stdout, call
    assert "value: 0.4" in world.graph.run("rosservice", "call", "/rosAFE/getProcessors", "{}").stdout.replace('"', "")
    axes, shape = world.lines(f"set env(GENOMIXD) $address\n{tcl}")[-1].split(": ")
    assert axes == "0 ear 1 feature 2 time" and shape.split()[:4] == ["0", "2", "1", "3"]
