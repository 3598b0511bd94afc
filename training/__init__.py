"""How the weights that are shipped were made; not part of the wheel."""
