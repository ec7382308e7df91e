"""Two incremental solvers with one interface: iSAM2 with the full history, and iSAM2 with a window (fixed-lag smoother).

Callbacks from GTSAM would copy all variables for each factor. Therefore this module linearises the factors of measurements at the
linearisation points of iSAM2. When iSAM2 moves a linearisation point, all factors on the variable are replaced in the same update.
Otherwise the factors would disagree on the effect of a rotation of the whole graph, and would contain false information on the
heading (Huang, Mourikis, Roumeliotis, International Journal of Robotics Research 29(5), 2010).

Marginal factors are linear and cannot be linearised again, so iSAM2 holds the linearisation points of their variables. A factor of
a measurement that is linearised far from the estimate is meaningless. Such factors are therefore linearised at the estimate. Their
Jacobian is replaced by the nearest one that agrees with the marginal factors on rotations and translations of the whole graph
(Hesch, Kottas, Bowman, Roumeliotis, IEEE Transactions on Robotics 30(1), 2014, section V). To make this change small, all held
points may follow the estimates by one common translation, which does not change the information of marginal factors.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, cast

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.graph import Node
from factorgraph_loc.fusion.graph.summary import MarginalSummary, oldest_pose
from factors.gaussian import invert_covariance
from factors.graph import (
    GTSAM_ERRORS,
    Values,
    frame_motions,
    gaussian_factor,
    is_constant,
    is_place,
    is_point,
    is_pose,
    jacobian_factors,
    leaving_key,
    read,
    retract,
    to_gtsam,
)
from factors.se2 import Array

# s; poses stay longer in a window than the lag, so that several leave together. The second value is for windows with points.
MARGIN, WITH_POINTS = 2.0, 1.0
FOREVER = 1e300  # s; with this lag only variables with the time minus infinity leave a window


class FullHistory:
    """An incremental solver that keeps all poses. After a method raises an error of GTSAM, discard the solver.

    ``threshold``: a variable is linearised again after it has changed by this value, in m, rad or the units of
    constants. ``on_failure``: a function that is called with the reason if a factor cannot be linearised. The factor is
    then left out.
    """

    _solver: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother

    def __init__(self, parameters: gtsam.ISAM2Params, threshold: float, on_failure: Callable[[str], None]) -> None:
        parameters.setRelinearizeThreshold(threshold)
        self._isam = self._solver = gtsam.ISAM2(parameters)
        self._ours = LinearFactors(threshold, parameters.relinearizeSkip, on_failure)
        self._touched: Collection[int] = ()  # the keys of variables in the last update

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        """Add the factors ``nodes`` and new variables, and solve. ``values``: initial values of the new variables by
        key. ``t`` [s]: the time of the new poses."""
        self.begin((), nodes, values, {})
        touched = {key for node in nodes for key in node.keys}
        self._touched = () if any(map(is_point, touched)) else touched

    def begin(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        """Add the first factors and variables to a new solver, and solve. ``factors``: of GTSAM, such as priors.
        ``nodes``: factors of measurements. ``values``: initial values by key. ``stamps``: the time [s] of each variable
        by key."""
        graph, removed = self._ours.added(self._isam, factors, nodes, values)
        self._ours.place(self._isam.update(graph, to_gtsam(values), removed).getNewFactorsIndices())
        self._touched = ()

    @property
    def oldest(self) -> int:
        """The index of the oldest pose that is needed to rebuild the solver after a failure."""
        return 0

    def summary(self, *, failed: bool) -> MarginalSummary | None:
        """Return the marginal factors that replace the variables removed from the solver. Returns None if no variable
        was removed. ``failed``: True if the last update failed. The result is then from before this update."""
        return None

    def value(self, key: int) -> Array:
        """Return the present estimate of the variable ``key``."""
        if key not in self._touched:
            return read(self._isam, key)
        step = np.linalg.solve(*self._isam.marginalFactor(key).jacobian())
        return retract(key, self._ours.at[key], np.asarray(step, dtype=float))

    def covariance(self, key: int) -> Array:
        """Return the marginal covariance of the variable ``key``. The covariance of a pose is in the body frame."""
        return np.asarray(self._solver.marginalCovariance(key))

    def linear(self) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
        """Return all factors as one linear graph, and the number of components of each variable by key."""
        isam = self._solver if isinstance(self._solver, gtsam.ISAM2) else self._solver.getISAM2()
        at = isam.getLinearizationPoint()
        sizes = {key: 3 if is_pose(key) else len(at.atVector(key)) for key in at.keys()}  # noqa: SIM118
        return isam.getFactorsUnsafe().linearize(at), sizes


# A copy of a window's state: all factors, the linearisation points of iSAM2, the linearisation points for a rebuilt window, and the
# indices of the measurements' factors.
_State = tuple[gtsam.NonlinearFactorGraph, gtsam.Values, Values, frozenset[int]]


class Window(FullHistory):
    """A fixed-lag smoother: each update marginalises poses that are older than ``lag`` [s]. An update without such
    poses is faster, because iSAM2 then puts the newest pose at the root of its elimination tree."""

    _solver: gtsam.IncrementalFixedLagSmoother

    def __init__(
        self, parameters: gtsam.ISAM2Params, threshold: float, on_failure: Callable[[str], None], lag: float
    ) -> None:
        super().__init__(parameters, threshold, on_failure)
        self.lag = lag
        self._solver = gtsam.IncrementalFixedLagSmoother(lag, parameters)
        self._stamps: dict[int, float] = {}  # s; the time of each variable that may leave
        # the state after the first update or after the last marginalisation
        self._left: _State = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}, frozenset()

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        stamps = dict.fromkeys(values, t)
        for node in nodes:
            if is_point(node.keys[-1]):  # the time of a point is the time of its last observation
                stamps[node.keys[-1]] = t
        self.begin((), nodes, values, stamps)

    def begin(
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
        # In the update that adds the auxiliary variables of `_holding`, no variable of the window leaves: GTSAM could fail.
        elif min(self._stamps.values()) < now - self.lag:
            leaving = [key for key, t in self._stamps.items() if t < now - self.lag]
            stamps = {**stamps, **dict.fromkeys(filter(is_constant, self._ours.at), now)}
            lag = self.lag
        self._solver.setSmootherLag(lag)
        self._solver.update(graph, start, cast("Mapping[Any, Any]", stamps), removed)
        self._ours.place(self._solver.getISAM2Result().getNewFactorsIndices())
        for key in leaving:
            del self._stamps[key]
            self._ours.forget(key)
        if leaving or not self._left[0].size():
            self._left = self._state()

    def value(self, key: int) -> Array:
        return read(self._solver, key)

    def covariances(self, keys: Sequence[int]) -> dict[int, Array]:
        """Return the marginal covariances of the variables ``keys``, by key. They are computed together by one
        elimination. The result is empty if the elimination fails, or if a variable is no longer in the solver."""
        order = gtsam.Ordering()
        for key in keys:
            order.push_back(key)
        marginals, end = {}, 0
        try:
            joint = invert_covariance(self.linear()[0].marginal(keys).hessian(order)[0])
            for key in keys:
                start, end = end, end + len(self._ours.at[key])
                marginals[key] = joint[start:end, start:end].copy()
        except (*GTSAM_ERRORS, LookupError, np.linalg.LinAlgError):
            return {}
        return marginals

    @property
    def oldest(self) -> int:
        return oldest_pose(self._left[0].keyVector())

    def summary(self, *, failed: bool) -> MarginalSummary | None:
        graph, points, at, ours = self._left if failed else self._state()
        return MarginalSummary.of(graph, points, at, ours) if graph.size() else None

    def _state(self) -> _State:
        """Return a copy of the solver's state, which the solver changes in place."""
        points = gtsam.Values(self._solver.getISAM2().getLinearizationPoint())
        return gtsam.NonlinearFactorGraph(self._solver.getFactors()), points, self._ours.framed, self._ours.slots


