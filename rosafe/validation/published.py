"""Published values for the figures. figures.json has the source of each, and the way in which it was obtained."""

from __future__ import annotations

import numpy as np

# Lateralization of a lead and a lag: ITD in ms, mean of three noises, for delays of the lag in ms; by the level of the
# lag relative to the lead in dB. The stimulus is `lead_lag` of binaural.py.
BRAASCH_DELAYS = np.arange(1, 9)
BRAASCH_ITD: dict[int, tuple[float, ...]] = {
    -6: (0.1920, 0.2807, 0.2783, 0.2789, 0.2660, 0.2842, 0.2892, 0.2837),
    -3: (0.1867, 0.2784, 0.2755, 0.2821, 0.2590, 0.2844, 0.2813, 0.2862),
    0: (0.2460, 0.2990, 0.2344, 0.2535, 0.3010, 0.2858, 0.2806, 0.3180),
    4: (0.1412, 0.3077, 0.2660, 0.2707, 0.3340, 0.2815, 0.2180, 0.2722),
}

# DRNL, average listener: centre (also of the low-pass) and width of the linear path in Hz, its gain; centre (also of
# the low-pass) and width of the compressive path, a, b. The exponent c is 0.25; there are three gammatone sections
# before the compression, three gammatone and three low-pass sections after it, and three gammatone and four low-pass
# sections in the linear path.
LOPEZPOVEDA_TABLE_2 = {
    250: (244, 100, 1150, 250, 84, 2194, 0.45),
    500: (480, 130, 850, 500, 103, 5184, 0.28),
    1000: (965, 240, 520, 1000, 175, 7558, 0.130),
    2000: (1925, 400, 410, 2000, 300, 9627, 0.078),
    4000: (3900, 660, 320, 4000, 560, 22288, 0.045),
    8000: (7750, 1450, 220, 8000, 1100, 43584, 0.030),
}

# Adaptation loops with an overshoot limit of 10: output in model units at times in ms after the onset of a constant
# input of 500 ms at 16 kHz; by its level in dB SPL.
BURST_TIMES = np.array([0.0, 1, 2, 5, 10, 20, 50, 100, 200, 499])
AMT_BURST = {
    20: (1280.3281, 694.87358, 488.79455, 287.71873, 192.39134, 120.03231, 50.360925, 25.986573, 18.567921, 17.249719),
    60: (1443.9809, 1418.3887, 1333.7354, 973.3984, 623.14038, 352.52749, 149.82138, 87.240014, 64.475191, 56.791724),
    100: (1443.9809, 1442.0399, 1437.7758, 1369.1643, 1091.4669, 660.96701, 285.20777, 167.91944, 121.22632, 102.98047),
}
