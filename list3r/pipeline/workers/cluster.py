"""A Ray cluster that this process joins, or starts for itself."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from typing import Any

from list3r.memory.core.errors import MissingPackageError, OptionError, install_hint


class RayCluster:
    """Machines that run functions; which one runs what is Ray's choice, by the resources that are asked for."""

    def __init__(self, address: str | None = None) -> None:
        """Connect to the cluster at an `address`, else to the one of this machine's environment, else start one.

        Raises `OptionError` where it cannot be reached, `MissingPackageError` without Ray.
        """
        try:
            ray: Any = importlib.import_module("ray")
        except ModuleNotFoundError:
            raise MissingPackageError(
                f"--engine ray needs ray, which is not installed: {install_hint('ray')}"
            ) from None
        self._ray = ray
        self.errors: Any = ray.exceptions
        self._ours = not ray.is_initialized()
        if self._ours:
            wanted = address or os.environ.get("RAY_ADDRESS")
            try:
                ray.init(address=wanted, log_to_driver=False, include_dashboard=False, logging_level="error")
            except (ConnectionError, RuntimeError, ValueError) as error:
                said = str(error).splitlines()[0]
                raise OptionError(f"the Ray cluster at {wanted or 'this machine'} cannot be reached: {said}") from error

    def fits(self, cpus: int, gpus: float = 0.0) -> int:
        """Return how many tasks that take so much can run at once."""
        there = self._ray.cluster_resources()
        count = int(there.get("CPU", 0)) // cpus
        return min(count, int(there.get("GPU", 0) / gpus)) if gpus else count

    def has_gpu(self) -> bool:
        """Whether a machine has a GPU."""
        return bool(self._ray.cluster_resources().get("GPU", 0))

    def remote(self, work: Callable[..., Any], **resources: Any) -> Callable[..., Any]:
        """Return what hands a call of a function to the cluster and returns a reference to its result."""
        submit: Callable[..., Any] = self._ray.remote(**resources)(work).remote
        return submit

    def first(self, references: list[Any]) -> Any:
        """Wait until one of some calls has ended; return its reference."""
        (done, *_), _ = self._ray.wait(references, num_returns=1)
        return done

    def result(self, reference: Any) -> Any:
        """Wait for the result of a call; raises one of `errors`."""
        return self._ray.get(reference)

    def leave(self, references: list[Any]) -> None:
        """End calls at once, and the cluster where this process started or joined it."""
        for reference in references:
            self._ray.cancel(reference, force=True)
        if self._ours:
            self._ray.shutdown()
