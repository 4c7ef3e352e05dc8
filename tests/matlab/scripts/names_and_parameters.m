p = mObj.addProcessor('onsetStrength', par);
parameters = genParStruct('sf_br_cf', 1000, 'sf_ro_perc', 0.9, 'sf_requests', {'flux', 'centroid'}, ...
    'fb_highFreqHz', 3000);
p = mObj.addProcessor('spectralFeatures', parameters);
assert(p{1}.fList(:).', {'flux', 'centroid'});
one = mObj.Processors.spectralFeatures{1};
assert({one.sf_brCF, one.sf_roPerc, one.sf_requests(:).'}, {1000, 0.9, {'flux', 'centroid'}});
breebaart = genParStruct('fb_highFreqHz', 3000, 'adpt_model', 'adt_breebart');
p = mObj.addProcessor('adaptation', breebaart);
assert(mObj.Processors.adaptation{1}.adpt_model, 'adt_breebaart');
assert(cellfun(@isstruct, {mObj.hasProcessor('spectralFeaturesProc', parameters), ...
    mObj.hasProcessor('spectralFeatures', below), mObj.hasProcessor('adaptationProc', breebaart), ...
    mObj.hasProcessor('adaptation', genParStruct('fb_highFreqHz', 3000, 'adpt_model', 'adt_puschel')), ...
    mObj.hasProcessor('onsetProc', par), mObj.hasProcessor('onsetProc', below)}), logical([1 0 1 0 1 0]));
range = genParStruct('fb_highFreqHz', 3000, 'p_pitchRangeHz', [100 300]);
p = mObj.addProcessor({'pitch', 'ic'}, {range, par});
assert(cell2mat(mObj.Processors.pitch{1}.pi_rangeHz), [100 300]);
p = mObj.addProcessor('pitch', genParStruct('fb_highFreqHz', 3000, 'pi_rangeHz', [100 300]));
modulations = genParStruct('fb_nChannels', 4, 'fb_highFreqHz', 3000, 'ams_nFilter', 3, 'ams_lowFreqHz', 8);
p = mObj.addProcessor('amsFeatures', modulations);
filters = cell2mat(mObj.Processors.amsFeatures{1}.ams_cfHz);
show('modulations', {p{2}.cfHz, p{2}.modCfHz, isequal(p{2}.modCfHz, filters)});
assert(isstruct(mObj.hasProcessor('modulationProc', modulations)));
p = mObj.addProcessor('precedence', par);
show('precedence', {p{1}.cfHz, numel(p{3}.lags), p{3}.lags(1) == -p{3}.lags(end)});
p = mObj.addProcessor('gabor', par);
show('gabor', {numel(p{1}.fList), p{1}.fList{end}});
assert([numel(mObj.Processors.pitch), size(dObj.pitch, 1)], [1 1]);

mObj.modifyParameter('spectralFeatures_0', 'sf_requests', {'rolloff', 'crest', 'flux'});
mObj.modifyParameter('pitch_0', 'pi_rangeHz', [90 310.5]);
show('changed', {dObj.spectralFeatures{1, 2}.fList, mObj.Processors.pitch{1}.pi_rangeHz});
mObj.deleteProcessor('onsetStrength', 1);
assert([size(dObj.onsetStrength, 1), numel(mObj.Processors.onsetStrength)], [0 0]);

other = rosAFE.OffsetProc('mine', 'ratemap_0'); % not created by the manager
other = rosAFE.getRepresentation('mine');
assert(other.result.parts{1}.name, 'offsetStrength');
mObj.processChunk();
assert({dObj.offsetStrength{1, 2}.Label, mObj.Processors.offsetStrength{1}.name}, {'mine', 'mine'});

show('none of it', message(@() mObj.addProcessor('pitch', genParStruct('pi_rangeHz', [-1 100]))));
show('not there', message(@() mObj.hasProcessor('pitch', genParStruct('fb_nERB', 1))));
show('bad word', message(@() mObj.addProcessor('spectralFeatures', genParStruct('sf_requests', {'charm'}))));
show('no type', message(@() mObj.deleteProcessor('spikes', 1)));
show('no name', message(@() dObj.spikes));
show('read only', message(@() subsasgn(dObj, substruct('.', 'pitch'), 3)));
