"""Plugins with faults: the check command finds them, and at run time they end with one error with file and line."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import rosafe
from rosafe.dsp.plugin_checks import checked
from rosafe.interface import KINDS
from rosafe.representations import STAGES
from rosafe.testing import check_representation
from tests.harness import PATIENCE, PYTHON, ROOT
from tests.plugins.stages import FAULTS, FRAMED, PLAIN, SAMPLES, Fault, loaded, process, text_of

SOUND = 0.1 * np.random.default_rng(1).standard_normal((2, 8000))
RUN_TIME = [name for name, fault in FAULTS.items() if fault.at_run_time]


@pytest.mark.parametrize("name", FAULTS)
def test_the_check_finds_each_fault(tmp_path: Path, name: str) -> None:
    path = tmp_path / "mine.py"
    path.write_text(text_of(FAULTS[name]))
    with pytest.raises(AssertionError) as caught:
        check_representation(loaded(path), seconds=0.06)
    assert FAULTS[name].expected_text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", [PLAIN, SAMPLES, FRAMED], ids=["rates", "samples", "frames"])
def test_good_ones_pass(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mine.py"
    path.write_text(text_of(Fault(text, "", "")))
    costs = check_representation(loaded(path), seconds=0.06)
    assert next(iter(costs)) == "mine"
    assert min(costs.values()) > 0
    assert set(costs) >= {"gammatone", "precedence"}


@pytest.fixture
def use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Register a plugin with a fault in this process, as the registry does."""

    def install(name: str) -> Path:
        path = tmp_path / "mine.py"
        path.write_text(text_of(FAULTS[name]))
        stage = checked(loaded(path))
        monkeypatch.setitem(STAGES, "mine", stage)
        monkeypatch.setitem(KINDS, "mine", stage.REPRESENTATION)
        return path

    return install


@pytest.mark.parametrize("name", RUN_TIME)
def test_python_raises_an_error_with_kind_and_place(use: Callable[[str], Path], name: str) -> None:
    path = use(name)

    def process() -> None:
        rosafe.process(SOUND, 16000, outputs=["ratemap", "mine"], block_frames=1600)

    def stream() -> None:
        rosafe.Stream(16000, outputs=["ratemap", "mine"]).process(SOUND)

    for run in (process, stream):
        with pytest.raises(ValueError, match=f"plugin mine .{re.escape(str(path))}:[0-9]+") as caught:
            run()
        assert FAULTS[name].expected_text in str(caught.value)


def test_the_command_tries_the_stage(tmp_path: Path) -> None:
    """A plugin that depends on block boundaries; one that ends the process."""
    bad, ends = (tmp_path / f"{name}.py" for name in ("bad", "ends"))
    bad.write_text(text_of(FAULTS["depends on blocks"]))
    ends.write_text(text_of(Fault(PLAIN, process("import os", "os._exit(7)"), "")))
    for path, expected_text in (
        (bad, f"{bad}: mine: the output depends on blocks"),
        (ends, f"{ends}: mine: the process that tested it ended with exit status 7"),
    ):
        command = ["-m", "rosafe.commands", "check", str(path)]
        done = subprocess.run([PYTHON, *command], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
        assert (done.returncode, "Traceback" in done.stderr) == (1, False), done
        assert expected_text in done.stdout


def test_a_variant_of_the_pitch_has_no_pitch_for_silence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its output is that of the pitch: NaN if there is none."""
    path = tmp_path / "mine.py"
    path.write_text(
        "from rosafe.plugin import variant\nfrom rosafe.representations import pitch\n"
        "Mine = variant(pitch.Pitch, 'mine', 'my')\n"
    )
    stage = checked(loaded(path))
    monkeypatch.setitem(STAGES, "mine", stage)
    monkeypatch.setitem(KINDS, "mine", stage.REPRESENTATION)
    result = rosafe.process(np.zeros((2, 8000)), 16000, outputs=["pitch", "mine"])
    assert np.isnan(result["pitch"]).any()
    np.testing.assert_array_equal(result["mine"], result["pitch"])
