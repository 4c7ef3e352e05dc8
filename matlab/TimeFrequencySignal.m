classdef TimeFrequencySignal < rosafe.TimeFrequencySignal
%TIMEFREQUENCYSIGNAL  The class rosafe.TimeFrequencySignal under the name of the original.

    methods
        function obj = TimeFrequencySignal(varargin)
            obj = obj@rosafe.TimeFrequencySignal(varargin{:});
        end
    end

    methods (Static)
        function obj = construct(varargin)
            %CONSTRUCT  Same as the constructor.
            obj = TimeFrequencySignal(varargin{:});
        end
    end
end
