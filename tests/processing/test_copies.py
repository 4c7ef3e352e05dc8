"""Copies of public objects: independent, with the same numbers, also in other processes and through joblib and Dask."""

from __future__ import annotations

import copy
import functools
import multiprocessing
import operator
import pickle
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rosafe
import rosafe.plugin
from rosafe.interface import KINDS
from rosafe.localization import model_cache
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.scene import SceneRenderer
from rosafe.localization.scene_file import read_scene
from rosafe.representations import STAGES
from tests.localization.test_head import write_sofa
from tests.models import random_model
from tests.plugins.stages import FACTOR, FRAMED, HEAD
from tests.plugins.support import python
from tests.representations.chain import Chain

Calls = list[Callable[[Any], Any]]
RATE = 16000
FEW: dict[str, Any] = {"fb_nChannels": 8, "pi_rangeHz": [150.0, 400.0]}
SOUND = 0.1 * np.random.default_rng(3).standard_normal((2, RATE))
PARTS = [SOUND[:, :5003], SOUND[:, 5003:9000], SOUND[:, 9000:]]
OTHER: dict[str, dict[str, Any]] = {  # parameters with other filters and states than the defaults
    "drnl": {"fb_type": "drnl", "fb_lowFreqHz": 100.0, "fb_highFreqHz": 4000.0, "adpt_model": "adt_dau"},
    "gain control": {"pp_bNormalizeRMS": True, "pp_bRemoveDC": True, "pp_bMiddleEarFiltering": True},
    "long": {"fb_nChannels": 16, "rm_wSizeSec": 0.2, "rm_hSizeSec": 0.25, "ild_wSizeSec": 0.4, "ams_fbType": "log"},
}


def _out_of_band(original: Any) -> Any:
    """Return the copy that Dask and joblib make: arrays are views of memory that cannot be written."""
    buffers: list[pickle.PickleBuffer] = []
    data = pickle.dumps(original, 5, buffer_callback=buffers.append)
    return pickle.loads(data, buffers=[bytes(buffer) for buffer in buffers])


WAYS: dict[str, Callable[[Any], Any]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda original: pickle.loads(pickle.dumps(original)),
    "out of band": _out_of_band,
}
of_each_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)


def _same(got: Any, expected: Any) -> None:
    if isinstance(expected, dict):
        assert got.keys() == expected.keys()
        got, expected = list(got.values()), list(expected.values())
    if isinstance(expected, (list, tuple)):
        for one, other in zip(got, expected, strict=True):
            _same(one, other)
    else:
        np.testing.assert_array_equal(got, expected)


def _stream(parameters: dict[str, Any], kinds: Any = tuple(KINDS)) -> rosafe.Stream:
    return rosafe.Stream(RATE, {**FEW, **parameters}, list(kinds))


def _other(name: str, folder: Path) -> rosafe.Stream:
    return _stream(OTHER[name])


def _model() -> DirectionModel:
    return random_model(4, np.random.default_rng(4))


def _scene(folder: Path) -> SceneRenderer:
    text = "duration: 2\nsample_rate: 16000\nhead: sphere\nhead_yaw: [[0, 0], [2, 90]]\nnoise: {snr_db: 10}\n"
    text += "sources:\n  - {name: one, signal: noise, azimuth: 30}\n"
    (folder / "scene.yaml").write_text(text)
    return SceneRenderer(read_scene(folder / "scene.yaml"))


# Objects with a state, and the arguments of successive calls
PROCESS: Calls = [operator.methodcaller("process", part) for part in PARTS]
CHANNELS = np.random.default_rng(5).standard_normal((3, 2, 8, 2000))
STATEFUL: dict[str, tuple[Callable[[Path], Any], Calls]] = {
    "Stream": (lambda folder: _stream({}), PROCESS),
    **{name: (functools.partial(_other, name), PROCESS) for name in OTHER},
    "Stream of one ear": (
        lambda folder: _stream({}, ["ratemap", "pitch"]),
        [operator.methodcaller("process", part[0]) for part in PARTS],
    ),
    "stages": (lambda folder: Chain(RATE, KINDS, FEW), [operator.methodcaller("process", part) for part in PARTS]),
    "Localizer": (lambda folder: rosafe.Localizer(RATE, _model()), PROCESS),
    "Resynthesizer": (
        lambda folder: rosafe.Resynthesizer(RATE, {"fb_nChannels": 8}),
        [operator.methodcaller("process", part) for part in CHANNELS],
    ),
    "SceneRenderer": (_scene, [operator.methodcaller("frames", count) for count in (5000, 3000, 9000)]),
}


