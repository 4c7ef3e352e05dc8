classdef request < handle
%REQUEST  The state of a service call.
%
%   r.status      'sent', 'done' or 'error'
%   r.result      a struct with the outputs of the service, [] before it is done
%   r.exception   a struct with the name of the exception in field ex, its members in detail if there are any, and the
%                 reason in detail.what or what; [] without an exception
%   r.warning     a warning of the component for an accepted request, for example about an unknown choice; '' for none
%   r.wait(s)     waits until the status is not 'sent', at most s seconds, and returns it
%   r.abort()     asks the activity to end
%
%   A rejected request raises no error; scripts check the status. A lost connection to genomixd raises an error. status,
%   result and exception query genomixd until the request has ended.

    properties (Dependent)
        status
        result
        exception
        warning
    end

    properties (Access = private)
        client
        matrices
        state  % the answer of genomixd: status and, at the end, output, large or exception
    end

    methods
        function obj = request(client, state, matrices)
            if ~(isstruct(state) && isfield(state, 'status') && ischar(state.status))
                error('genomix:connection', 'expected the status of a request from genomixd, got another answer');
            end
            obj.client = client;
            obj.state = state;
            obj.matrices = matrices;
        end

        function status = get.status(obj)
            refresh(obj, 0);
            status = obj.state.status;
        end

        function result = get.result(obj)
            refresh(obj, 0);
            result = [];
            if strcmp(obj.state.status, 'done')
                result = output(obj);
            end
        end

        function exception = get.exception(obj)
            refresh(obj, 0);
            exception = [];
            if strcmp(obj.state.status, 'error')
                exception = obj.state.exception;
            end
        end

        function text = get.warning(obj)
            refresh(obj, 0);
            text = '';
            if isfield(obj.state, 'warning')
                text = obj.state.warning;
            end
        end

        function status = wait(obj, seconds)
            %WAIT  Wait until the status is not 'sent', at most some seconds (by default unlimited), and return it.
            if nargin < 2
                seconds = Inf;
            end
            while strcmp(obj.state.status, 'sent') && seconds >= 0
                % In short steps, so that Ctrl-C can interrupt it.
                refresh(obj, min(seconds, 0.5));
                seconds = seconds - 0.5;
            end
            status = obj.state.status;
        end

        function abort(obj)
            %ABORT  Ask the activity to end; no effect if it has ended already.
            if strcmp(obj.state.status, 'sent')
                [answer, failed] = obj.client.get('/request/abort', {'id', obj.state.id}, false);
                if failed
                    error('genomix:request', 'abort: %s', genomix.request.explain(answer));
                end
            end
        end

        function disp(obj)
            refresh(obj, 0);
            [result, exception] = deal('[]');
            if strcmp(obj.state.status, 'error')
                exception = ['[1x1 struct] ' genomix.request.explain(obj.state.exception)];
            elseif strcmp(obj.state.status, 'done')
                result = '[1x1 struct]';
            end
            fprintf('  request with properties:\n\n');
            fprintf('%13s: %s\n', 'status', ['''' obj.state.status ''''], 'result', result, 'exception', exception);
            if isfield(obj.state, 'warning')
                fprintf('%13s: %s\n', 'warning', obj.state.warning);
            end
        end
    end

    methods (Access = private)
        function refresh(obj, seconds)
            % Query the state, and wait at most some seconds for the end.
            if ~strcmp(obj.state.status, 'sent')
                return
            end
            query = {'id', obj.state.id};
            if seconds > 0
                [answer, failed] = obj.client.get('/request/wait', ...
                    [query; {'ms', sprintf('%.0f', 1000 * seconds)}], obj.matrices);
            else
                [answer, failed] = obj.client.get('/request/status', query, obj.matrices);
            end
            if failed % the request is unknown, for example after a restart of genomixd
                answer = struct('status', 'error', 'exception', answer);
            end
            obj.state = answer;
        end

        function value = output(obj)
            % Return the output; large outputs are not part of the state.
            if ~isfield(obj.state, 'output')
                [answer, failed] = obj.client.get('/request/result', {'id', obj.state.id}, obj.matrices);
                if failed
                    error('genomix:request', 'the result is not available: %s', genomix.request.explain(answer));
                end
                obj.state.output = answer;
            end
            value = obj.state.output;
        end
    end

    methods (Static)
        function obj = failure(ex, what)
            %FAILURE  Return a request that has failed before it was sent.
            exception = struct('ex', ex, 'detail', struct('what', what));
            obj = genomix.request([], struct('status', 'error', 'exception', exception), false);
        end

        function text = explain(exception)
            %EXPLAIN  Describe an exception in one line.
            text = exception.ex;
            if isfield(exception, 'detail') && isfield(exception.detail, 'what')
                text = [text ': ' exception.detail.what];
            elseif isfield(exception, 'what')
                text = [text ': ' exception.what];
            end
        end
    end
end
