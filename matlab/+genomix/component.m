classdef component < handle
%COMPONENT  A component of the ROS graph: its services and ports as properties that are called.
%
%   rosAFE                                    % lists them
%   r = rosAFE.InputProc('-a', 'input', 12000, 1, 1)
%   r = rosAFE.GammatoneProc(struct('fb_nChannels', 16))
%   p = rosAFE.ildPort('ild')
%
%   A service takes its arguments by position, or as one struct by name; what is missing takes its default. It returns
%   a genomix.request when it is done, with '-a' as the first argument as soon as it is acknowledged. A port returns a
%   struct with one field of its name. With '-m', sequences of numbers are matrices and no cell arrays. '-h' prints what
%   there is to know about a service or port. Upper and lower case do not matter where there is no doubt.
%
%   genomix.client/load makes components. delete(component) forgets one, and leaves it running.

    properties (Access = private)
        client
        about  % what genomixd tells of the component
    end

    methods
        function obj = component(client, about)
            obj.client = client;
            obj.about = about;
        end

        function varargout = subsref(obj, s)
            if ~strcmp(s(1).type, '.')
                error('genomix:component', 'a component has services and ports: rosAFE.getParameters()');
            end
            called = numel(s) > 1 && strcmp(s(2).type, '()');
            if strcmp(s(1).subs, 'delete')
                delete(obj);
                return
            end
            if called
                value = call(obj, s(1).subs, s(2).subs);
                if nargout == 0 && isequal(value, [])
                    return % help was shown
                end
            else
                name = entry(obj, s(1).subs);
                value = @(varargin) call(obj, name, varargin);
            end
            if numel(s) > 1 + called
                value = subsref(value, s(2 + called:end));
            end
            varargout = {value};
        end

        function names = fieldnames(obj)
            %FIELDNAMES  The names of the services and ports.
            names = {};
            if ~isempty(obj.about)
                names = [fieldnames(obj.about.services); fieldnames(obj.about.ports)];
            end
        end

        function names = properties(obj)
            %PROPERTIES  As fieldnames.
            names = fieldnames(obj);
        end

        function yes = isprop(obj, name)
            %ISPROP  Whether there is a service or port of exactly this name.
            yes = any(strcmp(name, fieldnames(obj)));
        end

        function about = describe(obj)
            %DESCRIBE  What genomixd tells about the component, its services and ports.
            about = obj.about;
        end

        function delete(obj)
            %DELETE  Forget the component, which goes on.
            if isempty(obj.about)
                return
            end
            try
                if obj.client.isConnected()
                    obj.client.get(['/unload/' obj.about.name], {}, false);
                end
            catch
                % Then the server or the client is gone, and has forgotten it already.
            end
            obj.about = [];
        end

        function disp(obj)
            if isempty(obj.about)
                fprintf('  deleted genomix.component\n');
                return
            end
            fprintf('  genomix.component %s with properties:\n\n', obj.about.name);
            names = fieldnames(obj);
            for k = 1:numel(names)
                fprintf('%25s: [function_handle]\n', names{k});
            end
            fprintf('\n');
        end
    end

    methods (Access = private)
        function value = call(obj, name, given)
            % A service is called or a port is read.
            [name, kind] = entry(obj, name);
            flags = struct('a', false, 'm', false, 'h', false);
            given = cellfun(@genomix.wire.chars, given, 'UniformOutput', false);
            while ~isempty(given) && ischar(given{1}) && any(strcmp(given{1}, {'-a', '-m', '-h'}))
                flags.(given{1}(2)) = true;
                given(1) = [];
            end
            described = obj.about.(kind).(name);
            if flags.h
                fprintf('%s\n', genomix.wire.help(obj.about.name, name, described));
                value = [];
                return
            end
            if isempty(given) && genomix.wire.interactive()
                given = genomix.wire.ask(described);
            end
            path = ['/' genomix.wire.quote(obj.about.name) '/' name];
            query = {'i', obj.about.instance};
            try
                if strcmp(kind, 'ports')
                    query = [query; element(given, described)];
                else
                    query = [query; {'input', input_of(given)}];
                end
            catch problem
                value = genomix.request.failure('::genom::serialization', [name ': ' problem.message]);
                return
            end
            if flags.a
                [answer, failed] = obj.client.get(['/send' path], [query; {'ack', '1'}], flags.m);
            else
                [answer, failed] = obj.client.get(['/call' path], query, flags.m);
            end
            if strcmp(kind, 'ports') && ~flags.a && ~failed
                value = answer;
            elseif flags.a && ~failed
                value = genomix.request(obj.client, answer, flags.m);
            elseif failed
                value = genomix.request(obj.client, struct('status', 'error', 'exception', answer), flags.m);
            else
                told = struct('status', 'done', 'output', answer);
                if isfield(answer, 'warning')
                    told.warning = answer.warning;
                    told.output = rmfield(answer, 'warning');
                end
                value = genomix.request(obj.client, told, flags.m);
            end
        end

        function [name, kind] = entry(obj, name)
            % The service or port that is meant, and which of both it is.
            if isempty(obj.about)
                error('genomix:component', 'the component was deleted; client.load loads it again');
            end
            for same = {@strcmp, @strcmpi}
                for kinds = {'services', 'ports'}
                    kind = kinds{1};
                    entries = obj.about.(kind);
                    names = fieldnames(entries);
                    for k = 1:numel(names)
                        if any(same{1}(name, [names(k); entries.(names{k}).aliases(:)]))
                            name = names{k};
                            return
                        end
                    end
                end
            end
            error('genomix:component', '%s has no service or port ''%s''; it has: %s', obj.about.name, name, ...
                strjoin(fieldnames(obj).', ', '));
        end
    end
end

function query = element(given, port)
% The first argument names the element of a port; scripts give some to ports that have none.
query = cell(0, 2);
if isempty(given) || ~port.multiple
    return
end
if ~ischar(given{1}) || size(given{1}, 1) > 1
    error('genomix:argument', 'the name of an element is one text, and no %s', class(given{1}));
end
genomix.wire.utf8(given{1}); % raises an error where it is none
query = {'element', given{1}};
end

function text = input_of(given)
if numel(given) == 1 && isstruct(given{1})
    text = genomix.wire.encode(given{1});
else
    text = genomix.wire.encode(given);
end
if numel(text) > 80000 % three times as many in a URL, of which genomixd takes 256 KiB
    error('genomix:argument', 'the arguments are too long: %d characters', numel(text));
end
end
