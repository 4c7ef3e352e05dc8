"""Enhance the sound from a direction in a sound file or rosbag with two ears.

Channels and frames whose interaural time and level differences belong to other directions are attenuated. Azimuths are
in degrees, left of straight ahead positive. The output is a WAV with two channels of 32-bit float samples, of the same
length and sample rate.

The first use of a head, sample rate and parameters takes up to a minute: a model is learned and kept in
$XDG_CACHE_HOME/rosafe. docs/resynthesis.md describes the method and its effect.

example:
  rosafe enhance talkers.wav --azimuth 0 --head /usr/share/libmysofa/default.sofa -o front.wav"""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import Any

from rosafe.commands import CommandError
from rosafe.commands._parameters import add_channels, add_head, add_settings, head_of, one_input, parameters_of
from rosafe.system import option_types
from rosafe.system.output import check_target, write_files


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe enhance SOUND --azimuth DEG [--head FILE] [--[no-]mirror] -o OUT.wav [--channels L,R]\n"
        "                      [--set NAME=VALUE ...] [--force]"
    )
    parser.add_argument("inputs", nargs="*", metavar="SOUND", help="sound file or rosbag with two ears")
    parser.add_argument(
        "--azimuth",
        type=option_types.number(-360.0, 360.0, "a number of degrees"),
        required=True,
        metavar="DEG",
        help="direction of the wanted sound",
    )
    add_head(parser)
    parser.add_argument("-o", "--to", dest="to", metavar="OUT.wav", required=True, help="the enhanced sound")
    add_channels(parser)
    add_settings(parser, "rosafe process -h lists them")
    parser.add_argument("--force", action="store_true", help="replace OUT if it exists")


def run(options: argparse.Namespace) -> int:
    """Enhance and write the sound."""
    source = one_input(options, "SOUND: expected one file")
    target = Path(options.to)
    if target.suffix.lower() != ".wav":
        options.usage_error(f"-o: expected a name that ends in .wav, got {target}")
    check_target(target, options.force)
    from rosafe.audio.files.audiofile import AudioFileError
    from rosafe.localization.enhancement import enhance
    from rosafe.processing.sounds import read_ears

    try:
        sound, rate = read_ears(source, options.channels)
        parameters = parameters_of(options.settings) or None
        enhanced = enhance(sound, rate, options.azimuth, head_of(options), parameters)
    except (AudioFileError, ValueError) as problem:
        raise CommandError(str(problem)) from None
    _write(target, enhanced, rate, options.force)
    return 0


def _write(target: Path, sound: Any, rate: int, force: bool) -> None:
    import numpy as np
    import soundfile

    wav = io.BytesIO()
    soundfile.write(wav, sound.T.astype(np.float32), rate, format="WAV", subtype="FLOAT")
    write_files({target: wav.getvalue()}, force)
