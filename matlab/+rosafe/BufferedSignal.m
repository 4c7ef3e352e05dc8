classdef BufferedSignal < handle
%BUFFEREDSIGNAL  The newest seconds of what a processor puts out for one ear, or for both together, oldest first.
%
%   TimeDomainSignal (samples, N-by-1), TimeFrequencySignal (frames by channels), FeatureSignal (frames by features),
%   CorrelationSignal (frames by channels by lags) and ModulationSignal (frames by channels by filters) are made of it.
%   They offer the parts of the MATLAB Auditory Front-End's signals that the original's examples use, and accept chunks
%   of the same shapes.

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
        frameSize            % how many numbers a frame has: channels, or channels and lags
        chunks = cell(0, 1); % joined when Data is asked for, as copying all of it for every chunk takes time
        held = 0;            % frames in all chunks
    end

    methods
        function obj = BufferedSignal(fs, bufferSize_s, name, label, frameSize, channel)
            obj.FsHz = fs;
            obj.bufferSize_s = bufferSize_s;
            obj.Name = name;
            obj.Label = label;
            sizes = size(zeros([1 max(1, frameSize)])); % a last dimension of one is none
            obj.frameSize = sizes(2:end);
            obj.Channel = channel;
        end

        function appendChunk(obj, chunk)
            %APPENDCHUNK  Add frames, the rows of a chunk, at the end; the oldest go where there are too many.
            if ~isequal(size(chunk), [size(chunk, 1) obj.frameSize])
                shown = sprintf('%d-by-', size(chunk));
                error('BufferedSignal:size', '%s takes chunks of N%s (time goes down), and this one is %s', ...
                    obj.Label, sprintf('-by-%d', obj.frameSize), shown(1:end - 4));
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

        function picture(obj, rows, values)
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
