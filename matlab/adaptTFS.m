function [chunkLeft, chunkRight] = adaptTFS(framesOnPort, numberOfChannels, left, isBinaural, right)
%ADAPTTFS  The time-frequency signals of a port as matrices, frames by channels.
%
%   chunkLeft = adaptTFS(framesOnPort, numberOfChannels, left, 0)
%   [chunkLeft, chunkRight] = adaptTFS(framesOnPort, numberOfChannels, left, 1, right)
%
%   LEFT and RIGHT are those of a port, such as out.ildPort.left, also of one read with '-m'. The order (..., left,
%   right, isBinaural) of older scripts is understood too.

if nargin == 5 && ~(isscalar(isBinaural) && (isnumeric(isBinaural) || islogical(isBinaural)))
    [isBinaural, right] = deal(right, isBinaural);
end
chunkLeft = matrix(framesOnPort, numberOfChannels, left);
if nargin == 5 && isBinaural
    chunkRight = matrix(framesOnPort, numberOfChannels, right);
else
    chunkRight = [];
end
end

function chunk = matrix(frames, channels, signal)
if isnumeric(signal)
    chunk = signal;
else
    chunk = zeros(frames, channels);
    for k = 1:channels
        chunk(:, k) = vertcat(signal.dataN{k}.data{:});
    end
end
if ~isequal(size(chunk), [frames channels])
    error('adaptTFS:size', 'the signal has %d frames of %d channels, and not %d of %d', size(chunk, 1), ...
        size(chunk, 2), frames, channels);
end
end
