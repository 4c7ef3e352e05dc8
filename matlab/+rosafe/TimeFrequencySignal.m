classdef TimeFrequencySignal < rosafe.BufferedSignal
%TIMEFREQUENCYSIGNAL  Frames by channels of one ear, or of both for level differences. See rosafe.BufferedSignal.

    properties (SetAccess = private)
        cfHz  % centre frequencies of the channels
    end

    methods
        function obj = TimeFrequencySignal(fs, bufferSize_s, name, label, cfHz, channel)
            obj = obj@rosafe.BufferedSignal(fs, bufferSize_s, name, label, numel(cfHz), channel);
            obj.cfHz = cfHz(:).';
        end

        function h = plot(obj, h)
            %PLOT  Draw the channels over time, into a figure or axes if given.
            if nargin < 2
                h = [];
            end
            h = place(obj, h);
            if ~isempty(obj.Data)
                picture(obj, obj.Data, obj.cfHz);
                ylabel('Centre frequency (Hz)');
            end
        end
    end
end
