"""The factor of measured ranges and bearings of landmarks. It depends on a robot pose, and optionally on calibration
constants of the sensor, on a range bias, and on the position of an unknown landmark."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from factors import se2
from factors.landmarks import kernels, losses
from factors.landmarks.late import LateRanges
from factors.landmarks.model import (
    CONSTANTS,
    EXACT,
    HEIGHT,
    PARAMETERS,
    POINT,
    TIME_OFFSET,
    WIDTH,
    BearingRangeModel,
    located,
    log_likelihood,
    on_floor,
    recalibrated,
    widened,
    with_late,
)
from factors.robust import geman_mcclure_weight
from factors.se2 import Array, Integers
from factors.sighting import delayed
from factors.update import CONVERGED, GATE, Correction

NOTHING = np.zeros(0)  # the values of the sensor constants if the factor estimates no constants
_NOWHERE, _EXACTLY = np.zeros(3), np.zeros((3, 3))  # placeholders for an offset or covariance that is None
SMALL_BIAS = 1e-4  # m; step of the numerical derivative by a range bias: residuals are nearly linear
LEAST_SINGULAR = 1e-6  # minimum singular value of a Jacobian by a landmark, in 1/m and relative to the largest one


@dataclass(frozen=True, slots=True)
class BearingRangeFactor:
    """A factor on the robot's pose from K landmarks, all measured at the time of the pose or all at one later time.

    ``model``: the sensor and its noise. ``points``: world positions (K, 2) of the landmarks, or (K, 3) with their
    heights above the sensor.
    ``ranges``, ``bearings``: measurements (K,) [m, rad], NaN where a value is missing.
    ``offset`` (3,): the robot's pose at the time of the measurement in the frame of the estimated pose, from odometry.
    None if the two poses are equal.
    ``offset_covariance`` (3, 3): body-frame covariance of ``offset``. It is added to the noise.
    ``point_covariances`` (K, 2, 2): covariances of the landmarks, which are added to the noise. None if exact.
    ``estimated``: indices in :data:`PARAMETERS` of the P sensor constants that are estimated.
    ``free``: True if the position of the landmark is estimated. Then K is 1, and the estimate replaces ``points``.
    ``biased``: True if a bias of the ranges is estimated.
    ``twist`` (3,): the robot's body-frame velocity. Required if the time offset is estimated.
    ``simultaneous``: the number of all landmarks measured at this time, also by other factors. None means K. The
    covariance of ``offset`` is multiplied by this number, because its error is common to all and does not average out.

    The methods take ``values``, a list in this order: the pose (3,), the corrections (P,) of the estimated constants if
    P > 0, the range bias (1,) [m] if ``biased``, and the landmark's position (2,) if ``free``.
    """

    model: BearingRangeModel
    points: Array
    ranges: Array
    bearings: Array
    offset: Array | None = None
    offset_covariance: Array | None = None
    point_covariances: Array | None = None
    estimated: tuple[int, ...] = ()
    free: bool = False
    biased: bool = False
    twist: Array | None = None
    simultaneous: int | None = None

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (2K,) with robust weights, and a list of its Jacobians (2K, d), one for each
        variable. ``values``: the pose (3,), then the estimated constants, bias and position, see the class."""
        if not (self.free or self.biased):
            constants = values[1] if self.estimated else NOTHING
            linear = kernels.weighted(self.model.packed, self.packed, values[0], constants, self.places)
            residual, by_pose, by_sensor = linear
            return residual, [by_pose, by_sensor] if self.estimated else [by_pose]
        error, blocks, slopes = self._linearized(values)
        jacobian = np.concatenate(blocks, axis=2)
        losses.weigh(self.model.packed, error, jacobian, slopes)
        ends = np.cumsum([block.shape[2] for block in blocks])[:-1]
        return error.ravel(), np.split(jacobian.reshape(error.size, -1), ends, axis=1)

    @property
    def kind(self) -> Hashable:
        """A key that is equal for factors that can be linearised together. None if the factor must be linearised alone,
        because the landmark's position or a range bias is estimated."""
        return None if self.free or self.biased else (self.estimated, self.model)

    def stack(self, factors: Sequence[BearingRangeFactor], numbers: Sequence[int], column: int) -> BearingRangeStack:
        """Combine factors of the same ``kind`` into one object, which is linearised faster. ``numbers``: the index of
        each factor's pose. ``column``: the index of the first sensor constant in the parameters of the graph."""
        return BearingRangeStack(factors, numbers, column)

    def count_beyond(self, limit: float, pose: Array, covariance: Array) -> int:
        """Count the landmarks with a normalised innovation squared above ``limit``, at the predicted ``pose`` (3,) with
        body-frame ``covariance`` (3, 3). The factor must depend on the pose only."""
        contiguous = np.ascontiguousarray(covariance)
        return int(kernels.beyond(self.model.packed, pose, self.packed, contiguous, limit))

    @property
    def packed(self) -> kernels.Sighting:
        """The measured values of the factor, without the sensor model, as a tuple for compiled functions."""
        offset, drift, twist, surveys = self.offset, self.offset_covariance, self.twist, self.point_covariances
        return (
            *(self.points, self.ranges, self.bearings),
            *(offset is not None, _NOWHERE if offset is None else offset),
            *(drift is not None, _EXACTLY if drift is None else drift),
            float(len(self.ranges) if self.simultaneous is None else self.simultaneous),
            *(twist is not None, _NOWHERE if twist is None else twist),
            EXACT if surveys is None else np.ascontiguousarray(surveys),
        )

    @property
    def places(self) -> Integers:
        """The indices (P,) of the estimated constants in :data:`PARAMETERS`, as an array."""
        return _places(self.estimated)

    def cost(self, values: Sequence[Array]) -> float:
        """Return the sum of robust losses of all landmarks. ``values``: pose, constants, bias, position, see the
        class."""
        error, _, slopes = self._linearized(values)
        return float(losses.loss(self.model.packed, error, slopes))

    def log_likelihood(self, poses: Array, parameters: Array | None = None) -> Array:
        """Return the log-likelihood (N,), up to a constant, of ``poses`` (N, 3) at the time of the measurement.
        ``parameters`` (N, 6): corrections of the sensor constants for each pose, see
        :func:`~factors.landmarks.model.log_likelihood`."""
        measured = self.points, self.ranges, self.bearings
        return log_likelihood(self.model, poses, *measured, parameters, self.point_covariances)

    def weight(self, squared: Array) -> Array:
        """Return the robust weights (K,) for ``squared`` (K,), the squared norms of whitened residuals."""
        return geman_mcclure_weight(squared, self.model.robust)

    def widened(self, width: float) -> BearingRangeFactor:
        """Return the factor with the scale of its robust loss multiplied by ``width``."""
        return self if width == 1.0 else replace(self, model=widened(self.model, width))

    def with_late(self, late: LateRanges) -> BearingRangeFactor:
        """Return the factor with the statistics ``late`` of ranges that are too long."""
        return self if late == self.model.late else replace(self, model=with_late(self.model, late))

    def predicted(self, pose: Array, covariance: Array) -> tuple[Array, Array, Array]:
        """Return three arrays (K,), from the predicted ``pose`` (3,) with ``covariance`` (3, 3). The first has the
        predicted minus the measured ranges in standard deviations. The second has the inverse standard deviations
        [1/m], or 0 for a landmark without range or with a bearing. The third has the variances of the predicted ranges,
        divided by those of the noise. The factor must depend on the pose only."""
        contiguous = np.ascontiguousarray(covariance)
        return kernels.predicted(self.model.packed, self.packed, pose, contiguous)

    def resolved(self, values: Sequence[Array], covariance: Array) -> ResolvedFactor:
        """Return a factor to use in one Kalman update, with Gaussian measurements in place of ranges that may be too
        long. It is valid only for the prediction ``values`` (see the class) with the joint ``covariance`` (D, D)."""
        error, blocks, slopes = self._linearized(values)
        jacobian, changed, weights = np.concatenate(blocks, axis=2), error.copy(), np.ones(len(error))
        columns, contiguous = np.arange(len(covariance)), np.ascontiguousarray(covariance)
        known = changed, jacobian, columns, contiguous, slopes
        losses.resolve(self.model.packed, *known, GATE, weights, np.empty(len(error)))
        return ResolvedFactor(self, (changed - error)[:, 0], np.sqrt(weights))

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (K, 2), predicted minus measured, and a list of its Jacobians (K, 2, d), one for
        each variable, without robust weights. ``values``: the pose (3,), then constants, bias and position."""
        return self._linearized(values)[:2]

    def _linearized(self, values: Sequence[Array]) -> tuple[Array, list[Array], Array]:
        """Return the results of :meth:`whitened` and, as a third value, the derivative (K,) [1/m] of each range
        residual by the predicted range. It is 0 for a landmark without range or with a bearing."""
        error, jacobian = self._whitened(values)
        blocks, slopes = self._blocks(jacobian), np.empty(len(error))
        losses.slopes(error, jacobian, self._shortened(values), self.bearings, slopes)
        if self.biased:
            shorter, longer = (self._whitened(values, bias)[0] for bias in (SMALL_BIAS, -SMALL_BIAS))
            blocks.insert(1 + bool(self.estimated), ((shorter - longer) / (2.0 * SMALL_BIAS))[..., None])
        return error, blocks, slopes

    def _shortened(self, values: Sequence[Array]) -> Array:
        """Return the ranges (K,) minus the range bias in ``values``, if it is estimated."""
        return self.ranges - values[1 + bool(self.estimated)][0] if self.biased else self.ranges

    def _whitened(self, values: Sequence[Array], bias: float = 0.0) -> tuple[Array, Array]:
        """Return the whitened residual (K, 2) at ``values``, with ``bias`` [m] added to the range bias. Also returns
        its Jacobian (K, 2, WIDTH) by the pose, the landmark and all sensor constants."""
        packed, changes, count = self.packed, np.zeros(len(PARAMETERS)), len(self.ranges)
        if self.estimated:
            changes[list(self.estimated)] = values[1]
        if self.free:
            packed = (self._placed(values[-1]), *packed[1:])
        if self.biased:
            packed = (packed[0], self._shortened(values) - bias, *packed[2:])
        error, jacobian = np.zeros((count, 2)), np.zeros((count, 2, WIDTH))
        kernels.linearize(self.model.packed, values[0], changes, packed, error, jacobian)
        return error, jacobian

    def _blocks(self, jacobian: Array) -> list[Array]:
        """Return the Jacobians (K, 2, d) by each value except the range bias, parts of ``jacobian`` (K, 2, WIDTH)."""
        blocks = [jacobian[..., :POINT]]
        if self.estimated:
            blocks.append(jacobian[..., CONSTANTS:][..., list(self.estimated)])
        if self.free:
            blocks.append(jacobian[..., POINT:CONSTANTS])
        return blocks

    def fixed(self, parameters: Sequence[Array], point: Array | None, bias: float = 0.0) -> BearingRangeFactor:
        """Return a factor on the pose only, with the other variables fixed at the given values.

        ``parameters``: a sequence of one array (P,), the corrections of the estimated constants, or an empty sequence.
        ``point`` (2,): the position of the landmark if the factor estimates it (``free``), otherwise None.
        ``bias``: the range bias [m].
        """
        if not (parameters or self.biased) and point is None:
            return self
        model, offset = self.model, self.offset
        if parameters:
            changes = dict(zip(self.estimated, parameters[0].tolist(), strict=True))
            model = recalibrated(model, [changes.get(i, 0.0) for i in range(len(PARAMETERS))])
            offset = delayed(offset, self.twist, changes.get(TIME_OFFSET, 0.0))
        noises, measured = (self.offset_covariance, self.point_covariances), (self.ranges - bias, self.bearings)
        points = self.points if point is None else self._placed(point)
        return BearingRangeFactor(
            model, points, *measured, offset, *noises, twist=self.twist, simultaneous=self.simultaneous
        )

    def _placed(self, point: Array) -> Array:
        """Return the landmark's ``point`` (2,) as (1, 2), or as (1, 3) with its height if ``points`` has heights."""
        return np.concatenate((np.reshape(point, (1, 2)), self.points[:1, HEIGHT:]), axis=1)

    def dof(self) -> int:
        """Return the number of measured ranges and bearings."""
        return int(np.count_nonzero(~np.isnan(self.ranges)) + np.count_nonzero(~np.isnan(self.bearings)))

    def locate(self, values: Sequence[Array]) -> tuple[Array, list[Array], Array]:
        """Return the position of a single landmark from its range and bearing, to initialise an estimate of it.

        ``values``: the pose (3,), then the estimated constants and the bias, see the class. Returns the position (2,)
        in the world, its Jacobian (2, d) by each of ``values``, and its covariance (2, 2) due to measurement noise.
        """
        on_pose = self.fixed(values[1:], None)
        at = values[0] if on_pose.offset is None else se2.compose(values[0], on_pose.offset)
        point = se2.transform_from(
            at, located(on_pose.model, on_floor(on_pose.model, self.points, self.ranges), self.bearings)
        )[0]
        _, blocks = replace(self, free=True).whitened([*values, point])
        # The residual is zero at this position. Changes dv of the values and dp of the position satisfy
        # by_value dv + by_point dp = unit noise.
        to_point = _raised_inverse(blocks[-1][0])
        return point, [-to_point @ block[0] for block in blocks[:-1]], to_point @ to_point.T


