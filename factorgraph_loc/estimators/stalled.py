"""What stands in place of a solver that was lost and could not be built anew, until the next try."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import gtsam

from factorgraph_loc.estimators.summary import Summary
from factorgraph_loc.estimators.variables import Node, Values
from factors.se2 import Array

FIRST_WAIT = 1.0  # s until the next try, twice as long each time


class Stalled:
    """No solver (:class:`~factorgraph_loc.estimators.solvers.Solver`): what was ``known`` of each variable when the last one was
    lost, and the ``left`` summary of that. Until the time ``until`` the newest pose goes on as a filter's would; ``before``: the
    last time that it did."""

    def __init__(
        self, t: float, known: Callable[[int], Array], left: Summary | None, before: Stalled | None = None
    ) -> None:
        self.wait: float = FIRST_WAIT if before is None else 2.0 * before.wait
        self.until = t + self.wait
        self._known = known
        self._left = left

    def update(self, nodes: Sequence[Node], values: Values, t: float) -> None:
        raise RuntimeError("the last try failed")

    def begin(
        self,
        factors: Iterable[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
        stamps: Mapping[int, float],
    ) -> None:
        raise RuntimeError("the last try failed")

    def value(self, key: int) -> Array:
        return self._known(key)

    def covariance(self, key: int) -> Array:
        raise RuntimeError("there is no solver")

    def estimates(self) -> gtsam.Values:
        return gtsam.Values()

    def linear(self) -> tuple[gtsam.GaussianFactorGraph, dict[int, int]]:
        raise RuntimeError("there is no solver")

    @property
    def oldest(self) -> int:
        return 0 if self._left is None else self._left.oldest

    def summary(self, *, failed: bool) -> Summary | None:
        return self._left
