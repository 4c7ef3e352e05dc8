"""Damaged and malicious results: reading returns a mapping or raises ValueError for any content."""

from __future__ import annotations

import json
import math
import os
import shutil
import struct
import subprocess
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import soundfile
from matplotlib.figure import Figure

import rosafe
from rosafe.processing.corpus import write_failed
from rosafe.processing.files import process_file
from rosafe.results import hdf5_reading, isolated, readers
from rosafe.results.view.plot import draw
from rosafe.system.output import OutputError
from tests.harness import PYTHON, ROOT, run_program
from tests.results.damage import VALUES, damaged, forked

RATE = 16000
PARAMETERS = {"fb_cfHz": [200.0, 800.0, 2000.0]}
OUTPUTS = ["ild", "preProc", "spectralFeatures"]
NAMES = ["a.npz", "a.h5"]

pytestmark = pytest.mark.filterwarnings("error")
__all__ = ["forked"]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sound, and results of it in both formats."""
    folder = tmp_path_factory.mktemp("good")
    sound = np.random.default_rng(1).standard_normal((2000, 2)) / 10
    soundfile.write(folder / "sound.wav", sound, RATE)
    for name in NAMES:
        process_file(folder / "sound.wav", folder / name, PARAMETERS, outputs=OUTPUTS)
    return folder


def load(path: Path) -> dict[str, Any] | None:
    """Return the result, or None after a ValueError of one line with the name of the file."""
    try:
        return rosafe.load(path)
    except ValueError as problem:
        text = str(problem)
        assert text.isprintable() and str(path) in text and len(text) < 600 + len(str(path))
    return None


def refused(path: Path, *words: str) -> None:
    with pytest.raises(ValueError) as caught:
        rosafe.load(path)
    text = str(caught.value)
    assert str(path) in text and text.isprintable() and all(word in text for word in words), text


# --- anything -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_random_changes(tmp_path: Path, good: Path, name: str, forked: None) -> None:
    """`ROSAFE_FUZZ` is the number of changes."""
    for seed in range(int(os.environ.get("ROSAFE_FUZZ", "8"))):
        path = damaged(good / name, tmp_path / name, seed)
        loaded = load(path)
        try:
            head = readers.read(path, arrays=False)
        except ValueError:
            head = None
        if loaded is not None and head is not None:
            assert head["axes"].keys() == loaded["axes"].keys(), seed


def _heads() -> Iterator[tuple[str, Any]]:
    heads = ("axes", "units", "parameters", "sample_rate", "block_frames", "channels", "source")
    for name in (*heads, "ild_frameRate", "ild", "ild_time"):
        for value in VALUES:
            yield name, value


def _npz(path: Path, changes: dict[str, Any]) -> None:
    with np.load(path.parent / "a.npz") as file:
        content = {**file, **changes}
    np.savez(path, **{name: value for name, value in content.items() if value is not None})


def _as_saved(value: Any) -> Any:
    return np.array(float(value)) if isinstance(value, float) else np.array(json.dumps(value))


def test_heads(tmp_path: Path, good: Path) -> None:
    """Values of wrong types, in texts and as numbers."""
    shutil.copy(good / "a.npz", tmp_path)
    for name, value in _heads():
        _npz(tmp_path / "b.npz", {name: _as_saved(value)})
        load(tmp_path / "b.npz")


def test_nested_heads(tmp_path: Path, good: Path, forked: None) -> None:
    deep = "[" * 10**5 + "]" * 10**5
    shutil.copy(good / "a.npz", tmp_path)
    _npz(tmp_path / "b.npz", {"axes": np.array(deep)})
    shutil.copy(good / "a.h5", tmp_path / "b.h5")
    with h5py.File(tmp_path / "b.h5", "a") as file:
        file.attrs["axes"] = deep[:60000]
    for extension in readers.READERS:
        refused(tmp_path / f"b{extension}", "nested too deeply" if extension == ".npz" else "")


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_result_is_computed_again(tmp_path: Path, good: Path, name: str, forked: None) -> None:
    for seed in range(6):
        path = damaged(good / name, tmp_path / name, seed)
        try:
            process_file(good / "sound.wav", path, PARAMETERS, outputs=OUTPUTS, resume=True)
        except OutputError as problem:
            assert "\n" not in str(problem)
        else:
            load(path)


def test_non_finite_coordinates(tmp_path: Path, good: Path) -> None:
    loaded = rosafe.load(good / "a.npz")
    for name, value in (("ild", 1e308), ("preProc", -1e200), ("ild_time", math.nan), ("fb_cfHz", math.inf)):
        result = {**loaded, name: np.full_like(loaded[name], value)}
        with pytest.raises(ValueError, match=f"{name}: expected numbers between"):
            draw(Figure(), result, name.removesuffix("_time").replace("fb_cfHz", "ild"))
    result = {**loaded, "ild": np.full_like(loaded["ild"], math.nan)}
    draw(Figure(), result, "ild").savefig(tmp_path / "a.png")


def test_a_list_of_failures_that_is_damaged(tmp_path: Path) -> None:
    (tmp_path / "failed.csv").write_text("input,why\n" + "x" * 200000)
    with pytest.raises(OutputError, match="is not a list of failures"):
        write_failed(tmp_path, [], {"a": "b"})


# --- .npz ---------------------------------------------------------------------------------------------------------


def _npy(header: bytes, data: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


_HEADERS = [
    "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 99999999999, 99999999999), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 0), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
    "{'descr': '<f3', 'fortran_order': False, 'shape': (0,), }",
    "{'descr': '<U1000000', 'fortran_order': False, 'shape': (), }",
    "(" * 4000,
    "-" * 60000,
    "1" * 4000,
    "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "1, " * 70 + "), }",
]


@pytest.mark.parametrize("header", _HEADERS, ids=range(len(_HEADERS)))
def test_headers_of_npy(tmp_path: Path, good: Path, header: str) -> None:
    for name in ("ild", "source"):
        with zipfile.ZipFile(good / "a.npz") as old, zipfile.ZipFile(tmp_path / "a.npz", "w") as new:
            for one in old.namelist():
                new.writestr(one, _npy(header.encode(), bytes(8)) if one == f"{name}.npy" else old.read(one))
        refused(tmp_path / "a.npz")


def test_zip_members(tmp_path: Path, good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unknown compression methods, encrypted members, and large arrays in a small file."""
    content = bytearray((good / "a.npz").read_bytes())
    central = content.rindex(b"PK\x01\x02")
    for at, value in ((central + 10, 99), (central + 10, 12), (central + 8, 1)):
        changed = bytearray(content)
        changed[at] = value
        (tmp_path / "a.npz").write_bytes(changed)
        refused(tmp_path / "a.npz", "stored or deflated, and not encrypted")
    monkeypatch.setattr(isolated, "MAX_SIZE", 2**20)
    monkeypatch.setattr(isolated, "MAX_RATIO", 10)
    np.savez_compressed(tmp_path / "a.npz", ild=np.zeros((3, 10**6)))
    refused(tmp_path / "a.npz", "its arrays: expected less than ")


