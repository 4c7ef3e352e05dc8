function acquire = acquireAudio(bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice)
%ACQUIREAUDIO  Start the capture and connect rosAFE to it, as in the examples of the original. See rosafe.acquire.

if nargin < 6
    error('acquireAudio:arguments', ...
        'acquireAudio: expected bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice');
end
acquire = rosafe.acquire(bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice);
end
