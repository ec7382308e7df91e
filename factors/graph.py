"""Variables and factors of a graph, and their conversion to GTSAM.

A variable is a pose (3,) or a vector. A vector is the roll and pitch (2,) of the robot at a pose, the estimated
constants of a sensor, or the position of a landmark (2,) or of a point in space (3,).

A factor has the method ``linearize(values)``, whose values are arrays: poses (3,) and vectors (P,). It returns the
whitened residual with robust weights and one Jacobian per variable. The Jacobian of a pose is by its body-frame
perturbation. GTSAM gets each factor linearised, not as a callback. Callbacks would copy all variables, and an exception
in a callback leaves iSAM2 in an inconsistent state.
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

# The constructor of `gtsam.JacobianFactor` in Python accepts at most this number of variables.
MOST_TERMS = 3
# A fraction of the mean diagonal and a constant, which are added to an information matrix so that it is invertible.
RELATIVE_RIDGE, RIDGE = 1e-9, 1e-10
LEAST = 1e-12  # minimum of a divisor
Values = dict[int, Array]
GTSAM_ERRORS = (RuntimeError, IndexError, ValueError)  # all exceptions that GTSAM raises

_POSE, _TILT, _POINT, _LANDMARK = ord("x"), ord("t"), ord("p"), ord("l")
_CHARACTER = 56  # number of bits of a key below the character, which denotes the kind of variable


def pose_key(index: int) -> int:
    """Return the GTSAM key of the pose of keyframe ``index``."""
    return int(gtsam.symbol("x", index))


def tilt_key(index: int) -> int:
    """Return the GTSAM key of the robot's roll and pitch at keyframe ``index``."""
    return int(gtsam.symbol("t", index))


def constants_key(index: int) -> int:
    """Return the GTSAM key of the estimated constants of sensor number ``index``."""
    return int(gtsam.symbol("c", index))


def landmark_key(index: int) -> int:
    """Return the GTSAM key of landmark number ``index``, in order of first detection."""
    return int(gtsam.symbol("l", index))


def point_key(index: int) -> int:
    """Return the GTSAM key of point number ``index`` in space, in order of addition to the graph."""
    return int(gtsam.symbol("p", index))


def leaving_key(index: int) -> int:
    """Return the GTSAM key of auxiliary variable number ``index``. A fixed-lag smoother marginalises such a variable in
    the same update that adds it."""
    return int(gtsam.symbol("q", index))


def is_point(key: int) -> bool:
    """True if ``key`` is the key of a point in space."""
    return key >> _CHARACTER == _POINT


def is_landmark(key: int) -> bool:
    """True if ``key`` is the key of a landmark."""
    return key >> _CHARACTER == _LANDMARK


def is_pose(key: int) -> bool:
    """True if ``key`` is the key of a pose."""
    return key >> _CHARACTER == _POSE


def is_place(key: int) -> bool:
    """True if the first two components of the variable ``key`` are a position (x, y) in the world frame."""
    return key >> _CHARACTER in (_POSE, _POINT, _LANDMARK)


def is_of_keyframe(key: int) -> bool:
    """True for the key of a pose, or of roll and pitch. A fixed-lag smoother removes these with their keyframe."""
    return key >> _CHARACTER in (_POSE, _TILT)


def is_constant(key: int) -> bool:
    """True if ``key`` is the key of a landmark or of a vector of sensor constants. A smoother never removes these."""
    return not is_of_keyframe(key) and not is_point(key)


def index_of(key: int) -> int:
    """Return the ``index`` that the key of a pose, tilt, landmark or point was made from."""
    return key & ((1 << _CHARACTER) - 1)


