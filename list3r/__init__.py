"""Object memory for long videos."""

__version__ = "0.1.0"
