client = genomix.client;
bass = client.load('bass');
rosAFE = client.load('rosAFE');
acquire = bass.Acquire('-a', 'scene:');
rosAFE.connect_port('Audio', 'bass/Audio');
rosAFE.InputProc('-a', 'input', 12000, 0.5, 0.5);
rosAFE.PreProc('-a', 'preProc', 'input', 1, 20, false, 0.97, logical(1));
rosAFE.GammatoneProc('-a', 'scalar', 'preProc', 'gammatone', 80, 8000, 1, 5, 0, 4, 1.018);
rosAFE.GammatoneProc('-a', 'empty', 'preProc', 'gammatone', 80, 8000, 1, 5, {}, 4, 1.018);
rosAFE.GammatoneProc('-a', 'cells', 'preProc', 'gammatone', 80, 8000, 1, 0, {100, 200.25, 1/3*1000});
rosAFE.GammatoneProc('-a', 'matrix', 'preProc', 'gammatone', 80, 8000, 1, 0, [100; 200.25; 1000/3]);
rosAFE.GammatoneProc('-a', struct('name', 'named', 'fb_nChannels', int32(3), 'fb_bwERBs', single(1.5)));
r = rosAFE.IhcProc('-a', 'ä"\ ihc', 'scalar');
assert(r.status, 'error'); % not a valid name of a topic
g = rosAFE.getParameters();
p = g.result.parameters;
assert({size(p.gammatone), size(p.gammatone{3}.fb_cfHz), size(p.ild)}, {[1 5], [1 3], [1 0]});
kinds = cellfun(@class, {p.ild, p.gammatone, p.gammatone{3}.fb_cfHz, p.gammatone{3}.fb_type}, ...
    'UniformOutput', false);
assert(kinds, {'cell', 'cell', 'cell', 'char'});
assert([p.preProc{1}.pp_bRemoveDC == 1, p.preProc{1}.pp_bPreEmphasis == 0, ...
    p.preProc{1}.pp_bNormalizeRMS == true, p.preProc{1}.pp_coefPreEmphasis == 0.97, ...
    p.gammatone{1}.fb_bwERBs == 1.018, p.gammatone{5}.fb_bwERBs == 1.5, p.gammatone{5}.fb_nChannels == 3]);
assert(cell2mat(p.gammatone{3}.fb_cfHz), [100 200.25 1000/3]);
assert(p.gammatone{3}.fb_cfHz, p.gammatone{4}.fb_cfHz);
assert(cellfun(@(one) numel(one.fb_cfHz), p.gammatone), [5 5 3 3 3]);
assert(isempty(cell2mat(p.ild)));
m = rosAFE.getParameters('-m').result.parameters.gammatone{3}.fb_cfHz;
assert({class(m), size(m)}, {'double', [3 1]});
d = rosAFE.getDependencies('scalar');
assert(d.result.dependencies, {'input', 'preProc', 'scalar'});
assert(isempty(acquire.result));
s = rosAFE.genom_state();
assert({class(s.genom_state.task), class(s.genom_state.task{1}.name)}, {'cell', 'char'});

% requests that are running, and that end
assert({acquire.status, acquire.wait(0.1)}, {'sent', 'sent'});
assert(evalc('disp(acquire)'), sprintf( ...
    '  request with properties:\n\n       status: ''sent''\n       result: []\n    exception: []\n'));
acquire.abort();
assert({acquire.wait(60), acquire.exception, acquire.status}, {'done', [], 'done'});
again = bass.Acquire('-a', 'scene:');
bass.Stop();
assert(again.wait(60), 'done');
f = rosAFE.getParameters('-a');
assert({f.wait(60), fieldnames(f.result)}, {'done', {'parameters'}});
