function stopAndKill(bass, rosAFE, client)
%STOPANDKILL  Stop and end both components, and delete their objects and the client.

rosAFE.Stop();
rosAFE.kill();
delete(rosAFE);
bass.Stop();
bass.kill();
delete(bass);
delete(client);
end
