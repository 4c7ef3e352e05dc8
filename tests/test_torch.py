"""`rosafe.torch`: the numbers of `rosafe.process`, gradients, learned values, copies, and errors."""

from __future__ import annotations

import copy
import importlib.util
import io
import pickle
import resource
import subprocess
import sys
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.representations.haircell import METHODS
from tests.harness import PYTHON, ROOT

sys.path.insert(0, "/usr/local/lib/rosafe/torch")  # where scripts/install --tests installs it
sys.modules.pop("typing_extensions", None)  # Debian's is too old for it
if not importlib.util.find_spec("torch"):
    pytest.skip("PyTorch is not installed: scripts/install --tests, or pip install torch", allow_module_level=True)
import torch  # noqa: E402

from rosafe.torch import (  # noqa: E402
    CHUNK,
    CrossCorrelation,
    FrontEnd,
    Gammatone,
    InnerHairCell,
    InterauralLevelDifference,
    PreProcessing,
    Ratemap,
)

KINDS = ("input", "preProc", "gammatone", "ihc", "ratemap", "ild", "crossCorrelation")
LEARN = ("fb_cfHz", "fb_bwERBs", "rm_decaySec")
SMALL = {"fb_nChannels": 2, "rm_wSizeSec": 0.002, "rm_hSizeSec": 0.001, "ild_wSizeSec": 0.002, "cc_wSizeSec": 0.002}


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", category=UserWarning)  # of `rosafe.process`, about sounds without a frame


def random_parameters(rng: np.random.Generator, rate: int) -> dict[str, Any]:
    windows = ("hamming", "hanning", "hann", "blackman", "triang", "sqrt_win")
    return {
        "in_doNormalize": bool(rng.integers(2)),
        "in_normalizeValue": int(rng.integers(1, 9)),
        "pp_bRemoveDC": bool(rng.integers(2)),
        "pp_cutoffHzDC": rng.uniform(1, 100),
        "pp_bPreEmphasis": bool(rng.integers(2)),
        "pp_bNormalizeRMS": bool(rng.integers(2)),
        "pp_intTimeSecRMS": rng.uniform(0.01, 3),
        "pp_bLevelScaling": bool(rng.integers(2)),
        "pp_refSPLdB": rng.uniform(70, 110),
        "pp_bMiddleEarFiltering": bool(rng.integers(2)),
        "pp_middleEarModel": str(rng.choice(["jepsen", "lopezpoveda"])),
        "fb_nChannels": int(rng.integers(1, 16)),
        "fb_lowFreqHz": rng.uniform(30, 300),
        "fb_highFreqHz": rng.uniform(0.2, 0.45) * rate,
        "fb_nGamma": int(rng.integers(1, 9)),
        "fb_bwERBs": rng.uniform(0.3, 3),
        "ihc_method": str(rng.choice([method for method in METHODS if method != "none"])),
        "rm_decaySec": 10 ** rng.uniform(-4, 1),
        "rm_scaling": str(rng.choice(["power", "magnitude"])),
        "rm_wSizeSec": rng.uniform(0.005, 0.05),
        "rm_hSizeSec": rng.uniform(0.002, 0.06),
        "ild_wname": str(rng.choice(windows)),
        "ild_wSizeSec": rng.uniform(0.005, 0.05),
        "cc_wname": str(rng.choice(windows)),
        "cc_maxDelaySec": rng.uniform(0.0003, 0.03),
    }


