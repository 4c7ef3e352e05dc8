"""SOFA files, models and their cache: files that refer to others, are damaged or large, or belong to other users."""

from __future__ import annotations

import json
import os
import pwd
import resource
import shutil
import subprocess
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import rosafe
from rosafe.localization import angles, cues, direction_model, model_cache
from rosafe.localization import stored_noise as noise
from rosafe.localization.direction_model import TABLES, DirectionModel
from rosafe.system import trust
from tests.harness import PYTHON, ROOT, proc
from tests.localization.test_head import write_sofa
from tests.results.damage import change, forked

MEMORY = 600  # MiB, of which the libraries take 100
__all__ = ["forked"]


def refused(read: Callable[[Path], object], path: Path, *words: str) -> None:
    with pytest.raises(ValueError) as caught:
        read(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and text.isprintable() and all(word in text for word in words), text


# --- SOFA files ---------------------------------------------------------------------------------------------------


def test_a_missing_sofa_file(tmp_path: Path) -> None:
    text = "expected a SOFA file, got a missing file; check the path (Debian's package libmysofa1 has those in "
    refused(rosafe.Head.from_sofa, tmp_path / "none.sofa", text)


def test_sofa_files_that_refer_to_other_files(tmp_path: Path) -> None:
    """A head that is read would make any file that the server may read audible; tests/results has all references."""
    path = write_sofa(tmp_path / "a.sofa")
    with h5py.File(path, "r+") as file, h5py.File(tmp_path / "secret.h5", "w") as other:
        other["a"] = file["Data.IR"][()]
        del file["Data.IR"]
        file["Data.IR"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "/a")
    refused(rosafe.Head.from_sofa, path, "Data.IR: expected an array, got a link")


def test_sofa_files_with_other_objects(tmp_path: Path) -> None:
    """Objects of any type that are not needed do not matter; empty attributes are missing."""
    path = write_sofa(tmp_path / "a.sofa")
    expected = rosafe.Head.from_sofa(path).key
    with h5py.File(path, "r+") as file:
        file["M"] = np.zeros(36, ">f4")
        file["SourcePosition"].dims[0].attach_scale(file["M"])
        file.create_group("group")
        file["text"], file["link"] = "a text", h5py.SoftLink("/M")
        file.attrs["Title"], file.attrs["Organization"] = h5py.Empty("S1"), np.bytes_(b"T\xfc")
        file[b"\xff"], file.attrs[b"\xff"] = 1.0, 2.0  # names that are not UTF-8
        file["ReceiverPosition"].attrs["Type"] = h5py.Empty("S1")
    assert rosafe.Head.from_sofa(path).key == expected


def test_damaged_sofa_files(tmp_path: Path, forked: None) -> None:
    """`ROSAFE_FUZZ` is the number of changes."""
    import random

    good = write_sofa(tmp_path / "good.sofa").read_bytes()
    path = tmp_path / "a.sofa"
    for seed in range(int(os.environ.get("ROSAFE_FUZZ", "20"))):
        path.write_bytes(change(good, random.Random(seed)))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                rosafe.Head.from_sofa(path)
        except ValueError as problem:
            assert str(problem).startswith(f"{path}: ") and str(problem).isprintable()


# --- memory -------------------------------------------------------------------------------------------------------


def _sparse_sofa(path: Path) -> None:
    """Write a valid file of some kB with 720 directions, and responses of 16384 samples that are not stored."""
    azimuths = np.arange(720) / 2

    def large(values: dict[str, Any]) -> None:
        values["Data.IR"] = None
        values["SourcePosition"] = np.stack((azimuths, np.zeros(720), np.ones(720)), 1)

    write_sofa(path, large)
    with h5py.File(path, "r+") as file:
        file.create_dataset("Data.IR", (720, 2, 16384), "f8", chunks=(720, 2, 64), fillvalue=1.0)


def _large_chunks(path: Path) -> None:
    write_sofa(path, lambda values: values.update({"Data.IR": None}))
    with h5py.File(path, "r+") as file:
        shape = (36, 2, 16384)
        file.create_dataset("Data.IR", shape, "f8", chunks=(36, 2, 400_000), maxshape=(36, 2, None), compression="gzip")
        file["Data.IR"][:, :, 0] = 1.0


def _long_texts(path: Path) -> None:
    write_sofa(path)
    with h5py.File(path, "r+") as file:
        file.attrs["many"] = np.full(100, "a" * 1000, h5py.string_dtype())


def _long_response(path: Path) -> None:
    """Write a head at 8 kHz that is 96 times as long at the highest sample rate."""
    count = 180

    def large(values: dict[str, Any]) -> None:
        values["Data.IR"] = np.zeros((count, 2, 16384))
        values["Data.IR"][..., 0] = 1.0
        values["Data.SamplingRate"] = np.array([8000.0])
        values["SourcePosition"] = np.stack((np.arange(count) * 2, np.zeros(count), np.ones(count)), 1)

    write_sofa(path, large)


def _inflating_model(path: Path, channels: int = 128) -> None:
    model = small_model({"fb_nChannels": channels})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in model.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                if name == "description":
                    np.save(member, array)
                else:
                    header = {"descr": "<f2", "fortran_order": False, "shape": (3 * 10**7, 73)}
                    np.lib.format.write_array_header_1_0(member, header)
                    for _ in range(70):
                        member.write(bytes(4 * 2**20))


def _absurd_shape(path: Path) -> None:
    header = b"{'descr': '<f2', 'fortran_order': False, 'shape': (1000000000000, 73), }"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("description", *TABLES):
            archive.writestr(f"{name}.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)


def _fill_values(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("ild", (31, 10**7), "f8", chunks=(31, 10**5), fillvalue=1.0)


def _inflating_npz(path: Path) -> None:
    np.savez_compressed(path, ild=np.zeros((36, 10**6)))


def _sparse_csv(path: Path) -> None:
    with open(path, "wb") as file:
        file.write(b"time_s,head_yaw_deg\n")
        file.truncate(4 << 30)


_BOMBS: dict[str, tuple[Callable[[Path], None], str]] = {
    "sparse.sofa": (_sparse_sofa, "responses of at most 8388608 numbers"),
    "chunks.sofa": (_large_chunks, ""),
    "texts.sofa": (_long_texts, "expected attributes of at most 1 MiB"),
    "long.sofa": (_long_response, "768000 Hz"),
    "inflating.head": (_inflating_model, "expected less than"),
    "inflating.npz": (_inflating_npz, "its arrays: expected less than"),
    "fill.h5": (_fill_values, "its arrays: expected less than"),
    "sparse.csv": (_sparse_csv, "sparse.csv: expected at most 64 MiB"),
    "shape.head": (_absurd_shape, "shape.head: expected a model"),
}


@pytest.mark.parametrize("name", _BOMBS)
def test_small_files_do_not_take_much_memory(tmp_path: Path, name: str) -> None:
    proc()  # has the memory that the process has used
    write, words = _BOMBS[name]
    write(tmp_path / name)
    assert 512 * (tmp_path / name).stat().st_blocks < 10**7 or name == "long.sofa"
    program = (
        "import re, resource, rosafe, sys\n"
        "from rosafe.localization.results import read_yaw\n"
        "read = {\n"
        "    'sofa': lambda path: rosafe.Head.from_sofa(path).filters(768000),\n"
        "    'head': lambda path: rosafe.localize([[0.0] * 8000] * 2, 8000, path),\n"
        "    'csv': read_yaw,\n"
        "}\n"
        "try: print(read.get(sys.argv[1].rpartition('.')[2], rosafe.load)(sys.argv[1]))\n"
        "except ValueError as problem: print(problem)\n"
        "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])\n"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)\n"
    )
    done = subprocess.run(
        [PYTHON, "-c", program, tmp_path / name],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30)),
        check=True,
    )
    *_, text, own, children = done.stdout.splitlines()
    assert words in text and max(int(own), int(children)) < MEMORY * 1024, (text, own, children)


