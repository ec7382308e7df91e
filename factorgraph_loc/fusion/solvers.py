"""iSAM2 with the full history, and with a window that poses leave, behind one set of methods.

In the full history our own factors are linearised here and given to iSAM2 as linear ones: a callback from GTSAM copies all
variables, so its cost would grow with the run. A factor is linearised where iSAM2 linearises its variables, and replaced in the
update that moves these: were it left behind, the factors would no longer agree on what a turn of the whole graph does to the poses,
and would seem to tell of the heading what nothing measured (Huang, Mourikis, Roumeliotis, International Journal of Robotics
Research 29(5), 2010). In a window there are few variables, and callbacks are cheap.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol, cast

import gtsam
import numpy as np

from factorgraph_loc.fusion.summary import Summary, oldest_pose
from factorgraph_loc.fusion.variables import Node, Values, gather, gtsam_errors, is_point, is_pose, read, to_gtsam
from factors.graph import custom_factor, jacobian_factor, pose_array, read_pose, read_vector
from factors.se2 import Array

MARGIN = 1.0  # s that a pose stays longer in a window


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
        factors: Iterable[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        """The first update, with the time of each variable, and with ``factors`` of GTSAM's besides."""

    @property
    def oldest(self) -> int:
        """The index of the oldest pose in the graph before the last update."""

    def summary(self, *, failed: bool) -> Summary | None:
        """What is known of all that is no more in the graph, before the last update if that ``failed``; None where all is there."""


