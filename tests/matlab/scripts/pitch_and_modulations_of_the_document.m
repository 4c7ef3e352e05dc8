show('kinds', {columns(hertz), isequal(class(dObj.amsFeatures{1}), 'ModulationSignal')});
show('changed', {mObj.Processors.pitch{1}.pi_confThres, mObj.Processors.pitch{1}.pi_rangeHz});
while isempty(dObj.amsFeatures{1}.Data)
    mObj.processChunk();
end
show('size', size(dObj.amsFeatures{2}.Data)(2:3));
part = struct('data', []);
while isempty(part.data)
    r = rosAFE.getRepresentation('-m', 'pitch_0');
    part = r.result.parts{1};
end
frames = reshape(part.data, flipud(part.shape).'); % as documented: time first, then features, then ears
right = part.data(4 * part.shape(3) + 1:end); % row-major: the right ear's rawPitch and confidence
show('frames', [size(frames) - flipud(part.shape).', isequaln(frames(:, 2:3, 2)(:), right)]);
