"""Lines of sight between walls, and the free space of a map: free cells of a grid, distances to walls, and shortest paths."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from factorgraph_loc.errors import InputError
from factors.compiled import compiled
from factors.se2 import Array

CELL = 0.2  # m: side of a cell of the grid
SPACING = 0.05  # m between points of a path


class Walled(Protocol):
    """An object with walls, such as a map. ``walls``: a segment (x1, y1, x2, y2) [m] for each wall. ``name``: the name
    of the object in error messages."""

    @property
    def name(self) -> str: ...

    @property
    def walls(self) -> Sequence[tuple[float, float, float, float]]: ...


def crosses(world: Walled, a: Array, b: Array) -> NDArray[np.bool_]:
    """Return a mask (N,) that is True where the segment from ``a`` (N, 2) to ``b`` (N, 2) crosses a wall."""
    return np.asarray(_crosses(_segments(world), np.ascontiguousarray(a), np.ascontiguousarray(b)))


def _segments(world: Walled) -> Array:
    return np.array(world.walls, dtype=float).reshape(-1, 4)


@dataclass(frozen=True)
class FreeSpace:
    """The free space of a map: the largest connected set of K free cells in a grid (NX, NY) of cells of size
    :data:`CELL`.

    ``centres`` (K, 2): centres of the free cells [m]. ``graph`` (K, K): sparse matrix of the distances [m] between
    neighbouring free cells. ``index`` (NX, NY): the row of each free cell in ``centres``, -1 for other cells.
    ``origin`` (2,): smallest x and y of the grid [m]. ``distance`` (NX, NY): distance from the centre of each cell to
    the nearest wall [m]. ``clearance``: minimum distance of free cells from walls [m].
    """

    centres: Array
    graph: sparse.csr_matrix
    index: NDArray[np.int64]
    origin: Array
    distance: Array
    clearance: float

    @property
    def area(self) -> float:
        """The area [m^2] of the free cells."""
        return len(self.centres) * CELL**2

    def drawn(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` random poses (count, 3), uniformly distributed over the free cells and all headings."""
        cells = np.floor((np.arange(count) + rng.random()) * len(self.centres) / count)
        places = self.centres[cells.astype(np.int64)] + CELL * (rng.random((count, 2)) - 0.5)
        # a low-discrepancy sequence (golden ratio), so that neighbouring cells get different headings
        shares = (np.arange(count) * 0.5 * (math.sqrt(5.0) - 1.0)) % 1.0
        return np.column_stack((places, math.pi * (2.0 * shares - 1.0)))

    def cells(self, points: Array) -> NDArray[np.int64]:
        """Return the indices (N,) of the free cells that contain the ``points`` (N, 2), -1 for points outside."""
        places = np.floor((points - self.origin) / CELL).astype(np.int64)
        inside = np.all((places >= 0) & (places < self.index.shape), axis=-1)
        i, j = np.where(inside[:, None], places, 0).T
        return np.where(inside, self.index[i, j], -1)

    def is_clear(self, a: Array, b: Array) -> bool:
        """Return True if the straight line between two points ``a`` (2,) and ``b`` (2,) crosses only free cells."""
        return bool(_is_clear(self.index, self.origin, np.asarray(a, dtype=float), np.asarray(b, dtype=float)))


def free_space(world: Walled, clearance: float) -> FreeSpace:
    """Return the largest connected set of grid cells whose centres are more than ``clearance`` [m] from all walls of
    ``world``.

    Raises InputError if the map has no walls, or if no cell is that far from all walls.
    """
    walls = np.array(world.walls).reshape(-1, 2, 2)
    if not len(walls):
        raise InputError(f"world {world.name}: has no walls, expected walls around the free space")
    origin = walls.min(axis=(0, 1))
    shape = np.maximum(np.ceil((walls.max(axis=(0, 1)) - origin) / CELL).astype(int), 1)
    i, j = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    centres = origin + (np.stack((i, j), axis=-1) + 0.5) * CELL
    distance = distance_to_walls(world, centres.reshape(-1, 2)).reshape(i.shape)
    free = distance > clearance
    labels, count = ndimage.label(free)
    if not count:
        raise InputError(f"world {world.name}: has no place that is {clearance:g} m from all walls")
    largest = 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    inside = labels == largest
    index = np.full(i.shape, -1, dtype=np.int64)
    index[inside] = np.arange(int(inside.sum()))
    return FreeSpace(centres[inside], _graph(index), index, origin, distance, clearance)


def distance_to_walls(world: Walled, points: Array) -> Array:
    """Return the distances (N,) [m] from ``points`` (N, 2) to the nearest wall."""
    return nearest_walls(world, points)[0]


