classdef BufferedSignal < handle
%BUFFEREDSIGNAL  The last seconds of the output of a processor for one ear or for both, oldest frame first.
%
%   TimeDomainSignal (samples, N-by-1), TimeFrequencySignal (frames by channels), FeatureSignal (frames by features),
%   CorrelationSignal (frames by channels by lags) and ModulationSignal (frames by channels by filters) are subclasses.
%   They have the parts of the signals of the MATLAB Auditory Front-End that the examples of the original use, and
%   accept chunks of the same shapes.

    properties (SetAccess = private)
        Name          % of the representation: 'filterbank'
        Label         % of the processor: 'filterbank_0'
        Channel       % 'left', 'right' or 'mono'
        FsHz          % frames per second
        bufferSize_s  % length of the buffer
    end

    properties (Dependent)
        Data          % the frames, one per row
    end

    properties (Access = private)
        frameSize            % shape of a frame: channels, or channels and lags
        chunks = cell(0, 1); % joined when Data is read, because copying Data for every chunk is slow
        frames = 0;          % in all chunks
    end

    methods
        function obj = BufferedSignal(fs, bufferSize_s, name, label, frameSize, channel)
            obj.FsHz = fs;
            obj.bufferSize_s = bufferSize_s;
            obj.Name = name;
            obj.Label = label;
            sizes = size(zeros([1 max(1, frameSize)])); % without trailing dimensions of 1
            obj.frameSize = sizes(2:end);
            obj.Channel = channel;
        end

        function appendChunk(obj, chunk)
            %APPENDCHUNK  Append the rows of a chunk as frames, and remove the oldest frames if there are too many.
            if ~isequal(size(chunk), [size(chunk, 1) obj.frameSize])
                actual = sprintf('%d-by-', size(chunk));
                error('BufferedSignal:size', '%s: expected a chunk of N%s with one frame per row, got %s', ...
                    obj.Label, sprintf('-by-%d', obj.frameSize), actual(1:end - 4));
            end
            obj.chunks{end + 1, 1} = chunk;
            obj.frames = obj.frames + size(chunk, 1);
            while obj.frames - size(obj.chunks{1}, 1) >= capacity(obj)
                obj.frames = obj.frames - size(obj.chunks{1}, 1);
                obj.chunks(1) = [];
            end
        end

        function data = get.Data(obj)
            data = vertcat(obj.chunks{:});
            data = data(max(1, end - capacity(obj) + 1):end, :, :);
            if ~isempty(data)
                obj.chunks = {data};
                obj.frames = size(data, 1);
            end
        end

        function clearData(obj)
            %CLEARDATA  Remove all frames.
            obj.chunks = cell(0, 1);
            obj.frames = 0;
        end
    end

    methods (Access = private)
        function n = capacity(obj)
            n = max(1, round(obj.bufferSize_s * obj.FsHz));
        end
    end

    methods (Access = protected)
        function h = place(obj, h)
            % Select a new figure, the given figure, or the given axes.
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
            % Add the time axis and the title.
            xlabel('Time (s)');
            title(strrep([obj.Name ' ' obj.Label ' ' obj.Channel], '_', ' '));
        end

        function drawImage(obj, rows, values)
            % Draw an image of rows over time (frames by rows), and label some of the rows with their values.
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
