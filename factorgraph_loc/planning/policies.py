"""Policies that choose the path of a robot with an uncertain pose.

``information``: the path with the largest expected reduction of the belief's entropy, minus its cost. ``paper_literal``: the same
with the sign as printed in the paper, which prefers the least informative path. ``random``, ``patrol`` and ``nearest_tags`` are
for comparison.

All get the same candidates: paths whose first metre is free by the proximity sensor, and a turn in place unless the robot has
just done one. Only policies that compare candidates use paths to distant places.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import nearest
from factorgraph_loc.maps.free_space import FreeSpace
from factorgraph_loc.model.belief import Mode
from factorgraph_loc.planning.information import Sensors, expected_gain, fisher_gain
from factorgraph_loc.planning.paths import STEP, Path
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.plugins import POLICIES, load
from factorgraph_loc.text import quoted
from factors import se2
from factors.se2 import Array

NOTHING = 0.3  # nats: gains below are within the noise of the expectation
FEW = 0.6  # total weight of the modes that paths may start from
EACH, OF_MODES = 48, 96  # particles per mode, and in total
COMMITTED = 0.5  # fraction of an arc to complete before choosing again
FAR = "waypoint"  # kind of paths to places
FAR_PER_METRE = 0.02  # nats: prefers the shorter of equally informative paths
AHEAD = 1.0  # m that must be free
BACK = math.radians(135.0)  # a turn beyond which a patrol would go back
NEAR = 3  # tags that determine a place


@dataclass(frozen=True)
class Situation:
    """The input of a policy: the belief as ``particles`` (M, 3) with ``weights`` (M,), ``sensors`` for forecasts, walls
    (``space``), and ``candidates`` with their ``free`` (C,) length [m] within the range of the proximity sensor. ``modes``: the
    significant ones.
    """

    particles: Array
    weights: Array
    sensors: Sensors
    space: FreeSpace
    candidates: tuple[Path, ...]
    free: Array
    settings: ActiveSettings
    rng: np.random.Generator
    modes: tuple[Mode, ...] = ()


@dataclass(frozen=True)
class Choice:
    """The chosen path, None if there is none, to follow for at most ``metres``; ``values`` (C,): scores of the candidates, NaN if
    not evaluated, or (0,) if the policy does not compare.
    """

    path: Path | None
    metres: float
    values: Array = field(default_factory=lambda: np.empty(0))


NO_PATH = Choice(None, 0.0)


Policy = Callable[[Situation], Choice]
"""A function that chooses a path."""


def information(s: Situation, sign: float = 1.0) -> Choice:
    """The path by its expected information; ``sign`` -1: as printed in the paper.

    Near paths come first. If none is worth its cost, distant places that distinguish few possible poses are evaluated; if these
    yield nothing either, or the pose is unknown, the robot patrols.
    """
    settings = s.settings.policy
    if not s.sensors.forecasts or not s.candidates:
        return patrol(s)
    values = np.full(len(s.candidates), np.nan)
    near = [i for i, p in enumerate(s.candidates) if p.kind != FAR]
    gains = _near_gains(s, [s.candidates[i] for i in near])
    costs = _costs(s, near, settings.per_metre)
    values[near] = sign * gains - costs
    if np.any((gains >= NOTHING) & (gains > costs)):
        best = s.candidates[int(np.nanargmax(values))]
        return Choice(best, max(settings.replan, COMMITTED * best.length), values)
    far = [i for i, p in enumerate(s.candidates) if p.kind == FAR]
    if far and sum(mode.weight for mode in s.modes) > FEW:
        gains = _far_gains(s, [s.candidates[i] for i in far])
        values[:] = np.nan
        values[far] = sign * gains - _costs(s, far, FAR_PER_METRE)
        if np.max(gains) >= NOTHING:
            best = s.candidates[far[int(np.argmax(values[far]))]]
            # a long path is followed to its end, not abandoned for a small gain
            return Choice(best, best.length, values)
    return replace(patrol(s), metres=settings.replan)


def _near_gains(s: Situation, paths: Sequence[Path]) -> Array:
    """Gains (C,) with respect to the whole belief."""
    samples = s.settings.policy.samples
    gains = expected_gain(s.sensors, s.particles, s.weights, paths, s.rng, samples=samples, space=s.space)
    if len(s.modes) != 1:
        return gains
    # otherwise the robot would go back and forth to compensate the noise of the odometry
    alone, (mode,) = replace(s.sensors, forecasts=()), s.modes
    return gains + fisher_gain(mode.pose, mode.covariance, paths, alone)


def _far_gains(s: Situation, paths: Sequence[Path]) -> Array:
    """Gains (C,) on the mode index, or on the position if the belief has a single mode. On a long path particles would diverge and
    run into walls that the real robot avoids by planning again.
    """
    if len(s.modes) == 1:
        (mode,) = s.modes
        return fisher_gain(mode.pose, mode.covariance, paths, s.sensors)
    # which of equal modes is the heavier is random
    weights = np.repeat(np.sqrt([mode.weight for mode in s.modes]), EACH)
    return expected_gain(
        s.sensors,
        np.concatenate([s.rng.multivariate_normal(mode.pose, mode.covariance, EACH) for mode in s.modes]),
        weights / weights.sum(),
        paths,
        s.rng,
        samples=OF_MODES,
        space=s.space,
        places=np.repeat(np.arange(len(s.modes)), EACH),
    )


def _costs(s: Situation, rows: Sequence[int], per_metre: float) -> Array:
    """Costs (K,) [nats] of the candidates ``rows`` (K,)."""
    return per_metre * np.array([s.candidates[i].length for i in rows])


def random(s: Situation) -> Choice:
    """Any of the arcs, short straight paths and turns in place, to its end."""
    arcs = [p for p in s.candidates if p.kind != FAR]
    if not arcs:
        return NO_PATH
    path = arcs[int(s.rng.integers(len(arcs)))]
    # a turn has length 0 and needs no free space
    return Choice(path, max(path.length, s.settings.policy.replan))


def patrol(s: Situation) -> Choice:
    """Straight on until a wall is near, then in the direction with the most free space; back only if nothing else is free."""
    straight = [(i, p) for i, p in enumerate(s.candidates) if _is_straight(p)]
    if not straight:
        return NO_PATH
    turns = np.array([abs(_direction(p)) for _, p in straight])
    free = s.free[[i for i, _ in straight]]
    if turns.min() < 1e-6 and free[turns.argmin()] > AHEAD:
        best = int(turns.argmin())
    else:
        # the longest free path; of equal ones that with the smallest turn
        best = int(np.lexsort((turns, -free.round(1), turns > BACK))[0])
    direction = _direction(straight[best][1])
    length = s.settings.max_metres
    along = np.arange(0.0, length + STEP, STEP)
    poses = np.column_stack((along * math.cos(direction), along * math.sin(direction), np.full(len(along), direction)))
    if direction != 0.0:
        poses = np.concatenate((np.zeros((1, 3)), poses))
    return Choice(Path(poses, "patrol"), length)


def nearest_tags(s: Situation) -> Choice:
    """Towards the nearest tags, on average over the belief."""
    if not len(s.sensors.goals) or not s.candidates:
        return patrol(s)
    rows = s.rng.choice(len(s.weights), s.settings.policy.samples, p=s.weights / s.weights.sum())
    ends = np.array([p.poses[-1] for p in s.candidates])
    places = se2.compose(s.particles[rows][:, None], ends[None])[..., :2]
    gaps = np.linalg.norm(places[:, :, None] - s.sensors.goals, axis=3)
    count = min(NEAR, gaps.shape[2])
    values = -np.sort(gaps, axis=2)[..., :count].mean(axis=(0, 2))
    return Choice(s.candidates[int(np.argmax(values))], s.settings.policy.replan, values)


paper_literal = partial(information, sign=-1.0)


def policy(name: str) -> Policy:
    """The policy of this module that has the name. Raises InputError for an unknown name."""
    if name not in POLICIES:
        raise InputError(f"no policy is called {quoted(name)}{nearest(name, list(POLICIES))}")
    chosen: Policy = load(f"{__name__}:{name}")
    return chosen


def usable(paths: Sequence[Path], free: Array, sight: float) -> tuple[tuple[Path, ...], Array]:
    """The paths whose first metre is free, shortened to the range of the sensor, with their free lengths."""
    keep = [i for i, p in enumerate(paths) if free[i] >= min(AHEAD, p.length, sight) - 1e-9]
    return tuple(paths[i].until(float(free[i])) if free[i] < sight else paths[i] for i in keep), free[keep]


def _direction(path: Path) -> float:
    """The direction of a straight path [rad] relative to the robot's heading."""
    return math.atan2(*path.poses[-1, 1::-1].tolist())


def _is_straight(path: Path) -> bool:
    x, y = path.poses[-1, :2]
    return path.kind == "arc" and path.length > 0.0 and math.hypot(x, y) > path.length - 1e-6
