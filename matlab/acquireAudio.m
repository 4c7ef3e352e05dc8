function acquire = acquireAudio(bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice)
%ACQUIREAUDIO  Start the sound and connect rosAFE to it, as in the original's examples. See rosafe.acquire.

if nargin < 6
    error('acquireAudio:arguments', ...
        'acquireAudio takes bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice');
end
acquire = rosafe.acquire(bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice);
end