class Factor(Protocol):
    """The interface of factors that :func:`jacobian_factors` converts to linear factors of GTSAM."""

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (m,) and one Jacobian (m, d) for each variable. ``values``: the value (d,) of
        each variable. Both results include the square root of the robust weight, if there is one."""

    def cost(self, values: Sequence[Array]) -> float:
        """Return the cost at the ``values`` (d,) of the variables. It includes the robust loss, if there is one."""


class Stack(Protocol):
    """Many factors of one kind that are linearised by one call, for speed. Each factor depends on one of N poses or on
    two consecutive poses. It also depends on some of P parameters of the graph, such as sensor constants. ``rows``: the
    number M of all residuals."""

    rows: int

    @property
    def first(self) -> Integers:
        """The index (M,) of the first pose that each of the M residuals depends on."""

    def linearize(self, poses: Array, parameters: Array, jacobian: Array, residual: Array) -> None:
        """Linearise at ``poses`` (N, 3) and ``parameters`` (P,). Writes the whitened ``residual`` (M,), and its
        ``jacobian`` (M, 6 + P) with respect to the first pose, the next pose, and the parameters."""

    def cost(self, poses: Array, parameters: Array) -> float:
        """Return the sum of the costs of all factors at ``poses`` (N, 3) and ``parameters`` (P,)."""


@runtime_checkable
class Stackable(Factor, Protocol):
    """A factor on one pose or on two consecutive poses, and optionally on one vector of parameters. Many such factors
    can be combined into a :class:`Stack`."""

    @property
    def kind(self) -> Hashable:
        """A hashable key. Factors of one class can be in one stack if they have equal keys and the same parameters.
        None if the factor must be linearised alone."""

    def stack(self, factors: Sequence[Any], numbers: Sequence[int], column: int) -> Stack:
        """Combine ``factors`` of this type and kind into one stack.

        ``numbers``: for each factor, the index of its pose. If it has two consecutive poses, this is the first.
        ``column``: the index of the first parameter of these factors in the parameters (P,) of the graph.
        """


def pose_array(pose: gtsam.Pose2) -> Array:
    """Return a ``gtsam.Pose2`` as an array (x, y, heading) [m, m, rad]."""
    return np.array((pose.x(), pose.y(), pose.theta()))


def jacobian_factors(
    factors: Sequence[tuple[Factor, Sequence[int]] | tuple[Factor, Sequence[int], int]],
    values: Mapping[int, Array],
    on_failure: Callable[[str], None] | None = None,
) -> list[gtsam.GaussianFactor]:
    """Linearise factors. Returns linear factors of GTSAM in the same order.

    ``factors``: tuples (factor, keys of its variables) or (factor, keys, number of its residuals). The number is needed
    only with ``on_failure``.
    ``values``: the value of each variable by key.
    ``on_failure``: is called with the reason if a residual or Jacobian is not finite or has a wrong shape. The linear
    factor is then zero. If ``on_failure`` is None, nothing is checked.

    Factors with equal attributes ``alike`` are linearised together by their class method ``linearize_all``, without a
    check. The method returns residuals (N, m) and a Jacobian (N, m, d) for each variable.
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
    """Return a linear factor of GTSAM. ``keys``: the variables. ``residual`` (m,): whitened. ``blocks``: one Jacobian
    (m, d) for each variable."""
    unit = _unit(len(residual))
    if len(blocks) > MOST_TERMS:
        return gtsam.GaussianConditional(list(zip(keys, blocks, strict=True)), 1, -residual, unit)
    arguments: list[Any] = [*chain.from_iterable(zip(keys, blocks, strict=True)), -residual, unit]
    return gtsam.JacobianFactor(*arguments)


@lru_cache(maxsize=256)
def _unit(size: int) -> gtsam.noiseModel.Unit:
    return gtsam.noiseModel.Unit.Create(size)


class PriorFactor:
    """A Gaussian prior of a pose. ``mean`` (3,): the expected pose. ``covariance`` (3, 3): its body-frame covariance.
    The methods take ``values``, a list of one pose (3,)."""

    def __init__(self, mean: Array, covariance: Array) -> None:
        self._mean = mean
        self._whitener = positive.whitener(covariance)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (3,) ``log(mean^-1 * pose)`` and a list of its Jacobian (3, 3). ``values``: a
        list of the pose (3,)."""
        error = se2.log(se2.between(self._mean, values[0]))
        return self._whitener @ error, [self._whitener @ se2.inverse_right_jacobian(error)]

    def cost(self, values: Sequence[Array]) -> float:
        """Return half the squared norm of the whitened residual at the pose. ``values``: a list of the pose (3,)."""
        error = self._whitener @ se2.log(se2.between(self._mean, values[0]))
        return 0.5 * float(error @ error)


class VectorPriorFactor:
    """A Gaussian prior of a vector. ``mean`` (P,): the expected value. ``uncertainty``: standard deviations (P,), or a
    covariance (P, P). The methods take ``values``, a list of one vector (P,)."""

    def __init__(self, mean: Array, uncertainty: Array) -> None:
        self._mean = mean
        self._whitener = np.diag(1.0 / uncertainty) if uncertainty.ndim == 1 else positive.whitener(uncertainty)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (P,) and a list of its Jacobian (P, P). ``values``: a list of the vector."""
        return self._whitener @ (values[0] - self._mean), [self._whitener]

    def cost(self, values: Sequence[Array]) -> float:
        """Return half the squared norm of the whitened residual. ``values``: a list of the vector (P,)."""
        return 0.5 * float(np.sum((self._whitener @ (values[0] - self._mean)) ** 2))


