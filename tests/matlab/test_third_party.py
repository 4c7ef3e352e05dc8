"""Octave scripts like those of other users of the original's client, which depend on the shapes of values."""

from __future__ import annotations

import pytest

from tests.matlab import octave
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

# The robot interfaces of Two!Ears read their ear signals like this.
ROBOT = """
    1;
    function [signals, seconds] = getSignal(bass, duration)
        b = bass.Audio();
        signals = [cell2mat(b.Audio.left); cell2mat(b.Audio.right)]' ./ 2^31;
        count = round(duration * b.Audio.sampleRate);
        if count > size(signals, 1)
            error('the desired chunk is longer than the buffer');
        end
        signals = signals(end - count + 1:end, :);
        seconds = length(signals) / b.Audio.sampleRate;
    end
    client = genomix.client;
    bass = client.load('bass');
    bass.Acquire('-a', 'scene:', 16000, 800, 20);
    while bass.Audio().Audio.lastFrameIndex < 16000
        pause(0.05);
    end
    bass.Stop();
    [signals, seconds] = getSignal(bass, 0.5);
    whole = getSignal(bass, 1);
    b = bass.Audio();
    show('sizes', {size(b.Audio.left), size(signals), seconds, size(whole)});
    show('same', [isequal(whole(:, 1)' * 2^31, [b.Audio.left{:}]), isequal(whole(:, 2)' * 2^31, [b.Audio.right{:}])]);
    show('alive', all(std(whole) > 0));
    show('types', cellfun(@class, {b.Audio.left, b.Audio.left{1}}, 'UniformOutput', false));

    % in a tutorial of 2015, sequences are columns
    old = genomix.client(client.address, '-columns');
    p = old.load('bass').Audio();
    show('old', {size(p.Audio.left), size([cell2mat(p.Audio.left) cell2mat(p.Audio.right)])});
    setenv('GENOMIXD', client.address);
    rosAFE = genomix.client('-columns').load('rosAFE');
    show('fields', {size(rosAFE.getParameters().result.parameters.ild), rosAFE.GETPARAMETERS().status});
    show('wrong', message(@() genomix.client('a:1', '-rows')));
"""


def test_a_robot_interface(world: World) -> None:
    results = octave.run_and_parse(world, ROBOT)
    assert results["sizes"] == [[1, 16000], [8000, 2], 0.5, [16000, 2]]
    assert all(results["same"]) and results["alive"]
    assert results["types"] == ["cell", "double"]
    assert results["old"] == [[16000, 1], [16000, 2]]
    assert results["fields"] == [[0, 1], "done"]
    assert results["wrong"] == "genomix:connection expected at most '-columns' after the address of genomixd"


# A buffer that accepts the same chunks as circVBuf of Two!Ears: it assigns rows, one for each frame.
SIGNALS = """
    1;
    function data = appended(data, chunk)
        n = size(chunk, 1);
        old = size(data, 1);
        data(old + 1:old + n, :, :) = chunk(:, :, :);
    end
    function compare(name, signal, buffer, chunk)
        theirs = message(@() appended(buffer, chunk));
        ours = message(@() signal.appendChunk(chunk));
        show(name, {isempty(theirs), isempty(ours), size(signal.Data)});
    end
    client = genomix.client;
    bass = client.load('bass');
    rosAFE = client.load('rosAFE');
    bass.Acquire('-a', 'scene:', 16000);
    rosAFE.request('crosscorrelation', struct('fb_nChannels', 3, 'fb_highFreqHz', 4000, 'bufferSize_s_port', 0.1, ...
        'nFramesPerBlock', 1600));
    while rosAFE.crossCorrelationPort('crosscorrelation_0').crossCorrelationPort.lastFrameIndex < 3200
        pause(0.05);
    end
    bass.Stop();
    p = rosAFE.getParameters().result.parameters;
    cfHz = cell2mat(p.gammatone{1}.fb_cfHz);
    lags = cell2mat(p.crossCorrelation{1}.cc_lags);

    time = TimeDomainSignal.construct(16000, 10, 'input', 'input_0', 'left');
    port = rosAFE.inputProcPort().inputProcPort;
    compare('time', time, zeros(0, 1), cell2mat(port.left.data)');
    show('samples', isequal(time.Data', cell2mat(port.left.data)));
    compare('time as it comes', time, zeros(0, 1), cell2mat(port.left.data));
    compare('two ears', time, zeros(0, 1), [cell2mat(port.left.data); cell2mat(port.right.data)]');

    bank = TimeFrequencySignal.construct(16000, 10, 'filterbank', 'filterbank_0', cfHz, 'left');
    port = rosAFE.gammatonePort('filterbank_0').gammatonePort;
    chunk = zeros(port.framesOnPort, port.numberOfChannels);
    for jj = 1:port.numberOfChannels
        chunk(:, jj) = cell2mat(port.left.dataN{jj}.data)';
    end
    compare('bank', bank, zeros(0, 3), chunk);
    show('channels', isequal(bank.Data, chunk));
    show('adapted', isequal(adaptTFS(port.framesOnPort, port.numberOfChannels, port.left, 0), chunk));
    compare('bank on its side', bank, zeros(0, 3), chunk');
    compare('one channel', bank, zeros(0, 3), chunk(:, 1));
    compare('nothing new', bank, zeros(0, 3), chunk(end + 1:end, :));

    cc = CorrelationSignal(100, 10, 'crosscorrelation', 'crosscorrelation_0', cfHz, lags, 'mono');
    chunk = rosAFE.crossCorrelationPort('-m', 'crosscorrelation_0').crossCorrelationPort.left;
    compare('correlation', cc, zeros(0, 3, numel(lags)), chunk);
    compare('other lags', cc, zeros(0, 3, numel(lags)), chunk(:, :, 2:end));
    compare('lags first', cc, zeros(0, 3, numel(lags)), permute(chunk, [1 3 2]));

    brief = TimeDomainSignal.construct(10, 1, 'input', 'input_0', 'left');
    brief.appendChunk((1:25)');
    show('newest', brief.Data');
    show('error', message(@() brief.appendChunk(1:4410)));
    show('error 3', message(@() cc.appendChunk(chunk(:, :, 1))));
"""


def test_signals_accept_the_same_chunks_as_the_front_end(world: World) -> None:
    results = octave.run_and_parse(world, SIGNALS)
    samples, channels = [1600, 1], [1600, 3]
    frames = results["correlation"][2]
    assert results["time"] == [True, True, samples] and results["samples"]
    assert results["bank"] == [True, True, channels] and results["channels"] and results["adapted"]
    assert results["correlation"][:2] == [True, True] and frames == [10, 3, 37]
    assert results["nothing new"] == [True, True, channels]
    for name in ("time as it comes", "two ears"):
        assert results[name] == [False, False, samples]
    for name in ("bank on its side", "one channel"):
        assert results[name] == [False, False, channels]
    for name in ("other lags", "lags first"):
        assert results[name] == [False, False, frames]
    assert results["newest"] == list(range(16, 26))
    error = "expected a chunk of N-by-1 with one frame per row, got 1-by-4410"
    assert results["error"] == f"BufferedSignal:size input_0: {error}"
    assert results["error 3"].endswith("expected a chunk of N-by-3-by-37 with one frame per row, got 10-by-3")
