"""Train a network for directions through the front-end, then use it on a stream: train.py [STEPS]

Voices and noises are rendered through the head of rosafe. Centre frequencies and bandwidths of the filters are learned
with the network. Afterwards the learned values configure `rosafe.Stream`, whose frames give the same directions. Needs
PyTorch: pip install '.[torch]' in the checkout. 300 steps take about three minutes on two cores.
"""

import sys

import numpy as np
import torch

import rosafe
from rosafe.torch import FrontEnd

RATE, SECONDS, BATCH = 16000, 0.3, 16
AZIMUTHS = np.arange(-75, 76, 15)  # degrees, left is positive
OUTPUTS = ("ild", "crossCorrelation")
head = rosafe.Head.sphere()
rng = np.random.default_rng(1)


def sound(azimuth):
    """Return a noise with a random spectrum and random pauses, from `azimuth`, in weak noise of both microphones."""
    count = int(RATE * SECONDS)
    gains = np.interp(np.linspace(0, 9, count // 2 + 1), range(10), rng.normal(0, 1.5, 10))
    voice = np.fft.irfft(np.fft.rfft(rng.standard_normal(count)) * np.exp(gains), count)
    voice *= np.repeat(rng.uniform(0, 1, 10), count // 10)
    ears = head.render(0.1 * voice / voice.std(), RATE, float(azimuth))
    return ears + 10 ** rng.uniform(-3.5, -2.5) * rng.standard_normal(ears.shape)


def batch(size):
    """Return sounds (size, 2, N) and the numbers of their azimuths (size,)."""
    labels = rng.integers(len(AZIMUTHS), size=size)
    ears = np.stack([sound(AZIMUTHS[label]) for label in labels])
    return torch.tensor(ears, dtype=torch.float32), torch.tensor(labels)


class Directions(torch.nn.Module):
    """Logarithms of the probabilities of the azimuths, from the mean of the evidence of all frames."""

    def __init__(self, channels, lags):
        super().__init__()
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(channels * (1 + lags), 64), torch.nn.ReLU(), torch.nn.Linear(64, len(AZIMUTHS))
        )

    def forward(self, features):
        """Return (batch, azimuths) of `ild` (batch, C, F) and `crossCorrelation` (batch, C, L, F)."""
        ild = features["ild"].unsqueeze(2) / 10
        frames = torch.cat((ild, features["crossCorrelation"]), 2).flatten(1, 2).transpose(1, 2)
        return torch.log_softmax(self.layers(frames).mean(1), -1)


steps = int(sys.argv[1]) if len(sys.argv) > 1 else 300
front = FrontEnd(RATE, {"fb_nChannels": 8, "fb_lowFreqHz": 200.0}, OUTPUTS, learn=("fb_cfHz", "fb_bwERBs"))
network = Directions(channels=8, lags=37)
optimizer = torch.optim.Adam(
    [
        {"params": network.parameters(), "lr": 2e-3},
        {"params": [front.gammatone.fb_cfHz], "lr": 2.0},  # Hz
        {"params": [front.gammatone.fb_bwERBs], "lr": 2e-3},  # ERBs
    ]
)
for step in range(steps):
    sounds, labels = batch(BATCH)
    loss = torch.nn.functional.nll_loss(network(front(sounds)), labels)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step % 25 == 0:
        print(f"step {step}: loss {loss.item():.2f}", flush=True)

sounds, labels = batch(64)
sounds, network = sounds.double(), network.double()
with torch.no_grad():
    offline = network(front(sounds))
print(f"right: {(offline.argmax(1) == labels).double().mean().item():.2f} of 64 new sounds")

values = front.parameters_dict()
print("learned centre frequencies (Hz):", *(round(frequency) for frequency in values["fb_cfHz"]))
largest = 0.0
for number, ears in enumerate(sounds.numpy()):
    stream = rosafe.Stream(RATE, values, OUTPUTS)  # as in a robot: blocks of 10 ms
    blocks = [stream.process(block) for block in np.split(ears, 30, axis=1)]
    features = {name: torch.tensor(np.concatenate([block[name] for block in blocks], -1))[None] for name in OUTPUTS}
    with torch.no_grad():
        largest = max(largest, (network(features) - offline[number]).abs().max().item())
print(f"largest difference of a logarithm of a probability between network and stream: {largest:.1e}")
