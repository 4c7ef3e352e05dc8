function value = chars(value)
%CHARS  Convert a text of class string to class char; return other values unchanged.

if isa(value, 'string') && isscalar(value)
    value = char(value);
end
end
