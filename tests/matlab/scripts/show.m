function show(name, value)
  printf('%s=%s\n', name, jsonencode(value));
end