# --- models -------------------------------------------------------------------------------------------------------


def small_model(parameters: dict[str, Any], head: str = "a head") -> dict[str, np.ndarray]:
    """Return the arrays of a model of 8 kHz whose directions are equally likely."""
    described = cues.describe(8000.0, parameters)
    values = {
        "format": "rosafe direction model 3",
        "sample_rate": 8000.0,
        "parameters": cues.model_parameters(described),
        "head": head,
        "is_sphere": True,
        "max_itd": cues.MAX_ITD,
        "level_gain_db": 1.5,
    }
    rows = len(described["fb_cfHz"]) * cues.CLASSES
    tables = {name: np.zeros((rows * bins + 1, len(angles.grid()) + 1), np.float16) for name, bins in TABLES.items()}
    return {"description": np.array(json.dumps(values)), **tables}


def _save(path: Path, arrays: dict[str, Any]) -> Path:
    with open(path, "wb") as file:
        np.savez(file, **{name: value for name, value in arrays.items() if value is not None})
    return path


def _parameter(name: str, value: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda found: found["parameters"].__setitem__(name, value)


def _entry(name: str, value: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda found: found.__setitem__(name, value)


_DESCRIPTIONS: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda found: found["parameters"].clear(), "parameters: expected cc_"),
    (lambda found: found["parameters"].pop("rm_scaling"), "parameters: expected rm_scaling, got none"),
    (lambda found: found.pop("level_gain_db"), "level_gain_db: expected another value, got None"),
    (_parameter("unknown", 1.0), "'unknown'"),
    (_parameter("rm_scaling", "magnitude"), "rm_scaling: expected 'power' for localization, got 'magnitude'"),
    (_parameter("fb_nChannels", 30), "fb_nChannels"),
    (_parameter("fb_nChannels", "31"), "fb_nChannels: expected"),
    (_parameter("fb_cfHz", [100.0, 200.0]), "fb_nChannels: expected 2, got 3"),
    (_parameter("fb_cfHz", [100.0, float("nan")]), "fb_cfHz: expected"),
    (_parameter("cc_wSizeSec", [1]), "cc_wSizeSec: expected"),
    (_parameter("cc_wSizeSec", 1e308), "cc_wSizeSec: expected"),
    (_parameter("cc_hSizeSec", 0.02), "cc_hSizeSec, ild_hSizeSec"),
    (_parameter("pp_refSPLdB", float("nan")), "pp_refSPLdB: expected"),
    (_parameter("rm_decaySec", None), "rm_decaySec: expected"),
    (_entry("parameters", [1]), "parameters: expected another value, got [1]"),
    (_entry("sample_rate", "fast"), "sample_rate: expected another value, got 'fast'"),
    (_entry("sample_rate", 1e9), "sample_rate: expected another value"),
    (_entry("level_gain_db", float("nan")), "level_gain_db: expected another value, got nan"),
    (_entry("level_gain_db", 10**400), "level_gain_db: expected another value"),
    (_entry("is_sphere", "no"), "is_sphere: expected another value"),
    (_entry("format", {"a": 1}), "expected the format"),
]