@pytest.mark.parametrize("seed", range(8))
def test_the_numbers_are_those_of_process(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rate = int(rng.choice([8000, 16000, 22050, 44100, 48000]))
    parameters = random_parameters(rng, rate) if seed else {}
    count = (2 * rate, rate // 2, 10, CHUNK, 13000, 5 * CHUNK + 1, 300, rate)[seed]
    sound = 0.1 * rng.standard_normal((2, count))
    sound[:, : int(rng.uniform(0, 0.4) * count)] = 0
    sound[:, int(rng.uniform(0.6, 1) * count) :] = 0
    expected = rosafe.process(sound, rate, parameters=parameters, outputs=KINDS)
    front = FrontEnd(rate, parameters, KINDS)
    for dtype, tolerance in ((torch.float64, 1e-10), (torch.float32, 1e-4)):
        found = front(torch.tensor(np.stack((sound[::-1], sound)), dtype=dtype))
        for kind in KINDS:
            assert found[kind].dtype == dtype and found[kind].shape[1:] == expected[kind].shape
            error = np.abs(found[kind][1].numpy() - expected[kind]).max(initial=0)
            assert error <= tolerance * np.abs(expected[kind]).max(initial=0), (kind, dtype, parameters)


def test_a_gain_control_of_less_than_a_sample() -> None:
    values = {"pp_bNormalizeRMS": True, "pp_intTimeSecRMS": 1e-9}
    sound = np.random.default_rng(1).standard_normal((2, 500))
    expected = rosafe.process(sound, 16000, parameters=values, outputs="preProc")["preProc"]
    found = PreProcessing(16000, values)(torch.tensor(sound)[None])[0].numpy()
    assert np.abs(found - expected).max() <= 1e-10 * np.abs(expected).max()


def test_one_ear_and_low_precision() -> None:
    sound = np.random.default_rng(1).standard_normal((3, 4000))
    expected = np.stack([rosafe.process(one, 16000, outputs="ratemap")["ratemap"] for one in sound])
    front = FrontEnd(16000)
    assert np.abs(front(torch.tensor(sound))["ratemap"].numpy() - expected).max() <= 1e-10 * expected.max()
    half = torch.tensor(sound).bfloat16()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = front(half)["ratemap"]
    assert found.dtype == torch.float32 and torch.equal(found, front(half.float())["ratemap"])


def test_empty_batches_and_sounds() -> None:
    steps = dict.fromkeys(("pp_bRemoveDC", "pp_bPreEmphasis", "pp_bNormalizeRMS", "pp_bMiddleEarFiltering"), True)
    for values in ({}, steps):
        front = FrontEnd(16000, values, KINDS)
        expected = {kind: found.shape[1:] for kind, found in front(torch.zeros(1, 2, 900)).items()}
        assert {kind: found.shape[1:] for kind, found in front(torch.zeros(0, 2, 900)).items()} == expected
        assert all(found.shape == (1, *expected[kind][:-1], 0) for kind, found in front(torch.zeros(1, 2, 0)).items())


def test_long_decays_and_middle_ear_of_long_sounds() -> None:
    sound = 0.1 * np.random.default_rng(1).standard_normal((2, 20 * 48000))
    values = {"fb_cfHz": [500.0], "rm_decaySec": 100.0, "pp_bMiddleEarFiltering": True}
    expected = rosafe.process(sound, 48000, parameters=values, outputs="ratemap")["ratemap"]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for dtype, tolerance in ((torch.float64, 1e-10), (torch.float32, 1e-4)):
        found = FrontEnd(48000, values)(torch.tensor(sound, dtype=dtype)[None])["ratemap"][0].numpy()
        assert np.abs(found - expected).max() <= tolerance * expected.max()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1e6  # kB; a copy for each tap has 8 GB


def test_layers_one_by_one_are_the_front_end() -> None:
    values = {**SMALL, "ihc_method": "bernstein", "pp_bRemoveDC": True}
    sound = torch.randn(2, 2, 2000, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    expected = FrontEnd(16000, values, KINDS)(sound)
    motion, envelope = Gammatone(16000, values)(PreProcessing(16000, values)(sound), envelope=True)
    firing = InnerHairCell(16000, values)(motion, envelope)
    assert torch.equal(firing, expected["ihc"])
    for kind, layer in (
        ("ratemap", Ratemap),
        ("ild", InterauralLevelDifference),
        ("crossCorrelation", CrossCorrelation),
    ):
        assert torch.equal(layer(16000, values)(firing), expected[kind])


@pytest.mark.parametrize("method", METHODS)
def test_gradients_of_sound_and_learned_parameters(method: str) -> None:
    front = FrontEnd(16000, {**SMALL, "ihc_method": method}, ("ratemap", "ild", "crossCorrelation"), learn=LEARN)
    names = [name for name, _ in front.named_parameters()]
    assert names == ["gammatone.fb_cfHz", "gammatone.fb_bwERBs", "ratemap.rm_decaySec"]
    sound = 0.1 * torch.randn(1, 2, 90, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def outputs(sound: Any, *values: Any) -> tuple[Any, ...]:
        of_call = dict(zip(names, values, strict=True))
        return tuple(torch.func.functional_call(front, of_call, (sound,)).values())

    values = [value.detach().clone().requires_grad_() for value in front.parameters()]
    assert torch.autograd.gradcheck(outputs, (sound.requires_grad_(), *values), fast_mode=True, atol=1e-5)


def test_gradients_of_preprocessing_and_of_silence() -> None:
    steps = ("pp_bRemoveDC", "pp_bPreEmphasis", "pp_bNormalizeRMS", "pp_bMiddleEarFiltering")
    layer = PreProcessing(16000, {**dict.fromkeys(steps, True), "pp_intTimeSecRMS": 0.002})
    sound = torch.randn(1, 2, 80, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    assert torch.autograd.gradcheck(layer, (sound,), fast_mode=True)
    for method in METHODS:
        front = FrontEnd(16000, {**SMALL, "ihc_method": method, **dict.fromkeys(steps, True)}, KINDS, learn=LEARN)
        silence = torch.zeros(1, 2, 400, requires_grad=True)
        sum(output.sum() for output in front(silence).values()).backward()
        assert torch.isfinite(silence.grad).all()
        assert all(torch.isfinite(value.grad).all() for value in front.parameters())


def test_learned_values_are_carried_to_process_and_stay_in_their_ranges() -> None:
    front = FrontEnd(16000, {"fb_nChannels": 6, "ihc_method": "dau1996"}, learn=LEARN)
    sound = 0.1 * torch.randn(4, 2, 3000, generator=torch.Generator().manual_seed(1))
    optimizer = torch.optim.SGD(
        [
            {"params": [front.gammatone.fb_cfHz], "lr": 1e8},
            {"params": [front.gammatone.fb_bwERBs], "lr": 10.0},
            {"params": [front.ratemap.rm_decaySec], "lr": 1e-4},
        ]
    )
    before = front.parameters_dict()
    for _ in range(3):
        optimizer.zero_grad()
        (-front(sound)["ratemap"].mean() * 100).backward()
        optimizer.step()
    values = front.parameters_dict()
    assert all(values[name] != before[name] for name in LEARN)
    expected = rosafe.process(sound[1].double().numpy(), 16000, parameters=values, outputs="ratemap")["ratemap"]
    assert np.abs(front(sound.double())["ratemap"][1].detach().numpy() - expected).max() <= 1e-10 * expected.max()
    with torch.no_grad():
        front.gammatone.fb_cfHz[:2] = torch.tensor([-50.0, 9000.0])
        front.gammatone.fb_bwERBs.fill_(-1.0)
        front.ratemap.rm_decaySec.fill_(0.0)
    clamped = front.parameters_dict()
    assert 0 < clamped["fb_cfHz"][0] < 1e-5 and 7999 < clamped["fb_cfHz"][1] < 8000
    front.zero_grad()
    front(sound)["ratemap"].sum().backward()
    assert front.gammatone.fb_bwERBs.grad <= 0 and front.ratemap.rm_decaySec.grad <= 0  # a step leads inwards, or stays
    rosafe.process(sound[1].numpy(), 16000, parameters=clamped, outputs="ratemap")


def test_copies_and_states_are_equal() -> None:
    front = FrontEnd(16000, SMALL, ("ratemap", "ild"), learn=("fb_cfHz",))
    sound = torch.randn(2, 2, 1000, generator=torch.Generator().manual_seed(1))
    file = io.BytesIO()
    torch.save(front.state_dict(), file)
    loaded = FrontEnd(16000, {**SMALL, "fb_lowFreqHz": 300.0}, ("ratemap", "ild"), learn=("fb_cfHz",))
    assert not torch.equal(loaded(sound)["ratemap"], front(sound)["ratemap"])
    loaded.load_state_dict(torch.load(io.BytesIO(file.getvalue())))
    for other in (loaded, copy.deepcopy(front), pickle.loads(pickle.dumps(front))):
        for kind, expected in front(sound).items():
            assert torch.equal(other(sound)[kind], expected)


class Sounds:
    def __init__(self, front: Any) -> None:
        self.front = front

    def __len__(self) -> int:
        return 4

    def __getitem__(self, number: int) -> Any:
        return self.front(torch.full((1, 2, 400), number + 1.0))["ild"].detach()


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_of_a_data_loader(start: str) -> None:
    sounds = Sounds(FrontEnd(16000, SMALL, "ild"))
    loader = torch.utils.data.DataLoader(sounds, num_workers=1, multiprocessing_context=start)
    for number, batch in enumerate(loader):
        assert torch.equal(batch[0], sounds[number])


def test_compiled_graph_is_whole_and_equal() -> None:
    front = FrontEnd(16000, SMALL, ("ratemap", "ild", "crossCorrelation"))
    sound = torch.randn(1, 2, 700, generator=torch.Generator().manual_seed(1))
    compiled = torch.compile(front, backend="eager", fullgraph=True)
    for kind, expected in front(sound).items():
        assert torch.equal(compiled(sound)[kind], expected)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: FrontEnd(16000, {"fb_type": "drnl"}), "fb_type: expected gammatone, got drnl; use rosafe.process"),
        (lambda: FrontEnd(16000, outputs="itd"), "outputs: expected some of input, preProc, .*, got itd"),
        (lambda: FrontEnd(16000, {"fb_nErbs": 1}), "parameters: expected a known parameter, got 'fb_nErbs'; did you"),
        (lambda: FrontEnd(16000, {"fb_bwERBs": -1}), "fb_bwERBs: expected "),
        (lambda: FrontEnd("16000"), "sample_rate: expected a finite number, got '16000'"),  # type: ignore[arg-type]
        (lambda: FrontEnd(16000, learn=5), "learn: expected a sequence of names, got 5"),  # type: ignore[arg-type]
        (lambda: Ratemap(16000, learn="fb_cfHz"), "learn: expected some of rm_decaySec, got 'fb_cfHz'"),
        (lambda: FrontEnd(16, learn="fb_cfHz"), "sample_rate: expected Hz, got 16; did you mean 16000"),
        (lambda: FrontEnd(16000, learn="fb_nERBs"), "learn: expected some of fb_cfHz, .*, got 'fb_nERBs'"),
        (lambda: FrontEnd(16000, outputs="ihc", learn="rm_decaySec"), "learn: .* for these outputs, got 'rm_decaySec'"),
        (lambda: Ratemap(16000, learn=["fb_cfHz"]), "learn: expected some of rm_decaySec, got 'fb_cfHz'"),
        (lambda: FrontEnd(16000)(torch.zeros(1, 3, 10)), r"sound: expected shape .*, got \(1, 3, 10\)"),
        (lambda: FrontEnd(16000)(torch.zeros(1, 2, 10).int()), "sound: expected a tensor of floats, got torch.int32"),
        (lambda: FrontEnd(16000)(np.zeros((1, 2, 10))), "sound: expected a tensor of floats, got ndarray"),
        (lambda: FrontEnd(16000, outputs="ild")(torch.zeros(1, 900)), "sound: expected two ears"),
        (lambda: InnerHairCell(16000, {"ihc_method": "hilbert"})(torch.zeros(1, 1, 2, 9)), "envelope: expected one"),
    ],
)
def test_errors_are_one_line(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}") as caught:
        call()
    assert "\n" not in str(caught.value)


def test_without_torch_one_line_names_the_extra() -> None:
    program = "import sys; sys.modules['torch'] = None\nimport rosafe.torch"
    done = subprocess.run([PYTHON, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.stderr.splitlines()[-1] == (
        "ModuleNotFoundError: rosafe.torch: the Python package torch is not installed; "
        "pip install '.[torch]' in a checkout"
    )
