"""Odometry increments as factors of a graph, single or combined for speed."""

import math
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np

from factors import se2
from factors.compiled import compiled
from factors.gaussian import product
from factors.motion import Increment
from factors.odometry.kernels import NO_CONSTANTS, ROUNDING, all_changes, changed, recalibrate
from factors.se2 import Array, Integers, between_one, inverse_right_jacobian, twist_to


class Steps(NamedTuple):
    """K odometry increments (motions between two poses) as arrays for compiled code.

    ``deltas`` (K, 3): the increments as relative poses. ``twists`` (K, 3): their logarithms. ``moving`` (K,) [s]: the
    times in motion. ``whiteners`` (K, 3, 3): the matrices that whiten the residuals.
    """

    deltas: Array
    twists: Array
    moving: Array
    whiteners: Array


class OdometryStack:
    """Several odometry factors with the same estimated constants, linearised together.

    ``factors``: K factors. ``first`` (K,): the index of the first pose of each factor. The second pose is the next one.
    ``column``: the index of the first estimated constant in the parameters of the graph.
    """

    def __init__(self, factors: Sequence["OdometryFactor"], first: Sequence[int], column: int) -> None:
        self._first, self._column = np.array(first, dtype=np.int64), column
        self._indices = np.array(factors[0].estimated, dtype=np.int64)
        self._steps = Steps(*map(np.array, zip(*(f.packed for f in factors), strict=True)))
        self.rows = 3 * len(factors)

    @property
    def first(self) -> Integers:
        """The index (3 K,) of the first pose that each residual depends on."""
        return np.repeat(self._first, 3)

    def linearize(self, poses: Array, parameters: Array, jacobian: Array, residual: Array) -> None:
        """Write the whitened residuals into ``residual`` (3 K,), at ``poses`` (N, 3) and ``parameters`` (P,). Write
        their Jacobian by the first pose, the second pose and the parameters into ``jacobian`` (3 K, 6 + P)."""
        given = self._steps, self._constants(parameters), self._indices
        linearize_all(poses, self._first, *given, jacobian, residual, 6 + self._column)

    def cost(self, poses: Array, parameters: Array) -> float:
        """Return half the sum of the squared residuals at ``poses`` (N, 3) and ``parameters`` (P,) of the graph."""
        return float(cost_of_all(poses, self._first, self._steps, self._constants(parameters), self._indices))

    def _constants(self, parameters: Array) -> Array:
        return np.ascontiguousarray(parameters[self._column : self._column + len(self._indices)])


class OdometryFactor:
    """An odometry increment as a factor on two poses, and optionally on constants of the odometry.

    ``increment``: the measured motion. ``estimated``: the indices in :data:`factors.odometry.model.PARAMETERS` of the P
    constants that are estimated. The methods take ``values``, a list of the pose (3,) at the start, the pose (3,) at
    the end, and, if P > 0, the corrections (P,) of the constants.
    """

    def __init__(self, increment: Increment, estimated: Sequence[int] = ()) -> None:
        self._increment = increment
        self._arc = se2.log(increment.delta)
        self._moving = increment.duration - increment.still
        self.estimated = tuple(estimated)
        self._indices = np.array(estimated, dtype=np.int64)
        self._whitener = whitener(increment.covariance)

    @property
    def packed(self) -> tuple[Array, Array, float, Array]:
        """The increment (3,), its logarithm (3,), the time in motion [s], and the matrix (3, 3) to whiten residuals."""
        return self._increment.delta, self._arc, self._moving, self._whitener

    @property
    def kind(self) -> Hashable:
        """A hashable key that is equal for factors that can be linearised together."""
        return self.estimated

    def stack(self, factors: Sequence["OdometryFactor"], numbers: Sequence[int], column: int) -> OdometryStack:
        """Combine factors of the same ``kind`` into one object, which is linearised faster. ``numbers``: the index of
        each factor's first pose. ``column``: the index of the first odometry constant in the graph's parameters."""
        return OdometryStack(factors, numbers, column)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (3,) ``log(delta^-1 * start^-1 * end)``, and a list of its Jacobians by each
        variable. ``values``: the start pose (3,), the end pose (3,) and, if estimated, the constants (P,)."""
        start, end, *constants = values
        if constants:
            changed = self._arc, self._moving, constants[0], self._indices
            residual, *blocks = linearize_changed(start, end, *changed, self._whitener)
            return residual, blocks
        residual, *blocks = linearize(start, end, self._increment.delta, NO_CONSTANTS, self._whitener)
        return residual, blocks[:2]

    def cost(self, values: Sequence[Array]) -> float:
        """Return half the squared norm of the whitened residual. ``values``: start pose, end pose and constants."""
        residual, _ = self.linearize(values)
        return 0.5 * float(residual @ residual)


class ScaleFreeOdometryFactor(OdometryFactor):
    """An odometry factor for graphs without other measurements of the scale of the map, such as ranges. The translation
    in the residual is in the distance unit of the wheels, that is, divided by the estimated scale of distances.

    A residual in metres would decrease if the whole map shrinks. The estimated map would be too small by the fraction
    ``n s^2`` with the number ``n`` of increments and the standard deviation ``s`` of the scale.
    """

    kind = None  # always linearised alone

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (3,) and a list of its Jacobians by each of ``values``. The residual is that of
        :class:`OdometryFactor` with the translation divided by the estimated scale of distances."""
        start, end, *constants = values
        if not constants:
            return super().linearize(values)
        changed = self._arc, self._moving, constants[0], self._indices
        residual, *blocks = linearize_as_reported(start, end, *changed, self._whitener)
        return residual, blocks


