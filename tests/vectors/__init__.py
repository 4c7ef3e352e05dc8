"""Reference vectors of the project's own, and the script that made them."""
