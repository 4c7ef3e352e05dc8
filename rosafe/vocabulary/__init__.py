"""The words that everything else is declared in: types, parameters, representations, named errors."""
