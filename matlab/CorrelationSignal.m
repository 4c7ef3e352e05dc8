classdef CorrelationSignal < rosafe.CorrelationSignal
%CORRELATIONSIGNAL  The class rosafe.CorrelationSignal under the name of the original.

    methods
        function obj = CorrelationSignal(varargin)
            obj = obj@rosafe.CorrelationSignal(varargin{:});
        end
    end
end
