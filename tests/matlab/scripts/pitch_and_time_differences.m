sOut = mObj.addProcessor('pitch', below);
mObj.addProcessor('itd', below);
data = zeros(0, 3);
while ! any(isnan(data(:, 1))) || sum(data(:, 1) > 0) < 50
    pause(0.1);
    mObj.processChunk();
    data = sOut{1}.Data;
end
pitch = data(:, strcmp(sOut{1}.fList, 'pitch'));
show('pitch', median(pitch(! isnan(pitch))));
show('finite', all(isfinite(data(:, 2:3))(:)));
times = dObj.itd{1}.Data(:, 1:10);
show('itd', median(times(times != 0)));
