classdef TimeDomainSignal < rosafe.TimeDomainSignal
%TIMEDOMAINSIGNAL  The class rosafe.TimeDomainSignal under the name of the original.

    methods
        function obj = TimeDomainSignal(varargin)
            obj = obj@rosafe.TimeDomainSignal(varargin{:});
        end
    end

    methods (Static)
        function obj = construct(varargin)
            %CONSTRUCT  Same as the constructor.
            obj = TimeDomainSignal(varargin{:});
        end
    end
end
