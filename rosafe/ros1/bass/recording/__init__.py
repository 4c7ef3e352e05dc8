"""Recording: sound from any source into WAV files and bags, with its levels."""