def _holding(factors: Sequence[gtsam.NonlinearFactor], values: Values) -> dict[int, gtsam.NonlinearFactor]:
    """Return auxiliary factors that keep iSAM2 from moving the linearisation points of the variables of ``factors``.

    Each auxiliary factor connects one of these variables with a new auxiliary variable, and has no information. The
    auxiliary variable is marginalised immediately, and iSAM2 never moves the linearisation point of its neighbours. The
    keys of the result are the auxiliary variables. ``factors``: marginal factors. ``values``: of their variables, by
    key.
    """
    marginal = (factor.keys() for factor in factors if isinstance(factor, gtsam.LinearContainerFactor))
    fixed = dict.fromkeys(key for keys in marginal for key in keys)
    unit, out = gtsam.noiseModel.Unit.Create(1), dict[int, gtsam.NonlinearFactor]()
    for i, key in enumerate(fixed):
        nothing = np.zeros((1, len(values[key])))
        factor = gtsam.JacobianFactor(leaving_key(i), np.ones((1, 1)), key, nothing, np.zeros(1), unit)
        out[leaving_key(i)] = gtsam.LinearContainerFactor(factor)
    return out


class LinearFactors:
    """The factors of measurements in a solver, and the linearisation points of the solver's variables.

    ``threshold``: a variable is linearised again after it has changed by this value. ``skip``: the changes are checked
    at every ``skip``-th update. ``on_failure``: a function that is called with the reason if a factor cannot be
    linearised. The factor is then left out.
    """

    def __init__(self, threshold: float, skip: int, on_failure: Callable[[str], None]) -> None:
        self._threshold, self._skip, self._on_failure = threshold, skip, on_failure
        self._updates = 0
        self.at: Values = {}  # the linearisation point of each variable
        # the linearisation points that iSAM2 does not move, shifted by the mean translation of the estimates
        self._held: Values = {}
        # the factors on each variable, by their identity
        self._on: defaultdict[int, dict[int, _Linear]] = defaultdict(dict)
        self._slots: set[int] = set()  # the indices (slots) of these factors in the solver's graph
        self._added: list[_Linear] = []  # the factors of the last update

    def added(
        self,
        solver: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother,
        factors: Sequence[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
    ) -> tuple[gtsam.NonlinearFactorGraph, list[int]]:
        """Return the factors that the next update of ``solver`` must add, and the indices of the factors that it must
        remove. Call :meth:`place` after the update.

        ``factors``: new factors of GTSAM. ``nodes``: new factors of measurements. ``values``: initial values of new
        variables by key. Existing factors on variables that will be linearised again are replaced.
        """
        self._updates += 1
        self._added = self._moved(solver) if self.at and not self._updates % self._skip else []
        removed = [linear.slot for linear in self._added] if self._added else []
        self._slots.difference_update(removed)
        self.at |= values
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.add(factor)
        for node in nodes:
            if node.native is not None:
                graph.add(node.native)
                continue
            linear = _Linear(node)
            self._added.append(linear)
            for key in node.keys:
                self._on[key][id(linear)] = linear
        ours = list(map(_PLACED, self._added))
        for linear, linearized in zip(self._added, jacobian_factors(ours, self.at, self._on_failure), strict=True):
            linear.slot = graph.size()
            keys = linear.node.keys
            # a factor needs special treatment if the linearisation point of a variable is fixed (held)
            is_fixed = self._held and not self._held.keys().isdisjoint(keys)
            graph.add(self._on_held(keys, linearized) if is_fixed else gtsam.LinearContainerFactor(linearized))
        return graph, removed

    def _on_held(self, keys: Sequence[int], linearized: gtsam.GaussianFactor) -> gtsam.LinearContainerFactor:
        """Return the factor ``linearized`` with a changed Jacobian, which agrees with the marginal factors (see the
        module docstring). ``keys``: the variables of the factor. At least one of them has a fixed linearisation
        point."""
        jacobian, right = linearized.jacobian()
        motions, ends = frame_motions({key: self._held.get(key, self.at[key]) for key in keys})
        if sum(map(is_place, keys)) > 1:  # a factor on one position has absolute information, which must not be removed
            jacobian = project_out_gauge(jacobian, motions)
        factor = gaussian_factor(keys, -right, np.split(jacobian, ends[:-1], axis=1))
        return gtsam.LinearContainerFactor(factor, to_gtsam({key: self.at[key] for key in keys}))

    def place(self, slots: Sequence[int]) -> None:
        """Store ``slots``, the indices that the added factors have in the solver's graph after the update."""
        for linear in self._added:
            linear.slot = slots[linear.slot]
            self._slots.add(linear.slot)

    def forget(self, key: int) -> None:
        """Delete the data of the variable ``key`` and of its factors. Call this after it was removed from the
        solver."""
        del self.at[key]
        self._held.pop(key, None)
        for linear in self._on.pop(key, {}).values():
            self._slots.discard(linear.slot)
            for neighbour in linear.node.keys:
                if neighbour != key:
                    self._on[neighbour].pop(id(linear), None)

    @property
    def framed(self) -> Values:
        """The linearisation points for a new solver, by key. Variables of marginal factors keep their relative
        positions, because marginal factors are valid only for these."""
        return self.at | self._held

    @property
    def slots(self) -> frozenset[int]:
        """The indices that these factors have in the graph of the solver."""
        return frozenset(self._slots)

    def _moved(self, solver: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother) -> list[_Linear]:
        """Return the factors that the next update of ``solver`` must replace, because their linearisation points
        change."""
        keys, ends = list(self.at), np.cumsum([len(value) for value in self.at.values()])
        change = np.maximum.reduceat(np.abs(solver.getDelta().vector(keys)), np.append(0, ends[:-1]))
        moved = [keys[i] for i in np.flatnonzero(change >= self._threshold).tolist()]
        if not moved:
            return []
        isam = solver if isinstance(solver, gtsam.ISAM2) else solver.getISAM2()
        fixed = isam.getFixedVariables()  # the variables of marginal factors
        anew = [key for key in moved if not fixed.count(key)]
        self.at |= {key: read(solver, key) for key in anew}
        anew += self._followed({key: read(solver, key) for key in keys if is_place(key) and fixed.count(key)})
        return list({number: linear for key in anew for number, linear in self._on.get(key, {}).items()}.values())

    def _followed(self, estimates: Values) -> list[int]:
        """Return the keys of the variables that must be linearised again, none if the map is known. ``estimates``: the
        current estimates of all variables with a linearisation point that iSAM2 does not move."""
        if all(map(is_pose, estimates)):
            return []
        for key in estimates:
            self._held.setdefault(key, self.at[key])
        translation = np.mean([estimates[key][:2] - self._held[key][:2] for key in estimates], axis=0)
        moved = {key: now for key, now in estimates.items() if np.abs(now - self.at[key]).max() >= self._threshold}
        if np.abs(translation).max() >= self._threshold:
            self._held |= {key: np.append(self._held[key][:2] + translation, self._held[key][2:]) for key in estimates}
            moved = estimates
        self.at |= moved
        return list(moved)


@dataclass(slots=True, eq=False)
class _Linear:
    """The factor of a measurement (``node``). ``slot``: its index in the solver's factor graph."""

    node: Node
    slot: int = -1


_PLACED = attrgetter("node.factor", "node.keys", "node.rows")


def project_out_gauge(jacobian: Array, motions: Array) -> Array:
    """Return the matrix nearest to ``jacobian`` (m, n) whose product with ``motions`` is zero.

    ``motions`` (n, 3): the derivatives of the variables when the whole graph is translated or rotated, from
    :func:`factors.graph.frame_motions`. Source: Hesch, Kottas, Bowman, Roumeliotis, IEEE Transactions on Robotics
    30(1), 2014, section V.
    """
    basis = np.linalg.qr(motions)[0]
    return np.asarray(jacobian - jacobian @ basis @ basis.T)
