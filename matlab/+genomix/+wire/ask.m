function answers = ask(about)
%ASK  The arguments of a service, or the element of a port, that a person at the prompt gives; Return takes the default.

answers = {};
if isfield(about, 'multiple')
    if about.multiple
        answers = {unquoted(input('string element: name of the processor > ', 's'))};
    end
    return
end
given = struct();
names = fieldnames(about.parameters);
for k = 1:numel(names)
    parameter = about.parameters.(names{k});
    default = '';
    if ~parameter.required
        default = [' (' genomix.wire.shown(parameter.default) ')'];
    end
    answer = unquoted(input(sprintf('%s %s: %s%s > ', parameter.type, names{k}, parameter.doc, default), 's'));
    if ~isempty(answer)
        given.(names{k}) = answer; % genomixd reads numbers in texts
    end
end
if ~isempty(names)
    answers = {given};
end
end

function text = unquoted(text)
% People type texts as in a script, with their quotes: one pair is not part of them.
text = regexprep(strtrim(text), '^([''"])(.*)\1$', '$2');
end
