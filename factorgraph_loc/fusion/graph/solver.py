"""iSAM2 with the full history, and with a window that poses leave, behind one set of methods.

Our own factors are given to it as linear ones (:mod:`.linear_factors`).

GTSAM marginalises a variable into linear factors on those that it shared factors with. They and the priors hold all that the
window's own measurements do not tell, correlations included: a window that is built anew begins with them. Marginals of single
variables in their place would count the measurements among them twice, and lose what they have in common.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.linear_factors import LinearFactors
from factorgraph_loc.fusion.graph.variables import (
    GTSAM_ERRORS,
    Node,
    Values,
    index_of,
    is_constant,
    is_of_keyframe,
    is_point,
    is_pose,
    leaving_key,
    read,
    retract,
    to_gtsam,
)
from factors.positive_kernels import inverse
from factors.se2 import Array

KINDS = (gtsam.LinearContainerFactor, gtsam.PriorFactorPose2, gtsam.PriorFactorVector)
# s that a pose may stay longer in a window, so that several are read at a time; less with points, which make it large
MARGIN, WITH_POINTS = 2.0, 1.0
FOREVER = 1e300  # s; a lag with which only the variables that are added to leave at once do so


class FullHistory:
    """An incremental solver from whose graph nothing leaves. Methods may raise errors of GTSAM; the solver is then lost.

    ``threshold``: how far iSAM2 lets a variable move from where it is linearised, in m, rad or the units of constants.
    ``on_failure``: called with the reason where a factor cannot be linearised, which is then left out.

    Constants are in all branches of iSAM2's tree, and in each update: to read an estimate it solves the whole tree for its
    variables. What the last update touched is at the root, and is solved for by itself.
    """

    _solver: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother

    def __init__(self, parameters: gtsam.ISAM2Params, threshold: float, on_failure: Callable[[str], None]) -> None:
        parameters.setRelinearizeThreshold(threshold)
        self._isam = self._solver = gtsam.ISAM2(parameters)
        self._ours = LinearFactors(threshold, parameters.relinearizeSkip, on_failure)
        self._touched: Collection[int] = ()  # by the last update

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        """Add factors and new variables with their guesses; ``t`` is the time of new poses."""
        self.begin((), nodes, values, {})
        self._touched = {key for node in nodes for key in node.keys}

    def begin(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        """The first update, with the time of each variable, and with ``factors`` of GTSAM's besides."""
        graph, removed = self._ours.added(self._isam, factors, nodes, values)
        self._ours.place(self._isam.update(graph, to_gtsam(values), removed).getNewFactorsIndices())
        self._touched = ()

    @property
    def oldest(self) -> int:
        """The number of the oldest pose that a new solver would begin with after a failure."""
        return 0

    def summary(self, *, failed: bool) -> MarginalSummary | None:
        """What is known of all that is no more in the graph, from before the last update if that ``failed``; None where all is
        there."""
        return None

    def value(self, key: int) -> Array:
        """Estimate of a variable."""
        if key not in self._touched:
            return read(self._isam, key)
        step = np.linalg.solve(*self._isam.marginalFactor(key).jacobian())
        return retract(key, self._ours.at[key], step)

    def covariance(self, key: int) -> Array:
        """Marginal covariance of a variable, poses in the body frame."""
        return np.asarray(self._solver.marginalCovariance(key))

    def linear(self) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
        """All factors, linearised where the solver has them, and the sizes of their variables by key."""
        isam = self._solver if isinstance(self._solver, gtsam.ISAM2) else self._solver.getISAM2()
        at = isam.getLinearizationPoint()
        sizes = {key: 3 if is_pose(key) else len(at.atVector(key)) for key in at.keys()}  # noqa: SIM118
        return isam.getFactorsUnsafe().linearize(at), sizes


_State = tuple[gtsam.NonlinearFactorGraph, gtsam.Values, Values, frozenset[int]]


