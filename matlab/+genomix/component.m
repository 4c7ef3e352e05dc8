classdef component < handle
%COMPONENT  A component of the ROS graph. Its services and ports are properties that can be called.
%
%   rosAFE                                    % lists services and ports
%   r = rosAFE.InputProc('-a', 'input', 12000, 1, 1)
%   r = rosAFE.GammatoneProc(struct('fb_nChannels', 16))
%   p = rosAFE.ildPort('ild')
%
%   A service accepts its arguments by position, or one struct with arguments by name; missing arguments have their
%   defaults. It returns a genomix.request when it has finished, or, with '-a' as the first argument, when it has been
%   accepted. A port returns a struct with one field of its name. With '-m', sequences of numbers are matrices and not
%   cell arrays. '-h' prints a description of the service or port. Names are case-insensitive if they are unambiguous.
%
%   Use genomix.client/load to create components. delete(component) deletes the object; the component continues to run.

    properties (Access = private)
        client
        about  % the description of the component
    end

    methods
        function obj = component(client, about)
            obj.client = client;
            obj.about = about;
        end

        function varargout = subsref(obj, s)
            if ~strcmp(s(1).type, '.')
                error('genomix:component', ...
                    'expected a service or a port of the component, for example rosAFE.getParameters()');
            end
            called = numel(s) > 1 && strcmp(s(2).type, '()');
            if strcmp(s(1).subs, 'delete')
                delete(obj);
                return
            end
            if called
                value = call(obj, s(1).subs, s(2).subs);
                if nargout == 0 && isequal(value, [])
                    return % help was printed
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
            %FIELDNAMES  Return the names of the services and ports.
            names = {};
            if ~isempty(obj.about)
                names = [fieldnames(obj.about.services); fieldnames(obj.about.ports)];
            end
        end

        function names = properties(obj)
            %PROPERTIES  Same as fieldnames.
            names = fieldnames(obj);
        end

        function yes = isprop(obj, name)
            %ISPROP  Return whether there is a service or port of exactly this name.
            yes = any(strcmp(name, fieldnames(obj)));
        end

        function about = describe(obj)
            %DESCRIBE  Return the description of the component, its services and ports.
            about = obj.about;
        end

        function delete(obj)
            %DELETE  Delete the object. The component continues to run.
            if isempty(obj.about)
                return
            end
            try
                if obj.client.isConnected()
                    obj.client.get(['/unload/' obj.about.name], {}, false);
                end
            catch
                % The server or the session has ended already.
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
        function value = call(obj, name, args)
            % Call a service or read a port.
            [name, kind] = entry(obj, name);
            flags = struct('a', false, 'm', false, 'h', false);
            args = cellfun(@genomix.wire.chars, args, 'UniformOutput', false);
            while ~isempty(args) && ischar(args{1}) && any(strcmp(args{1}, {'-a', '-m', '-h'}))
                flags.(args{1}(2)) = true;
                args(1) = [];
            end
            description = obj.about.(kind).(name);
            if flags.h
                fprintf('%s\n', genomix.wire.help(obj.about.name, name, description));
                value = [];
                return
            end
            if isempty(args) && genomix.wire.interactive()
                args = genomix.wire.ask(description);
            end
            path = ['/' genomix.wire.quote(obj.about.name) '/' name];
            query = {'i', obj.about.instance};
            try
                if strcmp(kind, 'ports')
                    query = [query; element(args, description)];
                else
                    query = [query; {'input', input_of(args)}];
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
                state = struct('status', 'done', 'output', answer);
                if isfield(answer, 'warning')
                    state.warning = answer.warning;
                    state.output = rmfield(answer, 'warning');
                end
                value = genomix.request(obj.client, state, flags.m);
            end
        end

        function [name, kind] = entry(obj, name)
            % Find a service or port by name; return its name and 'services' or 'ports'.
            if isempty(obj.about)
                error('genomix:component', 'the component was deleted; load it again with client.load');
            end
            for compare = {@strcmp, @strcmpi}
                for kinds = {'services', 'ports'}
                    kind = kinds{1};
                    entries = obj.about.(kind);
                    names = fieldnames(entries);
                    for k = 1:numel(names)
                        if any(compare{1}(name, [names(k); entries.(names{k}).aliases(:)]))
                            name = names{k};
                            return
                        end
                    end
                end
            end
            error('genomix:component', '%s: expected a service or port (%s), got ''%s''', obj.about.name, ...
                strjoin(fieldnames(obj).', ', '), name);
        end
    end
end

function query = element(args, port)
% Return the element of a port, the first argument; ignore arguments of ports without elements.
query = cell(0, 2);
if isempty(args) || ~port.multiple
    return
end
if ~ischar(args{1}) || size(args{1}, 1) > 1
    error('genomix:argument', 'element: expected a text, got %s', class(args{1}));
end
genomix.wire.utf8(args{1}); % raises an error if it is not valid
query = {'element', args{1}};
end

function text = input_of(args)
if numel(args) == 1 && isstruct(args{1})
    text = genomix.wire.encode(args{1});
else
    text = genomix.wire.encode(args);
end
if numel(text) > 80000 % up to three times as many in a URL, which may have 256 KiB
    error('genomix:argument', 'expected arguments of at most 80000 characters, got %d', numel(text));
end
end
