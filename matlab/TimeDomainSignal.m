classdef TimeDomainSignal < BufferedSignal
%TIMEDOMAINSIGNAL  Samples of one ear: the input or what pre-processing made of it. See BufferedSignal.

    methods
        function obj = TimeDomainSignal(fs, bufferSize_s, name, label, channel)
            obj = obj@BufferedSignal(fs, bufferSize_s, name, label, 1, channel);
        end

        function h = plot(obj, h)
            %PLOT  Draw the samples over time, into a figure or axes if given.
            if nargin < 2
                h = [];
            end
            h = place(obj, h);
            plot(seconds(obj), obj.Data);
            ylabel('Amplitude');
            caption(obj);
        end
    end

    methods (Static)
        function obj = construct(fs, bufferSize_s, name, label, channel)
            %CONSTRUCT  As the constructor.
            obj = TimeDomainSignal(fs, bufferSize_s, name, label, channel);
        end
    end
end
