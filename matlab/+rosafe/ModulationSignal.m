classdef ModulationSignal < rosafe.BufferedSignal
%MODULATIONSIGNAL  Frames by channels by modulation filters of one ear. See rosafe.BufferedSignal.

    properties (SetAccess = private)
        cfHz     % centre frequencies of the channels
        modCfHz  % centre frequencies of the modulation filters
    end

    methods
        function obj = ModulationSignal(fs, bufferSize_s, name, label, cfHz, modCfHz, channel)
            obj = obj@rosafe.BufferedSignal(fs, bufferSize_s, name, label, [numel(cfHz) numel(modCfHz)], channel);
            obj.cfHz = cfHz(:).';
            obj.modCfHz = modCfHz(:).';
        end

        function h = plot(obj, h)
            %PLOT  Draw the mean over the channels, filters over time, into the given figure or axes, or a new figure.
            if nargin < 2
                h = [];
            end
            h = place(obj, h);
            if ~isempty(obj.Data)
                drawImage(obj, permute(mean(obj.Data, 2), [1 3 2]), obj.modCfHz);
                ylabel('Modulation frequency (Hz)');
            end
        end
    end
end
