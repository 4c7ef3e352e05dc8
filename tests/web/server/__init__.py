"""The parts shared by genomixd and the live page: checks of headers, limits of connections."""
