"""A nonlinear least-squares problem of a whole graph, and its marginal covariances.

The problem is solved by Levenberg-Marquardt in Python. Factors are linearised in Python, because a callback from GTSAM
would copy all values. A run without loop closures and points is a chain of poses with common constants, which compiled
code solves (:mod:`factors.chain`). Any other graph is solved by GTSAM's sparse elimination.

Marginal covariances by Cholesky decomposition lose half of the digits, and long dead reckoning appears indeterminate. QR
decomposition is more accurate (Golub, van Loan, "Matrix Computations", section 5.3), and is used if Cholesky fails. If QR fails
too, a small fraction of each variable's information is added to its diagonal. This fraction is called damping.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import cast

import gtsam
import numpy as np

from factors import chain, se2
from factors.graph import (
    GTSAM_ERRORS,
    Factor,
    Stack,
    Stackable,
    Values,
    gather,
    gaussian_factor,
    index_of,
    is_pose,
    jacobian_factors,
    retract,
)
from factors.least_squares import LEAST, MAX_ITERATIONS, descended
from factors.se2 import Array

DAMPINGS = (0.0, 1e-10, 1e-7)  # are tried one after the other
# message of the event
DAMPED = "the measurements hardly determine some variables: their covariances needed a relative damping of {damping:g}"
_NEAR = re.compile(r"variable\s+(\d+)")  # the key in GTSAM's message about an indeterminate system
MOST_PARAMETERS = 40  # with more parameters, GTSAM's sparse elimination is faster than the chain solver
Placed = tuple[Factor, tuple[int, ...]]  # a factor with the keys of its variables
State = tuple[Array, Array]  # poses (N, 3), and parameters (P,)


class IndeterminateError(RuntimeError):
    """The error of a graph whose factors do not determine all variables. ``key``: the key of an undetermined variable,
    None if unknown."""

    def __init__(self, key: int | None) -> None:
        super().__init__("the solution is not determined")
        self.key = key


@dataclass(frozen=True)
class Covariances:
    """Marginal covariances of variables. ``by_key``: {key: covariance (d, d)}. ``damping``: the strength of an
    additional prior, as a fraction of the diagonal of the information matrix. It is 0 if none was needed to compute
    them."""

    by_key: dict[int, Array]
    damping: float


def covariances(graph: gtsam.GaussianFactorGraph, sizes: Mapping[int, int], keys: Sequence[int]) -> Covariances:
    """Return the marginal covariances of the variables ``keys`` of a linear ``graph``. ``sizes``: the number of
    components of each variable of the graph, by key. Raises IndeterminateError if the graph does not determine a
    variable, even with weak priors."""
    result = _solved(graph, keys, robust=False)
    if isinstance(result, dict):
        return Covariances(result, 0.0)
    for damping in DAMPINGS:
        result = _solved(_damped(graph, sizes, damping) if damping else graph, keys, robust=True)
        if isinstance(result, dict):
            return Covariances(result, damping)
    raise result


def blamed(error: Exception) -> int | None:
    """Return the key of the variable that is not determined, if ``error`` (an exception of GTSAM or IndeterminateError)
    names it, otherwise None."""
    if isinstance(error, IndeterminateError):
        return error.key
    near = _NEAR.search(str(error))
    return None if near is None else int(near.group(1))


def _solved(
    graph: gtsam.GaussianFactorGraph, keys: Sequence[int], *, robust: bool
) -> dict[int, Array] | IndeterminateError:
    """Return {key: marginal covariance} of the variables ``keys`` of a linear graph. If the graph cannot be solved,
    return the error instead of raising it. ``robust``: True to use QR instead of Cholesky."""
    order = gtsam.Ordering.OrderingType.COLAMD
    marginals: dict[int, Array] = {}
    try:
        if not robust:
            tree = graph.eliminateMultifrontal(order)
            marginals = {key: np.asarray(tree.marginalCovariance(key)) for key in keys}
        else:
            tree = graph.eliminateMultifrontal(order, gtsam.EliminateQR)
            for key in keys:
                conditional = tree.marginalFactor(key, gtsam.EliminateQR)  # R() is a view of its memory
                root = np.linalg.inv(conditional.R())
                marginals[key] = np.asarray(root @ root.T, dtype=float)
    except (RuntimeError, IndexError) as error:  # IndexError: a variable without factors
        return IndeterminateError(blamed(error))
    except np.linalg.LinAlgError:
        return IndeterminateError(key)
    for key, covariance in marginals.items():
        if not (np.all(np.isfinite(covariance)) and np.all(np.diag(covariance) > 0.0)):
            return IndeterminateError(key)
    return marginals


def _damped(graph: gtsam.GaussianFactorGraph, sizes: Mapping[int, int], damping: float) -> gtsam.GaussianFactorGraph:
    """Return the linear ``graph`` with a prior on each variable. The information of a prior is ``damping`` times the
    diagonal of the graph's information. ``sizes``: the number of components of each variable by key."""
    keys, (_, columns, values) = graph.keyVector(), graph.sparseJacobian_()
    ends = np.cumsum([sizes[key] for key in keys])
    # the last column is the right side of the equations
    information = np.bincount(columns.astype(np.int64) - 1, values**2, int(ends[-1]) + 1)[:-1]
    out = gtsam.GaussianFactorGraph()
    out.push_back(graph)
    for key, own in zip(keys, np.split(np.sqrt(damping * information), ends[:-1]), strict=True):
        out.add(gtsam.JacobianFactor(key, np.diag(own), np.zeros(len(own)), gtsam.noiseModel.Unit.Create(len(own))))
    return out


