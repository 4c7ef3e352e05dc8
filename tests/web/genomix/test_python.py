"""The Python client of genomixd: calls, requests, ports and errors, as scripts for GenoM components use them."""

from __future__ import annotations

import copy
import http.client
import inspect
import math
import multiprocessing
import pickle
import re
import signal
import threading
import wave
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import genomix
import pytest
from genomix import event, packed

from rosafe.web.genomix.formats import PACKED
from tests import harness
from tests.web.genomix import world as worlds
from tests.web.genomix.test_server import live_activities
from tests.web.genomix.test_strangers import stranger
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros


@pytest.fixture
def g(world: World) -> Iterator[genomix.Client]:
    """A connection to the genomixd of the module's world."""
    yield genomix.connect(f"127.0.0.1:{world.port}")


def start_tree(g: genomix.Client) -> genomix.Component:
    """Start a small tree whose sound has ended, so that its ports do not change."""
    bass, afe = g.load("bass"), g.load("rosAFE")
    acquire = bass.Acquire("scene:", 16000, 800, 20, ack=True)
    afe.connect_port({"local": "Audio", "remote": "bass/Audio"})
    afe.InputProc("input", 1600, 0.5, 0.5, ack=True)
    afe.PreProc(ack=True)
    afe.GammatoneProc({"fb_nChannels": 3, "fb_highFreqHz": 4000}, ack=True)
    afe.IhcProc(ihc_method="halfwave", ack=True)
    afe.IldProc("ild", ild_wname="hamming", ack=True)
    harness.wait_for(lambda: afe.ildPort("ild")["ildPort"]["lastFrameIndex"] > 8000)
    acquire.abort()
    assert acquire.wait(harness.PATIENCE) is genomix.Status.done
    return afe


def error(ex: str, text: str = "") -> Any:
    """Expect a GenoMError whose text begins with a name and contains `text`."""
    return pytest.raises(event.GenoMError, match=f"^{ex}.*{re.escape(text)}")


SCRIPT = """
import sys
import genomix
from genomix.event import GenoMError

g = genomix.connect()
g.rpath('/opt/openrobots/lib/genom/ros/plugins')
ears = g.load('/opt/openrobots/lib/genom/ros/plugins/bass.so')
afe = g.load('rosAFE')

def setup():
    afe.connect_port({'local': 'Audio', 'remote': 'bass/Audio'})
    try:
        afe.connect_port(local='Audio', remote='bass/Video')
    except GenoMError as problem:
        assert 'no_such_outport' in str(problem), problem
    ears.Acquire({'device': 'scene:', 'sampleRate': 16000, 'nFramesPerChunk': 800}, ack=True)

def start():
    handle = afe.InputProc({'nFramesPerBlock': 1600}, ack=True)
    while str(handle.status) != 'sent' or afe.inputProcPort()['inputProcPort']['lastFrameIndex'] == 0:
        genomix.update()
    return handle

def stop(handle):
    afe.Stop()
    while True:
        if genomix.update() or handle.status == genomix.Status.done:
            break
        assert handle.status != genomix.Status.error
    ears.Stop()

setup()
handle = start()
print(afe.getDependencies('input'), [v for v in afe.getParameters()['parameters']['input'][0].values()][:1])
stop(handle)
print(handle.result, 'rosafe' in sys.modules, 'rospy' in sys.modules, 'numpy' in sys.modules)
"""


def test_a_public_script_runs_without_ros(world: World) -> None:
    path = world.graph.home / "script.py"
    path.write_text(SCRIPT)
    python = str(harness.ROOT / "python")
    done = world.graph.run(
        harness.PYTHON, "-S", str(path), check=True, GENOMIXD=f"127.0.0.1:{world.port}", PYTHONPATH=python
    )
    assert done.stdout.splitlines() == ["{'dependencies': ['input']} ['input']", "{} False False False"]
    assert done.stderr == ""


def test_the_session_of_the_document(world: World) -> None:
    text = (harness.ROOT / "docs" / "genomix-python.md").read_text("utf-8")
    (block,) = (b for b in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "import genomix" in b)
    path = world.graph.home / "document.py"
    path.write_text(f"{block}\nprint(len(centres), len(levels), {{len(row) for row in levels}})\n")
    done = world.graph.run(harness.PYTHON, str(path), check=True, GENOMIXD=f"127.0.0.1:{world.port}")
    assert (done.stdout, done.stderr) == ("16 16 {100}\n", "")


