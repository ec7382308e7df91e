"""Tracks on things that move by themselves: a second motion in the image, next to the one that wheels tell.

Wheels seldom slip. Where they do, all that stands still moves in the image as if the robot had turned by another angle, and what
seems to agree with the wheels agrees with that, too. If some tracks agree with the wheels alone, the others are of a thing that
moves, however many they are.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from factorgraph_loc.fusion.graph_parts import Keyframe
from factorgraph_loc.fusion.mapping import GraphView
from factorgraph_loc.sensors.camera.sensor import lifted
from factorgraph_loc.vision.consensus import GATE, Truths
from factors import positive
from factors.camera.model import CameraModel, linearize_in_space
from factors.camera.visual_odometry import RayPairs, nearness
from factors.motion import Increment
from factors.se2 import Array

MAX_TIME = 2.0  # s between two images that are compared
ENOUGH = 8  # tracks that agree with the wheels alone
COMMON = 0.8  # share of the others that another turn explains
TURNS, BETWEEN = np.linspace(-0.6, 0.6, 61), 0.01  # rad: other turns that are tried, and error of the nearest one
FARTHEST, NEAREST = 100.0, 0.5  # m


class MovingThings:
    """Remembers the last image, and which tracks move or stand still."""

    def __init__(self, model: CameraModel) -> None:
        self._model = model
        self._last: Keyframe | None = None
        self._pixels: Mapping[Hashable, Array] = {}
        self._moves: dict[Hashable, bool] = {}  # by track, once it is known
        self._doubts = False

    def moving(self) -> set[Hashable]:
        """The tracks in the last image that move by themselves."""
        return {name for name in self._pixels if self._moves.get(name, False)}

    def trusts(self, name: Hashable) -> bool:
        """Whether a track stands still; as long as something moves, it must have agreed with the wheels alone once."""
        return not self._moves.get(name, self._doubts)

    def look(self, keyframe: Keyframe, names: Sequence[Hashable], pixels: Array, graph: GraphView) -> None:
        """Learn from the tracks ``names``, seen at ``pixels`` (K, 2) from a keyframe."""
        before, last, here = self._last, self._pixels, dict(zip(names, pixels, strict=True))
        self._moves = {name: moves for name, moves in self._moves.items() if name in here or name in last}
        if before is None or keyframe.t > before.t:
            self._last, self._pixels = keyframe, here
        common = [name for name in names if name in last]
        if before is not None and common and 0.0 < keyframe.t - before.t <= MAX_TIME:
            first, second = (np.array([seen[name] for name in common]) for seen in (last, here))
            step = graph.between(before, keyframe)
            right = fitting(self._model, first, second, step)
            other = another(self._model, first, second, step, right)
            known = np.array([self._moves.get(name, False) for name in common])
            many = 2 * np.count_nonzero(known & ~right) > np.count_nonzero(~right)
            told = other.any() and (many or np.count_nonzero(right & ~other) >= ENOUGH)
            for name, fits, either in zip(common, right.tolist(), other.tolist(), strict=True):
                if not fits and (told or name in self._moves):
                    self._moves[name] = True
                elif told and not either:
                    self._moves.setdefault(name, False)
        self._doubts = any(self._moves.get(name, False) for name in names)


def another(model: CameraModel, first: Array, second: Array, step: Increment, right: Truths) -> Truths:
    """Which pairs of pixels (K, 2) fit the turn that explains most of those that do not fit the ``step`` that wheels tell.

    None does if most fit the step (``right``), or if no turn explains :data:`COMMON` of the others."""
    best, others = right, ~right
    if 2 * np.count_nonzero(others) >= len(right):
        for turn in TURNS.tolist():
            delta, covariance = step.delta.copy(), step.covariance.copy()
            delta[2] += turn
            covariance[2, 2] += BETWEEN**2
            fits = fitting(model, first, second, replace(step, delta=delta, covariance=covariance))
            if np.count_nonzero(fits & others) > np.count_nonzero(best & others):
                best = fits
    explained = np.count_nonzero(best & others)
    enough = explained > 0 and explained >= COMMON * np.count_nonzero(others)
    return best if enough else np.zeros(len(right), dtype=bool)


def fitting(model: CameraModel, first: Array, second: Array, step: Increment) -> Truths:
    """Which pairs of pixels (K, 2) fit a ``step`` of the robot between them, at some distance."""
    pairs = RayPairs.of(model, first, second)
    nearer = np.clip(nearness(pairs, step.delta)[0], 1.0 / FARTHEST, 1.0 / NEAREST)
    camera = lifted(model, step.delta, step.covariance)
    points = model.position + pairs.first / nearer[:, None]
    seen, by_camera, _ = linearize_in_space(model, camera.position, camera.rotation, points)
    noise = by_camera @ camera.covariance @ by_camera.transpose(0, 2, 1) + 2.0 * model.sigma**2 * np.eye(2)
    return np.asarray(positive.squared(seen - second, noise) < GATE)
