"""The texts of docs/reference: for each representation its equations and an example.

Everything else on the pages (parameters, units, publications) comes from the declarations of the representations.
docs/reference.py writes the pages.
"""

from __future__ import annotations

from typing import NamedTuple


class Page(NamedTuple):
    """The page of a representation.

    Attributes
    ----------
    title : str
        Its name in words.
    equations : str
        Markdown with formulas between dollar signs.
    sound : str
        Python lines of the example that define `sound`, from `rate`, `time` and `np`.
    use : str
        Python lines that print numbers of `result`.
    parameters : str
        Those of the example, as Python.
    """

    title: str
    equations: str
    sound: str
    use: str
    parameters: str = ""


_NOISE = "sound = 0.1 * np.random.default_rng(1).standard_normal((2, rate))"
_BURSTS = (
    "noise = 0.1 * np.random.default_rng(1).standard_normal(rate)\n"
    "sound = np.tile(noise * (time % 0.5 < 0.25) + 1e-4 * noise, (2, 1))  # bursts at 0 and 0.5 s"
)
_HARMONICS = (
    "harmonics = sum(np.sin(2 * np.pi * number * 200 * time) / number for number in range(1, 16))\n"
    "sound = np.tile(0.1 * harmonics, (2, 1))"
)
_DELAYED = (
    "noise = 0.1 * np.random.default_rng(1).standard_normal(rate)\n"
    "sound = np.stack([np.roll(noise, 8), noise])  # the left ear lags by 0.5 ms"
)

