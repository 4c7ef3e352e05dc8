"""manager_RosAFE and dataObject_RosAFE in Octave: requests of trees, gapless chunks, changes, errors."""

from __future__ import annotations

import pytest

from tests.matlab import octave
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

# The part of the original's rosAFEclient.m that uses the manager.
BEGIN = """
    addpath(genpath('/home/user/TwoEars/AuditoryFrontEnd'));
    startAuditoryFrontEnd;
    startRosAFE;
    client = genomix.client;
    bass = client.load('bass');
    rosAFE = client.load('rosAFE');
    dObj = dataObject_RosAFE( bass, rosAFE, 'scene:', 8000, 800, 1, 0.5, 3, 2 );
    par = genParStruct('fb_nChannels', 4, 'fb_highFreqHz', 3000);
"""


def test_representations_and_their_data(world: World) -> None:
    results = octave.run_and_parse(
        world,
        BEGIN
        + """
        mObj = manager_RosAFE(dObj);
        assert(isempty(mObj.Processors.input) && isequal(mObj.hasProcessor('ildProc'), 0));
        sOut = mObj.addProcessor('ild', par);
        [left, both] = mObj.addProcessor({'ratemap', 'crosscorrelation'}, par);
        assert({sOut{1}.Label, size(left), left{2}.Channel, both{1}.Label, numel(both{1}.lags)}, ...
            {'ild_0', [1 2], 'right', 'crosscorrelation_0', 19});
        assert(sOut{1}.cfHz, cell2mat(mObj.Processors.gammatone{1}.fb_cfHz));
        p = mObj.Processors;
        assert({p.input{1}.name, p.preProc{1}.name, p.gammatone{1}.name, p.ihc{1}.name, p.ild{1}.name, ...
            p.ratemap{1}.name, p.crossCorrelation{1}.name}, ...
            {'input_0', 'time_0', 'filterbank_0', 'innerhaircell_0', 'ild_0', 'ratemap_0', 'crosscorrelation_0'});
        assert(structfun(@numel, p), [ones(7, 1); zeros(numel(fieldnames(dObj)) - 7, 1)]);
        assert(dObj.acquire.status, 'sent');

        % new frames are appended without losses and duplicates
        mObj.processChunk();
        while size(dObj.ild{1}.Data, 1) < 60
            pause(0.2);
            mObj.processChunk();
        end
        bass.Stop();
        ends = [1 2];
        before = [];
        while any(ends ~= ends(1)) || ! isequal(ends, before) % until all processors have finished
            pause(0.3);
            before = ends;
            ends = [rosAFE.inputProcPort('-m').inputProcPort.lastFrameIndex, ...
                rosAFE.ildPort('-m', 'ild_0').ildPort.lastFrameIndex, ...
                rosAFE.ratemapPort('-m', 'ratemap_0').ratemapPort.lastFrameIndex, ...
                rosAFE.crossCorrelationPort('-m', 'crosscorrelation_0').crossCorrelationPort.lastFrameIndex];
        end
        mObj.processChunk();
        port = rosAFE.inputProcPort('-m').inputProcPort;
        n = port.framesOnPort;
        assert(n, 4000);
        assert(dObj.input{1, 1}.Data(end-n+1:end), port.left);
        assert(dObj.input{1, 2}.Data(end-n+1:end), port.right);
        data = dObj.ratemap{1, 2}.Data;
        port = rosAFE.ratemapPort('-m', 'ratemap_0').ratemapPort;
        assert(data(end-49:end, :), port.right);
        port = rosAFE.crossCorrelationPort('-m', 'crosscorrelation_0').crossCorrelationPort;
        data = dObj.crosscorrelation{1}.Data;
        assert(data(end-9:end, :, :), port.left(end-9:end, :, :));
        seconds = [size(dObj.time{1}.Data, 1) / 8000, size(dObj.filterbank{2}.Data, 1) / 8000, ...
            size(dObj.innerhaircell{1}.Data, 1) / 8000, size(dObj.ild{1}.Data, 1) / 100];
        show('seconds', seconds);
        assert([dObj.time{1}.FsHz, dObj.ild{1}.FsHz, dObj.ratemap{1}.FsHz], [8000 100 100]);
        mObj.processChunk();
        assert(size(dObj.ild{1}.Data, 1) / 100, seconds(4));
        dObj.clearData(0);
        assert(isempty(dObj.ild{1}.Data) && ! isempty(dObj.input{1}.Data));
        mObj.reset();
        assert(isempty(dObj.input{1}.Data));
        """,
    )
    *samples, frames = results["seconds"]
    assert min(samples) >= 0.6 and max(samples) - min(samples) <= 0.5
    assert abs(frames - samples[2]) <= 0.5


