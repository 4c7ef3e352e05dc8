function bytes = utf8(text)
%UTF8  A text as bytes. What is no text in Unicode, such as half a pair of surrogates, raises genomix:argument.

try
    bytes = unicode2native(text, 'UTF-8');
    whole = isequal(native2unicode(bytes, 'UTF-8'), text) || isempty(text);
catch
    whole = false;
end
if ~whole
    error('genomix:argument', 'a text with bytes that are no UTF-8 cannot be sent');
end
end
