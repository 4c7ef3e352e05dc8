function [value, failed] = decode(bytes, matrices, columns)
%DECODE  The value of a packed answer of genomixd (docs/genomixd.md), a row of uint8.
%
%   A structure becomes a struct. A sequence becomes a 1-by-N cell array, also one of numbers, and N-by-1 where COLUMNS
%   is true. Where MATRICES is true, a sequence of numbers becomes an N-by-1 matrix, and a signal a matrix: frames,
%   frames by channels, or frames by channels by lags. FAILED is true for an exception.
%
%   Bytes that are no such answer raise the error genomix:connection. No size is believed that is not there.

form = struct('matrices', matrices, 'columns', nargin > 2 && columns);
try
    failed = bytes(1) == uint8('!');
    [value, at] = item(bytes, 1 + failed, form, 0);
    if at <= numel(bytes)
        refuse('something follows its end');
    end
    if failed && ~(isstruct(value) && isfield(value, 'ex') && ischar(value.ex))
        refuse('an exception without a name');
    end
catch problem
    error('genomix:connection', 'an answer that this version of +genomix cannot read (%s)', problem.message);
end
end

function [value, at] = item(bytes, at, form, depth)
% The value that begins there, and where the next one does. Reading past the end is an error of the index.
DEEPEST = 50;
MANY = 2e4;
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
            if n > MANY || depth > DEEPEST
                refuse('too many elements');
            elseif n > numel(value)
                value{2 * n} = []; % room for as many again
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
            if n > MANY || depth > DEEPEST || bytes(at) ~= uint8('s')
                refuse('no structure');
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
        refuse(sprintf('kind %d', kind));
end
end

function [value, at] = signal(bytes, at, form)
LARGEST = 1e6; % of what is empty, and so takes no bytes
[levels, at] = count(bytes, at);
if levels < 1 || levels > 8
    refuse('a signal of too many levels');
end
names = cell(1, levels);
sizes = ones(1, max(levels, 2)); % the innermost first, as MATLAB counts dimensions
for k = levels:-1:1
    [names{k}, at] = text(bytes, at);
    if ~isvarname(names{k})
        refuse('a level without a name');
    end
    [sizes(k), at] = count(bytes, at);
end
if ~all(sizes) && any(sizes > LARGEST)
    refuse('too large for something empty');
end
[value, at] = numbers(bytes, at, prod(sizes));
value = reshape(value, sizes);
if ~form.matrices
    value = levels_of(value, names, levels, form);
end
end

function value = levels_of(block, names, level, form)
% The structs and cells of one level: dataN of data, for instance.
if level == 1
    parts = num2cell(block(:));
elseif isempty(block)
    % All parts are alike; they share one.
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
% A sequence: a row, as in the original, or a column, as in its first version.
if form.columns
    value = reshape(value, [], 1);
else
    value = reshape(value, 1, []);
end
end

function [value, at] = numbers(bytes, at, n)
if 8 * n > numel(bytes)
    refuse('too many numbers');
end
value = reshape(typecast(bytes(at:at + 8 * n - 1), 'double'), n, 1);
at = at + 8 * n;
end

function [value, at] = text(bytes, at)
[n, at] = count(bytes, at);
if n > numel(bytes)
    refuse('too long a text');
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

function refuse(why)
error('genomix:connection', '%s', why);
end
