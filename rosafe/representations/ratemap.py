"""The ratemap (cochleagram) stage: smoothed firing rate per frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.framing import FramedStage, frame_parameters
from rosafe.dsp.numeric_limits import FloatArray, clamp
from rosafe.dsp.sos_filter import SosFilter, leaky_integrator


class Ratemap(FramedStage):
    """Leaky integration and mean per frame, (2, C, N) to (2, C, F).

    u[n] = r u[n-1] + (1 - r) x[n] with r = exp(-1 / (fs rm_decaySec)); then, per frame, mean(window u) for `magnitude`
    or mean((window u)**2) for `power`. A change of rm_decaySec or rm_scaling resets the integrator but keeps
    the buffered samples.
    """

    REPRESENTATION = Representation(
        kind="ratemap",
        doc="Ratemap (cochleagram)",
        parent="ihc",
        axes=("ear", "channel", "time"),
        level=10.0,
        amplitude_choice=("rm_scaling", "magnitude"),
        parameters=(
            *frame_parameters("rm"),
            Parameter.text(
                "rm_scaling",
                "power",
                "Scaling type (power or magnitude)",
                ("power", "magnitude"),
                fallback="power",
                former=("set_rm_scailing",),
            ),
            Parameter.positive(
                "rm_decaySec", 0.008, "Signal-smoothing leaky integrator time constant (s)", 3600.0, unit="s"
            ),
        ),
        request_aliases=("Ratemap",),
        port_aliases=("ratemapProcPort",),
        port_doc="Ratemaps",
        references=(cite("brown1994"),),
    )
    prefix = "rm"
    CHANNEL_INDEPENDENT = True

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        samples = self._as_valid_block(block)
        power = self.values["rm_scaling"] == "power"
        if not kernels.compiled():
            return self._means(self._integrator.process(clamp(samples)), power)
        frames = self._frames(samples, self._framing.weights(squared=power))
        state = self._integrator.ensure_state(samples.shape[:-1])
        return kernels.ratemap(frames, power, self._integrator.sections, state)

    def reset(self) -> None:
        super().reset()
        self._integrator.reset()

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        super().build(values, changed)
        if changed & {"rm_decaySec", "rm_scaling"}:
            decay_factor = float(np.exp(-1 / (self.sample_rate * values["rm_decaySec"])))
            self._integrator = SosFilter(leaky_integrator(decay_factor))
