"""Enhance one of two sources, and draw mixture, mask and result: enhance.py [SOUND AZIMUTH [HEAD.sofa]]"""

import sys

import matplotlib.pyplot as plt
import numpy as np
import soundfile

import rosafe

head = sys.argv[3] if len(sys.argv) > 3 else "sphere"
if len(sys.argv) > 2:
    sound, rate = soundfile.read(sys.argv[1])
    sound, azimuth = sound.T, float(sys.argv[2])
else:  # a harmonic sound in front and bursts of noise on the left
    rate, azimuth = 16000, 0.0
    time = np.arange(2 * rate) / rate
    phase = 2 * np.pi * np.cumsum(150 + 30 * np.sin(2 * np.pi * time)) / rate
    voice = 0.02 * sum(np.sin(number * phase) for number in range(1, 30)) * (np.sin(4 * np.pi * time) > -0.5)
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(time)) * (np.sin(7 * np.pi * time) > 0)
    ears = [rosafe.Head.sphere().render(source, rate, angle) for source, angle in ((voice, 0), (noise, 60))]
    sound = ears[0] + ears[1]

mask = rosafe.direction_mask(sound, rate, azimuth, head)
result = rosafe.process(sound, rate, outputs=["gammatone", "ratemap"], pad=True)
enhanced = rosafe.resynthesize(result, mask)  # rosafe.enhance(sound, rate, azimuth, head) does all of this
soundfile.write("enhanced.wav", enhanced.T, rate, subtype="FLOAT")

after = rosafe.process(enhanced, rate, outputs=["ratemap"], pad=True)
figure, axes = plt.subplots(3, 1, figsize=(7, 6), sharex=True, layout="constrained")
levels = [10 * np.log10(one["ratemap"].sum(axis=0) + 1e-12) for one in (result, after)]
limits = {"vmin": levels[0].max() - 60, "vmax": levels[0].max()}
grid = result["ratemap_time"], result["fb_cfHz"]
for ax, image, title, options in (
    (axes[0], levels[0], "mixture (dB)", limits),
    (axes[1], mask, f"mask for {azimuth:g} degrees", {"vmin": 0, "vmax": 1}),
    (axes[2], levels[1], "enhanced (dB)", limits),
):
    figure.colorbar(ax.pcolormesh(*grid, image, **options), ax=ax)
    ax.set(yscale="log", ylabel="Hz", title=title)
axes[2].set_xlabel("time (s)")
figure.savefig("enhanced.png", dpi=80)

if len(sys.argv) <= 2:

    def ratio(estimate):
        """Return the scale-invariant signal-to-distortion ratio of both ears in dB."""
        scale = np.sum(estimate * ears[0], axis=1) / np.sum(ears[0] ** 2, axis=1)
        target = scale[:, np.newaxis] * ears[0]
        return 10 * np.log10(np.sum(target**2, axis=1) / np.sum((estimate - target) ** 2, axis=1))

    print("signal-to-distortion ratio of left and right ear (dB)")
    for name, estimate in (("mixture", sound), ("enhanced", enhanced)):
        print(f"{name:8}", *(f"{value:+5.1f}" for value in ratio(estimate)))
