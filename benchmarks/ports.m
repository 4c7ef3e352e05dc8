% Prints the median ms to read ports of one second as cell arrays and as matrices. Run by benchmarks/matlab.py.
client = genomix.client;
rosAFE = client.load('rosAFE');
ports = {'ildPort', 'ild'; 'ratemapPort', 'ratemap'; 'crossCorrelationPort', 'crosscorrelation'; ...
    'gammatonePort', 'gammatone'};
printf('%-22s %10s %10s\n', '', 'cells', 'matrices');
for k = 1:size(ports, 1)
    spent = zeros(2, 7);
    for turn = 1:size(spent, 2)
        tic;
        out = rosAFE.(ports{k, 1})(ports{k, 2});
        spent(1, turn) = toc;
        tic;
        out = rosAFE.(ports{k, 1})('-m', ports{k, 2});
        spent(2, turn) = toc;
    end
    printf('%-22s %10.0f %10.0f\n', ports{k, 1}, 1000 * median(spent, 2));
end
