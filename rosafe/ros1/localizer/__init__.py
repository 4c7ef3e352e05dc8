"""The localizer node: tracked directions of sources from the representations of a running rosAFE."""
