startRosAFE;
names = {'pitch', 'rawPitch', 'confidence'};
pitch = FeatureSignal(10, 10, 'pitch', 'pitch_0', names, 'left');
pitch.appendChunk([NaN 0 0.1; 120 120 0.9; 125 125 0.8; NaN 300 0.2]);
figure('visible', 'off');
pitch.plot();
lines = get(gca(), 'children'); % the top one is first
show('pitch', {get(lines(1), 'ydata'), get(lines(2), 'ydata'), get(lines(1), 'xdata')});
show('unit', get(get(gca(), 'ylabel'), 'string'));
figure('visible', 'off');
pitch.plot([], 'confidence');
show('confidence', {get(get(gca(), 'children'), 'ydata'), get(get(gca(), 'ylabel'), 'string')});
features = FeatureSignal(10, 10, 'spectralFeatures', 'spectralFeatures_0', {'flux', 'hfc', 'crest'}, 'left');
figure('visible', 'off');
features.plot(); % no frames yet
features.appendChunk([0 1e6 5; 2 3e6 5; 1 2e6 5]);
figure('visible', 'off');
features.plot();
show('ranges', get(get(gca(), 'children'), 'cdata'));
show('features', get(gca(), 'yticklabel').');
