classdef dataObject_RosAFE < handle
%DATAOBJECT_ROSAFE  Starts the capture, and stores the signals that a manager_RosAFE reads.
%
%   dObj = dataObject_RosAFE(bass, rosAFE, inputDevice, sampleRate, framesPerChunk)
%   dObj = dataObject_RosAFE(bass, rosAFE, inputDevice, sampleRate, framesPerChunk, bufferSize_s_bass, ...
%       bufferSize_s_rosAFE_port, bufferSize_s_rosAFE_getSignal, bufferSize_s_matlab)
%
%   The buffers are in seconds: of the port of bass (1), of the ports of rosAFE (1), of getSignals (0.5), and of the
%   signals in this object (10). Each representation is a cell array with one row per processor: dObj.ild{1, 1}. If it
%   has two ears, the columns are the ears: dObj.ratemap{1, 2} is the right one. The columns of precedence are time
%   differences, level differences and correlations. dObj.ild{1}.Data contains the values (see rosafe.BufferedSignal).

    properties (SetAccess = private)
        bass
        RosAFE
        sampleRate
        framesPerChunk
        bufferSize_s_rosAFE_port
        bufferSize_s_rosAFE_getSignal
        bufferSize_s_matlab
        acquire  % the request of the capture
    end

    properties (Access = private)
        kinds   % descriptions of the representations, by kind
        stored  % cell arrays of signals, by kind
    end

    properties (Constant, Access = private)
        CHUNK = 2205; % frames per chunk of bass
    end

    methods
        function dObj = dataObject_RosAFE(bass, rosAFE, inputDevice, sampleRate, framesPerChunk, bufferSize_s_bass, ...
                bufferSize_s_rosAFE_port, bufferSize_s_rosAFE_getSignal, bufferSize_s_matlab)
            if nargin < 5
                error('dataObject_RosAFE:arguments', ['dataObject_RosAFE: expected bass, rosAFE, inputDevice, ' ...
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
            dObj.stored = structfun(@(kind) {}, dObj.kinds, 'UniformOutput', false);
            dObj.acquire = rosafe.acquire(bass, rosAFE, sampleRate, seconds, dObj.CHUNK, inputDevice);
        end

        function varargout = subsref(dObj, s)
            % Representations are read like properties, by any of their names: dObj.ild
            kind = '';
            if strcmp(s(1).type, '.')
                kind = kindOf(dObj, s(1).subs);
            end
            if isempty(kind)
                [varargout{1:nargout}] = builtin('subsref', dObj, s);
            elseif isscalar(s)
                varargout = {dObj.stored.(kind)};
            else
                [varargout{1:max(1, nargout)}] = subsref(dObj.stored.(kind), s(2:end));
            end
        end

        function kind = kindOf(dObj, name)
            %KINDOF  Return the kind for a name of a representation ('ihc', 'innerhaircell', 'IhcProc'), or ''.
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
            %REPRESENTATIONS  Return the descriptions of the representations, one field per kind.
            about = dObj.kinds;
        end

        function names = fieldnames(dObj)
            %FIELDNAMES  Return the names of the representations for addProcessor.
            names = struct2cell(structfun(@(kind) kind.word, dObj.kinds, 'UniformOutput', false));
        end

        function addSignals(dObj, kind, signals)
            %ADDSIGNALS  Store the signals of a processor, a cell row, and replace its previous ones.
            row = find(strcmp(signals{1}.Label, labels(dObj, kind)));
            if isempty(row)
                row = size(dObj.stored.(kind), 1) + 1;
            end
            dObj.stored.(kind)(row, 1:numel(signals)) = signals;
        end

        function signals = signalsOf(dObj, kind, label)
            %SIGNALSOF  Return the signals of a processor, or an empty cell array.
            signals = dObj.stored.(kind)(strcmp(label, labels(dObj, kind)), :);
        end

        function keepOnly(dObj, kind, kept)
            %KEEPONLY  Remove the signals of a kind except those of the given processors.
            dObj.stored.(kind) = dObj.stored.(kind)(ismember(labels(dObj, kind), kept), :);
        end

        function clearData(dObj, bClearInput)
            %CLEARDATA  Remove all frames; with 0, keep those of the input.
            for kind = fieldnames(dObj.stored).'
                about = dObj.kinds.(kind{1});
                if nargin < 2 || bClearInput || ~isempty(about.parent)
                    cellfun(@clearData, dObj.stored.(kind{1}));
                end
            end
        end
    end

    methods (Access = private)
        function names = labels(dObj, kind)
            % The processors with stored signals, in the order of the rows.
            names = cellfun(@(signal) signal.Label, dObj.stored.(kind)(:, 1:min(1, end)), 'UniformOutput', false);
        end
    end
end