@dataclass(frozen=True)
class ResolvedFactor:
    """A landmark ``factor`` for one Kalman update, with Gaussian measurements in place of ranges that may be too long.
    ``shift`` (K,): is added to the whitened range residuals. ``root`` (K,): square roots of the Gaussians' weights."""

    factor: BearingRangeFactor
    shift: Array
    root: Array

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (K, 2) and a list of its Jacobians (K, 2, d) by ``values`` of ``factor``."""
        error, blocks = self.factor.whitened(values)
        error[:, 0] += self.shift
        return self.root[:, None] * error, [self.root[:, None, None] * block for block in blocks]

    def weight(self, squared: Array) -> Array:
        """Return the robust weights (K,) for ``squared`` (K,), the squared norms of whitened residuals."""
        return self.factor.weight(squared)

    def dof(self) -> int:
        """Return the number of measured ranges and bearings."""
        return self.factor.dof()


def landmark_update(
    factor: BearingRangeFactor,
    pose: Array,
    covariance: Array,
    constants: Array,
    first: int,
    iterations: int,
    converged: float = CONVERGED,
) -> Correction | None:
    """Correct the Gaussian estimate of a robot pose by the landmarks of ``factor``, with an iterated Kalman update. A
    compiled equivalent of :func:`~factors.update.update_state`.

    ``pose`` (3,): the predicted pose. ``covariance`` (S, S): the covariance of the error state. Its first three
    components are the pose. ``constants`` (P,): corrections of the estimated sensor constants. They are the components
    of the error state from index ``first`` on. ``iterations``: the maximum number of iterations. They end earlier when
    a step is below ``converged``. Returns None if the factor estimates a landmark position or a range bias, or if a
    matrix is singular. Call ``update_state`` then.
    """
    if factor.free or factor.biased:
        return None
    contiguous = np.ascontiguousarray(covariance)  # numba would compile the function again for other memory layouts
    known = factor.model.packed, factor.packed, pose, contiguous, constants, factor.places, first
    try:
        return Correction(*kernels.updated(*known, iterations, converged, GATE))
    except np.linalg.LinAlgError:
        return None


class BearingRangeStack:
    """Several landmark factors with the same model and estimated constants, linearised together. Landmarks are given.

    ``factors``: L factors.
    ``pose_of`` (L,): the index of the pose that each factor depends on.
    ``column``: the index of the first estimated constant in the parameters of the graph.
    """

    def __init__(self, factors: Sequence[BearingRangeFactor], pose_of: Sequence[int], column: int) -> None:
        first = factors[0]
        self._model, self._estimated, self._column = first.model.packed, list(first.estimated), column
        self._pose_of = np.array(pose_of, dtype=np.int64)
        sizes = np.array([len(f.points) for f in factors])
        self._ends = np.cumsum(sizes)
        self._seen = (
            np.concatenate([f.points for f in factors]),
            np.concatenate([f.ranges for f in factors]),
            np.concatenate([f.bearings for f in factors]),
        )
        parts = [f.packed for f in factors]
        covariances = [f.point_covariances for f in factors]
        self._flags = np.array([(p[3], p[5], p[8], s is not None) for p, s in zip(parts, covariances, strict=True)])
        self._offsets, self._covariances = np.array([p[4] for p in parts]), np.array([p[6] for p in parts])
        self._counts, self._twists = np.array([p[7] for p in parts]), np.array([p[9] for p in parts])
        none = [np.zeros((size, 2, 2)) for size in sizes.tolist()]
        self._spreads = np.concatenate([n if s is None else s for n, s in zip(none, covariances, strict=True)])
        self.rows = 2 * int(self._ends[-1])

    @property
    def first(self) -> Integers:
        """The index (2 K,) of the pose that each residual depends on. K is the number of landmarks of all factors."""
        return np.repeat(np.repeat(self._pose_of, np.diff(self._ends, prepend=0)), 2)

    def linearize(self, poses: Array, parameters: Array, jacobian: Array, residual: Array) -> None:
        """Write the whitened residuals with robust weights into ``residual`` (2 K,), for ``poses`` (N, 3) and
        ``parameters`` (P,). Write their Jacobian by the pose, the next pose and the parameters into ``jacobian`` (2 K,
        6 + P)."""
        error, by_all, slopes = self._whitened(poses, parameters)
        losses.weigh(self._model, error, by_all, slopes)
        by_all = by_all.reshape(len(residual), WIDTH)
        residual[:], jacobian[:, :3] = error.ravel(), by_all[:, :POINT]
        end = self._column + len(self._estimated)
        jacobian[:, 6 + self._column : 6 + end] = by_all[:, CONSTANTS:][:, self._estimated]

    def cost(self, poses: Array, parameters: Array) -> float:
        """Return the robust loss at ``poses`` (N, 3) and ``parameters`` (P,) of the graph, summed over all factors."""
        error, _, slopes = self._whitened(poses, parameters)
        return float(losses.loss(self._model, error, slopes))

    def _whitened(self, poses: Array, parameters: Array) -> tuple[Array, Array, Array]:
        """Return the whitened residuals (K, 2) without robust weights, at ``poses`` (N, 3) and ``parameters`` (P,).
        Also returns their Jacobian (K, 2, WIDTH), and the derivatives (K,) of
        :func:`~factors.landmarks.losses.slopes`."""
        changes, count = np.zeros(len(PARAMETERS)), self.rows // 2
        changes[self._estimated] = parameters[self._column : self._column + len(self._estimated)]
        out = np.zeros((count, 2)), np.zeros((count, 2, WIDTH))
        sightings = self._flags, self._offsets, self._covariances, self._counts, self._twists, self._spreads
        kernels.linearize_all(self._model, poses, self._pose_of, changes, self._ends, self._seen, *sightings, *out)
        slopes = np.empty(count)
        losses.slopes(*out, *self._seen[1:], slopes)
        return *out, slopes


@lru_cache(maxsize=64)
def _places(estimated: tuple[int, ...]) -> Integers:
    return np.array(estimated, dtype=np.int64)


def _raised_inverse(by_point: Array) -> Array:
    """Return the inverse of a whitened Jacobian (2, 2) by a landmark's position. Small singular values are raised
    first, because the Jacobian of a landmark very close to the sensor is singular."""
    rows, values, columns = np.linalg.svd(by_point)
    if values[1] > LEAST_SINGULAR * values[0]:
        return np.asarray(np.linalg.inv(by_point))
    values = np.maximum(values, max(LEAST_SINGULAR * values[0], LEAST_SINGULAR))
    return np.asarray(columns.T / values @ rows.T)
