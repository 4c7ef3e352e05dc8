classdef manager_RosAFE < handle
%MANAGER_ROSAFE  Requests representations from rosAFE and reads them into a data object.
%
%   mObj = manager_RosAFE(dObj)                          % dObj: a dataObject_RosAFE
%   mObj = manager_RosAFE(dObj, 'ild', genParStruct('fb_nChannels', 16))
%   mObj.addProcessor('ratemap')                         % with all processors that it needs
%   mObj.processChunk()                                  % appends new frames to dObj.ild{1}.Data
%   mObj.modifyParameter('time_0', 'pp_bRemoveDC', '1')
%   mObj.deleteProcessor('ild', 1)
%   mObj.cleanup()
%
%   All representations of rosAFE are available, including plugins; fieldnames(dObj) lists them. Existing processors
%   with the same parameters are reused. Processors has one field for each kind of processor, with the current
%   parameters: mObj.Processors.gammatone{1}.fb_cfHz.

    properties (SetAccess = private)
        Processors
        RosAFE
        dObj
    end

    properties (Access = private)
        listed  % the processors listed by getProcessors; [] before the first call
    end

    methods
        function mObj = manager_RosAFE(dObj, request, p)
            if nargin < 1
                error('manager_RosAFE:arguments', 'manager_RosAFE: expected a dataObject_RosAFE');
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
            %ADDPROCESSOR  Request a representation: sOut = mObj.addProcessor(request, p)
            %
            %   P is a struct with parameters of the representation and of the processors that it needs; the others have
            %   their defaults. REQUEST and P may be cell arrays for several representations. SOUT is a row of the data
            %   object: one signal for each ear.
            if nargin < 2 || isempty(request)
                error('manager_RosAFE:arguments', 'addProcessor: expected a representation, for example ''ild''');
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
            answer = mObj.RosAFE.request(request, parametersOf(mObj, p));
            check(answer);
            update(mObj);
            [~, kind] = named(mObj, answer.result.name);
            out = signalsOf(mObj.dObj, kind, answer.result.name);
        end

        function processor = hasProcessor(mObj, type, p)
            %HASPROCESSOR  Return the parameters of a processor of a type with given parameters, or 0.
            %
            %   TYPE is a representation or its request: 'ild', 'ildProc', 'onsetStrength', 'onsetProc'. P is a struct
            %   as in addProcessor; other parameters must have their defaults.
            if nargin < 3
                p = [];
            end
            about = representations(mObj.dObj);
            answer = mObj.RosAFE.find(about.(typeOf(mObj, type)).word, parametersOf(mObj, p));
            update(mObj);
            processor = 0;
            if strcmp(answer.status, 'done')
                processor = named(mObj, answer.result.name);
            elseif isempty(regexp(answer.exception.ex, '::e_(noSuchProcessor|existsAlready)$', 'once'))
                check(answer);
            end
        end

        function processChunk(mObj)
            %PROCESSCHUNK  Append the new frames of all processors to the signals of the data object.
            update(mObj);
            for processor = mObj.listed
                answer = mObj.RosAFE.getRepresentation('-m', processor{1}.name);
                failed = strcmp(answer.status, 'error');
                if failed && ~isempty(strfind(answer.exception.ex, 'e_noSuchProcessor')) %#ok<STREMP>
                    continue % another client has removed the processor
                end
                check(answer);
                append(mObj, processor{1}, answer.result.parts);
            end
        end

        function deleteProcessor(mObj, type, number)
            %DELETEPROCESSOR  Remove a processor and all that depend on it, by type and number or by name.
            name = type;
            if nargin > 2
                processors = mObj.Processors.(typeOf(mObj, type));
                if ~any(number == 1:numel(processors))
                    error('manager_RosAFE:number', 'number: expected 1 to %d for type ''%s'', got %g', ...
                        numel(processors), type, number);
                end
                name = processors{number}.name;
            end
            check(mObj.RosAFE.removeProcessor(name));
            update(mObj);
        end

        function modifyParameter(mObj, procName, paramName, newValue)
            %MODIFYPARAMETER  Change a parameter of a processor to a text, a number, or a cell array of these.
            if iscell(newValue)
                newValue = strjoin(cellfun(@textOf, newValue(:).', 'UniformOutput', false), ' ');
            end
            check(mObj.RosAFE.modifyParameter(procName, paramName, textOf(newValue)));
            update(mObj);
        end

        function cleanup(mObj)
            %CLEANUP  Remove all processors except the input.
            update(mObj);
            roots = {''};
            for processor = mObj.listed % in the order of creation, parents first
                if isempty(processor{1}.upperDepName)
                    roots{end + 1} = processor{1}.name; %#ok<AGROW>
                elseif any(strcmp(processor{1}.upperDepName, roots))
                    check(mObj.RosAFE.removeProcessor(processor{1}.name));
                end
            end
            update(mObj);
        end

        function reset(mObj)
            %RESET  Remove all frames from the data object.
            clearData(mObj.dObj);
        end
    end

    methods (Access = private)
        function update(mObj)
            % Read the list of processors, and create or remove signals accordingly.
            answer = mObj.RosAFE.getProcessors();
            check(answer);
            processors = answer.result.processors(:).';
            kinds = representations(mObj.dObj);
            % Ignore processors of plugins that genomixd has not loaded.
            processors = processors(cellfun(@(processor) isfield(kinds, processor.kind), processors));
            if isequal(mObj.listed, processors)
                return
            end
            mObj.listed = processors;
            arrange(mObj);
            for kind = fieldnames(mObj.Processors).'
                names = cellfun(@(processor) processor.name, mObj.Processors.(kind{1}), 'UniformOutput', false);
                keepOnly(mObj.dObj, kind{1}, names);
            end
            for processor = processors
                signals = newSignals(mObj, processor{1});
                stored = signalsOf(mObj.dObj, processor{1}.kind, processor{1}.name);
                if isempty(stored) || ~all(cellfun(@compatible, signals, stored))
                    addSignals(mObj.dObj, processor{1}.kind, signals);
                end
            end
        end

        function arrange(mObj)
            % Set Processors: by kind, with the values of their parameters.
            about = describe(mObj.RosAFE);
            types = about.services.request.parameters;
            mObj.Processors = structfun(@(kind) cell(1, 0), representations(mObj.dObj), 'UniformOutput', false);
            for processor = mObj.listed
                values = struct('name', processor{1}.name);
                for parameter = processor{1}.parameters(:).'
                    name = parameter{1}.name;
                    isText = isfield(types, name) && ~isempty(strfind(types.(name).type, 'string')); %#ok<STREMP>
                    values.(name) = valueOf(parameter{1}.value, isText);
                end
                mObj.Processors.(processor{1}.kind){end + 1} = values;
            end
        end

        function kind = typeOf(mObj, name)
            % Return the kind for a name, for example 'gammatone' for 'gammatoneProc' or 'filterbank'.
            kind = kindOf(mObj.dObj, name);
            if isempty(kind)
                error('manager_RosAFE:type', 'type: expected one of %s, got ''%s''', ...
                    strjoin(fieldnames(mObj.dObj).', ', '), name);
            end
        end

        function [values, kind, processor] = named(mObj, name)
            % Return the parameters of a processor, its kind, and its entry in the list of processors.
            names = cellfun(@(processor) processor.name, mObj.listed, 'UniformOutput', false);
            if ~any(strcmp(name, names))
                error('manager_RosAFE:removed', 'the processor %s has been removed by another client', name);
            end
            processor = mObj.listed{strcmp(name, names)};
            kind = processor.kind;
            same = cellfun(@(other) strcmp(other.name, name), mObj.Processors.(kind));
            values = mObj.Processors.(kind){same};
        end

        function signals = newSignals(mObj, processor)
            % Create the signals of a processor: one for each part, and for each ear if the part has ears.
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
            % Create a signal of the class that the MATLAB Auditory Front-End uses for these axes.
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
            % Return the coordinates of an axis: those of the kind for its last axis, otherwise those of the parent.
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
            if numel(values) ~= n % no coordinates are known
                values = num2cell(1:n);
            end
            if strcmp(axis, 'feature')
                values = cellfun(@textOf, values, 'UniformOutput', false);
            else
                values = cell2mat(values);
            end
        end

        function append(mObj, processor, parts)
            % Append the answer of getRepresentation to the signals of the processor: frames by rows for each ear.
            signals = signalsOf(mObj.dObj, processor.kind, processor.name);
            at = 0;
            for part = parts(:).'
                axes_of = part{1}.axes(:).';
                rows = rowsOf(axes_of);
                sizes = part{1}.shape(:).';
                ears = prod(sizes(strcmp('ear', axes_of)));
                fits = cellfun(@(axis) sizes(strcmp(axis, axes_of)) == sizeOf(processor, axis), rows);
                if all(fits) && sizes(end) > 0 % otherwise, they have changed since getProcessors
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
            % Return the given parameters and those of the input.
            parameters = struct( ...
                'nFramesPerBlock', mObj.dObj.framesPerChunk, ...
                'bufferSize_s_port', mObj.dObj.bufferSize_s_rosAFE_port, ...
                'bufferSize_s_getSignal', mObj.dObj.bufferSize_s_rosAFE_getSignal);
            p = plain(p);
            if isfield(p, 'pp_bMiddleEarFiltering') && ~isfield(p, 'pp_bUnityComp')
                p.pp_bUnityComp = 1; % the default of the MATLAB Auditory Front-End; used with this filter only
            end
            for name = fieldnames(p).'
                parameters.(name{1}) = p.(name{1});
            end
        end
    end
end

function rows = rowsOf(axes_of)
% Return the axes except ears and time.
rows = axes_of(~ismember(axes_of, {'ear', 'time'}));
end

function n = sizeOf(processor, axis)
% Return the size of an axis.
shape = [processor.shape{:}];
n = shape(strcmp(axis, processor.axes(:).'));
end

function yes = compatible(signal, stored)
% Return whether the frames of one signal can be appended to another.
yes = strcmp(class(signal), class(stored));
for name = {'FsHz', 'cfHz', 'lags', 'modCfHz', 'fList'}
    yes = yes && (~isprop(signal, name{1}) || isequal(signal.(name{1}), stored.(name{1})));
end
end

function value = valueOf(text, isText)
% Convert a text of getProcessors to a value: a number, a text if ISTEXT is true, or a row of these.
value = text;
if ~isempty(text) && text(1) == '['
    value = strtrim(strsplit(text(2:end - 1), ','));
    value = value(~cellfun(@isempty, value));
    if ~isText
        value = num2cell(str2double(value));
    end
elseif ~isText
    value = str2double(text);
end
end

function text = textOf(value)
% Convert a value to a text for modifyParameter with full precision.
if ischar(value)
    text = strtrim(value);
else
    text = strtrim(sprintf('%.17g ', value));
end
end

function p = plain(p)
% Convert parameters to a struct, also a parameter object of the MATLAB Auditory Front-End.
if isempty(p)
    p = struct();
elseif isstruct(p) && ~isscalar(p)
    error('manager_RosAFE:arguments', 'p: expected one structure of parameters, got %d', numel(p));
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
    error('manager_RosAFE:arguments', 'p: expected %d structures of parameters, one for each request, got %d', ...
        numel(request), numel(p));
end
requests = request;
parameters = p;
end

function check(request)
if strcmp(request.status, 'error')
    error('manager_RosAFE:refused', 'Error%s', genomix.request.explain(request.exception));
elseif ~isempty(request.warning)
    warning('manager_RosAFE:word', '%s', request.warning);
end
end
