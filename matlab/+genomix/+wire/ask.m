function answers = ask(about)
%ASK  The arguments of a service, or the element of a port, that a person at the prompt gives; Return takes the default.

answers = {};
if isfield(about, 'multiple')
    if about.multiple
        answers = {input('string element: name of the processor > ', 's')};
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
    answer = input(sprintf('%s %s: %s%s > ', parameter.type, names{k}, parameter.doc, default), 's');
    if ~isempty(answer)
        given.(names{k}) = answer; % genomixd reads numbers in texts
    end
end
if ~isempty(names)
    answers = {given};
end
end
