"""Sparse Cholesky factors of block matrices: solutions, and the blocks of the inverse on the pattern.

Multifrontal (Duff and Reid, "The multifrontal solution of indefinite sparse symmetric linear equations", 1983) on the
graph of blocks, so that all arithmetic is dense BLAS on fronts of some hundred rows. The inverse follows Takahashi,
"Formation of sparse bus impedance matrix", 1973, front by front from the root: no more work than the factor itself,
where the whole inverse of a thousand chunks would be seven thousand solutions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

_SMALL_FRONT = 7
"""Fronts of up to this many blocks are merged with their parent however many zeros that adds: a call costs more than
the sums. Merging larger ones takes memory and gains no time."""
_ZEROS = 0.2
"""Share of zeros that joining two larger fronts may add."""


class NotPositiveError(ArithmeticError):
    """A matrix that is not positive definite."""


@dataclass(frozen=True)
class Front:
    """One dense elimination step."""

    pivots: Rows
    """Blocks that are eliminated here, in order of elimination. Shape (P,)."""
    below: Rows
    """Later blocks that share an entry with the pivots. Shape (B,)."""
    parent: int
    """Number of the front that receives the Schur complement, -1 for a root."""
    into: Rows
    """Scalar rows of `below` within the parent's front. Shape (B * D,)."""
    entries: Rows
    """Numbers of the matrix's off-diagonal blocks that enter here. Shape (N,)."""
    at: tuple[Rows, Rows]
    """Block row and column of these entries within this front, row > column."""
    repeated: bool
    """True where two entries have the same row and column."""


@dataclass(frozen=True)
class BlockPattern:
    """The nonzero blocks of a symmetric matrix of n x n blocks, and its elimination order."""

    count: int
    size: int
    """Rows of a block, D."""
    fronts: tuple[Front, ...]
    flipped: NDArray[np.bool_]
    """True where an off-diagonal block is used transposed. Shape (N,)."""

    @staticmethod
    def analyse(count: int, rows: Rows, columns: Rows, size: int) -> BlockPattern:
        """Order n blocks, with off-diagonal blocks at (rows, columns), by minimum degree."""
        place, structure = _structure(count, rows, columns)
        return _pattern(count, size, place, structure, rows, columns)


def _structure(count: int, rows: Rows, columns: Rows) -> tuple[Rows, list[Rows]]:
    """Return each block's position in the elimination, and by position the later nonzero rows after fill-in."""
    ones = np.full(len(rows), -1.0)
    degree = np.bincount(rows, minlength=count) + np.bincount(columns, minlength=count) + 1.0
    i = np.concatenate([rows, columns, np.arange(count)])
    j = np.concatenate([columns, rows, np.arange(count)])
    matrix = coo_matrix((np.concatenate([ones, ones, degree]), (i, j)), shape=(count, count)).tocsc()
    factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    lower = factor.L.tocsc()
    lower.sort_indices()
    starts, indices = lower.indptr, lower.indices.astype(np.int64)
    structure = [indices[starts[k] + 1 : starts[k + 1]] for k in range(count)]
    after = _postorder(structure)
    before = np.argsort(after)
    return after[factor.perm_c], [after[structure[k]] for k in before.tolist()]


def _postorder(structure: list[Rows]) -> Rows:
    """Return the postorder of the elimination tree: no additional fill-in, and blocks of similar structure are
    adjacent. Shape (n,)."""
    count = len(structure)
    children: list[list[int]] = [[] for _ in range(count + 1)]
    for k in sorted(range(count), key=lambda k: len(structure[k]), reverse=True):
        children[int(structure[k][0]) if len(structure[k]) else count].append(k)
    waiting, order = list(children[count]), []
    while waiting:
        k = waiting.pop()
        order.append(k)
        waiting.extend(reversed(children[k]))
    out = np.empty(count, np.int64)
    out[order[::-1]] = np.arange(count)
    return out


def _groups(structure: list[Rows]) -> list[tuple[int, int]]:
    """Return runs of positions that are eliminated together: [start, end) with almost the same structure."""
    groups: list[tuple[int, int, int]] = []
    for k, own in enumerate(structure):
        start, filled = k, 1 + len(own)
        while groups:
            first, end, before = groups[-1]
            below = structure[end - 1]
            if len(below) == 0 or below[0] > k:
                break
            pivots = k + 1 - first
            cells = pivots * (pivots + 1) // 2 + pivots * len(own)
            if pivots + len(own) > _SMALL_FRONT and cells - before - filled > _ZEROS * cells:
                break
            start, filled = first, before + filled
            groups.pop()
        groups.append((start, k + 1, filled))
    return [(first, end) for first, end, _ in groups]


def _pattern(count: int, size: int, place: Rows, structure: list[Rows], rows: Rows, columns: Rows) -> BlockPattern:
    groups = _groups(structure)
    block_at = np.argsort(place)
    front_at = np.repeat(np.arange(len(groups)), [b - a for a, b in groups])
    later, sooner = np.maximum(place[rows], place[columns]), np.minimum(place[rows], place[columns])
    order = np.argsort(front_at[sooner], kind="stable")
    bounds = np.searchsorted(front_at[sooner][order], np.arange(len(groups) + 1))
    # A front's structure is that of all its positions: merged fronts include their children's rows.
    below = [_below(structure, a, b) for a, b in groups]
    held = [np.concatenate([np.arange(a, b), rest]) for (a, b), rest in zip(groups, below, strict=True)]
    fronts = []
    for k, (a, b) in enumerate(groups):
        parent = int(front_at[below[k][0]]) if len(below[k]) else -1
        into = np.searchsorted(held[parent], below[k]) if parent >= 0 else np.zeros(0, np.int64)
        entries = order[bounds[k] : bounds[k + 1]]
        at = (np.searchsorted(held[k], later[entries]), np.searchsorted(held[k], sooner[entries]))
        scalar = (into[:, None] * size + np.arange(size)).ravel()
        repeated = len(np.unique(at[0] * count + at[1])) < len(entries)
        fronts.append(Front(block_at[a:b], block_at[below[k]], parent, scalar, entries, at, repeated))
    return BlockPattern(count, size, tuple(fronts), place[rows] < place[columns])


