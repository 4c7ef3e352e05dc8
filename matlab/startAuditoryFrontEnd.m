function startAuditoryFrontEnd()
%STARTAUDITORYFRONTEND  Does nothing. It is called if the MATLAB Auditory Front-End of Two!Ears is not on the path.
end
