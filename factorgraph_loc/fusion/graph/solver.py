"""iSAM2 with the full history, and with a window that poses leave, behind one set of methods.

Our own factors are given to it as linear ones (:mod:`.linear_factors`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, Protocol, cast

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.linear_factors import LinearFactors
from factorgraph_loc.fusion.graph.summary import MarginalSummary, oldest_pose
from factorgraph_loc.fusion.graph.variables import (
    Node,
    Values,
    gtsam_errors,
    is_constant,
    is_point,
    is_pose,
    leaving_key,
    read,
    retract,
    to_gtsam,
)
from factors.graph import pose_array
from factors.positive_kernels import inverse
from factors.se2 import Array

_State = tuple[gtsam.NonlinearFactorGraph, gtsam.Values, Values, frozenset[int]]
# s that a pose may stay longer in a window, so that several are read at a time; less with points, which make it large
MARGIN, WITH_POINTS = 2.0, 1.0
FOREVER = 1e300  # s; a lag with which only the variables that are added to leave at once do so


class Solver(Protocol):
    """An incremental solver. Every method may raise RuntimeError; the solver is then lost."""

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        """Add factors and new variables with their guesses; ``t`` is the time of new poses."""

    def value(self, key: int) -> Array:
        """Estimate of a variable."""

    def covariance(self, key: int) -> Array:
        """Marginal covariance of a variable, poses in the body frame."""

    def estimates(self) -> gtsam.Values:
        """Estimates of all variables, to be :func:`read_all` if they are needed."""

    def linear(self) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
        """All factors, linearised where the solver has them, and the sizes of their variables by key."""

    def begin(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        """The first update, with the time of each variable, and with ``factors`` of GTSAM's besides."""

    @property
    def oldest(self) -> int:
        """The index of the oldest pose in the graph before the last update."""

    def summary(self, *, failed: bool) -> MarginalSummary | None:
        """What is known of all that is no more in the graph, before the last update if that ``failed``; None where all is there."""


