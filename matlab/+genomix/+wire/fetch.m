function [answer, failed] = fetch(address, path, query, matrices, columns)
%FETCH  Send one request to genomixd and return the answer (docs/genomixd.md).
%
%   [answer, failed] = genomix.wire.fetch('host:port', '/call/rosAFE/Stop', {'s', 'me'; ...}, matrices, columns)
%
%   QUERY is an N-by-2 cell array of names and texts; MATRICES and COLUMNS are those of genomix.wire.decode. FAILED is
%   true if the server or the component rejected the request; ANSWER is then the exception, with the field ex and
%   possibly detail and what. A server that cannot be reached raises the error genomix:connection.

url = ['http://' address path '?syntax=packed'];
for k = 1:size(query, 1)
    url = [url '&' query{k, 1} '=' genomix.wire.quote(query{k, 2})]; %#ok<AGROW>
end
if exist('OCTAVE_VERSION', 'builtin')
    bypass_proxy(address);
    [bytes, reached, message] = urlread(url); %#ok<URLRD> webread is slower here
else
    reached = true;
    message = '';
    bytes = [];
    try
        % genomixd has a timeout of 75 s
        bytes = webread(url, weboptions('ContentType', 'binary', 'Timeout', 120));
    catch problem
        reached = false;
        message = problem.message;
    end
end
if ~reached && ~isempty(regexp(message, '\<403\>|response code', 'once')) % Octave reports no status code
    host = regexprep(address, ':\d+$', '');
    error('genomix:connection', ['genomixd at %s rejects the request (%s). If it does not accept the ' ...
        'host name %s, start it with --name %s, or use its IP address.'], address, message, host, host);
elseif ~reached
    error('genomix:connection', ['no answer from genomixd at %s (%s). If it is not running, start it there: ' ...
        'genomixd &. If it runs on another machine: genomix.client(''host:8080'').'], address, message);
end
if isempty(bytes)
    answer = [];
    failed = false;
    return
end
bytes = uint8(bytes(:).');
if ~any(bytes(1) == uint8('dsD[{S!'))
    error('genomix:connection', 'the server at %s is not a genomixd: %s', address, char(bytes(1:min(end, 80))));
end
[answer, failed] = genomix.wire.decode(bytes, matrices, columns);
end

function bypass_proxy(address)
% A web proxy cannot reach the robot.
host = regexprep(address, ':\d+$', '');
for name = {'no_proxy', 'NO_PROXY'}
    hosts = getenv(name{1});
    if ~any(strcmp(host, strsplit(hosts, ',')))
        setenv(name{1}, [host ',' hosts]);
    end
end
end
