"""Stands in for a package that is not installed: the same names, inputs and outputs, a tiny network."""