def test_codes_that_are_no_characters(tmp_path: Path, good: Path) -> None:
    for count in (0, 1):
        header = f"{{'descr': '<U{count}', 'fortran_order': False, 'shape': (), }}".encode()
        with zipfile.ZipFile(good / "a.npz") as old, zipfile.ZipFile(tmp_path / "a.npz", "w") as new:
            for one in old.namelist():
                code = struct.pack("<I", 0x110000) * count
                new.writestr(one, _npy(header, code) if one == "parameters.npy" else old.read(one))
        refused(tmp_path / "a.npz", "expected a text, got invalid character codes" if count else "")


# --- HDF5 ---------------------------------------------------------------------------------------------------------


def _replace(change: Callable[[h5py.File, Path], None]) -> Callable[[h5py.File, Path], None]:
    def changed(file: h5py.File, folder: Path) -> None:
        del file["ild"]
        change(file, folder)

    return changed


def _virtual(file: h5py.File, folder: Path) -> None:
    layout = h5py.VirtualLayout(shape=(3, 10), dtype="f8")
    layout[:] = h5py.VirtualSource(str(folder / "secret.h5"), "a", shape=(3, 10))
    file.create_virtual_dataset("ild", layout)


def _external(file: h5py.File, folder: Path) -> None:
    secret = [(str(folder / "secret"), 0, 240)]
    file.create_dataset("ild", (3, 10), "f8", external=secret)


