words = fieldnames(dObj).';
show('words', words);
for word = words
    sOut = mObj.addProcessor(word{1}, par);
    show(['of ' word{1}], {sOut{1}.Label, cellfun(@class, sOut, 'UniformOutput', false), ...
        cellfun(@(signal) signal.Channel, sOut, 'UniformOutput', false), ...
        cellfun(@(signal) signal.Name, sOut, 'UniformOutput', false)});
end
for word = words(1:7:end)
    mObj.addProcessor(word{1}, par);
end
show('counts', structfun(@numel, mObj.Processors)); % there are no duplicates
processors = rosAFE.getProcessors();
processors = processors.result.processors(:).';
full = @(processor) size(dObj.(processor.kind){1}.Data, 1) >= 0.3 * processor.rate;
while ! all(cellfun(full, processors))
    pause(0.1);
    mObj.processChunk();
end
bass.Stop();
left = processors;
while ! isempty(left) % until the data object contains all frames of the ports
    pause(0.1);
    mObj.processChunk();
    waiting = {};
    for processor = left
        out = rosAFE.(processor{1}.port)('-m', processor{1}.name).(processor{1}.port);
        fields = fieldnames(out)(4:end).';
        fields = fields(! strncmp(fields, 'numberOf', 8));
        kind = processor{1}.kind;
        signals = dObj.(kind);
        same = out.framesOnPort > 0;
        for k = 1:numel(signals)
            same = same && isequaln(signals{k}.Data(end-out.framesOnPort+1:end, :, :), out.(fields{k}));
        end
        if same
            show(kind, [out.framesOnPort / processor{1}.rate, size(signals{1}.Data)(2:end)]);
        else
            waiting{end + 1} = processor{1};
        end
    end
    left = waiting;
end
show('fList', {dObj.pitch{1}.fList, dObj.spectralFeatures{1}.fList});
show('alike', isequal(dObj.onsetStrength{1}.cfHz, dObj.itd{1}.cfHz, dObj.zeroCrossings{1}.cfHz));
show('lags', [dObj.autocorrelation{2}.lags(2), dObj.crosscorrelation{1}.lags(1)]);
shown = {dObj.pitch{1}, dObj.itd{1}, dObj.amsFeatures{1}, dObj.autocorrelation{1}, dObj.time{1}};
show('figures', cellfun(@(signal) ishghandle(signal.plot()), shown));
mObj.cleanup();
show('clean', structfun(@numel, mObj.Processors));
