classdef dataObject_RosAFE < handle
%DATAOBJECT_ROSAFE  Starts the sound, and holds what a manager_RosAFE fetches of the representations.
%
%   dObj = dataObject_RosAFE(bass, rosAFE, inputDevice, sampleRate, framesPerChunk)
%   dObj = dataObject_RosAFE(bass, rosAFE, inputDevice, sampleRate, framesPerChunk, bufferSize_s_bass, ...
%       bufferSize_s_rosAFE_port, bufferSize_s_rosAFE_getSignal, bufferSize_s_matlab)
%
%   The buffers are in seconds: of bass's port (1), of rosAFE's ports (1), of what getSignals can return (0.5), and of
%   the signals here (10). Every representation that rosAFE has is a cell array with a row for each of its processors:
%   dObj.ild{1, 1}, and with a column for each ear where it has two: dObj.ratemap{1, 2} is the right one; precedence has
%   columns for time and level differences and correlations. dObj.ild{1}.Data holds the numbers (BufferedSignal).

    properties (SetAccess = private)
        bass
        RosAFE
        sampleRate
        framesPerChunk
        bufferSize_s_rosAFE_port
        bufferSize_s_rosAFE_getSignal
        bufferSize_s_matlab
        acquire  % the request of the acquisition
    end

    properties (Access = private)
        kinds   % what genomixd tells of the representations, by kind
        held    % cell arrays of signals, by kind
    end

    properties (Constant, Access = private)
        CHUNK = 2205; % frames that bass reads at a time
    end

    methods
        function dObj = dataObject_RosAFE(bass, rosAFE, inputDevice, sampleRate, framesPerChunk, bufferSize_s_bass, ...
                bufferSize_s_rosAFE_port, bufferSize_s_rosAFE_getSignal, bufferSize_s_matlab)
            if nargin < 5
                error('dataObject_RosAFE:arguments', ['dataObject_RosAFE takes bass, rosAFE, inputDevice, ' ...
                    'sampleRate, framesPerChunk, and up to four buffer sizes']);
            end
            sizes = {1, 1, 0.5, 10};
            if nargin > 5, sizes{1} = bufferSize_s_bass; end
            if nargin > 6, sizes{2} = bufferSize_s_rosAFE_port; end
            if nargin > 7, sizes{3} = bufferSize_s_rosAFE_getSignal; end
            if nargin > 8, sizes{4} = bufferSize_s_matlab; end
            dObj.bass = bass;
            dObj.RosAFE = rosAFE;
            dObj.sampleRate = sampleRate;
            dObj.framesPerChunk = framesPerChunk;
            [seconds, dObj.bufferSize_s_rosAFE_port, dObj.bufferSize_s_rosAFE_getSignal, dObj.bufferSize_s_matlab] = ...
                sizes{:};
            about = describe(rosAFE);
            dObj.kinds = about.representations;
            dObj.held = structfun(@(kind) {}, dObj.kinds, 'UniformOutput', false);
            dObj.acquire = rosafe.acquire(bass, rosAFE, sampleRate, seconds, dObj.CHUNK, inputDevice);
        end

        function varargout = subsref(dObj, s)
            % Representations are read like properties: dObj.ild, also by another of their names.
            kind = '';
            if strcmp(s(1).type, '.')
                kind = kindOf(dObj, s(1).subs);
            end
            if isempty(kind)
                [varargout{1:nargout}] = builtin('subsref', dObj, s);
            elseif isscalar(s)
                varargout = {dObj.held.(kind)};
            else
                [varargout{1:max(1, nargout)}] = subsref(dObj.held.(kind), s(2:end));
            end
        end

        function kind = kindOf(dObj, name)
            %KINDOF  The kind of representation by one of its names: 'ihc', 'innerhaircell', 'IhcProc'; '' for none.
            names = fieldnames(dObj.kinds);
            for k = 1:numel(names)
                about = dObj.kinds.(names{k});
                if any(strcmpi(name, [names(k); {about.word; about.request}; about.aliases(:)]))
                    kind = names{k};
                    return
                end
            end
            kind = '';
        end

        function about = representations(dObj)
            %REPRESENTATIONS  What genomixd tells of the representations, a field for each kind.
            about = dObj.kinds;
        end

        function names = fieldnames(dObj)
            %FIELDNAMES  The representations, as addProcessor takes them.
            names = struct2cell(structfun(@(kind) kind.word, dObj.kinds, 'UniformOutput', false));
        end

        function addSignals(dObj, kind, signals)
            %ADDSIGNALS  Hold the signals of a processor, a cell row, in the place of those that it had.
            row = find(strcmp(signals{1}.Label, labels(dObj, kind)));
            if isempty(row)
                row = size(dObj.held.(kind), 1) + 1;
            end
            dObj.held.(kind)(row, 1:numel(signals)) = signals;
        end

        function signals = signalsOf(dObj, kind, label)
            %SIGNALSOF  The row of a processor, empty where there is none.
            signals = dObj.held.(kind)(strcmp(label, labels(dObj, kind)), :);
        end

        function keepOnly(dObj, kind, kept)
            %KEEPONLY  Let go of the signals of a kind whose processors are not among those named.
            dObj.held.(kind) = dObj.held.(kind)(ismember(labels(dObj, kind), kept), :);
        end

        function clearData(dObj, bClearInput)
            %CLEARDATA  Forget all frames; with 0, not those of the input.
            for kind = fieldnames(dObj.held).'
                about = dObj.kinds.(kind{1});
                if nargin < 2 || bClearInput || ~isempty(about.parent)
                    cellfun(@clearData, dObj.held.(kind{1}));
                end
            end
        end
    end

    methods (Access = private)
        function names = labels(dObj, kind)
            % The processors whose signals are held, in the order of the rows.
            names = cellfun(@(signal) signal.Label, dObj.held.(kind)(:, 1:min(1, end)), 'UniformOutput', false);
        end
    end
end
