function text = shown(value)
%SHOWN  A default value as help and questions show it.

if iscell(value)
    text = ['{' strjoin(cellfun(@genomix.wire.shown, value(:).', 'UniformOutput', false), ' ') '}'];
elseif ischar(value)
    text = value;
else
    text = sprintf('%.15g', value);
end
end
