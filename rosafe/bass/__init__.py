"""The capture node `bass`: sound from ALSA devices, files and a built-in scene onto the port Audio."""
