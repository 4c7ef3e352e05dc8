classdef TimeDomainSignal < rosafe.BufferedSignal
%TIMEDOMAINSIGNAL  Samples of one ear: the input, or the output of the pre-processing. See rosafe.BufferedSignal.

    methods
        function obj = TimeDomainSignal(fs, bufferSize_s, name, label, channel)
            obj = obj@rosafe.BufferedSignal(fs, bufferSize_s, name, label, 1, channel);
        end

        function h = plot(obj, h)
            %PLOT  Draw the samples over time, into the given figure or axes, or a new figure.
            if nargin < 2
                h = [];
            end
            h = place(obj, h);
            plot(seconds(obj), obj.Data);
            ylabel('Amplitude');
            caption(obj);
        end
    end
end
