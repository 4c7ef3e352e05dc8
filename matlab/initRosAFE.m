function [bass, rosAFE, client] = initRosAFE(varargin)
%INITROSAFE  Load both components: [bass, rosAFE, client] = initRosAFE()
%
%   Arguments are folders that are added to the path, as in the original; missing folders are ignored.

for folder = varargin(cellfun(@(name) exist(name, 'dir') == 7, varargin))
    addpath(genpath(folder{1}));
end
startAuditoryFrontEnd();
startRosAFE();
client = genomix.client();
bass = client.load('bass');
rosAFE = client.load('rosAFE');
end
