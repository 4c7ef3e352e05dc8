"""All representations in Octave, including a plugin, with names and parameters of the MATLAB Auditory Front-End."""

from __future__ import annotations

import os
import re
import wave
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from rosafe.interface import KINDS
from tests import harness
from tests.matlab import octave
from tests.web.genomix import world as worlds
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

RATE = 8000
DELAY = 3  # of the right ear, samples
PITCH = 200.0  # Hz


@pytest.fixture(scope="module")
def shared_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Start nodes with the plugin of the documentation."""
    octave.require_program()
    folder = tmp_path_factory.mktemp("plugins")
    document = (harness.ROOT / "docs" / "own-representation.md").read_text("utf-8")
    plugin = re.search(r"^```python\n(.*?)^```$", document, re.MULTILINE | re.DOTALL)
    assert plugin is not None
    (folder / "zerocrossings.py").write_text(plugin[1])
    with (
        mock.patch.dict(os.environ, ROSAFE_PLUGINS=str(folder)),
        worlds.world(tmp_path_factory.mktemp("world")) as world,
    ):
        yield world


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    """Write a file with one second of a harmonic tone from the left and one second of silence."""
    t = np.arange(RATE) / RATE
    left = sum(np.cos(2 * np.pi * PITCH * k * t) for k in range(1, 15)) / 20
    ears = np.zeros((2 * RATE, 2))
    ears[:RATE, 0] = left
    ears[DELAY:RATE, 1] = left[:-DELAY]
    path = tmp_path / "tone.wav"
    with wave.open(str(path), "wb") as file:
        file.setparams((2, 2, RATE, 0, "NONE", ""))
        file.writeframes((ears * 20000).astype("<i2").tobytes())
    return path


def begin(sound: Path, port: float = 0.2) -> str:
    """Return the start of a script: a manager for the sound file, with ports of `port` seconds."""
    return f"""
        startRosAFE;
        client = genomix.client;
        bass = client.load('bass');
        rosAFE = client.load('rosAFE');
        dObj = dataObject_RosAFE(bass, rosAFE, 'file:{sound}?loop=1', {RATE}, {RATE // 10}, 1, {port}, 3, 3);
        mObj = manager_RosAFE(dObj);
        below = genParStruct('fb_highFreqHz', 3000);
        par = genParStruct('fb_nChannels', 4, 'fb_highFreqHz', 3000);
    """


CLASSES = {
    ("time",): "TimeDomainSignal",
    ("channel", "time"): "TimeFrequencySignal",
    ("feature", "time"): "FeatureSignal",
    ("channel", "lag", "time"): "CorrelationSignal",
    ("channel", "filter", "time"): "ModulationSignal",
}


@pytest.mark.exploration
def test_all_representations_are_equal_to_their_ports(world: World, sound: Path) -> None:
    results = octave.run_and_parse(
        world,
        begin(sound)
        + """
        words = fieldnames(dObj).';
        show('words', words);
        for word = words
            sOut = mObj.addProcessor(word{1}, par);
            show(['of ' word{1}], {sOut{1}.Label, cellfun(@class, sOut, 'UniformOutput', false), ...
                cellfun(@(signal) signal.Channel, sOut, 'UniformOutput', false), ...
                cellfun(@(signal) signal.Name, sOut, 'UniformOutput', false)});
        end
        for word = words(1:7:end)
            mObj.addProcessor(word{1}, par);
        end
        show('counts', structfun(@numel, mObj.Processors)); % there are no duplicates
        processors = rosAFE.getProcessors();
        processors = processors.result.processors(:).';
        full = @(processor) size(dObj.(processor.kind){1}.Data, 1) >= 0.3 * processor.rate;
        while ! all(cellfun(full, processors))
            pause(0.1);
            mObj.processChunk();
        end
        bass.Stop();
        left = processors;
        while ! isempty(left) % until the data object contains all frames of the ports
            pause(0.1);
            mObj.processChunk();
            waiting = {};
            for processor = left
                out = rosAFE.(processor{1}.port)('-m', processor{1}.name).(processor{1}.port);
                fields = fieldnames(out)(4:end).';
                fields = fields(! strncmp(fields, 'numberOf', 8));
                kind = processor{1}.kind;
                signals = dObj.(kind);
                same = out.framesOnPort > 0;
                for k = 1:numel(signals)
                    same = same && isequaln(signals{k}.Data(end-out.framesOnPort+1:end, :, :), out.(fields{k}));
                end
                if same
                    show(kind, [out.framesOnPort / processor{1}.rate, size(signals{1}.Data)(2:end)]);
                else
                    waiting{end + 1} = processor{1};
                end
            end
            left = waiting;
        end
        show('fList', {dObj.pitch{1}.fList, dObj.spectralFeatures{1}.fList});
        show('alike', isequal(dObj.onsetStrength{1}.cfHz, dObj.itd{1}.cfHz, dObj.zeroCrossings{1}.cfHz));
        show('lags', [dObj.autocorrelation{2}.lags(2), dObj.crosscorrelation{1}.lags(1)]);
        shown = {dObj.pitch{1}, dObj.itd{1}, dObj.amsFeatures{1}, dObj.autocorrelation{1}, dObj.time{1}};
        show('figures', cellfun(@(signal) ishghandle(signal.plot()), shown));
        mObj.cleanup();
        show('clean', structfun(@numel, mObj.Processors));
        """,
    )
    kinds = {kind.word: kind for kind in KINDS.values()}
    assert results["words"] == [*kinds, "zeroCrossings"]
    assert results["counts"] == [1] * (len(kinds) + 1)
    for word, kind in kinds.items():
        label, classes, channels, names = results[f"of {word}"]
        assert label == f"{word}_0"
        expected = []
        for part in kind.parts:
            name = word if len(kind.parts) == 1 else f"{word}_{part.name}"
            rows = tuple(axis for axis in part.axes if axis != "ear")
            for channel in ("left", "right") if "ear" in part.axes else ("mono",):
                expected.append((CLASSES[rows], channel, name))
        assert list(zip(classes, channels, names, strict=True)) == expected, word
        assert results[kind.kind][0] == pytest.approx(0.2, abs=0.01), word
        assert results[kind.kind][1:2] == [{"channel": 4}.get(rows[0], results[kind.kind][1])], word
    assert results["zeroCrossings"][1:] == [4]
    assert results["fList"][0] == ["pitch", "rawPitch", "confidence"]
    assert len(results["fList"][1]) == 14 and results["fList"][1][:2] == ["centroid", "crest"]
    assert results["alike"] and results["lags"] == [1 / RATE, -9 / RATE]
    assert all(results["figures"])
    assert results["clean"] == [1] + [0] * len(kinds)


def test_pitch_and_time_differences_of_a_tone_and_of_silence(world: World, sound: Path) -> None:
    """NaN is NaN in MATLAB and Tcl, and null in JSON."""
    results = octave.run_and_parse(
        world,
        begin(sound, port=3)
        + """
        sOut = mObj.addProcessor('pitch', below);
        mObj.addProcessor('itd', below);
        data = zeros(0, 3);
        while ! any(isnan(data(:, 1))) || sum(data(:, 1) > 0) < 50
            pause(0.1);
            mObj.processChunk();
            data = sOut{1}.Data;
        end
        pitch = data(:, strcmp(sOut{1}.fList, 'pitch'));
        show('pitch', median(pitch(! isnan(pitch))));
        show('finite', all(isfinite(data(:, 2:3))(:)));
        times = dObj.itd{1}.Data(:, 1:10);
        show('itd', median(times(times != 0)));
        """,
    )
    assert results["pitch"] == pytest.approx(PITCH, rel=0.01)
    assert results["finite"]
    assert abs(results["itd"]) == pytest.approx(DELAY / RATE, rel=0.1)
    (part,) = world.http.call("rosAFE/getRepresentation", {"name": "pitch_0"})["parts"]
    ears, features, frames = part["shape"]
    assert part["axes"] == ["ear", "feature", "time"] and (ears, features) == (2, 3)
    assert len(part["data"]) == 6 * frames
    over_http = world.http.get("/call/rosAFE/pitchPort/pitch_0")["pitchPort"]["left"]["dataN"][0]["data"]
    assert None in over_http
    assert np.median([value for value in over_http if value]) == pytest.approx(PITCH, rel=0.01)
    (line,) = world.lines("""
        set g [::genomix::connect $address]
        $g load rosAFE
        show {*}[lsort -unique [dict values [dict get [::rosAFE::pitchPort pitch_0] pitchPort left dataN 0 data]]]
    """)
    values = line.split("|")
    assert "NaN" in values and "null" not in values
    assert np.median([float(value) for value in values if float(value) > 0]) == pytest.approx(PITCH, rel=0.01)


SCRIPT = """
    p = mObj.addProcessor('onsetStrength', par);
    parameters = genParStruct('sf_br_cf', 1000, 'sf_ro_perc', 0.9, 'sf_requests', {'flux', 'centroid'}, ...
        'fb_highFreqHz', 3000);
    p = mObj.addProcessor('spectralFeatures', parameters);
    assert(p{1}.fList(:).', {'flux', 'centroid'});
    one = mObj.Processors.spectralFeatures{1};
    assert({one.sf_brCF, one.sf_roPerc, one.sf_requests(:).'}, {1000, 0.9, {'flux', 'centroid'}});
    breebaart = genParStruct('fb_highFreqHz', 3000, 'adpt_model', 'adt_breebart');
    p = mObj.addProcessor('adaptation', breebaart);
    assert(mObj.Processors.adaptation{1}.adpt_model, 'adt_breebaart');
    assert(cellfun(@isstruct, {mObj.hasProcessor('spectralFeaturesProc', parameters), ...
        mObj.hasProcessor('spectralFeatures', below), mObj.hasProcessor('adaptationProc', breebaart), ...
        mObj.hasProcessor('adaptation', genParStruct('fb_highFreqHz', 3000, 'adpt_model', 'adt_puschel')), ...
        mObj.hasProcessor('onsetProc', par), mObj.hasProcessor('onsetProc', below)}), logical([1 0 1 0 1 0]));
    range = genParStruct('fb_highFreqHz', 3000, 'p_pitchRangeHz', [100 300]);
    p = mObj.addProcessor({'pitch', 'ic'}, {range, par});
    assert(cell2mat(mObj.Processors.pitch{1}.pi_rangeHz), [100 300]);
    p = mObj.addProcessor('pitch', genParStruct('fb_highFreqHz', 3000, 'pi_rangeHz', [100 300]));
    modulations = genParStruct('fb_nChannels', 4, 'fb_highFreqHz', 3000, 'ams_nFilter', 3, 'ams_lowFreqHz', 8);
    p = mObj.addProcessor('amsFeatures', modulations);
    filters = cell2mat(mObj.Processors.amsFeatures{1}.ams_cfHz);
    show('modulations', {p{2}.cfHz, p{2}.modCfHz, isequal(p{2}.modCfHz, filters)});
    assert(isstruct(mObj.hasProcessor('modulationProc', modulations)));
    p = mObj.addProcessor('precedence', par);
    show('precedence', {p{1}.cfHz, numel(p{3}.lags), p{3}.lags(1) == -p{3}.lags(end)});
    p = mObj.addProcessor('gabor', par);
    show('gabor', {numel(p{1}.fList), p{1}.fList{end}});
    assert([numel(mObj.Processors.pitch), size(dObj.pitch, 1)], [1 1]);

    mObj.modifyParameter('spectralFeatures_0', 'sf_requests', {'rolloff', 'crest', 'flux'});
    mObj.modifyParameter('pitch_0', 'pi_rangeHz', [90 310.5]);
    show('changed', {dObj.spectralFeatures{1, 2}.fList, mObj.Processors.pitch{1}.pi_rangeHz});
    mObj.deleteProcessor('onsetStrength', 1);
    assert([size(dObj.onsetStrength, 1), numel(mObj.Processors.onsetStrength)], [0 0]);

    other = rosAFE.OffsetProc('mine', 'ratemap_0'); % not created by the manager
    other = rosAFE.getRepresentation('mine');
    assert(other.result.parts{1}.name, 'offsetStrength');
    mObj.processChunk();
    assert({dObj.offsetStrength{1, 2}.Label, mObj.Processors.offsetStrength{1}.name}, {'mine', 'mine'});

    show('none of it', message(@() mObj.addProcessor('pitch', genParStruct('pi_rangeHz', [-1 100]))));
    show('not there', message(@() mObj.hasProcessor('pitch', genParStruct('fb_nERB', 1))));
    show('bad word', message(@() mObj.addProcessor('spectralFeatures', genParStruct('sf_requests', {'charm'}))));
    show('no type', message(@() mObj.deleteProcessor('spikes', 1)));
    show('no name', message(@() dObj.spikes));
    show('read only', message(@() subsasgn(dObj, substruct('.', 'pitch'), 3)));
"""


@pytest.mark.exploration
def test_names_and_parameters_of_the_matlab_front_end(world: World, sound: Path) -> None:
    results = octave.run_and_parse(world, begin(sound) + SCRIPT)
    frequencies, modulations, same = results["modulations"]
    assert len(frequencies) == 4 and len(modulations) == 3 and same and modulations[0] == 8
    assert results["precedence"][0] == frequencies and results["precedence"][1] % 2 == 1 and results["precedence"][2]
    assert results["gabor"][0] == int(results["gabor"][1]) > 1
    assert results["changed"] == [["rolloff", "crest", "flux"], [90, 310.5]]
    assert results["none of it"].startswith("manager_RosAFE:refused Error::rosAFE::e_badNewValue: pi_rangeHz")
    assert "fb_nERB" in results["not there"]
    assert "e_badNewValue: sf_requests" in results["bad word"]
    assert results["no type"].startswith("manager_RosAFE:type type: expected one of input, ")
    assert "spikes" in results["no name"] and results["read only"]


def test_plots_of_features(world: World) -> None:
    """The pitch is plotted over the raw pitch, in Hz; other features are scaled to their own range."""
    results = octave.run_and_parse(
        world,
        """
        startRosAFE;
        names = {'pitch', 'rawPitch', 'confidence'};
        pitch = FeatureSignal(10, 10, 'pitch', 'pitch_0', names, 'left');
        pitch.appendChunk([NaN 0 0.1; 120 120 0.9; 125 125 0.8; NaN 300 0.2]);
        figure('visible', 'off');
        pitch.plot();
        lines = get(gca(), 'children'); % the top one is first
        show('pitch', {get(lines(1), 'ydata'), get(lines(2), 'ydata'), get(lines(1), 'xdata')});
        show('unit', get(get(gca(), 'ylabel'), 'string'));
        figure('visible', 'off');
        pitch.plot([], 'confidence');
        show('confidence', {get(get(gca(), 'children'), 'ydata'), get(get(gca(), 'ylabel'), 'string')});
        features = FeatureSignal(10, 10, 'spectralFeatures', 'spectralFeatures_0', {'flux', 'hfc', 'crest'}, 'left');
        figure('visible', 'off');
        features.plot(); % no frames yet
        features.appendChunk([0 1e6 5; 2 3e6 5; 1 2e6 5]);
        figure('visible', 'off');
        features.plot();
        show('ranges', get(get(gca(), 'children'), 'cdata'));
        show('features', get(gca(), 'yticklabel').');
        """,
    )
    on_top, under, times = results["pitch"]
    assert on_top == [None, 120, 125, None] and under == [None, 120, 125, 300]
    assert times == pytest.approx([0, 0.1, 0.2, 0.3]) and results["unit"] == "Hz"
    assert results["confidence"] == [pytest.approx([0.1, 0.9, 0.8, 0.2]), "confidence"]
    assert results["ranges"] == [[0, 1, 0.5], [0, 1, 0.5], [0, 0, 0]]
    assert results["features"] == ["flux", "hfc", "crest"]
