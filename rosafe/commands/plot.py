"""Draw the representations of a sound file or of a result of `rosafe process`.

The picture is a PNG beside the input, or the file that -o names. It shows time in seconds, channels at their centre
frequencies, and colours with their units. By default, correlations are means over the channels, and modulation
spectrograms are those of the loudest moment; --at and --channel select others. Pitch is drawn over the ratemap, and
onset and offset maps over the strengths.

examples:
  rosafe plot speech.wav
  rosafe plot speech.wav -o out.png --outputs amsFeatures,itd --channel 500 --set fb_nChannels=16
  rosafe plot speech.npz --ear left"""

from __future__ import annotations

import argparse
import contextlib
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosafe.commands import CommandError, _parameters
from rosafe.interface import KINDS
from rosafe.interface.arguments import check_outputs
from rosafe.system import option_types

if TYPE_CHECKING:
    import numpy as np

_DEFAULT = ("input", "ratemap", "pitch", "onsetMap", "ild", "itd")  # outputs of a sound


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe plot SOUND|RESULT [-o PNG] [--outputs NAME,...] [--set NAME=VALUE ...]\n"
        "                   [--preset NAME] [--ear left|right] [--at S] [--channel HZ] [--no-clip] [--force]"
    )
    parser.add_argument(
        "inputs", nargs="*", metavar="SOUND|RESULT", help="sound file or rosbag, or result of rosafe process"
    )
    parser.add_argument(
        "-o", "--to", dest="to", metavar="PNG", help="the picture, replaced if it exists (default: beside the input)"
    )
    parser.add_argument(
        "--outputs",
        metavar="NAME,...",
        help=f"outputs to draw, of {', '.join(KINDS)} (default: {','.join(_DEFAULT)} for a sound, all for a result)",
    )
    _parameters.add_settings(parser, "rosafe process -h lists them; for sounds only")
    _parameters.add_preset(parser)
    _parameters.add_float_handling(parser)
    parser.add_argument("--ear", choices=("left", "right"), help="draw one ear only")
    parser.add_argument(
        "--at",
        type=option_types.seconds(0.0, 1e10),
        metavar="S",
        help="draw channels against lags, or filters, at this time",
    )
    parser.add_argument(
        "--channel",
        type=option_types.number(0.0, 1e9, "a frequency in Hz"),
        metavar="HZ",
        help="draw lags, or filters, of this channel over time",
    )
    parser.add_argument("--force", action="store_true", help="replace a picture that -o does not name")


def run(options: argparse.Namespace) -> int:
    """Draw the picture."""
    source = Path(_parameters.one_input(options, "expected exactly one sound file or result"))
    target = Path(source.with_suffix(".png") if options.to is None else options.to)
    if target.suffix.lower() != ".png":
        raise CommandError(f"-o: expected a name ending in .png, got {target}")
    from matplotlib.figure import Figure

    from rosafe.audio.files.audiofile import AudioFileError
    from rosafe.processing.process import process
    from rosafe.results.formats import FORMATS
    from rosafe.results.view.axes import save
    from rosafe.results.view.plot import draw

    names = _parameters.parse_settings(options.outputs)
    result: Mapping[str, Any]
    try:
        if source.suffix.lower() in (*FORMATS, ".zarr"):
            if options.preset:
                options.usage_error("--preset: a result already has its parameters")
            if options.settings:
                raise ValueError(
                    "--set: expected a sound, got a result, which already has its parameters; name the sound instead"
                )
            result = _parameters.load_result(source)
        else:
            sound, rate = _sound(source, not options.no_clip)
            names = check_outputs(names) if names else _default(len(sound))
            outputs = [*names, *(KINDS[name].background for name in names if KINDS[name].background)]
            parameters = _parameters.parameters_of(options.settings, options.preset)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", UserWarning)
                result = process(sound, rate, parameters=parameters, outputs=outputs)
            for text in dict.fromkeys(str(one.message) for one in caught):
                print(f"rosafe plot: {text.replace('pad=True', 'rosafe process --pad')}", file=sys.stderr)
        figure = draw(Figure(), result, names, options.ear, at=options.at, channel=options.channel)
    except (AudioFileError, ValueError) as problem:
        raise CommandError(str(problem)) from None
    save(figure, target, options.to is not None or options.force)
    return 0


def _sound(path: Path, clip: bool) -> tuple[np.ndarray, int]:
    """Return the sound, (ears, N) with one or two ears, and its sample rate in Hz."""
    from rosafe.audio.files.audiofile import AudioFile, AudioFileError
    from rosafe.processing.sounds import BAG, open_sound, read_whole

    with contextlib.closing(open_sound(path) if path.suffix.lower() == BAG else AudioFile(path, clip)) as file:
        if isinstance(file, AudioFile) and file.channels > 2:
            raise AudioFileError(
                f"{path}: expected one or two channels, got {file.channels}; "
                "draw the result of rosafe process --channels A,B instead"
            )
        sound = read_whole(file)
        if file.clipped:
            print(f"rosafe plot: {path}: {_parameters.clipping_warning(file.clipped)}", file=sys.stderr)
        return sound, file.sample_rate


def _default(ears: int) -> list[str]:
    return [name for name in check_outputs(_DEFAULT) if ears == 2 or not KINDS[name].binaural]
