function bytes = utf8(text)
%UTF8  Encode a text. Invalid Unicode, for example an unpaired surrogate, raises the error genomix:argument.

try
    bytes = unicode2native(text, 'UTF-8');
    valid = isequal(native2unicode(bytes, 'UTF-8'), text) || isempty(text);
catch
    valid = false;
end
if ~valid
    error('genomix:argument', 'expected a text in valid Unicode');
end
end