@of_each_way
@pytest.mark.parametrize("name", STATEFUL)
def test_a_copy_and_its_original_continue_independently(tmp_path: Path, name: str, way: Callable[[Any], Any]) -> None:
    if name == "stages" and way is copy.copy:
        pytest.skip("a shallow copy of a stage shares its state")
    make, (first, second, third) = STATEFUL[name]
    reference, original, unused = make(tmp_path), make(tmp_path), way(make(tmp_path))
    _same(first(unused), first(reference))
    first(original)
    ahead, behind = way(original), way(original)
    expected = [second(reference), third(reference)]
    _same(second(ahead), expected[0])
    _same(second(original), expected[0])
    _same(third(original), expected[1])
    _same(third(ahead), expected[1])
    del original, ahead
    held = [np.full(10_000, np.nan) for _ in range(200)]  # takes memory that was released
    _same(second(behind), expected[0])
    again = way(behind)
    del behind
    _same(third(again), expected[1])
    assert len(held) == 200


def test_copies_of_a_localizer_have_tracks_of_their_own() -> None:
    localizer = rosafe.Localizer(RATE, _model())
    localizer.process(SOUND)
    for way in WAYS.values():
        other = way(localizer)
        assert str(other.tracks) == str(localizer.tracks)
        other.reset()
        assert not other.sources and localizer._count


# --- other processes ---


@pytest.fixture(scope="module", params=["spawn", "fork"])
def workers(request: pytest.FixtureRequest) -> Iterator[ProcessPoolExecutor]:
    context = multiprocessing.get_context(request.param)
    with ProcessPoolExecutor(1, context) as pool:
        yield pool


@pytest.mark.parametrize("name", STATEFUL)
def test_a_used_object_continues_in_another_process(tmp_path: Path, name: str, workers: ProcessPoolExecutor) -> None:
    make, (first, second, _) = STATEFUL[name]
    original = make(tmp_path)
    first(original)
    got = workers.submit(second, original)
    _same(got.result(60), second(original))


HEAD_CALLS: Calls = [
    operator.methodcaller("render", SOUND[0], RATE, 40.0),
    operator.methodcaller("ild", [500.0, 3000.0]),
]
RESULT = rosafe.process(SOUND, RATE, parameters={"fb_nChannels": 4}, outputs=["ild", "gammatone"])
PUBLIC: dict[str, tuple[Callable[[Path], Any], Calls]] = {
    "sphere": (lambda folder: rosafe.Head.sphere(), HEAD_CALLS),
    "head": (lambda folder: rosafe.Head.from_sofa(write_sofa(folder / "head.sofa")), HEAD_CALLS),
    "Result": (
        lambda folder: RESULT,
        [operator.attrgetter("parameters"), operator.itemgetter("ild"), rosafe.resynthesize],
    ),
    "DirectionModel": (lambda folder: _model(), [operator.attrgetter("itd_table"), operator.attrgetter("parameters")]),
}


@pytest.mark.parametrize("name", PUBLIC)
def test_public_objects_in_workers(tmp_path: Path, name: str, workers: ProcessPoolExecutor) -> None:
    make, calls = PUBLIC[name]
    original = make(tmp_path)
    for call in calls:
        expected = call(original)
        _same(workers.submit(call, original).result(60), expected)
        for way in WAYS.values():
            _same(call(way(original)), expected)


