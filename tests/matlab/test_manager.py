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
        show('before', {mObj.Processors.input, mObj.hasProcessor('ildProc')});
        sOut = mObj.addProcessor('ild', par);
        [left, both] = mObj.addProcessor({'ratemap', 'crosscorrelation'}, par);
        show('signals', {sOut{1}.Label, size(left), left{2}.Channel, both{1}.Label, numel(both{1}.lags)});
        show('cfHz', isequal(sOut{1}.cfHz, cell2mat(mObj.Processors.gammatone{1}.fb_cfHz)));
        p = mObj.Processors;
        show('names', {p.input{1}.name, p.preProc{1}.name, p.gammatone{1}.name, p.ihc{1}.name, p.ild{1}.name, ...
            p.ratemap{1}.name, p.crossCorrelation{1}.name});
        show('counts', structfun(@numel, p));
        show('kinds', numel(fieldnames(dObj)));
        acquire = dObj.acquire;
        show('acquire', acquire.status);

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
        show('input', [n, isequal(dObj.input{1, 1}.Data(end-n+1:end), port.left), ...
            isequal(dObj.input{1, 2}.Data(end-n+1:end), port.right)]);
        data = dObj.ratemap{1, 2}.Data;
        port = rosAFE.ratemapPort('-m', 'ratemap_0').ratemapPort;
        show('ratemap', isequal(data(end-49:end, :), port.right));
        port = rosAFE.crossCorrelationPort('-m', 'crosscorrelation_0').crossCorrelationPort;
        data = dObj.crosscorrelation{1}.Data;
        show('cc', isequal(data(end-9:end, :, :), port.left(end-9:end, :, :)));
        seconds = [size(dObj.time{1}.Data, 1) / 8000, size(dObj.filterbank{2}.Data, 1) / 8000, ...
            size(dObj.innerhaircell{1}.Data, 1) / 8000, size(dObj.ild{1}.Data, 1) / 100];
        show('seconds', seconds);
        show('rates', [dObj.time{1}.FsHz, dObj.ild{1}.FsHz, dObj.ratemap{1}.FsHz]);
        mObj.processChunk();
        show('nothing new', size(dObj.ild{1}.Data, 1) / 100 == seconds(4));
        dObj.clearData(0);
        show('cleared', {size(dObj.ild{1}.Data), isempty(dObj.input{1}.Data)});
        mObj.reset();
        show('reset', isempty(dObj.input{1}.Data));
        """,
    )
    assert results["before"] == [[], 0]
    assert results["signals"] == ["ild_0", [1, 2], "right", "crosscorrelation_0", 19]
    assert results["cfHz"]
    assert results["names"] == [
        "input_0",
        "time_0",
        "filterbank_0",
        "innerhaircell_0",
        "ild_0",
        "ratemap_0",
        "crosscorrelation_0",
    ]
    assert results["counts"] == [1] * 7 + [0] * (results["kinds"] - 7)
    assert results["acquire"] == "sent"
    assert results["input"] == [4000, True, True] or results["input"] == [4000, 1, 1]
    assert results["ratemap"] and results["cc"]
    *samples, frames = results["seconds"]
    assert min(samples) >= 0.6 and max(samples) - min(samples) <= 0.5
    assert abs(frames - samples[2]) <= 0.5
    assert results["rates"] == [8000, 100, 100]
    assert results["nothing new"] and results["cleared"][1] is False and results["reset"]
    assert 0 in results["cleared"][0]


def test_reuse_changes_and_errors(world: World) -> None:
    results = octave.run_and_parse(
        world,
        BEGIN
        + """
        mObj = manager_RosAFE(dObj, {'ild', 'ratemap'}, par);
        counts = @() [numel(mObj.Processors.preProc), numel(mObj.Processors.gammatone), numel(mObj.Processors.ild), ...
            numel(mObj.Processors.ratemap)];
        show('both', counts());
        mObj.addProcessor('ild', par);
        show('again', counts());
        wider = par;
        wider.ild_wSizeSec = 0.04;
        sOut = mObj.addProcessor('ild', wider);
        show('wider', {counts(), sOut{1}.Label, size(dObj.ild)});
        other = manager_RosAFE(dObj);
        has = @(type, p) {isstruct(mObj.hasProcessor(type, p))};
        show('has', [has('ildProc', par), has('ildProc', wider), has('gammatoneProc', par), has('preProc', []), ...
            has('ildProc', struct('fb_nERBs', 2)), has('crosscorrelationProc', par)]);
        h = mObj.hasProcessor('ildProc', wider);
        show('found', h.name);

        mObj.modifyParameter('time_0', 'pp_bRemoveDC', '1');
        mObj.modifyParameter('ild_0', 'ild_hSizeSec', 0.005);
        show('changed', [mObj.Processors.preProc{1}.pp_bRemoveDC, mObj.Processors.ild{1}.ild_hSizeSec]);
        mObj.addProcessor('ild', par);
        show('beside', counts());
        middle = manager_RosAFE(dObj, 'time', struct('pp_bMiddleEarFiltering', 1));
        show('unity', cellfun(@(one) one.pp_bUnityComp, middle.Processors.preProc));

        show('bad value', message(@() mObj.addProcessor('ild', struct('ild_wSizeSec', -1))));
        show('bad name', message(@() mObj.addProcessor('spikes')));
        show('bad member', message(@() mObj.addProcessor('ild', struct('fb_nERB', 1))));
        show('bad parameter', message(@() mObj.modifyParameter('ild_0', 'rm_scaling', 'power')));
        show('bad processor', message(@() mObj.deleteProcessor('missing')));
        show('bad type', message(@() mObj.hasProcessor('spikes')));
        show('bad number', message(@() mObj.deleteProcessor('ild', 99)));
        show('two', message(@() mObj.addProcessor('ild', struct('fb_nChannels', {1, 2}))));
        show('none', message(@() mObj.addProcessor({}, {})));
        show('bad count', message(@() mObj.addProcessor({'ild', 'ratemap', 'time'}, {par, par})));
        show('bad device', message(@() dataObject_RosAFE(bass, rosAFE, 'file:/nowhere.wav', 16000, 1600)));
        show('few', message(@() dataObject_RosAFE(bass, rosAFE, 'scene:')));
        show('after', counts());

        before = mObj.Processors.ild{2}.name;
        mObj.deleteProcessor('ild', 2);
        names = cellfun(@(one) one.name, mObj.Processors.ild, 'UniformOutput', false);
        show('deleted', {before, names, size(dObj.ild)});
        middle.deleteProcessor('time', 3);
        show('middle', numel(middle.Processors.preProc));
        sOut = mObj.addProcessor('ild', wider);
        show('name', sOut{1}.Label);
        mObj.deleteProcessor('time_0');
        show('root', {counts(), size(dObj.ratemap, 1)});

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
        show('follow', {signal.FsHz, signal.cfHz, numel(signal.lags), size(signal.Data)(2:3), isempty(sOut{1}.Data)});
        mObj.cleanup();
        show('clean', {counts(), mObj.Processors.input{1}.name, size(dObj.ild, 1), size(dObj.input, 1)});
        """,
    )
    assert results["both"] == results["again"] == [1, 1, 1, 1]
    assert results["wider"] == [[1, 1, 2, 1], "ild_1", [2, 1]]
    assert results["has"] == [True, True, True, True, False, False]
    assert results["found"] == "ild_1"
    assert results["changed"] == [1, 0.005]
    assert results["beside"] == [2, 2, 3, 1]
    assert results["unity"] == [0, 0, 1]
    assert results["bad value"].startswith("manager_RosAFE:refused Error::rosAFE::e_badNewValue: ild_wSizeSec: exp")
    assert "::genom::serialization" in results["bad name"] and "representation: expected one of" in results["bad name"]
    assert "fb_nERB" in results["bad member"]
    assert results["bad parameter"].startswith("manager_RosAFE:refused Error::rosAFE::e_noSuchParameter: ")
    assert "no 'rm_scaling'; they have: ild_wname, " in results["bad parameter"]
    assert results["bad processor"].startswith("manager_RosAFE:refused Error::rosAFE::e_noSuchProcessor: ")
    assert results["bad type"].startswith("manager_RosAFE:type")
    assert results["bad number"] == "manager_RosAFE:number number: expected 1 to 3 for type 'ild', got 99"
    assert results["two"].startswith("manager_RosAFE:arguments p: expected one structure of parameters, got 2")
    assert results["none"].startswith("manager_RosAFE:arguments")
    assert results["bad count"].startswith("manager_RosAFE:arguments")
    assert results["bad device"].startswith("acquireAudio:refused Error::bass::e_device")
    assert results["few"].startswith("dataObject_RosAFE:arguments")
    assert results["after"][2:] == [3, 1]
    before, left, size = results["deleted"]
    assert before not in left and len(left) == 2 and size == [2, 1]
    assert results["name"] not in left
    assert results["middle"] == 2
    assert results["root"][0] == [1, 1, 2, 0] and results["root"][1] == 0
    assert results["follow"] == [50, [500, 1000], 9, [2, 9], True]
    assert results["clean"] == [[0, 0, 0, 0], "input_0", 0, 1]
