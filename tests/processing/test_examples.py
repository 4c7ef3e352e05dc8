"""The tutorial and the examples run unchanged, with the described results."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import pytest

import rosafe
from tests import models
from tests.harness import PYTHON, ROOT, SCRIPTS

TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text("utf-8")
EXAMPLES = ROOT / "examples"
TORCH = Path("/usr/local/lib/rosafe/torch")

# In the place of python3-sounddevice: microphones that give three blocks.
SOUNDDEVICE = """
import numpy as np
class InputStream:
    def __init__(self, samplerate, channels, blocksize): self.left = 3
    def __enter__(self): return self
    def __exit__(self, *exception): pass
    active = property(lambda self: self.left > 0)
    def read(self, frames):
        self.left -= 1
        return np.random.default_rng(1).standard_normal((frames, 2)).astype(np.float32) * [1, 2], False
"""


def run(*command: str | Path, cwd: Path, path: str = "") -> str:
    """Return the output of a command."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("ROS_", "PYTHON"))}
    env = {**kept, "PATH": f"{SCRIPTS}:/usr/bin:/bin", "PYTHONPATH": f"{ROOT}:{path}", "MPLBACKEND": "Agg"}
    done = subprocess.run([*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, ""), done
    return done.stdout


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", TUTORIAL, re.MULTILINE | re.DOTALL)


@pytest.fixture(autouse=True)
def _models(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Use models of the head that are learned from less sound than usual."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(models.cache(tmp_path_factory)))


@pytest.fixture
def sphere(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Learn the model for the sample rate of tutorial and examples."""
    models.learn(tmp_path_factory, 16000)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sound of the tutorial."""
    folder = tmp_path_factory.mktemp("tutorial")
    run("sh", "-ec", blocks("sh")[0], cwd=folder)
    return folder


def is_picture(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 20_000


@pytest.mark.exploration
@pytest.mark.usefixtures("sphere")
def test_the_tutorial(folder: Path) -> None:
    pytest.importorskip("xarray", reason="xarray is not here: scripts/install --tests brings it")
    (plot,) = blocks("sh")[1:]
    run("sh", "-ec", plot, cwd=folder)
    said = run(PYTHON, "-c", "\n".join(blocks("python")), cwd=folder)
    azimuths = [float(text) for text in re.findall(r"-?\d+\.\d*", said.split("]")[0])]
    assert min(azimuths) < -30 and max(azimuths) > 30  # both sides
    assert f"16000.0 {rosafe.__version__} 8000.0" in said
    assert "(2, 62, 1000) [(2, 31, 999), (2, 31, 49)]" in said
    assert "expected a known parameter, got 'fb_nChanels'; did you mean fb_nChannels?" in said
    assert "('channel', 'time') Hz" in said and "(32, 1) [9.99]" in said
    assert is_picture(folder / "speech.png") and is_picture(folder / "ears.png")


SAID = {
    "ratemap.py": r"299 frames of 48 channels: ratemap.png",
    "localize.py": r"1 s:  \+[234]\d degrees, confidence .*\n(.*\n)+source 1: .*",
    "enhance.py": r"mixture   \+1\.\d \+1\d\.\d\nenhanced  \+[5-9]\.\d \+1\d\.\d\n",
    "pitch.py": r"0.25 s: 1[67]\d Hz\n(.*\n)+1.75 s: 2[78]\d Hz",
    "stream_wav.py": r"  9.990 s: right ear .* dB$",
    "stream_microphones.py": r"(right ear  \+[56]\.\d dB\n){3}",
    "train.py": r"step 0: loss \d.*\nright: \d.* of 64 new sounds\nlearned.*\nlargest difference .*: \d\.\de-1[2-6]\n",
    "features.py": r"loudest channel: .* Hz\nright ear: .* dB\n",
}


ALWAYS = ("enhance.py", "localize.py", "ratemap.py", "stream_microphones.py")  # the others only in long runs


@pytest.mark.usefixtures("sphere")
@pytest.mark.parametrize(
    "name",
    [
        name if name in ALWAYS else pytest.param(name, marks=pytest.mark.exploration)
        for name in sorted(path.name for path in EXAMPLES.glob("*.py"))
        if name != "speech_to_text.py"  # a node: tests/ros1/localizer
    ],
)
def test_an_example(name: str, folder: Path, tmp_path: Path) -> None:
    if name == "features.py":
        pytest.importorskip("xarray", reason="xarray is not here: scripts/install --tests brings it")
    if name == "train.py" and not (TORCH / "torch").exists():
        pytest.skip("PyTorch is not here: scripts/install --tests brings it where pip has a build for processors")
    (tmp_path / "sounddevice.py").write_text(SOUNDDEVICE)
    arguments: dict[str, list[str | Path]] = {"stream_wav.py": [folder / "speech.wav"], "train.py": ["3"]}
    said = run(PYTHON, EXAMPLES / name, *arguments.get(name, []), cwd=tmp_path, path=f"{tmp_path}:{TORCH}")
    assert re.search(SAID[name], said), said
    if name == "ratemap.py":
        assert is_picture(tmp_path / "ratemap.png")
    assert f"`{name}`" in TUTORIAL


@pytest.mark.usefixtures("sphere")
def test_the_notebook(tmp_path: Path) -> None:
    """The notebook runs, and contains no outputs."""
    cells = json.loads((EXAMPLES / "two_ears.ipynb").read_text("utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells if "outputs" in cell)
    lines = [
        *code[:-1],
        code[-1].rpartition("\n")[0],
        "print(" + "".join(cells[-1]["source"]).rpartition("\n")[2] + ")",
    ]
    assert float(run(PYTHON, "-c", "\n".join(lines), cwd=tmp_path)) < 1e-9