class Chained:
    """A least-squares problem on a chain of poses. Each factor depends on one pose or on two consecutive poses, and
    optionally on vectors, such as sensor constants. ``factors``: pairs of a factor and the keys of its variables."""

    def __init__(self, factors: Sequence[Placed]) -> None:
        keys = {key for _, of in factors for key in of}
        self._poses = sorted((key for key in keys if is_pose(key)), key=index_of)
        self._vectors = sorted(keys - set(self._poses))
        self._factors = factors
        self._stacks: list[Stack] = []
        self._columns: dict[int, slice] = {}

    @property
    def fits(self) -> bool:
        """True if each factor depends on one pose or on two consecutive poses. Otherwise this class cannot solve the
        problem."""
        place = {key: i for i, key in enumerate(self._poses)}
        for _, keys in self._factors:
            numbers = [place[key] for key in keys if key in place]
            if len(numbers) > 2 or (len(numbers) == 2 and numbers[1] != numbers[0] + 1):
                return False
        return bool(self._poses)

    def begin(self, values: Values) -> State | None:
        """Return ``values``, which are by key, as a state: poses (N, 3), and all vectors joined to one array (P,).
        Returns None if P is too large for this solver."""
        ends = np.cumsum([0, *(len(values[key]) for key in self._vectors)]).tolist()
        if ends[-1] > MOST_PARAMETERS:
            return None
        if not self._stacks:
            self._columns = {key: slice(a, b) for key, a, b in zip(self._vectors, ends[:-1], ends[1:], strict=True)}
            self._stacks = self._stacked(values)
            self._first = np.concatenate([stack.first for stack in self._stacks])
        parameters = np.concatenate([np.zeros(0), *(values[key] for key in self._vectors)])
        return np.array([values[key] for key in self._poses]), parameters

    def values(self, state: State) -> Values:
        """Return the values of ``state``, which has the form of :meth:`begin`, by key."""
        poses, parameters = state
        vectors = {key: parameters[columns] for key, columns in self._columns.items()}
        return dict(zip(self._poses, poses, strict=True)) | vectors

    def cost(self, state: State) -> float:
        return sum(stack.cost(*state) for stack in self._stacks)

    def system(self, state: State) -> chain.System:
        """Return the normal equations of the problem, linearised at a state from :meth:`begin`."""
        poses, parameters = state
        jacobian, residual = np.zeros((len(self._first), 6 + len(parameters))), np.zeros(len(self._first))
        begin = 0
        for stack in self._stacks:
            rows = slice(begin, begin + stack.rows)
            stack.linearize(poses, parameters, jacobian[rows], residual[rows])
            begin += stack.rows
        return chain.normal(len(poses), self._first, jacobian, residual)

    def moved(self, state: State, damping: float) -> tuple[State, float] | None:
        """Return ``state`` after a Levenberg-Marquardt step, and the step's largest component. ``damping``: this factor
        times the Hessian's diagonal is added to the Hessian. Returns None if the normal equations are nearly
        singular."""
        try:
            is_solved, poses, parameters = chain.solved(self.system(state), damping)
        except np.linalg.LinAlgError:
            return None
        if not is_solved:
            return None
        largest = max(np.abs(poses).max(initial=0.0), np.abs(parameters).max(initial=0.0))
        return (se2.compose(state[0], se2.exp(poses)), state[1] + parameters), float(largest)

    def covariances(self, values: Values) -> Covariances | None:
        """Return the marginal covariances of all variables at ``values``. Returns None if this solver cannot compute
        them accurately."""
        state = self.begin(values)
        if state is None:
            return None
        try:
            is_solved, of_poses, of_parameters = chain.covariances(self.system(state))
        except np.linalg.LinAlgError:
            return None
        variances = np.concatenate((np.diagonal(of_poses, axis1=1, axis2=2).ravel(), np.diag(of_parameters)))
        if not (is_solved and np.all(np.isfinite(variances)) and np.all(variances > 0.0)):
            return None
        shared = {key: of_parameters[columns, columns] for key, columns in self._columns.items()}
        return Covariances(dict(zip(self._poses, of_poses, strict=True)) | shared, 0.0)

    def _stacked(self, values: Values) -> list[Stack]:
        """Return all factors, grouped so that the factors of a group can be linearised together."""
        place = {key: i for i, key in enumerate(self._poses)}
        kinds: defaultdict[Hashable, list[Placed]] = defaultdict(list)
        for factor, keys in self._factors:
            kinds[_kind(factor, keys)].append((factor, keys))
        stacks: list[Stack] = []
        for placed in kinds.values():
            first, keys = placed[0]
            if _kind(first, keys) is None:
                stacks.append(_Others(placed, place, self._columns))
                continue
            assert isinstance(first, Stackable)
            numbers = [place[keys[0]] for _, keys in placed]
            column = next((self._columns[key].start for key in keys if key in self._columns), 0)
            stacks.append(first.stack([factor for factor, _ in placed], numbers, column))
        return stacks