def test_functions_in_workers(workers: ProcessPoolExecutor) -> None:
    rosafe.process(SOUND, RATE, outputs="ild")  # a fork has the state of its parent
    got = workers.submit(rosafe.process, SOUND, RATE, outputs=["ild", "gammatone"], parameters={"fb_nChannels": 4})
    _same(got.result(60), RESULT)


def test_declarations() -> None:
    names = [getattr(rosafe.plugin, name) for name in rosafe.plugin.__all__]
    for one in (KINDS, rosafe.PRESETS, STAGES, names):
        assert pickle.loads(pickle.dumps(one)) == one


# --- heads ---


def test_copies_of_a_head_share_its_models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null/none")
    model = _model()
    monkeypatch.setattr(model_cache, "learn_head", lambda *_: model)
    head = rosafe.Head.from_sofa(write_sofa(tmp_path / "head.sofa"))
    assert model_cache.model_of(head, RATE, None) is model
    monkeypatch.setattr(model_cache, "learn_head", lambda *_: pytest.fail("learned again"))
    for way in WAYS.values():
        other = way(head)
        assert other.key == head.key and model_cache.model_of(other, RATE, None) is model
    del head
    assert model_cache.model_of(way(other), RATE, None) is model


def test_filters_of_a_head_in_threads() -> None:
    """Each thread gets the filters of its sample rate; a head that is not used is released at once."""
    head = rosafe.Head("test", np.arange(-150.0, 181.0, 30.0), SOUND[:, :768].reshape(12, 2, 64), 44100.0)
    rates = [8000.0 + 1000 * number for number in range(7)]
    expected = {rate: copy.copy(head).filters(rate).responses for rate in rates}
    with ThreadPoolExecutor(8) as pool:
        for rate, got in zip(rates * 20, pool.map(head.filters, rates * 20), strict=True):
            np.testing.assert_array_equal(got.responses, expected[rate])
    assert head.filters(8000) is head.filters(8000.0)
    released = weakref.ref(head)
    del head
    assert released() is None


# --- plugins ---

PLUGIN = f"""{HEAD}
import threading
from rosafe.plugin import variant
from rosafe.representations.ratemap import Ratemap
{FRAMED.format(parameters=FACTOR, declared="")}
Other = variant(Ratemap, "slow", "slow", slow_decaySec=0.1)


class Locked(Stage):
    REPRESENTATION = Representation(kind="locked", doc="It", parent="ratemap", axes=("ear", "channel", "time"))

    def process(self, block, extra=None):
        self.lock = threading.Lock()
        return block * 2
"""
BEGIN = """
import copy, pickle, numpy as np, rosafe
sound = np.random.default_rng(3).standard_normal((2, 9000))
stream = rosafe.Stream(16000, {"fb_nChannels": 4}, ["mine", "slow"])
stream.process(sound[:, :4001])
first, second = copy.copy(stream), copy.deepcopy(stream)
expected = first.process(sound[:, 4001:])
assert all(map(np.array_equal, second.process(sound[:, 4001:]).values(), expected.values()))
open("PATH", "wb").write(pickle.dumps((stream, stream._stages["slow"], expected)))
locked = rosafe.Stream(16000, outputs=["locked"])
copy.deepcopy(locked)
locked.process(sound)
for way in (copy.copy, copy.deepcopy, pickle.dumps):
    try:
        way(locked)
    except TypeError as problem:
        assert "lock" in str(problem) and "\\n" not in str(problem)
    else:
        raise AssertionError(way)
"""
CONTINUE = """
import pickle, numpy as np
stream, stage, expected = pickle.load(open("PATH", "rb"))
sound = np.random.default_rng(3).standard_normal((2, 9000))
got = stream.process(sound[:, 4001:])
assert all(map(np.array_equal, got.values(), expected.values())) and len(expected) == 4
assert type(stage) is type(stream._stages["slow"])
"""


def test_plugins_in_another_process(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(PLUGIN)
    for code in (BEGIN, CONTINUE):
        done = python(code.replace("PATH", str(tmp_path / "data")), tmp_path)
        assert done.returncode == 0, done.stderr
