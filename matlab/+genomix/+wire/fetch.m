function [answer, failed] = fetch(address, path, query, matrices, columns)
%FETCH  What genomixd answers to one request (docs/genomixd.md).
%
%   [answer, failed] = genomix.wire.fetch('host:port', '/call/rosAFE/Stop', {'s', 'me'; ...}, matrices, columns)
%
%   QUERY is an N-by-2 cell array of names and texts; MATRICES and COLUMNS are those of genomix.wire.decode. FAILED is
%   true where the server or the component refused, and ANSWER is the exception then (fields ex and, for some, detail
%   and what). A server that cannot be reached raises the error genomix:connection.

url = ['http://' address path '?syntax=packed'];
for k = 1:size(query, 1)
    url = [url '&' query{k, 1} '=' genomix.wire.quote(query{k, 2})]; %#ok<AGROW>
end
if exist('OCTAVE_VERSION', 'builtin')
    bypass_proxy(address);
    [bytes, reached, message] = urlread(url); %#ok<URLRD> webread loses time here
else
    reached = true;
    message = '';
    bytes = [];
    try
        % genomixd itself gives up after 75 s at the latest
        bytes = webread(url, weboptions('ContentType', 'binary', 'Timeout', 120));
    catch problem
        reached = false;
        message = problem.message;
    end
end
if ~reached && ~isempty(regexp(message, '\<403\>|response code', 'once')) % Octave tells no number
    host = regexprep(address, ':\d+$', '');
    error('genomix:connection', ['genomixd at %s refuses the request (%s). If it does not know the ' ...
        'name %s, start it with --name %s, or use its IP address.'], address, message, host, host);
elseif ~reached
    error('genomix:connection', ['no answer from genomixd at %s (%s). If it does not run, start it there: ' ...
        'genomixd &. If it runs elsewhere, say where: genomix.client(''host:8080'').'], address, message);
end
if isempty(bytes)
    answer = [];
    failed = false;
    return
end
bytes = uint8(bytes(:).');
if ~any(bytes(1) == uint8('dsD[{S!'))
    error('genomix:connection', 'what answers at %s is no genomixd: %s', address, char(bytes(1:min(end, 80))));
end
[answer, failed] = genomix.wire.decode(bytes, matrices, columns);
end

function bypass_proxy(address)
% A proxy for the Internet knows nothing of robots.
host = regexprep(address, ':\d+$', '');
for name = {'no_proxy', 'NO_PROXY'}
    hosts = getenv(name{1});
    if ~any(strcmp(host, strsplit(hosts, ',')))
        setenv(name{1}, [host ',' hosts]);
    end
end
end
