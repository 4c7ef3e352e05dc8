function text = encode(value)
%ENCODE  Encode an argument of a request as JSON.
%
%   Supported are numbers, logicals, texts, cell arrays and matrices (as sequences), and structs (as objects). Other
%   values raise the error genomix:argument.

value = genomix.wire.chars(value);
if ischar(value) && (isrow(value) || isempty(value))
    text = quoted(value);
elseif iscell(value)
    items = cellfun(@genomix.wire.encode, value(:).', 'UniformOutput', false);
    text = ['[' strjoin(items, ',') ']'];
elseif isstruct(value) && isscalar(value)
    names = fieldnames(value);
    items = cell(1, numel(names));
    for k = 1:numel(names)
        items{k} = [quoted(names{k}) ':' genomix.wire.encode(value.(names{k}))];
    end
    text = ['{' strjoin(items, ',') '}'];
elseif (isnumeric(value) || islogical(value)) && isreal(value)
    items = arrayfun(@number, value(:).', 'UniformOutput', false);
    text = strjoin(items, ',');
    if ~isscalar(value)
        text = ['[' text ']'];
    end
else
    error('genomix:argument', 'expected a number, text, cell array, matrix or struct, got %s (%s)', class(value), ...
        strjoin(arrayfun(@int2str, size(value), 'UniformOutput', false), 'x'));
end
end

function text = number(value)
if isinteger(value) || islogical(value)
    text = sprintf('%d', value);
elseif isinf(value)
    signs = {'-', ''};
    text = [signs{1 + (value > 0)} 'Infinity'];
else
    text = sprintf('%.17g', value);
end
end

function text = quoted(value)
genomix.wire.utf8(value); % raises an error if it is not valid
value = strrep(strrep(value, '\', '\\'), '"', '\"');
if any(value < ' ')
    for code = 0:31
        value = strrep(value, char(code), sprintf('\\u%04x', code));
    end
end
text = ['"' value '"'];
end
