function [bass, rosAFE, client] = initRosAFE(varargin)
%INITROSAFE  Both components and the client: [bass, rosAFE, client] = initRosAFE()
%
%   Folders to be put on the path may be given, as to the original's function; those that do not exist are passed over.

for folder = varargin(cellfun(@(name) exist(name, 'dir') == 7, varargin))
    addpath(genpath(folder{1}));
end
startAuditoryFrontEnd();
startRosAFE();
client = genomix.client();
bass = client.load('bass');
rosAFE = client.load('rosAFE');
end
