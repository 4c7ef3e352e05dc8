"""Draw the representations of a sound file, or of what `rosafe process` has made of one.

The picture is a PNG beside it, or where -o says: time in seconds, channels at their centre frequencies, colours with
their units. Correlations are means over the channels, modulation spectrograms are those of the loudest moment, unless
--at or --channel says otherwise. Pitch lies over the ratemap, maps over strengths."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosafe.commands import CommandError
from rosafe.commands._parameters import add_settings, parameters_of, parse_settings
from rosafe.interface import KINDS
from rosafe.interface.arguments import check_outputs

if TYPE_CHECKING:
    import numpy as np

_DEFAULT = ("input", "ratemap", "pitch", "onsetMap", "ild", "itd")  # of a sound


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe plot SOUND|RESULT [-o PNG] [--outputs NAME,...] [--set NAME=VALUE ...]\n"
        "                   [--ear left|right] [--at S] [--channel HZ] [--force]"
    )
    parser.add_argument(
        "inputs", nargs="*", metavar="SOUND|RESULT", help="sound file or rosbag, or result of rosafe process"
    )
    parser.add_argument(
        "-o", "--to", dest="to", metavar="PNG", help="the picture, replaced if it is there (default: beside)"
    )
    parser.add_argument(
        "--outputs",
        metavar="NAME,...",
        help=f"what to draw of {', '.join(KINDS)} (default: {','.join(_DEFAULT)} of a sound, all of a result)",
    )
    add_settings(parser, "rosafe process -h tells them; for sounds only")
    parser.add_argument("--ear", choices=("left", "right"), help="draw one ear only")
    parser.add_argument("--at", type=float, metavar="S", help="draw channels against lags, or filters, at this time")
    parser.add_argument("--channel", type=float, metavar="HZ", help="draw lags, or filters, of this channel over time")
    parser.add_argument("--force", action="store_true", help="replace a picture that -o does not name")
    parser.epilog = (
        "examples:\n"
        "  rosafe plot speech.wav\n"
        "  rosafe plot speech.wav -o out.png --outputs amsFeatures,itd --channel 500 --set fb_nChannels=16\n"
        "  rosafe plot speech.npz --ear left"
    )


def run(options: argparse.Namespace) -> int:
    """Draw it."""
    inputs = [*options.inputs, *options.more_inputs]
    if len(inputs) != 1:
        options.usage_error("wanted is one sound file, or one result")
    source = Path(inputs[0])
    target = Path(source.with_suffix(".png") if options.to is None else options.to)
    if target.suffix.lower() != ".png":
        raise CommandError(f"-o {target}: a picture ends in .png")
    from matplotlib.figure import Figure

    from rosafe.offline.formats import FORMATS
    from rosafe.offline.process import process
    from rosafe.sound.audiofile import AudioFileError
    from rosafe.view.axes import save
    from rosafe.view.plot import UNDER, draw

    names = parse_settings(options.outputs)
    result: Mapping[str, Any]
    try:
        if source.suffix.lower() in FORMATS:
            result = _result(source, options.settings)
        else:
            sound, rate = _sound(source)
            names = check_outputs(names) if names else _default(len(sound))
            outputs = [*names, *(UNDER[name] for name in names if name in UNDER)]
            made = process(sound, rate, parameters=parameters_of(options.settings), outputs=outputs)
            result = {**made, "sample_rate": rate}
        figure = draw(Figure(), result, names, options.ear, at=options.at, channel=options.channel)
    except (AudioFileError, ValueError) as problem:
        raise CommandError(str(problem)) from None
    save(figure, target, options.to is not None or options.force)
    return 0


def _result(path: Path, settings: list[str]) -> Mapping[str, Any]:
    from rosafe.offline.formats import load

    if settings:
        raise ValueError("--set: a result is drawn as it is; name the sound instead")
    try:
        return load(path)
    except OSError as problem:
        raise ValueError(f"{path}: {problem.strerror}") from None


def _sound(path: Path) -> tuple[np.ndarray, int]:
    """One ear or two (ears, N), and the sample rate (Hz)."""
    from rosafe.offline.sounds import BAG, open_sound
    from rosafe.sound.audiofile import AudioFile, AudioFileError

    with contextlib.closing(open_sound(path) if path.suffix.lower() == BAG else AudioFile(path)) as file:
        if isinstance(file, AudioFile) and file.channels > 2:
            raise AudioFileError(
                f"{path} has {file.channels} channels; wanted are two, left and right ear, or one: "
                "draw what rosafe process makes of it with --channels"
            )
        return file.read(file.frames), file.sample_rate


def _default(ears: int) -> list[str]:
    return [name for name in check_outputs(_DEFAULT) if ears == 2 or not KINDS[name].binaural]
