function request = acquire(bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice)
%ACQUIRE  Start the capture, connect rosAFE to it, and return the request; raise an error if it is rejected.
%
%   The port of bass contains BUFFERSIZE_S_BASS seconds in chunks of NFRAMESPERCHUNK frames.

chunks = max(1, floor(bufferSize_s_bass * sampleRate / nFramesPerChunk));
request = bass.Acquire('-a', inputDevice, sampleRate, nFramesPerChunk, chunks);
check(request);
about = describe(bass);
check(rosAFE.connect_port('Audio', [about.node '/Audio']));
end

function check(request)
if strcmp(request.status, 'error')
    error('acquireAudio:refused', 'Error%s', genomix.request.explain(request.exception));
end
end
