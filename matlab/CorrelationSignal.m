classdef CorrelationSignal < BufferedSignal
%CORRELATIONSIGNAL  Frames by channels by lags of both ears. See BufferedSignal.

    properties (SetAccess = private)
        lags  % seconds
    end

    methods
        function obj = CorrelationSignal(fs, bufferSize_s, name, label, cfHz, lags, channel)
            obj = obj@BufferedSignal(fs, bufferSize_s, name, label, cfHz, channel);
            obj.lags = lags(:).';
        end

        function h = plot(obj, h)
            %PLOT  Draw the mean over the channels, lags over time, into a figure or axes if given.
            if nargin < 2
                h = [];
            end
            h = place(obj, h);
            if isempty(obj.Data)
                return
            end
            mean_of = permute(mean(obj.Data, 2), [3 1 2]);
            imagesc(seconds(obj), 1000 * obj.lags, mean_of);
            axis('xy');
            colorbar();
            xlabel('Time (s)');
            ylabel('Lag (ms)');
            title(strrep([obj.Label ' ' obj.Channel], '_', ' '));
        end
    end

    methods (Access = protected)
        function sizes = frameSize(obj)
            one = zeros(1, numel(obj.cfHz), numel(obj.lags)); % a last dimension of one is none
            sizes = size(one);
            sizes = sizes(2:end);
        end
    end
end
