classdef TimeFrequencySignal < BufferedSignal
%TIMEFREQUENCYSIGNAL  Frames by channels of one ear, or of both for level differences. See BufferedSignal.

    methods
        function obj = TimeFrequencySignal(fs, bufferSize_s, name, label, cfHz, channel)
            obj = obj@BufferedSignal(fs, bufferSize_s, name, label, cfHz, channel);
        end

        function h = plot(obj, h)
            %PLOT  Draw the channels over time, into a figure or axes if given.
            if nargin < 2
                h = [];
            end
            h = place(obj, h);
            if isempty(obj.Data)
                return
            end
            imagesc(seconds(obj), 1:numel(obj.cfHz), obj.Data.');
            axis('xy');
            ticks = unique(round(linspace(1, numel(obj.cfHz), 6)));
            set(gca(), 'ytick', ticks, 'yticklabel', arrayfun(@(k) sprintf('%.0f', obj.cfHz(k)), ticks, ...
                'UniformOutput', false));
            colorbar();
            xlabel('Time (s)');
            ylabel('Centre frequency (Hz)');
            title(strrep([obj.Label ' ' obj.Channel], '_', ' '));
        end
    end

    methods (Static)
        function obj = construct(fs, bufferSize_s, name, label, cfHz, channel)
            %CONSTRUCT  As the constructor.
            obj = TimeFrequencySignal(fs, bufferSize_s, name, label, cfHz, channel);
        end
    end
end
