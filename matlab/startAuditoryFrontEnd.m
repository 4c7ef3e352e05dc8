function startAuditoryFrontEnd()
%STARTAUDITORYFRONTEND  Nothing to start: stands in where Two!Ears' MATLAB front-end is not on the path.
end
