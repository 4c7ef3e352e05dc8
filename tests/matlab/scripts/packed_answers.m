file = fopen('documents');
slowest = 0;
while true
    header = fread(file, 2, 'uint32');
    if isempty(header), break, end
    bytes = uint8(fread(file, header(1), 'uint8').');
    for matrices = [false true]
        begin = cputime();
        told = 'good';
        try
            genomix.wire.decode(bytes, matrices, header(2) == 2);
        catch problem
            told = problem.identifier;
            if any(problem.message == "\n") || numel(problem.message) > 300
                told = ['long: ' problem.message];
            end
        end
        printf('%s\n', told);
        slowest = max(slowest, cputime() - begin);
    end
end
status = fileread('/proc/self/status');
printf('%g %s\n', slowest, regexp(status, 'VmHWM:\s*(\d+)', 'tokens'){1}{1});
