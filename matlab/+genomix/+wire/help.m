function text = help(component, name, about)
%HELP  Return the description of a service or port as text.

lines = {sprintf('%s.%s: %s', component, name, about.doc)};
if isfield(about, 'multiple')
    if about.multiple
        lines{1} = sprintf('%s.%s(''processor''): %s', component, name, about.doc);
    end
    text = lines{1};
    return
end
names = fieldnames(about.parameters);
for k = 1:numel(names)
    parameter = about.parameters.(names{k});
    line = sprintf('  %s %s: %s', parameter.type, names{k}, parameter.doc);
    if ~parameter.required
        line = [line ' (' genomix.wire.value_text(parameter.default) ')']; %#ok<AGROW>
    end
    if ~isempty(parameter.range)
        line = [line ', ' parameter.range]; %#ok<AGROW>
    end
    lines{end + 1} = line; %#ok<AGROW>
end
outputs = fieldnames(about.outputs);
if ~isempty(outputs)
    lines{end + 1} = ['  result: ' strjoin(outputs.', ', ')];
end
text = strjoin(lines, sprintf('\n'));
end
