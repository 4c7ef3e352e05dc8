"""Damaged and malicious results: reading returns a mapping or raises ValueError for any content."""

from __future__ import annotations

import itertools
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
import scipy.io
import soundfile
from matplotlib.figure import Figure

import rosafe
from rosafe.processing.corpus import write_failed
from rosafe.processing.files import process_file
from rosafe.results import containers, formats, isolated
from rosafe.system.output import OutputError
from rosafe.view.plot import draw
from tests.harness import PYTHON, ROOT
from tests.results.damage import VALUES, damaged, forked

RATE = 16000
PARAMETERS = {"fb_cfHz": [200.0, 800.0, 2000.0]}
OUTPUTS = ["ild", "preProc", "spectralFeatures"]
NAMES = ["a.npz", "a.h5", "a.mat", "b.mat", "a.zarr", "a.csv"]  # b.mat: version 7.3

pytestmark = pytest.mark.filterwarnings("error")
__all__ = ["forked"]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sound, and results of it in all formats."""
    folder = tmp_path_factory.mktemp("good")
    sound = np.random.default_rng(1).standard_normal((2000, 2)) / 10
    soundfile.write(folder / "sound.wav", sound, RATE)
    with pytest.MonkeyPatch.context() as patch:
        for name in NAMES:
            patch.setattr(formats, "MAX_MAT5", 10 if name == "b.mat" else 2**30)
            process_file(folder / "sound.wav", folder / name, PARAMETERS, outputs=_outputs(name))
    return folder


def _outputs(name: str) -> list[str]:
    return ["ild"] if name.endswith(".csv") else OUTPUTS


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
            head = formats.read(formats.format_of(path), path, arrays=False)
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
    lines = (good / "a.csv").read_text().splitlines(keepends=True)
    for name, value in _heads():
        _npz(tmp_path / "b.npz", {name: _as_saved(value)})
        load(tmp_path / "b.npz")
        head = {**json.loads(lines[0].removeprefix("# rosafe ")), name: value}
        head["fixed"] = {**head["fixed"], name: value} if name.startswith("ild") else head["fixed"]
        (tmp_path / "b.csv").write_text("".join([f"# rosafe {json.dumps(head)}\n", *lines[1:]]))
        load(tmp_path / "b.csv")
    head = json.loads(lines[0].removeprefix("# rosafe "))
    for key, value in itertools.product(("rows", "fixed"), [*VALUES, False, 1.0, 10**400]):
        (tmp_path / "b.csv").write_text("".join([f"# rosafe {json.dumps({**head, key: value})}\n", *lines[1:]]))
        load(tmp_path / "b.csv")


def test_nested_heads(tmp_path: Path, good: Path, forked: None) -> None:
    deep = "[" * 10**5 + "]" * 10**5
    shutil.copy(good / "a.npz", tmp_path)
    _npz(tmp_path / "b.npz", {"axes": np.array(deep)})
    (tmp_path / "b.csv").write_text(f"# rosafe {deep}\n")
    shutil.copy(good / "a.h5", tmp_path / "b.h5")
    with h5py.File(tmp_path / "b.h5", "a") as file:
        file.attrs["axes"] = deep[:60000]
    scipy.io.savemat(tmp_path / "b.mat", {"axes": deep})
    shutil.copytree(good / "a.zarr", tmp_path / "b.zarr")
    (tmp_path / "b.zarr" / ".zattrs").write_text(deep)
    for extension in formats.FORMATS:
        refused(tmp_path / f"b{extension}")
    (tmp_path / "b.csv").write_text("# rosafe {}\n")
    refused(tmp_path / "b.csv", "line 1: expected the description of one output")


@pytest.mark.parametrize("name", ["a.npz", "a.zarr"])
def test_a_damaged_result_is_computed_again(tmp_path: Path, good: Path, name: str, forked: None) -> None:
    for seed in range(6):
        path = damaged(good / name, tmp_path / name, seed)
        try:
            process_file(good / "sound.wav", path, PARAMETERS, outputs=_outputs(name), resume=True)
        except OutputError as problem:
            assert "\n" not in str(problem)
        else:
            assert load(path) or not (path / ".zattrs").exists()


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
    "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "1, " * 40 + "), }",
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


# --- .mat of version 5 --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compressed", [False, True])
def test_mat5_as_scipy_reads_it(tmp_path: Path, compressed: bool) -> None:
    values: dict[str, Any] = {
        "a" * 60: np.arange(24.0).reshape(2, 3, 4),
        "empty": np.zeros((3, 0)),
        "small": np.array([[1, 2]], np.uint8),
        "text": "ä€😀" * 40,
        "none": "",
        **{kind: np.array([[3, 4, 5]], kind) for kind in ("int8", "int16", "uint16", "int32", "uint32", "float32")},
    }
    scipy.io.savemat(tmp_path / "a.mat", values, long_field_names=True, do_compression=compressed)
    from rosafe.results.mat5 import _variables

    with open(tmp_path / "a.mat", "rb") as file:
        found = dict(_variables(file, os.fstat(file.fileno()).st_size, True))
    expected = scipy.io.loadmat(tmp_path / "a.mat")
    for name, value in values.items():
        if isinstance(value, str):
            assert found[name] == value
        else:
            np.testing.assert_array_equal(found[name], expected[name], strict=True)


@pytest.mark.parametrize("option", ["-v6", "-v7"])
def test_mat5_written_by_octave(tmp_path: Path, good: Path, option: str) -> None:
    """Octave stores whole numbers as integers, and compresses."""
    program = f"r = load('{good}/a.mat'); save('{option}', '{tmp_path}/a.mat', '-struct', 'r')"
    subprocess.run(["octave-cli", "--no-init-file", "--eval", program], check=True, capture_output=True, timeout=120)
    loaded, expected = rosafe.load(tmp_path / "a.mat"), rosafe.load(good / "a.mat")
    assert loaded.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(loaded[name], value, err_msg=name)


@pytest.mark.parametrize("change", [-1, 1, 2**31 - 1])
def test_mat5_whose_length_does_not_fit_its_shape(tmp_path: Path, good: Path, change: int) -> None:
    found = {k: v for k, v in scipy.io.loadmat(good / "a.mat").items() if not k.startswith("__")}
    scipy.io.savemat(tmp_path / "a.mat", found, long_field_names=True)
    content = bytearray((tmp_path / "a.mat").read_bytes())
    at = content.index(struct.pack("<I", 3 << 16 | 1) + b"ild\0") - 4  # the last length precedes the name
    assert struct.unpack_from("<I", content, at)[0] == found["ild"].shape[1]
    struct.pack_into("<I", content, at, min(found["ild"].shape[1] + change, 2**31 - 1))
    (tmp_path / "a.mat").write_bytes(content)
    refused(tmp_path / "a.mat", "ild", "numbers by its shape, got another length")


def test_mat5_with_other_contents(tmp_path: Path, good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for value in ({"a": 1.0}, np.array([1 + 1j]), np.array([{}], object), scipy.sparse.eye(2)):
        found = {k: v for k, v in scipy.io.loadmat(good / "a.mat").items() if not k.startswith("__")}
        scipy.io.savemat(tmp_path / "a.mat", {**found, "ild": value})
        refused(tmp_path / "a.mat", "expected an array of real numbers")
    monkeypatch.setattr(isolated, "MAX_SIZE", 2**20)
    monkeypatch.setattr(isolated, "MAX_RATIO", 10)
    scipy.io.savemat(tmp_path / "a.mat", {"axes": np.zeros(10**6)}, do_compression=True)
    refused(tmp_path / "a.mat", "its arrays: expected less than ")


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


def _attribute(of: str, value: Callable[[h5py.File], Any]) -> Callable[[h5py.File, Path], None]:
    def change(file: h5py.File, folder: Path) -> None:
        (file[of] if of else file).attrs["more"] = value(file)

    return change


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
    "the file: expected attributes that are numbers or texts": _attribute("", lambda file: file["ild"].ref),
    "ild: expected attributes that are numbers or texts": _attribute("ild", lambda file: file["ild"].ref),
    "expected attributes": _attribute("ild", lambda file: file["ild"].regionref[:1]),
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


@pytest.mark.parametrize("name", ["a.h5", "b.mat"])
def test_hdf5_with_references_to_other_files(tmp_path: Path, good: Path, name: str, forked: None) -> None:
    (tmp_path / "secret").write_bytes(bytes(240))
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["a"] = np.zeros((3, 10))
    for words, change in _H5.items():
        shutil.copy(good / name, tmp_path)
        with h5py.File(tmp_path / name, "a", locking=False) as file:
            change(file, tmp_path)
        expected = "" if words in ("named type", "compound", "reference") or words.startswith("'/'") else words
        refused(tmp_path / name, "expected a result of rosafe process, got another or damaged file", expected)
        with pytest.raises(ValueError, match="another or damaged file"):  # without the arrays, too
            formats.read(formats.format_of(name), tmp_path / name, arrays=False)


def test_hdf5_cannot_open_other_files(good: Path) -> None:
    program = (
        "import os; from rosafe.results import isolated\n"
        "kept = isolated.open_h5(os.open(os.environ['FILE'], os.O_RDONLY))\n"
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


def test_large_arrays_in_blocks(tmp_path: Path, good: Path, forked: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated, "BLOCK", 1000)
    for name in ("a.h5", "b.mat"):
        loaded, expected = rosafe.load(good / name), rosafe.load(good / "a.npz")
        for output in OUTPUTS:
            np.testing.assert_array_equal(loaded[output], expected[output], strict=True)


# --- Zarr ---------------------------------------------------------------------------------------------------------


def _pickled(marker: Path) -> bytes:
    import pickle

    class Harm:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (marker,))

    return pickle.dumps(Harm())


def _edit(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


_ZARRAYS: dict[str, dict[str, Any]] = {
    "pickle": {"compressor": {"id": "pickle"}},
    "filter": {"filters": [{"id": "pickle"}]},
    "objects": {"dtype": "|O", "filters": [{"id": "pickle"}]},
    "no list": {"compressor": [{"id": "pickle"}]},
    "json": {"compressor": {"id": "json2"}},
    "base64": {"compressor": {"id": ["blosc"]}},
    "structure": {"dtype": [["a", "<f8"]]},
    "format": {"zarr_format": 3},
    "chunks": {"chunks": [3, 10**12]},
    "no chunks": {"chunks": [0, 0]},
    "tiny": {"chunks": [1, 1], "shape": [3, 10**9]},
    "shape": {"shape": [3, 10**9], "chunks": [3, 10**6]},
    "negative": {"shape": [3, -1]},
    "words": {"shape": "ab", "chunks": "ab"},
    "axes": {"shape": [1] * 40, "chunks": [1] * 40},
    "fill": {"fill_value": [1]},
    "long fill": {"fill_value": "A" * 1000},
    "order": {"order": "K"},
    "separator": {"dimension_separator": "/"},
}


@pytest.mark.parametrize("case", _ZARRAYS)
def test_zarr_metadata(tmp_path: Path, good: Path, case: str, forked: None) -> None:
    shutil.copytree(good / "a.zarr", tmp_path / "a.zarr")
    array = tmp_path / "a.zarr" / "ild"
    for chunk in array.glob("[0-9]*"):
        chunk.write_bytes(_pickled(tmp_path / "marker"))
    _edit(array / ".zarray", **_ZARRAYS[case])
    refused(tmp_path / "a.zarr", "MiB in a file of" if case == "shape" else "ild")
    shutil.copytree(good / "a.zarr", tmp_path / "b.zarr")  # the same in consolidated metadata
    metadata = json.loads((tmp_path / "b.zarr" / ".zmetadata").read_text())
    metadata["metadata"]["more/.zarray"] = json.loads((array / ".zarray").read_text())
    (tmp_path / "b.zarr" / ".zmetadata").write_text(json.dumps(metadata))
    if case not in ("shape", "fill", "long fill"):
        refused(tmp_path / "b.zarr", "more/.zarray")
    assert not (tmp_path / "marker").exists()


def _nested(root: Path) -> None:
    (root / "group").mkdir()
    (root / "group" / ".zgroup").write_text('{"zarr_format": 2}')
    shutil.copytree(root / "ild", root / "group" / "ild")
    _edit(root / "group" / "ild" / ".zarray", compressor={"id": "pickle"})


def _third(root: Path) -> None:
    codecs = [{"name": "bytes"}, {"name": "numcodecs.pickle", "configuration": {}}]
    (root / "zarr.json").write_text(json.dumps({"zarr_format": 3, "node_type": "group", "attributes": {}}))
    (root / "ild" / "zarr.json").write_text(json.dumps({"zarr_format": 3, "node_type": "array", "codecs": codecs}))


def _third_array(root: Path) -> None:
    (root / "ild" / "zarr.json").write_text(json.dumps({"zarr_format": 3, "node_type": "array"}))


def _link(root: Path, name: str) -> None:
    (root / name).rename(root.parent / "elsewhere")
    (root / name).symlink_to(root.parent / "elsewhere")


def _fifo(root: Path) -> None:
    (root / "ild" / "0.0").unlink()
    os.mkfifo(root / "ild" / "0.0")


_FOLDERS: dict[str, Callable[[Path], Any]] = {
    "group": _nested,
    "format 3": _third,
    "ild: expected an array of format 2": _third_array,
    "'ild'": lambda root: _link(root, "ild"),
    "'0.0'": lambda root: _link(root, "ild/0.0"),
    "'.zattrs'": lambda root: _link(root, ".zattrs"),
    "'.zarray'": lambda root: _link(root, "ild/.zarray"),
    "'.zmetadata'": lambda root: _link(root, ".zmetadata"),
    "'0.0': expected a regular file": _fifo,
    "ild: expected chunks of 2": lambda root: _edit(root / "ild" / ".zarray", compressor=None),
    "'.zattrs': expected at most 1048576 bytes": lambda root: (root / ".zattrs").write_text(" " * 2**21),
    "ild": lambda root: shutil.rmtree(root / "ild"),
}


@pytest.mark.parametrize("words", _FOLDERS)
def test_zarr_folders(tmp_path: Path, good: Path, words: str, forked: None) -> None:
    shutil.copytree(good / "a.zarr", tmp_path / "a.zarr")
    _FOLDERS[words](tmp_path / "a.zarr")
    refused(tmp_path / "a.zarr", words)


@pytest.mark.parametrize("codec", [None, *isolated._CODECS])
def test_zarr_codecs(tmp_path: Path, good: Path, codec: str | None, forked: None) -> None:
    from numcodecs import get_codec

    shutil.copytree(good / "a.zarr", tmp_path / "a.zarr")
    expected = rosafe.load(good / "a.zarr")["preProc"]
    array = tmp_path / "a.zarr" / "preProc"
    encode = get_codec({"id": codec}).encode if codec else bytes
    _edit(array / ".zarray", compressor={"id": codec} if codec else None, order="F", chunks=[2, 1500])
    for index in range(2):
        chunk = np.zeros((2, 1500))
        part = expected[:, 1500 * index : 1500 * (index + 1)]
        chunk[:, : part.shape[1]] = part
        (array / f"0.{index}").write_bytes(encode(np.ascontiguousarray(chunk.T)))
    np.testing.assert_array_equal(rosafe.load(tmp_path / "a.zarr")["preProc"], expected)
    (array / "0.1").unlink()
    assert np.isnan(rosafe.load(tmp_path / "a.zarr")["preProc"][:, 1500:]).all()


# --- the child process --------------------------------------------------------------------------------------------


def _program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    (tmp_path / "program.py").write_text(text)
    monkeypatch.setattr(containers, "_PROGRAM", str(tmp_path / "program.py"))


def test_a_library_that_blocks_or_crashes(tmp_path: Path, good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(containers, "STALL", 1)
    _program(tmp_path, monkeypatch, "import os, signal; os.write(1, b'+'); signal.pause()")
    refused(good / "a.h5", "nothing could be read for 1 s")
    _program(tmp_path, monkeypatch, "import os; os.write(1, b'+'); os.kill(os.getpid(), 11)")
    refused(good / "a.h5", "the library that reads it crashed (SIGSEGV)")
    _program(tmp_path, monkeypatch, "import absent")
    with pytest.raises(OSError, match="cannot be started to read it: ModuleNotFoundError"):
        rosafe.load(good / "a.h5")


def test_memory_of_the_child(tmp_path: Path, good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A chunk with a header that claims 2 GB."""
    from numcodecs import LZ4

    shutil.copytree(good / "a.zarr", tmp_path / "a.zarr")
    array = tmp_path / "a.zarr" / "ild"
    _edit(array / ".zarray", compressor={"id": "lz4"})
    (array / "0.0").write_bytes(struct.pack("<I", 2**31 - 1) + LZ4().encode(b"a")[4:])
    refused(tmp_path / "a.zarr")


def test_callers_of_any_kind(tmp_path: Path, good: Path) -> None:
    """Programs without a main guard, threads, and embedded interpreters.

    Modules in the current folder are not imported, and no child process remains.
    """
    for name in ("struct", "json", "resource", "h5py", "numcodecs", "site", "sitecustomize"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'marker')!r}, 'w')\n")
    program = f"""
import sys, threading
sys.path[:] = [one for one in sys.path if one] + [{str(ROOT)!r}]
sys.executable = "/usr/bin/octave"
import rosafe
def read():
    print(len(rosafe.load({str(good / "a.h5")!r})), len(rosafe.load({str(good / "a.zarr")!r})))
threads = [threading.Thread(target=read) for _ in range(2)]
[one.start() for one in threads]
[one.join() for one in threads]
import os
try: os.waitpid(-1, os.WNOHANG)
except ChildProcessError: print("none left")
"""
    done = subprocess.run(
        [PYTHON, "-"], input=program, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    expected = f"{len(rosafe.load(good / 'a.h5'))} {len(rosafe.load(good / 'a.zarr'))}\n"
    assert (done.stdout, done.stderr) == (expected * 2 + "none left\n", "")
    assert not (tmp_path / "marker").exists()
