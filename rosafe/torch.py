"""The front-end as layers of PyTorch: the numbers of `rosafe.process`, in batches, with gradients.

Recursive filters are computed in chunks of 64 samples, by products of matrices: the response to the samples of a
chunk, and that to the state before it. The states follow from a scan over chunks that doubles its reach at each step.
Unlike with convolution by FFT, rounding errors are relative to the sound at that moment: quiet sounds are exact, too.

Needs PyTorch: ``pip install '.[torch]'`` in a checkout. docs/torch.md shows how to train with these layers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy

from rosafe.declarations.block_length import DEFAULT_FRAMES_PER_BLOCK
from rosafe.declarations.text import short_repr
from rosafe.dsp.erb import BANDWIDTH_SLOPE, MIN_BANDWIDTH
from rosafe.dsp.framing import FramedStage
from rosafe.dsp.gammatone import GammatoneBank
from rosafe.dsp.numeric_limits import EPSILON, TINY
from rosafe.dsp.rounding import round_half_away
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.sos_filter import HighPass
from rosafe.dsp.stage import SAMPLE_RATE, Stage
from rosafe.interface import KINDS
from rosafe.interface.arguments import check_outputs, check_parameters, needed
from rosafe.interface.remarks import rate_advice
from rosafe.processing.stream import create_stages
from rosafe.representations.haircell import COMPRESSION, RECTIFICATION
from rosafe.representations.preproc import Fir, GainControl
from rosafe.system.missing import require

require("torch", "rosafe.torch")
import torch  # noqa: E402
from torch import Tensor  # noqa: E402

LEARNABLE = {"gammatone": ("fb_cfHz", "fb_bwERBs"), "ratemap": ("rm_decaySec",)}
CHUNK = 64  # samples; T below


class _Layer(torch.nn.Module):
    """A stage of the tree as a layer: the parameters are checked, and tables designed, by the stage itself.

    Parameters
    ----------
    sample_rate : float
        In Hz.
    parameters : mapping, optional
        Names and values as in `rosafe.process`; those of stages above have an effect as far as this stage depends on
        them.
    learn : sequence of str, or str
        Parameters that become `torch.nn.Parameter` of the same name and unit, in float64.

    Raises
    ------
    ValueError
        One line that names the parameter, as from `rosafe.process`.
    """

    KIND = ""

    def __init__(
        self, sample_rate: float, parameters: Mapping[str, Any] | None = None, learn: Sequence[str] | str = ()
    ) -> None:
        super().__init__()
        front = _stages(sample_rate, parameters, [self.KIND])
        self._begin(front[self.KIND], _names(learn))

    @classmethod
    def _of(cls, stage: Stage, learn: Sequence[str]) -> Any:
        layer = cls.__new__(cls)
        torch.nn.Module.__init__(layer)
        layer._begin(stage, learn)
        return layer

    def _begin(self, stage: Stage, learn: Sequence[str]) -> None:
        self.sample_rate = stage.sample_rate
        self.learnable = LEARNABLE.get(self.KIND, ())
        self._bounds = {name: _bounds(name, stage) for name in self.learnable}
        for name in learn:
            if name not in self.learnable:
                raise ValueError(
                    f"learn: expected some of {', '.join(self.learnable) or 'no parameters'}, got {short_repr(name)}"
                )
        self._constants = {}
        for name in self.learnable:
            value = torch.tensor(stage.parameters[name], dtype=torch.float64)
            if name in learn:
                self.register_parameter(name, torch.nn.Parameter(value))
            else:
                self._constants[name] = value
        self._design(stage)

    def _design(self, stage: Stage) -> None:
        """Store the tables of a stage."""

    def value(self, name: str) -> Tensor:
        """Return a learnable parameter, within its range, in float64."""
        if name in self._constants:
            return self._constants[name].to(_device_of(self))
        low, high = self._bounds[name]
        return _InRange.apply(getattr(self, name).double(), low, high)

    def learned(self) -> dict[str, Any]:
        """Return the values of the learned parameters, for `rosafe.process` and for the node."""
        names = [name for name in self.learnable if name not in self._constants]
        return {name: self.value(name).detach().cpu().tolist() for name in names}


class _InRange(torch.autograd.Function):
    """Clamping whose gradient is that of the identity, except that it does not lead further out of the range."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, low: float, high: float) -> Tensor:
        ctx.save_for_backward(value)
        ctx.range = low, high
        return value.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (value,) = ctx.saved_tensors
        low, high = ctx.range
        outward = ((value < low) & (gradient > 0)) | ((value > high) & (gradient < 0))
        return gradient.masked_fill(outward, 0.0), None, None


