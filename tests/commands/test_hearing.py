"""Options for scientists: clipping, padding, presets, mono files, and warnings of the commands."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import soundfile

import rosafe
from tests.commands.command import rosafe as command
from tests.harness import PYTHON, ROOT, run_program
from tests.packaging.test_lint import TOOLS

RATE = 16000
NOISE = 0.1 * np.random.default_rng(3).standard_normal((RATE, 2))
SMALL = ("--set", "fb_nChannels=4")


@pytest.fixture
def loud(tmp_path: Path) -> int:
    """Write loud.wav, a float file, and return how many of its samples are beyond full scale."""
    sound = (NOISE / np.abs(NOISE).max() * 2.2).astype(np.float32)
    soundfile.write(tmp_path / "loud.wav", sound, RATE, subtype="FLOAT")
    return int(np.count_nonzero(np.abs(sound) > 1))


def test_clipping_is_reported_even_if_quiet(tmp_path: Path, loud: int) -> None:
    text = f"loud.wav: {loud} samples beyond full scale were clipped"
    for arguments in (("process", "loud.wav", "-q"), ("plot", "loud.wav", "--outputs", "input")):
        done = command(*arguments, *SMALL, cwd=tmp_path)
        assert done.returncode == 0 and done.stderr.count(text) == 1 and done.stdout == ""
    assert rosafe.load(tmp_path / "loud.npz").clipped == loud
    for name, options in (("process", ("-q",)), ("plot", ("--outputs", "input"))):
        done = command(name, "loud.wav", "--no-clip", "--force", *options, *SMALL, cwd=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
    assert rosafe.load(tmp_path / "loud.npz").clipped == 0


def test_padding_and_presets(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", NOISE, RATE)
    arguments = ("process", "a.wav", "-q", "--outputs", "pitch,ild", *SMALL)
    done = command(*arguments, "--pad", "--preset", "speech", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    result = rosafe.load(tmp_path / "a.npz")
    assert result["pitch"].shape[-1] == result["ild"].shape[-1] == 100
    assert result.parameters["pi_medianOrder"] == rosafe.PRESETS["speech"]["pi_medianOrder"]
    done = command(*arguments, "pi_medianOrder=1", "--preset", "speech", "--force", cwd=tmp_path)
    assert done.returncode == 0 and rosafe.load(tmp_path / "a.npz").parameters["pi_medianOrder"] == 1
    done = command(*arguments, "--force", cwd=tmp_path)
    assert done.returncode == 0 and done.stderr.count("contains fewer than 3 periods of 80 Hz") == 1
    done = command("process", "a.wav", "--preset", "music", cwd=tmp_path)
    assert done.returncode == 2


def test_mono_and_short_files(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "mono.wav", NOISE[:, 0], RATE)
    soundfile.write(tmp_path / "short.wav", NOISE[:100], RATE)
    assert command("process", "mono.wav", "--outputs", "ratemap", *SMALL, cwd=tmp_path).returncode == 0
    assert rosafe.load(tmp_path / "mono.npz")["ratemap"].shape == (1, 4, 99)
    done = command("process", "mono.wav", "--outputs", "ratemap,ild", "--force", *SMALL, cwd=tmp_path)
    assert done.returncode == 1 and "expected two channels, left and right ear, got 1" in done.stderr
    done = command("process", "short.wav", "-q", *SMALL, cwd=tmp_path)
    assert done.returncode == 0 and "ild, ratemap, crossCorrelation: no frames" in done.stderr
    done = command("process", "short.wav", "-q", "--pad", "--force", *SMALL, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert rosafe.load(tmp_path / "short.npz")["ild"].shape == (4, 1)
    done = command("plot", "short.wav", "--outputs", "ild", *SMALL, cwd=tmp_path)
    assert done.returncode == 0 and done.stderr.endswith("windows that they need; see rosafe process --pad\n")


SCRIPT = """
import numpy as np
import rosafe

sound = np.zeros((2, 16000))
result: rosafe.Result = rosafe.process(sound, 16000, parameters={"fb_nChannels": 8}, outputs=["ild"], pad=True)
axes: dict[str, tuple[str, ...]] = result.axes
rate: float = result.sample_rate
result.save("a.npz")
again: rosafe.Result = rosafe.load("a.npz")
again.plot(["ild"])
data = result.to_xarray()
stream = rosafe.Stream(16000, rosafe.PRESETS["speech"], ["pitch"])
block: dict[str, object] = {**stream.process(sound), **stream.finish()}
stream.modify("rm_decaySec", 0.01)
levels = rosafe.to_db(result["ild"] + 100, reference="max")
slopes = rosafe.deltas(levels)
results: list[rosafe.Result] = rosafe.process_batch([sound], 16000, outputs="ild")
figure = rosafe.plot(result)
print(rosafe.__version__, rosafe.to_xarray(result).attrs)
"""


@pytest.mark.exploration
def test_type_annotations_of_a_users_script(tmp_path: Path) -> None:
    """With mypy --strict, and the package as pip installs it."""
    if not (TOOLS / "mypy").is_dir():
        pytest.skip("mypy is not installed; run scripts/install --tests")
    assert (ROOT / "rosafe" / "py.typed").is_file()
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "installed").mkdir()
    (tmp_path / "installed" / "rosafe").symlink_to(ROOT / "rosafe")
    variables = {**os.environ, "PYTHONPATH": str(TOOLS), "MYPYPATH": str(tmp_path / "installed")}
    ignore = ["--follow-imports=silent", "--ignore-missing-imports"]
    done = run_program([PYTHON, "-m", "mypy", "--strict", *ignore, "script.py"], cwd=tmp_path, env=variables)
    assert done.returncode == 0, done.stdout
