"""Variables and factors as GTSAM gets them.

A variable is a pose (3,), or a vector: roll and pitch (2,) of the robot at a pose, constants of a sensor that are estimated, or the
position of a landmark (2,) or point (3,).

A factor has ``linearize(values)``, whose values are arrays: poses (3,), vectors (P,). It returns the whitened, robustly weighted
residual and one Jacobian per variable, by body-frame perturbation. GTSAM gets it as a linear factor: callbacks would copy all
variables, and an exception in a callback leaves iSAM2 in an inconsistent state.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import lru_cache
from itertools import chain
from typing import Any, Protocol, runtime_checkable

import gtsam
import numpy as np

from factors import positive, se2
from factors.compiled import compiled
from factors.gaussian import cholesky
from factors.se2 import Array, Integers

MOST_TERMS = 3  # of a `gtsam.JacobianFactor` in Python; a conditional is such a factor and may have any number
RELATIVE_RIDGE, RIDGE = 1e-9, 1e-10  # of the mean curvature of a cost, and of any: against division by zero
LEAST = 1e-12  # a cost of zero has no gradient
Values = dict[int, Array]
GTSAM_ERRORS = (RuntimeError, IndexError, ValueError)  # all that GTSAM raises

_POSE, _TILT, _POINT, _LANDMARK = ord("x"), ord("t"), ord("p"), ord("l")
_CHARACTER = 56  # bits of a key below its character


def pose_key(index: int) -> int:
    """The key of the pose of keyframe ``index``."""
    return int(gtsam.symbol("x", index))


def tilt_key(index: int) -> int:
    """The key of the tilt of the robot at keyframe ``index``."""
    return int(gtsam.symbol("t", index))


def constants_key(index: int) -> int:
    """The key of the constants of the sensor with number ``index``."""
    return int(gtsam.symbol("c", index))


def landmark_key(index: int) -> int:
    """The key of the landmark that was met as number ``index``."""
    return int(gtsam.symbol("l", index))


def point_key(index: int) -> int:
    """The key of the point in space that was added as number ``index``."""
    return int(gtsam.symbol("p", index))


def leaving_key(index: int) -> int:
    """The key of a variable that only serves to leave a window, with number ``index``."""
    return int(gtsam.symbol("q", index))


def is_point(key: int) -> bool:
    """Whether the variable is a point in space."""
    return key >> _CHARACTER == _POINT


def is_landmark(key: int) -> bool:
    """Whether the variable is a landmark."""
    return key >> _CHARACTER == _LANDMARK


def is_pose(key: int) -> bool:
    """Whether the variable is a pose."""
    return key >> _CHARACTER == _POSE


def is_place(key: int) -> bool:
    """Whether the variable begins with x and y in the frame of the world."""
    return key >> _CHARACTER in (_POSE, _POINT, _LANDMARK)


def is_of_keyframe(key: int) -> bool:
    """Whether the variable is a pose or a tilt, which a window loses with its keyframe."""
    return key >> _CHARACTER in (_POSE, _TILT)


def is_constant(key: int) -> bool:
    """Whether the variable is always there: constants, or a landmark."""
    return not is_of_keyframe(key) and not is_point(key)


def index_of(key: int) -> int:
    """The number of a pose, tilt, landmark or point."""
    return key & ((1 << _CHARACTER) - 1)


class Factor(Protocol):
    """A factor that :func:`jacobian_factors` accepts."""

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened, weighted residual (m,) and a Jacobian (m, d) for each variable."""

    def cost(self, values: Sequence[Array]) -> float:
        """The loss, robust if the factor is."""


class Stack(Protocol):
    """Factors of one kind on N poses in a row and on P parameters that all have in common, linearised by one call."""

    rows: int

    @property
    def first(self) -> Integers:
        """The number (M,) of the first pose that each of the ``rows`` residuals depends on."""

    def linearize(self, poses: Array, parameters: Array, jacobian: Array, residual: Array) -> None:
        """Fill ``residual`` (M,) and ``jacobian`` (M, 6 + P), see :mod:`factors.chain`, at ``poses`` (N, 3) and ``parameters``."""

    def cost(self, poses: Array, parameters: Array) -> float:
        """The loss of all."""


@runtime_checkable
class Stackable(Factor, Protocol):
    """A factor on one pose or on two consecutive ones, and perhaps on one vector. Many such factors become a stack."""

    @property
    def kind(self) -> Hashable:
        """Equal for factors of one type and vector that share a stack; None for a factor outside stacks."""

    def stack(self, factors: Sequence[Any], numbers: Sequence[int], column: int) -> Stack:
        """``factors`` of this type and kind as one, each on the pose with its number; ``column``: of the vector among the
        parameters."""


