"""Candidate paths of a robot: arcs, straight lines, and shortest paths in free space. Checks which part of a path is
free."""

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

STEP = 0.25  # m between the poses of a path
DIRECTIONS = 12  # number of directions of proposed paths
CURVATURES = (-0.6, -0.25, 0.0, 0.25, 0.6)  # rad/m of proposed arcs
SHORT = 0.5  # relative length of the short straight paths


@dataclass(frozen=True, eq=False)
class Path:
    """A path of a robot.

    ``poses`` (S, 3): in the frame of the start pose, at intervals of about :data:`STEP`. The first is the start pose,
    the last is the end. A turn in place is an additional pose at the same position. ``kind``: how the path was
    proposed: "arc" (also a straight path), "turn", "waypoint" (through free space to a distant place) or "patrol".
    """

    poses: Array
    kind: str

    @cached_property
    def metres(self) -> Array:
        """The distance (S,) [m] driven up to each pose."""
        steps = se2.log(se2.between(self.poses[:-1], self.poses[1:]))
        return np.concatenate((np.zeros(1), np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))

    @cached_property
    def turned(self) -> Array:
        """The sum of absolute turns (S,) [rad] up to each pose."""
        return np.concatenate((np.zeros(1), np.cumsum(np.abs(se2.wrap(np.diff(self.poses[:, 2]))))))

    @property
    def length(self) -> float:
        """The length [m] of the path."""
        return float(self.metres[-1])

    def passed(self, metres_per_radian: float) -> Array:
        """Return the distance (S,) [m] up to each pose. A turn counts as the distance driven in the same time.

        ``metres_per_radian`` [m]: the distance that the robot drives in the time of a turn by one radian.
        """
        steps = np.maximum(np.diff(self.metres), np.diff(self.turned) * metres_per_radian)
        return np.concatenate((np.zeros(1), np.cumsum(steps)))

    def until(self, length: float) -> Path:
        """Return the part of the path up to the last pose within ``length`` [m] of driving."""
        return Path(self.poses[self.metres <= length + 1e-9], self.kind)


def full_turn() -> Path:
    """Return the path of a full turn in place."""
    count = 2 * DIRECTIONS
    poses = np.zeros((count + 1, 3))
    poses[:, 2] = se2.wrap(2.0 * math.pi * np.arange(count + 1) / count)
    return Path(poses, "turn")


def primitives(length: float) -> list[Path]:
    """Return arcs and straight paths in :data:`DIRECTIONS` directions.

    Each path begins with a turn in place to its direction, except those straight ahead. Each direction has two gentle
    arcs and a straight path of ``length`` [m], and a straight path of half the length. Straight ahead there are also
    two sharper arcs. Raises InputError if ``length`` is not positive.
    """
    if not (math.isfinite(length) and length > 0.0):
        raise InputError(f"policy.horizon is {length:g} m, expected a length above 0 m")
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
    """Return the shortest paths through free space to targets (Dijkstra, 1959). The paths are straightened.

    ``pose`` (3,), ``targets`` (K, 2) [m]: start and targets in the world frame. The robot turns in place at the start
    and at corners. A start that is too close to a wall is replaced by the nearest free cell. Targets outside of free
    space, or in the same grid cell as the robot, are left out. ``nearest``: the largest number of paths, to the nearest
    targets; None means all. ``beyond``, ``within`` [m]: only targets at distances between these values are used.
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
    """Return at most ``count`` positions (K, 2) [m] that are distributed over free space.

    The first is farthest from walls. Each further position is farthest from the previous ones (farthest-point sampling:
    Gonzalez, Theoretical Computer Science 38, 1985).
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
    """Return the index (C, M) of the last pose that each of M robots reaches on each of C ``paths`` without collision.

    ``poses`` (M, 3): the start poses of the robots in the world frame. A robot that starts too close to a wall may
    drive away from it. ``between``: the number of collision checks between two poses of a path.
    """
    first = np.cumsum([0, *(len(path.poses) for path in paths)])
    along = np.concatenate([path.poses for path in paths]) if paths else np.empty((0, 3))
    out = np.empty((len(paths), len(poses)), dtype=np.int64)
    poses = np.ascontiguousarray(poses, dtype=float)
    _free_steps(space.index, space.distance, space.origin, poses, along, first, between, out)
    return out


def arc(turn: float, curvature: float, length: float) -> Path:
    """Return a path: a turn in place by ``turn`` [rad], then an arc of ``length`` [m] with ``curvature`` [rad/m]."""
    count = max(1, math.ceil(length / STEP - 1e-9))
    driven = np.minimum(STEP * np.arange(count + 1), length)
    poses = se2.exp(np.column_stack((driven, np.zeros(len(driven)), curvature * driven)))
    if turn == 0.0:
        return Path(poses, "arc")
    turned = se2.compose(np.array((0.0, 0.0, turn)), poses)
    return Path(np.concatenate((np.zeros((1, 3)), turned)), "arc")


def _driven(pose: Array, corners: Array) -> Array:
    """Return the poses (S, 3) of a robot that drives through ``corners`` (N, 2) in straight lines. ``pose`` (3,): the
    start. Corners and start are in the world frame, the result is in the frame of the start."""
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
