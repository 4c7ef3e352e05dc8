function request = acquire(bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice)
%ACQUIRE  Start the sound and connect rosAFE to it. Returns the request of the acquisition; raises an error if refused.
%
%   The port of bass holds BUFFERSIZE_S_BASS seconds, in chunks of NFRAMESPERCHUNK frames.

chunks = max(1, floor(bufferSize_s_bass * sampleRate / nFramesPerChunk));
request = bass.Acquire('-a', inputDevice, sampleRate, nFramesPerChunk, chunks);
refuse(request);
about = describe(bass);
refuse(rosAFE.connect_port('Audio', [about.instance '/Audio']));
end

function refuse(request)
if strcmp(request.status, 'error')
    error('acquireAudio:refused', 'Error%s', genomix.request.explain(request.exception));
end
end
