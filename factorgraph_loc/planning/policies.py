"""Policies that choose the path of a robot with an uncertain pose.

``information`` chooses the path with the largest expected reduction of the belief's entropy, minus the cost of its
length. ``paper_literal`` has the opposite sign, as printed by Raoui, Bouyakhf and Devy (ICINCO 2011). It prefers the
least informative path. ``random``, ``patrol`` and ``nearest_tags`` are for comparison.

All policies get the same candidates. These are paths whose first metre is free according to the proximity sensor, and a
turn in place unless the robot has just turned. Only policies that compare candidates use paths to distant places.
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

NOTHING = 0.3  # nats: a smaller gain is not significant, because the expectation is noisy
FEW = 0.6  # minimum total weight of the significant modes for an evaluation of paths to distant places
EACH, OF_MODES = 48, 96  # for far paths: number of particles drawn from each mode, and number that are used in total
COMMITTED = 0.5  # fraction of an arc that is completed before the next choice
FAR = "waypoint"  # kind of the paths to distant places
FAR_PER_METRE = 0.02  # nats/m: small penalty, so that the shorter of equally informative paths is chosen
AHEAD = 1.0  # m: a path must be free over this length from its start
BACK = math.radians(135.0)  # a patrol turns by more than this angle only if no other direction is free
NEAR = 3  # number of nearest tags whose mean distance is compared


@dataclass(frozen=True)
class Situation:
    """The input of a policy, the function that chooses the next path of a robot with an uncertain pose.

    ``particles`` (M, 3), ``weights`` (M,): the belief. ``modes``: its significant modes. ``sensors``: models of the
    sensors. ``space``: the free space between walls. ``candidates``: C paths. ``free`` (C,) [m]: the length of each
    path before the first wall, at most the range of the proximity sensor. ``settings``: of the active run. ``rng``: for
    random choices.
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
    """The choice of a policy.

    ``path``: the chosen path, or None if there is no candidate. ``metres`` [m]: the driven distance after which the
    policy chooses again. ``values`` (C,): the scores of the candidates, NaN if not evaluated. Empty if the policy does
    not compare candidates.
    """

    path: Path | None
    metres: float
    values: Array = field(default_factory=lambda: np.empty(0))


NO_PATH = Choice(None, 0.0)


Policy = Callable[[Situation], Choice]
"""A function that chooses a path."""


def information(s: Situation, sign: float = 1.0) -> Choice:
    """Return the choice of the path with the largest expected information. If ``sign`` is -1, the smallest is
    preferred, for comparison.

    Short candidates (arcs, straight paths, a turn in place) are evaluated first. Candidates to distant places are
    evaluated if each short one gains less than its length costs, and the belief has few modes. If these are not
    informative either, or if the pose is unknown, :func:`patrol` chooses.
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
            # follow a long path to its end: do not leave it for a small gain on another path
            return Choice(best, best.length, values)
    return replace(patrol(s), metres=settings.replan)


def _near_gains(s: Situation, paths: Sequence[Path]) -> Array:
    """Return the expected reduction of the belief's entropy (C,) [nats] on each of C short ``paths``. ``s``: has the
    belief and the sensor models."""
    samples = s.settings.policy.samples
    gains = expected_gain(s.sensors, s.particles, s.weights, paths, s.rng, samples=samples, space=s.space)
    if len(s.modes) != 1:
        return gains
    # add the loss by the noise of the odometry: without it the robot would prefer to drive back and forth
    alone, (mode,) = replace(s.sensors, forecasts=()), s.modes
    return gains + fisher_gain(mode.pose, mode.covariance, paths, alone)


def _far_gains(s: Situation, paths: Sequence[Path]) -> Array:
    """Return the expected information (C,) [nats] of C paths to distant places. If the belief has one mode, this is
    information about the pose. If it has several modes, it is information about which mode is true.

    Information about the pose is ignored with several modes: on a long path, simulated particles diverge and run into
    walls. The real robot plans again and avoids this.
    """
    if len(s.modes) == 1:
        (mode,) = s.modes
        return fisher_gain(mode.pose, mode.covariance, paths, s.sensors)
    # small differences between the weights of modes are random: the square root makes the weights more equal
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
    """Return the penalties (K,) [nats] for the lengths of K candidate paths. ``rows``: the indices of the paths in
    ``s.candidates``. ``per_metre`` [nats/m]: the penalty for one metre."""
    return per_metre * np.array([s.candidates[i].length for i in rows])


def random(s: Situation) -> Choice:
    """Return a random choice of an arc, a straight path or a turn in place, to be followed to its end. Candidates that
    lead to distant places are excluded."""
    arcs = [p for p in s.candidates if p.kind != FAR]
    if not arcs:
        return NO_PATH
    path = arcs[int(s.rng.integers(len(arcs)))]
    # a turn in place has length 0
    return Choice(path, max(path.length, s.settings.policy.replan))


def patrol(s: Situation) -> Choice:
    """Return the choice to drive straight ahead until a wall is near. Near a wall, choose the direction with the
    longest free path, and turn back only if no other direction is free."""
    straight = [(i, p) for i, p in enumerate(s.candidates) if _is_straight(p)]
    if not straight:
        return NO_PATH
    turns = np.array([abs(_direction(p)) for _, p in straight])
    free = s.free[[i for i, _ in straight]]
    if turns.min() < 1e-6 and free[turns.argmin()] > AHEAD:
        best = int(turns.argmin())
    else:
        # the longest free path; among equally long ones the path with the smallest turn
        best = int(np.lexsort((turns, -free.round(1), turns > BACK))[0])
    direction = _direction(straight[best][1])
    length = s.settings.max_metres
    along = np.arange(0.0, length + STEP, STEP)
    poses = np.column_stack((along * math.cos(direction), along * math.sin(direction), np.full(len(along), direction)))
    if direction != 0.0:
        poses = np.concatenate((np.zeros((1, 3)), poses))
    return Choice(Path(poses, "patrol"), length)


def nearest_tags(s: Situation) -> Choice:
    """Return the choice of the path whose end has the smallest mean distance to its nearest tags, averaged over the
    belief."""
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
    """Return the policy with this name, a function of a :class:`Situation` that returns a :class:`Choice`. Raises
    InputError for an unknown name."""
    if name not in POLICIES:
        raise InputError(f"policy {quoted(name)} is not known{nearest(name, list(POLICIES))}")
    chosen: Policy = load(f"{__name__}:{name}")
    return chosen


def usable(paths: Sequence[Path], free: Array, sight: float) -> tuple[tuple[Path, ...], Array]:
    """Return the ``paths`` that are free of walls in their first metre, and their free lengths [m] as an array.

    ``free`` (C,) [m]: the length of each of C ``paths`` before the first wall. ``sight`` [m]: the range of the
    proximity sensor. A path with a free length below ``sight`` is cut at this length.
    """
    keep = [i for i, p in enumerate(paths) if free[i] >= min(AHEAD, p.length, sight) - 1e-9]
    return tuple(paths[i].until(float(free[i])) if free[i] < sight else paths[i] for i in keep), free[keep]


def _direction(path: Path) -> float:
    """Return the direction [rad] of a straight path relative to the robot's heading."""
    return math.atan2(*path.poses[-1, 1::-1].tolist())


def _is_straight(path: Path) -> bool:
    x, y = path.poses[-1, :2]
    return path.kind == "arc" and path.length > 0.0 and math.hypot(x, y) > path.length - 1e-6
