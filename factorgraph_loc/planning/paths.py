"""Candidate paths: arcs and straight lines, shortest paths in free space, and the free length before walls."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csgraph

from factorgraph_loc.errors import InputError
from factorgraph_loc.maps.free_space import CELL, FreeSpace, chain, dense, straightened
from factors import se2
from factors.compiled import compiled
from factors.se2 import Array

STEP = 0.25  # m, between the poses of a path
DIRECTIONS = 12  # number of initial turns
CURVATURES = (-0.6, -0.25, 0.0, 0.25, 0.6)  # rad/m
SHORT = 0.5  # relative length of the short straight paths


@dataclass(frozen=True, eq=False)
class Path:
    """``poses`` (S, 3) in the frame of the start pose, the first of them, at intervals of about :data:`STEP`, and the end; a turn
    in place is an additional pose at the same position. ``kind``: how the path was proposed.
    """

    poses: Array
    kind: str

    @cached_property
    def metres(self) -> Array:
        """Distance (S,) [m] driven up to each pose."""
        steps = se2.log(se2.between(self.poses[:-1], self.poses[1:]))
        return np.concatenate((np.zeros(1), np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))

    @cached_property
    def turned(self) -> Array:
        """Absolute angle (S,) [rad] turned up to each pose."""
        return np.concatenate((np.zeros(1), np.cumsum(np.abs(se2.wrap(np.diff(self.poses[:, 2]))))))

    @property
    def length(self) -> float:
        """Length [m]."""
        return float(self.metres[-1])

    def passed(self, metres_per_radian: float) -> Array:
        """The metres (S,) that a robot could have driven in the time up to each pose; a turn by a radian takes the time of
        ``metres_per_radian``."""
        steps = np.maximum(np.diff(self.metres), np.diff(self.turned) * metres_per_radian)
        return np.concatenate((np.zeros(1), np.cumsum(steps)))

    def until(self, length: float) -> Path:
        """The path up to the last pose within ``length`` [m]."""
        return Path(self.poses[self.metres <= length + 1e-9], self.kind)


def look_around() -> Path:
    """A full turn in place."""
    count = 2 * DIRECTIONS
    poses = np.zeros((count + 1, 3))
    poses[:, 2] = se2.wrap(2.0 * math.pi * np.arange(count + 1) / count)
    return Path(poses, "turn")


def primitives(length: float) -> list[Path]:
    """Paths that begin with a turn in place, one set for each of :data:`DIRECTIONS` directions. A set has a straight path and two
    gentle arcs of ``length`` [m], and a straight path of half the length. Ahead there are also two sharper arcs. Raises
    InputError if the length is not positive."""
    if not (math.isfinite(length) and length > 0.0):
        raise InputError(f"horizon is {length:g} m, expected a length above 0")
    out = []
    for turn in (2.0 * math.pi * np.arange(DIRECTIONS) / DIRECTIONS).tolist():
        for curvature in CURVATURES:
            if turn == 0.0 or abs(curvature) <= CURVATURES[-2]:
                out.append(arc(turn, curvature, length))
        out.append(arc(turn, 0.0, SHORT * length))
    return out


def waypoint_paths(
    space: FreeSpace,
    pose: Array,
    targets: Array,
    *,
    nearest: int | None = None,
    beyond: float = 0.0,
    within: float = math.inf,
) -> list[Path]:
    """The shortest paths through free space from ``pose`` (3,) to ``targets`` (K, 2) [m] in the world (Dijkstra, 1959),
    straightened.

    The robot turns in place at the start and at corners. A pose too close to a wall starts from the nearest free cell; a target
    outside of free space, or at the robot, has no path. ``nearest``: use only this many of the nearest targets, among those from
    ``beyond`` to ``within`` [m] away on the grid.
    """
    start = _nearest_cell(space, pose[:2])
    ends = space.cells(np.asarray(targets, dtype=float).reshape(-1, 2))
    ends = ends[(ends >= 0) & (ends != start)]
    metres, links = csgraph.dijkstra(space.graph, directed=False, indices=start, limit=within, return_predecessors=True)
    ends = ends[(metres[ends] >= beyond) & np.isfinite(metres[ends])]
    out = []
    for end in ends[np.argsort(metres[ends], kind="stable")[:nearest]].tolist():
        points = space.centres[chain(links, end)[::-1]]
        if space.cells(pose[None, :2])[0] >= 0:
            points[0] = pose[:2]
        out.append(Path(_driven(pose, straightened(space, points)), "waypoint"))
    return out


def waypoints(space: FreeSpace, count: int) -> Array:
    """At most ``count`` places (K, 2) [m] spread over free space by farthest-point sampling (Gonzalez, Theoretical Computer
    Science 38, 1985), starting with the one farthest from walls.
    """
    i, j = np.nonzero(space.index >= 0)
    distance = np.empty(len(space.centres))
    distance[space.index[i, j]] = space.distance[i, j]
    chosen = [int(np.argmax(distance))]
    gaps = np.full(len(space.centres), np.inf)
    while len(chosen) < min(count, len(space.centres)):
        gaps = np.minimum(gaps, np.hypot(*(space.centres - space.centres[chosen[-1]]).T))
        chosen.append(int(np.argmax(gaps)))
    return np.asarray(space.centres[chosen])


def free_steps(space: FreeSpace, poses: Array, paths: Sequence[Path], between: int = 1) -> NDArray[np.int64]:
    """The last pose (C, M) of each of C paths that robots at ``poses`` (M, 3) in the world reach with the clearance to walls.

    A robot that is too close at the start may drive away from walls. ``between``: number of collision checks per step of a path.
    """
    first = np.cumsum([0, *(len(path.poses) for path in paths)])
    along = np.concatenate([path.poses for path in paths]) if paths else np.empty((0, 3))
    out = np.empty((len(paths), len(poses)), dtype=np.int64)
    poses = np.ascontiguousarray(poses, dtype=float)
    _free_steps(space.index, space.distance, space.origin, poses, along, first, between, out)
    return out


def arc(turn: float, curvature: float, length: float) -> Path:
    """A turn in place [rad] and an arc of ``length`` [m] with this curvature [rad/m]."""
    count = max(1, math.ceil(length / STEP - 1e-9))
    driven = np.minimum(STEP * np.arange(count + 1), length)
    poses = se2.exp(np.column_stack((driven, np.zeros(len(driven)), curvature * driven)))
    if turn == 0.0:
        return Path(poses, "arc")
    turned = se2.compose(np.array((0.0, 0.0, turn)), poses)
    return Path(np.concatenate((np.zeros((1, 3)), turned)), "arc")


def _driven(pose: Array, corners: Array) -> Array:
    """Poses (S, 3) in the frame of ``pose`` (3,) of a robot that drives through ``corners`` (N, 2) of the world."""
    parts = [np.zeros((1, 3))]
    start = pose[:2]
    if np.hypot(*(corners[0] - start)) < 1e-9:
        corners = corners[1:]
    for corner in corners:
        heading = math.atan2(corner[1] - start[1], corner[0] - start[0])
        points = np.concatenate((start[None], dense(np.stack((start, corner)), STEP)))
        world = np.column_stack((points, np.full(len(points), heading)))
        parts.append(se2.between(pose, world))
        start = corner
    return np.concatenate(parts)


def _nearest_cell(space: FreeSpace, point: Array) -> int:
    cell = int(space.cells(point[None])[0])
    return cell if cell >= 0 else int(np.argmin(np.hypot(*(space.centres - point).T)))


@compiled
def _free_steps(
    index: NDArray[np.int64],
    distance: Array,
    origin: Array,
    poses: Array,
    along: Array,
    first: NDArray[np.int64],
    between: int,
    out: NDArray[np.int64],
) -> None:
    nx, ny = index.shape
    for m in range(len(poses)):
        c, s = math.cos(poses[m, 2]), math.sin(poses[m, 2])
        for p in range(len(first) - 1):
            last, leaving, clearance = 0, True, -1.0
            for k in range(first[p], first[p + 1]):
                free, previous = True, max(k - 1, first[p])
                for part in range(1, between + 1):
                    share = 1.0 - part / between
                    ax = along[k, 0] + share * (along[previous, 0] - along[k, 0])
                    ay = along[k, 1] + share * (along[previous, 1] - along[k, 1])
                    x, y = poses[m, 0] + c * ax - s * ay, poses[m, 1] + s * ax + c * ay
                    i, j = math.floor((x - origin[0]) / CELL), math.floor((y - origin[1]) / CELL)
                    if i < 0 or j < 0 or i >= nx or j >= ny:
                        free = False
                        break
                    if index[i, j] >= 0:
                        leaving = False
                    elif not leaving or distance[i, j] < clearance:
                        free = False
                        break
                    clearance = distance[i, j]
                if not free:
                    break
                last = k - first[p]
            out[p, m] = last