PAGES: dict[str, Page] = {
    "input": Page(
        "Input",
        r"""With `in_doNormalize`, samples $s[n]$ of a sound card become

$$x[n] = \frac{s[n]}{V}$$

with $V$ = `in_normalizeValue`, by default $2^{31} - 1$: full scale of 32-bit integers becomes 1. Otherwise
$x[n] = s[n]$.""",
        "sound = np.stack([np.sin(2 * np.pi * 5 * time), 0.5 * np.sin(2 * np.pi * 3 * time)])",
        'print("largest samples:", np.abs(result["input"]).max(axis=1).round(3))',
    ),
    "preProc": Page(
        "Preprocessing",
        r"""Up to five steps in this order; all are off by default.

1. DC removal: a Butterworth high-pass of order 4 at $f_c$ = `pp_cutoffHzDC`.
2. Pre-emphasis: $y[n] = x[n] - c x[n-1]$ with $c$ = `pp_coefPreEmphasis`.
3. Gain control, with one gain for both ears. The level of each ear is that of a leaky integrator with the time constant
   $\tau$ = `pp_intTimeSecRMS`, and the larger one divides both:

   $$P_e[n] = a P_e[n-1] + (1 - a) x_e^2[n], \quad a = e^{-1 / (\tau f_s)}, \quad
   y_e[n] = \frac{x_e[n]}{\sqrt{\max(P_L[n], P_R[n])}}$$

4. Level scaling: $y = x \cdot 10^{(100 - L) / 20}$ with $L$ = `pp_refSPLdB`. An RMS of 1 then corresponds to
   100 dB SPL.
5. The middle ear: a finite impulse response, fitted to data of stapes velocity.""",
        "sound = 0.1 + 0.1 * np.random.default_rng(1).standard_normal((2, rate))  # with an offset",
        'print("mean before and after:", sound.mean().round(3), result["preProc"][:, rate // 2 :].mean().round(3))',
        '{"pp_bRemoveDC": True, "pp_cutoffHzDC": 40.0}',
    ),
    "gammatone": Page(
        "Filterbank",
        r"""Centre frequencies are spaced evenly on the ERB-rate scale, and bandwidths are proportional to the
equivalent
rectangular bandwidth (Hz):

$$E(f) = 9.265 \ln\left(1 + \frac{f}{24.7 \cdot 9.265}\right), \qquad \mathrm{ERB}(f) = 24.7 + 0.108 f$$

A channel with the centre frequency $f$ is a cascade of $n$ = `fb_nGamma` complex one-pole filters:

$$H(z) = \left(\frac{1 - e^{-\beta}}{1 - p z^{-1}}\right)^{n}, \quad p = e^{-\beta + j 2 \pi f / f_s}, \quad
\beta = \frac{2 \pi b \mathrm{ERB}(f)}{f_s}, \qquad y = 2 \mathrm{Re}(H x)$$

with $b$ = `fb_bwERBs`. Its impulse response is a sampled gammatone, and its gain at $f$ is 1. With `fb_type` drnl, a
channel is the sum of a linear path (gain, gammatone filters, low-pass) and a nonlinear one with compression between two
gammatone filters: $y = \mathrm{sign}(x) \min(a |x|, b |x|^{c})$.""",
        "sound = np.tile(0.1 * np.sin(2 * np.pi * 1000 * time), (2, 1))",
        'power = np.mean(result["gammatone"][0] ** 2, axis=1)\n'
        "print(f\"{len(power)} channels; the strongest is at {result['fb_cfHz'][power.argmax()]:.0f} Hz\")",
    ),
    "ihc": Page(
        "Inner hair cells",
        r"""Each channel $x$ of the filterbank is rectified and smoothed. By default (`ihc_method` dau)

$$y = h * \max(x, 0),$$

$h$ being a Butterworth low-pass of order 2 at 1 kHz. Phase locking is lost above it, and the envelope remains. With the
envelope $e = 2 |H x|$ of the filterbank, the other values of `ihc_method` are

| value | output |
|---|---|
| none, halfwave, fullwave, square | $x$, $\max(x, 0)$, $\lvert x \rvert$, $x^2$ |
| hilbert | $e$ |
| joergensen | $e$, low-pass of order 1 at 150 Hz |
| dau1996 | $\max(x, 0)$, low-pass of order 1 at 1 kHz |
| breebart | $\max(x, 0)$, five low-passes of order 1 at 2 kHz, together -3 dB at 770 Hz |
| bernstein | $\max(e^{-0.77} x, 0)^2$, low-pass of order 2 at 425 Hz |""",
        "low, high = (0.1 * np.sin(2 * np.pi * frequency * time) for frequency in (250, 4000))\n"
        "sound = np.stack([low, high])",
        "for ear, frequency in ((0, 250), (1, 4000)):\n"
        '    channel = np.abs(result["fb_cfHz"] - frequency).argmin()\n'
        '    steady = result["ihc"][ear, channel, rate // 2 :]\n'
        '    print(f"{frequency} Hz: fine structure {np.std(steady) / np.mean(steady):.3f} of the mean")',
    ),
    "adaptation": Page(
        "Adaptation loops",
        r"""With $v = \max(x, x_{\min})$ and $x_{\min} = 10^{(\theta - 100) / 20}$, $\theta$ = `adpt_mindB`, a loop
for each
time constant $\tau_j$ of `adpt_tau` divides by its own low-pass filtered output:

$$v \leftarrow v / s_j, \qquad v \leftarrow 1 + m_j \tanh\frac{v - 1}{m_j} \quad \text{if } v > 1, \qquad
s_j \leftarrow a_j s_j + (1 - a_j) v, \quad a_j = e^{-1 / (\tau_j f_s)}$$

The limit $m_j = (1 - s_{j,0}^2) l - 1$ with $l$ = `adpt_lim` applies if $l > 1$. The loops start at rest,
$s_{j,0} = x_{\min}^{2^{-j}}$. The output in model units is

$$y = 100 \frac{v - K}{1 - K}, \qquad K = x_{\min}^{2^{-J}}$$

for $J$ loops: 0 at the threshold, and 100 for a steady input with an RMS of 1 (100 dB SPL).""",
        "tone = np.sin(2 * np.pi * 1000 * time) * (time > 0.3)\n"
        "sound = np.tile(10 ** (-40 / 20) * np.sqrt(2) * tone, (2, 1))  # 60 dB SPL from 0.3 s on",
        'channel = np.abs(result["fb_cfHz"] - 1000).argmin()\n'
        'loops = result["adaptation"][0, channel]\n'
        'print(f"onset {loops.max():.0f}, at the end {loops[-rate // 10 :].mean():.0f} model units")',
        '{"fb_nChannels": 16}',
    ),
    "ratemap": Page(
        "Ratemap",
        r"""The output $x$ of the hair cells passes a leaky integrator with the time constant $\tau$ = `rm_decaySec`,
and is
averaged in frames of $w$ samples every $h$ samples with the window $g$:

$$u[n] = r u[n-1] + (1 - r) x[n], \quad r = e^{-1 / (\tau f_s)}, \qquad
R[k] = \frac{1}{w} \sum_{i=0}^{w-1} \big(g[i] u[k h + i]\big)^2$$

With `rm_scaling` magnitude it is the mean of $g u$.""",
        _HARMONICS,
        'strongest = result["fb_cfHz"][result["ratemap"][0].mean(axis=1).argmax()]\n'
        'print(result["ratemap"].shape, f"strongest at {strongest:.0f} Hz")',
        '{"fb_nChannels": 48}',
    ),
    "ild": Page(
        "Interaural level differences",
        r"""For each channel and frame of $w$ samples every $h$ samples with the window $g$,

$$\mathrm{ILD}[k] = 10 \log_{10} \frac{E_R[k] + \epsilon}{E_L[k] + \epsilon}, \qquad
E[k] = \frac{1}{w} \sum_{i=0}^{w-1} \big(g[i] x[k h + i]\big)^2$$

in dB, $\epsilon = 2^{-52}$. It is positive if the right ear is louder.""",
        "noise = 0.1 * np.random.default_rng(1).standard_normal(rate)\nsound = np.stack([noise / 2, noise])",
        "print(f\"median {np.median(result['ild']):.2f} dB\")",
    ),
    "crossCorrelation": Page(
        "Interaural cross-correlation",
        r"""With the windowed frames $l$ and $r$ of the ears, for lags $m$ from $-M$ to $M$, $M$ = ceil(`cc_maxDelaySec`
$f_s$),

$$c[m] = \frac{\sum_n l[n + m] r[n]}{\sqrt{\sum_n l^2[n] \sum_n r^2[n] + \epsilon}}$$

A positive lag means that the left ear lags: the source is on the right. No mean is removed.""",
        _DELAYED,
        'mean = result["crossCorrelation"].mean(axis=(0, 2))\n'
        "print(f\"maximum {mean.max():.3f} at a lag of {1000 * result['cc_lags'][mean.argmax()]:.2f} ms\")",
    ),
    "itd": Page(
        "Interaural time differences",
        r"""With $i$, the index of the first maximum of the cross-correlation $c$ of $2 M + 1$ lags, and the top of a
parabola
through it and its neighbours,

$$\delta = \frac{1}{2} \frac{c[i-1] - c[i+1]}{c[i-1] - 2 c[i] + c[i+1]}, \qquad
\mathrm{ITD} = \frac{i - M + \delta}{f_s}$$

in seconds; $\delta = 0$ at both ends. It is positive if the left ear lags, and 0 in silence.""",
        _DELAYED,
        "print(f\"median {1000 * np.median(result['itd']):.3f} ms\")",
    ),
    "ic": Page(
        "Interaural coherence",
        r"""The height of the top of the parabola through the maximum of the cross-correlation, with $i$ and $\delta$
as for
the [ITD](itd.md):

$$\mathrm{IC} = c[i] - \frac{c[i-1] - c[i+1]}{4} \delta$$

It is 1 if the ears differ by a delay and a gain only, and 0 in silence.""",
        "noise = 0.1 * np.random.default_rng(1).standard_normal((2, rate))\n"
        "sound = np.where(time < 0.5, noise[0], noise)  # equal at both ears, then independent",
        'ic, seconds = result["ic"].mean(axis=0), result["ic_time"]\n'
        'print(f"equal {ic[seconds < 0.45].mean():.3f}, independent {ic[seconds > 0.55].mean():.3f}")',
    ),
    "precedence": Page(
        "Precedence effect",
        r"""The autocorrelations of all channels, summed since the beginning, show the delay $d$ and the gain $b$ of
an echo:
its peak at $d \ge 0.75$ ms has the height $b / (1 + b^2)$ relative to that at 0. Two filters remove it,

$$y_1[n] = \sum_{i=0}^{5} (-b t)^i x[n - i d], \qquad
y_2[n] = \sum_{i=0}^{5} (-1)^{i+1} b^{6-i} t^{5-i} x[n + (6 - i) d],$$

for echoes that are weaker or stronger than the direct sound; $t$ fades echoes between 6 and 20 ms. There are
four pairs of
these filters for both ears; the one with the largest correlation is used. Its correlation in each channel has the
weight
$W(f)$ of Stern et al. (1988); `precedence_itd` is the lag of its maximum, and `precedence_ild` the ratio of the
energies
in dB.

Agreement: with the defaults, the lead dominates for an echo of -6 dB after 1 to 8 ms, and of -3 dB up to about
5 ms; with `prec_wSizeSec` = 0.05, of -3 dB up to 8 ms. For an echo of equal level it holds in part, best at 3 ms. If
the echo is louder, the results follow the echo. The model of Braasch (2013) finds the lead in all of these cases: it
analyses the whole sound at once. [Published figures](../figures.md) compares both.""",
        "noise = 0.1 * np.random.default_rng(1).standard_normal(rate)\n"
        "lead = np.stack([np.roll(noise, 6), noise])  # from the right\n"
        "lag = 0.8 * np.roll(lead[::-1], 48, axis=1)  # an echo from the left after 3 ms\n"
        "sound = lead + lag",
        'found, plain = (1000 * np.median(result[name]) for name in ("precedence_itd", "itd"))\n'
        'print(f"median ITD {found:.3f} ms with precedence, {plain:.3f} ms without")',
        '{"fb_lowFreqHz": 300.0, "fb_highFreqHz": 1500.0}',
    ),
    "onsetStrength": Page(
        "Onset strength",
        r"""The rise of the level $L = 10 \log_{10} R$ of the ratemap from one frame to the next, in dB:

$$y[k] = \min\big(\max(L[k] - L[k-1], 0), D\big)$$

with $D$ = `ons_maxOnsetdB`. It is 0 in the first frame.""",
        _BURSTS,
        'mean = result["onsetStrength"][0].mean(axis=0)\nseconds = result["onsetStrength_time"]\n'
        'print(f"largest rise at {seconds[mean.argmax()]:.2f} s")',
    ),
    "offsetStrength": Page(
        "Offset strength",
        r"""The fall of the level $L = 10 \log_{10} R$ of the ratemap from one frame to the next, in dB:

$$y[k] = \min\big(\max(L[k-1] - L[k], 0), D\big)$$

with $D$ = `ofs_maxOffsetdB`. It is 0 in the first frame.""",
        _BURSTS,
        'mean = result["offsetStrength"][0].mean(axis=0)\nseconds = result["offsetStrength_time"]\n'
        'strong = seconds[mean > 5]\nprint(f"falls from {strong[0]:.2f} s on")',
    ),
    "onsetMap": Page(
        "Onset map",
        r"""A unit (channel $c$, frame $k$) is 1 if its onset strength is a peak in time,

1. of at least `trm_minStrengthdB`, and of a level of at least `trm_minValuedB`;
2. the strongest of its channel within $q = \mathrm{round}(T \rho)$ frames, with $T$ = `trm_fuseWithinSec` and the
   frame rate $\rho$;
3. and part of a fragment of at least $s$ = `trm_minSpread` adjacent peaks, including diagonal ones.

Frame $k$ depends on the frames from $k - H$ to $k + H$, $H = 2 q + s - 1$, so that it is $H$ frames late.

The defaults mark fluctuations of steady noise, too. [Onset maps](../onset-maps.md) shows their errors, and the preset
`onsets`.""",
        _BURSTS,
        'units = result["onsetMap"][0].sum(axis=0)\nseconds = result["onsetMap_time"]\n'
        'print("onsets at", sorted({round(float(second), 2) for second in seconds[units >= 8]}), "s")',
    ),
    "offsetMap": Page(
        "Offset map",
        r"""The same as the [onset map](onsetMap.md), for offset strengths: a unit is 1 if its offset strength is a
peak in
time of at least `trm_minStrengthdB`, the strongest within `trm_fuseWithinSec`, and part of a fragment of at least
$s$ = `trm_minSpread` adjacent peaks. It is $H = 2 q + s - 1$ frames late.

[Onset maps](../onset-maps.md) shows the errors of the defaults, and the preset `onsets`.""",
        _BURSTS,
        'units = result["offsetMap"][0].sum(axis=0)\nseconds = result["offsetMap_time"]\n'
        'print(f"most units at {seconds[units.argmax()]:.2f} s")',
    ),
    "autocorrelation": Page(
        "Autocorrelation",
        r"""A windowed frame $x$ of $w$ samples is centre-clipped to $y$: samples between $-T_-$ and $T_+$ become 0,
with
$T_\pm$ = `ac_clipAlpha` times its largest and smallest value. Then, with an FFT of
$N = 2^{\lceil \log_2 (2 w - 1) \rceil}$ points and $K$ = `ac_K`,

$$r = \mathrm{IFFT}\big(|\mathrm{FFT}(y)|^{K}\big), \qquad
A[l] = \frac{r[l]}{r[0]} \cdot \frac{w}{w - l}, \quad l = 0 \ldots w - 2$$

$K = 2$ is the ordinary autocorrelation; $K < 2$ compresses the spectrum. Silence is 0 at all lags.""",
        _HARMONICS,
        'mean = result["autocorrelation"][0].mean(axis=(0, 2))\nlags = result["ac_lags"]\n'
        "peak = 40 + mean[40:200].argmax()\n"
        'print(f"peak at a lag of {1000 * lags[peak]:.2f} ms")',
        '{"fb_nChannels": 16, "ac_wSizeSec": 0.04}',
    ),
    "pitch": Page(
        "Pitch",
        r"""The lag $l$ is the highest peak of the mean $s$ of the autocorrelations $A_c$ of all $C$ channels, in the
range `pi_rangeHz`. If `pi_peakRatio` is below 1 and $s$ has a peak at half of this lag (within 3 % or one sample) that
is at least `pi_peakRatio` times as high, $l$ is the lag of that peak. The ends of the range are not peaks.

$$s[l] = \frac{1}{C} \sum_c A_c[l], \qquad f_0 = \frac{f_s}{l}, \qquad \text{confidence} = s[l]$$

`rawPitch` is $f_0$. `pitch` is its median over `pi_medianOrder` frames, after frames with a confidence below
`pi_confThres` times the largest of the last 5 s have been set to 0; 0 becomes NaN.""",
        _HARMONICS,
        "print(f\"median {np.nanmedian(result['pitch'][0, 0]):.1f} Hz\")",
        '{"fb_nChannels": 16, "ac_wSizeSec": 0.04}',
    ),
    "amsFeatures": Page(
        "Amplitude modulation spectrogram",
        r"""The output of the hair cells, of which every `ams_dsRatio`-th sample is used, passes a bank of modulation
filters:
with `ams_fbType` log a low-pass of order 1 at the lowest frequency, then band-passes of constant quality $Q = 1$,

$$f_i = f_1 \left(\frac{f_M}{f_1}\right)^{(i - 1) / (M - 1)}, \quad
\text{from } f_i \left(\sqrt{1.25} - 0.5\right) \text{ to } f_i \left(\sqrt{1.25} + 0.5\right), \qquad
y_i[k] = \frac{1}{w} \sum_{n=0}^{w-1} \big| g[n] u_i[k h + n] \big|$$

With `ams_fbType` lin, triangles weight the magnitudes of the spectrum of each frame.""",
        "noise = 0.1 * np.random.default_rng(1).standard_normal(rate)\n"
        "sound = np.tile((1 + np.sin(2 * np.pi * 16 * time)) * noise, (2, 1))  # modulated at 16 Hz",
        'strength = result["amsFeatures"][0].mean(axis=(0, 2))[1:]  # without the low-pass\n'
        'frequencies = result["ams_cfHz"][1:]\nprint(f"strongest at {frequencies[strength.argmax()]:.0f} Hz")',
        '{"fb_nChannels": 16, "ams_lowFreqHz": 4.0, "ams_highFreqHz": 256.0, "ams_nFilters": 7, "ams_wSizeSec": 0.25,\n'
        '    "ams_hSizeSec": 0.1}',
    ),
    "spectralFeatures": Page(
        "Spectral features",
        r"""For each frame, with the rates $x_c$ of the $C$ channels of the ratemap at the centre frequencies $f_c$,
$X = \sum_c x_c$, $p_c = x_c / X$, the mean $m = X / C$, the centroid $g = \sum_c f_c p_c$ in Hz, the standard
deviation $s$ of $x_c$ and the level $D_c = 10 \log_{10} x_c$:

| feature | value |
|---|---|
| centroid, spread | $g / f_{\max}$, $\sqrt{\sum_c (f_c - g)^2 p_c} / f_{\max}$ |
| crest, flatness | $\max_c x_c / m$, $\exp(\mathrm{mean} \ln x_c) / m$ |
| entropy | $-\sum_c p_c \ln p_c / \ln C$ |
| brightness | $\sum p_c$ over $f_c >$ `sf_brCF` |
| hfc | $\sum_c f_c^2 p_c$ |
| decrease | $\sum_{c \ge 1} \frac{x_c - x_0}{c} / \sum_{c \ge 1} x_c$ |
| flux | $\sqrt{\mathrm{mean}_c (D_c[k] - D_c[k-1])^2}$ |
| irregularity | $\sqrt{\mathrm{mean}_{c \ge 1} (D_c - D_{c-1})^2}$ |
| skewness | $\mathrm{mean} \left(\frac{x_c - m}{s}\right)^3$ |
| kurtosis | $\mathrm{mean} \left(\frac{x_c - m}{s}\right)^4 - 3$ |
| rolloff | $f_r / f_{\max}$, $f_r$ being the frequency up to which the sum of the $x_c$ is `sf_roPerc` of $X$ |
| variation | $1 - \sum_c x_c[k] x_c[k-1] / (\lVert x[k] \rVert \lVert x[k-1] \rVert)$ |

A constant of $10^{-15}$ in denominators and logarithms keeps silence finite.""",
        "noise = 0.1 * np.random.default_rng(1).standard_normal(rate)\n"
        "sound = np.stack([np.cumsum(noise) / 30, noise])  # mostly low frequencies; white",
        'centroid = result["spectralFeatures"][:, result["sf_requests"].index("centroid")].mean(axis=1)\n'
        'print("centroid of both ears:", centroid.round(3))',
    ),
    "gabor": Page(
        "Gabor features",
        r"""The level of the ratemap, limited to the dynamic range $D$ = `gb_maxDynamicRangeDB` below the largest rate
$\hat R$ of the last 5 s, is correlated with patterns in time and frequency:

$$S_c[k] = 10 \log_{10}\big(R_c[k] + 10^{-D / 10} \hat R[k] + \epsilon\big), \qquad
y[k] = \sum_{c} \sum_{u=-19}^{19} W_c[u] S_c[k - u]$$

$W$ is the real part of a complex exponential along time and channels under Hann envelopes with 3.5 half-waves,

$$g[c, u] = h_t[u] h_f[c] e^{j (\omega u + \kappa c)},$$

without mean. Each feature is normalised by mean and standard deviation of its last 5 s, and is 19 frames late.""",
        "from scipy.signal import chirp\n\nsound = np.tile(0.1 * chirp(time, 200, 1, 4000, 'logarithmic'), (2, 1))",
        'print("ears, features, frames:", result["gabor"].shape)',
    ),
    "moc": Page(
        "Medial olivocochlear reflex",
        r"""With the level $y = 20 \log_{10} R$ of a channel of the ratemap, not below `moc_thresholdRatedB` and
limited to the
range from -181.86 to -93.82 dB in which $P$ rises, the attenuation in dB is

$$P(y) = -0.00012411 y^3 - 0.051322 y^2 - 6.3528 y - 206.11,$$

limited to 0 to `moc_maxAttenuationdB`. It is output and not fed back to the filterbank.""",
        "levels = 10 ** ((-60 + 40 * (time > 0.5)) / 20)\n"
        "sound = np.tile(levels * np.sin(2 * np.pi * 1000 * time), (2, 1))  # 20 dB, then 60 dB SPL",
        'channel = np.abs(result["fb_cfHz"] - 1000).argmin()\n'
        'seconds, moc = result["moc_time"], result["moc"][0, channel]\n'
        'print(f"{moc[seconds < 0.45].max():.1f} dB, then {moc[seconds > 0.7].max():.1f} dB")',
        '{"fb_type": "drnl", "fb_nChannels": 16, "pp_bMiddleEarFiltering": True}',
    ),
}
