function [value, failed] = decode(bytes, matrices, columns)
%DECODE  Decode a packed answer of genomixd (docs/genomixd.md), a row of uint8.
%
%   A structure is converted to a struct, a sequence to a 1-by-N cell array, or N-by-1 if COLUMNS is true. If MATRICES
%   is true, a sequence of numbers is converted to an N-by-1 matrix, and a signal to a matrix: frames, frames by
%   channels, or frames by channels by lags. FAILED is true for an exception.
%
%   Other bytes raise the error genomix:connection. Sizes are checked before memory is allocated.

form = struct('matrices', matrices, 'columns', nargin > 2 && columns);
try
    failed = bytes(1) == uint8('!');
    [value, at] = item(bytes, 1 + failed, form, 0);
    if at <= numel(bytes)
        fail('data after the end');
    end
    if failed && ~(isstruct(value) && isfield(value, 'ex') && ischar(value.ex))
        fail('expected an exception with a name');
    end
catch problem
    error('genomix:connection', 'expected an answer in the format of this version of +genomix (%s)', problem.message);
end
end

function [value, at] = item(bytes, at, form, depth)
% Return the value at an index, and the index of the next one. Reading past the end raises an index error.
MAX_DEPTH = 50;
MAX_ELEMENTS = 2e4;
END = uint8('.');
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
        if ~form.matrices
            value = cells(num2cell(value), form);
        end
    case '['
        value = cell(1, 8);
        n = 0;
        while bytes(at) ~= END
            n = n + 1;
            if n > MAX_ELEMENTS || depth > MAX_DEPTH
                fail('too many elements');
            elseif n > numel(value)
                value{2 * n} = []; % doubles the capacity
            end
            [value{n}, at] = item(bytes, at, form, depth + 1);
        end
        value = cells(value(1:n), form);
        at = at + 1;
    case '{'
        value = struct();
        n = 0;
        while bytes(at) ~= END
            n = n + 1;
            if n > MAX_ELEMENTS || depth > MAX_DEPTH || bytes(at) ~= uint8('s')
                fail('expected a structure');
            end
            [name, at] = text(bytes, at + 1);
            if ~isvarname(name)
                name = matlab.lang.makeValidName(name);
            end
            [value.(name), at] = item(bytes, at, form, depth + 1);
        end
        at = at + 1;
    case 'S'
        [value, at] = signal(bytes, at, form);
    otherwise
        fail(sprintf('kind %d', kind));
end
end

function [value, at] = signal(bytes, at, form)
MAX_SIZE = 1e6; % of a dimension of an empty signal
[levels, at] = count(bytes, at);
if levels < 1 || levels > 8
    fail('expected a signal of 1 to 8 levels');
end
names = cell(1, levels);
sizes = ones(1, max(levels, 2)); % the innermost level is the first dimension
for k = levels:-1:1
    [names{k}, at] = text(bytes, at);
    if ~isvarname(names{k})
        fail('expected a level with a name');
    end
    [sizes(k), at] = count(bytes, at);
end
if ~all(sizes) && any(sizes > MAX_SIZE)
    fail('an empty signal is too large');
end
[value, at] = numbers(bytes, at, prod(sizes));
value = reshape(value, sizes);
if ~form.matrices
    value = levels_of(value, names, levels, form);
end
end

function value = levels_of(block, names, level, form)
% Return the structs and cells of one level, for example dataN of data.
if level == 1
    parts = num2cell(block(:));
elseif isempty(block)
    % All parts are equal and share one value.
    rest = [size(block) ones(1, level)];
    parts = repmat({levels_of(zeros([rest(1:level - 1) 1]), names, level - 1, form)}, size(block, level), 1);
else
    others = repmat({':'}, 1, level - 1);
    parts = cell(size(block, level), 1);
    for k = 1:numel(parts)
        parts{k} = levels_of(block(others{:}, k), names, level - 1, form);
    end
end
value = struct(names{level}, {cells(parts, form)});
end

function value = cells(value, form)
% Return a sequence as a row, as in the original, or as a column, as in its first version.
if form.columns
    value = reshape(value, [], 1);
else
    value = reshape(value, 1, []);
end
end

function [value, at] = numbers(bytes, at, n)
if 8 * n > numel(bytes)
    fail('too many numbers');
end
value = reshape(typecast(bytes(at:at + 8 * n - 1), 'double'), n, 1);
at = at + 8 * n;
end

function [value, at] = text(bytes, at)
[n, at] = count(bytes, at);
if n > numel(bytes)
    fail('a text is too long');
end
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

function fail(reason)
error('genomix:connection', '%s', reason);
end
