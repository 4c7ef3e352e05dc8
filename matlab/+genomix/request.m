classdef request < handle
%REQUEST  What became of a service that was called.
%
%   r.status      'sent', 'done' or 'error', as it is now
%   r.result      a struct with the service's outputs, [] before it is done
%   r.exception   a struct with the name of the exception in field ex, for some its members in detail, and the reason
%                 in detail.what or in what; [] for none
%   r.warning     what the component has to say of a request that it grants all the same, such as a word that it does
%                 not know; '' for nothing
%   r.wait(s)     waits until it is no longer 'sent', or for s seconds, and returns the status
%   r.abort()     asks the activity to end
%
%   A refusal raises no error: scripts look at status. A lost connection to genomixd does raise one. status, result and
%   exception ask genomixd until the request has ended.

    properties (Dependent)
        status
        result
        exception
        warning
    end

    properties (Access = private)
        client
        matrices
        told  % as genomixd tells it: status and, in time, output, large or exception
    end

    methods
        function obj = request(client, told, matrices)
            if ~(isstruct(told) && isfield(told, 'status') && ischar(told.status))
                error('genomix:connection', 'genomixd does not say what has become of a request');
            end
            obj.client = client;
            obj.told = told;
            obj.matrices = matrices;
        end

        function status = get.status(obj)
            refresh(obj, 0);
            status = obj.told.status;
        end

        function result = get.result(obj)
            refresh(obj, 0);
            result = [];
            if strcmp(obj.told.status, 'done')
                result = output(obj);
            end
        end

        function exception = get.exception(obj)
            refresh(obj, 0);
            exception = [];
            if strcmp(obj.told.status, 'error')
                exception = obj.told.exception;
            end
        end

        function text = get.warning(obj)
            refresh(obj, 0);
            text = '';
            if isfield(obj.told, 'warning')
                text = obj.told.warning;
            end
        end

        function status = wait(obj, seconds)
            %WAIT  The status once it is no longer 'sent', or after some seconds (for ever by default).
            if nargin < 2
                seconds = Inf;
            end
            while strcmp(obj.told.status, 'sent') && seconds >= 0
                % In short steps, so that Ctrl-C interrupts it.
                refresh(obj, min(seconds, 0.5));
                seconds = seconds - 0.5;
            end
            status = obj.told.status;
        end

        function abort(obj)
            %ABORT  Ask the activity to end; what has ended already stays as it is.
            if strcmp(obj.told.status, 'sent')
                [answer, failed] = obj.client.get('/request/abort', {'id', obj.told.id}, false);
                if failed
                    error('genomix:request', 'abort: %s', genomix.request.explain(answer));
                end
            end
        end

        function disp(obj)
            refresh(obj, 0);
            [result, exception] = deal('[]');
            if strcmp(obj.told.status, 'error')
                exception = ['[1x1 struct] ' genomix.request.explain(obj.told.exception)];
            elseif strcmp(obj.told.status, 'done')
                result = '[1x1 struct]';
            end
            fprintf('  request with properties:\n\n');
            fprintf('%13s: %s\n', 'status', ['''' obj.told.status ''''], 'result', result, 'exception', exception);
            if isfield(obj.told, 'warning')
                fprintf('%13s: %s\n', 'warning', obj.told.warning);
            end
        end
    end

    methods (Access = private)
        function refresh(obj, seconds)
            % Ask genomixd what has become of it, and wait some seconds for an end.
            if ~strcmp(obj.told.status, 'sent')
                return
            end
            query = {'id', obj.told.id};
            if seconds > 0
                [answer, failed] = obj.client.get('/request/wait', ...
                    [query; {'ms', sprintf('%.0f', 1000 * seconds)}], obj.matrices);
            else
                [answer, failed] = obj.client.get('/request/status', query, obj.matrices);
            end
            if failed % genomixd has forgotten it: perhaps it is another one by now
                answer = struct('status', 'error', 'exception', answer);
            end
            obj.told = answer;
        end

        function value = output(obj)
            % Large outputs are not part of the status.
            if ~isfield(obj.told, 'output')
                [answer, failed] = obj.client.get('/request/result', {'id', obj.told.id}, obj.matrices);
                if failed
                    error('genomix:request', 'the result is lost: %s', genomix.request.explain(answer));
                end
                obj.told.output = answer;
            end
            value = obj.told.output;
        end
    end

    methods (Static)
        function obj = failure(ex, what)
            %FAILURE  A request that was never sent, and why.
            exception = struct('ex', ex, 'detail', struct('what', what));
            obj = genomix.request([], struct('status', 'error', 'exception', exception), false);
        end

        function text = explain(exception)
            %EXPLAIN  One line that tells an exception.
            text = exception.ex;
            if isfield(exception, 'detail') && isfield(exception.detail, 'what')
                text = [text ': ' exception.detail.what];
            elseif isfield(exception, 'what')
                text = [text ': ' exception.what];
            end
        end
    end
end
