"""Engines by name; each is imported when it is asked for."""

from __future__ import annotations

from collections.abc import Callable

from list3r.batch.engines.base import Engine, TaskResources
from list3r.memory.core.errors import OptionError, check_choice


def make_engine(name: str, resources: TaskResources, jobs: int | None, address: str | None) -> Engine:
    """Return the engine of a name. Raises `OptionError` for one that is not known."""
    known: dict[str, Callable[[], Engine]] = {
        "local": lambda: _local(resources, jobs),
        "ray": lambda: _ray(resources, jobs, address),
    }
    check_choice("--engine", name, known)
    if address is not None and name != "ray":
        raise OptionError(f"--address {address} needs --engine ray")
    if jobs is not None and jobs < 1:
        raise OptionError(f"--jobs {jobs}: give 1 or more")
    return known[name]()


def _local(resources: TaskResources, jobs: int | None) -> Engine:
    from list3r.batch.engines.local import LocalEngine

    return LocalEngine(resources, jobs)


def _ray(resources: TaskResources, jobs: int | None, address: str | None) -> Engine:
    from list3r.batch.engines.ray import RayEngine

    return RayEngine(resources, jobs, address)
