classdef ModulationSignal < rosafe.ModulationSignal
%MODULATIONSIGNAL  The class rosafe.ModulationSignal under the name of the original.

    methods
        function obj = ModulationSignal(varargin)
            obj = obj@rosafe.ModulationSignal(varargin{:});
        end
    end
end
