"""What genomixd and the live page share: checks of headers, limits of connections."""
