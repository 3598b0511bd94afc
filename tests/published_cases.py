"""Cases made by hand that were also run through the published code of VGGT-Long (6b9f61f) and Pi-Long (ae567d9)."""

from __future__ import annotations

import numpy as np

from list3r.memory.core.geometry import Sim3

SPANS = ((0, 60), (30, 90), (60, 120), (90, 150), (120, 180), (150, 210))
"""Chunks of 60 frames that share 30."""


def looks_of_a_walk() -> np.ndarray:
    """Unit descriptors (210, 40) of a walk that is twice at most of its places, a little off the second time."""
    t = np.arange(210)
    place = 3.0 + 2.5 * np.sin(2 * np.pi * t / 140.0) + 0.0004 * t
    centres = np.linspace(0.0, 6.0, 40)
    looks = np.exp(-0.5 * ((place[:, None] - centres) / 0.35) ** 2) + 0.05 * np.sin(np.outer(0.37 * t, np.arange(40)))
    return np.asarray(looks / np.linalg.norm(looks, axis=1, keepdims=True), np.float32)


def matched_points() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Twelve points, where they are found again (two are wrong), and their weights."""
    k = np.arange(12.0)
    p = np.stack([np.cos(k), np.sin(1.7 * k), 2.0 + 0.3 * np.cos(2.3 * k)], axis=1)
    q = Sim3.exp(np.array([0.4, -0.2, 0.1, 0.3, -0.5, 0.2, 0.15])).apply(p)
    q[3] += [0.5, 0.0, -0.2]
    q[8] += [0.0, -1.0, 0.3]
    return p, q, 0.2 + 0.06 * k


def ring_with_a_loop() -> tuple[list[Sim3], tuple[int, int, Sim3]]:
    """Seven steps S_(k)_(k+1) of a ring that drifts, and the loop (later, earlier, S_earlier_later) that closes it."""
    steps = [
        Sim3.exp(np.array([1.0, 0.02 * k, 0.03, 0.01, -0.02, 2 * np.pi / 7 + 0.01 * (-1) ** k, 0.02 * np.sin(k)]))
        for k in range(7)
    ]
    return steps, (7, 0, Sim3.exp(np.array([0.1, -0.05, 0.02, 0.0, 0.03, 0.02, -0.04])))
