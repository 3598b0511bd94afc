"""Findings of the attack on version 0.1, each a small script that runs against any checkout of the program."""
