function value = chars(value)
%CHARS  A text of MATLAB's class string as one of class char; anything else as it is.

if isa(value, 'string') && isscalar(value)
    value = char(value);
end
end
