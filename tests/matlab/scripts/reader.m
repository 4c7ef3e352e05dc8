clear all; close all; clc;
p = 0.1;
addpath(genpath('~/openrobots/lib/matlab'));
[bass, rosAFE, client] = initRosAFE();
sampleRate = 16000; bufferSize_s_matlab = 10;
acquireAudio(bass, rosAFE, sampleRate, 1, 800, 'scene:');
thisProc = rosAFE.InputProc('-a', 'input', 1600, 1, 1);
preProcProc = rosAFE.PreProc('-a', 'preProc', 'input', 0, 5000, 0, 0.97, 0, 500e-3, 0, 10, 0, 'jespen', 1);
gammatoneProc = rosAFE.GammatoneProc('-a', 'gammatone', 'preProc', 'gammatone', 80, 6000, 1, 8, 0, 4, 1.0180);
ihcProc = rosAFE.IhcProc('-a', 'ihc', 'gammatone', 'dau');
ratemapProc = rosAFE.RatemapProc('-a', 'ratemap', 'ihc', 'hann', 0.02, 0.01, 'magnitude', 0.008);
pause(p);
params = rosAFE.getParameters();
cfHz = cell2mat(params.result.parameters.gammatone{1}.fb_cfHz);
gammatoneOut = rosAFE.gammatonePort('gammatone');
exLastFrameIndex = gammatoneOut.gammatonePort.lastFrameIndex;
start = exLastFrameIndex;
sig_l = TimeFrequencySignal.construct(sampleRate, bufferSize_s_matlab, 'filterbank', 'gammatone', cfHz, 'left');
sig_r = TimeFrequencySignal.construct(sampleRate, bufferSize_s_matlab, 'filterbank', 'gammatone', cfHz, 'right');
rounds = 0; allLost = 0;
while ( rounds < 4 )
    pause(p);
    gammatoneOut = rosAFE.gammatonePort('gammatone');
    gotFrames = gammatoneOut.gammatonePort.lastFrameIndex - exLastFrameIndex;
    exLastFrameIndex = gammatoneOut.gammatonePort.lastFrameIndex;
    if ( gotFrames > gammatoneOut.gammatonePort.framesOnPort )
        lostFrames = gotFrames - gammatoneOut.gammatonePort.framesOnPort;
        gotFrames = gotFrames - lostFrames;
        disp(strcat('Lost Frames : ', int2str(lostFrames)));
        allLost = allLost + lostFrames;
    end
    [ chunkLeft chunkRight ] = adaptTFS( gammatoneOut.gammatonePort.framesOnPort, ...
        gammatoneOut.gammatonePort.numberOfChannels, gammatoneOut.gammatonePort.left, ...
        gammatoneOut.gammatonePort.right, true );
    sig_l.appendChunk( chunkLeft(end-gotFrames+1:end,:) );
    sig_r.appendChunk( chunkRight(end-gotFrames+1:end,:) );
    rounds = rounds + (gotFrames > 0);
end
show('frames', [exLastFrameIndex - start - allLost, size(sig_l.Data, 1), size(sig_r.Data, 1), allLost])
show('same', isequal(sig_l.Data(end-99:end, :), chunkLeft(end-99:end, :)))
show('alive', all(std(sig_r.Data) > 0))

ratemapOut = rosAFE.ratemapPort('ratemap');
exLastFrameIndex = ratemapOut.ratemapPort.lastFrameIndex;
gotFrames = 0;
while ( gotFrames < 5 )
    pause(p);
    ratemapOut = rosAFE.ratemapPort('ratemap');
    step = ratemapOut.ratemapPort.lastFrameIndex - exLastFrameIndex;
    gotFrames = step / sampleRate * ratemapOut.ratemapPort.sampleRate;
end
[ chunkLeft, chunkRight ] = adaptTFS( ratemapOut.ratemapPort.framesOnPort, ...
    ratemapOut.ratemapPort.numberOfChannels, ratemapOut.ratemapPort.left, true, ratemapOut.ratemapPort.right);
show('ratemap', [gotFrames, size(chunkLeft), size(chunkRight), min(chunkLeft(end, :)) > 0])
preProc = rosAFE.preProcPort('preProc');
inputPort = rosAFE.inputProcPort();
bassPort = bass.Audio();
both = [cell2mat(inputPort.inputProcPort.left.data); cell2mat(inputPort.inputProcPort.right.data)]';
show('input', [size(both), max(abs(both(:))) < 1])
audio = bass.Audio();
audio = audio.Audio();
show('audio', [size(cell2mat(audio.left)), iscell(audio.left)])
modif = rosAFE.modifyParameter('preProc', 'pp_bLevelScaling', '0');
kill = rosAFE.removeProcessor('preProc');
show('status', {modif.status, kill.status, gammatoneProc.wait(60)})
stopAndKill(bass, rosAFE, client);