def pose_array(pose: gtsam.Pose2) -> Array:
    """A ``gtsam.Pose2`` as (x, y, heading)."""
    return np.array((pose.x(), pose.y(), pose.theta()))


def jacobian_factors(
    factors: Sequence[tuple[Factor, Sequence[int]] | tuple[Factor, Sequence[int], int]],
    values: Mapping[int, Array],
    on_failure: Callable[[str], None] | None = None,
) -> list[gtsam.GaussianFactor]:
    """Factors, each with the keys of its variables, linearised at ``values``.

    Factors whose ``alike`` is equal are linearised together, by ``linearize_all`` of their class, to residuals (N, m) and a
    Jacobian (N, m, d) for each of their variables.
    ``on_failure``: called with the reason where a residual or Jacobian is not finite or has a wrong shape, which then is zero.
    Each factor comes with the number of its residuals then. Factors that are alike are not checked.
    """
    out: list[Any] = []
    alike: defaultdict[Hashable, list[int]] = defaultdict(list)
    for i, (factor, keys, *rows) in enumerate(factors):
        if hasattr(factor, "alike"):
            alike[factor.alike].append(i)
            out.append(None)
            continue
        at = list(map(values.__getitem__, keys))
        linear = factor.linearize(at) if on_failure is None else _checked(factor, at, rows[0], on_failure)
        out.append(gaussian_factor(keys, *linear))
    for numbers in alike.values():
        some = [factors[i] for i in numbers]
        first: Any = some[0][0]
        residuals, blocks = first.linearize_all([f[0] for f in some], [[values[key] for key in f[1]] for f in some])
        for i, (_, keys, *_), residual, *parts in zip(numbers, some, residuals, *blocks, strict=True):
            out[i] = gaussian_factor(keys, residual, parts)
    return out


def gaussian_factor(keys: Sequence[int], residual: Array, blocks: Sequence[Array]) -> gtsam.GaussianFactor:
    """A linear factor from the whitened ``residual`` (m,) and a Jacobian (m, d) for each of its variables."""
    unit = _unit(len(residual))
    if len(blocks) > MOST_TERMS:
        return gtsam.GaussianConditional(list(zip(keys, blocks, strict=True)), 1, -residual, unit)
    arguments: list[Any] = [*chain.from_iterable(zip(keys, blocks, strict=True)), -residual, unit]
    return gtsam.JacobianFactor(*arguments)


@lru_cache(maxsize=256)
def _unit(size: int) -> gtsam.noiseModel.Unit:
    return gtsam.noiseModel.Unit.Create(size)


class PriorFactor:
    """A Gaussian prior of a pose: ``mean`` (3,) and the ``covariance`` (3, 3) of its body-frame perturbation."""

    def __init__(self, mean: Array, covariance: Array) -> None:
        self._mean = mean
        self._whitener = positive.whitener(covariance)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (3,) ``log(mean^-1 * pose)`` and its Jacobian."""
        error = se2.log(se2.between(self._mean, values[0]))
        return self._whitener @ error, [self._whitener @ se2.inverse_right_jacobian(error)]

    def cost(self, values: Sequence[Array]) -> float:
        """Half the squared whitened residual."""
        error = self._whitener @ se2.log(se2.between(self._mean, values[0]))
        return 0.5 * float(error @ error)


class VectorPriorFactor:
    """A Gaussian prior of a vector: ``mean`` (P,), and standard deviations (P,) or a covariance (P, P)."""

    def __init__(self, mean: Array, uncertainty: Array) -> None:
        self._mean = mean
        self._whitener = np.diag(1.0 / uncertainty) if uncertainty.ndim == 1 else positive.whitener(uncertainty)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (P,) and its Jacobian."""
        return self._whitener @ (values[0] - self._mean), [self._whitener]

    def cost(self, values: Sequence[Array]) -> float:
        """Half the squared whitened residual."""
        return 0.5 * float(np.sum((self._whitener @ (values[0] - self._mean)) ** 2))


def _checked(
    factor: Factor, values: Sequence[Array], rows: int, on_failure: Callable[[str], None]
) -> tuple[Array, list[Array]]:
    """A factor with ``rows`` residuals, linearised; zero where that fails."""
    try:
        residual, blocks = factor.linearize(values)
        # a product with zeros is not a number if any value is not finite
        total = np.vdot(residual, _zeros(residual.size))
        fits = residual.shape == (rows,) and len(blocks) == len(values)
        for block, value in zip(blocks, values, strict=False):
            fits = fits and block.shape == (rows, len(value))
            total += np.vdot(block, _zeros(block.size))
        if not fits:
            shapes = [part.shape for part in (residual, *blocks)]
            raise ValueError(f"shapes {shapes}, expected {rows} rows for {len(values)} variables")
        if not math.isfinite(total):
            raise ValueError("a residual or Jacobian is not finite")
    except (ValueError, FloatingPointError, np.linalg.LinAlgError) as failure:
        on_failure(str(failure))
        return np.zeros(rows), [np.zeros((rows, len(value))) for value in values]
    return residual, blocks


