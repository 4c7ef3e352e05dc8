"""Rejected requests: each exception reports its reason through every interface."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import tomllib
import yaml

from tests import harness
from tests.matlab import octave
from tests.web.genomix import world as worlds
from tests.web.genomix.world import World


class Refusal(NamedTuple):
    """A rejected request, its exception, and words of the reason.

    `command` is the equivalent command line, if there is one.
    """

    request: str
    given: dict[str, Any]
    ex: str
    why: str
    command: Sequence[str] = ()


REFUSALS = [
    Refusal(**one) for one in tomllib.loads(Path(__file__).with_name("refusals.toml").read_text("utf-8"))["refusal"]
]
WITH_COMMAND = [refusal for refusal in REFUSALS if refusal.command]

# Run `rosservice call NAME YAML` and `rosafe WORD ...` in one process, because starting Python is slow.
ROSSERVICE = """
import json, sys, rosservice
for name, text in json.load(sys.stdin):
    try:
        rosservice.rosservicemain(["rosservice", "call", name, text])
    except SystemExit:
        pass
    print("%%", flush=True)
"""
ROSAFE = """
import json, sys
from rosafe.commands.__main__ import main
for words in json.load(sys.stdin):
    code = main(words)
    print(f"exit {code}\\n%%", file=sys.stderr, flush=True)
"""


@pytest.fixture(scope="module")
def refusing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """A tree of four processors, and a second rosAFE without any."""
    with worlds.world(tmp_path_factory.mktemp("world")) as world, world.graph.node("rosAFE-ros", "-i", "empty"):
        world.http.call("bass/Acquire", ["scene:"])
        world.http.call("rosAFE/connect_port", ["Audio", "bass/Audio"])
        for request in ("InputProc", "PreProc", "GammatoneProc", "IhcProc"):
            world.http.call(f"rosAFE/{request}")
        yield world


@pytest.fixture
def world(refusing: World) -> Iterator[World]:
    """The same; nothing has changed after a test."""
    yield refusing
    processors = refusing.http.call("rosAFE/getProcessors")["processors"]
    assert [p["name"] for p in processors] == ["input", "preProc", "gammatone", "ihc"]
    assert refusing.http.call("empty/getProcessors")["processors"] == []


def check(refusal: Refusal, body: dict[str, Any]) -> None:
    """Check that a client got the expected exception, with its reason in one of two places."""
    ex = refusal.ex if refusal.ex.startswith("::") else f"::{refusal.request.partition('/')[0]}::{refusal.ex}"
    assert body["ex"] == ex, body
    places = [body["what"]] if "what" in body else []
    places += [body["detail"]["what"]] if "what" in body.get("detail", {}) else []
    assert len(places) == 1 and refusal.why in places[0] and "\n" not in places[0], body


def program(world: World, text: str, given: Any) -> Any:
    """Run a Python program that reads JSON."""
    python = harness.python_path(world.graph)
    return world.graph.run("python3", "-c", text, stdin=json.dumps(given), timeout=180, PYTHONPATH=python)


def test_rosservice(world: World) -> None:
    calls = [(f"/{r.request}", json.dumps(r.given)) for r in REFUSALS]
    for refusal, printed in zip(REFUSALS, program(world, ROSSERVICE, calls).stdout.split("%%\n"), strict=False):
        answer = yaml.safe_load(printed)
        assert answer["genom_success"] is False
        check(refusal, json.loads(answer["genom_exdetail"]))


def test_http(world: World) -> None:
    for refusal in REFUSALS:
        with pytest.raises(worlds.HttpError) as refused:
            world.http.call(refusal.request, refusal.given)
        assert refused.value.status in (404, 422)
        check(refusal, refused.value.body)


def test_tcl(world: World) -> None:
    words = []
    for refusal in REFUSALS:
        pairs = [value for pair in refusal.given.items() for value in pair]
        given = " ".join("{%s}" % (" ".join(map(str, v)) if isinstance(v, list) else v) for v in pairs)
        words.append(f"tell {{{refusal.request.replace('/', '::')} {{{given}}}}}")
    script = """
        set g [genomix::connect $address]
        $g load bass; $g load rosAFE
        proc tell {script} {
            catch $script message options
            set what {}
            catch {set what [dict get $message detail what]}
            catch {set what [dict get $message what]}
            puts [dict get $message ex]\\t$what\\t[lrange [dict get $options -errorcode] 0 1]
        }
    """
    for refusal, line in zip(REFUSALS, world.lines(script + "\n".join(words)), strict=True):
        ex, what, code = line.split("\t")
        check(refusal, {"ex": ex, "what": what})
        assert code == f"GENOM {ex}"


def test_octave(world: World) -> None:
    lines = ["client = genomix.client(); bass = client.load('bass'); rosAFE = client.load('rosAFE');"]
    for number, refusal in enumerate(REFUSALS):
        fields = ", ".join(f"'{name}', {_matlab(value)}" for name, value in refusal.given.items())
        lines.append(f"show('r{number}', {refusal.request.replace('/', '.')}(struct({fields})).exception);")
    shown = octave.run_and_parse(world, "\n".join(lines))
    for number, refusal in enumerate(REFUSALS):
        check(refusal, shown[f"r{number}"])


def _matlab(value: Any) -> str:
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    return f"{{{{{', '.join(map(str, value))}}}}}" if isinstance(value, list) else str(value)


def test_command_line(world: World) -> None:
    """In one line, with exit status 1."""
    done = program(world, ROSAFE, [refusal.command for refusal in WITH_COMMAND])
    for refusal, printed in zip(WITH_COMMAND, done.stderr.split("%%\n"), strict=False):
        line, code, end = printed.split("\n")
        assert line.startswith(f"rosafe {refusal.command[0]}: ") and refusal.why in line
        assert (code, end) == ("exit 1", "")
