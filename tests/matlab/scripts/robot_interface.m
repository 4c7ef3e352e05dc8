% The robot interfaces of Two!Ears read their ear signals like this.
1;
function [signals, seconds] = getSignal(bass, duration)
    b = bass.Audio();
    signals = [cell2mat(b.Audio.left); cell2mat(b.Audio.right)]' ./ 2^31;
    count = round(duration * b.Audio.sampleRate);
    if count > size(signals, 1)
        error('the desired chunk is longer than the buffer');
    end
    signals = signals(end - count + 1:end, :);
    seconds = length(signals) / b.Audio.sampleRate;
end
client = genomix.client;
bass = client.load('bass');
bass.Acquire('-a', 'scene:', 16000, 800, 20);
while bass.Audio().Audio.lastFrameIndex < 16000
    pause(0.05);
end
bass.Stop();
[signals, seconds] = getSignal(bass, 0.5);
whole = getSignal(bass, 1);
b = bass.Audio();
show('sizes', {size(b.Audio.left), size(signals), seconds, size(whole)});
show('same', [isequal(whole(:, 1)' * 2^31, [b.Audio.left{:}]), isequal(whole(:, 2)' * 2^31, [b.Audio.right{:}])]);
show('alive', all(std(whole) > 0));
show('types', cellfun(@class, {b.Audio.left, b.Audio.left{1}}, 'UniformOutput', false));

% in a tutorial of 2015, sequences are columns
old = genomix.client(client.address, '-columns');
p = old.load('bass').Audio();
show('old', {size(p.Audio.left), size([cell2mat(p.Audio.left) cell2mat(p.Audio.right)])});
setenv('GENOMIXD', client.address);
rosAFE = genomix.client('-columns').load('rosAFE');
show('fields', {size(rosAFE.getParameters().result.parameters.ild), rosAFE.GETPARAMETERS().status});
show('wrong', message(@() genomix.client('a:1', '-rows')));
