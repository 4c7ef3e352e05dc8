classdef dataObject_RosAFE < handle
%DATAOBJECT_ROSAFE  Starts the sound, and holds what a manager_RosAFE fetches of the representations.
%
%   dObj = dataObject_RosAFE(bass, rosAFE, inputDevice, sampleRate, framesPerChunk)
%   dObj = dataObject_RosAFE(bass, rosAFE, inputDevice, sampleRate, framesPerChunk, bufferSize_s_bass, ...
%       bufferSize_s_rosAFE_port, bufferSize_s_rosAFE_getSignal, bufferSize_s_matlab)
%
%   The buffers are in seconds: of bass's port (1), of rosAFE's ports (1), of what getSignals can return (0.5), and of
%   the signals here (10). Every representation is a cell array with a row for each of its processors: dObj.ild{1, 1},
%   and with a column for each ear where it has two: dObj.ratemap{1, 2} is the right one. dObj.ild{1}.Data holds the
%   numbers (BufferedSignal).

    properties (SetAccess = private)
        bass
        RosAFE
        sampleRate
        framesPerChunk
        bufferSize_s_rosAFE_port
        bufferSize_s_rosAFE_getSignal
        bufferSize_s_matlab
        acquire  % the request of the acquisition
        input = {};
        preProc = {};
        filterbank = {};
        innerhaircell = {};
        ild = {};
        ratemap = {};
        crosscorrelation = {};
    end

    properties (Dependent)
        time  % another name of preProc
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
            dObj.acquire = acquireAudio(bass, rosAFE, sampleRate, seconds, dObj.CHUNK, inputDevice);
        end

        function signals = get.time(dObj)
            signals = dObj.preProc;
        end

        function addSignal(dObj, signal)
            %ADDSIGNAL  Hold a signal; one of the same name and label is the other ear of its row.
            row = find(strcmp(signal.Label, labels(dObj, signal.Name)));
            column = 1 + strcmp(signal.Channel, 'right');
            if isempty(row)
                row = size(dObj.(signal.Name), 1) + 1;
            end
            dObj.(signal.Name){row, column} = signal;
        end

        function names = labels(dObj, name)
            %LABELS  The processors whose signals of a representation are held, in the order of the rows.
            rows = dObj.(name);
            names = cell(size(rows, 1), 1);
            for k = 1:numel(names)
                names{k} = rows{k, 1}.Label;
            end
        end

        function keepOnly(dObj, name, kept)
            %KEEPONLY  Let go of the signals of a representation whose processors are not among those named.
            dObj.(name) = dObj.(name)(ismember(labels(dObj, name), kept), :);
        end

        function clearData(dObj, bClearInput)
            %CLEARDATA  Forget all frames; with 0, not those of the input.
            names = {'input', 'preProc', 'filterbank', 'innerhaircell', 'ild', 'ratemap', 'crosscorrelation'};
            if nargin > 1 && ~bClearInput
                names(1) = [];
            end
            for name = names
                cellfun(@clearData, dObj.(name{1}));
            end
        end
    end
end