def _below(structure: list[Rows], first: int, end: int) -> Rows:
    rest = np.unique(np.concatenate(structure[first:end])) if end > first else np.zeros(0, np.int64)
    return rest[rest >= end]


@dataclass
class BlockFactor:
    """The factor L of a matrix on a pattern, H = L L^T."""

    pattern: BlockPattern
    upper: list[Array]
    """L of the pivots of each front. Shape (P * D, P * D)."""
    lower: list[Array]
    """L of the rows below. Shape (B * D, P * D)."""

    @staticmethod
    def of(pattern: BlockPattern, diagonal: Array, off: Array) -> BlockFactor:
        """Factorise; `diagonal` (n, D, D) and `off` (N, D, D) at the pattern's rows and columns.

        Raises `NotPositiveError` for a matrix that is not positive definite.
        """
        d = pattern.size
        oriented = np.where(pattern.flipped[:, None, None], np.swapaxes(off, 1, 2), off)
        waiting: list[list[tuple[Rows, Array]]] = [[] for _ in pattern.fronts]
        uppers, lowers = [], []
        for k, front in enumerate(pattern.fronts):
            p, n = len(front.pivots), len(front.pivots) + len(front.below)
            matrix = np.zeros((n, d, n, d))
            matrix[np.arange(p), :, np.arange(p), :] = diagonal[front.pivots]
            blocks = matrix.transpose(0, 2, 1, 3)
            if front.repeated:
                np.add.at(blocks, front.at, oriented[front.entries])
            else:
                blocks[front.at] = oriented[front.entries]
            flat = matrix.reshape(n * d, n * d)
            for into, left in waiting[k]:
                flat[into[:, None], into] += left
            waiting[k] = []
            upper, info = dpotrf(flat[: p * d, : p * d], lower=1, clean=1)
            if info != 0:
                raise NotPositiveError("the normal equations of the graph are not positive definite")
            lower = np.asarray(dtrsm(1.0, upper, flat[p * d :, : p * d], side=1, lower=1, trans_a=1))
            if front.parent >= 0:
                waiting[front.parent].append((front.into, flat[p * d :, p * d :] - lower @ lower.T))
            uppers.append(upper)
            lowers.append(lower)
        return BlockFactor(pattern, uppers, lowers)

    def solve(self, right: Array) -> Array:
        """Return H^-1 applied to right-hand sides by block. Shape (n, D) -> (n, D)."""
        x = right.copy()
        d = self.pattern.size
        for front, upper, lower in zip(self.pattern.fronts, self.upper, self.lower, strict=True):
            y = dtrsm(1.0, upper, x[front.pivots].reshape(-1, 1), lower=1)
            x[front.pivots] = y.reshape(-1, d)
            if len(front.below):
                x[front.below] -= (lower @ y).reshape(-1, d)
        for front, upper, lower in zip(
            reversed(self.pattern.fronts), reversed(self.upper), reversed(self.lower), strict=True
        ):
            y = x[front.pivots].reshape(-1, 1)
            if len(front.below):
                y = y - lower.T @ x[front.below].reshape(-1, 1)
            x[front.pivots] = dtrsm(1.0, upper, y, lower=1, trans_a=1).reshape(-1, d)
        return x

    def inverse_blocks(self) -> tuple[Array, Array]:
        """Return blocks of H^-1 on the diagonal (n, D, D) and at the pattern's rows and columns (N, D, D)."""
        d, pattern = self.pattern.size, self.pattern
        diagonal = np.empty((pattern.count, d, d))
        off = np.empty((len(pattern.flipped), d, d))
        fronts: list[Array | None] = [None] * len(pattern.fronts)
        pending = np.bincount([f.parent for f in pattern.fronts if f.parent >= 0], minlength=len(fronts))
        for k in reversed(range(len(fronts))):
            front, p = pattern.fronts[k], len(pattern.fronts[k].pivots) * d
            whole = np.empty((p + len(front.into), p + len(front.into)))
            flipped = dtrsm(1.0, self.upper[k], np.eye(p), lower=1)
            whole[:p, :p] = flipped.T @ flipped
            if front.parent >= 0:
                above = fronts[front.parent]
                assert above is not None
                whole[p:, p:] = above[front.into[:, None], front.into]
                gain = self.lower[k] @ flipped
                whole[p:, :p] = -whole[p:, p:] @ gain
                whole[:p, p:] = whole[p:, :p].T
                whole[:p, :p] -= gain.T @ whole[p:, :p]
                pending[front.parent] -= 1
                if pending[front.parent] == 0:
                    fronts[front.parent] = None
            blocks = whole.reshape(-1, d, len(whole) // d, d)
            here = np.arange(p // d)
            diagonal[front.pivots] = blocks[here, :, here, :]
            off[front.entries] = blocks[front.at[0], :, front.at[1], :]
            fronts[k] = whole if pending[k] else None
        turned = np.where(pattern.flipped[:, None, None], np.swapaxes(off, 1, 2), off)
        return diagonal, turned
