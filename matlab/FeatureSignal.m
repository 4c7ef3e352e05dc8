classdef FeatureSignal < BufferedSignal
%FEATURESIGNAL  Frames by features of one ear: pitch and what it came from, spectral features. See BufferedSignal.

    properties (SetAccess = private)
        fList  % what the columns are
    end

    methods
        function obj = FeatureSignal(fs, bufferSize_s, name, label, fList, channel)
            obj = obj@BufferedSignal(fs, bufferSize_s, name, label, numel(fList), channel);
            obj.fList = fList(:).';
        end

        function h = plot(obj, h, feature)
            %PLOT  Draw the features over time, or one of them, into a figure or axes if given.
            if nargin < 2
                h = [];
            end
            drawn = true(size(obj.fList));
            if nargin > 2
                drawn = ismember(obj.fList, feature);
            end
            h = place(obj, h);
            plot(seconds(obj), obj.Data(:, drawn));
            legend(strrep(obj.fList(drawn), '_', ' '));
            caption(obj);
        end
    end
end