def _set(name: str, value: Any) -> Callable[[h5py.File, Path], None]:
    def change(file: h5py.File, folder: Path) -> None:
        file[name] = value

    return _replace(change)


def _filtered(file: h5py.File, folder: Path) -> None:
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((3, 10))
    plan.set_filter(32001, h5py.h5z.FLAG_OPTIONAL, (1,))
    h5py.h5d.create(file.id, b"ild", h5py.h5t.NATIVE_DOUBLE, h5py.h5s.create_simple((3, 10)), plan)


def _large(file: h5py.File, folder: Path) -> None:
    file.create_dataset("ild", (3, 10**9), "f8", chunks=(3, 10**6))


def _cut(file: h5py.File, folder: Path) -> None:
    file.create_dataset("ild", (3, 10**7), "f8", chunks=(1, 1))


_H5 = {
    "external storage": _replace(_external),
    "virtual dataset": _replace(_virtual),
    "got a link": _set("ild", h5py.ExternalLink("secret.h5", "/a")),
    "'/': expected an array, got a link": lambda file, folder: file.__setitem__("more", h5py.SoftLink("/")),
    "ild: expected an array; compute": _replace(lambda file, folder: file.create_group("ild")),
    "named type": _set("ild", np.dtype("f8")),
    "ild: expected an array, got an empty dataset": _set("ild", h5py.Empty("f8")),
    "ild: expected an array of real numbers": _set("ild", "a text"),
    "compound": _set("ild", np.zeros(3, [("a", "f8")])),
    "reference": _replace(lambda file, folder: file.__setitem__("ild", file["preProc"].ref)),
    "filter 32001": _replace(_filtered),
    "MiB in a file of": _replace(_large),
    "chunks, got more": _replace(_cut),
}


def test_hdf5_with_references_to_other_files(tmp_path: Path, good: Path, forked: None) -> None:
    (tmp_path / "secret").write_bytes(bytes(240))
    path = tmp_path / "a.h5"
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["a"] = np.zeros((3, 10))
    for words, change in _H5.items():
        shutil.copy(good / "a.h5", path)
        with h5py.File(path, "a", locking=False) as file:
            change(file, tmp_path)
        expected = "" if words in ("named type", "compound", "reference") or words.startswith("'/'") else words
        refused(path, "expected a result of rosafe process, got another or damaged file", expected)
        with pytest.raises(ValueError, match="another or damaged file"):  # without the arrays, too
            readers.read(path, arrays=False)


def test_hdf5_attributes_that_are_references_are_ignored(tmp_path: Path, good: Path, forked: None) -> None:
    shutil.copy(good / "a.h5", tmp_path)
    with h5py.File(tmp_path / "a.h5", "a", locking=False) as file:
        file.attrs["more"] = file["ild"].attrs["more"] = file["ild"].ref
        file["ild"].attrs["region"] = file["ild"].regionref[:1]
    assert rosafe.load(tmp_path / "a.h5").keys() == rosafe.load(good / "a.npz").keys()
    with h5py.File(tmp_path / "a.h5", "a", locking=False) as file:
        file.attrs["axes"] = file["ild"].ref
    refused(tmp_path / "a.h5", "it lacks axes")


