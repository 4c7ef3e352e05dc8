"""Zero crossings: how often the signal of each channel changes its sign."""

import numpy as np

from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Representation
from rosafe.dsp.framing import FramedStage, frame_parameters


class ZeroCrossings(FramedStage):
    """Sign changes per second in each frame; those of steps smaller than zc_threshold do not count."""

    REPRESENTATION = Representation(
        kind="zeroCrossings",
        doc="Zero crossings in each channel",
        parent="gammatone",
        axes=("ear", "channel", "time"),
        unit="1/s",
        parameters=(
            *frame_parameters("zc"),
            Parameter("zc_threshold", "double", 1e-6, "Least step that counts", minimum=0.0, maximum=1.0),
        ),
    )
    PREFIX = "zc"

    def frame(self, frames):
        """(2, C, F, w) to (2, C, F)."""
        before, after = frames[..., :-1], frames[..., 1:]
        crossing = (before < 0) != (after < 0)
        crossing &= np.abs(after - before) >= self._values["zc_threshold"]
        return crossing.sum(axis=-1) * self.given.rate / (frames.shape[-1] - 1)