def test_reuse_changes_and_errors(world: World) -> None:
    results = octave.run_and_parse(
        world,
        BEGIN
        + """
        mObj = manager_RosAFE(dObj, {'ild', 'ratemap'}, par);
        counts = @() [numel(mObj.Processors.preProc), numel(mObj.Processors.gammatone), numel(mObj.Processors.ild), ...
            numel(mObj.Processors.ratemap)];
        assert(counts(), [1 1 1 1]);
        mObj.addProcessor('ild', par);
        assert(counts(), [1 1 1 1]);
        wider = par;
        wider.ild_wSizeSec = 0.04;
        sOut = mObj.addProcessor('ild', wider);
        assert({counts(), sOut{1}.Label, size(dObj.ild)}, {[1 1 2 1], 'ild_1', [2 1]});
        other = manager_RosAFE(dObj);
        has = @(type, p) isstruct(mObj.hasProcessor(type, p));
        assert([has('ildProc', par), has('ildProc', wider), has('gammatoneProc', par), has('preProc', []), ...
            has('ildProc', struct('fb_nERBs', 2)), has('crosscorrelationProc', par)], logical([1 1 1 1 0 0]));
        assert(mObj.hasProcessor('ildProc', wider).name, 'ild_1');

        mObj.modifyParameter('time_0', 'pp_bRemoveDC', '1');
        mObj.modifyParameter('ild_0', 'ild_hSizeSec', 0.005);
        assert([mObj.Processors.preProc{1}.pp_bRemoveDC, mObj.Processors.ild{1}.ild_hSizeSec], [1 0.005]);
        mObj.addProcessor('ild', par);
        assert(counts(), [2 2 3 1]);
        middle = manager_RosAFE(dObj, 'time', struct('pp_bMiddleEarFiltering', 1));
        assert(cellfun(@(one) one.pp_bUnityComp, middle.Processors.preProc)(:).', [0 0 1]);

        show('bad value', message(@() mObj.addProcessor('ild', struct('ild_wSizeSec', -1))));
        show('bad name', message(@() mObj.addProcessor('spikes')));
        show('bad parameter', message(@() mObj.modifyParameter('ild_0', 'rm_scaling', 'power')));
        show('bad processor', message(@() mObj.deleteProcessor('missing')));
        show('bad type', message(@() mObj.hasProcessor('spikes')));
        show('bad number', message(@() mObj.deleteProcessor('ild', 99)));
        show('two', message(@() mObj.addProcessor('ild', struct('fb_nChannels', {1, 2}))));
        show('bad count', message(@() mObj.addProcessor({'ild', 'ratemap', 'time'}, {par, par})));
        show('bad device', message(@() dataObject_RosAFE(bass, rosAFE, 'file:/nowhere.wav', 16000, 1600)));
        show('few', message(@() dataObject_RosAFE(bass, rosAFE, 'scene:')));
        assert(counts()(3:4), [3 1]);

        before = mObj.Processors.ild{2}.name;
        mObj.deleteProcessor('ild', 2);
        names = cellfun(@(one) one.name, mObj.Processors.ild, 'UniformOutput', false);
        assert(! any(strcmp(before, names)) && numel(names) == 2 && isequal(size(dObj.ild), [2 1]));
        middle.deleteProcessor('time', 3);
        assert(numel(middle.Processors.preProc), 2);
        sOut = mObj.addProcessor('ild', wider);
        assert(! any(strcmp(sOut{1}.Label, names)));
        mObj.deleteProcessor('time_0');
        assert({counts(), size(dObj.ratemap, 1)}, {[1 1 2 0], 0});

        % signals are replaced when parameters change
        sOut = mObj.addProcessor('crosscorrelation', par);
        name = @(kind) mObj.Processors.(kind){end}.name;
        mObj.modifyParameter(name('gammatone'), 'fb_cfHz', [500 1000]);
        mObj.modifyParameter(name('crossCorrelation'), 'cc_maxDelaySec', 0.0005);
        mObj.modifyParameter(name('crossCorrelation'), 'cc_hSizeSec', 0.02);
        signal = dObj.crosscorrelation{1};
        while isempty(signal.Data)
            pause(0.1);
            mObj.processChunk();
        end
        assert({signal.FsHz, signal.cfHz(:).', numel(signal.lags), size(signal.Data)(2:3)}, {50, [500 1000], 9, [2 9]});
        assert(isempty(sOut{1}.Data));
        mObj.cleanup();
        assert({counts(), mObj.Processors.input{1}.name, size(dObj.ild, 1), size(dObj.input, 1)}, ...
            {[0 0 0 0], 'input_0', 0, 1});
        """,
    )
    for name, beginning in {
        "bad value": "manager_RosAFE:refused Error::rosAFE::e_badNewValue: ild_wSizeSec: exp",
        "bad name": "manager_RosAFE:refused Error::genom::serialization: ",
        "bad parameter": "manager_RosAFE:refused Error::rosAFE::e_noSuchParameter: ",
        "bad processor": "manager_RosAFE:refused Error::rosAFE::e_noSuchProcessor: ",
        "bad type": "manager_RosAFE:type",
        "bad number": "manager_RosAFE:number number: expected 1 to 3 for type 'ild', got 99",
        "two": "manager_RosAFE:arguments p: expected one structure of parameters, got 2",
        "bad count": "manager_RosAFE:arguments",
        "bad device": "acquireAudio:refused Error::bass::e_device",
        "few": "dataObject_RosAFE:arguments",
    }.items():
        assert results[name].startswith(beginning), (name, results[name])
