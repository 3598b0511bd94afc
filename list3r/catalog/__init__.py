"""One catalogue of many memories: a list of files and an index of their content, rebuilt from the files."""

from list3r.catalog.catalog import Catalog

__all__ = ["Catalog"]