class FullHistory:
    """Everything stays in the graph. ``threshold``: how far iSAM2 lets a variable move from where it is linearised, in m, rad or
    the units of constants.

    Constants are in all branches of iSAM2's tree, and in each update: to read an estimate it solves the whole tree for its
    variables. What the last update touched is at the root, and is solved for by itself.
    """

    def __init__(self, parameters: gtsam.ISAM2Params, threshold: float) -> None:
        parameters.setRelinearizeThreshold(threshold)
        self._isam = gtsam.ISAM2(parameters)
        self._ours = LinearFactors(threshold, parameters.relinearizeSkip, None)
        self._touched: Collection[int] = ()  # by the last update

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        self.begin((), nodes, values, {})
        self._touched = {key for node in nodes for key in node.keys}

    def begin(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        with gtsam_errors():
            graph, removed = self._ours.added(self._isam, factors, nodes, values)
            self._ours.place(self._isam.update(graph, to_gtsam(values), removed).getNewFactorsIndices())
        self._touched = ()

    @property
    def oldest(self) -> int:
        return 0

    def summary(self, *, failed: bool) -> MarginalSummary | None:
        return None

    def value(self, key: int) -> Array:
        with gtsam_errors():
            if key not in self._touched:
                return read(self._isam, key)
            step = np.linalg.solve(*self._isam.marginalFactor(key).jacobian())
            return retract(key, self._ours.at[key], np.asarray(step, dtype=float))

    def covariance(self, key: int) -> Array:
        with gtsam_errors():
            return np.asarray(self._isam.marginalCovariance(key))

    def estimates(self) -> gtsam.Values:
        self._touched = ()  # the whole tree is solved
        return self._isam.calculateEstimate()

    def linear(self) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
        return _linear(self._isam)


class Window:
    """Poses older than ``lag`` [s] are marginalised out with each update. One with which nothing leaves takes less time: iSAM2 then
    puts the newest pose at the root of its tree."""

    def __init__(
        self, parameters: gtsam.ISAM2Params, threshold: float, lag: float, on_failure: Callable[[str], None]
    ) -> None:
        parameters.setRelinearizeThreshold(threshold)
        self.lag = lag
        self._smoother = gtsam.IncrementalFixedLagSmoother(lag, parameters)
        self._ours = LinearFactors(threshold, parameters.relinearizeSkip, on_failure)
        self._stamps: dict[int, float] = {}  # of the variables that may leave
        # before the last update: all factors, where iSAM2 had the variables, where a new window begins, and which factors are ours
        self._before: _State = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}, frozenset()

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        # points leave when they are seen no more
        seen = (key for node in nodes for key in node.keys if is_point(key))
        self.begin((), nodes, values, dict.fromkeys((*values, *seen), t))

    def begin(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        self._before = self._state()
        self._stamps |= {key: t for key, t in stamps.items() if not is_constant(key)}
        now, lag = max(self._stamps.values()), FOREVER
        holding = _holding(factors, values)
        # GTSAM may fail where others leave in the same update
        leaving = [] if holding else [key for key, t in self._stamps.items() if t < now - self.lag]
        if leaving:
            stamps = {**stamps, **dict.fromkeys(filter(is_constant, self._ours.at), now)}
            lag = self.lag
        with gtsam_errors():
            graph, removed = self._ours.added(self._smoother, factors, nodes, values)
            start = to_gtsam(values)
            for key, factor in holding.items():
                graph.add(factor)
                start.insert(key, np.zeros(1))
            stamps = {**stamps, **dict.fromkeys(holding, -math.inf)}
            self._smoother.setSmootherLag(lag)
            self._smoother.update(graph, start, cast("Mapping[Any, Any]", stamps), removed)
            self._ours.place(self._smoother.getISAM2Result().getNewFactorsIndices())
        for key in leaving:
            del self._stamps[key]
            self._ours.forget(key)

    def value(self, key: int) -> Array:
        with gtsam_errors():
            return read(self._smoother, key)

    def covariance(self, key: int) -> Array:
        with gtsam_errors():
            return np.asarray(self._smoother.marginalCovariance(key))

    def covariances(self, keys: Sequence[int]) -> dict[int, Array]:
        """Marginal covariances by key, from one elimination of the window; none where that fails, or has lost one."""
        order = gtsam.Ordering()
        for key in keys:
            order.push_back(key)
        isam, found, end = self._smoother.getISAM2(), {}, 0
        try:
            factors = isam.getFactorsUnsafe().linearize(isam.getLinearizationPoint())
            joint, there = inverse(factors.marginal(keys).hessian(order)[0])
            for key in keys:
                start, end = end, end + len(self._ours.at[key])
                found[key] = joint[start:end, start:end].copy()
        except (RuntimeError, LookupError, ValueError):
            return {}
        return found if there else {}

    def estimates(self) -> gtsam.Values:
        return self._smoother.calculateEstimate()

    def linear(self) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
        return _linear(self._smoother.getISAM2())

    @property
    def oldest(self) -> int:
        return oldest_pose(self._before[0].keyVector())

    def summary(self, *, failed: bool) -> MarginalSummary | None:
        graph, held, at, ours = self._before if failed else self._state()
        return MarginalSummary.of(graph, held, at, ours) if graph.size() else None

    def _state(self) -> _State:
        """A copy of what the solver has, which changes in place."""
        held = gtsam.Values(self._smoother.getISAM2().getLinearizationPoint())
        return gtsam.NonlinearFactorGraph(self._smoother.getFactors()), held, self._ours.framed, self._ours.slots


def _holding(factors: Sequence[gtsam.NonlinearFactor], values: Values) -> dict[int, gtsam.NonlinearFactor]:
    """Factors that tell nothing, by the variables on which they are besides. As these leave the solver at once, iSAM2 takes what
    marginal ``factors`` are on for what it marginalised itself, and never linearises it elsewhere."""
    marginal = (factor.keys() for factor in factors if isinstance(factor, gtsam.LinearContainerFactor))
    held = dict.fromkeys(key for keys in marginal for key in keys)
    unit, out = gtsam.noiseModel.Unit.Create(1), dict[int, gtsam.NonlinearFactor]()
    for i, key in enumerate(held):
        nothing = np.zeros((1, len(values[key])))
        factor = gtsam.JacobianFactor(leaving_key(i), np.ones((1, 1)), key, nothing, np.zeros(1), unit)
        out[leaving_key(i)] = gtsam.LinearContainerFactor(factor)
    return out


def _linear(isam: gtsam.ISAM2) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
    at = isam.getLinearizationPoint()
    sizes = {key: 3 if is_pose(key) else len(at.atVector(key)) for key in at.keys()}  # noqa: SIM118
    return isam.getFactorsUnsafe().linearize(at), sizes


def read_all(values: gtsam.Values, keys: Iterable[int]) -> Values:
    """Those variables that GTSAM holds a value of."""
    return {
        key: pose_array(values.atPose2(key)) if is_pose(key) else np.asarray(values.atVector(key), dtype=float)
        for key in keys
        if values.exists(key)
    }