class PreProcessing(_Layer):
    """`preProc` of sound (batch, 2, N) or (batch, N): (batch, ears, N). DC removal to middle ear, as chosen.

    It is computed in float64. Gain control (`pp_bNormalizeRMS`) starts for each ear with its first block of 12000
    samples that is not all zero, as in `rosafe.process` with its default `block_frames`.
    """

    KIND = "preProc"

    def _design(self, stage: Any) -> None:
        self._steps: list[Any] = []
        for step in stage._steps:
            if isinstance(step, HighPass):
                self._steps += [_Recursion.of_pole(*form) for form in step.forms]
            elif isinstance(step, GainControl):
                self._steps.append((step.decay_factor, step.start_samples))
            else:
                taps = step.taps if isinstance(step, Fir) else np.array([1.0, -step.coefficient])
                length = max(CHUNK, len(taps))
                padding = np.zeros(length - 1)
                table = scipy.linalg.toeplitz(np.r_[taps[::-1], padding], np.r_[taps[-1], padding])
                self._steps.append(torch.from_numpy(table))
        self._gain = stage._gain

    def forward(self, sound: Tensor) -> Tensor:
        """Condition sound."""
        samples = _ears(sound)
        if not self._steps or not samples.shape[-1]:
            return samples * self._gain
        done = samples.double()
        with torch.autocast(done.device.type, enabled=False):
            for step in self._steps:
                if isinstance(step, _Recursion):
                    done = step.filter(done)
                elif isinstance(step, tuple):
                    done = _gain_controlled(done, *step)
                else:
                    done = _fir(done, step)
            return (done * self._gain).to(samples.dtype)


class Gammatone(_Layer):
    """`gammatone` of sound (batch, 2, N) or (batch, N): (batch, ears, C, N). `fb_cfHz` and `fb_bwERBs` can be learned.

    The filter is that of `rosafe.dsp.gammatone.GammatoneBank`, a cascade of n equal complex poles p with the gain g.
    """

    KIND = "gammatone"

    def _design(self, stage: Any) -> None:
        if not isinstance(stage._bank, GammatoneBank):
            raise ValueError(f"fb_type: expected gammatone, got {stage.values['fb_type']}; use rosafe.process for it")
        order = int(stage.values["fb_nGamma"])
        rows = np.arange(order)[:, np.newaxis]
        self._ways = torch.from_numpy(scipy.special.comb(rows + np.arange(CHUNK + 1), rows))  # (n, T + 1)

    def recursion(self, quadrature: bool = False) -> _Recursion:
        """Return the filters for the current values; with `quadrature` those of the imaginary part of the output."""
        order = len(self._ways)
        frequencies = self.value("fb_cfHz")[:, None]
        bandwidths = self.value("fb_bwERBs") * (MIN_BANDWIDTH + BANDWIDTH_SLOPE * frequencies)  # Hz
        decays = 2 * math.pi * bandwidths / self.sample_rate
        k = torch.arange(CHUNK + 1, dtype=torch.float64, device=decays.device)
        angles = -2 * math.pi / self.sample_rate * frequencies * k
        powers = torch.stack((torch.cos(angles), torch.sin(angles))) * torch.exp(-decays * k)  # of p: (2, C, T + 1)
        ways = self._ways.to(decays.device)
        gain = -torch.expm1(-decays)[:, :, None]
        gains = gain ** torch.arange(order, dtype=torch.float64, device=decays.device)[:, None]
        # (2, C, n, T): from an input of stage 0 to the output of stage i, k samples later
        responses = gains * gain * (ways[:, :CHUNK] * powers[:, :, None, :CHUNK])
        # (2, C, n, T): from the output of a stage, before the chunk, to that of the stage d further, at sample k
        decaying = gains * (ways[:, :CHUNK] * powers[:, :, None, 1:])
        i, j = torch.tril_indices(order, order)
        step = decaying[..., -1].new_zeros(2, len(frequencies), order, order)
        step[:, :, j, i] = decaying[:, :, i - j, CHUNK - 1]
        (real, imaginary), to_last = step, decaying.flip(2)
        out_real, out_imaginary = (to_last[1], to_last[0]) if quadrature else (to_last[0], -to_last[1])
        return _Recursion(
            2 * responses[int(quadrature), :, -1],
            torch.cat((responses[0], responses[1]), 1).flip(2).transpose(1, 2),
            torch.cat((torch.cat((real, imaginary), 2), torch.cat((-imaginary, real), 2)), 1),
            2 * torch.cat((out_real, out_imaginary), 1),
        )

    def forward(self, sound: Tensor, envelope: bool = False) -> Any:
        """Return the output, and with `envelope` also its envelope, of equal shape."""
        samples = _ears(sound).unsqueeze(-2)
        with torch.autocast(samples.device.type, enabled=False):
            real = self.recursion().filter(samples)
            if not envelope:
                return real
            return real, torch.complex(real, self.recursion(quadrature=True).filter(samples)).abs()


