classdef FeatureSignal < rosafe.FeatureSignal
%FEATURESIGNAL  The class rosafe.FeatureSignal under the name of the original.

    methods
        function obj = FeatureSignal(varargin)
            obj = obj@rosafe.FeatureSignal(varargin{:});
        end
    end
end
