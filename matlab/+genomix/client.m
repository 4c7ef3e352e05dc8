classdef client < handle
%CLIENT  A connection to genomixd, through which the components of the ROS graph are used.
%
%   client = genomix.client                   % the genomixd of this machine (or of the environment's GENOMIXD)
%   client = genomix.client('host:8080')      % that of another one; 8080 is the port unless another is given
%   client = genomix.client('-columns')       % with sequences as N-by-1 cells, not 1-by-N; also after an address
%   rosAFE = client.load('rosAFE')            % a genomix.component
%   left = client.load('rosAFE', '-i', 'left')
%   delete(client)                            % activities go on
%
%   See docs/matlab.md.

    properties (SetAccess = private)
        address  % host:port of genomixd
        session  % the name under which genomixd knows this client
        columns  % whether sequences are N-by-1 cells, as in the original's first version
    end

    properties (Access = private)
        lost = false; % whether genomixd did not answer the last time
    end

    methods
        function obj = client(varargin)
            given = cellfun(@genomix.wire.chars, varargin, 'UniformOutput', false);
            obj.columns = ~isempty(given) && ischar(given{end}) && strcmp(given{end}, '-columns');
            given = given(1:end - obj.columns);
            if isempty(given)
                given = {getenv('GENOMIXD')};
            elseif numel(given) > 1
                error('genomix:connection', 'after the address of genomixd there may be only: ''-columns''');
            end
            obj.address = full_address(given{1});
            [~, obj.session] = fileparts(tempname()); % MATLAB's rand begins alike in every process
            obj.get('/components', {}, false);
        end

        function component = load(obj, component, varargin)
            %LOAD  A component that runs, as a genomix.component: load(name), load(name, '-i', instance)
            if nargin > 1
                component = genomix.wire.chars(component);
            end
            if nargin < 2 || ~ischar(component) || isempty(component)
                error('genomix:load', 'load takes the name of a component, such as ''rosAFE''');
            end
            [~, name] = fileparts(component); % the original takes paths of plug-ins, too
            query = {};
            varargin = cellfun(@genomix.wire.chars, varargin, 'UniformOutput', false);
            if numel(varargin) == 2 && strcmp(varargin{1}, '-i') && ischar(varargin{2})
                query = {'i', varargin{2}};
            elseif ~isempty(varargin)
                error('genomix:load', 'after the name of a component there may be only: ''-i'', ''instance''');
            end
            [about, failed] = obj.get(['/load/' genomix.wire.quote(name)], query, false);
            if failed
                error('genomix:load', 'load %s: %s', component, genomix.request.explain(about));
            elseif ~isstruct(about) || ~all(isfield(about, {'name', 'instance', 'services', 'ports'})) || ...
                    ~isstruct(about.services) || ~isstruct(about.ports)
                error('genomix:connection', 'what answers at %s is no genomixd', obj.address);
            end
            component = genomix.component(obj, about);
        end

        function rpath(~, ~)
            %RPATH  Accepted for the original's scripts: components are found on the graph, there are no plug-ins.
        end

        function [answer, failed] = get(obj, path, query, matrices)
            %GET  The answer of genomixd to a URL of this session; see genomix.wire.fetch.
            if isempty(obj.session)
                error('genomix:connection', 'the client was deleted');
            end
            obj.lost = true; % unless it returns
            [answer, failed] = genomix.wire.fetch(obj.address, path, [{'s', obj.session}; query], matrices, ...
                obj.columns);
            obj.lost = false;
        end

        function yes = isConnected(obj)
            %ISCONNECTED  Whether there is a session, and genomixd has answered the last time.
            yes = ~isempty(obj.session) && ~obj.lost;
        end

        function delete(obj)
            %DELETE  End the session. Activities go on.
            if isConnected(obj)
                try
                    obj.get('/session/stop', {}, false);
                catch
                    % Then the server is gone, and the session with it.
                end
            end
            obj.session = '';
        end

        function disp(obj)
            fprintf('  genomix.client of genomixd at %s\n', obj.address);
        end
    end
end

function address = full_address(address)
if ~isempty(address) && ~(ischar(address) && isrow(address))
    error('genomix:connection', 'the address of genomixd is a text, such as ''host:8080''');
end
address = regexprep(address, '^http://|/+$', '');
if isempty(address) || address(1) == ':'
    address = ['127.0.0.1' address];
end
if isempty(regexp(address, ':\d+$', 'once'))
    address = [address ':8080'];
end
end
