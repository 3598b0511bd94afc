"""Furnished rooms made from seeds, filmed by simulated cameras, with the truth of every pixel."""
