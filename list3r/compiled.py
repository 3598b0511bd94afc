"""Loops over pixels and points that NumPy would take many passes for, compiled by numba on their first call.

Machine code is kept beside the module, or in the user's cache where that cannot be written, so that later processes
load it. Nothing is reordered (no `fastmath`, one thread), so that results do not depend on how many processes work.
Division by zero gives infinity or NaN, as in NumPy: a check at each pixel would keep loops from taking several at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function as machine code. Its arguments are numbers and C-contiguous arrays."""
    try:
        return cast(Callable[P, R], numba.njit(cache=True, error_model="numpy")(function))
    except RuntimeError:  # nothing can be written: it is compiled in every process
        return cast(Callable[P, R], numba.njit(error_model="numpy")(function))
