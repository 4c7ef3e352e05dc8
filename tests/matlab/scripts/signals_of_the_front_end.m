% A buffer that accepts the same chunks as circVBuf of Two!Ears: it assigns rows, one for each frame.
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
