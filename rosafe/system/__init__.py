"""Files, terminals and messages about missing packages."""
