function answers = ask(about)
%ASK  Ask the user for the arguments of a service or the element of a port; Return selects the default.

answers = {};
if isfield(about, 'multiple')
    if about.multiple
        answers = {unquoted(input('string element: name of the processor > ', 's'))};
    end
    return
end
args = struct();
names = fieldnames(about.parameters);
for k = 1:numel(names)
    parameter = about.parameters.(names{k});
    default = '';
    if ~parameter.required
        default = [' (' genomix.wire.value_text(parameter.default) ')'];
    end
    answer = unquoted(input(sprintf('%s %s: %s%s > ', parameter.type, names{k}, parameter.doc, default), 's'));
    if ~isempty(answer)
        args.(names{k}) = answer; % genomixd accepts numbers as texts
    end
end
if ~isempty(names)
    answers = {args};
end
end

function text = unquoted(text)
% Remove one pair of quotes, because users type texts as in a script.
text = regexprep(strtrim(text), '^([''"])(.*)\1$', '$2');
end
