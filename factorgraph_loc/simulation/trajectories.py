"""Drives through free space: shortest paths on a grid between random places, and a robot that follows them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from factorgraph_loc.errors import InputError
from factorgraph_loc.simulation.settings import DriveSettings
from factorgraph_loc.trajectory import Trajectory
from factorgraph_loc.world import World
from factors import se2
from factors.se2 import Array

CELL = 0.2  # m
LOOKAHEAD = 0.3  # m: the robot aims at the point of the path that is so far away
STEP = 0.02  # s, of the robot's control
GAIN = 4.0  # rad/s of turn per rad of error
SPACING = 0.05  # m, between the points of a path


@dataclass(frozen=True)
class FreeSpace:
    """Cells of :data:`CELL` that are free and connected: ``centres`` (K, 2), the ``graph`` (K, K) of distances between neighbours,
    ``index`` (NX, NY): places among them, -1 elsewhere, and ``origin`` (2,) of the first cell's corner."""

    centres: Array
    graph: sparse.csr_matrix
    index: NDArray[np.int64]
    origin: Array

    def clear(self, a: Array, b: Array) -> bool:
        """Whether the straight line between two points runs over free cells alone."""
        n = max(2, math.ceil(math.hypot(*(b - a)) / SPACING))
        points = a + np.linspace(0.0, 1.0, n)[:, None] * (b - a)
        i, j = ((points - self.origin) / CELL).astype(np.int64).T
        return bool((self.index[i, j] >= 0).all())


def free_space(world: World, clearance: float) -> FreeSpace:
    """Where a robot may be that keeps ``clearance`` [m] to all walls of the world; the largest connected part."""
    walls = np.array(world.walls).reshape(-1, 2, 2)
    if not len(walls):
        raise InputError(f"world {world.name}: has no walls, expected some around the space to drive in")
    origin = walls.min(axis=(0, 1))
    shape = np.maximum(np.ceil((walls.max(axis=(0, 1)) - origin) / CELL).astype(int), 1)
    i, j = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    centres = origin + (np.stack((i, j), axis=-1) + 0.5) * CELL
    free = distance_to_walls(world, centres.reshape(-1, 2)).reshape(i.shape) > clearance
    labels, count = ndimage.label(free)
    if not count:
        raise InputError(f"world {world.name}: has no place that is {clearance:g} m from all walls")
    largest = 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    inside = labels == largest
    index = np.full(i.shape, -1, dtype=np.int64)
    index[inside] = np.arange(int(inside.sum()))
    return FreeSpace(centres[inside], _graph(index), index, origin)


def distance_to_walls(world: World, points: Array) -> Array:
    """Distance [m] (N,) from points (N, 2) to the nearest wall."""
    out = np.full(len(points), np.inf)
    for x1, y1, x2, y2 in world.walls:
        start, along = np.array((x1, y1)), np.array((x2 - x1, y2 - y1))
        share = np.clip((points - start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        out = np.minimum(out, np.hypot(*(points - start - share[:, None] * along).T))
    return out


def drive(world: World, settings: DriveSettings, rng: np.random.Generator) -> Trajectory:
    """Poses at ``settings.rate`` from t = 0 to the duration, of a robot that drives from one random place to the next."""
    space = free_space(world, settings.clearance)
    here = int(rng.integers(len(space.centres)))
    length, parts = 0.0, [space.centres[here][None]]
    while length < settings.duration * settings.speed:
        there = int(rng.integers(len(space.centres)))
        if there == here:
            if len(space.centres) == 1:
                raise InputError(f"world {world.name}: has no room to drive in, expected a larger one")
            continue
        leg = _dense(_path(space, here, there))
        length += SPACING * len(leg)
        parts.append(leg)
        here = there
    path = np.concatenate(parts)
    heading = rng.uniform(-math.pi, math.pi)
    return _follow(path, heading, settings)


def _graph(index: NDArray[np.int64]) -> sparse.csr_matrix:
    """Edges to the eight neighbours; to the diagonal ones only where both cells beside them are free."""
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


def _path(space: FreeSpace, start: int, end: int) -> Array:
    """Corners (N, 2) of a short path between two cells: a shortest one on the grid, straightened where the way is clear."""
    _, before = csgraph.dijkstra(space.graph, directed=False, indices=end, return_predecessors=True)
    cells = [start]
    while cells[-1] != end:
        cells.append(int(before[cells[-1]]))
    points = space.centres[cells]
    corners, i = [0], 0
    while i < len(points) - 1:
        # the farthest point in sight, by bisection: nearer ones are in sight where farther ones are, nearly always
        low, high = i + 1, len(points) - 1
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if space.clear(points[i], points[middle]) else (low, middle - 1)
        corners.append(low)
        i = low
    return np.asarray(points[corners])


def _dense(corners: Array) -> Array:
    """Points :data:`SPACING` apart on the way through ``corners``, the first left out."""
    along = np.concatenate((np.zeros(1), np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    s = np.linspace(0.0, along[-1], max(2, round(along[-1] / SPACING) + 1))[1:]
    return np.column_stack((np.interp(s, along, corners[:, 0]), np.interp(s, along, corners[:, 1])))


def _follow(path: Array, heading: float, settings: DriveSettings) -> Trajectory:
    """A robot that turns towards a point of the path ahead, and slows down while it looks elsewhere (pure pursuit)."""
    every = max(1, round(1.0 / (settings.rate * STEP)))
    step = 1.0 / (settings.rate * every)
    count = int(settings.duration * settings.rate + 1e-9)
    points = path.tolist()
    (x, y), aim, last = points[0], 0, len(points) - 1
    poses = [(x, y, heading)]
    for _ in range(count):
        for _ in range(every):
            while aim < last and math.hypot(points[aim][0] - x, points[aim][1] - y) < LOOKAHEAD:
                aim += 1
            error = se2.wrap_scalar(math.atan2(points[aim][1] - y, points[aim][0] - x) - heading)
            turn = step * min(max(GAIN * error, -settings.turn_rate), settings.turn_rate)
            advance = step * settings.speed * max(0.0, math.cos(error)) ** 2
            p, q = se2.arc_coefficients(turn)
            c, s = math.cos(heading), math.sin(heading)
            x, y = x + advance * (c * p - s * q), y + advance * (s * p + c * q)
            heading = se2.wrap_scalar(heading + turn)
        poses.append((x, y, heading))
    return Trajectory(np.arange(count + 1) / settings.rate, np.array(poses))
