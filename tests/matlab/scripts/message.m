function text = message(work)
  text = '';
  try
    work();
  catch problem
    text = [problem.identifier ' ' problem.message];
  end
end
