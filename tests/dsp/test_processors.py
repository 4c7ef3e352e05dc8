"""The kernels on other processors and with the other compiler; test_kernels.py has the inputs for aarch64."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Output
from rosafe.representations import STAGES

from . import foreign
from .bare import FloatArray, single
from .implementations import CLANG, NUMPY, Choice, using
from .test_kernels import RATE, agree, signal

CHANNELS = 9
each_processor = pytest.mark.parametrize("choice", [*foreign.MACHINES, CLANG])


@pytest.fixture(scope="module", autouse=True)
def implementation() -> Iterator[None]:
    """Each test selects the implementation itself; started processes end with the module."""
    yield
    foreign.close_all()


def representations(choice: Choice) -> dict[str, FloatArray]:
    """Return two blocks of each representation that has a kernel, from the filterbank on."""
    made: dict[str, list[FloatArray]] = {}
    bank, cell = STAGES["gammatone"](RATE, fb_nChannels=CHANNELS, fb_highFreqHz=7000.0), STAGES["ihc"](RATE)
    kinds = ("ild", "ratemap", "crossCorrelation", "adaptation", "autocorrelation", "amsFeatures", "precedence")
    stages = {kind: STAGES[kind](RATE) for kind in kinds}
    frames = SignalFormat(
        RATE, 100.0, True, round(RATE / 100), round(RATE / 50), tuple(np.geomspace(80, 7000, CHANNELS))
    )
    with using(choice):
        for block in np.array_split(signal(1, 9000)[:, 0], 2, axis=-1):
            block = np.ascontiguousarray(block)
            filtered = single(bank.process(block))
            inner = single(cell.process(filtered))
            outputs: dict[str, Output] = {"gammatone": filtered, "ihc": inner}
            outputs |= {kind: stage.process(inner) for kind, stage in stages.items()}
            for kind, output in outputs.items():
                parts = output if isinstance(output, tuple) else (output,)
                for number, part in enumerate(parts):
                    made.setdefault(f"{kind} {number}", []).append(part)
        rates = np.abs(signal(CHANNELS, 200))
        for kind in ("spectralFeatures", "gabor"):
            made[kind] = [single(STAGES[kind](frames).process(rates))]
    return {kind: np.concatenate(parts, axis=-1) for kind, parts in made.items()}


@each_processor
def test_every_kernel(choice: Choice) -> None:
    got, expected = representations(choice), representations(NUMPY)
    assert got.keys() == expected.keys()
    assert min(array.shape[-1] for array in got.values()) > 20
    for kind, array in got.items():
        if not kind.startswith("precedence"):  # depends on rounding of such input: test_precedence uses suitable sound
            agree([array], [expected[kind]])


@pytest.mark.parametrize(("machine", "level"), [("aarch64", 8), ("nehalem", 2)])
def test_the_library_reports_its_level(machine: str, level: int) -> None:
    """Also on a processor without AVX: the function has no illegal instruction."""
    assert foreign.running(machine).rosafe_processor_level() == level


@pytest.mark.parametrize("machine", foreign.MACHINES)
def test_denormal_numbers_are_off_until_they_are_restored(machine: str) -> None:
    elsewhere = foreign.running(machine)
    before = elsewhere.rosafe_denormals_off() & 0xFFFFFFFF
    off = elsewhere.rosafe_denormals_off() & 0xFFFFFFFF
    assert off != before
    elsewhere.rosafe_denormals_as(before)
    assert elsewhere.rosafe_denormals_off() & 0xFFFFFFFF == before
    elsewhere.rosafe_denormals_as(before)
