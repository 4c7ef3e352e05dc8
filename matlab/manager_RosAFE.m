classdef manager_RosAFE < handle
%MANAGER_ROSAFE  Asks rosAFE for representations, and fetches them into a data object.
%
%   mObj = manager_RosAFE(dObj)                          % dObj: a dataObject_RosAFE
%   mObj = manager_RosAFE(dObj, 'ild', genParStruct('fb_nChannels', 16))
%   mObj.addProcessor('ratemap')                         % with all that it depends on
%   mObj.processChunk()                                  % the new frames are in dObj.ild{1}.Data now
%   mObj.modifyParameter('time_0', 'pp_bRemoveDC', '1')
%   mObj.deleteProcessor('ild', 1)
%   mObj.cleanup()
%
%   Representations are all that rosAFE has, those of plugins too: fieldnames(dObj) lists them. What is there already
%   with the same parameters is used again. Processors has a field for each kind of processor, with their parameters in
%   force: mObj.Processors.gammatone{1}.fb_cfHz.

    properties (SetAccess = private)
        Processors
        RosAFE
        dObj
    end

    properties (Access = private)
        told  % what getProcessors tells of all processors, [] before it was asked
    end

    methods
        function mObj = manager_RosAFE(dObj, request, p)
            if nargin < 1
                error('manager_RosAFE:arguments', 'a manager is built upon a dataObject_RosAFE');
            end
            mObj.dObj = dObj;
            mObj.RosAFE = dObj.RosAFE;
            update(mObj);
            if nargin > 1 && ~isempty(request)
                if nargin < 3
                    p = [];
                end
                mObj.addProcessor(request, p);
            end
        end

        function [out, varargout] = addProcessor(mObj, request, p)
            %ADDPROCESSOR  Have a representation computed: sOut = mObj.addProcessor(request, p)
            %
            %   P is a struct of parameters that are not the defaults, of the representation and of all that it depends
            %   on. REQUEST and P may be cell arrays, for several at once. SOUT is a row of the data object, a signal
            %   for each ear.
            if nargin < 2 || isempty(request)
                error('manager_RosAFE:arguments', 'addProcessor takes a representation, such as ''ild''');
            end
            if nargin < 3
                p = [];
            end
            if iscell(request) || iscell(p)
                [requests, parameters] = pairs(request, p);
                outs = cell(1, numel(requests));
                for k = 1:numel(requests)
                    outs{k} = mObj.addProcessor(requests{k}, parameters{k});
                end
                out = outs{1};
                varargout = outs(2:end);
                return
            end
            asked = mObj.RosAFE.request(request, parametersOf(mObj, p));
            refuse(asked);
            update(mObj);
            [~, kind] = named(mObj, asked.result.name);
            out = signalsOf(mObj.dObj, kind, asked.result.name);
        end

        function processor = hasProcessor(mObj, type, p)
            %HASPROCESSOR  The parameters of a processor that computes a type with given parameters, or 0.
            %
            %   TYPE: a representation or the request of its processors: 'ild', 'ildProc', 'onsetStrength', 'onsetProc'.
            %   P is a struct as that of addProcessor; what it lacks has to have its default.
            if nargin < 3
                p = [];
            end
            about = representations(mObj.dObj);
            asked = mObj.RosAFE.find(about.(typeOf(mObj, type)).word, parametersOf(mObj, p));
            update(mObj);
            processor = 0;
            if strcmp(asked.status, 'done')
                processor = named(mObj, asked.result.name);
            elseif isempty(regexp(asked.exception.ex, '::e_(noSuchProcessor|existsAlready)$', 'once'))
                refuse(asked);
            end
        end

        function processChunk(mObj)
            %PROCESSCHUNK  Add what all processors have computed since the last call to the signals of the data object.
            update(mObj);
            for processor = mObj.told
                got = mObj.RosAFE.getRepresentation('-m', processor{1}.name);
                if strcmp(got.status, 'error') && ~isempty(strfind(got.exception.ex, 'e_noSuchProcessor')) %#ok<STREMP>
                    continue % another client has just removed it
                end
                refuse(got);
                append(mObj, processor{1}, got.result.parts);
            end
        end

        function deleteProcessor(mObj, type, number)
            %DELETEPROCESSOR  Remove a processor and all that depend on it: by type and number, or by its name alone.
            name = type;
            if nargin > 2
                processors = mObj.Processors.(typeOf(mObj, type));
                if ~any(number == 1:numel(processors))
                    error('manager_RosAFE:number', 'there is no processor %g of type ''%s''', number, type);
                end
                name = processors{number}.name;
            end
            refuse(mObj.RosAFE.removeProcessor(name));
            update(mObj);
        end

        function modifyParameter(mObj, procName, paramName, newValue)
            %MODIFYPARAMETER  Change a parameter of a processor, by its name, to a text, a number or several of them.
            if iscell(newValue)
                newValue = strjoin(cellfun(@textOf, newValue(:).', 'UniformOutput', false), ' ');
            end
            refuse(mObj.RosAFE.modifyParameter(procName, paramName, textOf(newValue)));
            update(mObj);
        end

        function cleanup(mObj)
            %CLEANUP  Remove all processors but the input.
            update(mObj);
            roots = {''};
            for processor = mObj.told % in the order of creation: parents first
                if isempty(processor{1}.upperDepName)
                    roots{end + 1} = processor{1}.name; %#ok<AGROW>
                elseif any(strcmp(processor{1}.upperDepName, roots))
                    refuse(mObj.RosAFE.removeProcessor(processor{1}.name));
                end
            end
            update(mObj);
        end

        function reset(mObj)
            %RESET  Forget the frames that the data object holds.
            clearData(mObj.dObj);
        end
    end

    methods (Access = private)
        function update(mObj)
            % Ask for all processors, and have signals for just those, as they are now.
            asked = mObj.RosAFE.getProcessors();
            refuse(asked);
            processors = asked.result.processors(:).';
            kinds = representations(mObj.dObj);
            % What genomixd does not know, as the plugin that it is of is the node's alone, cannot be asked for here.
            processors = processors(cellfun(@(processor) isfield(kinds, processor.kind), processors));
            if isequal(mObj.told, processors)
                return
            end
            mObj.told = processors;
            arrange(mObj);
            for kind = fieldnames(mObj.Processors).'
                names = cellfun(@(processor) processor.name, mObj.Processors.(kind{1}), 'UniformOutput', false);
                keepOnly(mObj.dObj, kind{1}, names);
            end
            for processor = processors
                signals = newSignals(mObj, processor{1});
                held = signalsOf(mObj.dObj, processor{1}.kind, processor{1}.name);
                if isempty(held) || ~all(cellfun(@alike, signals, held))
                    addSignals(mObj.dObj, processor{1}.kind, signals);
                end
            end
        end

        function arrange(mObj)
            % Processors, by kind, with the values of their parameters.
            about = describe(mObj.RosAFE);
            types = about.services.request.parameters;
            mObj.Processors = structfun(@(kind) cell(1, 0), representations(mObj.dObj), 'UniformOutput', false);
            for processor = mObj.told
                values = struct('name', processor{1}.name);
                for parameter = processor{1}.parameters(:).'
                    name = parameter{1}.name;
                    words = isfield(types, name) && ~isempty(strfind(types.(name).type, 'string')); %#ok<STREMP>
                    values.(name) = valueOf(parameter{1}.value, words);
                end
                mObj.Processors.(processor{1}.kind){end + 1} = values;
            end
        end

        function kind = typeOf(mObj, name)
            % The kind of processors that is meant: 'gammatone' by that name, 'gammatoneProc' or 'filterbank'.
            kind = kindOf(mObj.dObj, name);
            if isempty(kind)
                error('manager_RosAFE:type', 'there is no type of processors ''%s''; there are: %s', name, ...
                    strjoin(fieldnames(mObj.dObj).', ', '));
            end
        end

        function [values, kind, processor] = named(mObj, name)
            % A processor: the values of its parameters, its kind, and what getProcessors tells of it.
            names = cellfun(@(processor) processor.name, mObj.told, 'UniformOutput', false);
            if ~any(strcmp(name, names))
                error('manager_RosAFE:removed', 'somebody has removed the processor %s', name);
            end
            processor = mObj.told{strcmp(name, names)};
            kind = processor.kind;
            same = cellfun(@(other) strcmp(other.name, name), mObj.Processors.(kind));
            values = mObj.Processors.(kind){same};
        end

        function signals = newSignals(mObj, processor)
            % Signals for what a processor computes: for each of its parts and, where those are of one ear, each ear.
            about = representations(mObj.dObj);
            about = about.(processor.kind);
            parts = fieldnames(about.parts);
            signals = cell(1, 0);
            for k = 1:numel(parts)
                name = about.word;
                if numel(parts) > 1
                    name = [name '_' parts{k}]; %#ok<AGROW>
                end
                axes_of = about.parts.(parts{k}).axes(:).';
                channels = {'mono'};
                if any(strcmp('ear', axes_of))
                    channels = {'left', 'right'};
                end
                for channel = channels
                    signals{end + 1} = newSignal(mObj, processor, name, rowsOf(axes_of), channel{1}); %#ok<AGROW>
                end
            end
        end

        function signal = newSignal(mObj, processor, name, rows, channel)
            % A signal of the class that the MATLAB front-end has for such axes.
            fs = processor.rate;
            label = processor.name;
            seconds = mObj.dObj.bufferSize_s_matlab;
            along = cellfun(@(axis) coordinates(mObj, processor, axis), rows, 'UniformOutput', false);
            if isempty(rows)
                signal = rosafe.signal('TimeDomainSignal', fs, seconds, name, label, channel);
            elseif strcmp(rows{1}, 'feature')
                signal = rosafe.signal('FeatureSignal', fs, seconds, name, label, along{1}, channel);
            elseif isscalar(rows)
                signal = rosafe.signal('TimeFrequencySignal', fs, seconds, name, label, along{1}, channel);
            elseif strcmp(rows{2}, 'lag')
                signal = rosafe.signal('CorrelationSignal', fs, seconds, name, label, along{:}, channel);
            else
                signal = rosafe.signal('ModulationSignal', fs, seconds, name, label, along{:}, channel);
            end
        end

        function values = coordinates(mObj, processor, axis)
            % What lies along an axis: the kind's own coordinate for its last axis, else what its parent says.
            n = sizeOf(processor, axis);
            about = representations(mObj.dObj);
            while true
                kind = about.(processor.kind);
                own = rowsOf(processor.axes(:).');
                if strcmp(axis, 'feature') && ~isempty(kind.features)
                    values = kind.features(:).';
                elseif ~isempty(own) && strcmp(own{end}, axis) && ~isempty(kind.coordinates)
                    values = named(mObj, processor.name);
                    values = values.(kind.coordinates{1});
                elseif ~isempty(processor.upperDepName)
                    [~, ~, processor] = named(mObj, processor.upperDepName);
                    continue
                else
                    values = {};
                end
                break
            end
            if numel(values) ~= n % nobody says
                values = num2cell(1:n);
            end
            if strcmp(axis, 'feature')
                values = cellfun(@textOf, values, 'UniformOutput', false);
            else
                values = cell2mat(values);
            end
        end

        function append(mObj, processor, parts)
            % What getRepresentation gives, as frames by rows for each ear, to the processor's signals.
            signals = signalsOf(mObj.dObj, processor.kind, processor.name);
            at = 0;
            for part = parts(:).'
                axes_of = part{1}.axes(:).';
                rows = rowsOf(axes_of);
                sizes = part{1}.shape(:).';
                ears = prod(sizes(strcmp('ear', axes_of)));
                fits = cellfun(@(axis) sizes(strcmp(axis, axes_of)) == sizeOf(processor, axis), rows);
                if all(fits) && sizes(end) > 0 % else they have changed since getProcessors
                    [~, order] = ismember([{'time'} rows {'ear'}], fliplr(axes_of));
                    order(order == 0) = [];
                    data = permute(reshape(part{1}.data, [fliplr(sizes) 1]), [order, numel(order) + 1]);
                    data = reshape(data, [], ears);
                    for k = 1:ears
                        shape = cellfun(@(axis) sizeOf(processor, axis), rows);
                        appendChunk(signals{at + k}, reshape(data(:, k), [sizes(end), shape, 1]));
                    end
                end
                at = at + ears;
            end
        end

        function parameters = parametersOf(mObj, p)
            % What is given, and what the data object says about the input.
            parameters = struct( ...
                'nFramesPerBlock', mObj.dObj.framesPerChunk, ...
                'bufferSize_s_port', mObj.dObj.bufferSize_s_rosAFE_port, ...
                'bufferSize_s_getSignal', mObj.dObj.bufferSize_s_rosAFE_getSignal);
            p = plain(p);
            if isfield(p, 'pp_bMiddleEarFiltering') && ~isfield(p, 'pp_bUnityComp')
                p.pp_bUnityComp = 1; % the default of the MATLAB front-end; without the filter it means nothing
            end
            for name = fieldnames(p).'
                parameters.(name{1}) = p.(name{1});
            end
        end
    end
end

function rows = rowsOf(axes_of)
% The axes less ears and time.
rows = axes_of(~ismember(axes_of, {'ear', 'time'}));
end

function n = sizeOf(processor, axis)
% How much of an axis a processor puts out.
shape = [processor.shape{:}];
n = shape(strcmp(axis, processor.axes(:).'));
end

function yes = alike(signal, held)
% Whether the frames of one signal can follow those of another.
yes = strcmp(class(signal), class(held));
for name = {'FsHz', 'cfHz', 'lags', 'modCfHz', 'fList'}
    yes = yes && (~isprop(signal, name{1}) || isequal(signal.(name{1}), held.(name{1})));
end
end

function value = valueOf(text, words)
% The value that a text of getProcessors tells: a number or, where WORDS is true, a word; or a row of them.
value = text;
if ~isempty(text) && text(1) == '['
    value = strtrim(strsplit(text(2:end - 1), ','));
    value = value(~cellfun(@isempty, value));
    if ~words
        value = num2cell(str2double(value));
    end
elseif ~words
    value = str2double(text);
end
end

function text = textOf(value)
% The text that modifyParameter reads as a value, to the last digit.
if ischar(value)
    text = strtrim(value);
else
    text = strtrim(sprintf('%.17g ', value));
end
end

function p = plain(p)
% A struct, also of the parameter object of the MATLAB front-end.
if isempty(p)
    p = struct();
elseif isstruct(p) && ~isscalar(p)
    error('manager_RosAFE:arguments', 'there are %d structures of parameters in place of one', numel(p));
elseif isobject(p)
    p = cell2struct(values(p.map).', keys(p.map).', 1);
end
end

function [requests, parameters] = pairs(request, p)
if ~iscell(request)
    request = repmat({request}, size(p));
elseif ~iscell(p)
    p = repmat({p}, size(request));
elseif numel(request) == 1
    request = repmat(request, size(p));
end
if numel(request) ~= numel(p)
    error('manager_RosAFE:arguments', 'there are %d requests and %d structures of parameters', numel(request), ...
        numel(p));
end
requests = request;
parameters = p;
end

function refuse(request)
if strcmp(request.status, 'error')
    error('manager_RosAFE:refused', 'Error%s', genomix.request.explain(request.exception));
elseif ~isempty(request.warning)
    warning('manager_RosAFE:word', '%s', request.warning);
end
end
