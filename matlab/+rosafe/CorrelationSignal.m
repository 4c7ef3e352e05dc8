classdef CorrelationSignal < rosafe.BufferedSignal
%CORRELATIONSIGNAL  Frames by channels by lags, for one ear or both. See rosafe.BufferedSignal.

    properties (SetAccess = private)
        cfHz  % centre frequencies of the channels
        lags  % seconds
    end

    methods
        function obj = CorrelationSignal(fs, bufferSize_s, name, label, cfHz, lags, channel)
            obj = obj@rosafe.BufferedSignal(fs, bufferSize_s, name, label, [numel(cfHz) numel(lags)], channel);
            obj.cfHz = cfHz(:).';
            obj.lags = lags(:).';
        end

        function h = plot(obj, h)
            %PLOT  Draw the mean over the channels, lags over time, into the given figure or axes, or a new figure.
            if nargin < 2
                h = [];
            end
            h = place(obj, h);
            if ~isempty(obj.Data)
                drawImage(obj, permute(mean(obj.Data, 2), [1 3 2]), 1000 * obj.lags);
                ylabel('Lag (ms)');
            end
        end
    end
end
