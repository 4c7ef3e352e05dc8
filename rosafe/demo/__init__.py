"""The demonstration: starts the nodes, sends the requests of the user guide, records seven ports and plots them."""