def _checked(
    factor: Factor, values: Sequence[Array], rows: int, on_failure: Callable[[str], None]
) -> tuple[Array, list[Array]]:
    """Return residual and Jacobians of a factor that must have ``rows`` residuals, at ``values``. If the result is not
    finite or has a wrong shape, call ``on_failure`` with the reason and return zeros."""
    try:
        residual, blocks = factor.linearize(values)
        # NaN or infinity times zero is NaN, so the product with zeros detects a value that is not finite
        total = np.vdot(residual, _zeros(residual.size))
        fits = residual.shape == (rows,) and len(blocks) == len(values)
        for block, value in zip(blocks, values, strict=False):
            fits = fits and block.shape == (rows, len(value))
            total += np.vdot(block, _zeros(block.size))
        if not fits:
            shapes = [part.shape for part in (residual, *blocks)]
            raise ValueError(
                f"a factor returns arrays of shapes {shapes}, expected {rows} rows and {len(values)} Jacobians"
            )
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
    """Return ``value`` after a ``step``. If ``key`` is the key of a pose, the step is a twist in the body frame.
    Otherwise it is added."""
    return se2.moved(value, step) if is_pose(key) else value + step


def frame_motions(values: Values) -> tuple[Array, list[int]]:
    """Return how all variables ``values`` change when the whole solution moves in the world frame (the gauge freedom).

    The first result (n, 3) stacks the changes of all variables, in the tangent space of each. Its columns belong to
    shifts in x and y, and a rotation about the origin. The second result has the index after the last row of each.
    """
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
    """Convert values to ``gtsam.Values``. Poses become ``gtsam.Pose2``."""
    out = gtsam.Values()
    for key, value in values.items():
        out.insert(key, gtsam.Pose2(*value) if is_pose(key) else value)
    return out


def read(solver: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother, key: int) -> Array:
    """Return the solver's estimate of the variable ``key``: a pose (3,) or a vector (P,)."""
    if is_pose(key):
        return pose_array(solver.calculateEstimatePose2(key))
    return np.asarray(solver.calculateEstimateVector(key), dtype=float)


def gather(values: Values, keys: Sequence[int]) -> list[Array]:
    """Return the values of the variables with these ``keys``, as a list in the order of the keys."""
    return [values[key] for key in keys]


@compiled(error_model="numpy")
def _whitened(lower: Array, vector: Array, out: Array) -> float:
    """Solve ``lower @ out = vector`` for a lower triangular matrix, write ``out``, and return its squared norm."""
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
    """Return the residual and the Jacobian of :func:`compressed`, from the same arguments as contiguous arrays."""
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
    """Convert a cost with derivatives to a residual (d + 1,) and a Jacobian (d + 1, d) for a least-squares solver.

    ``nll``: the cost, a negative log-likelihood of at least 0.
    ``gradient`` (d,): its gradient g.
    ``information`` (d, d): its Fisher information H, symmetric and positive semi-definite, of any rank.

    With H = L L^T the residual is ``[L^-1 g; sqrt(2 nll - g^T H^-1 g)]`` and its Jacobian is ``[L^T; 0]``. Half the
    squared residual is exactly nll, its gradient is g, and its curvature is H. A least-squares solver therefore takes
    the step of Fisher scoring and evaluates the exact likelihood. The last residual requires ``g^T H^-1 g <= 2 nll``:
    the minimum of the parabola must not be negative. Otherwise the curvature is raised along g to ``H + t g g^T`` with
    ``t = 1 / (2 nll) - 1 / (g^T H^-1 g)``. The results are always finite.
    """
    arrays = np.ascontiguousarray(gradient, dtype=float), np.ascontiguousarray(information, dtype=float)
    residual, jacobian = _compressed(float(nll), *arrays)
    return residual, jacobian
