function [chunkLeft, chunkRight] = adaptTFS(framesOnPort, numberOfChannels, left, isBinaural, right)
%ADAPTTFS  Convert the time-frequency signals of a port to matrices, frames by channels.
%
%   chunkLeft = adaptTFS(framesOnPort, numberOfChannels, left, 0)
%   [chunkLeft, chunkRight] = adaptTFS(framesOnPort, numberOfChannels, left, 1, right)
%
%   LEFT and RIGHT are fields of a port, for example out.ildPort.left, also if it was read with '-m'. The order
%   (..., left, right, isBinaural) of older scripts is accepted as well.

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
    error('adaptTFS:size', 'expected a signal of %d frames and %d channels, got %d and %d', frames, channels, ...
        size(chunk, 1), size(chunk, 2));
end
end
