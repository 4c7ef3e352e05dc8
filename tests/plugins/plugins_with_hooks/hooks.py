"""Every hook that an author may define: a stage that changes rate, a child that needs its extra, a variant."""

from dataclasses import replace

import numpy as np

from rosafe.plugin import Derived, FramedStage, Parameter, Part, Representation, Stage, frame_parameters
from rosafe.representations.ild import Ild


class Every(Stage):
    """Every n-th sample, one later than it could."""

    REPRESENTATION = Representation(
        kind="everyNth",
        doc="Every n-th sample",
        parent="ihc",
        axes=("ear", "channel", "time"),
        parameters=(Parameter("ev_step", "unsigned long", 4, "Step", minimum=1, maximum=100),),
        derived=(Derived("ev_gain", "double", "Gain"),),
        word="nth",
    )
    EXTRAS = ("square",)

    def process(self, block, extra=None):
        room = self._output_array(block[..., ::1].shape)
        room[...] = block
        samples = np.concatenate((self._rest, self._as_valid_block(room)), axis=-1) if self._rest is not None else room
        step = self.values["ev_step"]
        count = samples.shape[-1] // step
        self._rest = samples[..., count * step :].copy()
        output = np.ascontiguousarray(samples[..., : count * step : step]) * self._gain
        self.provided = {"square": output**2} if "square" in self.provide else {}
        return output

    def output_count(self, count):
        return count // self.values["ev_step"]

    @property
    def derived(self):
        return {"ev_gain": self._gain}

    def build(self, values, changed):
        super().build(values, changed)
        self._gain = 2.0 * self.input_format.rate / self.input_format.sample_rate
        self._rest = None

    def input_format_changed(self, before):
        super().input_format_changed(before)
        self.build(self.values, frozenset())

    @property
    def output_format(self):
        step = self.values["ev_step"]
        return replace(super().output_format, rate=self.input_format.rate / step, framed=True, hop=step, window=1)

    def reset(self):
        self._rest = None


class Needing(FramedStage):
    """The mean of a frame of the parent, and of its squares."""

    REPRESENTATION = Representation(
        kind="meanSquare",
        doc="Mean, and mean square",
        parent="everyNth",
        parts=(Part("mean", ("channel", "time")), Part("square", ("channel", "time"))),
        parameters=(*frame_parameters("ms"),),
    )
    prefix = "ms"

    @property
    def required_extra(self):
        return "square"

    def __init__(self, input_format, **parameters):
        self._held = None
        super().__init__(input_format, **parameters)

    def process(self, block, extra=None):
        both = np.concatenate((block, extra), axis=1)
        means = super().process(both)
        return tuple(np.ascontiguousarray(part.mean(axis=0)) for part in np.split(means, 2, axis=1))

    def frame(self, frames):
        assert self.window.shape == frames.shape[-1:]
        return frames.mean(axis=-1)

    def output_rows(self, rows):
        return super().output_rows(rows)[1:]

    def part_rows(self, rows):
        return (self.output_rows(rows),) * 2

    def output_count(self, count):
        return super().output_count(count)

    @property
    def output_format(self):
        return super().output_format


class FineIld(Ild):
    """A variant of a built-in representation: its parameters under another prefix."""

    REPRESENTATION = Representation(
        kind="fineIld", doc="ILD", parent="ihc", axes=("channel", "time"), parameters=frame_parameters("fi")
    )
    prefix = "fi"