@compiled
def whitener(covariance: Array) -> Array:
    """Return the inverse (3, 3) of the lower Cholesky factor of a covariance (3, 3). Diagonal elements of the factor
    that are too small because of rounding are raised."""
    a = math.sqrt(covariance[0, 0])
    b, c = covariance[1, 0] / a, covariance[2, 0] / a
    d = math.sqrt(max(covariance[1, 1] - b * b, ROUNDING * covariance[1, 1]))
    e = (covariance[2, 1] - b * c) / d
    f = math.sqrt(max(covariance[2, 2] - c * c - e * e, ROUNDING * covariance[2, 2]))
    return np.array(
        (
            (1.0 / a, 0.0, 0.0),
            (-b / (a * d), 1.0 / d, 0.0),
            ((b * e / d - c) / (a * f), -e / (d * f), 1.0 / f),
        )
    )


@compiled
def linearize(
    start: Array, end: Array, delta: Array, by_changes: Array, whitener: Array
) -> tuple[Array, Array, Array, Array]:
    """Linearise an increment between two poses.

    ``start``, ``end`` (3,): the poses. ``delta`` (3,): the measured increment.
    ``by_changes`` (3, P): the derivative of ``delta``, as a body-frame perturbation, by the estimated constants.
    ``whitener`` (3, 3): the matrix that whitens the residual.

    Returns the whitened residual (3,) ``log(delta^-1 * start^-1 * end)``, and its Jacobians by ``start`` (3, 3), by
    ``end`` (3, 3) and by the constants (3, P).
    """
    relative = between_one(start, end)
    rx, ry, turned = relative[0], relative[1], relative[2]
    error = twist_to(delta, relative)
    by_end = product(whitener, inverse_right_jacobian(error))
    c, s = math.cos(turned), math.sin(turned)
    # minus the adjoint of the inverse relative pose
    adjoint = np.array(((-c, -s, c * ry - s * rx), (s, -c, -c * rx - s * ry), (0.0, 0.0, -1.0)))
    by_delta = product(whitener, inverse_right_jacobian(-error))
    for i in range(3):
        for j in range(3):
            by_delta[i, j] = -by_delta[i, j]
    residual = np.empty(3)
    for i in range(3):
        residual[i] = whitener[i, 0] * error[0] + whitener[i, 1] * error[1] + whitener[i, 2] * error[2]
    return residual, product(by_end, adjoint), by_end, product(by_delta, by_changes)


