classdef TimeFrequencySignal < rosafe.BufferedSignal
%TIMEFREQUENCYSIGNAL  Frames by channels for one ear, or interaural differences. See rosafe.BufferedSignal.

    properties (SetAccess = private)
        cfHz  % centre frequencies of the channels
    end

    methods
        function obj = TimeFrequencySignal(fs, bufferSize_s, name, label, cfHz, channel)
            obj = obj@rosafe.BufferedSignal(fs, bufferSize_s, name, label, numel(cfHz), channel);
            obj.cfHz = cfHz(:).';
        end

        function h = plot(obj, h)
            %PLOT  Draw the channels over time, into the given figure or axes, or a new figure.
            if nargin < 2
                h = [];
            end
            h = place(obj, h);
            if ~isempty(obj.Data)
                drawImage(obj, obj.Data, obj.cfHz);
                ylabel('Centre frequency (Hz)');
            end
        end
    end
end