def test_all_forms_of_a_call(g: genomix.Client) -> None:
    afe = start_tree(g)
    expected = afe.IhcProc("first", "gammatone", "square", ack=True) and "square"
    for number, (args, kwargs) in enumerate(
        [
            (({"name": "a0", "ihc_method": "square"},), {}),
            (("a1", "gammatone", "square"), {}),
            ((), {"name": "a2", "ihc_method": "square"}),
            (("a3",), {"ihc_method": "square"}),
            (({"name": "a4"},), {"ihc_method": "square"}),
        ]
    ):
        request = afe.IhcProc(*args, ack=True, **kwargs)
        assert request.status is genomix.Status.sent and request.result is None and request.exception is None
        found = {p["name"]: p["ihc_method"] for p in afe.getParameters()["parameters"]["ihc"]}
        assert found[f"a{number}"] == expected
    tree = afe.request("ratemap", fb_nChannels=3, fb_highFreqHz=4000)
    assert tree == {**afe.request("ratemap", {"fb_nChannels": 3, "fb_highFreqHz": 4000}), "created": tree["created"],
                    "reused": tree["reused"]}  # fmt: skip
    assert afe.removeProcessor(nameProc="a0") == {}  # an alias of a parameter
    assert afe.getSignal.__name__ == "getSignals"  # an alias of a service


def test_arrays_of_numpy(g: genomix.Client) -> None:
    np = pytest.importorskip("numpy")
    afe = start_tree(g)
    afe.GammatoneProc("bank", fb_cfHz=np.array([250.5, 1000.0]), fb_nGamma=np.int64(3), ack=True)
    bank = afe.getParameters()["parameters"]["gammatone"][1]
    assert bank["fb_cfHz"] == [250.5, 1000] and bank["fb_nGamma"] == 3


def test_ports_have_the_values_of_the_server(world: World, g: genomix.Client) -> None:
    afe = start_tree(g)
    for port, element in (("ildPort", "ild"), ("gammatonePort", "gammatone"), ("inputProcPort", "")):
        read = getattr(afe, port)(element) if element else getattr(afe, port)()
        assert read == world.http.call(f"rosAFE/{port}/{element}".rstrip("/"))
    audio = g.load("bass").Audio()
    assert audio == world.http.call("bass/Audio")
    assert {type(v) for v in audio["Audio"]["left"]} == {int} == {type(audio["Audio"]["lastFrameIndex"])}
    (part,) = afe.getRepresentation("ild")["parts"]
    assert math.prod(part["shape"]) == len(part["data"]) > 0
    assert {type(v) for v in part["shape"]} == {int}


def test_errors(g: genomix.Client, world: World) -> None:
    afe = start_tree(g)
    with error("::rosAFE::e_noSuchProcessor", "there is no processor 'x'") as caught:
        afe.removeProcessor("x")
    assert (caught.value.ex, caught.value.detail) == ("::rosAFE::e_noSuchProcessor", {})
    assert issubclass(event.GenoMError, RuntimeError)
    copies: list[Any] = [copy.deepcopy(caught.value), pickle.loads(pickle.dumps(caught.value))]
    for same in copies:
        assert (same.ex, same.what, str(same)) == (caught.value.ex, caught.value.what, str(caught.value))
    for options in ({}, {"ack": True}):
        with error("::rosAFE::e_noUpperDependencie", "there is no processor 'q'"):
            afe.IldProc("new", upperDepName="q", **options)
    with error("::genom::serialization", "expected a known parameter, got 'fb_nChanels'"):
        afe.GammatoneProc(fb_nChanels=3)
    with error("::genom::serialization", "name: expected one value, got two"):
        afe.IhcProc("a", name="b")
    with error("::genom::serialization", "expected at most 3 values, got 4"):
        afe.IhcProc("a", "b", "dau", "c", x=1)
    with error("::genom::serialization", "got object"):
        afe.IhcProc(object())
    with error("::genom::serialization", "local is missing"):
        afe.connect_port()
    with error("::genom::no_such_outport", "there are: ild"):
        afe.ildPort("no")
    with error("::genom::no_such_outport", "is an input port"):
        afe.Audio()
    with error("::genom::mwerr", "nobody is not running"):
        g.load("nobody")
    with error("::genom::serialization", 'expected "-i", INSTANCE'):
        g.load("rosAFE", "-x")
    with pytest.raises(AttributeError, match=r"expected a service or port \(InputProc, .*did you mean IldProc\?"):
        afe.IldProk  # noqa: B018
    assert not hasattr(afe, "__wrapped__") and copy.copy(afe).getDependencies("ild")
    with pytest.warns(UserWarning, match=r"rosAFE\.IhcProc: .*dauu"):
        afe.IhcProc("w", "gammatone", "dauu", ack=True)


