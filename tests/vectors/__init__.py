"""Reference vectors of this project, and the script that generates them."""
