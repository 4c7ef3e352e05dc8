function acquire = acquireAudio(bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice)
%ACQUIREAUDIO  Start the sound and let rosAFE listen: the request of the acquisition, or an error with what was refused.
%
%   The port of bass holds BUFFERSIZE_S_BASS seconds, in chunks of NFRAMESPERCHUNK.

if nargin < 6
    error('acquireAudio:arguments', ...
        'acquireAudio takes bass, rosAFE, sampleRate, bufferSize_s_bass, nFramesPerChunk, inputDevice');
end
chunks = max(1, floor(bufferSize_s_bass * sampleRate / nFramesPerChunk));
acquire = bass.Acquire('-a', inputDevice, sampleRate, nFramesPerChunk, chunks);
refuse(acquire);
about = describe(bass);
refuse(rosAFE.connect_port('Audio', [about.instance '/Audio']));
end

function refuse(request)
if strcmp(request.status, 'error')
    error('acquireAudio:refused', 'Error%s', genomix.request.explain(request.exception));
end
end