@compiled
def linearize_changed(
    start: Array, end: Array, twist: Array, moving: float, constants: Array, indices: Integers, whitener: Array
) -> tuple[Array, Array, Array, Array]:
    """Linearise an increment between the poses ``start`` and ``end``, corrected for changed odometry constants.
    ``twist`` (3,): the logarithm of the increment. ``moving`` [s]: its time in motion. ``constants`` (P,): the
    differences of constants from those of the model. ``indices`` (P,): the indices of these constants in
    :data:`~factors.odometry.model.PARAMETERS`. ``whitener`` and results: as in :func:`linearize`."""
    delta, by_changes = changed(twist, moving, constants, indices)
    return linearize(start, end, delta, by_changes, whitener)


@compiled
def linearize_as_reported(
    start: Array, end: Array, twist: Array, moving: float, constants: Array, indices: Integers, whitener: Array
) -> tuple[Array, Array, Array, Array]:
    """Linearise an increment as :func:`linearize_changed` does, with the same arguments. The translation of the
    residual is divided by the estimated scale of distances. It is then in the wheels' distance unit, like the noise."""
    unit = 1.0 + all_changes(constants, indices)[0]
    as_reported = whitener.copy()
    for i in range(3):
        as_reported[i, 0] /= unit
        as_reported[i, 1] /= unit
    delta, by_changes = changed(twist, moving, constants, indices)
    residual, by_start, by_end, by_constants = linearize(start, end, delta, by_changes, as_reported)
    error = twist_to(delta, between_one(start, end))
    for j in range(len(indices)):
        if indices[j] == 0:
            for i in range(3):
                by_constants[i, j] -= (as_reported[i, 0] * error[0] + as_reported[i, 1] * error[1]) / unit
    return residual, by_start, by_end, by_constants


@compiled
def linearize_all(
    poses: Array,
    first: Integers,
    steps: Steps,
    constants: Array,
    indices: Integers,
    jacobian: Array,
    residual: Array,
    column: int,
) -> None:
    """Linearise K increments ``steps``. Writes the whitened residuals into ``residual`` (3 K,). Writes their Jacobian
    by the first pose, the second pose and the parameters of the graph into ``jacobian`` (3 K, 6 + P).

    ``poses`` (N, 3), ``first`` (K,): increment k is between the poses ``first[k]`` and ``first[k] + 1``.
    ``constants``, ``indices``: corrections of the estimated odometry constants, and their indices among all constants.
    ``column``: the first column of the constants in the Jacobian.
    """
    deltas, twists, moving, whiteners = steps
    for k in range(len(first)):
        start, end, row = poses[first[k]], poses[first[k] + 1], 3 * k
        if len(indices):
            linear = linearize_changed(start, end, twists[k], moving[k], constants, indices, whiteners[k])
            for i in range(3):
                for j in range(len(indices)):
                    jacobian[row + i, column + j] = linear[3][i, j]
        else:
            linear = linearize(start, end, deltas[k], np.zeros((3, 0)), whiteners[k])
        for i in range(3):
            residual[row + i] = linear[0][i]
            for j in range(3):
                jacobian[row + i, j], jacobian[row + i, 3 + j] = linear[1][i, j], linear[2][i, j]


@compiled
def cost_of_all(
    poses: Array,
    first: Integers,
    steps: Steps,
    constants: Array,
    indices: Integers,
) -> float:
    """Return half the sum of squared residuals of K increments ``steps``. Increment k is between the poses ``first[k]``
    and ``first[k] + 1`` of ``poses`` (N, 3). ``constants``, ``indices`` (P,): corrections of the estimated odometry
    constants, and their indices among all constants."""
    total = 0.0
    for k in range(len(first)):
        delta = steps.deltas[k]
        if len(indices):
            delta, _ = recalibrate(steps.twists[k], steps.moving[k], all_changes(constants, indices))
        error, w = twist_to(delta, between_one(poses[first[k]], poses[first[k] + 1])), steps.whiteners[k]
        total += (w[0, 0] * error[0]) ** 2 + (w[1, 0] * error[0] + w[1, 1] * error[1]) ** 2
        total += (w[2, 0] * error[0] + w[2, 1] * error[1] + w[2, 2] * error[2]) ** 2
    return 0.5 * total
