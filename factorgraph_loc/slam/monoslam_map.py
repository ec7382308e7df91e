"""Management of the points in the state of the monoSLAM filter: initialization, conversion to x, y, z, and deletion.

Davison et al., 2007 (see :mod:`~factorgraph_loc.slam.monoslam_motion`), section III.G: a point that is often not found is deleted.
Civera, Davison, Montiel, 2008: new points are initialized by inverse depth (:mod:`factors.camera.inverse_depth`).
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from factorgraph_loc.slam.monoslam_state import Eye, MapPoint, SlamState
from factors.camera import inverse_depth
from factors.se2 import Array, Integers

# 1/m: mean and standard deviation of the prior inverse depth of a point, so wide that it does not determine the map's scale.
INVERSE_DEPTH, INVERSE_DEPTH_SIGMA = 0.3, 1.0
# A point is deleted if it was expected in at least FEWEST_TRIALS images and matched in a smaller fraction of them than LEAST_FOUND.
FEWEST_TRIALS, LEAST_FOUND = 8, 0.5


def with_point(state: SlamState, point: MapPoint, eye: Eye, pixel: Array) -> SlamState:
    """Return ``state`` with a new ``point``, which the camera ``eye`` observes at ``pixel`` (2,). Its depth is
    unknown."""
    position, rotation = eye.pose(state.robot)
    ray, by_camera, by_seen = inverse_depth.begin(eye.model, position, rotation, pixel, INVERSE_DEPTH)
    by_pose = by_camera @ eye.lift
    noise = np.diag((eye.model.sigma, eye.model.sigma, INVERSE_DEPTH_SIGMA)) ** 2
    size, more = len(state.covariance), inverse_depth.SIZE
    carried = by_pose @ state.covariance[:6]
    covariance = np.empty((size + more, size + more))
    covariance[:size, :size] = state.covariance
    covariance[size:, :size], covariance[:size, size:] = carried, carried.T
    covariance[size:, size:] = carried[:, :6] @ by_pose.T + by_seen @ noise @ by_seen.T
    return replace(
        state, points=(*state.points, point), values=np.concatenate((state.values, ray)), covariance=covariance
    )


def settled(state: SlamState, eye: Eye) -> SlamState:
    """Return ``state`` with points of certain depth converted from inverse depth to x, y, z. A depth is certain if the
    linearity index of Civera, Davison and Montiel (2008) is small. ``eye``: the camera."""
    position, _ = eye.pose(state.robot)
    rays = [i for i, p in enumerate(state.points) if p.ray]
    if not rays:
        return state
    starts = state.starts()[rays]
    values = state.values[starts[:, None] + np.arange(inverse_depth.SIZE)]
    last = state.base + starts + inverse_depth.SIZE - 1
    index = inverse_depth.linearity(values, np.sqrt(state.covariance[last, last]), position)
    ripe = [i for i, linear in zip(rays, index.tolist(), strict=True) if linear < inverse_depth.LINEAR]
    if not ripe:
        return state
    starts, kept = state.starts(), np.ones(len(state.values), dtype=bool)
    points, moved, covariance = list(state.points), state.values.copy(), state.covariance.copy()
    for i in ripe:
        s, more = int(starts[i]), inverse_depth.SIZE
        (moved[s : s + 3],), (by_ray,) = inverse_depth.positions(state.values[None, s : s + more])
        c = state.base + s
        covariance[c : c + 3] = by_ray @ covariance[c : c + more]
        covariance[:, c : c + 3] = covariance[:, c : c + more] @ by_ray.T
        kept[s + 3 : s + more] = False
        points[i] = replace(points[i], ray=False)
    rows = np.concatenate((np.arange(state.base), state.base + np.flatnonzero(kept)))
    return replace(state, covariance=covariance[np.ix_(rows, rows)], points=tuple(points), values=moved[kept])


def counted(state: SlamState, expected: Sequence[int], matched: Collection[int], t: float) -> SlamState:
    """Return the state with updated counters of its points, after an image at time ``t`` [s]. ``expected``: indices of
    the points that should be visible. ``matched``: indices of the points that were matched."""
    points = list(state.points)
    for i in expected:
        hit = i in matched
        p = points[i]
        points[i] = replace(p, expected=p.expected + 1, matched=p.matched + hit, t=t if hit else p.t)
    return replace(state, points=tuple(points))


def pruned(state: SlamState, most: int) -> tuple[SlamState, int]:
    """Return the state without points that are often not matched, and without points of negative inverse depth.

    Also returns the number of these deleted points. If more than ``most`` points remain, the points with the oldest
    matches are deleted too, but not counted.
    """
    failed = {
        i
        for i, (p, start) in enumerate(zip(state.points, state.starts().tolist(), strict=True))
        if (p.expected >= FEWEST_TRIALS and p.matched < LEAST_FOUND * p.expected)
        or (p.ray and _is_beyond_infinity(state, start + 5))
    }
    left = [i for i in range(len(state.points)) if i not in failed]
    spare = len(left) - most
    dropped = set(sorted(left, key=lambda i: state.points[i].t)[:spare]) if spare > 0 else set()
    return without(state, failed | dropped), len(failed)


def _is_beyond_infinity(state: SlamState, place: int) -> bool:
    """Return True if the inverse depth ``state.values[place]`` is below zero by more than two standard deviations."""
    return bool(state.values[place] < -2.0 * np.sqrt(state.covariance[state.base + place, state.base + place]))


def without(state: SlamState, which: Collection[int]) -> SlamState:
    """Return ``state`` without the points with the indices ``which``."""
    if not which:
        return state
    kept = np.repeat([i not in which for i in range(len(state.points))], [p.size for p in state.points])
    rows: Integers = np.concatenate((np.arange(state.base), state.base + np.flatnonzero(kept)))
    points = tuple(p for i, p in enumerate(state.points) if i not in which)
    return replace(state, covariance=state.covariance[np.ix_(rows, rows)], points=points, values=state.values[kept])
