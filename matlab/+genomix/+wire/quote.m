function text = quote(text)
%QUOTE  Encode a text for a URL: bytes except letters, digits and -_.~ become a percent sign and two hex digits.

bytes = genomix.wire.utf8(text);
plain = (bytes >= 'a' & bytes <= 'z') | (bytes >= 'A' & bytes <= 'Z') | (bytes >= '0' & bytes <= '9') | ...
    ismember(bytes, uint8('-_.~'));
pieces = cell(1, numel(bytes));
pieces(plain) = num2cell(char(bytes(plain)));
pieces(~plain) = arrayfun(@(byte) sprintf('%%%02X', byte), bytes(~plain), 'UniformOutput', false);
text = [pieces{:}];
if isempty(text)
    text = '';
end
end
