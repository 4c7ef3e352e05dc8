clear all; close all; clc;
addpath(genpath('/home/user/genom_ws/rosAFE/examples'));
[ bass, rosAFE, client ] = initRosAFE( );
sampleRate = 16000;
dObj = dataObject_RosAFE( bass, rosAFE, 'scene:', sampleRate, 1600, 1, 1, 1, 10 );
mObj = manager_RosAFE(dObj);
mObj.addProcessor('ild');
mObj.addProcessor('ratemap');
mObj.addProcessor('pitch', genParStruct('fb_nChannels', 4));
mObj.addProcessor('crosscorrelation', genParStruct('fb_nChannels', 4));
mObj.addProcessor('amsFeatures', genParStruct('fb_nChannels', 4));
mObj.modifyParameter( 'time_0', 'pp_bRemoveDC', '0' );
mObj.processChunk( );
while isempty(dObj.ild{1}.Data) || isempty(dObj.pitch{1}.Data) || isempty(dObj.amsFeatures{1}.Data)
    pause(0.1);
    mObj.processChunk( );
end
show('columns', [size(dObj.ild{1}.Data, 2), size(dObj.pitch{1}.Data, 2)]);
show('class', class(dObj.pitch{1}));
mObj.deleteProcessor( 'ild', 1 );
show('left', numel(mObj.Processors.ild));
