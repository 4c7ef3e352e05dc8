"""Results: files that are written and read, and the mapping with their parameters."""
