"""The demonstration: the nodes, the guide's requests, seven ports, a table and a picture, with one command."""
