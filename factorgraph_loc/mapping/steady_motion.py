"""Constant-velocity motion model in SE(3) between consecutive frames.

Velocity increments are white noise, as the impulses of Davison, Reid, Molton, Stasse, "MonoSLAM", PAMI 29(6), 2007, section
3.4.
"""

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from factors.se2 import Array

TURN, SHIFT = 6.0, 4.0  # rad/s^2, m/s^2
UNEVEN = 0.5  # relative difference of two intervals that is allowed
ROBUST = 2.0


@dataclass(frozen=True, eq=False)
class SteadyMotion:
    """Motion model of a camera with frames at ``t`` (F,) [s], ascending; ``longest`` [s]: the largest interval between frames
    that is modelled.
    """

    t: Array
    longest: float = 0.5

    def add_to(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """Add a factor on each three consecutive frames at sufficiently even intervals."""
        steps = np.diff(self.t)
        for i, (first, second) in enumerate(zip(steps[:-1].tolist(), steps[1:].tolist(), strict=True)):
            if max(first, second) > self.longest or abs(second - first) > UNEVEN * min(first, second):
                continue
            mean = 0.5 * (first + second)
            sigmas = mean**2 * np.repeat((TURN, SHIFT), 3)
            huber = gtsam.noiseModel.mEstimator.Huber.Create(ROBUST)
            noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Diagonal.Sigmas(sigmas))
            graph.add(_factor((X(i), X(i + 1), X(i + 2)), second / first, noise))


def change_of_velocity(
    first: gtsam.Pose3, second: gtsam.Pose3, third: gtsam.Pose3, ratio: float
) -> tuple[Array, list[Array]]:
    """The change of velocity (6,), rotation first, and its Jacobians (6, 6) with respect to body-frame perturbations of the
    poses.

    It is the increment from ``second`` to ``third``, minus ``ratio`` (that of the intervals) times that from ``first`` to
    ``second``.
    """
    one, two = first.between(second), second.between(third)
    by_one, by_two = gtsam.Pose3.LogmapDerivative(one), gtsam.Pose3.LogmapDerivative(two)
    error = gtsam.Pose3.Logmap(two) - ratio * gtsam.Pose3.Logmap(one)
    back_one, back_two = one.inverse().AdjointMap(), two.inverse().AdjointMap()
    return error, [ratio * by_one @ back_one, -by_two @ back_two - ratio * by_one, by_two]


def _factor(keys: tuple[int, int, int], ratio: float, noise: Any) -> gtsam.CustomFactor:
    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> Array:
        first, second, third = (values.atPose3(key) for key in keys)
        residual, blocks = change_of_velocity(first, second, third, ratio)
        if jacobians is not None:
            for i, block in enumerate(blocks):
                jacobians[i] = block
        return residual

    return gtsam.CustomFactor(noise, list(keys), error)
