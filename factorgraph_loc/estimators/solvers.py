"""iSAM2 with the full history, and with a window that poses leave, behind one set of methods.

In the full history our own factors are linearised here and given to iSAM2 as linear ones, which are replaced when their
variables have moved: a callback from GTSAM copies all variables, so its cost would grow with the run. In a window there
are few variables, and callbacks are cheap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, cast

import gtsam
import numpy as np

from factorgraph_loc.estimators.variables import Node, Values, gather, is_point, is_pose, read, to_gtsam
from factors import se2
from factors.graph import custom_factor, jacobian_factor, pose_array, read_pose, read_vector
from factors.se2 import Array

RELINEARIZE_SKIP = 10  # updates between checks of which factors of the full history to linearise anew
RECENT = 200  # variables that are checked then; older ones hardly move before the end
MOVED, TURNED = 0.05, 0.03  # m, rad: how far a variable may be from where its factors were linearised
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


class FullHistory:
    """Everything stays in the graph."""

    def __init__(self, parameters: gtsam.ISAM2Params) -> None:
        self._isam = gtsam.ISAM2(parameters)
        self._ours: list[_Linear] = []
        self._updates = 0

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        graph = gtsam.NonlinearFactorGraph()
        new: list[_Linear] = []
        for node in nodes:
            if node.native is not None:
                graph.add(node.native)
            else:
                new.append(_Linear(node, graph.size(), self._point(node.keys, values)))
                graph.add(new[-1].linearize())
        with _gtsam():
            slots = self._isam.update(graph, to_gtsam(values)).getNewFactorsIndices()
        for linear in new:
            linear.slot = slots[linear.slot]
        self._ours += new
        self._updates += 1
        if self._updates % RELINEARIZE_SKIP == 0:
            self._relinearize(self._ours[-RECENT:])

    def value(self, key: int) -> Array:
        return read(self._isam, key)

    def covariance(self, key: int) -> Array:
        return np.asarray(self._isam.marginalCovariance(key))

    def estimates(self) -> gtsam.Values:
        return self._isam.calculateEstimate()

    def linear(self) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
        return _linear(self._isam)

    def _point(self, keys: Sequence[int], values: Values) -> list[Array]:
        """Values of the variables: as given in ``values``, else as the solver estimates them."""
        return [values[key] if key in values else read(self._isam, key) for key in keys]

    def _relinearize(self, linears: Iterable[_Linear]) -> None:
        """Replace the factors whose variables have moved from where they were linearised."""
        graph, slots, changed = gtsam.NonlinearFactorGraph(), [], []
        estimates: Values = {}
        for linear in linears:
            for key in linear.node.keys:
                if key not in estimates:
                    estimates[key] = read(self._isam, key)
            point = gather(estimates, linear.node.keys)
            if linear.is_off(point):
                linear.point = point
                slots.append(linear.slot)
                changed.append(linear)
                graph.add(linear.linearize())
        if changed:
            with _gtsam():
                new = self._isam.update(graph, gtsam.Values(), slots).getNewFactorsIndices()
            for linear, slot in zip(changed, new, strict=True):
                linear.slot = slot


class Window:
    """Poses older than ``lag``, and a margin so that they can be read several at a time, are marginalised out."""

    def __init__(self, parameters: gtsam.ISAM2Params, lag: float, on_failure: Callable[[str], None]) -> None:
        self._smoother = gtsam.IncrementalFixedLagSmoother(lag + MARGIN, parameters)
        self._sizes: dict[int, int] = {}  # of the variables that are no poses
        self._on_failure = on_failure

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        self._sizes |= {key: len(value) for key, value in values.items() if not is_pose(key)}
        graph = gtsam.NonlinearFactorGraph()
        for node in nodes:
            graph.add(node.native if node.native is not None else self._custom(node))
        stamps: dict[int, float] = dict.fromkeys(values, t)
        # what is constant never leaves the window, points do when they are seen no more
        stamps |= dict.fromkeys((key for key in self._sizes if not is_point(key)), t)
        stamps |= dict.fromkeys((key for node in nodes for key in node.keys if is_point(key)), t)
        with _gtsam():
            self._smoother.update(graph, to_gtsam(values), cast("Mapping[Any, Any]", stamps))

    def value(self, key: int) -> Array:
        return read(self._smoother, key)

    def covariance(self, key: int) -> Array:
        return np.asarray(self._smoother.marginalCovariance(key))

    def estimates(self) -> gtsam.Values:
        return self._smoother.calculateEstimate()

    def linear(self) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
        return _linear(self._smoother.getISAM2())

    def covariances(self, keys: Sequence[int]) -> list[Array]:
        """Marginal covariances of neighbouring poses, together: they share most of the work."""
        joint = self._smoother.getISAM2().jointMarginalCovariance(list(keys))
        return [np.asarray(joint.at(key, key)) for key in keys]

    def _custom(self, node: Node) -> gtsam.NonlinearFactor:
        assert node.factor is not None
        readers = [read_pose if is_pose(key) else read_vector for key in node.keys]
        dimensions = [3 if is_pose(key) else self._sizes[key] for key in node.keys]
        return custom_factor(node.factor, node.keys, readers, dimensions, node.rows, self._on_failure)


class _Linear:
    """One of our factors in the full history: where it was linearised and which slot of iSAM2 it has."""

    def __init__(self, node: Node, slot: int, point: list[Array]) -> None:
        self.node = node
        self.slot = slot
        self.point = point

    def linearize(self) -> gtsam.LinearContainerFactor:
        assert self.node.factor is not None
        values = to_gtsam(dict(zip(self.node.keys, self.point, strict=True)))
        return gtsam.LinearContainerFactor(jacobian_factor(self.node.factor, self.node.keys, self.point), values)

    def is_off(self, point: Sequence[Array]) -> bool:
        """Whether a variable has moved too far from where it was."""
        for key, old, new in zip(self.node.keys, self.point, point, strict=True):
            change = new - old
            if is_pose(key):
                turn = abs(se2.wrap_scalar(change[2]))
                if abs(change[0]) > MOVED or abs(change[1]) > MOVED or turn > TURNED:
                    return True
            elif np.abs(change).max() > MOVED:
                return True
        return False


@contextmanager
def _gtsam() -> Iterator[None]:
    """Whatever GTSAM throws as RuntimeError."""
    try:
        yield
    except (IndexError, ValueError) as error:
        raise RuntimeError(str(error)) from error


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
