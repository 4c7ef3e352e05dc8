function [value, failed] = get(name, matrices, columns = false)
    file = fopen(name);
    [value, failed] = genomix.wire.decode(uint8(fread(file, Inf).'), matrices, columns);
    fclose(file);
end
p = get('plain', false);
assert(iscell(p.a) && isequal(size(p.a), [1 3]) && p.a{2} == 2.5 && isnan(p.a{3}))
assert(isequal(p.b, {'x', 'äß€', ''}) && isequal(size(p.c), [1 0]) && iscell(p.c))
t = get('plain', false, true);
assert(isequal(t.a(1:2), {1; 2.5}) && isequal(t.b, {'x'; 'äß€'; ''}) && isequal(size(t.c), [0 1]))
m = get('plain', true);
assert(isa(m.a, 'double') && m.a(1) == 1 && iscell(m.b))
c = get('lags', false);
assert(isequal(size(c.dataNxN), [1 4]) && isequal(c.dataNxN{3}.dataN{2}.data, {210, 211, 212}))
c = get('lags', false, true);
assert(isequal(size(c.dataNxN), [4 1]) && isequal(c.dataNxN{3}.dataN{2}.data, {210; 211; 212}))
e = get('empty', false);
none = struct('data', {cell(1, 0)});
assert(isequal(e, struct('dataNxN', {{struct('dataN', {{none, none}})}})))
assert(isequal(size(get('empty', true)), [0 2]))
m = get('lags', true);
assert(isequal(size(m), [3 2 4]) && isequal(m(:, 2, 3), [210; 211; 212]))
r = get('ragged', true);
assert(isequal(r.dataN{1}, [1; 1]) && isequal(r.dataN{2}, [0; 0; 0]))
[e, failed] = get('error', false);
assert(failed && strcmp(e.ex, 'x'))
sent = {1, -0.1, 1/3, true, int32(7), 'a"\', {}, [], {1, {'x'}}, [1 2; 3 4], struct('a', {{}}), NaN, -Inf, 1e300};
printf('%s\n', genomix.wire.encode(sent))
printf('%s\n', genomix.wire.encode(sprintf('a\tb\nc')), genomix.wire.quote('ä b&c/d%_-.~'))
try
    genomix.wire.encode({@sin})
catch problem
    printf('%s\n', problem.identifier)
end
