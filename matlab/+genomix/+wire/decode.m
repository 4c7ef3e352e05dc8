function [value, failed] = decode(bytes, matrices)
%DECODE  The value of a packed answer of genomixd (docs/genomixd.md), a row of uint8.
%
%   A structure becomes a struct. A sequence becomes an N-by-1 cell array, also one of numbers; where MATRICES is true,
%   one of numbers becomes an N-by-1 matrix, and a signal a matrix: frames, frames by channels, or frames by channels
%   by lags. FAILED is true for an exception.

failed = bytes(1) == uint8('!');
value = item(bytes, 1 + failed, matrices);
end

function [value, at] = item(bytes, at, matrices)
kind = char(bytes(at));
at = at + 1;
switch kind
    case 'd'
        value = typecast(bytes(at:at + 7), 'double');
        at = at + 8;
    case 's'
        [value, at] = text(bytes, at);
    case 'D'
        [n, at] = count(bytes, at);
        [value, at] = numbers(bytes, at, n);
        if ~matrices
            value = num2cell(value);
        end
    case '['
        value = cell(0, 1);
        while bytes(at) ~= uint8('.')
            [value{end + 1, 1}, at] = item(bytes, at, matrices);
        end
        at = at + 1;
    case '{'
        value = struct();
        while bytes(at) ~= uint8('.')
            [name, at] = text(bytes, at + 1);
            if ~isvarname(name)
                name = matlab.lang.makeValidName(name);
            end
            [value.(name), at] = item(bytes, at, matrices);
        end
        at = at + 1;
    case 'S'
        [value, at] = signal(bytes, at, matrices);
    otherwise
        error('genomix:connection', 'an answer of genomixd that this version of +genomix cannot read (%d)', kind);
end
end

function [value, at] = signal(bytes, at, matrices)
[levels, at] = count(bytes, at);
names = cell(1, levels);
sizes = ones(1, max(levels, 2)); % the innermost first, as MATLAB counts dimensions
for k = levels:-1:1
    [names{k}, at] = text(bytes, at);
    [sizes(k), at] = count(bytes, at);
end
[value, at] = numbers(bytes, at, prod(sizes(1:levels)));
value = reshape(value, sizes);
if ~matrices
    value = levels_of(value, names, levels);
end
end

function value = levels_of(block, names, level)
% The structs and cells of one level: dataN of data, for instance.
if level == 1
    cells = num2cell(block(:));
else
    others = repmat({':'}, 1, level - 1);
    cells = cell(size(block, level), 1);
    for k = 1:numel(cells)
        cells{k} = levels_of(block(others{:}, k), names, level - 1);
    end
end
value = struct(names{level}, {cells});
end

function [value, at] = numbers(bytes, at, n)
value = reshape(typecast(bytes(at:at + 8 * n - 1), 'double'), n, 1);
at = at + 8 * n;
end

function [value, at] = text(bytes, at)
[n, at] = count(bytes, at);
raw = bytes(at:at + n - 1);
value = char(raw);
if any(raw > 127)
    value = native2unicode(raw, 'UTF-8');
end
at = at + n;
end

function [value, at] = count(bytes, at)
value = double(typecast(bytes(at:at + 3), 'uint32'));
at = at + 4;
end
