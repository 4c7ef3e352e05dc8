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
%   Representations: 'time', 'filterbank', 'innerhaircell', 'ild', 'ratemap', 'crosscorrelation'. What is there already
%   with the same parameters is used again. Processors has a field for each type of processor, with their parameters as
%   getParameters tells them: mObj.Processors.gammatone{1}.fb_cfHz.

    properties (SetAccess = private)
        Processors
        RosAFE
        dObj
    end

    properties (Constant, Access = private)
        % The types of processors, as getParameters calls them; the representation of each in the data object; their
        % requests; how the original calls them in hasProcessor.
        TYPES = struct( ...
            'type', {'input', 'preProc', 'gammatone', 'ihc', 'ild', 'ratemap', 'crossCorrelation'}, ...
            'signal', {'input', 'preProc', 'filterbank', 'innerhaircell', 'ild', 'ratemap', 'crosscorrelation'}, ...
            'request', {'InputProc', 'PreProc', 'GammatoneProc', 'IhcProc', 'IldProc', 'RatemapProc', ...
                'CrossCorrelationProc'}, ...
            'binaural', {true, true, true, true, false, true, false});
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
            name = asked.result.name;
            for kind = mObj.TYPES
                row = find(strcmp(name, labels(mObj.dObj, kind.signal)));
                if ~isempty(row)
                    out = mObj.dObj.(kind.signal)(row, :);
                end
            end
        end

        function processor = hasProcessor(mObj, type, p)
            %HASPROCESSOR  The parameters of a processor that computes a type with given parameters, or 0.
            %
            %   TYPE: 'input', 'preProc', 'gammatoneProc', 'ihcProc', 'ildProc', 'ratemapProc', 'crosscorrelationProc'.
            %   P is a struct as that of addProcessor; what it lacks has to have its default.
            if nargin < 3 || isempty(p)
                p = struct();
            end
            update(mObj);
            processor = 0;
            for candidate = mObj.Processors.(typeOf(mObj, type))(:).'
                chain = mObj.RosAFE.getDependencies(candidate{1}.name);
                refuse(chain);
                if all(cellfun(@(name) hasParameters(mObj, name, p), chain.result.dependencies))
                    processor = candidate{1};
                    return
                end
            end
        end

        function processChunk(mObj)
            %PROCESSCHUNK  Add what all processors have computed since the last call to the signals of the data object.
            update(mObj);
            output = mObj.RosAFE.getSignals('-m');
            refuse(output);
            signals = output.result.signals;
            for kind = mObj.TYPES
                names = namesOf(mObj.Processors.(kind.type));
                chunks = signals.(kind.type);
                if numel(chunks) ~= numel(names)
                    continue % another client changes the tree just now: getSignals names none, the next call will do
                end
                for k = 1:numel(names)
                    if chunks{k}.framesOnPort > 0
                        append(mObj, kind, names{k}, chunks{k});
                    end
                end
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
            %MODIFYPARAMETER  Change a parameter of a processor, by the processor's name, to a text or a number.
            if ~ischar(newValue)
                newValue = sprintf('%.17g ', newValue);
            end
            refuse(mObj.RosAFE.modifyParameter(procName, paramName, strtrim(newValue)));
            update(mObj);
        end

        function cleanup(mObj)
            %CLEANUP  Remove all processors but the input.
            update(mObj);
            for processor = mObj.Processors.preProc(:).'
                refuse(mObj.RosAFE.removeProcessor(processor{1}.name));
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
            asked = mObj.RosAFE.getParameters();
            refuse(asked);
            if isequal(mObj.Processors, asked.result.parameters)
                return
            end
            mObj.Processors = asked.result.parameters;
            for kind = mObj.TYPES
                processors = mObj.Processors.(kind.type);
                keepOnly(mObj.dObj, kind.signal, namesOf(processors));
                for k = 1:numel(processors)
                    signals = signalsOf(mObj, kind, processors{k});
                    row = find(strcmp(processors{k}.name, labels(mObj.dObj, kind.signal)));
                    if isempty(row) || ~alike(signals{1}, mObj.dObj.(kind.signal){row, 1})
                        cellfun(@(signal) addSignal(mObj.dObj, signal), signals);
                    end
                end
            end
        end

        function type = typeOf(mObj, name)
            % The type of processors that is meant: 'gammatone' by that name, 'gammatoneProc' or 'filterbank'.
            if strcmpi(name, 'time')
                name = 'preProc';
            end
            kinds = mObj.TYPES;
            meant = strcmpi(name, {kinds.type}) | strcmpi(name, {kinds.request}) | strcmpi(name, {kinds.signal});
            if ~any(meant)
                error('manager_RosAFE:type', 'there is no type of processors ''%s''', name);
            end
            type = kinds(meant).type;
        end

        function signals = signalsOf(mObj, kind, processor)
            % New signals for what a processor computes, one for each ear.
            channels = {'left', 'right'};
            if ~kind.binaural
                channels = {'mono'};
            end
            fs = mObj.dObj.sampleRate;
            seconds = mObj.dObj.bufferSize_s_matlab;
            switch kind.type
                case {'input', 'preProc'}
                    make = @(channel) TimeDomainSignal.construct(fs, seconds, kind.signal, processor.name, channel);
                case 'crossCorrelation'
                    cfHz = frequencies(mObj, processor.name);
                    make = @(channel) CorrelationSignal(1 / processor.cc_hSizeSec, seconds, kind.signal, ...
                        processor.name, cfHz, cell2mat(processor.cc_lags), channel);
                otherwise
                    if isfield(processor, 'ild_hSizeSec')
                        fs = 1 / processor.ild_hSizeSec;
                    elseif isfield(processor, 'rm_hSizeSec')
                        fs = 1 / processor.rm_hSizeSec;
                    end
                    cfHz = frequencies(mObj, processor.name);
                    make = @(channel) TimeFrequencySignal.construct(fs, seconds, kind.signal, processor.name, cfHz, ...
                        channel);
            end
            signals = cellfun(make, channels, 'UniformOutput', false);
        end

        function cfHz = frequencies(mObj, name)
            % The centre frequencies of the filterbank that a processor hangs on, or is.
            chain = mObj.RosAFE.getDependencies(name);
            refuse(chain);
            cfHz = [];
            for bank = mObj.Processors.gammatone(:).'
                if any(strcmp(bank{1}.name, chain.result.dependencies))
                    cfHz = cell2mat(bank{1}.fb_cfHz);
                end
            end
        end

        function append(mObj, kind, name, chunk)
            row = find(strcmp(name, labels(mObj.dObj, kind.signal)));
            signals = mObj.dObj.(kind.signal)(row, :);
            axes = {'cfHz', 'lags'};
            for k = 1:2 % channels, lags
                if isprop(signals{1}, axes{k}) && ~isempty(signals{1}.(axes{k})) && ...
                        size(chunk.left, 1 + k) ~= numel(signals{1}.(axes{k}))
                    return % they have changed since getParameters
                end
            end
            appendChunk(signals{1}, chunk.left);
            if kind.binaural
                appendChunk(signals{2}, chunk.right);
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

        function yes = hasParameters(mObj, name, p)
            % Whether a processor has the parameters of P, and else its defaults.
            p = plain(p);
            for kind = mObj.TYPES
                for processor = mObj.Processors.(kind.type)(:).'
                    if strcmp(processor{1}.name, name)
                        about = describe(mObj.RosAFE);
                        defaults = about.services.(kind.request).parameters;
                        yes = all(cellfun(@(field) same(field, processor{1}, p, defaults), fieldnames(processor{1})));
                        return
                    end
                end
            end
            yes = false;
        end
    end
