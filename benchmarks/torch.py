"""Time and memory of the layers of rosafe.torch, forward and backward, beside public layers of gammatone filters.

``/usr/bin/python3 benchmarks/torch.py`` writes benchmarks/results/torch.md. Each row runs in a process of its own, on
one thread. Public layers are measured if they are installed: ``pip install nnAudio asteroid-filterbanks``.
"""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from report import Report, arguments

sys.path = [str(Path(__file__).resolve().parents[1]), *sys.path[1:]]  # without this folder, whose torch.py is this file

RATE, BATCH, CHANNELS, REPETITIONS = 16000, 16, 32, 7


def front(**options: Any) -> Callable[[Any], Any]:
    """Return gammatone, hair cell and ratemap of rosafe."""
    from rosafe.torch import FrontEnd

    layers = FrontEnd(RATE, {"fb_nChannels": CHANNELS}, **options)
    return lambda sound: layers(sound)["ratemap"]


def gammatone() -> Callable[[Any], Any]:
    """Return the filterbank of rosafe."""
    from rosafe.torch import Gammatone

    return Gammatone(RATE, {"fb_nChannels": CHANNELS})


def asteroid(taps: int) -> Callable[[Any], Any]:
    """Return the filterbank of asteroid at the rate of the sound, by convolution with `taps` samples."""
    import numpy as np

    np.complex, np.float = complex, float  # names that NumPy has removed, and asteroid-filterbanks 0.4.0 needs
    from asteroid_filterbanks import Encoder
    from asteroid_filterbanks.multiphase_gammatone_fb import MultiphaseGammatoneFB

    bank = MultiphaseGammatoneFB(n_filters=CHANNELS, kernel_size=taps, sample_rate=RATE, stride=1)
    layer = Encoder(bank)
    return lambda sound: layer(sound[:, None])


def nnaudio() -> Callable[[Any], Any]:
    """Return the gammatonegram of nnAudio: an STFT whose bins are weighted, without filters in time."""
    from nnAudio.features.gammatone import Gammatonegram

    return Gammatonegram(sr=RATE, n_fft=1024, n_bins=CHANNELS, hop_length=160, fmin=80, fmax=7600, verbose=False)


ROWS: dict[str, tuple[Callable[[], Callable[[Any], Any]], str]] = {
    "rosafe: gammatone, hair cell, ratemap": (front, "99 frames, from filters at audio rate"),
    "rosafe: the same, learned fb_cfHz, fb_bwERBs, rm_decaySec": (
        lambda: front(learn=("fb_cfHz", "fb_bwERBs", "rm_decaySec")),
        "",
    ),
    "rosafe: gammatone": (gammatone, "audio rate"),
    "asteroid-filterbanks: MultiphaseGammatoneFB, 512 taps": (lambda: asteroid(512), "audio rate, ends after 32 ms"),
    "asteroid-filterbanks: MultiphaseGammatoneFB, 32 taps": (lambda: asteroid(32), "audio rate, ends after 2 ms"),
    "nnAudio: Gammatonegram": (nnaudio, "no filters in time: weighted bins of an STFT"),
}


def measure(name: str) -> None:
    """Print the medians of forward and backward (s), and the memory (MB) that they need."""
    import torch

    torch.set_num_threads(1)
    layer = ROWS[name][0]()
    sound = torch.randn(BATCH, RATE, requires_grad=True)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    forward, backward = [], []
    for _ in range(REPETITIONS + 1):
        begin = time.perf_counter()
        output = layer(sound)
        middle = time.perf_counter()
        output.square().sum().backward()
        forward.append(middle - begin)
        backward.append(time.perf_counter() - middle)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(statistics.median(forward[1:]), statistics.median(backward[1:]), (after - before) / 1024)


def main() -> None:
    """Measure and write benchmarks/results/torch.md."""
    parser = arguments(__doc__)
    parser.add_argument("--row", help="measure only this row, in this process")
    options = parser.parse_args()
    if options.row:
        return measure(options.row)
    page = Report(options, "Layers of PyTorch")
    page.say(f"{BATCH} sounds of 1 s at {RATE} Hz, {CHANNELS} channels, float32, one thread; medians of {REPETITIONS}.")
    page.say()
    rows, first = [], 0.0
    for name, (_, remark) in ROWS.items():
        done = subprocess.run([sys.executable, __file__, "--row", name], capture_output=True, text=True)
        if done.returncode:
            rows.append([name, "", "", "", "", done.stderr.strip().splitlines()[-1]])
            continue
        forward, backward, memory = map(float, done.stdout.split())
        first = first or forward + backward
        ratio = (forward + backward) / first
        rows.append([name, f"{forward:.3f}", f"{backward:.3f}", f"{ratio:.2f}", f"{memory:.0f}", remark])
    page.table(["layer", "forward, s", "backward, s", "both, relative", "memory, MB", "remark"], rows)
    page.write("torch.md")
    return None


if __name__ == "__main__":
    main()