@lru_cache(maxsize=256)
def _zeros(size: int) -> Array:
    return np.zeros(size)


def retract(key: int, value: Array, step: Array) -> Array:
    """A variable moved by a step of its tangent space."""
    return se2.moved(value, step) if is_pose(key) else value + step


def frame_motions(values: Values) -> tuple[Array, list[int]]:
    """The tangent steps (n, 3) of all variables, stacked, when the world frame moves in x, in y, and about its origin; and the end
    row of each variable."""
    parts = []
    for key, value in values.items():
        part = np.zeros((len(value), 3))
        if is_place(key):
            part[:2] = (1.0, 0.0, -value[1]), (0.0, 1.0, value[0])
        if is_pose(key):
            c, s = math.cos(value[2]), math.sin(value[2])
            part[:2] = np.array(((c, s), (-s, c))) @ part[:2]
            part[2, 2] = 1.0
        parts.append(part)
    return np.vstack(parts), np.cumsum([len(part) for part in parts]).tolist()


def to_gtsam(values: Values) -> gtsam.Values:
    """The same as GTSAM holds them."""
    out = gtsam.Values()
    for key, value in values.items():
        out.insert(key, gtsam.Pose2(*value) if is_pose(key) else value)
    return out


def read(solver: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother, key: int) -> Array:
    """The estimate of a variable."""
    if is_pose(key):
        return pose_array(solver.calculateEstimatePose2(key))
    return np.asarray(solver.calculateEstimateVector(key), dtype=float)


def gather(values: Values, keys: Sequence[int]) -> list[Array]:
    """The values of several variables."""
    return [values[key] for key in keys]


@compiled(error_model="numpy")
def _whitened(lower: Array, vector: Array, out: Array) -> float:
    """Compute L^-1 v into ``out`` and return its squared norm."""
    squared = 0.0
    for i in range(len(vector)):
        total = vector[i]
        for k in range(i):
            total -= lower[i, k] * out[k]
        out[i] = total / lower[i, i]
        squared += out[i] * out[i]
    return squared


@compiled(error_model="numpy")
def _compressed(nll: float, gradient: Array, information: Array) -> tuple[Array, Array]:
    size, curvature, trace = len(gradient), information.copy(), 0.0
    residual, jacobian = np.empty(size + 1), np.zeros((size + 1, size))
    for i in range(size):
        trace += curvature[i, i]
    for i in range(size):
        curvature[i, i] += RELATIVE_RIDGE * trace / size + RIDGE
    lower, _ = cholesky(curvature)
    squared, floor = _whitened(lower, gradient, residual), max(2.0 * nll, LEAST)
    if squared > floor:
        raised = 1.0 / floor - 1.0 / squared
        for i in range(size):
            for j in range(size):
                curvature[i, j] += raised * gradient[i] * gradient[j]
        lower, _ = cholesky(curvature)
        squared = _whitened(lower, gradient, residual)
    residual[size] = math.sqrt(max(2.0 * nll - squared, 0.0))
    for i in range(size):
        for j in range(i + 1):
            jacobian[j, i] = lower[i, j]
    return residual, jacobian


def compressed(nll: float, gradient: Array, information: Array) -> tuple[Array, Array]:
    """Residual (d + 1,) and Jacobian (d + 1, d) of a cost ``nll`` >= 0 with ``gradient`` (d,) and symmetric positive semi-definite
    ``information`` (d, d). All are finite for any rank of the information.

    With the information H = L L^T the residual is ``[L^-1 g; sqrt(2 nll - g^T H^-1 g)]`` and its Jacobian ``[L^T; 0]``. Half its
    square is nll exactly, its gradient is g and its curvature H, so a least-squares solver takes the scoring step and evaluates
    the exact likelihood. The last row requires ``g^T H^-1 g <= 2 nll``: the minimum of the parabola must not be negative.
    Otherwise the curvature is raised along g to ``H + t g g^T`` with ``t = 1 / (2 nll) - 1 / (g^T H^-1 g)``.
    """
    arrays = np.ascontiguousarray(gradient, dtype=float), np.ascontiguousarray(information, dtype=float)
    residual, jacobian = _compressed(float(nll), *arrays)
    return residual, jacobian
