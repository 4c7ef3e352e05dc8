classdef client < handle
%CLIENT  A connection to genomixd, which gives access to the components of the ROS graph.
%
%   client = genomix.client                   % genomixd on this machine, or at the environment variable GENOMIXD
%   client = genomix.client('host:8080')      % on another machine; the default port is 8080
%   client = genomix.client('-columns')       % sequences are N-by-1 cells, not 1-by-N; also after an address
%   rosAFE = client.load('rosAFE')            % a genomix.component
%   left = client.load('rosAFE', '-i', 'left')
%   delete(client)                            % activities continue
%
%   See docs/matlab.md.

    properties (SetAccess = private)
        address  % host:port of genomixd
        session  % name of the session of this client
        columns  % whether sequences are N-by-1 cells, as in the first version of the original
    end

    properties (Access = private)
        lost = false; % whether the last request was not answered
    end

    methods
        function obj = client(varargin)
            args = cellfun(@genomix.wire.chars, varargin, 'UniformOutput', false);
            obj.columns = ~isempty(args) && ischar(args{end}) && strcmp(args{end}, '-columns');
            args = args(1:end - obj.columns);
            if isempty(args)
                args = {getenv('GENOMIXD')};
            elseif numel(args) > 1
                error('genomix:connection', 'expected at most ''-columns'' after the address of genomixd');
            end
            obj.address = full_address(args{1});
            [~, obj.session] = fileparts(tempname()); % the numbers of rand are the same in every new process of MATLAB
            obj.get('/components', {}, false);
        end

        function component = load(obj, component, varargin)
            %LOAD  Return a running component as a genomix.component: load(name), load(name, '-i', instance)
            if nargin > 1
                component = genomix.wire.chars(component);
            end
            if nargin < 2 || ~ischar(component) || isempty(component)
                error('genomix:load', 'load: expected the name of a component, for example ''rosAFE''');
            end
            query = {};
            varargin = cellfun(@genomix.wire.chars, varargin, 'UniformOutput', false);
            if numel(varargin) == 2 && strcmp(varargin{1}, '-i') && ischar(varargin{2})
                query = {'i', varargin{2}};
            elseif ~isempty(varargin)
                error('genomix:load', 'load: expected ''-i'', ''instance'' after the name of a component');
            end
            [about, failed] = obj.get(['/load/' genomix.wire.quote(component)], query, false);
            if failed
                error('genomix:load', 'load %s: %s', component, genomix.request.explain(about));
            elseif ~isstruct(about) || ~all(isfield(about, {'name', 'instance', 'services', 'ports'})) || ...
                    ~isstruct(about.services) || ~isstruct(about.ports)
                error('genomix:connection', 'the server at %s is not a genomixd', obj.address);
            end
            component = genomix.component(obj, about);
        end

        function rpath(~, ~)
            %RPATH  Accepted for scripts of the original, without effect: components are found on the ROS graph.
        end

        function [answer, failed] = get(obj, path, query, matrices)
            %GET  Request a URL in this session and return the answer; see genomix.wire.fetch.
            if isempty(obj.session)
                error('genomix:connection', 'the client has been deleted');
            end
            obj.lost = true; % until the answer is received
            [answer, failed] = genomix.wire.fetch(obj.address, path, [{'s', obj.session}; query], matrices, ...
                obj.columns);
            obj.lost = false;
        end

        function yes = isConnected(obj)
            %ISCONNECTED  Return whether there is a session and the last request was answered.
            yes = ~isempty(obj.session) && ~obj.lost;
        end

        function delete(obj)
            %DELETE  End the session. Activities continue.
            if isConnected(obj)
                try
                    obj.get('/session/stop', {}, false);
                catch
                    % The server has ended, and with it the session.
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
    error('genomix:connection', 'address: expected a text, for example ''host:8080''');
end
address = regexprep(address, '^http://|/+$', '');
if isempty(address) || address(1) == ':'
    address = ['127.0.0.1' address];
end
if isempty(regexp(address, ':\d+$', 'once'))
    address = [address ':8080'];
end
end
