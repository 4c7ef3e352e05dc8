% Begins as the part of the original's rosAFEclient.m that uses the manager.
addpath(genpath('/home/user/TwoEars/AuditoryFrontEnd'));
startAuditoryFrontEnd;
startRosAFE;
client = genomix.client;
bass = client.load('bass');
rosAFE = client.load('rosAFE');
dObj = dataObject_RosAFE( bass, rosAFE, 'scene:', 8000, 800, 1, 0.5, 3, 2 );
par = genParStruct('fb_nChannels', 4, 'fb_highFreqHz', 3000);
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