end

function names = namesOf(processors)
names = cellfun(@(processor) processor.name, processors, 'UniformOutput', false);
end

function yes = alike(signal, held)
% Whether the frames of one signal can follow those of another.
yes = true;
for name = {'FsHz', 'cfHz', 'lags'}
    yes = yes && (~isprop(signal, name{1}) || isequal(signal.(name{1}), held.(name{1})));
end
end

function yes = same(field, processor, p, defaults)
wanted = [];
if isfield(p, field)
    wanted = p.(field);
elseif isfield(defaults, field) && ~any(strcmp(field, derived(p)))
    wanted = defaults.(field).default;
end
if iscell(wanted)
    wanted = cell2mat(wanted);
end
value = processor.(field);
if iscell(value)
    value = cell2mat(value);
end
yes = isempty(wanted) || isequal(wanted(:), value(:));
end

function names = derived(p)
% What getParameters tells as it came out of what is given, and not as it was asked for.
names = {'name', 'fb_cfHz', 'fb_nChannels'};
if isfield(p, 'fb_nChannels') || isfield(p, 'fb_cfHz')
    names{end + 1} = 'fb_nERBs';
end
if isfield(p, 'fb_cfHz')
    names = [names {'fb_lowFreqHz', 'fb_highFreqHz'}];
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
end
end
