"""A catalogue over HTTP: stateless, bounded, for many processes side by side."""