def test_addresses() -> None:
    for address in ("a b", "host:x", "host:70000", "http://host/path", "host:0"):
        with error("::genom::mwerr", "expected host or host:port"):
            genomix.connect(address)
    with error("::genom::mwerr", "got no connection"):
        genomix.connect("\u00fc" * 100)
    port = harness.free_port()
    with error("::genom::mwerr", f"expected genomixd at [::1]:{port}, got no connection"):
        genomix.connect(f"[::1]:{port}")


def test_help_shows_parameters(g: genomix.Client) -> None:
    afe = g.load("rosAFE")
    assert {"GammatoneProc", "ildPort", "kill"} <= set(dir(afe))
    text = afe.GammatoneProc.__doc__ or ""
    assert "fb_nGamma (unsigned long; default 4; from 1 to 128)\n        Gammatone rising slope order" in text
    assert "::rosAFE::e_noUpperDependencie" in text
    assert str(inspect.signature(afe.IldProc)).startswith("(name='ild', upperDepName='ihc', ild_wname='hann',")
    assert "Interaural level differences" in (afe.ildPort.__doc__ or "")


def test_an_activity_is_waited_for(g: genomix.Client, tmp_path: Path) -> None:
    """Without `ack`, a call returns at the end of the activity; with `callback`, the function is called there."""
    with wave.open(str(tmp_path / "short.wav"), "wb") as file:
        file.setparams((2, 2, 8000, 0, "NONE", ""))
        file.writeframes(bytes(4 * 2400))
    bass = g.load("bass")
    assert bass.Acquire(f"file:{tmp_path}/short.wav", 0, 400, 20) == {}
    assert bass.Audio()["Audio"]["lastFrameIndex"] == 2400
    ended: list[genomix.Request] = []
    request = bass.Acquire("scene:", callback=ended.append)
    harness.wait_for(lambda: bass.getAcquisition()["running"])  # an activity that is aborted before it runs has failed
    assert request.wait(0.05) is genomix.Status.sent and not ended
    request.abort()
    harness.wait_for(lambda: ended == [request])
    assert request.status is genomix.Status.done and request.result == {}
    assert bass.Acquire("scene:", oneway=True) is None
    harness.wait_for(lambda: bass.getAcquisition()["running"])  # later, it would run in the next test


BLOCKING = """
import genomix
bass = genomix.connect().load("bass")
print("ready", flush=True)
bass.Acquire("scene:")
"""


def test_an_interrupt_aborts_the_activity(world: World) -> None:
    with world.graph.start(harness.PYTHON, "-c", BLOCKING, GENOMIXD=f"127.0.0.1:{world.port}") as process:
        harness.wait_for(lambda: live_activities(world, "bass"), what="start of the capture")
        process.stop(signal.SIGINT)
        assert "KeyboardInterrupt" in process.err
    harness.wait_for(lambda: not live_activities(world, "bass"), what="end of the capture")


UNNOTICED = f"""
import signal, threading
# The signal reaches another thread, so the main thread is not interrupted while it reads the answer.
threading.Thread(target=threading.Event().wait, daemon=True).start()
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
{BLOCKING}
"""


def test_an_interrupt_that_is_not_noticed_at_once(world: World) -> None:
    with world.graph.start(harness.PYTHON, "-c", UNNOTICED, GENOMIXD=f"127.0.0.1:{world.port}") as process:
        harness.wait_for(lambda: live_activities(world, "bass"), what="start of the capture")
        process.stop(signal.SIGINT, harness.PATIENCE / 2)
        assert "KeyboardInterrupt" in process.err
    harness.wait_for(lambda: not live_activities(world, "bass"), what="end of the capture")


