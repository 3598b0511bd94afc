"""The command line."""

from list3r.cli.app import main

__all__ = ["main"]