class FullHistory:
    """Everything stays in the graph. ``threshold``: how far iSAM2 lets a variable move from where it is linearised, in m, rad or
    the units of constants."""

    def __init__(self, parameters: gtsam.ISAM2Params, threshold: float) -> None:
        parameters.setRelinearizeThreshold(threshold)
        self._isam = gtsam.ISAM2(parameters)
        self._threshold, self._skip = threshold, parameters.relinearizeSkip
        self._updates = 0
        self._at: Values = {}  # where ISAM2 linearises each variable
        self._keys: list[int] = []  # of all variables
        self._starts: list[int] = [0]  # of each of them in a vector of all, and its length
        self._linear: defaultdict[int, list[_Linear]] = defaultdict(list)  # our factors on each variable

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        with gtsam_errors():
            self._update(nodes, values)

    def _update(self, nodes: Sequence[Node], values: Values) -> None:
        ours = self._relinearized()
        old = [linear.slot for linear in ours]
        self._at |= values
        for key, value in values.items():
            self._keys.append(key)
            self._starts.append(self._starts[-1] + len(value))
        graph = gtsam.NonlinearFactorGraph()
        for linear in ours:
            graph.add(linear.at(self._at))
        for node in nodes:
            if node.native is not None:
                graph.add(node.native)
                continue
            linear = _Linear(node, graph.size())
            graph.add(linear.at(self._at))
            ours.append(linear)
            for key in node.keys:
                self._linear[key].append(linear)
        for i in range(len(old)):
            ours[i].slot = i
        slots = self._isam.update(graph, to_gtsam(values), old).getNewFactorsIndices()
        for linear in ours:
            linear.slot = slots[linear.slot]
        self._updates += 1

    def begin(
        self,
        factors: Iterable[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        natives = [Node(tuple(factor.keys()), native=factor) for factor in factors]
        self.update([*natives, *nodes], values, 0.0)

    @property
    def oldest(self) -> int:
        return 0

    def summary(self, *, failed: bool) -> Summary | None:
        return None

    def value(self, key: int) -> Array:
        with gtsam_errors():
            return read(self._isam, key)

    def covariance(self, key: int) -> Array:
        with gtsam_errors():
            return np.asarray(self._isam.marginalCovariance(key))

    def estimates(self) -> gtsam.Values:
        return self._isam.calculateEstimate()

    def linear(self) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
        return _linear(self._isam)

    def _relinearized(self) -> list[_Linear]:
        """Our factors on those variables that the next update will linearise elsewhere."""
        if not self._keys or (self._updates + 1) % self._skip:
            return []
        change = np.abs(self._isam.getDelta().vector(self._keys))
        moved = np.flatnonzero(np.maximum.reduceat(change, self._starts[:-1]) >= self._threshold)
        found: dict[int, _Linear] = {}
        for key in (self._keys[i] for i in moved.tolist()):
            self._at[key] = read(self._isam, key)
            found |= {id(linear): linear for linear in self._linear.get(key, ())}
        return list(found.values())


class Window:
    """Poses older than ``lag``, and a margin so that they can be read several at a time, are marginalised out."""

    def __init__(self, parameters: gtsam.ISAM2Params, lag: float, on_failure: Callable[[str], None]) -> None:
        self._smoother = gtsam.IncrementalFixedLagSmoother(lag + MARGIN, parameters)
        self._sizes: dict[int, int] = {}  # of the variables that are no poses
        self._on_failure = on_failure
        # before the last update: all factors, and where they were linearised
        self._before = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        stamps: dict[int, float] = dict.fromkeys(values, t)
        # what is constant never leaves the window, points do when they are seen no more
        stamps |= dict.fromkeys((key for key in self._sizes if not is_point(key)), t)
        stamps |= dict.fromkeys((key for node in nodes for key in node.keys if is_point(key)), t)
        self.begin((), nodes, values, stamps)

    def begin(
        self,
        factors: Iterable[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        self._sizes |= {key: len(value) for key, value in values.items() if not is_pose(key)}
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.add(factor)
        for node in nodes:
            graph.add(node.native if node.native is not None else self._custom(node))
        self._before = self._smoother.getFactors(), self._smoother.getLinearizationPoint()
        with gtsam_errors():
            self._smoother.update(graph, to_gtsam(values), cast("Mapping[Any, Any]", stamps))

    def value(self, key: int) -> Array:
        with gtsam_errors():
            return read(self._smoother, key)

    def covariance(self, key: int) -> Array:
        with gtsam_errors():
            return np.asarray(self._smoother.marginalCovariance(key))

    def estimates(self) -> gtsam.Values:
        return self._smoother.calculateEstimate()

    def linear(self) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
        return _linear(self._smoother.getISAM2())

    @property
    def oldest(self) -> int:
        return oldest_pose(self._before[0].keyVector())

    def summary(self, *, failed: bool) -> Summary | None:
        graph, at = self._before if failed else (self._smoother.getFactors(), self._smoother.getLinearizationPoint())
        return Summary.of(graph, at) if graph.size() else None

    def covariances(self, keys: Sequence[int]) -> list[Array]:
        """Marginal covariances of neighbouring poses, together: they share most of the work."""
        with gtsam_errors():
            joint = self._smoother.getISAM2().jointMarginalCovariance(list(keys))
            return [np.asarray(joint.at(key, key)) for key in keys]

    def _custom(self, node: Node) -> gtsam.NonlinearFactor:
        assert node.factor is not None
        readers = [read_pose if is_pose(key) else read_vector for key in node.keys]
        dimensions = [3 if is_pose(key) else self._sizes[key] for key in node.keys]
        return custom_factor(node.factor, node.keys, readers, dimensions, node.rows, self._on_failure)


class _Linear:
    """One of our factors in the full history, and which slot of iSAM2 it has."""

    def __init__(self, node: Node, slot: int) -> None:
        self.node = node
        self.slot = slot

    def at(self, values: Values) -> gtsam.LinearContainerFactor:
        """The factor, linearised at ``values``."""
        assert self.node.factor is not None
        point = gather(values, self.node.keys)
        here = to_gtsam(dict(zip(self.node.keys, point, strict=True)))
        return gtsam.LinearContainerFactor(jacobian_factor(self.node.factor, self.node.keys, point), here)


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
