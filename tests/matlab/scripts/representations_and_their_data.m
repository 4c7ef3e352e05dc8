% Begins as the part of the original's rosAFEclient.m that uses the manager.
addpath(genpath('/home/user/TwoEars/AuditoryFrontEnd'));
startAuditoryFrontEnd;
startRosAFE;
client = genomix.client;
bass = client.load('bass');
rosAFE = client.load('rosAFE');
dObj = dataObject_RosAFE( bass, rosAFE, 'scene:', 8000, 800, 1, 0.5, 3, 2 );
par = genParStruct('fb_nChannels', 4, 'fb_highFreqHz', 3000);
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
