"""Declarations on which all other packages are built: types, parameters, representations, named errors."""
