classdef BufferedSignal < handle
%BUFFEREDSIGNAL  The newest seconds of what a processor puts out for one ear, or for both together, oldest first.
%
%   TimeDomainSignal (samples), TimeFrequencySignal (frames by channels), FeatureSignal (frames by features),
%   CorrelationSignal (frames by channels by lags) and ModulationSignal (frames by channels by filters) are made of it.
%   They offer what the original's examples use of the signals of Two!Ears' MATLAB front-end; where that is ahead on
%   the path, its own classes serve.

    properties (SetAccess = private)
        Name          % of the representation: 'filterbank'
        Label         % of the processor: 'filterbank_0'
        Channel       % 'left', 'right' or 'mono'
        FsHz          % frames per second
        bufferSize_s  % how many seconds are kept
    end

    properties (Dependent)
        Data          % the frames, a row for each
    end

    properties (Access = private)
        columns            % how many a frame has; [] for samples
        chunks = cell(0, 1); % joined when Data is asked for, as copying all of it for every chunk takes time
        held = 0;            % frames in all chunks
    end

    methods
        function obj = BufferedSignal(fs, bufferSize_s, name, label, columns, channel)
            obj.FsHz = fs;
            obj.bufferSize_s = bufferSize_s;
            obj.Name = name;
            obj.Label = label;
            obj.columns = columns;
            obj.Channel = channel;
        end

        function appendChunk(obj, chunk)
            %APPENDCHUNK  Add frames at the end; the oldest go where there are too many.
            if isempty(chunk)
                return
            end
            if isempty(obj.columns)
                chunk = chunk(:); % samples come as a row or as a column
            elseif size(chunk, 2) ~= obj.columns
                error('BufferedSignal:channels', '%s has %d channels, and the chunk has %d', obj.Label, ...
                    obj.columns, size(chunk, 2));
            end
            if obj.held > 0 && size(obj.chunks{1}, 3) ~= size(chunk, 3)
                clearData(obj); % the lags or filters have changed
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

        function caption(obj)
            % What all pictures have in common.
            xlabel('Time (s)');
            title(strrep([obj.Name ' ' obj.Label ' ' obj.Channel], '_', ' '));
        end

        function image(obj, rows, values)
            % A picture of rows over time, frames by rows, with some of the rows' values at the side.
            imagesc(seconds(obj), 1:numel(values), rows.');
            axis('xy');
            ticks = unique(round(linspace(1, numel(values), 6)));
            set(gca(), 'ytick', ticks, 'yticklabel', arrayfun(@(k) sprintf('%.4g', values(k)), ticks, ...
                'UniformOutput', false));
            colorbar();
            caption(obj);
        end
    end
end
