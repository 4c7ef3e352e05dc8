1; % a script that starts with functions
function signal_test(name)
    fclose(fopen(name, 'w'));
end
function await(name)
    while exist(name, 'file') ~= 2
        pause(0.02);
    end
end
client = genomix.client;
bass = client.load('bass');
acquire = bass.Acquire('-a', 'scene:');
show('sent', acquire.status);
signal_test('1 kill the node');
status = acquire.wait(60);
show('killed', {status, acquire.exception.ex, acquire.exception.detail.what});
r = bass.ListDevices();
show('dead', {r.status, r.exception.ex});
p = bass.Audio();
show('dead port', {class(p), p.status});
show('load', message(@() client.load('bass')));
signal_test('2 start the node');
await('3 the node is back');
again = bass.Acquire('-a', 'scene:');
show('back', again.status);

signal_test('4 end the server');
await('5 the server has ended');
show('gone', message(@() bass.Stop()));
show('gone status', message(@() again.status));
delete(bass);
signal_test('6 start the server');
await('7 the server is back');
bass = client.load('bass');
show('forgotten', {again.status, again.exception.ex});
show('works', bass.Stop().status);
delete(client);
show('closed', message(@() client.load('bass')));
