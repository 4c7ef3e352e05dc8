classdef BufferedSignal < handle
%BUFFEREDSIGNAL  The newest seconds of one representation of one ear, oldest first.
%
%   TimeDomainSignal (samples, N-by-1), TimeFrequencySignal (frames by channels) and CorrelationSignal (frames by
%   channels by lags) are made of it. They offer what the original's examples use of the signals of Two!Ears' MATLAB
%   front-end, and take chunks of the same shapes; where that is ahead on the path, its own classes serve.

    properties (SetAccess = private)
        Name          % of the representation: 'filterbank'
        Label         % of the processor: 'filterbank_0'
        Channel       % 'left', 'right' or 'mono'
        FsHz          % frames per second
        bufferSize_s  % how many seconds are kept
        cfHz          % centre frequencies of the channels, [] for none
    end

    properties (Dependent)
        Data          % the frames, a row for each
    end

    properties (Access = private)
        chunks = cell(0, 1); % joined when Data is asked for, as copying all of it for every chunk takes time
        held = 0;            % frames in all chunks
    end

    methods
        function obj = BufferedSignal(fs, bufferSize_s, name, label, cfHz, channel)
            obj.FsHz = fs;
            obj.bufferSize_s = bufferSize_s;
            obj.Name = name;
            obj.Label = label;
            obj.cfHz = cfHz(:).';
            obj.Channel = channel;
        end

        function appendChunk(obj, chunk)
            %APPENDCHUNK  Add frames, the rows of a chunk, at the end; the oldest go where there are too many.
            wanted = frameSize(obj);
            if ~isequal(size(chunk), [size(chunk, 1) wanted])
                shown = sprintf('%d-by-', size(chunk));
                error('BufferedSignal:size', '%s takes chunks of N%s (time goes down), and this one is %s', ...
                    obj.Label, sprintf('-by-%d', wanted), shown(1:end - 4));
            end
            obj.chunks{end + 1, 1} = chunk;
            obj.held = obj.held + size(chunk, 1);
            while obj.held - size(obj.chunks{1}, 1) >= capacity(obj)
                obj.held = obj.held - size(obj.chunks{1}, 1);
                obj.chunks(1) = [];
            end
        end

        function data = get.Data(obj)
            data = vertcat(obj.chunks{:});
            data = data(max(1, end - capacity(obj) + 1):end, :, :);
            if ~isempty(data)
                obj.chunks = {data};
                obj.held = size(data, 1);
            end
        end

        function clearData(obj)
            %CLEARDATA  Forget all frames.
            obj.chunks = cell(0, 1);
            obj.held = 0;
        end
    end

    methods (Access = protected)
        function sizes = frameSize(obj)
            % How many numbers a frame has: channels, or channels and lags.
            sizes = max(1, numel(obj.cfHz));
        end
    end

    methods (Access = private)
        function frames = capacity(obj)
            frames = max(1, round(obj.bufferSize_s * obj.FsHz));
        end
    end

    methods (Access = protected)
        function h = place(obj, h)
            % Where to draw: a new figure, the given one, or the given axes.
            if nargin < 2 || isempty(h)
                h = figure();
            elseif strcmp(get(h, 'type'), 'axes')
                axes(h); %#ok<LAXES>
            else
                figure(h);
            end
        end

        function t = seconds(obj)
            t = (0:size(obj.Data, 1) - 1) / obj.FsHz;
        end
    end
end
