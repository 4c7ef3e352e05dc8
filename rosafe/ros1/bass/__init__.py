"""The capture node `bass`: publishes sound from ALSA devices, files and a built-in scene on the port Audio."""
