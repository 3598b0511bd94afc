"""One catalogue of many memories: which files there are, and an index of what is in them, rebuilt from the files."""

from list3r.catalog.catalog import Catalog

__all__ = ["Catalog"]