def test_an_interrupt_before_the_start_aborts_the_activity(g: genomix.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    bass = g.load("bass")
    ids: list[str] = []

    def interrupted(request: genomix.Request) -> genomix.Status:
        ids.append(request.id)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(genomix.Request, "wait_for_start", interrupted)
        bass.Acquire("scene:", ack=True)
    assert g.get("/request/wait", id=ids[0], ms="60000")["status"] != "sent"


def test_an_interrupt_before_the_answer_aborts_the_activity(world: World, g: genomix.Client) -> None:
    """genomixd answers after the activity has begun, and Ctrl-C arrives between the two."""
    bass = g.load("bass")
    answer = http.client.HTTPConnection.getresponse

    def delayed(connection: http.client.HTTPConnection) -> http.client.HTTPResponse:
        patch.undo()
        harness.wait_for(lambda: live_activities(world, "bass"), what="start of the capture")
        signal.pthread_kill(cast(int, threading.main_thread().ident), signal.SIGINT)
        return answer(connection)

    signal.signal(signal.SIGINT, signal.default_int_handler)  # the tests may have started with SIGINT ignored
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(http.client.HTTPConnection, "getresponse", delayed)
        bass.Acquire("scene:")
    harness.wait_for(lambda: not live_activities(world, "bass"), what="end of the capture")


def test_threads_share_a_connection(g: genomix.Client) -> None:
    afe = start_tree(g)
    gammatone = afe.gammatonePort("gammatone")
    names = ["input", "preProc", "gammatone", "ihc", "ild"]

    def work(index: int) -> bool:
        good = True
        for _ in range(10):
            good &= afe.getDependencies(names[index])["dependencies"] == names[: index + 1]
            good &= afe.gammatonePort("gammatone") == gammatone
        return good

    assert harness.run_together(5, work) == [True] * 5


def test_forked_processes_have_their_own_connections(g: genomix.Client) -> None:
    afe = start_tree(g)
    ours, theirs = multiprocessing.Pipe()
    child = multiprocessing.get_context("fork").Process(target=lambda: theirs.send(afe.getDependencies("ild")))
    child.start()
    results = [afe.getDependencies("ihc")["dependencies"][-1] for _ in range(20)]
    assert ours.recv()["dependencies"][-1] == "ild" and set(results) == {"ihc"}
    child.join()
    assert afe.getDependencies("input") == {"dependencies": ["input"]}  # the child's end did not end the session


def test_requests_without_an_object_are_forgotten(world: World, g: genomix.Client) -> None:
    bass = g.load("bass")
    for _ in range(5):
        bass.Stop(ack=True)
    kept = bass.Stop(ack=True)
    assert list(g.get("/requests")) == [kept.id]


def test_instances(world: World, g: genomix.Client) -> None:
    with world.graph.node("bass-ros", "-i", "left"):
        left, other = g.load("bass", "-i", "left"), g.load("bass", "-i", "left", "as", "other")
        assert (repr(left), repr(other)) == ("<genomix.Component left>", "<genomix.Component other>")
        left.Acquire("scene:", 8000, ack=True)
        assert other.getAcquisition()["sampleRate"] == 8000 and not g.load("bass").getAcquisition()["running"]
        g.unload(other)
        g.unload("/opt/lib/genom/ros/plugins/left.so")
        with error("::genom"):
            g.unload("nobody")


def test_a_new_genomixd_is_used(empty_world: World) -> None:
    with empty_world.graph.node("bass-ros"):
        port = harness.free_port()
        with worlds.genomixd(empty_world.graph, "-p", str(port), "__name:=first"):
            g = genomix.connect(f"localhost:{port}")
            bass = g.load("bass")
            request = bass.Stop(ack=True)
        with error("::genom::mwerr", f"genomixd at localhost:{port}"):
            bass.Stop()
        with worlds.genomixd(empty_world.graph, "-p", str(port), "__name:=second"):
            assert bass.Stop() == {} and bass.Audio()["Audio"]["lastFrameIndex"] == 0
            del request  # the new server does not know it
            assert bass.Stop(ack=True).wait() is genomix.Status.done
    with error("::genom::mwerr"):
        g.get("/components")


def test_a_damaged_answer() -> None:
    """tests/web/genomix/test_packed.py decodes whole ones."""
    data = PACKED.plain({"a": [1.5, math.inf], "b": "text"})
    assert packed.decode(data) == {"a": [1.5, math.inf], "b": "text"}
    for end in range(len(data)):
        with error("::genom::mwerr", "damaged"):
            packed.decode(data[:end])


def test_a_server_that_is_no_genomixd() -> None:
    expected = error("::genom::mwerr", "expected an answer of genomixd")
    with stranger(b"HTTP/1.0 404 Not Found\r\n\r\n<html>") as server, expected:
        genomix.connect(f"127.0.0.1:{server.port}")
