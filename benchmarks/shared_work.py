"""Cache of work that several variants of association share on one video.

Variants measure the same edges, ask for the same joint windows and test the same relations wherever their settings and
earlier results agree. These are pure functions, so results can be shared; `tests/test_benchmark_shared_work.py`
compares both. Memory files, which live for one variant, are not compressed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields, is_dataclass
from typing import Any
from unittest.mock import patch

import numpy as np

from list3r.memory.core.errors import List3rError

_PLACES = (
    ("list3r.pipeline.mapping", "measure_edge"),
    ("list3r.association.revisits.joint_window", "measure_edge"),
    ("list3r.association.revisits.joint_window", "align"),
    ("list3r.association.revisits.joint_window", "shared_view"),
    ("list3r.association.revisits.joint_window", "cross_check"),
    ("list3r.association.revisits.search", "compare_instances"),
)
"""Functions by the modules that call them."""


class SharedWork:
    """Results by their arguments, for one video."""

    def __init__(self) -> None:
        self._known: dict[bytes, Any] = {}
        self._raised: dict[bytes, Exception] = {}

    def joint(self, model: Callable[..., Any]) -> Callable[..., Any]:
        """Return the model's joint windows, each made once."""
        windows: dict[Any, Any] = {}

        def ask(u_session: int, u_frames: Sequence[int], v_session: int, v_frames: Sequence[int]) -> Any:
            key = (u_session, tuple(u_frames), v_session, tuple(v_frames))
            if key not in windows:
                windows[key] = model(u_session, u_frames, v_session, v_frames)
            return windows[key]

        return ask

    @contextmanager
    def used(self) -> Iterator[None]:
        """Let the stages of association use the cache."""
        from importlib import import_module

        with ExitStack() as stack:
            for module, name in _PLACES:
                original = getattr(import_module(module), name)
                stack.enter_context(patch(f"{module}.{name}", self._once(f"{original.__module__}.{name}", original)))
            stack.enter_context(patch("list3r.memory.store.rows.codec._LEVEL", 0))
            yield

    def _once(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            key = digest((name, args, sorted(kwargs.items())))
            if key in self._raised:
                raise self._raised[key]
            if key not in self._known:
                try:
                    self._known[key] = function(*args, **kwargs)
                except List3rError as error:
                    self._raised[key] = error
                    raise
            return self._known[key]

        return call


def digest(value: Any) -> bytes:
    """Return a fingerprint of arguments: arrays by their bytes, records by their fields."""
    h = hashlib.blake2b(digest_size=16)
    _feed(h, value)
    return h.digest()


def _feed(h: Any, value: Any) -> None:
    h.update(type(value).__name__.encode())
    if isinstance(value, np.ndarray):
        h.update(str((value.dtype, value.shape)).encode())
        h.update(np.ascontiguousarray(value).view(np.uint8).data if value.size else b"")
    elif is_dataclass(value) and not isinstance(value, type):
        for f in fields(value):
            _feed(h, getattr(value, f.name))
    elif isinstance(value, (tuple, list)):
        h.update(str(len(value)).encode())
        for one in value:
            _feed(h, one)
    elif isinstance(value, (frozenset, set)):
        _feed(h, sorted(value))
    elif isinstance(value, dict):
        _feed(h, list(value.items()))
    else:
        h.update(repr(value).encode())