class InnerHairCell(_Layer):
    """`ihc` of the output of `Gammatone`, (batch, ears, C, N) to (batch, ears, C, N), by all methods.

    Subgradients: 0 at the corner of the half-wave and full-wave rectification and where an envelope is 0.
    """

    KIND = "ihc"

    def _design(self, stage: Any) -> None:
        self.method = stage.values["ihc_method"]
        self.needs_envelope = bool(stage.required_extra)
        self._lowpass = [_Recursion.of_section(section) for section in stage._lowpass.sections]

    def _rectify(self, samples: Tensor, envelope: Tensor | None) -> Tensor:
        kind = RECTIFICATION.get(self.method, "none")
        if kind == "compressed" and envelope is not None:
            sounds = envelope >= max(TINY, torch.finfo(envelope.dtype).tiny)
            compressed = torch.where(sounds, envelope, 1.0) ** COMPRESSION * samples
            return torch.relu(torch.where(sounds, compressed, 0.0)).square()
        if envelope is not None:
            return envelope
        functions = {"halfwave": torch.relu, "fullwave": torch.abs, "square": torch.square}
        return functions.get(kind, torch.clone)(samples)

    def forward(self, samples: Tensor, envelope: Tensor | None = None) -> Tensor:
        """Return the firing probability; methods with `needs_envelope` need the envelope of `Gammatone`, too."""
        if self.needs_envelope and envelope is None:
            raise ValueError(f"envelope: expected one for {self.method}, got none; call Gammatone with envelope=True")
        samples = _floats(samples)
        with torch.autocast(samples.device.type, enabled=False):
            output = self._rectify(samples, _floats(envelope) if self.needs_envelope else None)
            for lowpass in self._lowpass:
                output = lowpass.filter(output)
            return output