def test_hdf5_with_many_large_arrays(tmp_path: Path, good: Path, forked: None) -> None:
    """Each array may be as large as the file permits, but not all together."""
    shutil.copy(good / "a.h5", tmp_path)
    with h5py.File(tmp_path / "a.h5", "a", locking=False) as file:
        for name in ("more", "most"):
            file.create_dataset(name, (isolated.MAX_SIZE // 8,), "f8", chunks=(2**20,))
    refused(tmp_path / "a.h5", "MiB in a file of")


def test_hdf5_cannot_open_other_files(good: Path) -> None:
    program = (
        "import os; from rosafe.results import isolated\n"
        "kept = isolated._h5_file(os.open(os.environ['FILE'], os.O_RDONLY))\n"
        "try: open('/etc/hostname')\nexcept OSError as problem: print(problem.errno)"
    )
    environment = {**os.environ, "FILE": str(good / "a.h5"), "PYTHONPATH": str(ROOT)}
    done = subprocess.run([PYTHON, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "24\n"


@pytest.mark.parametrize(
    "options", [{"compression": "gzip"}, {"compression": "lzf", "shuffle": True}, {"fletcher32": True}]
)
def test_hdf5_compressed_by_other_programs(tmp_path: Path, good: Path, options: dict[str, Any], forked: None) -> None:
    shutil.copy(good / "a.h5", tmp_path)
    expected = rosafe.load(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "a", locking=False) as file:
        del file["preProc"]
        file.create_dataset("preProc", data=expected["preProc"], chunks=(1, 300), **options)
    np.testing.assert_array_equal(rosafe.load(tmp_path / "a.h5")["preProc"], expected["preProc"])


def test_large_arrays_in_blocks(good: Path, forked: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated, "BLOCK", 1000)
    loaded, expected = rosafe.load(good / "a.h5"), rosafe.load(good / "a.npz")
    for output in OUTPUTS:
        np.testing.assert_array_equal(loaded[output], expected[output], strict=True)


# --- the child process --------------------------------------------------------------------------------------------


def _program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    (tmp_path / "program.py").write_text(text)
    monkeypatch.setattr(hdf5_reading, "_PROGRAM", str(tmp_path / "program.py"))


def test_a_library_that_blocks_or_crashes(tmp_path: Path, good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hdf5_reading, "STALL", 1)
    _program(tmp_path, monkeypatch, "import os, signal; os.write(1, b'+'); signal.pause()")
    refused(good / "a.h5", "nothing could be read for 1 s")
    _program(tmp_path, monkeypatch, "import os; os.write(1, b'+'); os.kill(os.getpid(), 11)")
    refused(good / "a.h5", "the library that reads it crashed (SIGSEGV)")
    _program(tmp_path, monkeypatch, "import absent")
    with pytest.raises(OSError, match="cannot be started to read it: ModuleNotFoundError"):
        rosafe.load(good / "a.h5")


def test_memory_of_the_child(tmp_path: Path, good: Path, monkeypatch: pytest.MonkeyPatch, forked: None) -> None:
    """A chunk that is small in the file and larger than the memory of the child process."""
    monkeypatch.setattr(isolated, "MAX_MEMORY", 2**25)
    shutil.copy(good / "a.h5", tmp_path)
    with h5py.File(tmp_path / "a.h5", "a", locking=False) as file:
        file.create_dataset("more", data=np.zeros(2**24), chunks=(2**24,), compression="gzip")
    refused(tmp_path / "a.h5", "")


def test_callers_of_any_kind(tmp_path: Path, good: Path) -> None:
    """Programs without a main guard, threads, and embedded interpreters.

    Modules in the current folder are not imported, and no child process remains.
    """
    for name in ("struct", "json", "resource", "h5py", "site", "sitecustomize"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'marker')!r}, 'w')\n")
    program = f"""
import sys, threading
sys.path[:] = [one for one in sys.path if one] + [{str(ROOT)!r}]
sys.executable = "/usr/bin/octave"
import rosafe
lengths = []  # two threads that print could mix their lines
def read():
    lengths.append(len(rosafe.load({str(good / "a.h5")!r})))
threads = [threading.Thread(target=read) for _ in range(2)]
[one.start() for one in threads]
[one.join() for one in threads]
print(lengths)
import os
try: os.waitpid(-1, os.WNOHANG)
except ChildProcessError: print("none left")
"""
    done = run_program([PYTHON, "-"], input=program, cwd=tmp_path)
    expected = [len(rosafe.load(good / "a.h5"))] * 2
    assert (done.stdout, done.stderr) == (f"{expected}\nnone left\n", "")
    assert not (tmp_path / "marker").exists()