def _kind(factor: Factor, keys: tuple[int, ...]) -> Hashable:
    """Return a key that groups factors: factors with equal keys can be linearised together. The key is None for a
    factor that must be linearised alone. ``keys``: the keys of the factor's variables."""
    kind = cast(Stackable, factor).kind if _is_stackable(type(factor)) else None
    return None if kind is None else (type(factor), kind, *[key for key in keys if not is_pose(key)])


@cache
def _is_stackable(kind: type[Factor]) -> bool:
    """Return True if factors of the class ``kind`` can be linearised together. The result is cached."""
    return hasattr(kind, "kind") and hasattr(kind, "stack")


class _Others:
    """A group of factors of different classes, each linearised separately. ``placed``: pairs of a factor and the keys
    of its variables. ``place``: the index of each pose by key. ``columns``: the indices of each vector's parameters by
    key."""

    def __init__(self, placed: Sequence[Placed], place: dict[int, int], columns: dict[int, slice]) -> None:
        self._placed, self._place, self._columns = placed, place, columns
        poses, parameters = np.zeros((len(place), 3)), np.zeros(max((c.stop for c in columns.values()), default=0))
        sizes = [len(factor.linearize(self._at(keys, poses, parameters))[0]) for factor, keys in placed]
        numbers = [next((place[key] for key in keys if key in place), 0) for _, keys in placed]
        self.first = np.repeat(np.array(numbers, dtype=np.int64), sizes)
        self.rows = sum(sizes)

    def linearize(self, poses: Array, parameters: Array, jacobian: Array, residual: Array) -> None:
        begin = 0
        for factor, keys in self._placed:
            error, blocks = factor.linearize(self._at(keys, poses, parameters))
            rows, first = slice(begin, begin + len(error)), True
            residual[rows] = error
            for key, block in zip(keys, blocks, strict=True):
                if key in self._place:
                    jacobian[rows, slice(0, 3) if first else slice(3, 6)] = block
                    first = False
                else:
                    columns = self._columns[key]
                    jacobian[rows, 6 + columns.start : 6 + columns.stop] = block
            begin = rows.stop

    def cost(self, poses: Array, parameters: Array) -> float:
        return sum(factor.cost(self._at(keys, poses, parameters)) for factor, keys in self._placed)

    def _at(self, keys: tuple[int, ...], poses: Array, parameters: Array) -> list[Array]:
        return [poses[self._place[key]] if key in self._place else parameters[self._columns[key]] for key in keys]