def nearest_walls(world: Walled, points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the distances (N,) [m] from ``points`` (N, 2) to the nearest wall, and the indices (N,) of these walls.
    Without walls the distances are infinite and the indices are -1."""
    distances, indices = _nearest(_segments(world), np.ascontiguousarray(points))
    return np.asarray(distances), np.asarray(indices)


def shortest_path(space: FreeSpace, start: int, end: int) -> Array:
    """Return the corners (N, 2) [m] of a short path between two free cells. ``start``, ``end``: indices of the cells.

    The path is the shortest one from neighbouring cell to neighbouring cell, then :func:`straightened`.
    """
    _, predecessors = csgraph.dijkstra(space.graph, directed=False, indices=end, return_predecessors=True)
    return straightened(space, space.centres[chain(predecessors, start)])


def chain(predecessors: NDArray[np.int32], start: int) -> list[int]:
    """Return the indices of the cells on the path from ``start`` to the root of a tree of shortest paths, both
    included.

    ``predecessors`` (K,): for each of K cells the index of the next cell towards the root. It is negative at the root.
    """
    cells = [start]
    while predecessors[cells[-1]] >= 0:
        cells.append(int(predecessors[cells[-1]]))
    return cells


def straightened(space: FreeSpace, points: Array) -> Array:
    """Return the path ``points`` (N, 2) without the points that straight lines through free cells can bypass."""
    corners, i = [0], 0
    while i < len(points) - 1:
        # bisection may miss the farthest point in line of sight, but rarely: nearer points are mostly in sight, too
        low, high = i + 1, len(points) - 1
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if space.is_clear(points[i], points[middle]) else (low, middle - 1)
        corners.append(low)
        i = low
    return np.asarray(points[corners])


def dense(corners: Array, spacing: float = SPACING) -> Array:
    """Return points (M, 2) about every ``spacing`` [m] along the path ``corners`` (N, 2), without the first corner."""
    along = np.concatenate((np.zeros(1), np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    s = np.linspace(0.0, along[-1], max(2, round(along[-1] / spacing) + 1))[1:]
    return np.column_stack((np.interp(s, along, corners[:, 0]), np.interp(s, along, corners[:, 1])))


def _graph(index: NDArray[np.int64]) -> sparse.csr_matrix:
    """Return the distances (K, K) [m] between neighbouring cells of K free cells, as a sparse matrix. ``index``
    (NX, NY): the index of each free cell, -1 for other cells of the grid.

    A cell has up to eight neighbours. A diagonal neighbour is included only if both cells next to the diagonal are
    free.
    """
    rows, columns, weights = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        nx, ny = index.shape
        a = index[: nx - dx, max(0, -dy) : ny - max(0, dy)]
        b = index[dx:, max(0, dy) : ny - max(0, -dy)]
        keep = (a >= 0) & (b >= 0)
        if dx and dy:
            beside = index[dx:, max(0, -dy) : ny - max(0, dy)], index[: nx - dx, max(0, dy) : ny - max(0, -dy)]
            keep &= (beside[0] >= 0) & (beside[1] >= 0)
        rows.append(a[keep])
        columns.append(b[keep])
        weights.append(np.full(int(keep.sum()), CELL * math.hypot(dx, dy)))
    count = int(index.max()) + 1
    entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_matrix(entries, shape=(count, count))


@compiled
def _is_clear(index: NDArray[np.int64], origin: Array, a: Array, b: Array) -> bool:
    dx, dy = b[0] - a[0], b[1] - a[1]
    count = max(2, math.ceil(math.hypot(dx, dy) / SPACING))
    step = 1.0 / (count - 1)
    for k in range(count):
        share = k * step if k < count - 1 else 1.0
        i = math.floor((a[0] + share * dx - origin[0]) / CELL)
        j = math.floor((a[1] + share * dy - origin[1]) / CELL)
        if i < 0 or j < 0 or i >= index.shape[0] or j >= index.shape[1] or index[i, j] < 0:
            return False
    return True


@compiled
def _nearest(walls: Array, points: Array) -> tuple[Array, NDArray[np.int64]]:
    squares, indices = np.full(len(points), np.inf), np.full(len(points), -1)
    for n in range(len(points)):
        for w in range(len(walls)):
            x, y = walls[w, 2] - walls[w, 0], walls[w, 3] - walls[w, 1]
            px, py = points[n, 0] - walls[w, 0], points[n, 1] - walls[w, 1]
            share = min(max((px * x + py * y) / max(x * x + y * y, 1e-12), 0.0), 1.0)
            square = (px - share * x) ** 2 + (py - share * y) ** 2
            if square < squares[n]:
                squares[n], indices[n] = square, w
    return np.sqrt(squares), indices


@compiled
def _crosses(walls: Array, a: Array, b: Array) -> NDArray[np.bool_]:
    out = np.zeros(len(a), dtype=np.bool_)
    for n in range(len(a)):
        dx, dy = b[n, 0] - a[n, 0], b[n, 1] - a[n, 1]
        for w in range(len(walls)):
            x, y = walls[w, 2] - walls[w, 0], walls[w, 3] - walls[w, 1]
            ax, ay = a[n, 0] - walls[w, 0], a[n, 1] - walls[w, 1]
            bx, by = b[n, 0] - walls[w, 0], b[n, 1] - walls[w, 1]
            if (x * ay - y * ax) * (x * by - y * bx) < 0.0:
                at_start, at_end = dy * ax - dx * ay, dx * (y - ay) - dy * (x - ax)
                if at_start * at_end <= 0.0:
                    out[n] = True
                    break
    return out
