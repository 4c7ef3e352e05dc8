"""The npz writer: whatever is appended in whatever order, numpy and zipfile read it; what does not fit is refused."""

from __future__ import annotations

import os
import tempfile
import threading
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.offline.npz import NpzWriter, memory_map

SHAPES = st.lists(st.integers(0, 5), min_size=1, max_size=3)


def write(path: Path, fixed: dict[str, Any], arrays: dict[str, np.ndarray], order: list[tuple[str, int]]) -> None:
    """Write `arrays` piece by piece: each (name, length) takes so many frames of one of them, the rest comes last."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    writer = NpzWriter(descriptor, fixed, {name: array.shape for name, array in arrays.items()})
    at = dict.fromkeys(arrays, 0)
    for name, length in [*order, *((name, array.shape[-1]) for name, array in arrays.items())]:
        writer.append(name, arrays[name][..., at[name] : at[name] + length])
        at[name] = min(at[name] + length, arrays[name].shape[-1])
    size = writer.size
    writer.finish()
    assert os.fstat(descriptor).st_size > size
    os.close(descriptor)


@settings(max_examples=60, deadline=None)
@given(st.lists(SHAPES, min_size=1, max_size=4), st.data())
def test_any_arrays_in_any_pieces(shapes: list[list[int]], data: st.DataObject) -> None:
    random = np.random.default_rng(1)
    arrays = {f"array{index}": random.standard_normal(shape) for index, shape in enumerate(shapes)}
    order = data.draw(st.lists(st.tuples(st.sampled_from(sorted(arrays)), st.integers(0, 3)), max_size=10))
    fixed: dict[str, Any] = {"rate": 44100, "text": "Höhe", "list": np.arange(3.0)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "x.npz")
        write(path, fixed, arrays, order)
        assert zipfile.ZipFile(path).testzip() is None
        with np.load(path) as loaded:
            for name, value in {**fixed, **arrays}.items():
                np.testing.assert_array_equal(loaded[name], value, strict=isinstance(value, np.ndarray))
            assert set(loaded) == {*fixed, *arrays}
        for name, array in memory_map(path).items():
            np.testing.assert_array_equal(array, {**fixed, **arrays}[name])


def test_what_does_not_fit(tmp_path: Path) -> None:
    descriptor = os.open(tmp_path / "x.npz", os.O_RDWR | os.O_CREAT)
    writer = NpzWriter(descriptor, {}, {"a": (2, 10)})
    writer.append("a", np.ones((2, 6)))
    for shape in ((3, 4), (2, 5), (4,), (1, 2, 4)):
        with pytest.raises(ValueError, match="does not fit"):
            writer.append("a", np.zeros(shape))
    with pytest.raises(ValueError, match="64 bytes of it never came"):
        writer.finish()
    writer.append("a", np.ones((2, 4)))
    writer.finish()
    os.close(descriptor)
    with np.load(tmp_path / "x.npz") as loaded:
        np.testing.assert_array_equal(loaded["a"], np.ones((2, 10)))


def test_several_threads(tmp_path: Path) -> None:
    signals = {f"a{n}": np.random.default_rng(n).standard_normal((3, 5000)) for n in range(4)}
    descriptor = os.open(tmp_path / "x.npz", os.O_RDWR | os.O_CREAT)
    writer = NpzWriter(descriptor, {}, {name: signal.shape for name, signal in signals.items()})

    def append(name: str) -> None:
        for at in range(0, 5000, 10):
            writer.append(name, signals[name][:, at : at + 10])

    threads = [threading.Thread(target=append, args=(name,)) for name in signals]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    writer.finish()
    os.close(descriptor)
    with np.load(tmp_path / "x.npz") as loaded:
        for name, signal in signals.items():
            np.testing.assert_array_equal(loaded[name], signal)


def test_data_are_aligned_and_not_read_before_they_are_asked_for(tmp_path: Path) -> None:
    write(tmp_path / "x.npz", {"n": 1}, {"a": np.ones((2, 7)), "longer_name": np.ones((3, 5))}, [])
    mapped = memory_map(tmp_path / "x.npz")
    for name in ("a", "longer_name"):
        assert isinstance(mapped[name], np.memmap)
        assert mapped[name].ctypes.data % 64 == 0
        assert not mapped[name].flags.writeable


def test_memory_map_of_what_numpy_writes(tmp_path: Path) -> None:
    path, array = tmp_path / "x.npz", np.arange(12.0).reshape(3, 4)
    np.savez(path, array=array, fortran=np.asfortranarray(array), none=np.zeros((0, 3)))
    mapped = memory_map(path)
    np.testing.assert_array_equal(mapped["array"], array)
    np.testing.assert_array_equal(mapped["fortran"], array)
    assert mapped["none"].shape == (0, 3)


def test_memory_map_refuses(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    np.savez_compressed(path, a=np.zeros(1000))
    with pytest.raises(ValueError, match="compressed"):
        memory_map(path)
    np.savez(path, a=np.array([{}], object))
    with pytest.raises(ValueError, match="Python objects"):
        memory_map(path)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(zipfile.BadZipFile):
        memory_map(path)
    with pytest.raises(FileNotFoundError):
        memory_map(tmp_path / "y.npz")