@dataclass(frozen=True)
class Solution:
    """A solution of a least-squares problem. ``values``: the values of all variables by key. ``cost``: the sum of
    robust losses."""

    values: Values
    cost: float


class Problem:
    """A nonlinear least-squares problem. ``factors``: pairs of a factor and the keys of its variables."""

    def __init__(self, factors: Sequence[tuple[Factor, tuple[int, ...]]]) -> None:
        self._factors = factors

    @cached_property
    def _chain(self) -> Chained | None:
        """The problem as a chain of poses, or None if it is not a chain."""
        chain = Chained(self._factors)
        return chain if chain.fits else None

    def solve(self, values: Values, max_iterations: int = MAX_ITERATIONS) -> Solution:
        """Return a local optimum near the initial ``values``, or the best values after ``max_iterations``, with their
        cost."""
        chain = self._chain
        begin = None if chain is None else chain.begin(values)
        if chain is not None and begin is not None:
            state, cost, _ = descended(chain.cost, chain.moved, begin, max_iterations)
            return Solution(values | chain.values(state), cost)
        return Solution(*descended(self.cost, self._moved, values, max_iterations)[:2])

    def _moved(self, values: Values, damping: float) -> tuple[Values, float] | None:
        """Return ``values`` after a Levenberg-Marquardt step, and the step's largest component. ``damping``: this
        factor times the Hessian's diagonal is added to the Hessian. Returns None if the problem is nearly singular."""
        linear = self.linearize(values)
        curvature = {key: np.full(len(value), LEAST) for key, value in values.items()}
        for i in range(linear.size()):
            factor = linear.at(i)
            columns, end = np.square(factor.jacobian()[0]).sum(axis=0), 0
            for key in factor.keys():  # noqa: SIM118
                begin, end = end, end + len(curvature[key])
                curvature[key] += columns[begin:end]
        for key, diagonal in curvature.items():
            linear.add(gaussian_factor((key,), np.zeros(len(diagonal)), (np.diag(np.sqrt(damping * diagonal)),)))
        try:
            step = linear.optimize()
        except GTSAM_ERRORS:
            return None
        largest = max((float(np.abs(step.at(key)).max()) for key in values), default=0.0)
        return {key: retract(key, value, step.at(key)) for key, value in values.items()}, largest

    def cost(self, values: Values) -> float:
        """Return the sum of robust losses at ``values``. It is infinite if a loss is NaN."""
        cost = sum(factor.cost(gather(values, keys)) for factor, keys in self._factors)
        return math.inf if math.isnan(cost) else cost

    def linearize(self, values: Values) -> gtsam.GaussianFactorGraph:
        """Return all factors as a linear graph, linearised at ``values`` with their robust weights."""
        graph = gtsam.GaussianFactorGraph()
        for factor in jacobian_factors(self._factors, values):
            graph.add(factor)
        return graph

    def covariances(self, values: Values, keys: Iterable[int]) -> Covariances:
        """Return the marginal covariances of the variables ``keys`` at the solution ``values``. The result may contain
        further variables. The covariance of a pose is in the body frame. Raises IndeterminateError if a variable is not
        determined."""
        marginals = None if self._chain is None else self._chain.covariances(values)
        if marginals is not None:
            return marginals
        return covariances(self.linearize(values), {key: len(value) for key, value in values.items()}, list(keys))
