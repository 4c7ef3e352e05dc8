"""Declarations that everything else is built from: types, parameters, representations, named errors."""