class _Framed(_Layer):
    """A layer whose output is in frames, the complete ones only."""

    def _design(self, stage: Any) -> None:
        assert isinstance(stage, FramedStage)
        self.window = torch.from_numpy(stage.window.copy())
        self.hop = stage._framing.hop

    def _means(self, samples: Tensor, weights: Tensor) -> Tensor:
        """Return the means (..., F) of the frames of (..., N), weighted."""
        size, hop = len(weights), self.hop
        frames = max(0, (samples.shape[-1] - size) // hop + 1)
        parts = -(-size // hop)
        table = torch.nn.functional.pad(weights / size, (0, parts * hop - size)).reshape(parts, hop).to(samples)
        length = (frames + parts - 1) * hop if frames else 0
        padded = torch.nn.functional.pad(samples[..., :length], (0, max(0, length - samples.shape[-1])))
        sums = padded.unflatten(-1, (length // hop, hop)) @ table.T  # each part of a hop, by each part of the window
        return sum(sums[..., part : part + frames, part] for part in range(parts))


class Ratemap(_Framed):
    """`ratemap` of the output of `InnerHairCell`: (batch, ears, C, F). `rm_decaySec` can be learned."""

    KIND = "ratemap"

    def _design(self, stage: Any) -> None:
        super()._design(stage)
        self._power = stage.values["rm_scaling"] == "power"
        self._weights = self.window**2 if self._power else self.window

    def forward(self, samples: Tensor) -> Tensor:
        """Return the ratemap."""
        samples = _floats(samples)
        with torch.autocast(samples.device.type, enabled=False):
            decay = torch.exp(-1 / (self.sample_rate * self.value("rm_decaySec")))
            # the logarithm of the rounded factor: for long decays, 1 - r is that of `rosafe.process`
            smooth = _leaky_integrator(decay.clamp(min=TINY).log()).filter(samples)
            return self._means(smooth.square() if self._power else smooth, self._weights)


class InterauralLevelDifference(_Framed):
    """`ild` of the output of `InnerHairCell` for two ears: (batch, C, F) in dB."""

    KIND = "ild"

    def forward(self, samples: Tensor) -> Tensor:
        """Return the level of the right ear over the left."""
        samples = _two_ears(samples)
        with torch.autocast(samples.device.type, enabled=False):
            # in float64, as energies can be far below EPSILON
            energies = self._means(samples.square(), self.window**2).double() + EPSILON
            return (10 * torch.log10(energies[:, 1] / energies[:, 0])).to(samples.dtype)


class CrossCorrelation(_Framed):
    """`crossCorrelation` of the output of `InnerHairCell` for two ears: (batch, C, L, F)."""

    KIND = "crossCorrelation"

    def _design(self, stage: Any) -> None:
        super()._design(stage)
        self._max_lag = stage._max_lag
        self._reach = min(self._max_lag, len(self.window) - 1)  # frames do not overlap at longer lags
        self._transform = scipy.fft.next_fast_len(len(self.window) + self._reach, real=True)

    def forward(self, samples: Tensor) -> Tensor:
        """Return the normalised correlations at lags from -M to M samples."""
        samples = _two_ears(samples)
        size = len(self.window)
        count = max(0, (samples.shape[-1] - size) // self.hop + 1)
        if not count or not len(samples):  # MKL transforms no empty batch
            return samples.new_zeros((*samples[:, 0].shape[:-1], 2 * self._max_lag + 1, count))
        reach, transform = self._reach, self._transform
        with torch.autocast(samples.device.type, enabled=False):
            frames = samples.unfold(-1, size, self.hop) * self.window.to(samples)
            energies = frames.double().square().sum(-1)
            left, right = (torch.fft.rfft(frames[:, ear], transform) for ear in (0, 1))
            circular = torch.fft.irfft(left * right.conj(), transform)
            lags = torch.cat((circular[..., transform - reach :], circular[..., : reach + 1]), -1)
            scaled = lags / torch.sqrt(energies[:, 0] * energies[:, 1] + EPSILON)[..., None].to(lags)
            beyond = self._max_lag - reach
            return torch.nn.functional.pad(scaled, (beyond, beyond)).transpose(-1, -2)


_LAYERS: dict[str, type[_Layer]] = {
    layer.KIND: layer
    for layer in (PreProcessing, Gammatone, InnerHairCell, Ratemap, InterauralLevelDifference, CrossCorrelation)
}


class FrontEnd(torch.nn.Module):
    """The chain from sound to representations, as `rosafe.process` for a batch of sounds.

    Parameters
    ----------
    sample_rate : float
        In Hz.
    parameters : mapping, optional
        Names and values as in `rosafe.process`, such as ``{"fb_nChannels": 32}``.
    outputs : sequence of str, or str
        Some of `input`, `preProc`, `gammatone`, `ihc`, `ratemap`, `ild` and `crossCorrelation`.
    learn : sequence of str, or str
        Some of `fb_cfHz` (Hz), `fb_bwERBs` (ERBs) and `rm_decaySec` (s). They become `torch.nn.Parameter` in these
        units, of the layers `gammatone` and `ratemap`: give each a learning rate of its own. Values outside of the
        range of a parameter count as its end.

    Raises
    ------
    ValueError
        One line that names the parameter or output, as from `rosafe.process`.

    Examples
    --------
    >>> front = FrontEnd(16000, {"fb_nChannels": 32}, outputs=("ratemap", "ild"))
    >>> features = front(torch.randn(16, 2, 16000))
    >>> features["ratemap"].shape, features["ild"].shape
    (torch.Size([16, 2, 32, 99]), torch.Size([16, 32, 99]))
    """

    def __init__(
        self,
        sample_rate: float,
        parameters: Mapping[str, Any] | None = None,
        outputs: Sequence[str] | str = ("ratemap",),
        learn: Sequence[str] | str = (),
    ) -> None:
        super().__init__()
        self.outputs = tuple(check_outputs(outputs))
        unknown = [kind for kind in needed(self.outputs) if kind not in _LAYERS and kind != "input"]
        if unknown:
            raise ValueError(f"outputs: expected some of input, {', '.join(_LAYERS)}, got {unknown[-1]}")
        stages = _stages(sample_rate, parameters, self.outputs)
        learn = _names(learn)
        possible = [name for kind in stages for name in LEARNABLE.get(kind, ())]
        for name in learn:
            if name not in possible:
                raise ValueError(
                    f"learn: expected some of {', '.join(possible) or 'nothing'} for these outputs, "
                    f"got {short_repr(name)}"
                )
        self._values = check_parameters(parameters)
        self._divisor = stages["input"]._divisor if self._values.get("in_doNormalize") else 1.0
        for kind, stage in stages.items():
            if kind != "input":
                own = [name for name in learn if name in LEARNABLE.get(kind, ())]
                self.add_module(kind, _LAYERS[kind]._of(stage, own))

    def parameters_dict(self) -> dict[str, Any]:
        """Return the given and the learned values, for `rosafe.process`, `rosafe.Stream` and the node."""
        values = dict(self._values)
        for layer in self.children():
            values.update(layer.learned())
        return values

    def forward(self, sound: Tensor) -> dict[str, Tensor]:
        """Compute the outputs.

        Parameters
        ----------
        sound : Tensor, (batch, 2, N) or (batch, N)
            Floats of any precision, on any device. Less than float32 is computed in float32. Samples are not checked
            for NaN.

        Returns
        -------
        dict of str to Tensor
            Each output with the axes of `rosafe.process` behind the batch; (batch, 1, ...) for one ear.
        """
        samples = _ears(sound) / self._divisor
        found = {"input": samples}
        layers = dict(self.named_children())
        for kind, layer in layers.items():
            if kind == "gammatone" and "ihc" in layers and layers["ihc"].needs_envelope:
                found[kind], envelope = layer(found["preProc"], envelope=True)
            elif kind == "ihc" and layer.needs_envelope:
                found[kind] = layer(found["gammatone"], envelope)
            else:
                found[kind] = layer(found[KINDS[kind].parent])
        return {kind: found[kind] for kind in self.outputs}


class _Recursion:
    """A linear filter, or one for each of C channels, that is computed in chunks of T samples.

    Parameters
    ----------
    response : Tensor, (T,) or (C, T)
        The impulse response.
    to_state : Tensor, (..., T, D)
        From the samples of a chunk to the state after it.
    step : Tensor, (..., D, D)
        From the state before a chunk to that after it.
    from_state : Tensor, (..., D, T)
        From the state before a chunk to its samples.
    """

    def __init__(self, response: Tensor, to_state: Tensor, step: Tensor, from_state: Tensor) -> None:
        lags = torch.arange(CHUNK, device=response.device)
        lags = lags - lags[:, None]  # from each input sample to each output sample
        padded = torch.nn.functional.pad(response, (0, 1))
        self._direct = padded[..., torch.where(lags >= 0, lags, CHUNK)]
        self._to_state, self._step, self._from_state = to_state, step, from_state

    @classmethod
    def of_section(cls, section: np.ndarray) -> _Recursion:
        """Design a section b0, b1, b2, 1, a1, a2 with a pair of complex poles, or with one real pole."""
        b0, b1, b2, _, a1, a2 = section.astype(np.longdouble)
        if not a2:
            return cls.of_pole(float(b0), complex(-a1), complex(b1 - b0 * a1))
        pole = -a1 / 2 + 1j * np.sqrt(a2 - a1 * a1 / 4)
        weight = ((b1 - b0 * a1) * pole + b2 - b0 * a2) / (2j * pole.imag)
        return cls.of_pole(float(b0), complex(pole), complex(weight))

    @classmethod
    def of_pole(cls, b0: float, pole: complex, weight: complex) -> _Recursion:
        """Design y[n] = b0 x[n] + 2 Re(w s[n-1]), s[n] = p s[n-1] + x[n]; with a real pole b0 x[n] + w s[n-1]."""
        kept = 2 if pole.imag else 1
        powers = np.cumprod(np.r_[1.0, np.full(CHUNK, pole, np.clongdouble)])
        out = kept * weight * powers[:CHUNK]  # of the state before a sample
        to_state = powers[CHUNK - 1 :: -1]
        step = np.array([[powers[CHUNK].real, powers[CHUNK].imag], [-powers[CHUNK].imag, powers[CHUNK].real]])
        return cls(
            *(
                torch.from_numpy(np.array(table, np.float64))
                for table in (
                    np.r_[b0, out.real[:-1]],
                    np.stack((to_state.real, to_state.imag), 1)[:, :kept],
                    step[:kept, :kept],
                    np.stack((out.real, -out.imag))[:kept],
                )
            )
        )

    def filter(self, samples: Tensor) -> Tensor:
        """Filter (..., N) along its last axis; with channels, (..., 1, N) to (..., C, N)."""
        direct, to_state, from_state = (table.to(samples) for table in (self._direct, self._to_state, self._from_state))
        step = self._step  # in float64, as errors of its powers grow with the length of the sound
        count = samples.shape[-1]
        chunks = torch.nn.functional.pad(samples, (0, -count % CHUNK)).unflatten(-1, (-(-count // CHUNK), CHUNK))
        states = (chunks @ to_state)[..., :-1, :]  # after each chunk but the last: (..., K - 1, D)
        reach = 1
        while reach < states.shape[-2]:
            states = states + torch.nn.functional.pad(states[..., :-reach, :] @ step.to(samples), (0, 0, reach, 0))
            step, reach = step @ step, 2 * reach
        before = torch.nn.functional.pad(states, (0, 0, 1, 0))[..., : chunks.shape[-2], :]
        return (chunks @ direct + before @ from_state).flatten(-2)[..., :count]


def _leaky_integrator(log_decay: Tensor) -> _Recursion:
    """Return u[n] = r u[n-1] + (1 - r) x[n] for the logarithm of r, ()."""
    powers = torch.exp(log_decay * torch.arange(CHUNK + 1, dtype=torch.float64, device=log_decay.device))
    response = -torch.expm1(log_decay) * powers[:-1]
    return _Recursion(response, response.flip(0)[:, None], powers[-1:, None], powers[None, 1:])


def _names(learn: Any) -> list[str]:
    """Return `learn` as a list."""
    try:
        return [learn] if isinstance(learn, str) else list(learn)
    except TypeError:
        raise ValueError(f"learn: expected a sequence of names, got {short_repr(learn)}") from None


def _stages(sample_rate: float, parameters: Any, outputs: Sequence[str]) -> dict[str, Any]:
    """Return the stages that `outputs` need, by kind."""
    sound = SignalFormat.sound(SAMPLE_RATE.check(sample_rate))
    try:
        return create_stages(sound, check_parameters(parameters), needed(outputs))
    except ValueError as problem:
        raise rate_advice(problem, sample_rate).with_traceback(None) from None


def _bounds(name: str, stage: Stage) -> tuple[float, float]:
    """Return the range of a learned parameter, without its open ends."""
    declared = KINDS[stage.REPRESENTATION.kind].parameter(name)
    assert declared.minimum is not None and declared.maximum is not None
    high = min(declared.maximum, stage.sample_rate / 2) if name == "fb_cfHz" else declared.maximum
    return declared.minimum + 1e-6, high * (1 - 1e-6)


def _fir(samples: Tensor, table: Tensor) -> Tensor:
    """Return samples (..., N), filtered by K taps in chunks of T samples: (T + K - 1, T).

    `conv1d` in float64 stores a copy of the samples for each tap.
    """
    size, length = table.shape
    count = samples.shape[-1]
    padded = torch.nn.functional.pad(samples, (size - length, -count % length))
    return (padded.unfold(-1, size, length) @ table.to(samples)).flatten(-2)[..., :count]


def _gain_controlled(samples: Tensor, decay_factor: float, start_samples: float) -> Tensor:
    """Return samples (batch, ears, N) over the running RMS of the louder ear; see `preproc.GainControl`."""
    count, block = samples.shape[-1], DEFAULT_FRAMES_PER_BLOCK
    squares = samples.square()
    padded = torch.nn.functional.pad((samples != 0).int(), (0, -count % block))
    sounds = padded.unflatten(-1, (-(-count // block), block)).amax(-1)
    first = sounds.argmax(-1, keepdim=True) * block  # sample at which the control starts
    lengths = (count - first).clamp(1, round_half_away(min(block, start_samples)))
    k = torch.arange(count, dtype=samples.dtype, device=samples.device)
    start = (squares * ((k >= first) & (k < first + lengths))).sum(-1, keepdim=True) / lengths
    begun = torch.where(k >= first, decay_factor ** (k - first + 1).clamp(min=0), 0.0)
    log_decay = torch.tensor(math.log(max(decay_factor, TINY)), dtype=samples.dtype, device=samples.device)
    power = _leaky_integrator(log_decay).filter(squares) + start * begun
    loud = power > 0
    rms = torch.where(loud, torch.where(loud, power, 1.0).sqrt(), 0.0).amax(1, keepdim=True)
    return samples / (rms + GainControl.FLOOR)


def _floats(samples: Any) -> Tensor:
    """Return a tensor in float32 or float64."""
    if not isinstance(samples, Tensor) or not samples.is_floating_point():
        got = samples.dtype if isinstance(samples, Tensor) else type(samples).__name__
        raise ValueError(f"sound: expected a tensor of floats, got {got}")
    return samples if samples.dtype == torch.float64 else samples.float()


def _ears(sound: Any) -> Tensor:
    """Return sound as (batch, ears, N)."""
    samples = _floats(sound)
    if samples.ndim == 2:
        samples = samples.unsqueeze(1)
    if samples.ndim != 3 or samples.shape[1] not in (1, 2):
        raise ValueError(f"sound: expected shape (batch, 2, N) or (batch, N), got {tuple(sound.shape)}")
    return samples


def _two_ears(samples: Any) -> Tensor:
    samples = _floats(samples)
    if samples.ndim != 4 or samples.shape[1] != 2:
        raise ValueError(f"sound: expected two ears, shape (batch, 2, C, N), got {tuple(samples.shape)}")
    return samples


def _device_of(layer: torch.nn.Module) -> Any:
    return next((parameter.device for parameter in layer.parameters()), torch.device("cpu"))
