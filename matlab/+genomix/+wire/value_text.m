function text = value_text(value)
%VALUE_TEXT  Return a default value as text for help and questions.

if iscell(value)
    text = ['{' strjoin(cellfun(@genomix.wire.value_text, value(:).', 'UniformOutput', false), ' ') '}'];
elseif ischar(value)
    text = value;
else
    text = sprintf('%.15g', value);
end
end
