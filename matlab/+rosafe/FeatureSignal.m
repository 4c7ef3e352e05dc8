classdef FeatureSignal < rosafe.BufferedSignal
%FEATURESIGNAL  Frames by features of one ear: pitch and raw pitch, or spectral features. See rosafe.BufferedSignal.

    properties (SetAccess = private)
        fList  % names of the columns
    end

    methods
        function obj = FeatureSignal(fs, bufferSize_s, name, label, fList, channel)
            obj = obj@rosafe.BufferedSignal(fs, bufferSize_s, name, label, numel(fList), channel);
            obj.fList = fList(:).';
        end

        function h = plot(obj, h, feature)
            %PLOT  Draw all features, or the given ones, over time into the given figure or axes, or a new figure.
            %
            %   The pitch is drawn over the raw pitch, in Hz. Several other features, which have different units, are
            %   drawn as an image, each scaled to its own range.
            if nargin < 2
                h = [];
            end
            drawn = true(size(obj.fList));
            if nargin > 2
                drawn = ismember(obj.fList, feature);
            elseif all(ismember({'pitch', 'rawPitch'}, obj.fList))
                drawn = ismember(obj.fList, {'pitch', 'rawPitch'});
            end
            h = place(obj, h);
            values = obj.Data;
            if isempty(values)
                values = NaN(1, numel(obj.fList)); % no frames yet
            end
            t = (0:size(values, 1) - 1) / obj.FsHz;
            values = values(:, drawn);
            names = strrep(obj.fList(drawn), '_', ' ');
            if isequal(names, {'pitch', 'rawPitch'})
                pitches(t, names, values);
            elseif numel(names) == 1
                plot(t, values);
                ylabel(names{1});
            else
                ranges(t, names, values);
            end
            caption(obj);
        end
    end
end

function pitches(t, names, hertz)
    hertz(hertz == 0) = NaN; % no raw pitch
    plot(t, hertz(:, 2), '.', 'color', [0.7 0.7 0.7], 'markersize', 4);
    hold('on');
    plot(t, hertz(:, 1), '.', 'color', [0.85 0.2 0.1], 'markersize', 10);
    hold('off');
    legend(names([2 1]));
    ylabel('Hz');
end

function ranges(t, names, values)
    low = min(values, [], 1);
    span = max(values, [], 1) - low;
    span(span == 0) = 1;
    imagesc(t, 1:numel(names), bsxfun(@rdivide, bsxfun(@minus, values, low), span).');
    axis('xy');
    ticks = unique(round(linspace(1, numel(names), min(numel(names), 16))));
    set(gca(), 'ytick', ticks, 'yticklabel', names(ticks));
    ylabel(colorbar(), 'relative to the range of the feature');
end