@pytest.mark.parametrize(("alter", "words"), _DESCRIPTIONS, ids=range(len(_DESCRIPTIONS)))
def test_descriptions_of_models_are_checked(tmp_path: Path, alter: Callable[[Any], Any], words: str) -> None:
    arrays: dict[str, Any] = small_model({"fb_nChannels": 3})
    assert DirectionModel.load(_save(tmp_path / "good.head", arrays)).channels == 3
    description = json.loads(str(arrays["description"]))
    alter(description)
    path = _save(tmp_path / "a.head", {**arrays, "description": np.array(json.dumps(description))})
    refused(DirectionModel.load, path, "expected a model of rosafe head learn", words, "; learn it again")


def _changed(at: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def alter(table: np.ndarray) -> np.ndarray:
        table = table.copy()
        table[at, 3] = value
        return table

    return alter


_TABLES: list[tuple[Callable[[np.ndarray], Any], str]] = [
    (lambda table: table[:-1], "expected the shape"),
    (lambda table: table.T, "expected the shape"),
    (lambda table: np.array(1.0), "expected the shape"),
    (lambda table: table.astype(np.float64), "expected numbers of type float16, got float64"),
    (lambda table: table.astype("U1"), "expected"),
    (lambda table: None, "it lacks itd_table"),
    (_changed(5, np.nan), "expected log-likelihood ratios"),
    (_changed(5, np.inf), "expected log-likelihood ratios"),
    (_changed(5, -np.inf), "expected log-likelihood ratios"),
    (_changed(5, -100.1), "expected log-likelihood ratios"),
    (_changed(5, 60000), "expected log-likelihood ratios"),
    (_changed(-1, 1), "and 0 in the last row"),
]


@pytest.mark.parametrize(("alter", "words"), _TABLES, ids=range(len(_TABLES)))
def test_tables_of_models_are_checked(tmp_path: Path, alter: Callable[[np.ndarray], Any], words: str) -> None:
    arrays: dict[str, Any] = small_model({"fb_nChannels": 3})
    path = _save(tmp_path / "a.head", {**arrays, "itd_table": alter(arrays["itd_table"])})
    refused(DirectionModel.load, path, words)


def test_tables_may_have_the_largest_ratios(tmp_path: Path) -> None:
    arrays: dict[str, Any] = small_model({"fb_nChannels": 3})
    arrays["itd_table"][5, 3:6] = 100, -100, -0.0
    arrays["itd_table"][-1, 3] = -0.0
    model = DirectionModel.load(_save(tmp_path / "a.head", arrays))
    assert (model.itd_table == arrays["itd_table"][:, :-1]).all()


def test_a_model_is_read_again_if_its_file_changes(tmp_path: Path) -> None:
    arrays: dict[str, Any] = small_model({"fb_nChannels": 3})
    path = _save(tmp_path / "a.head", arrays)
    first = DirectionModel.load(path)
    assert DirectionModel.load(path) is first
    arrays["itd_table"][5, 3] = 1
    _save(tmp_path / "b.head", arrays).rename(path)
    assert DirectionModel.load(path).itd_table[5, 3] == 1
    path.unlink()
    refused(DirectionModel.load, path, "got a missing file; check the path, or create it with rosafe head learn")


def test_texts_that_are_no_description(tmp_path: Path) -> None:
    arrays: dict[str, Any] = small_model({"fb_nChannels": 3})
    for text in ("[" * 10**5, "x" * 2**19, "null", "{", "NaN"):
        refused(DirectionModel.load, _save(tmp_path / "a.head", {**arrays, "description": np.array(text)}))


def test_models_of_listed_channels(tmp_path: Path) -> None:
    parameters = {"fb_cfHz": [500.0, 1000.0, 2000.0]}
    path = _save(tmp_path / "a.head", small_model(parameters))
    localizer = rosafe.Localizer(8000, path, parameters=parameters)
    assert localizer.process(np.zeros((2, 8000)))["posterior"].shape == (99, 72)
    (values,) = (cues.model_parameters(cues.describe(8000.0, one)) for one in [localizer.model.parameters])
    assert values == localizer.model.parameters and values["fb_cfHz"] == parameters["fb_cfHz"]


def test_the_number_of_channels_of_a_model_is_limited() -> None:
    with pytest.raises(ValueError, match="fb_nChannels: expected at most 128 for localization, got 129"):
        cues.describe(44100, {"fb_nChannels": 129})


# --- the cache ----------------------------------------------------------------------------------------------------


@pytest.fixture
def learned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Learn small models at once; the list has the name of each head that is learned. The cache is a new folder."""
    heads: list[str] = []

    def learn(head: rosafe.Head, sample_rate: float, *_: Any) -> DirectionModel:
        heads.append(head.name)
        return DirectionModel.load(_save(tmp_path / "learned.head", small_model({"fb_nChannels": 3}, head.key)))

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(model_cache, "learn_head", learn)
    yield heads


def _model() -> DirectionModel:
    """Return the model of a sphere as a new process does, which has read none."""
    direction_model._read.cache_clear()
    return model_cache.model_of(rosafe.Head.sphere(), 8000, {"fb_nChannels": 3})


def _stored(tmp_path: Path) -> Path:
    (path,) = (tmp_path / "cache" / "rosafe").iterdir()
    return path


def test_a_damaged_entry_is_replaced(tmp_path: Path, learned: list[str]) -> None:
    _model()
    path = _stored(tmp_path)
    good = path.read_bytes()
    _model()
    assert len(learned) == 1
    for sample_rate in (8000, 8000.0):
        model_cache.model_of(rosafe.Head.sphere(), sample_rate, {"fb_nChannels": 3})
    assert len(learned) == 1
    for damage in (lambda: path.write_bytes(good[:1000]), lambda: _absurd_shape(path), lambda: _other_head(path)):
        damage()
        count = len(learned)
        _model()
        _model()
        assert len(learned) == count + 1 and path.read_bytes() == good


def _other_head(path: Path) -> None:
    _save(path, small_model({"fb_nChannels": 3}, "another head"))


def test_a_link_named_like_a_model_is_replaced(tmp_path: Path, learned: list[str]) -> None:
    _model()
    path, target = _stored(tmp_path), tmp_path / "target"
    path.rename(target)
    content = target.read_bytes()
    path.symlink_to(target)
    _model()
    assert len(learned) == 2 and not path.is_symlink() and target.read_bytes() == content
    target.write_text("a diary")
    path.unlink()
    path.symlink_to(target)
    _model()
    assert target.read_text() == "a diary" and path.read_bytes() == content


def _of_another_user(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if os.geteuid() == 0:
        os.chown(path, 12345, -1, follow_symlinks=False)
    else:  # all files are of another user then
        monkeypatch.setattr(os, "geteuid", lambda: 54321)
        monkeypatch.setattr(trust, "_PROGRAM", Path("/"))


@pytest.mark.parametrize("part", ["folder", "file", "link", "writable folder", "writable file"])
def test_models_that_other_users_could_have_written_are_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, learned: list[str], part: str
) -> None:
    _model()
    path = _stored(tmp_path)
    changed = path if "file" in part else path.parent
    if part == "link":
        path.parent.rename(tmp_path / "elsewhere")
        path.parent.symlink_to(tmp_path / "elsewhere")
    if "writable" in part:
        changed.chmod(0o777)
    else:
        _of_another_user(changed, monkeypatch)
    before = (path.read_bytes(), path.stat().st_mtime_ns)
    _model()
    assert len(learned) == 2
    if "file" not in part:
        assert (path.read_bytes(), path.stat().st_mtime_ns) == before
        assert noise.default_path() is None


def test_a_cache_that_cannot_be_written_is_ignored(monkeypatch: pytest.MonkeyPatch, learned: list[str]) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null/none")
    assert _model().channels == 3 and len(learned) == 1


def test_without_a_home_there_is_no_cache(monkeypatch: pytest.MonkeyPatch, learned: list[str]) -> None:
    def nobody(_: int) -> Any:
        raise KeyError("uid not found")

    for name in ("XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", nobody)
    _model()
    _model()
    assert len(learned) == 2 and trust.user_cache() is None and noise.default_path() is None


def test_a_noise_calibration_that_is_a_link_is_not_used(tmp_path: Path, learned: list[str]) -> None:
    _model()
    path = _stored(tmp_path).with_name("noise.json")
    assert noise.default_path() == path
    path.symlink_to(tmp_path / "target")
    assert noise.default_path() is None
    shutil.rmtree(path.parent)