class Window(FullHistory):
    """Poses older than ``lag`` [s] are marginalised out with each update. One with which nothing leaves takes less time: iSAM2 then
    puts the newest pose at the root of its tree."""

    _solver: gtsam.IncrementalFixedLagSmoother

    def __init__(
        self, parameters: gtsam.ISAM2Params, threshold: float, on_failure: Callable[[str], None], lag: float
    ) -> None:
        parameters.setRelinearizeThreshold(threshold)
        self.lag = lag
        self._solver = gtsam.IncrementalFixedLagSmoother(lag, parameters)
        self._ours = LinearFactors(threshold, parameters.relinearizeSkip, on_failure)
        self._stamps: dict[int, float] = {}  # of the variables that may leave
        # when something last left: all factors, where iSAM2 had the variables, where a new window would have them, and which
        # factors are ours
        self._left: _State = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}, frozenset()

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        # points leave when they are seen no more
        stamps = dict.fromkeys(values, t)
        for node in nodes:
            for key in node.keys:
                if is_point(key):
                    stamps[key] = t
        self._add((), nodes, values, stamps)

    def begin(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        self._add(factors, nodes, values, stamps)
        self._left = self._state()

    def _add(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        for key, t in stamps.items():
            if not is_constant(key):
                self._stamps[key] = t
        now, lag = max(self._stamps.values()), FOREVER
        graph, removed = self._ours.added(self._solver, factors, nodes, values)
        start, leaving = to_gtsam(values), []
        holding = _holding(factors, values) if factors else {}
        if holding:
            for key, factor in holding.items():
                graph.add(factor)
                start.insert(key, np.zeros(1))
            stamps = {**stamps, **dict.fromkeys(holding, -math.inf)}
        elif min(self._stamps.values()) < now - self.lag:  # GTSAM may fail where others leave in the same update
            leaving = [key for key, t in self._stamps.items() if t < now - self.lag]
            stamps = {**stamps, **dict.fromkeys(filter(is_constant, self._ours.at), now)}
            lag = self.lag
        self._solver.setSmootherLag(lag)
        self._solver.update(graph, start, cast("Mapping[Any, Any]", stamps), removed)
        self._ours.place(self._solver.getISAM2Result().getNewFactorsIndices())
        for key in leaving:
            del self._stamps[key]
            self._ours.forget(key)
        if leaving:
            self._left = self._state()

    def value(self, key: int) -> Array:
        return read(self._solver, key)

    def covariances(self, keys: Sequence[int]) -> dict[int, Array]:
        """Marginal covariances by key, from one elimination of the window; none where that fails, or has lost one."""
        order = gtsam.Ordering()
        for key in keys:
            order.push_back(key)
        found, end = {}, 0
        try:
            joint, there = inverse(self.linear()[0].marginal(keys).hessian(order)[0])
            for key in keys:
                start, end = end, end + len(self._ours.at[key])
                found[key] = joint[start:end, start:end].copy()
        except (*GTSAM_ERRORS, LookupError):
            return {}
        return found if there else {}

    @property
    def oldest(self) -> int:
        return oldest_pose(self._left[0].keyVector())

    def summary(self, *, failed: bool) -> MarginalSummary | None:
        graph, held, at, ours = self._left if failed else self._state()
        return MarginalSummary.of(graph, held, at, ours) if graph.size() else None

    def _state(self) -> _State:
        """A copy of what the solver has, which changes in place."""
        held = gtsam.Values(self._solver.getISAM2().getLinearizationPoint())
        return gtsam.NonlinearFactorGraph(self._solver.getFactors()), held, self._ours.framed, self._ours.slots


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


def oldest_pose(keys: Iterable[int]) -> int:
    """The index of the oldest pose among ``keys``, 0 if there is none."""
    return min((index_of(key) for key in keys if is_pose(key)), default=0)


@dataclass(frozen=True)
class MarginalSummary:
    """``factors``: marginal ones, and priors; ``keys`` of all variables of the graph; ``at``: where each is linearised."""

    factors: tuple[gtsam.NonlinearFactor, ...]
    keys: frozenset[int]
    at: Values

    @classmethod
    def of(
        cls, graph: gtsam.NonlinearFactorGraph, held: gtsam.Values, at: Values, ours: Collection[int] = ()
    ) -> MarginalSummary:
        """Of a graph that iSAM2 has linearised where it ``held`` the variables, to be linearised ``at`` there. ``ours``: places of
        factors of our own, which are not marginal ones."""
        every = (graph.at(i) for i in range(graph.size()) if i not in ours)
        there = to_gtsam(at)

        def placed(factor: gtsam.LinearContainerFactor) -> gtsam.LinearContainerFactor:
            """iSAM2 never moves what a marginal factor is on, and so gives it no place: elsewhere it needs one."""
            return gtsam.LinearContainerFactor(
                gtsam.LinearContainerFactor(factor.factor(), held).linearize(there), there
            )

        kept = tuple(
            placed(f) if isinstance(f, gtsam.LinearContainerFactor) else f for f in every if isinstance(f, KINDS)
        )
        return cls(kept, frozenset(graph.keyVector()), at)

    @property
    def oldest(self) -> int:
        """The index of the oldest pose."""
        return oldest_pose(self.keys)

    def before(self, pose: int) -> MarginalSummary:
        """What is left once the poses from the index ``pose`` on are taken back: others come under their keys."""
        kept = frozenset(key for key in self.keys if not is_of_keyframe(key) or index_of(key) < pose)
        return MarginalSummary(tuple(self.on(kept)), kept, {key: self.at[key] for key in kept})

    def on(self, present: Collection[int]) -> list[gtsam.NonlinearFactor]:
        """The factors on variables that are ``present``, with all that those on others tell of these."""
        kept: list[gtsam.NonlinearFactor] = []
        linear, gone, at = gtsam.GaussianFactorGraph(), set[int](), to_gtsam(self.at)
        for factor in self.factors:
            absent = [key for key in factor.keys() if key not in present]  # noqa: SIM118
            gone.update(absent)
            if absent:
                linear.add(factor.linearize(at))
            else:
                kept.append(factor)
        if gone:
            order = gtsam.Ordering()
            for key in sorted(gone):
                order.push_back(key)
            _, rest = linear.eliminatePartialMultifrontal(order)
            kept += [gtsam.LinearContainerFactor(rest.at(i), at) for i in range(rest.size())]
        return kept


def is_missing(node: Node, present: Collection[int], known: Collection[int]) -> bool:
    """Whether a factor is to be added to a graph of the variables ``present``, of which a summary tells those that are ``known``:
    it holds priors of what is no pose, and what hangs on a pose that is gone."""
    if any(key not in present for key in node.keys):
        return False
    return node.has_pose or node.keys[0] not in known
